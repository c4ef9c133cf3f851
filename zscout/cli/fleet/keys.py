"""`zscout doctor --keys`: the participants on the mesh, and the key expressions that each serves."""

from __future__ import annotations

from typing import Any

import click

from zscout import terminal
from zscout.cli import common
from zscout.cli.fleet.fleet_view import FleetView
from zscout.keyexpr import Keys, Role, Sender, Token


@click.command()
@common.json_option("Print one JSON object.")
@common.runs
async def keys(as_json: bool) -> None:
    """List the participants on the mesh, by host, and the keys of each: now `zscout doctor --keys`.

    \b
    Examples:
      zscout doctor --keys
      zscout doctor --keys --json | jq -r '.alive[].keys[].key'
    """
    await show_keys(as_json=as_json)


async def show_keys(*, as_json: bool) -> None:
    """Raises NobodyThere."""
    async with common.connected("keys", need_rcm=False) as client:
        sharable: set[str] | None = None
        with FleetView(client) as fleet_view:
            await fleet_view.quiet()
            try:
                state = await fleet_view.settled(loads=False)
                sharable = {view.rc for view in state.rcs if view.sharable}
            except common.NobodyThere:
                if not fleet_view.hosts:
                    raise
        tokens = sorted(token for host in fleet_view.hosts.values() for token in host.tokens)
        own, links = client.mesh.keys, client.mesh.links()
        if as_json:
            alive = [
                {**token._asdict(), "token": own.alive(token), "keys": served(own, token, sharable)} for token in tokens
            ]
            terminal.print_json({"fleet": own.fleet, "base": own.base, "links": links, "alive": alive})
        else:
            _print(own, tokens, links, sharable)


def served(own: Keys, token: Token, sharable: set[str] | None) -> list[dict[str, Any]]:
    """The keys of the participant with this token. `how`: query (it answers), put (it publishes) or hear (it
    subscribes). `sharable`: the RCs that vote; None: unknown. On a secured fleet keys of queries have the asker."""
    match token.role:
        case Role.RCM:
            found = [
                ("query", own.schedule_any, "request, cancel, release, hand over, book, unbook, slots"),
                ("query", own.rcm_state_any if own.closed else own.rcm_state, "holds, and the queue with reasons"),
                ("query", own.rcm_bookings_any if own.closed else own.rcm_bookings, "bookings"),
                ("put", own.grants, "holders of each device touched, revocations, heartbeat"),
                ("put", own.notice_any, "the changes of each request, to its client"),
                ("query", own.rank_any if own.closed else own.rank, "the best hosts for a component"),
                ("query", own.served_placer()[0], "place, stop, migrate, drain, uncordon, list"),
                ("put", own.placements, "states of components, at each change"),
            ]
        case Role.NODE:
            [named, *_] = own.served_component(token.host)
            found = [("query", named, "components here: start, stop, list, logs, move")]
        case Role.RC:
            found = [
                ("query", own.command_any(token.name), "commands, under a grant"),
                ("query", (own.asked_state_any if own.closed else own.rc_state)(token.name), "holders, term, health"),
                ("put", own.rc_state(token.name), "the same, at each change"),
                ("hear", own.grants, "its holders from now on"),
            ]
            if sharable is None or token.name in sharable:
                found.insert(0, ("query", own.vote(token.name), "would it carry these holders"))
        case Role.LOAD:
            found = [("put", own.load(token.host), "load report, once a second")]
        case Role.CLIENT:
            sender = Sender(token.host, token.name)
            found = [
                ("query", own.requests(sender), "its open requests"),
                ("hear", own.notice(sender), "their changes"),
            ]
        case Role.CANDIDATE | Role.RECORDER:
            found = [("hear", own.grants, "holders of all devices"), ("hear", own.placements, "states of components")]
            if token.role == Role.CANDIDATE:
                found.append(("query", own.history_any(token.host), "holds that are over, if it keeps a journal"))
                found.append(("query", own.bookings(token.host), "bookings that it keeps"))
        case _:
            found = []
    return [{"how": how, "key": key, "what": what} for how, key, what in found]


def _print(own: Keys, tokens: list[Token], links: int, sharable: set[str] | None) -> None:
    terminal.print_line(f"Fleet {own.fleet}: {len(tokens)} alive, {links} links; all keys lie under {own.base}/")
    rows: list[tuple[str, ...]] = []
    # Two instances of one name have two tokens, and serve the same keys.
    for token in {token[:3]: token for token in tokens}.values():
        keys = served(own, token, sharable) or [{"how": "-", "key": "-", "what": "it is alive"}]
        for number, key in enumerate(keys):
            # At a terminal only the first key of a participant has its name; programs need it on each line.
            who = token[:3] if number == 0 or not terminal.at_terminal() else ("", "", "")
            rows.append((*who, key["how"], key["key"].removeprefix(f"{own.base}/"), key["what"]))
    terminal.print_line("")
    terminal.Table(
        "", ("HOST", "ROLE", "NAME", "HOW", "KEY", "WHAT"), rows, spare=("WHAT",), fold=("NAME", "KEY")
    ).print()

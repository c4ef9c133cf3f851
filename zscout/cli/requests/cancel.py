"""`zscout cancel` and `release`: end requests and holds."""

from __future__ import annotations

from typing import Final, NamedTuple

import click

from zscout import terminal
from zscout.behaviors.client.client import TRY_AGAIN, Client
from zscout.cli import common
from zscout.cli.ownership import User, ask_for_others, whose, yes_option
from zscout.cli.requests.acquire import release_token
from zscout.cli.requests.options import arc_argument
from zscout.config.strict import quoted
from zscout.keyexpr import USERS, check_name, client_of
from zscout.messages import Cancel, Notice, RcmState, Release, Who

MAX_LISTED: Final = 20
"""ARCs of one name that an error lists."""
TRIES: Final = 3
TIMEOUT_S: Final = 1.0

every_option = click.option("--all", "every", is_flag=True, help="End all requests of that name.")


@click.command()
@arc_argument
@every_option
@yes_option
@common.json_option("Print one JSON object.")
@common.runs
async def cancel(arc: str, every: bool, yes: bool, as_json: bool) -> None:
    """End a request, whether it holds or waits. Name it by name, id, or <host>/<client>/<id>.

    Its program is notified; a command that `zscout request` runs is stopped. If several requests have the name, the
    command lists them and ends none, unless --all is given. Before it ends another user's request it asks; if stdin is
    not a terminal, add --yes. In a secured fleet only operators may end others' requests.

    \b
    Examples:
      zscout cancel survey
      zscout cancel 5f0c2a9d13be
      zscout cancel survey --all
    """
    await _end(arc, "cancel", every=every, yes=yes, as_json=as_json)


@click.command()
@arc_argument
@every_option
@yes_option
@common.json_option("Print one JSON object.")
@common.runs
async def release(arc: str, every: bool, yes: bool, as_json: bool) -> None:
    """End the hold of a request. Name it by name, id, or <host>/<client>/<id>, or by the token of `zscout acquire`.

    Like `zscout cancel`, with the same question, but a waiting request keeps waiting. If several requests have the
    name, none is ended, unless --all is given. With a token the commands that run under it are ended first; a hold
    that has already ended is no error.

    \b
    Examples:
      zscout release survey
      zscout release $TOKEN
      zscout release anvil/request-5f0c2a9d13be/0b1d3c5e7f90 --json
    """
    if (held := await release_token(arc)) is None:
        await _end(arc, "release", every=every, yes=yes, as_json=as_json)
        return
    target, outcome = Target(held.arc, held.id, held.client, "ended" if held.ended else "running"), "released"
    if as_json:
        found = {name: getattr(target, name) for name in ("arc", "id", "client", "was")}
        terminal.print_json({"op": "release", "arcs": [found | {"state": "ended", "outcome": outcome}]})
    else:
        word = f"has ended: {held.ended}" if held.ended else f"was {target.was}: {outcome}"
        terminal.print_line(terminal.clean(f"{target.arc} ({target.full_name}) {word}"))


class Target(NamedTuple):
    """An ARC to end. `was`: `running` or `queued`."""

    arc: str
    id: str
    client: str
    was: str
    who: Who | None = None

    @property
    def host(self) -> str:
        return self.client.partition("/")[0]

    @property
    def label(self) -> str:
        return f"{self.arc} ({self.full_name}) of {whose(self.host, self.who)}"

    @property
    def full_name(self) -> str:
        return f"{self.client}/{self.id}"


async def _end(named: str, word: str, *, every: bool, yes: bool, as_json: bool) -> None:
    async with common.connected(word) as client:
        found = _choose(await common.state_of(client), named, word, every=every)
        me = User.of(client)
        others = [target.label for target in found if not me.owns(target.host, target.who)]
        await ask_for_others(client, others, word, yes=yes)
        done = [(target, await _operate(client, target, word)) for target in found]
    if as_json:
        arcs = [
            {name: getattr(target, name) for name in ("arc", "id", "client", "was")}
            | {"state": notice.state, "outcome": notice.outcome}
            for target, notice in done
        ]
        terminal.print_json({"op": word, "arcs": arcs})
        return
    for target, notice in done:
        outcome = notice.outcome or notice.state
        terminal.print_line(terminal.clean(f"{target.arc} ({target.full_name}) was {target.was}: {outcome}"))


def _choose(state: RcmState, named: str, word: str, *, every: bool) -> list[Target]:
    """Raises Failed if there is none, or, without `every`, more than one."""
    known = [Target(hold.arc, hold.id, hold.client, "running", hold.who) for hold in state.holds]
    known += [Target(wait.arc, wait.id, wait.client, "queued", wait.who) for wait in state.queue]
    matching = [target for target in known if named in (target.arc, target.id, target.full_name)]
    if not matching and state.more and named.count("/") == 2:
        # The answer leaves out the end of a long queue; a full name is enough to end a request there.
        client, _, request = named.rpartition("/")
        matching = [Target(request, check_name(request, "id"), str(client_of(client)), "queued")]
    found = [target for target in matching if word == "cancel" or target.was == "running"]
    if matching and not found:
        raise common.Failed(
            f"request {quoted(named)} is waiting and holds nothing; to cancel it: zscout cancel {named}"
        )
    if not found:
        more = f"; {state.more} more wait: name them <host>/<client>/<id>" if state.more else ""
        raise common.Failed(f"no request {quoted(named)} holds or waits{more}; {_hint(state, named)}")
    if len(found) > 1 and not every:
        listed = ", ".join(f"{target.full_name} ({target.was})" for target in found[:MAX_LISTED])
        rest = f" and {len(found) - MAX_LISTED} more" if len(found) > MAX_LISTED else ""
        raise common.Failed(
            f"{len(found)} requests are called {quoted(named)}: {listed}{rest}; "
            "name one by <host>/<client>/<id>, or add --all"
        )
    return found


def _hint(state: RcmState, named: str) -> str:
    if rc := common.device_named(state, named):
        return f"{rc} is a device: zscout status {rc} shows which requests hold it or wait"
    return "see zscout status, or zscout booking list for bookings"


async def _operate(client: Client, target: Target, word: str) -> Notice:
    """Let the RCM end an ARC. Retries are safe. Raises Failed, NobodyThere."""
    own = client.mesh.me.host
    if client.mesh.keys.closed and (why := client.fleet.access.refusal(own, "end requests", USERS)):
        raise common.Failed(f"{target.full_name} was not ended: {why}")
    operation = (Cancel if word == "cancel" else Release)(id=target.id, client=target.client, who=client.who)
    key = client.mesh.keys.schedule(client.mesh.me)
    for _ in range(TRIES):
        replies = await client.mesh.ask(
            key, operation, Notice, timeout=TIMEOUT_S, enough=lambda reply: reply.message is not None
        )
        notices = [reply.message for reply in replies if reply.message is not None]
        if notices:
            return max(notices, key=lambda notice: (notice.term, notice.step))
        problem = next((reply.problem for reply in replies if reply.problem is not None), None)
        if problem is not None and problem.code not in TRY_AGAIN:
            raise common.Failed(f"{target.full_name} was not ended: {problem.message}")
    raise common.NobodyThere("the leader did not answer; the request may or may not have ended: see zscout status")

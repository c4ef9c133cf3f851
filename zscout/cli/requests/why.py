"""`zscout why ARC`: its story, what it waits for, and who is in its way."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Final

import click
from msgspec import structs

from zscout import terminal
from zscout.cli import common
from zscout.cli.requests.contention import NeedContention, contention_of, hold_json
from zscout.messages import HoldView, RcAsk, RcmState, RcState, StoryLine, WaitView

if TYPE_CHECKING:
    from zscout.behaviors.client.client import Client

MAX_TWINS: Final = 20
"""Open ARCs of one name that are described."""
ASK_RC: Final = 0.5
"""Seconds that an RC has to say what ails it."""

View = HoldView | WaitView


@click.command()
@click.argument("arc")
@common.json_option("Print one JSON object.")
def why(arc: str, as_json: bool) -> None:
    """Tell what became of ARC, and why it waits if it does.

    ARC is its name, its id, or HOST/CLIENT/ID. Of each RC that it needs: who holds it, with which priority,
    since when, for how long yet. An ARC that has ended is known for as long as the RCM remembers it.

    \b
    Examples:
      zscout why survey
      zscout why 4caaac1a6451 --json | jq .arcs[0].story
    """
    found = common.run(_look(common.arc_named(arc)))
    if as_json:
        terminal.print_json(found)
        return
    for number, one in enumerate(found["arcs"]):
        if number:
            terminal.print_line("")
        for line, style in _words(one):
            # `secho` leaves the colours out in a pipe.
            click.secho(terminal.clean(line), **style)


async def _look(asked: str) -> dict[str, Any]:
    """What `--json` prints. Raises NobodyThere, and Failed where there is no such ARC."""
    async with common.connected("why") as client:
        state = await common.state_of(client, asked, forecast=True)
        views: list[View] = [*state.holds, *state.queue]
        same = [view for view in views if asked in (view.arc, view.id, _full(view))]
        if not same and not state.story:
            names = [view.arc for view in views]
            raise common.unknown("ARC", asked, names, "and none is open", "open", state.more)
        arcs = [await _described(client, view, state) for view in same[:MAX_TWINS]]
        if not same:
            arcs = [{"arc": asked, "state": "ended", "story": _story(state.story)}]
        return {
            "fleet": client.fleet.name,
            "asked": asked,
            "arcs": arcs,
            "more": max(0, len(same) - MAX_TWINS),
        }


async def _described(client: Client, view: View, state: RcmState) -> dict[str, Any]:
    """One open ARC, with its own story and not that of others of its name."""
    story = (await common.state_of(client, _full(view))).story
    described = structs.asdict(view) | {
        "state": "running" if isinstance(view, HoldView) else "queued",
        "needs": [
            _need(need, view) | {"health": await _health(client, need)}
            for need in contention_of(state, view.needs, _full(view))
        ],
        "story": _story(story),
    }
    if isinstance(view, WaitView):
        described["ahead"] = state.queue.index(view)
        described["queued"] = len(state.queue) + state.more
    return described


def _need(seen: NeedContention, view: View) -> dict[str, Any]:
    """One need; of a hold `need` is what was asked for, and `rc` what it has."""
    met = {rc: need for need, rc in view.bound.items()} if isinstance(view, HoldView) else {}
    holders = [
        hold_json(hold) | {"rc": rc.rc, "params": hold.needs[rc.rc]} for rc in seen.rcs for hold in rc.holds
    ]
    return seen.as_json() | {
        "need": met.get(seen.need, seen.need),
        "params": view.needs[seen.need],
        "holders": holders,
    }


async def _health(client: Client, need: NeedContention) -> str | None:
    """Why an RC that counts as lost does so, in its own words; None where it is well or does not answer."""
    if need.rc is None or need.present:
        return None
    mesh = client.mesh
    reply = await mesh.ask_one(mesh.keys.rc_state(need.rc), RcAsk(), RcState, timeout=ASK_RC)
    state = None if reply is None else reply.message
    return None if state is None or state.health == "ok" else state.health


def _story(lines: list[StoryLine]) -> list[dict[str, Any]]:
    return [{"ago": line.ago, "text": line.text} for line in lines]


def _full(view: View) -> str:
    return f"{view.client}/{view.id}"


# Words

Line = tuple[str, dict[str, Any]]
_PLAIN: Final[dict[str, Any]] = {}
_BOLD: Final = {"bold": True}
_DIM: Final = {"dim": True}


def _words(arc: dict[str, Any]) -> Iterator[Line]:
    if arc["state"] == "ended":
        yield f"{arc['arc']} is not open any more", _BOLD
    else:
        yield from _standing(arc)
        yield "Holds" if arc["state"] == "running" else "Needs", _BOLD
        for need in arc["needs"]:
            yield from _need_words(need)
    yield "Story", _BOLD
    spans = [f"{terminal.span(line['ago'])} ago" for line in arc["story"]]
    width = max(map(len, spans), default=0)
    for span, line in zip(spans, arc["story"], strict=True):
        yield f"  {span:>{width}}  {line['text']}", _PLAIN


def _standing(arc: dict[str, Any]) -> Iterator[Line]:
    who = f"{arc['arc']} (id {arc['id']}, of {arc['client']}, priority {arc['priority']})"
    runtime = terminal.span(float(arc["min_runtime"]))
    if arc["state"] == "running":
        yield f"{who} has run for {terminal.span(arc['held'])}", {"bold": True, "fg": "green"}
        left = f"{terminal.span(arc['remaining'])} left" if arc["remaining"] > 0 else "nothing left"
        after = "; it keeps what it has after that" if arc["keep"] else ""
        yield f"  {left} of its minimum runtime of {runtime}{after}", _PLAIN
        return
    yield f"{who} has waited for {terminal.span(arc['waited'])}", {"bold": True, "fg": "yellow"}
    yield f"  {arc['reason']}", _PLAIN
    ahead = arc["ahead"]
    place = "nobody is ahead of it" if not ahead else f"{ahead} {'is' if ahead == 1 else 'are'} ahead of it"
    yield f"  {place} in the queue of {arc['queued']}; it wants {runtime}", _PLAIN
    if arc.get("starts_in") is not None:
        yield f"  it may start in {terminal.span(arc['starts_in'])}, if nothing else comes", _PLAIN
    else:
        yield "  no start can be foretold as things stand", _PLAIN
    if arc["preemptions"]:
        yield f"  it was preempted {_times(arc['preemptions'])}", _PLAIN


def _need_words(need: dict[str, Any]) -> Iterator[Line]:
    amounts = common.amount_text(need["params"])
    rc = need["rc"]
    what = need["need"] if rc in (None, need["need"]) else f"{rc} for {need['need']}"
    name = f"  {what}" + (f" ({amounts})" if amounts else "")
    if not need["present"]:
        yield f"{name}: {need['health'] or 'not on the mesh'}", {"fg": "red"}
    elif rc is None and need["free"]:
        yield f"{name}: no ARC holds {', '.join(need['free'])}", {"fg": "green"}
    elif not need["holders"]:
        yield f"{name}: no other ARC holds it", {"fg": "green"}
    for holder in need["holders"] if need["present"] else ():
        share = common.amount_text(holder["params"])
        which = "" if rc is not None else f"{holder['rc']} "
        yield (
            f"{name}: {which}{'shared with' if need['sharable'] else 'held by'} {holder['arc']}"
            + (f" ({share})" if share else "")
            + f" of {holder['client']}, priority {holder['priority']}, for {terminal.span(holder['held'])}; "
            + _left(holder),
            _PLAIN,
        )


def _left(hold: dict[str, Any]) -> str:
    if hold["remaining"] <= 0:
        return "its minimum runtime is over"
    return f"{terminal.span(hold['remaining'])} left" + (" at least" if hold["keep"] else "")


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"

"""`zscout why`: the events of a request (its story), and the requests that are in its way."""

from __future__ import annotations

from datetime import datetime
from typing import Any, Final

import click
from msgspec import structs

from zscout import terminal
from zscout.behaviors.client.client import Client
from zscout.cli import common
from zscout.cli.journals import ask_journals, ending, local
from zscout.cli.journals import hold_json as past_json
from zscout.cli.ownership import User
from zscout.cli.requests.options import MAX_ARC_NAME, arc_argument
from zscout.cli.requests.waiting import (
    NeedContention,
    comment,
    contention_of,
    hold_json,
    hold_words,
    reason_text,
    request_words,
)
from zscout.messages import HistoryAsk, HoldView, RcAsk, RcmState, RcState, WaitView
from zscout.scheduling.reason import starting

MAX_DESCRIBED: Final = 20
"""Requests of one name that are described."""
RC_TIMEOUT_S: Final = 0.5

View = HoldView | WaitView


@click.command()
@arc_argument
@common.json_option("Print one JSON object.")
@common.runs
async def why(arc: str, as_json: bool) -> None:
    """Show the story of a request, event by event, and why it waits.

    REQUEST is the request's name, its id, or HOST/CLIENT/ID. For each device that it needs you see the requests that
    hold it: person, priority, begin and end. The leader keeps the story of an ended request for a while; after that
    the journals of the candidates show its holds and how they ended.

    \b
    Examples:
      zscout why survey
      zscout why 4caaac1a6451 --json | jq .arcs[0].story
    """
    async with common.connected("why") as client:
        me = User.of(client)
        state = await common.state_of(client, arc, forecast=True)
        views: list[View] = [*state.holds, *state.queue]
        same = [view for view in views if arc in (view.arc, view.id, _full(view))]
        unknown = common.unknown("request", arc, [view.arc for view in views], "and none is open", "open", state.more)
        if rc := common.device_named(state, arc):
            unknown = common.Failed(f"{rc} is a device: zscout status {rc} shows which requests hold it or wait")
        past = [] if same or state.story else await _past_holds(client, arc, unknown)
        found = [await _described(client, view, state) for view in same[:MAX_DESCRIBED]]
        if not same:
            found = [{"arc": arc, "state": "ended", "story": list(map(structs.asdict, state.story)), "holds": past}]
    if as_json:
        more = max(0, len(same) - MAX_DESCRIBED)
        terminal.print_json({"fleet": client.fleet.name, "asked": arc, "arcs": found, "more": more})
        return
    for number, described in enumerate(found):
        if number:
            terminal.print_line("")
        _print(described, me)


async def _past_holds(client: Client, arc: str, unknown: common.Failed) -> list[dict[str, Any]]:
    """The latest holds of a request unknown to the leader, oldest first, as of `zscout history --json`. Raises
    `unknown` if no journal has a hold."""
    if len(arc) > MAX_ARC_NAME:
        raise unknown
    try:
        answer = await ask_journals(client, HistoryAsk(arc=arc), MAX_DESCRIBED)
    except common.Failed:
        raise unknown from None
    if not answer.holds:
        raise unknown
    return [past_json(hold, answer.window.ended) | {"end": ending(hold)} for hold in answer.holds]


async def _described(client: Client, view: View, state: RcmState) -> dict[str, Any]:
    """With its story, without other requests of its name. In a hold `need` is as requested, `rc` its device."""
    story = (await common.state_of(client, _full(view))).story
    met = {rc: need for need, rc in view.bound.items()} if isinstance(view, HoldView) else {}
    needs = []
    for seen in contention_of(state, view.needs, _full(view)):
        holders = [hold_json(hold) | {"rc": rc.rc, "params": hold.needs[rc.rc]} for rc in seen.rcs for hold in rc.holds]
        need = {"need": met.get(seen.need, seen.need), "params": view.needs[seen.need], "holders": holders}
        needs.append(seen.as_json() | need | {"health": await _health(client, seen)})
    status = "running" if isinstance(view, HoldView) else "queued"
    described = structs.asdict(view) | {"state": status, "needs": needs, "story": list(map(structs.asdict, story))}
    if isinstance(view, WaitView):
        described |= {"ahead": state.queue.index(view), "queued": len(state.queue) + state.more}
    return described


async def _health(client: Client, need: NeedContention) -> str | None:
    """Return the reason that a device is lost, in its own words or else the leader's; None: unknown."""
    if need.rc is None or need.present:
        return None
    lost = need.rcs[0].lost or None
    mesh = client.mesh
    reply = await mesh.ask_one(mesh.keys.rc_state(need.rc), RcAsk(), RcState, timeout=RC_TIMEOUT_S)
    state = None if reply is None else reply.message
    return lost if state is None or state.health == "ok" else state.health


def _full(view: View) -> str:
    return f"{view.client}/{view.id}"


def _echo(text: str, **style: Any) -> None:
    # `secho` leaves the colours out in a pipe.
    click.secho(terminal.clean(text), **style)


def _print(arc: dict[str, Any], me: User) -> None:
    if arc["state"] == "ended":
        _echo(f"{arc['arc']} is no longer open", bold=True)
        if arc["holds"]:
            _print_holds(arc["holds"])
            return
    else:
        _print_request(arc, me)
        _echo("Holds" if arc["state"] == "running" else "Needs", bold=True)
        for need in arc["needs"]:
            _print_need(need, arc["priority"], me)
    _echo("Story", bold=True)
    spans = [f"{terminal.clock(-line['ago'])} ({terminal.span(line['ago'])} ago)" for line in arc["story"]]
    width = max(map(len, spans), default=0)
    for span, line in zip(spans, arc["story"], strict=True):
        _echo(f"  {span:>{width}}  {line['text']}")


def _print_holds(holds: list[dict[str, Any]]) -> None:
    _echo("Holds, from the journals of the candidates", bold=True)
    for hold in holds:
        waited = "" if hold["waited"] is None else f" after {terminal.span(hold['waited'])} in the queue"
        began = local(datetime.fromisoformat(hold["began"]).timestamp())
        by = request_words(hold["arc"], hold["who"], hold["client"])
        _echo(f"  {began}  {by}, priority {hold['priority']}, held {', '.join(hold['rcs'])}")
        _echo(f"    for {terminal.span(hold['held'])}{waited}: {hold['end']}")


def _print_request(arc: dict[str, Any], me: User) -> None:
    who = f"{request_words(arc['arc'], arc['who'], arc['client'])}, priority {arc['priority']},"
    command = f", command {arc['who'].command}" if arc["who"] is not None and arc["who"].command else ""
    names = f"  id {arc['id']}, client {arc['client']}{command}{comment(arc['who'])}"
    runtime = terminal.span(float(arc.get("runtime") or arc["min_runtime"]))
    if arc["state"] == "running":
        _echo(f"{who} has run since {_past(arc['held'])}", bold=True, fg="green")
        _echo(names)
        left = "its minimum runtime is over"
        if arc["waits"] is not None:
            left = f"{starting(arc['waits'])}; its minimum runtime of {runtime} begins then"
        elif arc["remaining"] > 0:
            left = f"until {_end(arc['remaining'])}, its minimum runtime of {runtime}"
        after = "; it keeps its devices after that" if arc["keep"] else ""
        _echo(f"  {left}{after}")
        if arc["remaining"] > 0 and (protected := arc["protected_from"]) is not None:
            since = "" if arc["remaining"] <= protected else f" from {terminal.clock(arc['remaining'] - protected)} on"
            _echo(f"  only operators preempt it{since}")
        if (ends := arc.get("ends_in")) is not None:
            _echo(f"  likely to end at {terminal.clock(ends)} (in {terminal.span(ends)}), judging by earlier holds")
        return
    _echo(f"{who} has waited since {_past(arc['waited'])}", bold=True, fg="yellow")
    _echo(names)
    _echo(f"  {reason_text(arc['reason'], arc['why'], me=me)}")
    ahead = arc["ahead"]
    place = "no request is ahead of it" if not ahead else f"{ahead} {'is' if ahead == 1 else 'are'} ahead of it"
    _echo(f"  {place} in the queue of {arc['queued']}; it wants {runtime}")
    start = "no start can be estimated"
    if (starts := arc.get("starts_in")) is not None:
        start = f"it may start at {terminal.clock(starts)} (in {terminal.span(starts)}), if nothing else comes"
    _echo(f"  {start}")
    if arc["preemptions"]:
        times = "once" if arc["preemptions"] == 1 else f"{arc['preemptions']} times"
        _echo(f"  it was preempted {times}")


def _past(ago: float) -> str:
    return f"{terminal.clock(-ago)} ({terminal.span(ago)})"


def _end(left: float) -> str:
    return f"{terminal.clock(left)} ({terminal.span(left)})"


def _print_need(need: dict[str, Any], priority: int, me: User) -> None:
    rc = need["rc"]
    what = need["need"] if rc in (None, need["need"]) else f"{rc} for {need['need']}"
    name = f"  {common.with_amounts(what, need['params'])}"
    if not need["present"]:
        _echo(f"{name}: {need['health'] or 'not on the mesh'}", fg="red")
    elif rc is None and need["free"]:
        _echo(f"{name}: no request holds {', '.join(need['free'])}", fg="green")
    elif not need["holders"]:
        _echo(f"{name}: no other request holds it", fg="green")
    for holder in need["holders"] if need["present"] else ():
        which = "" if rc is not None else f"{holder['rc']} "
        relation = "shared with" if need["sharable"] else "held by"
        _echo(f"{name}: {which}{relation} {hold_words(holder, priority, me)}")

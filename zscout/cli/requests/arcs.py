"""`zscout why`, `cancel` and `release`: the story of an ARC, and its end at somebody's word."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import click
from msgspec import structs

from zscout import terminal
from zscout.behaviors.client.client import TRY_AGAIN, Client
from zscout.cli import common
from zscout.cli.requests.waiting import NeedContention, contention_of, hold_json
from zscout.config.strict import BadInput, quoted
from zscout.keyexpr import check_name, client_of
from zscout.messages import Cancel, HoldView, Notice, RcAsk, RcmState, RcState, Release, WaitView

MAX_NAME: Final = 200
"""Characters of `<host>/<client>/<id>`, the longest name of an ARC."""
MAX_LISTED: Final = 20
"""ARCs of one name that are described, or listed where one has to be chosen."""
ASK_RC: Final = 0.5
"""Seconds that an RC has to say what ails it."""
TRIES: Final = 3
TIMEOUT: Final = 1.0

View = HoldView | WaitView


def arc_named(text: str, _option: str) -> str:
    """What may be an ARC's name, its id or `<host>/<client>/<id>`. Raises BadInput."""
    if not text or len(text) > MAX_NAME or not text.isprintable():
        raise BadInput(f"{quoted(text)} names no ARC; zscout status lists them")
    return text


arc_argument = click.argument("arc", type=common.Parsed("text", arc_named))
every_option = click.option("--all", "every", is_flag=True, help="All ARCs of that name, not only one.")


@click.command()
@arc_argument
@common.json_option("Print one JSON object.")
@common.runs
async def why(arc: str, as_json: bool) -> None:
    """Tell what became of ARC, and why it waits if it does.

    ARC is its name, its id, or HOST/CLIENT/ID. Of each RC that it needs: who holds it, with which priority,
    since when, for how long yet. An ARC that has ended is known for as long as the RCM remembers it.

    \b
    Examples:
      zscout why survey
      zscout why 4caaac1a6451 --json | jq .arcs[0].story
    """
    async with common.connected("why") as client:
        state = await common.state_of(client, arc, forecast=True)
        views: list[View] = [*state.holds, *state.queue]
        same = [view for view in views if arc in (view.arc, view.id, _full(view))]
        if not same and not state.story:
            raise common.unknown("ARC", arc, [view.arc for view in views], "and none is open", "open", state.more)
        found = [await _described(client, view, state) for view in same[:MAX_LISTED]]
        if not same:
            found = [{"arc": arc, "state": "ended", "story": list(map(structs.asdict, state.story))}]
    if as_json:
        more = max(0, len(same) - MAX_LISTED)
        terminal.print_json({"fleet": client.fleet.name, "asked": arc, "arcs": found, "more": more})
        return
    for number, one in enumerate(found):
        if number:
            terminal.print_line("")
        _print(one)


@click.command()
@arc_argument
@every_option
@common.json_option("Print one JSON object.")
@common.runs
async def cancel(arc: str, every: bool, as_json: bool) -> None:
    """End an ARC, whether it runs or waits: by name, id, or <host>/<client>/<id>.

    Its program is told; one that `zscout request` runs is stopped. A name that
    several ARCs have is refused with the list of them, unless --all is given.

    \b
    Examples:
      zscout cancel survey
      zscout cancel 5f0c2a9d13be
      zscout cancel survey --all
    """
    await _end(arc, "cancel", every=every, as_json=as_json)


@click.command()
@arc_argument
@every_option
@common.json_option("Print one JSON object.")
@common.runs
async def release(arc: str, every: bool, as_json: bool) -> None:
    """End the hold of a running ARC: by name, id, or <host>/<client>/<id>.

    The same as `zscout cancel`, but only for ARCs that run: one that waits is
    left alone. A name that several have is refused, unless --all is given.

    \b
    Examples:
      zscout release survey
      zscout release anvil/request-5f0c2a9d13be/0b1d3c5e7f90 --json
    """
    await _end(arc, "release", every=every, as_json=as_json)


# Its end


class Target(NamedTuple):
    """An ARC to be ended. `was` is `running` or `queued`."""

    arc: str
    id: str
    client: str
    was: str


async def _end(named: str, word: str, *, every: bool, as_json: bool) -> None:
    async with common.connected(word) as client:
        found = _choose(await common.state_of(client), named, word, every=every)
        done = [(target, await _operate(client, target, word)) for target in found]
    if as_json:
        arcs = [{**target._asdict(), "state": notice.state, "outcome": notice.outcome} for target, notice in done]
        terminal.print_json({"op": word, "arcs": arcs})
        return
    for target, notice in done:
        outcome = notice.outcome or notice.state
        terminal.print_line(terminal.clean(f"{target.arc} ({_full(target)}) was {target.was}: {outcome}"))


def _choose(state: RcmState, named: str, word: str, *, every: bool) -> list[Target]:
    """The ARCs that are meant. Raises Failed where there is none, or more than one without `every`."""
    known = [Target(hold.arc, hold.id, hold.client, "running") for hold in state.holds]
    known += [Target(wait.arc, wait.id, wait.client, "queued") for wait in state.queue]
    matching = [target for target in known if named in (target.arc, target.id, _full(target))]
    if not matching and state.more and named.count("/") == 2:
        # The answer leaves out the end of a long queue; a full name is enough to end it all the same.
        client, _, request = named.rpartition("/")
        matching = [Target(request, check_name(request, "id"), str(client_of(client)), "queued")]
    found = [target for target in matching if word == "cancel" or target.was == "running"]
    if matching and not found:
        raise common.Failed(f"{quoted(named)} holds nothing, it waits; to end that: zscout cancel {named}")
    if not found:
        more = f"; {state.more} more wait: name it <host>/<client>/<id>" if state.more else ""
        raise common.Failed(f"no ARC {quoted(named)} runs or waits{more}; see zscout status")
    if len(found) > 1 and not every:
        listed = ", ".join(_full(target) for target in found[:MAX_LISTED])
        rest = f" and {len(found) - MAX_LISTED} more" if len(found) > MAX_LISTED else ""
        raise common.Failed(f"{len(found)} ARCs are called {quoted(named)}: {listed}{rest}; name one so, or add --all")
    return found


async def _operate(client: Client, target: Target, word: str) -> Notice:
    """Has the RCM end one ARC; asking twice does no harm. Raises Failed, NobodyThere."""
    operation = (Cancel if word == "cancel" else Release)(id=target.id, client=target.client)
    key = client.mesh.keys.schedule(client.mesh.me)
    for _ in range(TRIES):
        replies = await client.mesh.ask(
            key, operation, Notice, timeout=TIMEOUT, enough=lambda reply: reply.message is not None
        )
        notices = [reply.message for reply in replies if reply.message is not None]
        if notices:
            return max(notices, key=lambda notice: (notice.term, notice.step))
        problem = next((reply.problem for reply in replies if reply.problem is not None), None)
        if problem is not None and problem.code not in TRY_AGAIN:
            raise common.Failed(f"{_full(target)} was not ended: {problem.message}")
    raise common.NobodyThere("the RCM did not answer: it may be done or not; see zscout status, and try again")


# Its story


async def _described(client: Client, view: View, state: RcmState) -> dict[str, Any]:
    """One open ARC, with its own story and not that of others of its name. Of a hold each `need` is what was asked
    for, and `rc` what it has."""
    story = (await common.state_of(client, _full(view))).story
    met = {rc: need for need, rc in view.bound.items()} if isinstance(view, HoldView) else {}
    needs = []
    for seen in contention_of(state, view.needs, _full(view)):
        holders = [hold_json(hold) | {"rc": rc.rc, "params": hold.needs[rc.rc]} for rc in seen.rcs for hold in rc.holds]
        need = {"need": met.get(seen.need, seen.need), "params": view.needs[seen.need], "holders": holders}
        needs.append(seen.as_json() | need | {"health": await _health(client, seen)})
    stands = "running" if isinstance(view, HoldView) else "queued"
    described = structs.asdict(view) | {"state": stands, "needs": needs, "story": list(map(structs.asdict, story))}
    if isinstance(view, WaitView):
        described |= {"ahead": state.queue.index(view), "queued": len(state.queue) + state.more}
    return described


async def _health(client: Client, need: NeedContention) -> str | None:
    """Why an RC that counts as lost does so, in its own words; None where it is well or does not answer."""
    if need.rc is None or need.present:
        return None
    mesh = client.mesh
    reply = await mesh.ask_one(mesh.keys.rc_state(need.rc), RcAsk(), RcState, timeout=ASK_RC)
    state = None if reply is None else reply.message
    return None if state is None or state.health == "ok" else state.health


def _full(view: View | Target) -> str:
    return f"{view.client}/{view.id}"


def _say(text: str, **style: Any) -> None:
    # `secho` leaves the colours out in a pipe.
    click.secho(terminal.clean(text), **style)


def _print(arc: dict[str, Any]) -> None:
    if arc["state"] == "ended":
        _say(f"{arc['arc']} is not open any more", bold=True)
    else:
        _print_standing(arc)
        _say("Holds" if arc["state"] == "running" else "Needs", bold=True)
        for need in arc["needs"]:
            _print_need(need)
    _say("Story", bold=True)
    spans = [f"{terminal.span(line['ago'])} ago" for line in arc["story"]]
    width = max(map(len, spans), default=0)
    for span, line in zip(spans, arc["story"], strict=True):
        _say(f"  {span:>{width}}  {line['text']}")


def _print_standing(arc: dict[str, Any]) -> None:
    who = f"{arc['arc']} (id {arc['id']}, of {arc['client']}, priority {arc['priority']})"
    runtime = terminal.span(float(arc["min_runtime"]))
    if arc["state"] == "running":
        _say(f"{who} has run for {terminal.span(arc['held'])}", bold=True, fg="green")
        left = f"{terminal.span(arc['remaining'])} left" if arc["remaining"] > 0 else "nothing left"
        after = "; it keeps what it has after that" if arc["keep"] else ""
        _say(f"  {left} of its minimum runtime of {runtime}{after}")
        return
    _say(f"{who} has waited for {terminal.span(arc['waited'])}", bold=True, fg="yellow")
    _say(f"  {arc['reason']}")
    ahead = arc["ahead"]
    place = "nobody is ahead of it" if not ahead else f"{ahead} {'is' if ahead == 1 else 'are'} ahead of it"
    _say(f"  {place} in the queue of {arc['queued']}; it wants {runtime}")
    start = "no start can be foretold as things stand"
    if arc.get("starts_in") is not None:
        start = f"it may start in {terminal.span(arc['starts_in'])}, if nothing else comes"
    _say(f"  {start}")
    if arc["preemptions"]:
        times = "once" if arc["preemptions"] == 1 else f"{arc['preemptions']} times"
        _say(f"  it was preempted {times}")


def _print_need(need: dict[str, Any]) -> None:
    rc = need["rc"]
    what = need["need"] if rc in (None, need["need"]) else f"{rc} for {need['need']}"
    name = f"  {common.with_amounts(what, need['params'])}"
    if not need["present"]:
        _say(f"{name}: {need['health'] or 'not on the mesh'}", fg="red")
    elif rc is None and need["free"]:
        _say(f"{name}: no ARC holds {', '.join(need['free'])}", fg="green")
    elif not need["holders"]:
        _say(f"{name}: no other ARC holds it", fg="green")
    for holder in need["holders"] if need["present"] else ():
        who = common.with_amounts(holder["arc"], holder["params"])
        which = "" if rc is not None else f"{holder['rc']} "
        relation = "shared with" if need["sharable"] else "held by"
        left = "its minimum runtime is over"
        if holder["remaining"] > 0:
            left = f"{terminal.span(holder['remaining'])} left" + (" at least" if holder["keep"] else "")
        _say(
            f"{name}: {which}{relation} {who} of {holder['client']}, priority {holder['priority']}, for "
            f"{terminal.span(holder['held'])}; {left}"
        )

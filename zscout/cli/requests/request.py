"""`zscout request`: waits for devices, and holds them for a time or for a command."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Iterator
from typing import Any, Final

import click

from zscout.behaviors.client.arc import Held
from zscout.behaviors.client.client import Client, CommandRefused
from zscout.behaviors.client.request import HoldEnd, OpenArc
from zscout.cli import common
from zscout.cli.common import Failed
from zscout.cli.requests.options import CommandAfterDashes, HoldOptions, Need, gather, hold_options
from zscout.cli.requests.run_command import RunningCommand, environment
from zscout.cli.requests.waiting import Report, held_text
from zscout.messages import Foresight
from zscout.terminal import clean, print_json, print_line, span

TAKEN_AWAY: Final = 75
"""EX_TEMPFAIL: the grant was taken from the command; it may be tried again."""
TIME_OVER: Final = 124
"""As `timeout` has it: the command was ended because its time was over."""
MAX_PRIORITY: Final = 1_000_000
LAST_WORD: Final = 0.5
"""Seconds in which the RCM's word about a hold whose time is over arrives."""


@click.command(cls=CommandAfterDashes)
@click.argument("needs", nargs=-1, required=True, type=Need(), metavar="NEED...")
@click.option(
    "--priority",
    type=click.IntRange(-MAX_PRIORITY, MAX_PRIORITY),
    default=0,
    help="Higher ones preempt lower ones.",
)
@click.option("--keep", is_flag=True, help="Go on past the minimum runtime, until something else needs it.")
@click.option(
    "--dry-run", is_flag=True, help="Only say when it would start, and whom it would preempt at once."
)
@hold_options
@click.pass_context
@common.runs
async def request(
    ctx: click.Context, /, needs: Any, priority: int, keep: bool, name: str | None, dry_run: bool, **rest: Any
) -> int:
    """Wait until all of the devices are granted at once, then hold them.

    A NEED is kind/name, and for a sharable device how it will be used:
    radio/rf0:command_rate=5,other=1. With a * it is met by any one device whose
    name matches: 'framegrabber/*' is any framegrabber, 'robot/scout$*' any robot
    whose name begins so; twice the same is two of them. Quote it for the shell.

    With a COMMAND, they are held while it
    runs, for the minimum runtime at most (--keep: for longer), and given back
    as soon as it ends. When its time is over or the grant is taken away, the
    command's process group gets SIGTERM, and SIGKILL after the grace. Without
    one, they are held until Ctrl-C or until the minimum runtime is over.

    \b
    The command finds in its environment:
      ZSCOUT_ARC, ZSCOUT_ARC_ID  the ARC's name and id
      ZSCOUT_RCS                 the devices, with spaces between
      ZSCOUT_BOUND               which of them meets which pattern, as JSON:
                                 {"framegrabber/*": "framegrabber/fgrab1"}
      ZSCOUT_GRANT               the grant as JSON, to be sent with each command
      ZSCOUT_CLIENT              who holds it: <host>/<client>
      ZSCOUT_REMAINING           seconds until the minimum runtime is over
      ZSCOUT_FLEET_NAME          the fleet; ZSCOUT_FLEET its file, if there is one

    \b
    Exit code: the command's own (128 + n: ended by signal n), or
      75   the grant was taken away       124  its time was over
      126  it can't be executed           127  there is no such command
      1    not granted; without a command also: taken away    3  no RCM

    With a COMMAND all lines of zscout go to stderr.

    \b
    Examples:
      zscout request robot/scout33 --min-runtime 2m
      zscout request robot/scout33 radio/rf0:command_rate=5 --keep -- ./survey.py --fast
      zscout request framegrabber/fgrab1 --timeout 30 --again -- ./record.sh
      zscout request 'framegrabber/*' 'framegrabber/*' robot/scout33 -- ./stereo.py
      zscout request robot/scout33 --json | jq .event
      zscout request robot/scout33 --priority 5 --dry-run
    """
    wanted = gather(ctx, needs, name, priority=priority, keep=keep, **rest)
    async with common.connected("request") as client:
        return await (_foresee(client, wanted) if dry_run else carry_out(client, wanted))


async def carry_out(client: Client, wanted: HoldOptions) -> int:
    """Waits, holds, runs the command; everything is given back at the end. Returns the exit code.

    Raises Failed, RequestRefused."""
    stream = sys.stderr if wanted.command else sys.stdout
    with Report(wanted.name, client, as_json=wanted.as_json, stream=stream) as report:
        client.watch(report.news)
        arc: OpenArc | None = None
        while True:
            try:
                arc = await _wait(client, wanted, report, arc)
                code = await _use(client, wanted, report, arc)
            except CommandRefused as refused:
                # A device did not know of the grant: the client has given it back.
                if not wanted.again:
                    lost = TAKEN_AWAY if wanted.command else 1
                    raise Failed(f"{wanted.name}: {refused}; try again", lost) from None
                report.event("lost", f"{wanted.name}: {refused}; asking again", {"reason": str(refused)})
                arc = None
                continue
            if code is not None:
                return code


async def _wait(client: Client, wanted: HoldOptions, report: Report, arc: OpenArc | None) -> OpenArc:
    """Until it is granted. Raises Failed where it is not."""
    try:
        async with report.telling(report.follow_wait()), asyncio.timeout(wanted.timeout):
            if arc is None:
                arc = await client.request(wanted.name, wanted.needs, **wanted.terms(), estimate=True)
            grant = await client.granted(arc)
    except TimeoutError:
        why = arc.reason if arc is not None else ""
        if arc is not None:
            await client.end(arc)
        line = f"{wanted.name} was not granted within {span(wanted.timeout or 0)}, and is cancelled"
        report.event("ended", "", {"outcome": "timeout", "reason": why})
        raise Failed(clean(f"{line}: {why}" if why else line)) from None
    except asyncio.CancelledError:
        if arc is not None:
            await client.end(arc)
        report.event("ended", f"{wanted.name} is cancelled", {"outcome": "cancelled"})
        raise
    if grant is None:
        report.event("ended", "", {"outcome": arc.outcome, "reason": arc.reason})
        raise Failed(clean(f"{wanted.name} was not granted: {arc.reason or arc.outcome}"))
    return arc


async def _use(client: Client, wanted: HoldOptions, report: Report, arc: OpenArc) -> int | None:
    """Under the grant. Returns the exit code, or None: it was taken away, and is to be waited for again."""
    grant = arc.grant
    if grant is None:  # taken away since the RCs confirmed it
        return await _taken(client, wanted, report, arc)
    held = Held(client, arc, grant)
    rcs = held_text(held.rcs, held.bound)
    length = "until it is needed elsewhere" if arc.keep else f"for {span(held.remaining)}"
    details = {"id": arc.id, "grant": grant, "rcs": held.rcs, "bound": held.bound, "keep": arc.keep}
    details["remaining"] = round(held.remaining, 3)
    report.event("granted", f"{arc.name} holds {rcs} {length}", details)
    try:
        code = None
        if wanted.command:
            code = await _run(wanted, report, held, client)
        else:
            async with report.telling(report.follow_hold(arc)):
                await held.over()
    except BaseException:
        await client.end(arc)
        report.event("ended", f"{arc.name} gave back {rcs}", {"outcome": "released"})
        raise
    if code is not None:
        await client.end(arc)
        report.event("ended", f"{arc.name} gave back {rcs}", {"outcome": "released", "code": code})
        return code
    if held.active:
        # By our clock its time is over; the RCM's own word is on its way.
        await report.within(LAST_WORD, lambda: not held.active)
    if held.active or _ending(arc).outcome == "completed":
        arc.finish("completed", "its time is over", client.mesh.now())
        report.event("ended", f"the time of {arc.name} is over", {"outcome": "completed"})
        return TIME_OVER if wanted.command else 0
    return await _taken(client, wanted, report, arc)


async def _run(wanted: HoldOptions, report: Report, held: Held, client: Client) -> int | None:
    """Runs the command until it ends (its code), or until the hold is over and it has been ended (None)."""
    async with RunningCommand(wanted.command, environment(held, client), float(wanted.grace)) as command:
        _, ended = await common.first_of(held.over(), command.wait())
        if ended:
            if held.active:
                # At once: what it left running is ended afterwards, and may take its time.
                await client.end(held.arc)
            return await command.wait()
        why = "its time is over" if held.active else _ending(held.arc).reason or "the grant is gone"
        report.event("stopping", f"{wanted.command[0]} is stopped: {why}", {"reason": why})
        await command.end()
    return None


async def _taken(client: Client, wanted: HoldOptions, report: Report, arc: OpenArc) -> int | None:
    """The grant was taken away. Raises Failed where there is no command and no second try."""
    ending, again = _ending(arc), wanted.again and arc.open
    line = f"{arc.name} lost its grant: {ending.reason or ending.outcome}"
    details = {"outcome": ending.outcome, "reason": ending.reason, "by": ending.by, "again": again}
    if again:
        report.event("taken", f"{line}; waiting again", details)
        return None
    report.event("taken", line if wanted.command else "", details)
    if arc.open:
        await client.end(arc)
    if wanted.command:
        return TAKEN_AWAY
    raise Failed(clean(f"{line}; ask again, or with a higher priority"))


def _ending(arc: OpenArc) -> HoldEnd:
    """How its last hold came to its end."""
    return arc.ending or HoldEnd("lost", "")


# What would come of it


async def _foresee(client: Client, wanted: HoldOptions) -> int:
    """Prints when it would start and whom it would preempt at once. Exit code 1: it would not start.

    Raises RequestRefused, NobodyThere."""
    foretold = await client.foresee(wanted.name, wanted.needs, **wanted.terms())
    if foretold is None:
        raise common.NobodyThere(f"the RCM of fleet {client.fleet.name} did not answer; try again")
    if wanted.as_json:
        found = {name: getattr(foretold, name) for name in ("starts_in", "preempts", "reason")}
        print_json({"arc": wanted.name, **found})
    else:
        for line in _words(foretold):
            print_line(clean(line))
    return 0 if foretold.starts_in is not None else 1


def _words(foretold: Foresight) -> Iterator[str]:
    if foretold.starts_in is None:
        yield f"{foretold.arc} would wait, and no start can be foretold: {foretold.reason}"
    elif foretold.reason:
        yield f"{foretold.arc} would start in {span(foretold.starts_in)}, if nothing else comes"
        yield f"until then: {foretold.reason}"
    else:
        yield f"{foretold.arc} would start at once"
    if foretold.preempts:
        yield f"it would preempt {', '.join(foretold.preempts)}"

"""`zscout take`: an operator's request, which says first from whom it takes."""

from __future__ import annotations

import asyncio
import os
import sys
from dataclasses import dataclass
from typing import Any

import click

from zscout.behaviors.client.client import Client
from zscout.cli.common import Failed, connected, run, state_of, the_fleet
from zscout.cli.requests.contention import contention_of, hold_json, hold_text
from zscout.cli.requests.options import CommandAfterDashes, HoldOptions, Need, gather, hold_options
from zscout.cli.requests.request import carry_out
from zscout.messages import HoldView, RcmState
from zscout.terminal import clean, print_json, print_line

MAX_ANSWER = 4_096


@click.command(cls=CommandAfterDashes)
@click.argument("needs", nargs=-1, required=True, type=Need(), metavar="NEED...")
@click.option("-y", "--yes", is_flag=True, help="Don't ask.")
@click.option("--no-keep", is_flag=True, help="Give back when the minimum runtime is over.")
@hold_options
@click.pass_context
def take(ctx: click.Context, /, needs: Any, yes: bool, no_keep: bool, name: str | None, **rest: Any) -> int:
    """Take devices at the fleet's operator priority, and keep them.

    Says who will be preempted and asks, on stderr; without a terminal it needs
    --yes. Then it waits, holds and runs a COMMAND as `zscout request` does, with the
    same exit codes; 1 also where the question was not answered with y. A NEED is
    written as there.

    \b
    Examples:
      zscout take robot/scout33
      zscout take robot/scout33 radio/rf0:command_rate=5 --yes -- ./drive.py
      zscout take 'robot/*' 'framegrabber/*' --no-keep --min-runtime 2m
    """
    priority = the_fleet().operator_priority
    wanted = gather(ctx, needs, name, "operator", priority=priority, keep=not no_keep, **rest)
    return run(_take(wanted, yes=yes))


async def _take(wanted: HoldOptions, *, yes: bool) -> int:
    async with connected("take") as client:
        await _agree(client, wanted, yes=yes)
        return await carry_out(client, wanted)


@dataclass(frozen=True, slots=True)
class TakeoverCost:
    """What taking costs others: holds that end for certain, that may end, and that do not yield. Of `either`,
    by pattern, one must end before it is met."""

    ends: list[HoldView]
    may_end: list[HoldView]
    stays: list[HoldView]
    either: dict[str, list[HoldView]]
    absent: list[str]

    def lines(self) -> list[str]:
        """In words."""
        lines = [f"preempts {hold_text(hold)}: {', '.join(sorted(hold.needs))}" for hold in self.ends]
        lines += [f"may preempt {hold_text(hold)}: {', '.join(sorted(hold.needs))}" for hold in self.may_end]
        lines += [f"waits for {hold_text(hold)}" for hold in self.stays]
        lines += [
            f"waits for {need}: {' or '.join(hold_text(hold) for hold in holds)}"
            for need, holds in self.either.items()
        ]
        lines += [f"waits for {rc}, which is not on the mesh" for rc in self.absent]
        return lines

    def as_json(self) -> dict[str, Any]:
        """The same for programs."""
        return {
            "preempts": [hold_json(hold) for hold in self.ends],
            "may_preempt": [hold_json(hold) for hold in self.may_end],
            "waits_for": [hold_json(hold) for hold in self.stays],
            "waits_for_one_of": {
                need: [hold_json(hold) for hold in holds] for need, holds in self.either.items()
            },
            "absent": self.absent,
        }


def takeover_cost(state: RcmState, wanted: HoldOptions) -> TakeoverCost:
    """What would happen if it were asked for now: as the RCM decides, but for the votes of sharable RCs."""
    ends: dict[str, HoldView] = {}
    may_end: dict[str, HoldView] = {}
    stays: dict[str, HoldView] = {}
    either: dict[str, list[HoldView]] = {}
    needs = contention_of(state, wanted.needs)
    for need in needs:
        if need.rc is None and need.met:
            continue
        choice = len(need.rcs) > 1
        keeps: dict[str, HoldView] = {}
        yields = False
        for rc in need.rcs:
            for hold in rc.holds:
                key = f"{hold.client}/{hold.id}"
                overstays = hold.keep and hold.remaining <= 0 and hold.priority == wanted.priority
                if hold.priority < wanted.priority or overstays:
                    (may_end if rc.sharable or choice else ends)[key] = hold
                    yields = True
                elif not rc.sharable:
                    keeps[key] = hold
        # With a choice, the RCM takes from the lowest priority that yields.
        if not choice:
            stays |= keeps
        elif keeps and not yields:
            either[need.need] = list(keeps.values())
    may_end = {key: hold for key, hold in may_end.items() if key not in ends}
    absent = [need.need for need in needs if not need.present]
    return TakeoverCost(list(ends.values()), list(may_end.values()), list(stays.values()), either, absent)


async def _agree(client: Client, wanted: HoldOptions, *, yes: bool) -> None:
    """Says whom it will preempt and asks, again where that has changed meanwhile. Raises Failed for a no."""
    agreed: set[tuple[str, str]] = set()
    while True:
        cost = takeover_cost(await state_of(client), wanted)
        victims = {(hold.client, hold.id) for hold in (*cost.ends, *cost.may_end)}
        if victims and victims <= agreed:
            return
        _say(client, wanted, cost)
        if yes or not victims:
            return
        if not (sys.stdin.isatty() and sys.stderr.isatty()):
            raise Failed("nobody can be asked here whether to preempt others; add --yes")
        if wanted.as_json:
            # The JSON may go down a pipe; who is asked must see what the question is about.
            _say_in_words(wanted, cost)
        sys.stderr.write(f"Take {', '.join(sorted(wanted.needs))}? [y/N] ")
        sys.stderr.flush()
        if (await _answer()).strip().lower() not in ("y", "yes"):
            raise Failed("nothing was taken")
        agreed |= victims


def _say(client: Client, wanted: HoldOptions, cost: TakeoverCost) -> None:
    stream = sys.stderr if wanted.command else sys.stdout
    if wanted.as_json:
        print_json(
            {"event": "preview", "arc": wanted.name, "client": str(client.mesh.me), **cost.as_json()}, stream
        )
        return
    _say_in_words(wanted, cost)


def _say_in_words(wanted: HoldOptions, cost: TakeoverCost) -> None:
    for line in cost.lines():
        print_line(clean(f"{wanted.name} {line}"), sys.stderr)


async def _answer() -> str:
    """One line from the terminal. Unlike input() it lets Ctrl-C through to the event loop."""
    loop = asyncio.get_running_loop()
    readable = asyncio.Event()
    loop.add_reader(0, readable.set)
    try:
        await readable.wait()
        return os.read(0, MAX_ANSWER).decode(errors="replace")
    finally:
        loop.remove_reader(0)

"""`zscout take`: an operator's request, which first lists the holders that it preempts."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from typing import Any

import click

from zscout.behaviors.client.client import Client
from zscout.cli import common
from zscout.cli.common import Parsed
from zscout.cli.ownership import User, confirm, yes_option
from zscout.cli.requests.options import (
    DEFAULT_NAMES,
    CommandAfterDashes,
    HoldOptions,
    gather,
    hold_options,
    parse_comment,
)
from zscout.cli.requests.request import carry_out
from zscout.cli.requests.waiting import contention_of, hold_json, hold_text
from zscout.messages import HoldView, RcmState
from zscout.scheduling.reason import base, some_of
from zscout.terminal import clean, print_json, print_line


@click.command(cls=CommandAfterDashes)
@yes_option
@click.option("--no-keep", is_flag=True, hidden=True, help="Treat --min-runtime like --release-after.")
@click.option(
    "--reason", type=Parsed("text", parse_comment), default="", help="A reason, shown in status and to the preempted."
)
@hold_options
@common.runs
async def take(needs: Any, yes: bool, no_keep: bool, name: str | None, reason: str, comment: str, **rest: Any) -> int:
    """Take devices at the fleet's operator priority, and keep them.

    The command lists the holds that it preempts, and asks on stderr; if stdin is not a terminal, add --yes. Then it
    waits, holds and runs a COMMAND like `zscout request`, with the same exit codes; 1 also if you did not answer y. A
    DEVICE is written as for `zscout request`, and refused for the same reasons (2).

    \b
    Examples:
      zscout take robot/scout33 --reason 'the gripper is stuck'
      zscout take robot/scout33 radio/rf0:command_rate=5 --yes -- bash
      zscout take 'robot/*' 'framegrabber/*' --release-after 2m
    """
    priority = common.the_fleet().operator_priority
    terms: dict[str, Any] = {"priority": priority, "keep": not no_keep, "comment": reason or comment}
    wanted = gather(needs, name, DEFAULT_NAMES[1], **terms, **rest)
    async with common.connected("take") as client:
        # Refuse a request that can never start before asking the user.
        await client.foresee(wanted.name, wanted.needs, **wanted.terms())
        await _agree(client, wanted, yes=yes)
        return await carry_out(client, wanted)


@dataclass(slots=True)
class TakeoverCost:
    """Holds that end for certain, that may end, and that do not yield. `either`: by pattern, holds of which one must
    end first; `missing`: by pattern without its number, how many of them."""

    priority: int
    """Priority of the request."""
    ends: list[HoldView] = field(default_factory=list)
    may_end: list[HoldView] = field(default_factory=list)
    stays: list[HoldView] = field(default_factory=list)
    either: dict[str, list[tuple[str, HoldView]]] = field(default_factory=dict)
    missing: dict[str, int] = field(default_factory=dict)
    absent: list[str] = field(default_factory=list)

    def lines(self, me: User | None = None) -> list[str]:
        def text(hold: HoldView) -> str:
            return hold_text(hold, self.priority, me)

        return [
            *(f"takes over from {text(hold)}: {', '.join(sorted(hold.needs))}" for hold in self.ends),
            *(f"may take over from {text(hold)}: {', '.join(sorted(hold.needs))}" for hold in self.may_end),
            *(f"waits for {text(hold)}: {', '.join(sorted(hold.needs))}" for hold in self.stays),
            *(
                f"waits for {some_of(max(1, self.missing[family]))} "
                f"{', '.join(f'{rc} (held by {text(hold)})' for rc, hold in some)}"
                for family, some in {base(need): some for need, some in self.either.items()}.items()
            ),
            *(f"waits for {rc}, which is not on the mesh" for rc in self.absent),
        ]

    def as_json(self) -> dict[str, Any]:
        return {
            "preempts": list(map(hold_json, self.ends)),
            "may_preempt": list(map(hold_json, self.may_end)),
            "waits_for": list(map(hold_json, self.stays)),
            "waits_for_one_of": {need: [hold_json(hold) for _, hold in some] for need, some in self.either.items()},
            "absent": self.absent,
        }


def takeover_cost(state: RcmState, wanted: HoldOptions) -> TakeoverCost:
    """Predict the RCM's decision on `wanted`, except for the votes of sharable RCs."""
    cost = TakeoverCost(wanted.priority)
    for need in contention_of(state, wanted.needs):
        if not need.present:
            cost.absent.append(need.need)
        if need.rc is None and need.met:
            continue
        choice = len(need.rcs) > 1
        keeps: list[tuple[str, HoldView]] = []
        yields = False
        for rc in need.rcs:
            for hold in rc.holds:
                overstays = hold.keep and hold.remaining <= 0 and hold.priority == wanted.priority
                if hold.priority < wanted.priority or overstays:
                    _add(cost.may_end if rc.sharable or choice else cost.ends, hold)
                    yields = True
                elif not rc.sharable:
                    keeps.append((rc.rc, hold))
        # With a choice, the RCM takes from the lowest priority that yields.
        if not choice:
            for _, hold in keeps:
                _add(cost.stays, hold)
        elif keeps and not yields:
            cost.either[need.need] = keeps
            family = base(need.need)
            cost.missing[family] = cost.missing.get(family, -len(need.free)) + 1
    cost.may_end = [hold for hold in cost.may_end if hold not in cost.ends]
    return cost


def _add(holds: list[HoldView], hold: HoldView) -> None:
    if hold not in holds:
        holds.append(hold)


async def _agree(client: Client, wanted: HoldOptions, *, yes: bool) -> None:
    """List the holds to preempt and ask, again if they have changed meanwhile. Raises Failed for a no."""
    agreed: set[tuple[str, str]] = set()
    while True:
        cost = takeover_cost(await common.state_of(client), wanted)
        victims = {(hold.client, hold.id) for hold in (*cost.ends, *cost.may_end)}
        if victims and victims <= agreed:
            return
        preview = {"event": "preview", "arc": wanted.name, "client": str(client.mesh.me)} | cost.as_json()
        if wanted.events is not None:
            wanted.events.write(preview)
        if wanted.as_json:
            print_json(preview, sys.stderr if wanted.command else sys.stdout)
        asks = bool(victims) and not yes
        possible = sys.stdin.isatty() and sys.stderr.isatty()
        # Before a question print the lines even with --json: the JSON may go into a pipe.
        if not wanted.as_json or (asks and possible):
            for line in cost.lines(User.of(client)):
                print_line(clean(f"{wanted.name} {line}"), sys.stderr)
        if not asks:
            return
        unasked = "stdin is not a terminal, so I can't ask before preempting; add --yes"
        await confirm(f"Take {', '.join(sorted(wanted.needs))}?", unasked, "nothing was taken")
        agreed |= victims

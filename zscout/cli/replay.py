"""`zscout replay FILE`: what would become of a workload, by the very code that the RCM runs."""

from __future__ import annotations

import json
import re
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from zscout.scheduling.effects import Effect, Granted, Outcome, Queued, Revoked
from zscout.scheduling.model import SECOND, ArcId, Ns, RcName
from zscout.scheduling.policy import StrategyName
from zscout.scheduling.replay import HoldRecord, Replay
from zscout.scheduling.replay import replay as play
from zscout.scheduling.strategies import STRATEGIES
from zscout.scheduling.workload import Workload
from zscout.scheduling.workload_file import MAX_BYTES, parse_workload
from zscout.strict import BadInput, read_text

if TYPE_CHECKING:
    from zscout.services.timeline import Timeline

MAX_SECONDS: Final = 60
"""Columns of one second each; a longer schedule gets a column per interval between two events."""
MAX_COLUMNS: Final = 500
MAX_CELL: Final = 12
"""Characters of a cell; a longer ARC name is cut."""
MAX_LISTED: Final = 200
"""Preemptions, and unserved ARCs, that are listed without --json."""
MAX_DRAWN: Final = 1_000_000_000 * SECOND
"""The end of the time that a recording can show."""
COLOURS: Final = ("blue", "yellow", "green", "magenta", "cyan", "bright_blue", "bright_green")
OPERATOR: Final = "red"
"""Kept for what preempted something."""


@dataclass(slots=True)
class _Preemption:
    arc: ArcId
    at: Ns
    by: ArcId | None
    ran: Ns


@dataclass(slots=True)
class _Told:
    """What the replay told beside its holds: who preempted whom, and why the others wait."""

    workload: Workload
    timeline: Timeline | None = None
    preemptions: list[_Preemption] = field(default_factory=list)
    reasons: dict[ArcId, str] = field(default_factory=dict)
    started: dict[ArcId, Ns] = field(default_factory=dict)
    evicted: set[ArcId] = field(default_factory=set)

    def watch(self, now: Ns, _core: object, effects: list[Effect]) -> None:
        for effect in effects:
            match effect:
                case Granted(arc=arc):
                    self.started[arc] = now
                    self.evicted.discard(arc)
                case Revoked(arc=arc, outcome=Outcome.PREEMPTED, by=by):
                    self.preemptions.append(_Preemption(arc, now, by, now - self.started[arc]))
                    self.evicted.add(arc)
                case Queued(arc=arc, reason=reason):
                    self.reasons[arc] = reason
                case _:
                    pass
            if self.timeline is not None:
                if now > MAX_DRAWN:
                    raise BadInput(
                        f"a recording ends at {_s(MAX_DRAWN)} s, and this goes on; leave out --rrd"
                    )
                _draw(self.timeline, now / SECOND, effect, self.evicted)


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "--strategy",
    type=click.Choice(list(STRATEGIES)),
    default="priority",
    show_default=True,
    help="How RCs are shared out.",
)
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object instead of the table.")
@click.option(
    "--rrd",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write a Rerun recording besides; look at it with `zscout view FILE`.",
)
def replay(file: Path, strategy: StrategyName, as_json: bool, rrd: Path | None) -> None:
    """Show who would hold what, and when, if the requests in FILE came.

    FILE is a workload: RCs, and ARCs with the time at which they ask (TOML). No mesh is needed, and no time
    passes. Without --json, a table with a row for each RC (a sharable one has a row for each holder) and a
    column for each second, or for each interval between two events where a second is not the right step.

    \b
    Examples:
      zscout replay table1.toml
      zscout replay table1.toml --json | jq '.holds[] | select(.outcome == "preempted")'
      zscout replay table1.toml --rrd table1.rrd && zscout view table1.rrd
    """
    workload = parse_workload(read_text(file, max_bytes=MAX_BYTES), str(file))
    told = _Told(workload)
    with ExitStack() as stack:
        if rrd is not None:
            told.timeline = _recording(stack, rrd, file)
        played = play(workload, told.watch, strategy=STRATEGIES[strategy]())
        if told.timeline is not None:
            _draw_holders(told.timeline, workload, played)
    if as_json:
        click.echo(json.dumps(as_object(strategy, played)))
        return
    for line in _report(strategy, workload, played, told):
        click.echo(line)
    if rrd is not None:
        click.echo(f"\nRecording: {rrd} (zscout view {rrd})")


def as_object(strategy: str, played: Replay) -> dict[str, Any]:
    """What `--json` prints: times are seconds."""
    return {
        "strategy": strategy,
        "holds": [
            {
                "arc": hold.arc,
                "start": hold.start / SECOND,
                "end": hold.end / SECOND,
                "outcome": hold.outcome.value,
                "rcs": sorted(hold.rcs),
            }
            for hold in played.holds
        ],
        "unserved": list(played.unserved),
    }


# The table


@dataclass(frozen=True, slots=True)
class Columns:
    """Each column begins at its entry of `starts`; `end` ends the last, and `cut` more are left out."""

    starts: tuple[Ns, ...]
    end: Ns
    by_second: bool
    cut: int = 0


def columns_of(holds: Sequence[HoldRecord]) -> Columns:
    """A column per second where that says all and fits; otherwise one per interval between two events."""
    times = sorted({time for hold in holds for time in (hold.start, hold.end)})
    if not times:
        return Columns((), 0, by_second=True)
    end = times[-1]
    if end <= MAX_SECONDS * SECOND and all(time % SECOND == 0 for time in times):
        return Columns(tuple(range(0, end, SECOND)), end, by_second=True)
    cut = max(0, len(times) - 1 - MAX_COLUMNS)
    shown = times[: len(times) - cut]
    return Columns(tuple(shown[:-1]), shown[-1], by_second=False, cut=cut)


def rows_of(
    workload: Workload, holds: Sequence[HoldRecord], columns: Columns
) -> Iterator[tuple[RcName, list[ArcId | None]]]:
    """The rows, RCs in the file's order: who holds it in each column. Several holders have a row each."""
    index = {start: number for number, start in enumerate((*columns.starts, columns.end))}
    width = len(columns.starts)
    lanes: dict[RcName, list[list[ArcId | None]]] = {rc.name: [[None] * width] for rc in workload.rcs}
    for hold in holds:
        first, last = index.get(hold.start, width), index.get(hold.end, width)
        if first >= last:
            continue
        for rc in hold.rcs:
            row = next((row for row in lanes[rc] if not any(row[first:last])), None)
            if row is None:
                row = [None] * width
                lanes[rc].append(row)
            row[first:last] = [hold.arc] * (last - first)
    for rc, rows in lanes.items():
        for row in rows:
            yield rc, row


def short_names(names: Sequence[ArcId]) -> tuple[dict[ArcId, str], bool]:
    """How a cell names each ARC, and whether by its number: arc0, arc1 are 0 and 1, as in the paper."""
    found = [re.fullmatch(r"(.*\D)(\d+)", name) for name in names]
    if len({match[1] if match else None for match in found}) == 1 and found[0] is not None:
        return {match[0]: match[2] for match in found if match}, True
    return {name: name if len(name) <= MAX_CELL else name[: MAX_CELL - 1] + "…" for name in names}, False


def _report(strategy: str, workload: Workload, played: Replay, told: _Told) -> Iterator[str]:
    arcs = [arrival.request.arc for arrival in workload.arrivals]
    end = max((hold.end for hold in played.holds), default=0)
    yield (
        f"Strategy {strategy}: {len(arcs)} ARCs on {len(workload.rcs)} RCs; {len(played.holds)} holds, "
        f"{len(told.preemptions)} preempted, over {_s(end)} s; {len(played.unserved)} ARCs unserved"
    )
    if played.holds:
        yield ""
        yield from _table(workload, played, arcs, {preempted.by for preempted in told.preemptions})
    if told.preemptions:
        yield from ("", click.style("Preempted", bold=True))
        yield from _listed(_preempted(one, workload, played) for one in told.preemptions)
    if played.unserved:
        yield from ("", click.style("Unserved (never held all it needs for its minimum runtime)", bold=True))
        yield from _listed(f"{arc}: {told.reasons.get(arc, '')}" for arc in played.unserved)


def _table(
    workload: Workload, played: Replay, arcs: Sequence[ArcId], winners: set[ArcId | None]
) -> Iterator[str]:
    columns = columns_of(played.holds)
    short, prefixed = short_names(arcs)
    colours = {arc: COLOURS[number % len(COLOURS)] for number, arc in enumerate(arcs)}
    step = SECOND if columns.by_second else 1
    heads = [str(start // step) if columns.by_second else _s(start) for start in columns.starts]
    rows = list(rows_of(workload, played.holds, columns))
    width = max(map(len, [*heads, *(short[arc] for _, row in rows for arc in set(row) if arc)]))
    label = max(len("seconds"), *(len(rc) for rc, _ in rows))
    per_block = _columns_that_fit(label, width, len(heads))

    def cell(arc: ArcId | None) -> str:
        if arc is None:
            return click.style("-".rjust(width), dim=True)
        text = short[arc].rjust(width)
        return (
            click.style(text, fg=OPERATOR, bold=True)
            if arc in winners
            else click.style(text, fg=colours[arc])
        )

    for begin in range(0, len(heads), per_block):
        part = slice(begin, begin + per_block)
        if begin:
            yield ""
        yield f"{'seconds':<{label}}  " + " ".join(
            click.style(head.rjust(width), dim=True) for head in heads[part]
        )
        for rc, row in rows:
            yield f"{rc:<{label}}  " + " ".join(cell(arc) for arc in row[part])
    notes = (
        []
        if columns.by_second
        else [f"a column reaches to the next one's time, the last to {_s(columns.end)} s"]
    )
    notes += [f"{short[arcs[0]]} is {arcs[0]}, and so on"] if prefixed else []
    notes += [f"{columns.cut} more columns are left out: --json has all"] if columns.cut else []
    if notes:
        yield click.style(f"({'; '.join(notes)})", dim=True)


def _columns_that_fit(label: int, width: int, count: int) -> int:
    # Whoever reads a pipe wants whole rows.
    if not sys.stdout.isatty():
        return count
    return max(1, (shutil.get_terminal_size().columns - label - 1) // (width + 1))


def _preempted(one: _Preemption, workload: Workload, played: Replay) -> str:
    request = next(arrival.request for arrival in workload.arrivals if arrival.request.arc == one.arc)
    text = f"{one.arc} at {_s(one.at)} s by {one.by}, after {_s(one.ran)} of {_s(request.min_runtime)} s"
    again = next((hold.start for hold in played.holds if hold.arc == one.arc and hold.start >= one.at), None)
    return f"{text}; ran again from {_s(again)} s" if again is not None else f"{text}; never ran again"


def _listed(lines: Iterator[str]) -> Iterator[str]:
    for number, line in enumerate(lines):
        if number == MAX_LISTED:
            yield "  ... and more: --json has all"
            return
        yield f"  {line}"


def _s(time: Ns) -> str:
    """Exact seconds without needless zeros."""
    return f"{Decimal(time).scaleb(-9):f}".rstrip("0").rstrip(".") if time else "0"


# The recording


def _recording(stack: ExitStack, rrd: Path, source: Path) -> Timeline:
    if rrd.suffix != ".rrd":
        raise BadInput(f"--rrd {rrd}: the viewer knows a recording by its name; end it in .rrd")
    # Rerun is large: only who wants a recording loads it.
    from zscout.services.timeline import Timeline

    return stack.enter_context(Timeline(source.stem, path=rrd))


def _draw(timeline: Timeline, at: float, effect: Effect, evicted: set[ArcId]) -> None:
    """What an ARC does, and the event in words. The evicted are shown so until they run again."""
    match effect:
        case Granted(arc=arc, rcs=rcs):
            timeline.arc(at, arc, "running")
            timeline.event(at, f"{arc} runs on {', '.join(sorted(rcs))}")
        case Revoked(arc=arc, outcome=Outcome.PREEMPTED, reason=reason):
            timeline.arc(at, arc, "preempted", reason)
            timeline.event(at, f"{arc}: {reason}; queued again", "WARN")
        case Revoked(arc=arc, outcome=outcome):
            timeline.arc(at, arc, "done", outcome.value)
            timeline.event(at, f"{arc} {outcome.value}")
        case Queued(arc=arc, reason=reason, settled=True):
            timeline.event(at, f"{arc} waits: {reason}")
            if arc not in evicted:
                timeline.arc(at, arc, "waiting", reason)
        case _:
            pass


def _draw_holders(timeline: Timeline, workload: Workload, played: Replay) -> None:
    from zscout.config import default_fleet
    from zscout.services.timeline import Holder

    operators = default_fleet().operator_priority
    priority = {arrival.request.arc: arrival.request.priority for arrival in workload.arrivals}
    holding: dict[RcName, list[ArcId]] = {rc.name: [] for rc in workload.rcs}
    changes: dict[Ns, list[tuple[bool, HoldRecord]]] = {0: []}
    for hold in played.holds:
        changes.setdefault(hold.start, []).append((True, hold))
        changes.setdefault(hold.end, []).append((False, hold))
    for at, happened in sorted(changes.items()):
        touched = set(holding) if at == 0 else {rc for _, hold in happened for rc in hold.rcs}
        for begins, hold in sorted(happened, key=lambda change: change[0]):
            for rc in hold.rcs:
                (holding[rc].append if begins else holding[rc].remove)(hold.arc)
        for rc in sorted(touched):
            holders = [Holder(arc, priority[arc] >= operators) for arc in holding[rc]]
            timeline.holders(at / SECOND, rc, holders)

"""`zscout replay`: the outcome of a workload as JSON, as a table, and as a recording."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import click

from zscout.config.scheduling_policy import StrategyName
from zscout.config.strict import read_text
from zscout.scheduling.model import Effect, Granted, HoldEnded, Outcome, Queued
from zscout.scheduling.strategies import STRATEGIES
from zscout.simulation.plots.gantt import columns_of, rows_of, short_names
from zscout.simulation.replay import HoldRecord, Replay, replay
from zscout.simulation.workload import MAX_BYTES, Workload, parse_workload
from zscout.types import SECOND, ArcId, Ns

if TYPE_CHECKING:
    from zscout.simulation.plots.replay import ReplayRecording

MAX_LISTED: Final = 200  # preemptions, and unserved ARCs, without --json
COLOURS: Final = ("blue", "yellow", "green", "magenta", "cyan", "bright_blue", "bright_green")
OPERATOR: Final = "red"  # for ARCs that preempted others


@dataclass(slots=True)
class _Preemption:
    arc: ArcId
    at: Ns
    by: ArcId | None
    ran: Ns


@dataclass(slots=True)
class _Observer:
    """The preemptions of a replay, and why ARCs wait."""

    preemptions: list[_Preemption] = field(default_factory=list)
    reasons: dict[ArcId, str] = field(default_factory=dict)
    started: dict[ArcId, Ns] = field(default_factory=dict)

    def watch(self, now: Ns, effects: list[Effect]) -> None:
        for effect in effects:
            match effect:
                case Granted(arc=arc):
                    self.started[arc] = now
                case HoldEnded(arc=arc, outcome=Outcome.PREEMPTED, by=by):
                    self.preemptions.append(_Preemption(arc, now, by, now - self.started[arc]))
                case Queued(arc=arc, reason=reason):
                    self.reasons[arc] = str(reason)


def replay_file(file: Path, strategy: StrategyName, rrd: Path | None, *, as_json: bool) -> None:
    """Replay a workload and print the outcome. Raises BadInput."""
    workload = parse_workload(read_text(file, max_bytes=MAX_BYTES), str(file))
    observed = _Observer()
    with ExitStack() as stack:
        recording = _recording(stack, rrd, file) if rrd is not None else None

        def watch(now: Ns, _core: object, effects: list[Effect]) -> None:
            observed.watch(now, effects)
            if recording is not None:
                recording.watch(now, effects)

        played = replay(workload, watch, strategy=STRATEGIES[strategy]())
        if recording is not None:
            recording.holders(workload, played)
    if as_json:
        click.echo(json.dumps(_as_object(strategy, played)))
        return
    for line in _report(strategy, workload, played, observed):
        click.echo(line)
    if rrd is not None:
        click.echo(f"\nRecording: {rrd} (zscout view {rrd})")


def _recording(stack: ExitStack, rrd: Path, source: Path) -> ReplayRecording:
    # Rerun is large: import it only for a recording.
    from zscout.services.recorder.timeline import Timeline
    from zscout.simulation.plots.replay import ReplayRecording

    return ReplayRecording(stack.enter_context(Timeline(source.stem, path=rrd)))


def _as_object(strategy: str, played: Replay) -> dict[str, Any]:
    """The output of `--json`; times in seconds."""

    def shown(hold: HoldRecord) -> dict[str, Any]:
        times = {"start": hold.start / SECOND, "end": hold.end / SECOND}
        return {"arc": hold.arc, **times, "outcome": hold.outcome.value, "rcs": sorted(hold.rcs)}

    return {"strategy": strategy, "holds": [*map(shown, played.holds)], "unserved": list(played.unserved)}


def _report(strategy: str, workload: Workload, played: Replay, observed: _Observer) -> Iterator[str]:
    arcs = [arrival.request.arc for arrival in workload.arrivals]
    end = max((hold.end for hold in played.holds), default=0)
    yield (
        f"Strategy {strategy}: {len(arcs)} requests on {len(workload.rcs)} devices; {len(played.holds)} holds, "
        f"{len(observed.preemptions)} preempted, over {_s(end)} s; {len(played.unserved)} requests unserved"
    )
    if played.holds:
        yield ""
        yield from _table(workload, played, arcs, {preempted.by for preempted in observed.preemptions})
    if observed.preemptions:
        yield from ("", click.style("Preempted", bold=True))
        yield from _listed(_preempted(preemption, workload, played) for preemption in observed.preemptions)
    if played.unserved:
        yield from ("", click.style("Unserved (never held all it needs for its minimum runtime)", bold=True))
        yield from _listed(f"{arc}: {observed.reasons.get(arc, '')}" for arc in played.unserved)


def _table(workload: Workload, played: Replay, arcs: Sequence[ArcId], winners: set[ArcId | None]) -> Iterator[str]:
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
        return click.style(text, fg=OPERATOR, bold=True) if arc in winners else click.style(text, fg=colours[arc])

    for begin in range(0, len(heads), per_block):
        part = slice(begin, begin + per_block)
        if begin:
            yield ""
        yield f"{'seconds':<{label}}  " + " ".join(click.style(head.rjust(width), dim=True) for head in heads[part])
        for rc, row in rows:
            yield f"{rc:<{label}}  " + " ".join(cell(arc) for arc in row[part])
    notes = [] if columns.by_second else [f"a column reaches to the next one's time, the last to {_s(columns.end)} s"]
    notes += [f"{short[arcs[0]]} is {arcs[0]}, and so on"] if prefixed else []
    notes += [f"{columns.cut} more columns are left out: --json has all"] if columns.cut else []
    if notes:
        yield click.style(f"({'; '.join(notes)})", dim=True)


def _columns_that_fit(label: int, width: int, count: int) -> int:
    # Readers of a pipe want whole rows.
    if not sys.stdout.isatty():
        return count
    return max(1, (shutil.get_terminal_size().columns - label - 1) // (width + 1))


def _preempted(lost: _Preemption, workload: Workload, played: Replay) -> str:
    request = next(arrival.request for arrival in workload.arrivals if arrival.request.arc == lost.arc)
    text = f"{lost.arc} at {_s(lost.at)} s by {lost.by}, after {_s(lost.ran)} of {_s(request.min_runtime)} s"
    again = next((hold.start for hold in played.holds if hold.arc == lost.arc and hold.start >= lost.at), None)
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

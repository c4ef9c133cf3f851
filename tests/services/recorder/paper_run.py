"""The paper's example shown on a timeline, and what a recording says when it is read back."""

from __future__ import annotations

import getpass
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from rerun.chunk import RrdReader

from zscout.scheduling.model import ArcRequest, Effect, Granted, HoldEnded, Outcome, Queued
from zscout.services.recorder.blueprint import TIME, WALL_TIME
from zscout.services.recorder.drawing import HolderRow
from zscout.services.recorder.timeline import OPERATOR_MARK, Timeline
from zscout.simulation.replay import Replay, replay
from zscout.simulation.workload import Arrival, Workload, WorkloadRc
from zscout.types import SECOND, Ns

_spec = find_spec("rerun_cli")
assert _spec is not None
assert _spec.origin is not None
RERUN = Path(_spec.origin).with_name("rerun")
"""The viewer's own binary: the `rerun` script only wraps it, and killing the script would orphan it."""

SCOUT33, SCOUT35 = "robot/scout33", "robot/scout35"
FGRAB1, FGRAB2 = "framegrabber/fgrab1", "framegrabber/fgrab2"
RCS = (SCOUT33, SCOUT35, FGRAB1, FGRAB2)

# Table 1 of the paper: name, arrival (s), priority, minimum runtime (s), needs.
TABLE1 = (
    ("arc0", 0, 1, 5, (SCOUT33, FGRAB1)),
    ("arc1", 0, 1, 5, (SCOUT35, FGRAB1)),
    ("arc2", 1, 1, 4, (SCOUT33, FGRAB2)),
    ("arc3", 2, 1, 3, (SCOUT33, FGRAB2)),
    ("arc4", 11, 10, 3, (SCOUT33, SCOUT35, FGRAB1)),
)
# Table 2 of the paper: who holds each resource in each of the seconds 0 to 17.
TABLE2 = {
    SCOUT33: "0 0 0 0 0 3 3 3 2 2 2 4 4 4 2 2 2 2",
    SCOUT35: "- - - - - 1 1 1 1 1 - 4 4 4 - - - -",
    FGRAB1: "0 0 0 0 0 1 1 1 1 1 - 4 4 4 - - - -",
    FGRAB2: "- - - - - 3 3 3 2 2 2 - - - 2 2 2 2",
}
OPERATOR_PRIORITY = 10
USER = getpass.getuser()
PERSON = f" ({USER})"
"""Follows the names of requests that programs of this user make."""


def table1() -> Workload:
    return Workload(
        tuple(WorkloadRc(name) for name in RCS),
        tuple(
            Arrival(at * SECOND, ArcRequest(name, name, {rc: {} for rc in needs}, priority, runtime * SECOND))
            for name, at, priority, runtime, needs in TABLE1
        ),
    )


def play_table1(timeline: Timeline) -> Replay:
    """Runs the paper's example through the scheduler and shows it as the recorder would."""
    requests = {arrival.request.arc: arrival.request for arrival in table1().arrivals}
    preempted: set[str] = set()

    def show(now: Ns, _core: object, effects: list[Effect]) -> None:
        at = now / SECOND
        for effect in effects:
            match effect:
                case Granted(arc=arc, rcs=rcs):
                    request = requests[arc]
                    preempted.discard(arc)
                    detail = f"priority {request.priority} · min {request.min_runtime / SECOND:g} s"
                    timeline.arc(at, arc, "running", detail)
                    timeline.event(at, f"{arc} runs on {', '.join(rcs)}")
                case HoldEnded(arc=arc, outcome=Outcome.PREEMPTED, reason=reason):
                    preempted.add(arc)
                    timeline.arc(at, arc, "preempted", "queued again")
                    timeline.event(at, f"{arc} preempted: {reason}", "WARN")
                case HoldEnded(arc=arc, outcome=outcome):
                    timeline.arc(at, arc, "done")
                    timeline.event(at, f"{arc} {outcome.value}")
                case Queued(arc=arc, reason=reason) if arc not in preempted:
                    timeline.arc(at, arc, "waiting", str(reason))
                    timeline.event(at, f"{arc} waits: {reason}")
                case _:
                    pass

    played = replay(table1(), show)
    for instant in sorted({end for hold in played.holds for end in (hold.start, hold.end)}):
        for rc in RCS:
            holders = [
                HolderRow(hold.arc, requests[hold.arc].priority >= OPERATOR_PRIORITY)
                for hold in played.holds
                if rc in hold.rcs and hold.start <= instant < hold.end
            ]
            timeline.holders(instant / SECOND, rc, holders)
    return played


def rows(path: Path, content: str, column: str, *, static: bool = False) -> Iterator[tuple[str, float, Any]]:
    """(entity, seconds since the recording's zero, value) of every logged row, as stored."""
    begin = 0
    for chunk in RrdReader(path).stream().filter(content=content, is_static=static):
        batch = chunk.to_record_batch()
        if column not in batch.schema.names:
            continue
        values = batch.column(column).to_pylist()
        times = [0] * len(values)
        if WALL_TIME in batch.schema.names:
            begin = begin or _begin(path)
            times = [at - begin for at in batch.column(WALL_TIME).cast("int64").to_pylist()]
        elif not static:
            times = batch.column(TIME).cast("int64").to_pylist()
        for nanoseconds, value in zip(times, values, strict=True):
            if value is not None:  # rows of one entity may tell of several things
                yield str(chunk.entity_path), nanoseconds / 1e9, value


def _begin(path: Path) -> int:
    """When the recording began, in nanoseconds of the epoch: what was told last."""
    begin = 0
    for chunk in RrdReader(path).stream().filter(content="/__properties/**", is_static=True):
        batch = chunk.to_record_batch()
        if "RecordingInfo:start_time" in batch.schema.names:
            begin = [value[0] for value in batch.column("RecordingInfo:start_time").to_pylist() if value][-1]
    return begin


def lanes(path: Path, content: str) -> dict[str, list[tuple[float, list[str]]]]:
    """Changes of each lane, in order of time."""
    found: dict[str, list[tuple[float, list[str]]]] = {}
    for entity, at, states in rows(path, content, "StateChange:state"):
        found.setdefault(entity, []).append((at, states))
    return {entity: sorted(changes, key=lambda change: change[0]) for entity, changes in found.items()}


def colours(path: Path, content: str) -> dict[str, dict[str, int]]:
    """The last configuration of each lane: colour by text."""
    found: dict[str, dict[str, int]] = {}
    names = rows(path, content, "StateConfiguration:values", static=True)
    values = rows(path, content, "StateConfiguration:colors", static=True)
    for (entity, _, texts), (_, _, shades) in zip(names, values, strict=True):
        found[entity] = dict(zip(texts, shades, strict=True))
    return found


def events(path: Path) -> list[str]:
    return [text for _, _, texts in rows(path, "/events", "TextLog:text") for text in texts]


def second_by_second(changes: list[tuple[float, list[str]]]) -> str:
    """A lane in the form of Table 2."""
    shown = []
    for second in range(18):
        state = [states for at, states in changes if at <= second][-1][0]
        shown.append(state.removesuffix(OPERATOR_MARK).removesuffix(PERSON).removeprefix("arc") or "-")
    return " ".join(shown)

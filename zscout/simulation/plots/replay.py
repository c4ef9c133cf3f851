"""A replay as a Rerun recording, drawn as the recorder draws a live fleet."""

from __future__ import annotations

from typing import Final

from zscout.config.fleet import default_fleet
from zscout.config.strict import BadInput
from zscout.scheduling.model import Effect, Granted, HoldEnded, Outcome, Queued
from zscout.scheduling.reason import waits
from zscout.services.recorder.drawing import HolderRow
from zscout.services.recorder.timeline import Timeline
from zscout.simulation.replay import HoldRecord, Replay
from zscout.simulation.workload import Workload
from zscout.types import SECOND, ArcId, Ns, RcName

MAX_DRAWN: Final = 1_000_000_000 * SECOND  # end of a recording's time


class ReplayRecording:
    """Writes to `timeline`, in virtual time."""

    def __init__(self, timeline: Timeline) -> None:
        self.timeline = timeline
        self._evicted: set[ArcId] = set()  # shown as preempted until they run again

    def watch(self, now: Ns, effects: list[Effect]) -> None:
        """Record the effects of `now`. Raises BadInput past MAX_DRAWN."""
        if effects and now > MAX_DRAWN:
            raise BadInput(f"this workload is longer than {MAX_DRAWN // SECOND} s; leave out --rrd")
        for effect in effects:
            self._draw(now / SECOND, effect)

    def _draw(self, at: float, effect: Effect) -> None:
        timeline = self.timeline
        match effect:
            case Granted(arc=arc, rcs=rcs):
                self._evicted.discard(arc)
                timeline.arc(at, arc, "running")
                timeline.event(at, f"{arc} runs on {', '.join(sorted(rcs))}")
            case HoldEnded(arc=arc, outcome=Outcome.PREEMPTED, reason=reason):
                self._evicted.add(arc)
                timeline.arc(at, arc, "preempted", str(reason))
                timeline.event(at, f"{arc}: {reason}; queued again", "WARN")
            case HoldEnded(arc=arc, outcome=outcome):
                timeline.arc(at, arc, "done", outcome.value)
                timeline.event(at, f"{arc} {outcome.value}")
            case Queued(arc=arc, reason=reason, settled=True):
                timeline.event(at, f"{arc} {waits(str(reason), reason)}")
                if arc not in self._evicted:
                    timeline.arc(at, arc, "waiting", str(reason))
            case _:
                pass

    def holders(self, workload: Workload, played: Replay) -> None:
        """Record the holders of each RC over time."""
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
                holders = [HolderRow(arc, priority[arc] >= operators) for arc in holding[rc]]
                self.timeline.holders(at / SECOND, rc, holders)

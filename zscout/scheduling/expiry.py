"""When holds are over."""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Mapping

from zscout.scheduling.model import Arc, Hold
from zscout.types import ArcId, Ns


class ExpiryQueue:
    """The ends of minimum runtimes, soonest first. Those of holds that ended otherwise are skipped."""

    def __init__(self, running: Mapping[ArcId, Arc]) -> None:
        self._running = running
        self._heap: list[tuple[Ns, ArcId, int]] = []

    def note(self, arc: Arc, hold: Hold) -> None:
        """`arc` holds, or holds under another name or grant than before."""
        heapq.heappush(self._heap, (hold.end, arc.id, hold.grant.seq))

    def over(self, now: Ns) -> Iterator[Arc]:
        """Those whose minimum runtime is over by `now`, each once; what is done to one may end others."""
        while self._heap and self._heap[0][0] <= now:
            _, arc_id, _ = heapq.heappop(self._heap)
            arc = self._running.get(arc_id)
            if arc is not None and arc.hold is not None and arc.hold.end <= now:
                yield arc

    def next(self) -> Ns | None:
        """When the next one is."""
        while self._heap:
            at, arc_id, _ = self._heap[0]
            arc = self._running.get(arc_id)
            if arc is not None and arc.hold is not None and arc.hold.end == at:
                return at
            heapq.heappop(self._heap)
        return None

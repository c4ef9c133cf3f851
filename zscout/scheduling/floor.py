"""Who holds what, who waits: the state that a scheduling pass reads and changes.

Sets of RCs are integer bit masks; `needs & ~free == 0` is the whole test for an ARC of exclusive RCs.
"""

from __future__ import annotations

from collections.abc import Iterator

from zscout.scheduling.model import Arc, ArcId, Hold, Ns, Rc, RcName


class Floor:
    """The RCs, the ARCs and the holds between them. Every change goes through its methods."""

    def __init__(self) -> None:
        self.rcs: dict[RcName, Rc] = {}
        self.queued: dict[ArcId, Arc] = {}
        self.running: dict[ArcId, Arc] = {}
        self.present = 0
        """Bits of the RCs that are there."""
        self.sharable = 0
        """Bits of the RCs that vote and take several holders."""
        self.busy = 0
        """Bits of the exclusive RCs that somebody holds."""
        self._by_bit: list[Rc] = []

    def rc(self, name: RcName) -> Rc:
        """The RC of this name, made known (absent, exclusive) if it was not."""
        rc = self.rcs.get(name)
        if rc is None:
            rc = self.rcs[name] = Rc(name, 1 << len(self._by_bit))
            self._by_bit.append(rc)
        return rc

    def mask(self, names: Iterator[RcName]) -> int:
        mask = 0
        for name in names:
            mask |= self.rc(name).bit
        return mask

    def of(self, mask: int) -> Iterator[Rc]:
        """The RCs of a mask, in the order in which they became known."""
        while mask:
            low = mask & -mask
            yield self._by_bit[low.bit_length() - 1]
            mask ^= low

    def arc(self, arc: ArcId) -> Arc | None:
        return self.running.get(arc) or self.queued.get(arc)

    def join(self, name: RcName, *, sharable: bool) -> None:
        rc = self.rc(name)
        rc.present, rc.sharable = True, sharable
        self.present |= rc.bit
        self.sharable = self.sharable | rc.bit if sharable else self.sharable & ~rc.bit

    def leave(self, name: RcName) -> None:
        rc = self.rc(name)
        rc.present = False
        self.present &= ~rc.bit

    def enqueue(self, arc: Arc, now: Ns) -> None:
        arc.since = now
        self.queued[arc.id] = arc

    def start(self, arc: Arc, hold: Hold, now: Ns) -> None:
        del self.queued[arc.id]
        arc.hold, arc.reason, arc.since = hold, "", now
        self.running[arc.id] = arc
        for rc in self.of(arc.mask):
            rc.holders[arc.id] = arc
        self.busy |= arc.mask & ~self.sharable

    def stop(self, arc: Arc) -> Hold:
        """Takes everything from a running ARC; what it was holding is returned."""
        hold = arc.hold
        assert hold is not None, arc.id  # noqa: S101
        del self.running[arc.id]
        arc.hold = None
        for rc in self.of(arc.mask):
            del rc.holders[arc.id]
        self.busy &= ~arc.mask
        return hold

    def validate(self) -> None:
        """Checks every invariant; for tests and simulators. Raises AssertionError that names the breach."""
        check(not self.queued.keys() & self.running.keys(), "an ARC both waits and runs")
        for arc in self.queued.values():
            check(arc.hold is None, f"{arc.id} waits and holds")
        for arc in self.running.values():
            check(arc.hold is not None, f"{arc.id} runs without a hold")
            check(arc.mask & ~self.present == 0, f"{arc.id} holds an absent RC")
            for rc in self.of(arc.mask):
                check(rc.holders.get(arc.id) is arc, f"{arc.id} holds only a part: not {rc.name}")
        busy = 0
        for rc in self.rcs.values():
            for holder in rc.holders:
                check(holder in self.running, f"{rc.name} is held by {holder}, which does not run")
                check(rc.name in self.running[holder].request.needs, f"{holder} did not ask for {rc.name}")
            if not rc.sharable:
                check(len(rc.holders) <= 1, f"{rc.name} has two holders: {sorted(rc.holders)}")
                busy |= rc.bit if rc.holders else 0
        check(busy == self.busy, "the mask of busy RCs is wrong")


def check(truth: bool, breach: str) -> None:
    if not truth:
        raise AssertionError(breach)

"""Needs by pattern: `framegrabber/*` is met by any one RC whose name it matches.

While an ARC waits, each visit *binds* it: gives each of its patterns an RC of its own, the best choice of the
instant. So a bound ARC is like any other, and every strategy knows patterns. Where a bound RC keeps the ARC
out, the visit goes on with the next best. A hold keeps its binding to its end.

How good a choice is (`Fitness`): an RC that is free, before one that somebody yields, before one that is
kept for another or does not answer, before one that is held. The worst of an ARC's choices counts: of two
bindings, the one that gets by without the worse kind is taken, by augmenting paths (Kuhn's algorithm), so
that an ARC never waits where some choice of free RCs would let it run. Between equals, the RC that fewest
wait for by name: they have no other choice.

`optimal` is exact for the binding of the instant; it does not search all bindings of all ARCs.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum

from zscout.keyexpr import check_need, is_pattern
from zscout.scheduling.floor import Floor
from zscout.scheduling.model import Arc, Need, Ns, Params, Rc
from zscout.scheduling.reservations import Reservations
from zscout.scheduling.visit import listed
from zscout.scheduling.votes import Votes


class Fitness(IntEnum):
    """How well an RC would do, the best first."""

    FREE = 0
    SPOKEN_FOR = 1
    """Bound already to one that ranks before in this pass."""
    YIELDED = 2
    """Held by one that yields."""
    KEPT = 3
    """Kept for another, or what it says is not known and it is silent."""
    HELD = 4
    """Held by one that does not yield, or it has refused."""


class Binder:
    """Finds bindings at one instant. `claimed`: bits of the RCs that others are bound to already."""

    def __init__(
        self, floor: Floor, votes: Votes, now: Ns, reserved: Reservations | None = None, claimed: int = 0
    ) -> None:
        self._floor, self._votes, self._now, self._reserved = floor, votes, now, reserved
        self._claimed = claimed

    def bind(self, arc: Arc, without: int = 0) -> bool:
        """Binds `arc` to the best RCs there are but those of `without`, a bit mask. False: there is no such
        binding; the old one stands."""
        chosen = self._choose(arc, without)
        if chosen is None:
            return False
        self._floor.bind(arc, {need: rc.name for need, rc in chosen.items()})
        return True

    def _choose(self, arc: Arc, without: int) -> dict[str, Rc] | None:
        taken = without | arc.named
        options: dict[str, list[tuple[tuple[int, float], Rc]]] = {}
        for need in arc.slots:
            matching = (rc for rc in self._floor.matching(need) if rc.present and not rc.bit & taken)
            options[need] = sorted(((self._fitness(arc, rc), rc) for rc in matching), key=_by_fitness)
            if not options[need]:
                return None
        for worst in Fitness:
            allowed = {
                need: [rc for (fitness, _), rc in found if fitness <= worst]
                for need, found in options.items()
            }
            if all(allowed.values()) and (chosen := _distinct(allowed)) is not None:
                return chosen
        return None

    def _fitness(self, arc: Arc, rc: Rc) -> tuple[int, float]:
        """How well `rc` would do, and what decides between equals."""
        wanted = float(rc.wanted)
        firm = [holder for holder in rc.holders.values() if not holder.yields_to(arc, self._now)]
        if rc.sharable:
            answer = self._votes.known(rc.name, frozenset((*(holder.id for holder in firm), arc.id)))
            if answer is None and self._votes.silent(rc.name):
                return Fitness.KEPT, wanted
            if answer is not None and not answer.accept:
                return Fitness.HELD, wanted
            return Fitness.FREE, len(rc.holders) + (answer is None)
        if firm:
            return Fitness.HELD, max(0 if one.hold is None else one.hold.end for one in firm)
        if self._reserved is not None and self._reserved.keeps(rc, arc):
            return Fitness.KEPT, wanted
        if rc.holders:
            return Fitness.YIELDED, max(one.priority for one in rc.holders.values())
        return (Fitness.SPOKEN_FOR if rc.bit & self._claimed else Fitness.FREE), wanted


def bind_all(floor: Floor, votes: Votes, now: Ns, reserved: Reservations | None = None) -> None:
    """Binds all who wait by pattern, the best-ranked first, to different RCs as far as there are any."""
    claimed = 0
    for arc in sorted(floor.flexible.values(), key=lambda arc: arc.rank):
        if Binder(floor, votes, now, reserved, claimed).bind(arc):
            claimed |= arc.mask & ~arc.named
        else:
            floor.unbind(arc)


def nothing_left(floor: Floor, arc: Arc) -> str:
    """Which patterns keep an ARC from being bound at all, in words."""
    there = {need: sum(rc.present for rc in floor.matching(need)) for need in arc.slots}
    # Those without any; else there are some for each, but not enough for all.
    short = sorted(need for need, count in there.items() if not count) or sorted(there)
    return f"no RC on the mesh is left for {listed(short)}"


def check_patterns(needs: Mapping[Need, Params]) -> None:
    """Raises ValueError (BadName) for a pattern that is none, and where the choice of RCs would decide what
    is asked of one: its votes must not depend on that."""
    asked: dict[str, Params] = {}
    for need, params in needs.items():
        if not is_pattern(need):
            continue
        kind = check_need(need).partition("/")[0]
        if asked.setdefault(kind, params) != params:
            raise ValueError(f"patterns of the kind {kind} have different parameters; give all the same")
    if any(is_pattern(kind) for kind in asked) and any(asked.values()):
        raise ValueError("a pattern that any kind of RC meets can't stand beside parameters; name its kind")


def _by_fitness(option: tuple[tuple[int, float], Rc]) -> tuple[tuple[int, float], int]:
    return option[0], option[1].bit


def _distinct(allowed: dict[str, list[Rc]]) -> dict[str, Rc] | None:
    """An RC of its own for each need, each the best that leaves one for the others; None: there is none."""
    owner: dict[int, str] = {}
    chosen: dict[str, Rc] = {}

    def place(need: str, seen: set[int]) -> bool:
        for rc in allowed[need]:
            if rc.bit in seen:
                continue
            seen.add(rc.bit)
            if rc.bit not in owner or place(owner[rc.bit], seen):
                owner[rc.bit], chosen[need] = need, rc
                return True
        return False

    for need in sorted(allowed, key=lambda need: (len(allowed[need]), need)):
        if not place(need, set()):
            return None
    return chosen

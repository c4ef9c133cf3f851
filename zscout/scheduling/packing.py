"""Which ARCs may hold their RCs together, and which such set is the best: branch and bound over bit masks.

The value of a set is the vector of (ARC, RC) pairs in use by priority level, highest level first, compared
lexicographically; among equals the set with fewest preemptions, then the one that holds the best-ranked item
in which they differ. Items come in the order of decision (see `order`): with "take it" tried first, the first
best set that is met is the best-ranked one, so only strictly better sets need be looked for.

The bound: an RC is used once, so free RCs, each counted at the highest level that still covers it, can't be
beaten; pairs at sharable RCs are added as they are.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

NO_LIMIT = 1 << 60


@dataclass(frozen=True, slots=True)
class Item:
    """A contender: exclusive RCs as a bit mask, RCs in all, its level (0 is the highest), whether it runs.

    `spent` marks one that runs on after its minimum runtime: it is worth nothing, yields to its own level as
    well, and to no lower one."""

    mask: int
    width: int
    level: int
    standing: bool = False
    spent: bool = False


@dataclass(frozen=True, slots=True)
class Packing:
    """The best set found, as a bit set of item numbers; `exact` if it is proven that none is better."""

    chosen: int
    value: int
    bound: int
    """No set is worth more than this."""
    exact: bool
    nodes: int
    first: int
    """The value of the first complete set: the heuristic's, which takes whatever fits, best rank first."""


def order(item: Item) -> tuple[int, int]:
    """Sorts items for decision; those of one key stay as they are ranked."""
    return (item.level, 2 if item.spent else 0 if item.standing else 1)


def pack(items: Sequence[Item], barred: Iterable[int] = (), *, nodes: int = NO_LIMIT) -> Packing:
    """The best set of `items`, which are in the order of decision.

    `barred` are bit sets of items that must not all be chosen (vetoes). At most `nodes` steps are taken, one
    complete set at least."""
    return _Search(items, list(barred), nodes).run()


class _Search:
    def __init__(self, items: Sequence[Item], barred: list[int], nodes: int) -> None:
        self.items = items
        self.limit = nodes
        levels = max((item.level for item in items), default=0) + 1
        base = sum(item.width for item in items) + 1
        self.unit = [base ** (levels - 1 - item.level) for item in items]
        """What one RC in use is worth at an item's level: more than all lower levels together."""
        self.masks = [item.mask for item in items]
        self.worth = [
            0 if item.spent else item.width * unit for item, unit in zip(items, self.unit, strict=True)
        ]
        self.extra = [
            0 if item.spent else (item.width - item.mask.bit_count()) * unit
            for item, unit in zip(items, self.unit, strict=True)
        ]
        self.shares = any(self.extra)
        self.barred: list[list[int]] = [[] for _ in items]
        for bar in barred:
            for number in _numbers(bar):
                self.barred[number].append(bar)
        self.best = -1
        self.best_lost = 0
        self.chosen = 0
        self.first = -1
        self.nodes = 0
        self.cut = False
        """Whether the limit left something unseen."""

    def run(self) -> Packing:
        whole = [number for number in range(len(self.items)) if self._allowed(number, 0)]
        bound = self._bound(whole)
        self._go(whole, 0, 0, 0)
        return Packing(
            chosen=self.chosen,
            value=self.best,
            bound=bound if self.cut else self.best,
            exact=not self.cut,
            nodes=self.nodes,
            first=self.first,
        )

    def _go(self, open_: list[int], chosen: int, value: int, lost: int) -> None:
        """Decides the first open item, both ways where both are allowed. `open_` fit beside `chosen`."""
        items, masks = self.items, self.masks
        while open_:
            self.nodes += 1
            if self.best >= 0:
                if self.nodes > self.limit:
                    self.cut = True
                    return
                bound = value + self._bound(open_)
                if bound < self.best or (bound == self.best and lost >= self.best_lost):
                    return
            head, *tail = open_
            mask, bit = masks[head], 1 << head
            taken = chosen | bit
            rest = [number for number in tail if not masks[number] & mask]
            if any(self.barred):
                rest = [number for number in rest if self._allowed(number, taken)]
            dropped = lost
            if len(rest) < len(tail):
                gone = set(tail).difference(rest)
                dropped += sum(items[number].standing and not items[number].spent for number in gone)
            if len(rest) == len(tail) or self._must(head):
                chosen, value, lost, open_ = taken, value + self.worth[head], dropped, rest
                continue
            self._go(rest, taken, value + self.worth[head], dropped)
            item = items[head]
            lost += item.standing and not item.spent
            open_ = tail
        self._complete(chosen, value, lost)

    def _must(self, number: int) -> bool:
        """Who runs and fits beside all that is chosen above stays; only vetoes among equals may differ."""
        return self.items[number].standing and not self.barred[number]

    def _complete(self, chosen: int, value: int, lost: int) -> None:
        if not self._lawful(chosen):
            return
        if self.first < 0:
            self.first = value
        if value > self.best or (value == self.best and lost < self.best_lost):
            self.best, self.best_lost, self.chosen = value, lost, chosen

    def _lawful(self, chosen: int) -> bool:
        """Whether nobody is left out who runs and fits beside the chosen above and the equals that run."""
        for number, item in enumerate(self.items):
            if not item.standing or chosen >> number & 1 or not self.barred[number]:
                continue
            beside, mask = 0, 0
            for other in _numbers(chosen):
                them = self.items[other]
                same = them.level == item.level and (them.standing or item.spent)
                if them.level < item.level or same:
                    beside |= 1 << other
                    mask |= them.mask
            if not item.mask & mask and self._allowed(number, beside):
                return False
        return True

    def _allowed(self, number: int, chosen: int) -> bool:
        beside = chosen | 1 << number
        return all(bar & ~beside for bar in self.barred[number])

    def _bound(self, open_: list[int]) -> int:
        """What the open items can be worth together, at most."""
        masks, units = self.masks, self.unit
        bound = seen = layer = unit = 0
        for number in open_:
            if units[number] != unit:
                bound += (layer & ~seen).bit_count() * unit
                seen |= layer
                layer, unit = 0, units[number]
            if self.worth[number]:
                layer |= masks[number]
        bound += (layer & ~seen).bit_count() * unit
        if self.shares:
            bound += sum(self.extra[number] for number in open_)
        return bound


def _numbers(bits: int) -> Iterable[int]:
    while bits:
        low = bits & -bits
        yield low.bit_length() - 1
        bits ^= low

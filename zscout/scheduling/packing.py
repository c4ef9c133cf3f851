"""The best set of ARCs that may hold their RCs together: branch and bound over bit masks.

The value of a set is the vector of (ARC, RC) pairs in use by priority level, highest first, compared lexicographically,
each pair worth its ARC's density; among equals the fewest preemptions win, then the best-ranked item in which they
differ. Items are numbered by rank. Taking the best rank first finds the best-ranked of equal sets first, so only
strictly better sets are searched.

Upper bound: each free exclusive RC counts once, at the highest level that covers it; pairs at sharable RCs are
added."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

NO_LIMIT = 1 << 60


class PackingItem(NamedTuple):
    """An ARC: `mask` of its exclusive RCs, `width` in RCs of both kinds, level (0 is the highest). `past_min_runtime`:
    worth nothing, and may have to end for its own level too, but for no lower level."""

    mask: int
    width: int
    level: int
    running: bool = False
    past_min_runtime: bool = False
    density: int = 1
    """The worth of each of its RCs, compared within its level."""

    @property
    def in_min_runtime(self) -> bool:
        return self.running and not self.past_min_runtime


@dataclass(frozen=True, slots=True)
class Packing:
    """A set as bits of item numbers; `exact` if it is proven to be the best."""

    chosen: int
    exact: bool
    nodes: int


class PackingProblem:
    """Items in rank order, so levels never decrease; `nogoods`: item sets that must not be chosen together. All running
    items fit together, except as vetoed."""

    def __init__(self, items: Sequence[PackingItem], nogoods: Iterable[int] = ()) -> None:
        self.items = items
        self.levels = items[-1].level + 1 if items else 1
        base = sum(item.width * item.density for item in items) + 1
        self.unit = [item.density * base ** (self.levels - 1 - item.level) for item in items]
        """The worth of one RC at an item's level: more than all lower levels together."""
        self.masks = [item.mask for item in items]
        valued = [0 if item.past_min_runtime else unit for item, unit in zip(items, self.unit, strict=True)]
        self.worth = [item.width * unit for item, unit in zip(items, valued, strict=True)]
        self.extra = [(item.width - item.mask.bit_count()) * unit for item, unit in zip(items, valued, strict=True)]
        self.dense = any(item.density != 1 for item in items)
        alike = self.levels == 1 and not self.dense
        self.plain = alike and not any(self.extra) and not any(item.past_min_runtime for item in items)
        """Each RC in use counts one."""
        self.nogoods: list[list[int]] = [[] for _ in items]
        for nogood in nogoods:
            for number in numbers(nogood):
                self.nogoods[number].append(nogood)
        self.vetoes = any(self.nogoods)
        self.running = [number for number, item in enumerate(items) if item.running]

    def allowed(self, number: int, chosen: int) -> bool:
        beside = chosen | 1 << number
        return all(nogood & ~beside for nogood in self.nogoods[number])

    def upper_bound(self, open_: Iterable[int]) -> int:
        """The most that these items can be worth together; their levels must not decrease."""
        masks, units = self.masks, self.unit
        if self.plain:
            layer = 0
            for number in open_:
                layer |= masks[number]
            return layer.bit_count()
        if self.dense:
            open_ = sorted(open_, key=units.__getitem__, reverse=True)
        total = seen = layer = unit = extra = 0
        for number in open_:
            if units[number] != unit:
                total += (layer & ~seen).bit_count() * unit
                seen |= layer
                layer, unit = 0, units[number]
            if self.worth[number]:
                layer |= masks[number]
            extra += self.extra[number]
        return total + (layer & ~seen).bit_count() * unit + extra

    def upper_bound_of_all(self) -> int:
        return self.upper_bound(number for number in range(len(self.items)) if self.allowed(number, 0))

    def value(self, chosen: int) -> int:
        return sum(self.worth[number] for number in numbers(chosen))

    def key(self, chosen: int) -> tuple[int, int]:
        left_out = (self.items[number] for number in self.running if not chosen >> number & 1)
        return self.value(chosen), -sum(item.in_min_runtime for item in left_out)

    def complete(self, preferred: int = 0) -> int:
        """A maximal feasible set by level: running, `preferred`, other items. Default: the heuristic's set."""
        items, masks = self.items, self.masks

        def order(number: int) -> tuple[int, int]:
            item = items[number]
            if item.running:
                return item.level, 3 if item.past_min_runtime else 0
            return item.level, 1 if preferred >> number & 1 else 2

        used = chosen = 0
        for number in sorted(range(len(items)), key=order):
            if not masks[number] & used and (not self.vetoes or self.allowed(number, chosen)):
                used |= masks[number]
                chosen |= 1 << number
        return chosen

    def preempts_only_if_needed(self, chosen: int) -> bool:
        """Return True if each dropped running item conflicts with chosen items that outrank it."""
        for number in self.running:
            if chosen >> number & 1:
                continue
            beside, mask = 0, 0
            for other in numbers(chosen):
                if self.outranks(other, number):
                    beside |= 1 << other
                    mask |= self.masks[other]
            if not self.masks[number] & mask and self.allowed(number, beside):
                return False
        return True

    def outranks(self, other: int, running: int) -> bool:
        """Return True if `running` may have to end because `other` was chosen."""
        them, item = self.items[other], self.items[running]
        return them.level < item.level or (them.level == item.level and (them.running or item.past_min_runtime))


def pack(problem: PackingProblem, nodes: int = NO_LIMIT) -> Packing:
    """The best set, or the best found in `nodes` steps: at least the heuristic's."""
    return _BranchAndBound(problem, nodes).run()


class _BranchAndBound:
    def __init__(self, problem: PackingProblem, nodes: int) -> None:
        self.problem = problem
        self.limit = nodes
        items = problem.items
        # Running items that stay wherever they fit. The others are decided by rank, and the whole set is checked.
        self.always_kept = [
            item.in_min_runtime and not nogoods for item, nogoods in zip(items, problem.nogoods, strict=True)
        ]
        self.in_min_runtime = [item.in_min_runtime for item in items]
        self.ends = any(self.in_min_runtime)
        self.checked = any(item.running and not kept for item, kept in zip(items, self.always_kept, strict=True))
        self.best = -1
        self.best_preemptions = 0
        self.chosen = 0
        self.nodes = 0

    def run(self) -> Packing:
        problem = self.problem
        whole = [number for number in range(len(problem.items)) if problem.allowed(number, 0)]
        whole.sort(key=lambda number: (problem.items[number].level, not self.always_kept[number]))
        out = sum(self.in_min_runtime) - sum(self.in_min_runtime[number] for number in whole)
        todo = [(whole, 0, 0, out)]
        cut = False
        while todo and not cut:
            cut = self._descend(todo, *todo.pop())
        if cut:
            self.chosen = max(self.chosen, problem.complete(), key=problem.key)
        return Packing(self.chosen, not cut, self.nodes)

    def _descend(
        self, todo: list[tuple[list[int], int, int, int]], open_: list[int], chosen: int, value: int, preemptions: int
    ) -> bool:
        """Take first items until the set is complete; alternatives go to `todo`. All `open_` are allowed beside
        `chosen`. Return True if the limit left sets unseen."""
        problem, masks, worth = self.problem, self.problem.masks, self.problem.worth
        while open_:
            self.nodes += 1
            if self.nodes > self.limit:
                return True
            if self.best >= 0:
                most = value + problem.upper_bound(open_)
                if most < self.best or (most == self.best and preemptions >= self.best_preemptions):
                    return False
            head, *tail = open_
            mask = masks[head]
            taken = chosen | 1 << head
            rest = [number for number in tail if not masks[number] & mask]
            if problem.vetoes:
                rest = [number for number in rest if problem.allowed(number, taken)]
            dropped = preemptions
            if self.ends and len(rest) < len(tail):
                dropped += sum(self.in_min_runtime[number] for number in set(tail).difference(rest))
            if not self.always_kept[head] and (len(rest) < len(tail) or self._in_the_way(head, taken, tail)):
                todo.append((tail, chosen, value, preemptions + self.in_min_runtime[head]))
            open_, chosen, value, preemptions = rest, taken, value + worth[head], dropped
        better = value > self.best or (value == self.best and preemptions < self.best_preemptions)
        if better and (not self.checked or problem.preempts_only_if_needed(chosen)):
            self.best, self.best_preemptions, self.chosen = value, preemptions, chosen
        return False

    def _in_the_way(self, head: int, taken: int, tail: list[int]) -> bool:
        """Return True if a veto on `head` could apply if all open items were taken."""
        nogoods = self.problem.nogoods[head]
        if not nogoods:
            return False
        reach = taken | sum(1 << number for number in tail)
        return any(not nogood & ~reach for nogood in nogoods)


def numbers(bits: int) -> Iterator[int]:
    while bits:
        low = bits & -bits
        yield low.bit_length() - 1
        bits ^= low

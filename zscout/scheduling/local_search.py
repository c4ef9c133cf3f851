"""Local search for a better set, where the group is too large for an exact answer. Time is counted in steps.

A step picks a random RC that is free or used below the highest level that could use it, and forces in the best item
that covers it: items in its way leave, and others that fit come in. An item that has just moved stays (tabu), so the
search leaves local optima. Each set that looks better is made feasible first (`PackingProblem.complete`)."""

from __future__ import annotations

from typing import Final

from zscout.scheduling.packing import PackingProblem, numbers

MAX_ITEMS: Final = 2_000
"""Items searched, best-ranked first; the others only fill gaps."""
MAX_LEVELS: Final = 12
"""Levels searched: a value has a digit per level, and large numbers are slow."""
TENURE: Final = 7
"""Steps for which a moved item stays where it is."""
IDLE_FACTOR: Final = 40
"""The search ends after this many steps per item without gain."""


class LocalSearch:
    """A search in slices. `best` is always feasible, and at least as good as the start."""

    def __init__(self, problem: PackingProblem, start: int) -> None:
        self.problem = problem
        self.upper_bound = problem.upper_bound_of_all()
        self.best = problem.complete(start)
        self.best_key = problem.key(self.best)
        self.steps = 0
        items = problem.items
        searched = [
            number
            for number, item in enumerate(items[:MAX_ITEMS])
            if item.level < MAX_LEVELS and item.mask and problem.allowed(number, 0)
        ]
        self._needs: dict[int, tuple[int, ...]] = {number: tuple(numbers(items[number].mask)) for number in searched}
        width = max((rcs[-1] + 1 for rcs in self._needs.values()), default=0)
        self._cover: list[list[int]] = [[] for _ in range(width)]
        for number in searched:
            if not items[number].past_min_runtime:
                for rc in self._needs[number]:
                    self._cover[rc].append(number)
        self._level = [item.level for item in items]
        self._top = [max((problem.unit[number] for number in cover), default=0) for cover in self._cover]
        """By RC: the most that it could be worth; 0 where no item uses it."""
        self._all_may_enter = not problem.running and not problem.vetoes
        self._moved = [-TENURE] * len(items)
        self._random = 1
        self._improved_at = 0
        self._idle = IDLE_FACTOR * max(1, len(searched))
        self._adopt(self.best)

    @property
    def done(self) -> bool:
        return self.best_key[0] >= self.upper_bound or not self._pool or self.steps - self._improved_at > self._idle

    def _adopt(self, chosen: int) -> None:
        self._owner = [-1] * len(self._cover)
        self._chosen = chosen
        self._value = self.problem.value(chosen)
        self._used = 0
        self._pool: list[int] = []  # RCs that might be put to better use
        self._at = [-1] * len(self._cover)
        for number in numbers(chosen):
            if number in self._needs:
                self._used |= self.problem.masks[number]
                for rc in self._needs[number]:
                    self._owner[rc] = number
        for rc, owner in enumerate(self._owner):
            if self._top[rc] and (owner < 0 or self.problem.unit[owner] < self._top[rc]):
                self._at[rc] = len(self._pool)
                self._pool.append(rc)

    def run(self, steps: int) -> int:
        """Take at most `steps` steps; return how many were taken."""
        began = self.steps
        while self.steps - began < steps and not self.done:
            self.steps += 1
            # A plain congruential generator: quick, and the search is the same everywhere.
            self._random = (self._random * 6364136223846793005 + 1442695040888963407) & 0xFFFFFFFFFFFFFFFF
            incoming = self._pick(self._pool[(self._random >> 33) % len(self._pool)])
            if incoming >= 0:
                self._force(incoming)
                if self._value > self.best_key[0]:
                    self._keep()
        return self.steps - began

    def _keep(self) -> None:
        completed = self.problem.complete(self._chosen)
        key = self.problem.key(completed)
        if key > self.best_key:
            self.best, self.best_key = completed, key
            self._improved_at = self.steps
        if completed != self._chosen:
            self._adopt(completed)

    def _pick(self, rc: int) -> int:
        """The item to force in at `rc`, by greatest gain, then longest unmoved; -1 for none."""
        worth, owner, moved, needs = self.problem.worth, self._owner, self._moved, self._needs
        aim = self.best_key[0] - self._value
        fresh = self.steps - TENURE
        best, best_gain, best_moved = -1, 0, 0
        for number in self._cover[rc]:
            if self._chosen >> number & 1:
                continue
            gain = worth[number]
            out: list[int] = []
            for need in needs[number]:
                other = owner[need]
                if other >= 0 and other not in out:
                    out.append(other)
                    gain -= worth[other]
            last = moved[number]
            if last > fresh and gain <= aim:
                continue
            if best >= 0 and (gain < best_gain or (gain == best_gain and last >= best_moved)):
                continue
            if self._all_may_enter or self._may_enter(number, out):
                best, best_gain, best_moved = number, gain, last
        return best

    def _may_enter(self, number: int, out: list[int]) -> bool:
        problem, level = self.problem, self._level[number]
        for other in out:
            item = problem.items[other]
            if item.running and (item.level < level or (item.level == level and not item.past_min_runtime)):
                return False
        if not problem.vetoes:
            return True
        left = self._chosen
        for other in out:
            left &= ~(1 << other)
        return problem.allowed(number, left)

    def _force(self, number: int) -> None:
        """Put `number` in; conflicting items leave, and items that fit the gaps enter."""
        problem, owner, masks = self.problem, self._owner, self.problem.masks
        out = {owner[need] for need in self._needs[number]}
        out.discard(-1)
        freed = 0
        for other in out:
            self._leave(other)
            freed |= masks[other]
        self._enter(number)
        fits: set[int] = set()
        for rc in numbers(freed & ~masks[number]):
            fits.update(other for other in self._cover[rc] if not masks[other] & self._used)
        for other in sorted(fits - out, key=lambda candidate: (-problem.worth[candidate], candidate)):
            if not masks[other] & self._used and (not problem.vetoes or problem.allowed(other, self._chosen)):
                self._enter(other)

    def _enter(self, number: int) -> None:
        self._chosen |= 1 << number
        self._used |= self.problem.masks[number]
        self._value += self.problem.worth[number]
        self._moved[number] = self.steps
        owner, pool, place, top, unit = self._owner, self._pool, self._at, self._top, self.problem.unit[number]
        for rc in self._needs[number]:
            owner[rc] = number
            at = place[rc]
            if at >= 0 and unit >= top[rc]:
                last = pool.pop()
                if last != rc:
                    pool[at] = last
                    place[last] = at
                place[rc] = -1

    def _leave(self, number: int) -> None:
        self._chosen &= ~(1 << number)
        self._used &= ~self.problem.masks[number]
        self._value -= self.problem.worth[number]
        self._moved[number] = self.steps
        for rc in self._needs[number]:
            self._owner[rc] = -1
            if self._at[rc] < 0 and self._top[rc]:
                self._at[rc] = len(self._pool)
                self._pool.append(rc)

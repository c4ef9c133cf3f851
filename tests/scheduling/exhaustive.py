"""The best set by trying all of them: slow, obvious, and written from the brief alone.

`level`, `runs` and `past_min_runtime` as in the brief; vetoes are sets of items that must not all hold."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import combinations

from zscout.scheduling.packing import PackingItem


def best_set(items: Sequence[PackingItem], vetoes: Iterable[frozenset[int]]) -> frozenset[int]:
    """The best of all sets of `items`, which are in rank order. Time doubles with each item."""
    vetoes = list(vetoes)
    everyone = range(len(items))
    sets = [frozenset(chosen) for size in range(len(items) + 1) for chosen in combinations(everyone, size)]
    lawful = [
        chosen
        for chosen in sets
        if fits(items, vetoes, chosen)
        and all(may_end(items, vetoes, chosen, one) for one in everyone if items[one].running)
    ]

    def worth(chosen: frozenset[int]) -> tuple[list[int], int, list[bool]]:
        preempted = [one for one in everyone if items[one].running and not items[one].past_min_runtime]
        lost = sum(one not in chosen for one in preempted)
        return vector(items, chosen), -lost, [one in chosen for one in everyone]

    return max(lawful, key=worth)


def vector(items: Sequence[PackingItem], chosen: Iterable[int]) -> list[int]:
    """(ARC, RC) pairs in use at each level, highest first; one past its minimum runtime counts nothing."""
    pairs = [0] * (max((item.level for item in items), default=0) + 1)
    for one in chosen:
        if not items[one].past_min_runtime:
            pairs[items[one].level] += items[one].width
    return pairs


def fits(items: Sequence[PackingItem], vetoes: Iterable[frozenset[int]], chosen: frozenset[int]) -> bool:
    if any(veto <= chosen for veto in vetoes):
        return False
    return not any(items[one].mask & items[other].mask for one, other in combinations(chosen, 2))


def may_end(items: Sequence[PackingItem], vetoes: Iterable[frozenset[int]], chosen: frozenset[int], one: int) -> bool:
    """Whether a running item is in the set, or has no room beside the chosen that it must give way to."""
    if one in chosen:
        return True
    me = items[one]
    before = frozenset(
        other
        for other in chosen
        if items[other].level < me.level
        or (items[other].level == me.level and (items[other].running or me.past_min_runtime))
    )
    return not fits(items, vetoes, before | {one})

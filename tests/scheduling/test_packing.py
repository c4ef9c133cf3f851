"""The exact packers against trying all sets, and local search against the exact."""

from __future__ import annotations

import random

from tests.scheduling.exhaustive import best_set, may_end, vector
from tests.thorough import times
from zscout.scheduling import optimal
from zscout.scheduling.adaptive import steps_for
from zscout.scheduling.local_search import LocalSearch
from zscout.scheduling.optimal import best
from zscout.scheduling.packing import PackingItem, PackingProblem, numbers, pack

Case = tuple[list[PackingItem], list[frozenset[int]]]


def case(seed: int, most: int = 9) -> Case:
    """Few RCs, some sharable, up to three levels; some run, some of these past their time; some vetoes."""
    draw = random.Random(seed)  # noqa: S311
    rcs = draw.randint(2, 6)
    items: list[PackingItem] = []
    used = 0
    for _ in range(draw.randint(1, most)):
        mask = sum(1 << rc for rc in draw.sample(range(rcs), draw.randint(1, min(3, rcs))))
        shared = draw.choice([0, 0, 1])
        running = not mask & used and draw.random() < 0.5
        if running:
            used |= mask
        elif shared and draw.random() < 0.3:
            mask = 0
        past_min_runtime = running and draw.random() < 0.3
        items.append(PackingItem(mask, mask.bit_count() + shared, draw.randrange(3), running, past_min_runtime))
    items.sort(key=lambda item: item.level)
    vetoes: list[frozenset[int]] = []
    for _ in range(draw.randint(1, 4) if draw.random() < 0.6 else 0):
        veto = frozenset(draw.sample(range(len(items)), min(len(items), draw.randint(1, 3))))
        # Rules that changed may rule out even those who run.
        if draw.random() < 0.2 or not all(items[one].running for one in veto):
            vetoes.append(veto)
    return items, vetoes


def problem(case: Case) -> PackingProblem:
    items, vetoes = case
    return PackingProblem(items, [sum(1 << one for one in veto) for veto in vetoes])


def large(seed: int, rcs: int, arcs: int, levels: int = 1) -> PackingProblem:
    draw = random.Random(seed)  # noqa: S311
    masks = [sum(1 << rc for rc in draw.sample(range(rcs), draw.randint(1, 5))) for _ in range(arcs)]
    return PackingProblem(
        sorted((PackingItem(mask, mask.bit_count(), draw.randrange(levels)) for mask in masks), key=_level)
    )


def _level(item: PackingItem) -> int:
    return item.level


def test_branch_and_bound_finds_the_very_set_that_trying_all_finds() -> None:
    for seed in range(times(500)):
        items, vetoes = case(seed)
        found = pack(problem((items, vetoes)))
        assert found.exact
        assert frozenset(numbers(found.chosen)) == best_set(items, vetoes), seed


def test_cpsat_finds_the_very_set_as_well() -> None:
    for seed in range(times(30)):
        items, vetoes = case(seed, most=7)
        asked = problem((items, vetoes))
        found = optimal.improve(asked, asked.complete(), budget=5)
        assert frozenset(numbers(found)) == best_set(items, vetoes), seed


def test_what_is_cut_short_is_lawful_no_better_than_the_best_and_no_worse_than_the_heuristic() -> None:
    for seed in range(times(200)):
        items, vetoes = case(seed)
        asked = problem((items, vetoes))
        exact = pack(asked)
        search = LocalSearch(asked, 0)
        search.run(50)
        for chosen in (pack(asked, 2).chosen, search.best, asked.complete(seed)):
            holders = frozenset(numbers(chosen))
            assert not any(veto <= holders for veto in vetoes)
            assert not any(items[one].mask & items[other].mask for one in holders for other in holders if one < other)
            running = [one for one in range(len(items)) if items[one].running]
            assert all(may_end(items, vetoes, holders, one) for one in running)
            assert asked.key(chosen) <= asked.key(exact.chosen)
            assert vector(items, holders) <= vector(items, numbers(exact.chosen))
        heuristic = asked.key(asked.complete())
        assert min(asked.key(search.best), asked.key(pack(asked, 2).chosen)) >= heuristic


def test_the_bound_is_one() -> None:
    for seed in range(times(200)):
        asked = problem(case(seed))
        assert asked.upper_bound_of_all() >= asked.value(pack(asked).chosen)


def test_a_search_in_slices_is_the_search_in_one_go() -> None:
    asked = large(1, 50, 100)
    whole, sliced = LocalSearch(asked, 0), LocalSearch(asked, 0)
    whole.run(300)
    while sliced.steps < 300 and sliced.run(min(7, 300 - sliced.steps)):
        pass
    assert (whole.best, whole.steps) == (sliced.best, sliced.steps)


def test_local_search_comes_within_a_hundredth_of_the_proven_best_at_50x100() -> None:
    shares = []
    for seed in range(7):
        asked = large(seed, 50, 100)
        search = LocalSearch(asked, 0)
        search.run(steps_for(100))
        shares.append(search.best_key[0] / asked.value(best(asked)))
    assert sorted(shares)[3] >= 0.99
    assert min(shares) >= 0.95


def test_local_search_across_levels_never_gives_up_a_higher_one() -> None:
    for seed in range(5):
        asked = large(seed, 30, 90, levels=3)
        search = LocalSearch(asked, 0)
        search.run(600)
        first, found = (vector(asked.items, numbers(one)) for one in (asked.complete(), search.best))
        assert found > first
        top = PackingProblem([item for item in asked.items if item.level == 0])
        assert found[0] >= 0.9 * top.value(best(top))


def test_cpsat_begins_with_what_it_is_given() -> None:
    asked = large(3, 120, 240)
    search = LocalSearch(asked, 0)
    search.run(500)
    assert asked.key(optimal.improve(asked, search.best, budget=0.01)) >= search.best_key

"""The paper's Figure 3 and its cures, unlike machines, and what `auto` learns, in simulation."""

from __future__ import annotations

from random import Random

import pytest

from studies.placement.scenarios import NET_SIZE, NETS, STAGGER
from studies.placement.simulation import Machine, SimulatedJob, simulate
from studies.placement.study import BASELINE, BATCHES, batch, figure, learn
from tests.thorough import times
from zscout.placement.model import CHOICES, ENOUGH, MetricLearner, spearman
from zscout.types import POLICIES, SECOND, Metric, Policy

SEEDS = range(100)
PLACED_BY = 2 * SECOND
"""All that start at once are placed by then."""


def splits(policy: Policy) -> list[list[int]]:
    return [sorted(figure("simultaneous", policy, seed, PLACED_BY).counts()) for seed in SEEDS]


def test_all_at_once_one_policy_uses_one_host_as_the_paper_found_and_two_use_all() -> None:
    assert splits("least_loaded") == [[0, 0, 12]] * 100
    assert all(most - least <= 1 for least, _, most in splits("pending"))
    found = splits("two_choices")
    assert all(least >= 2 for least, _, _ in found)
    # Chance has its share: not all runs are within one.
    assert sum(most - least <= 1 for least, _, most in found) > 50


@pytest.mark.parametrize("policy", POLICIES)
def test_staggered_every_policy_uses_all_hosts(policy: Policy) -> None:
    until = (NETS - 1) * STAGGER + PLACED_BY
    for seed in range(times(5)):
        counts = figure("staggered", policy, seed, until).counts()
        assert min(counts) > 0
        assert sum(counts) == NETS * NET_SIZE


@pytest.mark.slow
def test_pending_brings_the_load_curves_together() -> None:
    apart = {policy: sum(figure("simultaneous", policy, seed).apart() for seed in range(4)) for policy in POLICIES}
    assert apart["pending"] < apart["two_choices"] < apart["randomized"] < apart["least_loaded"]


@pytest.mark.slow
def test_unlike_machines_finish_a_mixed_batch_a_quarter_sooner() -> None:
    """Both the last end and the mean completion, means over the seeds."""
    setups: tuple[tuple[Metric, Policy], ...] = (BASELINE, ("composite", "pending"), ("auto", "pending"))
    found = [[batch(metric, policy, seed) for seed in range(times(10))] for metric, policy in setups]
    makespan, completion = ([sum(run[at] for run in runs) for runs in found] for at in range(2))
    for took in (makespan, completion):
        assert took[1] <= 0.75 * took[0]
        assert took[2] <= 0.75 * took[0]


@pytest.mark.slow
def test_a_seed_is_the_same_every_time() -> None:
    for metric, policy in BATCHES:
        assert batch(metric, policy, 3) == batch(metric, policy, 3)
    for policy in POLICIES:
        assert figure("simultaneous", policy, 3, PLACED_BY) == figure("simultaneous", policy, 3, PLACED_BY)
    assert learn("processor_speed", 3) == learn("processor_speed", 3)


@pytest.mark.parametrize(
    ("decides", "right"),
    [
        ("processor_speed", {"processor_speed"}),
        # Where nothing misleads `composite`, it ranks hosts exactly as the load does.
        pytest.param("load_average", {"load_average", "composite"}, marks=pytest.mark.slow),
        pytest.param("available_memory", {"available_memory"}, marks=pytest.mark.slow),
    ],
)
def test_auto_finds_the_metric_that_foretells(decides: str, right: set[Metric]) -> None:
    found = [learn(decides, seed)[0] for seed in range(times(4))]
    assert sum(metric in right for metric in found) >= 0.75 * len(found), found


def test_auto_says_which_metric_it_believes_and_why() -> None:
    learner = MetricLearner()
    for number in range(ENOUGH):
        assert learner.judge() == ("composite", f"the default: {number} placements seen, {ENOUGH} are needed")
        scores = {metric: float(number if metric == "available_memory" else -number) for metric in CHOICES}
        learner.seen.append((scores, number / 10))
    metric, why = learner.judge()
    assert metric == "available_memory"
    assert why.startswith(f"available_memory agrees best with how {ENOUGH} components ran: 1.00")
    assert "composite -1.00" in why
    rng = Random(0)  # noqa: S311
    choices = [learner.choose(rng) for _ in range(200)]
    tried = {metric for metric, why in choices if why.startswith("tried in turn")}
    assert tried == set(CHOICES)


@pytest.mark.parametrize(
    ("one", "other", "result"),
    [
        ([1, 2, 3], [10, 20, 90], 1.0),
        ([1, 2, 3], [3, 2, 1], -1.0),
        ([1, 1, 2, 2], [1, 1, 2, 2], 1.0),
        ([1, 1, 1], [1, 2, 3], 0.0),
        ([1], [1], 0.0),
    ],
)
def test_rank_correlation(one: list[float], other: list[float], result: float) -> None:
    assert spearman(one, other) == pytest.approx(result)


def test_a_machine_shares_its_processor_and_slows_down_for_want_of_memory() -> None:
    def end(jobs: int, memory: int, speed: float = 1.0) -> float:
        machine = Machine("a", speed=speed, memory=1_000)
        work = [SimulatedJob(f"j{number}", "j", 0, 1, memory, 10, greedy=True) for number in range(jobs)]
        return max(simulate([machine], work).ends.values()) / SECOND

    assert end(1, 10) == pytest.approx(10.5, abs=0.2)
    assert end(1, 10, speed=4) == pytest.approx(3.0, abs=0.2)
    assert end(2, 10) == pytest.approx(20.5, abs=0.2)
    assert end(2, 1_000) == pytest.approx(80.5, abs=1)


def test_a_simulation_that_would_never_end_is_refused() -> None:
    with pytest.raises(ValueError, match="needs `until`"):
        simulate([Machine("a")], [SimulatedJob("j", "j", 0, 1)])

"""The study of placement: policies and metrics compared over seeds. A seed gives the same result everywhere."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from random import Random
from typing import Final

from studies.placement.scenarios import (
    FLEETS,
    STAGGER,
    WATCHED,
    deciding_fleet,
    mixed_batch,
    sensor_nets,
    unlike_machines,
    workstations,
)
from studies.placement.simulation import PlacementOutcome, simulate
from zscout.placement.balancer import Balancer
from zscout.types import METRICS, POLICIES, SECOND, Metric, Ns, Policy

SCENARIOS: Final[Mapping[str, Ns]] = {"simultaneous": 0, "staggered": STAGGER}
"""The paper's Figure 3 (a) and (b): interval between the Place Sensor Nets in ns."""
FIGURE_METRIC: Final[Metric] = "load_average"
BASELINE: Final[tuple[Metric, Policy]] = ("load_average", "least_loaded")
"""The paper's balancer, with which batches are compared."""
BATCHES: Final[tuple[tuple[Metric, Policy], ...]] = (BASELINE, *((metric, "pending") for metric in METRICS))
LATEST: Final = 20
"""Number of last placements in a fleet by which `auto` is judged."""


@dataclass(frozen=True, slots=True)
class PolicySpread:
    """Three Place Sensor Nets on three workstations under one policy, over all seeds. `splits`: number of seeds by
    split of the components, the fullest host first. `used_all`: seeds in which every host got components. `even`: seeds
    in which the hosts' counts differed by at most 1. `apart`: highest minus lowest load average, mean over time and
    seeds."""

    scenario: str
    policy: Policy
    splits: Mapping[str, int]
    used_all: int
    even: int
    apart: float


@dataclass(frozen=True, slots=True)
class Batch:
    """Means over seeds, in seconds. `makespan`: until the last end; `completion`: from a component's start to its end.
    The gains are relative to `BASELINE`, at most 1."""

    metric: Metric
    policy: Policy
    makespan: float
    completion: float
    makespan_gain: float
    completion_gain: float


@dataclass(frozen=True, slots=True)
class Learnt:
    """What `auto` chose in a fleet where the figure `decides`. `used`: seeds by the metric of most of the last
    placements. `why`: its explanation at the end of the first seed."""

    decides: str
    used: Mapping[Metric, int]
    why: str


@dataclass(frozen=True, slots=True)
class PlacementReport:
    seeds: int
    spreads: tuple[PolicySpread, ...]
    batches: tuple[Batch, ...]
    learnt: tuple[Learnt, ...]


def parts() -> int:
    """Calls of `advance` for each seed of `study`."""
    return len(SCENARIOS) * len(POLICIES) + len(BATCHES) + len(FLEETS)


def study(
    seeds: Sequence[int], advance: Callable[[], None] = lambda: None
) -> tuple[PlacementReport, dict[tuple[str, Policy], PlacementOutcome]]:
    """Run everything. Also return the first seed's outcomes by scenario and policy. Raises ValueError without seeds."""
    if not seeds:
        raise ValueError("a study needs a seed")
    spreads, first = [], {}
    for scenario in SCENARIOS:
        for policy in POLICIES:
            outcomes = []
            for seed in seeds:
                outcomes.append(figure(scenario, policy, seed))
                advance()
            first[scenario, policy] = outcomes[0]
            spreads.append(_spread(scenario, policy, outcomes))
    batches: list[Batch] = []
    for metric, policy in BATCHES:
        times = []
        for seed in seeds:
            times.append(batch(metric, policy, seed))
            advance()
        makespan, completion = (_mean([run[at] for run in times]) for at in range(2))
        base = batches[0] if batches else None
        gains = [1 - makespan / base.makespan, 1 - completion / base.completion] if base else [0.0, 0.0]
        batches.append(Batch(metric, policy, makespan, completion, *gains))
    learnt = []
    for decides in FLEETS:
        found = []
        for seed in seeds:
            found.append(learn(decides, seed))
            advance()
        used = Counter(metric for metric, _ in found)
        learnt.append(Learnt(decides, dict(used.most_common()), found[0][1]))
    return PlacementReport(len(seeds), tuple(spreads), tuple(batches), tuple(learnt)), first


def figure(scenario: str, policy: Policy, seed: int, until: Ns = WATCHED) -> PlacementOutcome:
    """The paper's Figure 3: `scenario` is one of `SCENARIOS`."""
    nets = sensor_nets(SCENARIOS[scenario])
    return simulate(workstations(), nets, metric=FIGURE_METRIC, policy=policy, seed=seed, until=until)


def batch(metric: Metric, policy: Policy, seed: int) -> tuple[float, float]:
    """Makespan and mean completion of the mixed batch on unlike machines, in seconds."""
    jobs = mixed_batch(seed)
    outcome = simulate(unlike_machines(seed), jobs, metric=metric, policy=policy, seed=seed)
    began = min(job.at for job in jobs)
    took = [(outcome.ends[job.component] - job.at) / SECOND for job in jobs]
    return (max(outcome.ends.values()) - began) / SECOND, _mean(took)


def learn(decides: str, seed: int) -> tuple[Metric, str]:
    """The metric that `auto` used for most of the last placements, and its explanation."""
    balancer = Balancer(Random(seed))  # noqa: S311 - a simulation
    machines, jobs = deciding_fleet(decides, seed)
    outcome = simulate(machines, jobs, metric="auto", seed=seed, balancer=balancer)
    used = Counter(outcome.metrics[-LATEST:]).most_common(1)[0][0]
    return used, balancer.learner.judge()[1]


def _spread(scenario: str, policy: Policy, outcomes: Sequence[PlacementOutcome]) -> PolicySpread:
    splits = Counter("-".join(str(count) for count in sorted(outcome.counts(), reverse=True)) for outcome in outcomes)
    return PolicySpread(
        scenario,
        policy,
        dict(sorted(splits.items(), key=lambda split: (-split[1], split[0]))),
        used_all=sum(min(outcome.counts()) > 0 for outcome in outcomes),
        even=sum(outcome.spread() <= 1 for outcome in outcomes),
        apart=_mean([outcome.apart() for outcome in outcomes]),
    )


def _mean(values: Sequence[float]) -> float:
    return sum(values) / len(values)

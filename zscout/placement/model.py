"""Hosts and kinds of components as the load balancer knows them, and the score of a host by each metric.

A greater score is a better host. `load_average`, `processor_speed` and `available_memory` are the paper's (section 5).
`composite` predicts how fast the component would run there, sharing the processor and fitting in memory.

Metric `auto` (the paper's open question) records every metric's score of the chosen host and how well the component
then ran. The next placement uses the metric with the best Spearman rank correlation over the latest placements. One
placement in ten tries the metrics in turn: a bad host must be tried to be known."""

from __future__ import annotations

import math
from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from random import Random
from statistics import StatisticsError, correlation
from typing import Final, NamedTuple

from zscout.messages import ComponentSpec, ComponentUse, LoadReport, RankAsk, RankedHost
from zscout.types import SECOND, HostName, Kind, Metric, Ns, Policy

REPORT_EVERY: Final[Ns] = SECOND
STALE: Final[Ns] = 3 * REPORT_EVERY + REPORT_EVERY // 2
"""A host with an older report is never ranked."""
THRASHING: Final = 0.05
"""Share of its speed that a component keeps when memory is far too small."""
MEGABYTE: Final = 1_000_000
LEAST: Final = 0.01


class Profile(NamedTuple):
    """Known or assumed use of a kind: `cpu` in cores of speed 1.0, `memory` in bytes. `threads`: the most cores it
    wants. A component that computes all the time wants one core on any host; a paced one less of a faster host."""

    cpu: float = 0.25
    memory: int = 64_000_000
    samples: int = 0
    threads: int = 1

    def wants(self, speed: float) -> float:
        """Cores wanted of a host of this speed. A kind that never ran counts the same on all."""
        return min(self.cpu / speed if self.samples else self.cpu, float(self.threads))

    def learn(self, use: ComponentUse, speed: float) -> Profile:
        """Add a sample; memory is the slowly decaying maximum."""
        # Its demand, not its share of a busy host.
        wanted = use.cpu / max(use.served, LEAST_SERVED) if use.served is not None else use.cpu
        threads = max(1, math.ceil(round(wanted, 1)))
        if not self.samples:
            return Profile(wanted * speed, use.memory, 1, threads)
        return Profile(
            cpu=self.cpu + LEARN * (wanted * speed - self.cpu),
            memory=max(use.memory, round(self.memory + LEARN / 10 * (use.memory - self.memory))),
            samples=self.samples + 1,
            threads=max(self.threads, threads),
        )


@dataclass(frozen=True, slots=True)
class RankQuery:
    """`labels`: all of them; `memory`: bytes available; `hosts`: only these; None: all that report."""

    kind: Kind = ""
    metric: Metric = "composite"
    policy: Policy = "pending"
    labels: frozenset[str] = frozenset()
    memory: int = 0
    hosts: frozenset[HostName] | None = None

    @classmethod
    def of(cls, asked: ComponentSpec | RankAsk) -> RankQuery:
        hosts = None if asked.hosts is None else frozenset(asked.hosts)
        return cls(asked.kind, asked.metric, asked.policy, frozenset(asked.labels), asked.memory, hosts)


class Unfit(NamedTuple):
    """Why a host can't be used; `str` is its text."""

    text: str
    without_figures: str = ""
    """The same whatever its figures are; empty: it has none."""

    def __str__(self) -> str:
        return self.text

    @property
    def cause(self) -> str:
        return self.without_figures or self.text


NO_REPORT: Final = Unfit("no report of it")


@dataclass(frozen=True, slots=True)
class Ranking:
    """Best first; `why`: how `metric` was chosen; `more`: ranked hosts not listed; `left_out`: why, by host."""

    hosts: tuple[RankedHost, ...]
    metric: Metric
    why: str
    left_out: Mapping[HostName, Unfit] = field(default_factory=dict)
    more: int = 0


@dataclass(frozen=True, slots=True)
class Outlook:
    """A host as reported, plus pending placements."""

    report: LoadReport
    load: float
    """Processes that want a processor: the load average plus pending ones."""
    memory: int
    """Bytes available after all placements."""

    @property
    def load_per_core(self) -> float:
        return self.load / self.report.cores


def rate(outlook: Outlook, profile: Profile) -> float:
    """Predicted speed of a component: 1.0 is a core of speed 1.0 whenever it wants one."""
    return rates([outlook], profile)[0]


def rates(outlooks: Sequence[Outlook], profile: Profile) -> list[float]:
    """For thousands of hosts at once: `profile.wants` is inlined, as a call would cost more."""
    cpu, threads, needed = profile.cpu, float(profile.threads), profile.memory
    found = []
    for outlook in outlooks:
        report = outlook.report
        speed, cores = report.speed, report.cores
        wants = cpu / speed
        if wants > threads:
            wants = threads
        elif wants < LEAST:
            wants = LEAST
        wanting = outlook.load + wants
        got = speed if wanting <= cores else speed * cores / wanting
        if max(0, outlook.memory) < needed:
            got *= max(THRASHING, (max(0, outlook.memory) / needed) ** 2)
        found.append(got)
    return found


SCORES: Final[Mapping[Metric, Callable[[Sequence[Outlook], Profile], list[float]]]] = {
    "load_average": lambda outlooks, _: [-outlook.load_per_core for outlook in outlooks],
    "processor_speed": lambda outlooks, _: [outlook.report.speed for outlook in outlooks],
    "available_memory": lambda outlooks, _: [float(outlook.memory) for outlook in outlooks],
    "composite": rates,
}
"""Scores of hosts by all metrics but `auto`."""

WORDS: Final[Mapping[Metric, Callable[[Outlook, Profile], str]]] = {
    "load_average": lambda outlook, _: f"load {outlook.load_per_core:.2f} a core",
    "processor_speed": lambda outlook, _: f"speed {outlook.report.speed:.2f}",
    "available_memory": lambda outlook, _: f"{outlook.memory / MEGABYTE:,.0f} MB available",
    "composite": lambda outlook, profile: (
        f"would run at {rate(outlook, profile):.2f}: speed {outlook.report.speed:.2f}, "
        f"load {outlook.load_per_core:.2f} a core, {outlook.memory / MEGABYTE:,.0f} MB available"
    ),
}
"""Explanations for the listed hosts: slower than scores."""

CHOICES: Final[tuple[Metric, ...]] = tuple(SCORES)
REMEMBERED: Final = 200
ENOUGH: Final = 12
EXPLORE: Final = 0.1
DEFAULT: Final[Metric] = "composite"
AHEAD: Final = 0.02
"""How much better another metric than `DEFAULT` has to agree."""
LEAST_SERVED: Final = 0.05
"""A smaller share does not show how much a component wants."""
LEARN: Final = 0.2
"""Weight of the latest figure in a profile."""


class MetricLearner:
    def __init__(self) -> None:
        self.seen: deque[tuple[Mapping[Metric, float], float]] = deque(maxlen=REMEMBERED)
        """All scores of a host, and how fast a component then ran there (`rate`)."""
        self._turn = 0

    def choose(self, rng: Random) -> tuple[Metric, str]:
        if rng.random() < EXPLORE:
            metric = CHOICES[self._turn % len(CHOICES)]
            self._turn += 1
            return metric, f"tried in turn, to learn: {len(self.seen)} placements seen"
        return self.judge()

    def judge(self) -> tuple[Metric, str]:
        if len(self.seen) < ENOUGH:
            return DEFAULT, f"the default: {len(self.seen)} placements seen, {ENOUGH} are needed"
        ran = [rate for _, rate in self.seen]
        found = {metric: spearman([scores[metric] for scores, _ in self.seen], ran) for metric in CHOICES}
        best = max(CHOICES, key=lambda metric: found[metric] + AHEAD * (metric == DEFAULT))
        others = ", ".join(f"{metric} {found[metric]:.2f}" for metric in CHOICES if metric != best)
        return best, f"{best} agrees best with how {len(self.seen)} components ran: {found[best]:.2f} ({others})"


def spearman(first: Sequence[float], other: Sequence[float]) -> float:
    """Rank correlation, ties shared, from -1 to 1; 0 where either does not vary."""
    try:
        return correlation(_ranks(first), _ranks(other))
    except StatisticsError:
        return 0.0


def _ranks(values: Sequence[float]) -> list[float]:
    ordered = sorted(values)
    return [float(bisect_left(ordered, value) + bisect_right(ordered, value)) for value in values]

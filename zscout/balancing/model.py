"""What the load balancer knows: hosts by their reports, kinds of components by their profiles.

Times are whole nanoseconds on one clock of the caller's choice; nothing here reads a clock or draws a random
number that was not handed in.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple, TypeAlias

HostName: TypeAlias = str
ComponentId: TypeAlias = str
Kind: TypeAlias = str
"""What is started: the name of an entry point of the group `zscout.components`."""
Ns: TypeAlias = int

SECOND: Final[Ns] = 1_000_000_000
REPORT_EVERY: Final[Ns] = SECOND
"""From one load report of a host to the next."""
STALE: Final[Ns] = 3 * REPORT_EVERY + REPORT_EVERY // 2
"""A host whose last report is older is silent: it is never named."""

Metric: TypeAlias = Literal["load_average", "processor_speed", "available_memory", "composite", "auto"]
Policy: TypeAlias = Literal["least_loaded", "randomized", "two_choices", "pending"]
METRICS: Final[tuple[Metric, ...]] = (
    "load_average",
    "processor_speed",
    "available_memory",
    "composite",
    "auto",
)
POLICIES: Final[tuple[Policy, ...]] = ("least_loaded", "randomized", "two_choices", "pending")


MAX_USES: Final = 1_000
"""Components in one load report."""


class Use(NamedTuple):
    """What one component uses, with all its child processes: `cpu` in cores, `memory` in bytes.

    `served` is the share of the time in which it wanted a processor that it had one, from 0 to 1; None where
    the system does not tell."""

    component: ComponentId
    kind: Kind
    incarnation: int
    cpu: float
    memory: int
    served: float | None = None


@dataclass(frozen=True, slots=True)
class Report:
    """One load report. `cores` may be a fraction where a container has only so much.

    `speed`: how fast one core is, measured by the same short piece of work on every host (`1.0` is the speed
    at which that takes a millisecond), so that unlike machines compare; `clock` and `clock_rated` in MHz, 0
    where the system does not tell. Load averages as the kernel has them, memory in bytes, `cpu` 0 to 1.
    Raises ValueError for figures that no host can have."""

    host: HostName
    number: int
    cores: float
    load_average: tuple[float, float, float]
    cpu: float
    memory_available: int
    memory_total: int
    speed: float = 1.0
    clock: float = 0.0
    clock_rated: float = 0.0
    temperature: float | None = None
    labels: frozenset[str] = frozenset()
    uses: tuple[Use, ...] = ()

    def __post_init__(self) -> None:
        # Thousands come each second: what is wrong is looked for only where something is.
        one, five, fifteen = self.load_average
        if not (
            SMALLEST <= self.cores <= LARGEST
            and SMALLEST <= self.speed <= LARGEST
            and 0 <= self.cpu <= 1
            and 0 <= one <= LARGEST
            and 0 <= five <= LARGEST
            and 0 <= fifteen <= LARGEST
            and 0 <= self.memory_available <= LARGEST
            and 0 <= self.memory_total <= LARGEST
            and len(self.uses) <= MAX_USES
        ):
            self._refuse()

    def _refuse(self) -> None:
        _bounded("cores", self.cores, SMALLEST)
        _bounded("speed", self.speed, SMALLEST)
        _bounded("cpu", self.cpu, 0, 1)
        for load in self.load_average:
            _bounded("load_average", load, 0)
        _bounded("memory_available", self.memory_available, 0)
        _bounded("memory_total", self.memory_total, 0)
        if len(self.uses) > MAX_USES:
            raise ValueError(f"uses: {len(self.uses)} components; a report has at most {MAX_USES}")


SMALLEST: Final = 0.001
"""The least cores and the least speed: what is divided by."""
LARGEST: Final = 2**63


def _bounded(name: str, value: float, least: float, most: float = LARGEST) -> None:
    if not (math.isfinite(value) and least <= value <= most):
        raise ValueError(f"{name}: {value} is not from {least:g} to {most:g}")


class Profile(NamedTuple):
    """What a kind of component is known to use: `cpu` in cores of speed 1.0, `memory` in bytes.

    `threads`: it never wants more cores than that, however slow they are. A component that computes all the
    time wants one core on any host; one that keeps a pace wants less of a faster one."""

    cpu: float
    memory: int
    samples: int = 0
    threads: int = 1

    def wants(self, speed: float) -> float:
        """Cores that it wants of a host of this speed. Of a kind that never ran nobody knows what speed does
        to it: it counts the same everywhere."""
        if not self.samples:
            return min(self.cpu, float(self.threads))
        return min(self.cpu / speed, float(self.threads))


DEFAULT_PROFILE: Final = Profile(cpu=0.25, memory=64_000_000)
"""Of a kind that never ran here."""


@dataclass(frozen=True, slots=True)
class Requirements:
    """Where a component can run at all."""

    labels: frozenset[str] = frozenset()
    """The host must have all of these: devices, operating system, a place."""
    memory: int = 0
    """Bytes that must be available."""


@dataclass(frozen=True, slots=True)
class Question:
    """Which host is the best for a component? `hosts`: only these; None: all that report."""

    kind: Kind = ""
    metric: Metric = "composite"
    policy: Policy = "pending"
    requirements: Requirements = Requirements()
    hosts: frozenset[HostName] | None = None


@dataclass(frozen=True, slots=True)
class Ranked:
    """A host and what it counts for; the greater score is the better host. `reason` says it in words."""

    host: HostName
    score: float
    reason: str


@dataclass(frozen=True, slots=True)
class Ranking:
    """Hosts best first; `metric` is the one that was used, `why` says how that came; `left_out` tells of each
    host that was asked about and can't be named, why; `more` hosts are ranked behind those named."""

    hosts: tuple[Ranked, ...]
    metric: Metric
    why: str
    left_out: Mapping[HostName, str] = field(default_factory=dict)
    more: int = 0

"""What the load balancer knows: hosts by their reports, kinds of components by their profiles.

Times are whole nanoseconds on one clock of the caller's choice.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from zscout.types import SECOND, ComponentId, HostName, Kind, Metric, Ns, Policy

REPORT_EVERY: Final[Ns] = SECOND
"""Period of a host's load reports."""
STALE: Final[Ns] = 3 * REPORT_EVERY + REPORT_EVERY // 2
"""A host whose last report is older is never ranked."""

MAX_USES: Final = 1_000
"""Components in one load report."""


class ComponentUsage(NamedTuple):
    """What one component uses, with all its child processes: `cpu` in cores, `memory` in bytes.

    `served`: of the time in which it wanted a processor, the share in which it had one, from 0 to 1; None
    where the system does not measure it."""

    component: ComponentId
    kind: Kind
    incarnation: int
    cpu: float
    memory: int
    served: float | None = None


@dataclass(frozen=True, slots=True)
class HostReport:
    """One load report. `cores` may be a fraction where a container has only so much.

    `speed`: how fast one core is, measured by the same short piece of work on every host (`1.0` is the speed
    at which that takes a millisecond), so that unlike machines compare; `clock` and `clock_rated` in MHz, 0
    where the system does not report it. Load averages as the kernel has them, memory in bytes, `cpu` 0 to 1.
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
    uses: tuple[ComponentUsage, ...] = ()

    def __post_init__(self) -> None:
        # Thousands come each second: which figure is wrong is determined only where one is.
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
        """Cores that it wants of a host of this speed. A kind that never ran counts the same on all."""
        if not self.samples:
            return min(self.cpu, float(self.threads))
        return min(self.cpu / speed, float(self.threads))


DEFAULT_PROFILE: Final = Profile(cpu=0.25, memory=64_000_000)
"""Of a kind that never ran."""


@dataclass(frozen=True, slots=True)
class Requirements:
    """Where a component can run at all."""

    labels: frozenset[str] = frozenset()
    """The host must have all of these: devices, operating system, a place."""
    memory: int = 0
    """Bytes that must be available."""


@dataclass(frozen=True, slots=True)
class RankQuery:
    """Which hosts are best for a component? `hosts`: only these; None: all that report."""

    kind: Kind = ""
    metric: Metric = "composite"
    policy: Policy = "pending"
    requirements: Requirements = Requirements()
    hosts: frozenset[HostName] | None = None


@dataclass(frozen=True, slots=True)
class ScoredHost:
    """A host and its score, which is greater for a better host; `reason` has it in words."""

    host: HostName
    score: float
    reason: str


@dataclass(frozen=True, slots=True)
class Ranking:
    """Hosts best first; `metric` is the one that was used, `why` says how it was chosen; `left_out` has the
    reasons of hosts that are not eligible; `more` hosts are ranked behind those listed."""

    hosts: tuple[ScoredHost, ...]
    metric: Metric
    why: str
    left_out: Mapping[HostName, str] = field(default_factory=dict)
    more: int = 0

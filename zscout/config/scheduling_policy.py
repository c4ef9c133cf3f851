"""The scheduling options of a fleet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal, TypeAlias

from zscout.types import SECOND, Ns

PATIENCE: Final[Ns] = 142 * SECOND
"""Least patience in ns where it follows the runtimes. Measured: docs/evaluation/trace.md."""
PREEMPT_BUDGET: Final = 0.25
"""Default. Measured: docs/evaluation/strategies.md."""
FAIR_PATIENCE: Final[Ns] = 3_600 * SECOND
"""Default, in ns."""
OPERATOR_PRIORITY: Final = 10

StrategyName: TypeAlias = Literal["priority", "optimal", "adaptive"]
Preempt: TypeAlias = Literal["always", "after_min_runtime"]
Promise: TypeAlias = Literal["equals", "all"]


@dataclass(frozen=True, slots=True)
class RcQuota:
    """The number of RCs that some owners (hosts and people) may hold together at one time."""

    name: str
    owners: frozenset[str]
    rcs: int


@dataclass(frozen=True, slots=True)
class FairShares:
    """Among ARCs of equal priority, groups with less recent contended usage go first (`fair_shares.py`)."""

    half_life: Ns
    """Time in ns after which usage counts half."""
    weights: Mapping[str, float] = field(default_factory=dict)
    """By group: its share of contended devices relative to the other groups; 1 if not given."""
    patience: Ns = FAIR_PATIENCE
    """Patience in ns of groups that used more than a waiting group; other groups have `SchedulingPolicy.patience`."""
    groups: Mapping[str, str] = field(default_factory=dict)
    """The group of an owner (host or person). An owner without an entry forms its own group."""


@dataclass(frozen=True, slots=True)
class SchedulingPolicy:
    """The options. The defaults are the paper's rules, and bounded waiting among equals under `adaptive`."""

    preempt: Preempt = "always"
    """`after_min_runtime`: only operators preempt a hold within its minimum runtime."""
    operator_priority: int = OPERATOR_PRIORITY
    """ARCs of this priority and above are an operator's: no other option delays them."""
    preempt_budget: float = PREEMPT_BUDGET
    """`adaptive`: once an ARC has lost this share of its minimum runtime to others, only operators preempt it."""
    patience: Ns | Literal["runtimes"] | None = "runtimes"
    """`adaptive`: when a waiting ARC is due, in ns (`reservations.py`); `runtimes`: by minimum runtimes; None:
    never."""
    promise: Promise = "equals"
    """ARCs that may not pass a due ARC. `equals`: those of equal and lower priority; `all`: all but operators. With
    `all`, only operators preempt the due ARC's hold within its minimum runtime."""
    max_running_per_host: int | None = None
    """ARCs that the clients of one host may have running at one time; None: any number."""
    max_runtime: Ns | None = None
    """Time in ns after which every hold ends as completed, kept or not, also an operator's; None: never. The hold of a
    booking lasts at least until the booking's end."""
    max_booking: Ns | None = None
    """The longest booking in ns; None: any."""
    rc_quotas: Mapping[str, tuple[RcQuota, ...]] = field(default_factory=dict)
    """By owner: the quotas that bind it."""
    barred: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """By owner: patterns of RCs that its ARCs never get."""
    fair_shares: FairShares | None = None
    """None: the order does not depend on owners."""


DEFAULT: Final = SchedulingPolicy()

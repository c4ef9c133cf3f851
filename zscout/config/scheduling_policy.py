"""What a fleet may choose about scheduling."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal, TypeAlias

from zscout.types import SECOND, Ns

PATIENCE: Final[Ns] = 142 * SECOND
"""In ns: the least where it follows the runtimes. Measured: docs/study.md."""
PREEMPT_BUDGET: Final = 0.25
"""Default. Measured: docs/scheduling.md."""
FAIR_PATIENCE: Final[Ns] = 3_600 * SECOND
"""Default, in ns."""
OPERATOR_PRIORITY: Final = 10

StrategyName: TypeAlias = Literal["priority", "optimal", "adaptive"]
Preempt: TypeAlias = Literal["always", "after_min_runtime"]
Promise: TypeAlias = Literal["equals", "all"]


@dataclass(frozen=True, slots=True)
class RcQuota:
    """How many RCs some owners (hosts and people) together may hold at one time."""

    name: str
    owners: frozenset[str]
    rcs: int


@dataclass(frozen=True, slots=True)
class FairShares:
    """Groups of equal priority in the order of what they lately had and others waited for (`fair_shares.py`)."""

    half_life: Ns
    """Time in ns after which a group is charged half of what it had."""
    weights: Mapping[str, float] = field(default_factory=dict)
    """By group: how much of what is contended is to be its, against the others' weights; 1 where nothing is said."""
    patience: Ns = FAIR_PATIENCE
    """In ns: that of the ARCs of groups that had more than another that waits. `SchedulingPolicy.patience` is that of
    the others."""
    groups: Mapping[str, str] = field(default_factory=dict)
    """By owner (host or person): its group. Any other is a group of its own."""


@dataclass(frozen=True, slots=True)
class SchedulingPolicy:
    """The knobs. The defaults are the paper's rules, and bounded waiting among equals under `adaptive`."""

    preempt: Preempt = "always"
    """`after_min_runtime`: nobody but an operator takes a hold before its minimum runtime is over."""
    operator_priority: int = OPERATOR_PRIORITY
    """ARCs of this priority and above are an operator's: no knob keeps them waiting."""
    preempt_budget: float = PREEMPT_BUDGET
    """`adaptive`: once an ARC has lost this part of its minimum runtime to others, only operators preempt it."""
    patience: Ns | Literal["runtimes"] | None = "runtimes"
    """`adaptive`: time in ns after which an ARC that waits is due (`reservations.py`); `runtimes`: it follows the
    minimum runtimes (`patience.py`); None: never."""
    promise: Promise = "equals"
    """The ARCs that may not pass a due ARC: those of equal and lower priority, or all but operators. With
    `all`, what a due ARC is granted at last is not preempted within its minimum runtime either."""
    max_running_per_host: int | None = None
    """ARCs that the clients of one host may have running at one time; None: any number."""
    max_runtime: Ns | None = None
    """Time in ns after which every hold ends as completed, kept or not, whoever's it is; None: never. The hold of a
    booking lasts until the booking's end at least."""
    max_booking: Ns | None = None
    """The longest booking in ns; None: any."""
    rc_quotas: Mapping[str, tuple[RcQuota, ...]] = field(default_factory=dict)
    """By owner: the quotas that bind it."""
    barred: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """By owner: patterns of the RCs that no need of its ARCs is bound to."""
    fair_shares: FairShares | None = None
    """None: whose an ARC is does not count."""


DEFAULT: Final = SchedulingPolicy()

"""The strategies by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final, Literal, TypeAlias

from zscout.scheduling import optimal, priority
from zscout.scheduling.adaptive import Adaptive
from zscout.scheduling.priority import Strategy

StrategyName: TypeAlias = Literal["priority", "optimal", "adaptive"]

STRATEGIES: Final[Mapping[StrategyName, Callable[[], Strategy]]] = {
    "priority": lambda: priority.run_pass,
    "optimal": lambda: optimal.run_pass,
    "adaptive": Adaptive,
}
"""Each makes a strategy for one core: `adaptive` keeps unfinished searches."""

"""The strategies by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

from zscout.scheduling import optimal, priority
from zscout.scheduling.adaptive import Adaptive
from zscout.scheduling.policy import StrategyName
from zscout.scheduling.priority import Strategy

STRATEGIES: Final[Mapping[StrategyName, Callable[[], Strategy]]] = {
    "priority": lambda: priority.run_pass,
    "optimal": lambda: optimal.run_pass,
    "adaptive": Adaptive,
}
"""Each makes a strategy for one core: `adaptive` keeps unfinished searches."""

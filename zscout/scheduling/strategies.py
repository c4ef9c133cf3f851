from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

from zscout.config.scheduling_policy import StrategyName
from zscout.scheduling.adaptive import Adaptive
from zscout.scheduling.optimal import Optimal
from zscout.scheduling.priority import Priority
from zscout.scheduling.state import Strategy

STRATEGIES: Final[Mapping[StrategyName, Callable[[], Strategy]]] = {
    "priority": Priority,
    "optimal": Optimal,
    "adaptive": Adaptive,
}
"""Factories: each core has its own strategy."""

"""What a fleet decides about placing: how hard it tries, and whether it moves what pays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from zscout.balancing.model import SECOND, Ns


@dataclass(frozen=True, slots=True)
class Rules:
    """Durations in ns."""

    start_timeout: Ns = 15 * SECOND
    """A start that says nothing for as long has failed."""
    restarts: int = 5
    """Starts in a row that fail soon, after which a component is given up."""
    back_off: Ns = SECOND // 2
    """Before the first restart of a component that failed soon; doubled each time."""
    longest_back_off: Ns = 30 * SECOND
    settled: Ns = 30 * SECOND
    """Who ran for as long begins to count its failures anew."""
    rebalance: bool = False
    """Whether running components are moved when that pays."""
    gain: float = 0.3
    """By how much better a component must run elsewhere, as a share of how it runs now, to be moved."""
    steady: Ns = 10 * SECOND
    """For how long it must have been so."""
    rest: Ns = 60 * SECOND
    """A component that was placed or moved stays for as long."""


DEFAULT_RULES: Final = Rules()

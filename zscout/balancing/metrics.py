"""What each metric makes of a host. The greater score is the better host, whatever the unit.

`load_average`, `processor_speed` and `available_memory` are the paper's (section 5). `composite` foretells
how fast the component would run there: a processor shared by all who want it, and a memory that must hold it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from zscout.balancing.model import Metric, Profile, Report

THRASHING: Final = 0.05
"""What a component keeps of its speed where memory is far too small for it."""
MEGABYTE: Final = 1_000_000


@dataclass(frozen=True, slots=True)
class Outlook:
    """A host as it will be: its report, and what was placed there and can't be seen in the report yet."""

    report: Report
    load: float
    """Processes that want a processor: the load average, and what it does not show yet."""
    memory: int
    """Bytes available when all that was placed has taken its own."""

    @property
    def load_per_core(self) -> float:
        return self.load / self.report.cores


def rate(outlook: Outlook, profile: Profile) -> float:
    """How fast a component of this profile would run: 1.0 is a core of speed 1.0 whenever it wants one."""
    report = outlook.report
    wanting = outlook.load + max(profile.wants(report.speed), 0.01)
    return report.speed * min(1.0, report.cores / wanting) * fits(outlook, profile)


def fits(outlook: Outlook, profile: Profile) -> float:
    """The share of its speed that a component keeps for want of memory: 1 where there is enough."""
    if profile.memory <= 0 or outlook.memory >= profile.memory:
        return 1.0
    return max(THRASHING, (max(0, outlook.memory) / profile.memory) ** 2)


def _load_average(outlook: Outlook, _: Profile) -> tuple[float, str]:
    return -outlook.load_per_core, f"load {outlook.load_per_core:.2f} a core"


def _processor_speed(outlook: Outlook, _: Profile) -> tuple[float, str]:
    return outlook.report.speed, f"speed {outlook.report.speed:.2f}"


def _available_memory(outlook: Outlook, _: Profile) -> tuple[float, str]:
    return float(outlook.memory), f"{outlook.memory / MEGABYTE:,.0f} MB available"


def _composite(outlook: Outlook, profile: Profile) -> tuple[float, str]:
    got = rate(outlook, profile)
    words = (
        f"would run at {got:.2f}: speed {outlook.report.speed:.2f}, load {outlook.load_per_core:.2f} a core, "
        f"{outlook.memory / MEGABYTE:,.0f} MB available"
    )
    return got, words


SCORES: Final[Mapping[Metric, Callable[[Outlook, Profile], tuple[float, str]]]] = {
    "load_average": _load_average,
    "processor_speed": _processor_speed,
    "available_memory": _available_memory,
    "composite": _composite,
}
"""All but `auto`, which chooses among them: the score, and it in words."""

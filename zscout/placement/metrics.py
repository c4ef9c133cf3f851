"""How each metric scores a host. The greater score is the better host, whatever the unit.

`load_average`, `processor_speed` and `available_memory` are the paper's (section 5). `composite` predicts
how fast the component would run there: a processor shared by all who want it, and a memory that must hold it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from zscout.placement.model import HostReport, Profile
from zscout.types import Metric

THRASHING: Final = 0.05
"""What a component keeps of its speed where memory is far too small for it."""
MEGABYTE: Final = 1_000_000
LEAST: Final = 0.01
"""Cores that any component wants."""


@dataclass(frozen=True, slots=True)
class Outlook:
    """A host as it will be: its report, and what was placed there and is not in the report yet."""

    report: HostReport
    load: float
    """Processes that want a processor: the load average, and what is not in it yet."""
    memory: int
    """Bytes available when all that was placed has taken its own."""

    @property
    def load_per_core(self) -> float:
        return self.load / self.report.cores


def rate(outlook: Outlook, profile: Profile) -> float:
    """How fast a component of this profile would run: 1.0 is a core of speed 1.0 whenever it wants one."""
    return rates([outlook], profile)[0]


def rates(outlooks: Sequence[Outlook], profile: Profile) -> list[float]:
    """Of thousands of hosts at once: `profile.wants` is inlined, as a call would cost more."""
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
        found.append(got if outlook.memory >= needed else got * fits(outlook, profile))
    return found


def fits(outlook: Outlook, profile: Profile) -> float:
    """The share of its speed that a component keeps for want of memory: 1 where there is enough."""
    if profile.memory <= 0 or outlook.memory >= profile.memory:
        return 1.0
    return max(THRASHING, (max(0, outlook.memory) / profile.memory) ** 2)


def _composite_words(outlook: Outlook, profile: Profile) -> str:
    return (
        f"would run at {rate(outlook, profile):.2f}: speed {outlook.report.speed:.2f}, "
        f"load {outlook.load_per_core:.2f} a core, {outlook.memory / MEGABYTE:,.0f} MB available"
    )


SCORES: Final[Mapping[Metric, Callable[[Sequence[Outlook], Profile], list[float]]]] = {
    "load_average": lambda outlooks, _: [-one.load_per_core for one in outlooks],
    "processor_speed": lambda outlooks, _: [one.report.speed for one in outlooks],
    "available_memory": lambda outlooks, _: [float(one.memory) for one in outlooks],
    "composite": rates,
}
"""All but `auto`, which chooses among them: the scores of these hosts."""

WORDS: Final[Mapping[Metric, Callable[[Outlook, Profile], str]]] = {
    "load_average": lambda outlook, _: f"load {outlook.load_per_core:.2f} a core",
    "processor_speed": lambda outlook, _: f"speed {outlook.report.speed:.2f}",
    "available_memory": lambda outlook, _: f"{outlook.memory / MEGABYTE:,.0f} MB available",
    "composite": _composite_words,
}
"""The same in words, for the hosts that are listed: they take longer than the scores."""

"""Units, amounts and identities shared by all rooms.

Times are whole nanoseconds (`Ns`) on one clock of the caller's choice. Bandwidth parameters are `Fraction`, so that
sums are exact (0.1 + 0.2 is 0.3)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from fractions import Fraction
from typing import Final, Literal, NamedTuple, TypeAlias

VERSION: Final = "0.3.0"
"""Also in pyproject.toml."""
ArcId: TypeAlias = str
"""Identifies a request while it is open; unique in the fleet. On the mesh `<host>/<client>/<id>`, where the client
chooses the id."""
ClientId: TypeAlias = str
"""Identifies a program that makes requests: `<host>/<client>` on the mesh."""
RcName: TypeAlias = str
"""`kind/name` of a resource controller."""
Need: TypeAlias = str
"""The name of an RC, or a pattern such as `framegrabber/*`, in a request."""
Ns: TypeAlias = int
"""Whole nanoseconds."""
Params: TypeAlias = Mapping[str, Fraction]
"""Bandwidth parameters of one ARC at one RC; only the RC knows what they mean."""
HostName: TypeAlias = str
ComponentId: TypeAlias = str
Kind: TypeAlias = str
"""Kind of a component: the name of an entry point of the group `zscout.components`."""

SECOND: Final[Ns] = 1_000_000_000

MAX_ROBOT: Final = 254
"""Greatest id of a robot on a radio: a byte whose value 255 means all robots."""
MAX_CHANNEL: Final = 15
"""Greatest video channel in a packet."""

Metric: TypeAlias = Literal["load_average", "processor_speed", "available_memory", "composite", "auto"]
Policy: TypeAlias = Literal["least_loaded", "randomized", "two_choices", "pending"]
METRICS: Final[tuple[Metric, ...]] = ("load_average", "processor_speed", "available_memory", "composite", "auto")
POLICIES: Final[tuple[Policy, ...]] = ("least_loaded", "randomized", "two_choices", "pending")


def clean(text: str) -> str:
    """Replace control characters in a text from another host by blanks: it stays on one line and can't draw."""
    return text if text.isprintable() else "".join(char if char.isprintable() else " " for char in text)


def span(seconds: float) -> str:
    """Format a duration for people: `0.4 s`, `12 s`, `3 min 5 s`, `2 h 4 min`, `3 d 2 h`."""
    seconds = max(0.0, seconds)
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    for big, small, big_unit, small_unit in ((86_400, 3600, "d", "h"), (3600, 60, "h", "min"), (60, 1, "min", "s")):
        if whole >= big:
            rest = whole % big // small
            return f"{whole // big} {big_unit}" + (f" {rest} {small_unit}" if rest else "")
    return f"{whole} s"


def whole_second(at: float) -> int:
    """The nearest second: the rounding of each date and time of day that people read, before its minute is taken."""
    return math.floor(at + 0.5)


class Term(NamedTuple):
    """One RCM's period of leadership: compared by counter, then by the RCM's instance."""

    counter: int
    rcm: str


NO_TERM = Term(0, "")


class Grant(NamedTuple):
    """Identity of a hold: its term and its number within the term. A later grant compares greater."""

    term: Term
    seq: int


class Place(NamedTuple):
    """Place in the queue: term and arrival number of the first request; smaller places go first."""

    term: Term
    arrival: int

"""Units, amounts and identities that all rooms share.

Times are whole nanoseconds (`Ns`) on one clock of the caller's choice. Bandwidth parameters are `Fraction`, so that
sums are exact (0.1 + 0.2 is 0.3)."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction
from typing import Final, Literal, NamedTuple, TypeAlias

VERSION: Final = "0.3.0"
"""This zscout's own; pyproject.toml has it as well."""
ArcId: TypeAlias = str
"""Identifies one request for as long as it lives; unique in the fleet. On the mesh `<host>/<client>/<id>`, of
which the client chooses the id."""
ClientId: TypeAlias = str
"""Identifies the program behind requests: `<host>/<client>` on the mesh."""
RcName: TypeAlias = str
"""`kind/name` of a resource controller."""
Need: TypeAlias = str
"""What a request asks for: the name of an RC, or a pattern such as `framegrabber/*`."""
Ns: TypeAlias = int
"""Whole nanoseconds."""
Params: TypeAlias = Mapping[str, Fraction]
"""Bandwidth parameters of one ARC at one RC; only the RC knows what they mean."""
HostName: TypeAlias = str
ComponentId: TypeAlias = str
Kind: TypeAlias = str
"""What is started: the name of an entry point of the group `zscout.components`."""

SECOND: Final[Ns] = 1_000_000_000

MAX_ROBOT: Final = 254
"""The greatest id of a robot on a radio: one byte, of which one value means all."""
MAX_CHANNEL: Final = 15
"""The greatest video channel that a packet can name."""

Metric: TypeAlias = Literal["load_average", "processor_speed", "available_memory", "composite", "auto"]
Policy: TypeAlias = Literal["least_loaded", "randomized", "two_choices", "pending"]
METRICS: Final[tuple[Metric, ...]] = ("load_average", "processor_speed", "available_memory", "composite", "auto")
POLICIES: Final[tuple[Policy, ...]] = ("least_loaded", "randomized", "two_choices", "pending")


def clean(text: str) -> str:
    """Words from another host, on one line, unable to draw on a terminal."""
    return text if text.isprintable() else "".join(char if char.isprintable() else " " for char in text)


def span(seconds: float) -> str:
    """A span of time as people read it: `0.4 s`, `12 s`, `3 min 5 s`, `2 h 4 min`, `3 d 2 h`."""
    seconds = max(0.0, seconds)
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    whole = round(seconds)
    for big, small, big_unit, small_unit in ((86_400, 3600, "d", "h"), (3600, 60, "h", "min"), (60, 1, "min", "s")):
        if whole >= big:
            rest = whole % big // small
            return f"{whole // big} {big_unit}" + (f" {rest} {small_unit}" if rest else "")
    return f"{whole} s"


class Term(NamedTuple):
    """The period in which one RCM leads: compared by counter, then by the RCM's instance."""

    counter: int
    rcm: str


NO_TERM = Term(0, "")


class Grant(NamedTuple):
    """Identity of one hold: the term it was given in and its number there. A later grant compares greater."""

    term: Term
    seq: int


class Place(NamedTuple):
    """Place in the queue: term and arrival number of the first request; the smaller goes first."""

    term: Term
    arrival: int

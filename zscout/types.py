"""Units, amounts and identities that all rooms share.

Times are whole nanoseconds (`Ns`) on one clock of the caller's choice. Bandwidth parameters are `Fraction`,
so that sums are exact (0.1 + 0.2 is 0.3); numbers from outside are bounded and made exact here before
anything is computed with them.
"""

from __future__ import annotations

from collections.abc import Mapping
from decimal import Decimal
from fractions import Fraction
from typing import Final, Literal, NamedTuple, TypeAlias

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
METRICS: Final[tuple[Metric, ...]] = (
    "load_average",
    "processor_speed",
    "available_memory",
    "composite",
    "auto",
)
POLICIES: Final[tuple[Policy, ...]] = ("least_loaded", "randomized", "two_choices", "pending")


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


MAX_DIGITS = 25
MAX_EXPONENT = 18
MAX_SECONDS = Decimal(10 * 366 * 86_400)


def exact(value: Decimal, what: str) -> Fraction:
    """A number that is not negative, exactly. Raises ValueError for NaN, infinity, and implausible sizes."""
    shown = str(value)[:40]
    if not value.is_finite():
        raise ValueError(f"{what} must be a number, not {shown}")
    if value < 0:
        raise ValueError(f"{what} must not be negative, and is {shown}")
    # A Fraction of 1e999999 would take all memory: look at the exponent before converting.
    if value and not -MAX_EXPONENT <= value.adjusted() <= MAX_EXPONENT:
        raise ValueError(f"{what} must lie between 1e-{MAX_EXPONENT} and 1e{MAX_EXPONENT}, and is {shown}")
    if len(value.as_tuple().digits) > MAX_DIGITS:
        raise ValueError(f"{what} has more than {MAX_DIGITS} digits")
    return Fraction(value)


def exact_amounts(params: Mapping[str, Decimal]) -> dict[str, Fraction]:
    """Bandwidth parameters, exactly. Raises ValueError."""
    return {name: exact(value, name) for name, value in params.items()}


def duration(value: Decimal, what: str) -> Ns:
    """A positive duration in seconds as whole ns, half to even. Raises ValueError."""
    exact(value, what)
    if value > MAX_SECONDS:
        raise ValueError(f"{what} must be at most {MAX_SECONDS} s (ten years), and is {value}")
    nanoseconds = round(value * SECOND)
    if nanoseconds <= 0:
        raise ValueError(f"{what} must be positive, and is {value}")
    return nanoseconds

"""Numbers from outside, made exact and bounded before anything is computed with them."""

from __future__ import annotations

from collections.abc import Mapping
from decimal import Decimal
from fractions import Fraction

from zscout.scheduling.model import SECOND, Ns

MAX_DIGITS = 25
MAX_EXPONENT = 18
MAX_SECONDS = Decimal(10 * 366 * 86_400)


def exact(value: Decimal, what: str) -> Fraction:
    """A number that is not negative, exactly. Raises ValueError for NaN, infinity, and absurd sizes."""
    said = str(value)[:40]
    if not value.is_finite():
        raise ValueError(f"{what} must be a number, not {said}")
    if value < 0:
        raise ValueError(f"{what} must not be negative, and is {said}")
    # A Fraction of 1e999999 would take all memory: look at the exponent before converting.
    if value and not -MAX_EXPONENT <= value.adjusted() <= MAX_EXPONENT:
        raise ValueError(f"{what} must lie between 1e-{MAX_EXPONENT} and 1e{MAX_EXPONENT}, and is {said}")
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

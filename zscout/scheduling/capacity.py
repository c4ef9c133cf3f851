"""Capacity check of sharable RCs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from fractions import Fraction

from zscout.types import ArcId, Params


def excess(capacity: Mapping[str, Fraction], holders: Iterable[tuple[ArcId, Params]]) -> str:
    """Explain why an RC of this capacity can't carry these holders; empty if it can. A parameter without a capacity is
    unbounded, a missing parameter counts 0; sums are exact."""
    totals: dict[str, Fraction] = {}
    for _, params in holders:
        for parameter, value in params.items():
            totals[parameter] = totals.get(parameter, Fraction(0)) + value
    over = [
        f"{parameter} would be {float(totals[parameter]):g} of {float(bound):g}"
        for parameter, bound in capacity.items()
        if totals.get(parameter, 0) > bound
    ]
    return ", ".join(over)

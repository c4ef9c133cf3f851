"""A workload: RCs, and the ARCs that come to ask for them. What replay and study feed the core."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction

from zscout.scheduling.model import ArcRequest
from zscout.types import (
    ArcId,
    Ns,
    Params,
    RcName,
)


@dataclass(frozen=True, slots=True)
class WorkloadRc:
    """An RC of a workload. A sharable one vetoes what exceeds its capacity; no capacity means no bound."""

    name: RcName
    sharable: bool = False
    capacity: Mapping[str, Fraction] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Arrival:
    """An ARC that asks at `at` ns."""

    at: Ns
    request: ArcRequest


@dataclass(frozen=True, slots=True)
class Workload:
    """RCs and arrivals; arrivals of one instant ask in the order given."""

    rcs: tuple[WorkloadRc, ...]
    arrivals: tuple[Arrival, ...]


def excess(capacity: Mapping[str, Fraction], holders: Iterable[tuple[ArcId, Params]]) -> str:
    """Why a sharable RC of this capacity can't carry these holders; empty if it can.

    A parameter without a capacity is unbounded, a missing one counts 0; sums are exact."""
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

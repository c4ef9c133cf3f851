"""Drivers of devices that need no control, so that a fleet can be described in TOML alone."""

from __future__ import annotations

from collections.abc import Mapping
from decimal import Decimal
from fractions import Fraction
from typing import Any, ClassVar, Self

from zscout.config.devices import CapacityRc, ExclusiveRc, VideoRc
from zscout.drivers.driver import Driver, RcHandle
from zscout.messages import Amounts, Figures, Holder, Parameter, ProposedHolder, exact, exact_amounts
from zscout.scheduling.capacity import excess
from zscout.types import SECOND


class ExclusiveDriver(Driver):
    Options: ClassVar[type] = ExclusiveRc

    def __init__(self, *, activation: float = 0.0) -> None:
        self.activation = activation

    @classmethod
    def configured(cls, options: Any) -> Self:
        return cls(activation=options.activation / SECOND)

    async def command(self, holder: Holder, do: Mapping[str, Any]) -> Any:
        """Supports `echo`, which returns its `value`."""
        if do.get("name") == "echo":
            return do.get("value")
        return await super().command(holder, do)

    def parameters(self) -> list[Parameter] | None:
        return []


class CapacityDriver(ExclusiveDriver):
    """A sharable device that accepts holders while no sum of a bandwidth parameter exceeds its capacity."""

    Options = CapacityRc
    sharable = True

    def __init__(self, capacity: Mapping[str, Fraction], *, activation: float = 0.0) -> None:
        super().__init__(activation=activation)
        self._capacity = dict(capacity)

    @classmethod
    def configured(cls, options: Any) -> Self:
        return cls(exact_amounts(options.capacity), activation=options.activation / SECOND)

    def vote(self, holders: list[ProposedHolder]) -> str:
        return excess(self._capacity, ((holder.id, exact_amounts(holder.params)) for holder in holders))

    def capacity(self) -> Amounts:
        return {name: Decimal(repr(float(bound))) for name, bound in self._capacity.items()}

    def parameters(self) -> list[Parameter]:
        return [Parameter(name, bound=bound, default=Decimal(0)) for name, bound in self.capacity().items()]


class VideoDriver(Driver):
    """A radio frequency: any number may receive, one may transmit. `transmitters`: 1 by default; 0 only receives."""

    Options = VideoRc
    sharable = True

    async def open(self, rc: RcHandle) -> None:
        self._rc = rc

    def vote(self, holders: list[ProposedHolder]) -> str:
        transmitting: list[ProposedHolder] = []
        for holder in holders:
            try:
                count = exact(holder.params.get("transmitters", Decimal(1)), "transmitters")
            except ValueError as error:
                return f"{holder.arc}: {error}"
            if count.denominator != 1:
                return f"{holder.arc}: transmitters is {float(count):g}; write 1, or 0 to listen only"
            if count > 1:
                return f"{holder.arc} would transmit {count} times on it; a frequency carries a single picture"
            if count:
                transmitting.append(holder)
        if len(transmitting) < 2:
            return ""
        now = {holder.id for holder in self._rc.holders()}
        already = sorted(holder.arc for holder in transmitting if holder.id in now)
        if already:
            return f"{' and '.join(already)} transmits on it already; two would spoil each other"
        arcs = sorted(holder.arc for holder in transmitting)
        return f"{', '.join(arcs[:-1])} and {arcs[-1]} would transmit on it; they would spoil each other"

    def capacity(self) -> Amounts:
        return {"transmitters": Decimal(1)}

    def parameters(self) -> list[Parameter]:
        return [Parameter("transmitters", bound=Decimal(1), default=Decimal(1))]

    def figures(self) -> Figures:
        held = self._rc.holders()
        silent = sum(holder.params.get("transmitters") == 0 for holder in held)
        return {"transmitters": float(len(held) - silent), "listeners": float(silent)}

"""Devices that need no driver of their own: a fleet can be described in TOML alone."""

from __future__ import annotations

from collections.abc import Mapping
from decimal import Decimal
from fractions import Fraction
from typing import Any

from zscout.drivers.driver import Driver
from zscout.messages import Amounts, Holder, ProposedHolder, exact_amounts
from zscout.scheduling.workload import excess


class ExclusiveDriver(Driver):
    """A device that needs no driver of its own to be shared: it is held, and nothing more."""

    def __init__(self, *, activation: float = 0.0) -> None:
        self.activation = activation

    async def command(self, holder: Holder, do: Mapping[str, Any]) -> Any:
        """Knows `echo`, which returns its `value`."""
        if do.get("name") == "echo":
            return do.get("value")
        return await super().command(holder, do)


class CapacityDriver(ExclusiveDriver):
    """A sharable device that carries holders as long as no bandwidth parameter's sum exceeds its bound."""

    sharable = True

    def __init__(self, capacity: Mapping[str, Fraction], *, activation: float = 0.0) -> None:
        super().__init__(activation=activation)
        self._capacity = dict(capacity)

    def vote(self, holders: list[ProposedHolder]) -> str:
        wanted = ((holder.id, exact_amounts(holder.params)) for holder in holders)
        return excess(self._capacity, wanted)

    def capacity(self) -> Amounts:
        return {name: Decimal(repr(float(bound))) for name, bound in self._capacity.items()}

"""A video channel: a frequency. Any number may listen, one may transmit."""

from __future__ import annotations

from collections.abc import Mapping
from decimal import Decimal

from zscout.drivers.driver import Driver, RcHandle
from zscout.messages import Amounts, Figures, Holder, ProposedHolder, exact


class VideoDriver(Driver):
    """The RC of a video channel. Bandwidth parameter: `transmitters`, 1 unless given; 0 only listens."""

    sharable = True

    def __init__(self) -> None:
        self._rc: RcHandle | None = None

    async def open(self, rc: RcHandle) -> None:
        self._rc = rc

    def vote(self, holders: list[ProposedHolder]) -> str:
        transmitting: list[ProposedHolder] = []
        for holder in holders:
            try:
                count = _transmitters(holder.params)
            except ValueError as error:
                return f"{holder.arc}: {error}"
            if count > 1:
                return f"{holder.arc} would transmit {count} times on it; one frequency carries one picture"
            if count:
                transmitting.append(holder)
        if len(transmitting) < 2:
            return ""
        now = {holder.id for holder in self._holders()}
        already = sorted(holder.arc for holder in transmitting if holder.id in now)
        if already:
            return f"{' and '.join(already)} transmits on it already; two would spoil each other"
        arcs = sorted(holder.arc for holder in transmitting)
        return f"{', '.join(arcs[:-1])} and {arcs[-1]} would transmit on it; they would spoil each other"

    def capacity(self) -> Amounts:
        return {"transmitters": Decimal(1)}

    def figures(self) -> Figures:
        held = self._holders()
        silent = sum(holder.params.get("transmitters") == 0 for holder in held)
        return {"transmitters": float(len(held) - silent), "listeners": float(silent)}

    def _holders(self) -> list[Holder]:
        return [] if self._rc is None else [held.holder for held in self._rc.holds.held.values()]


def _transmitters(params: Mapping[str, Decimal]) -> int:
    """How many transmitters a holder has on the channel. Raises ValueError with a reason in words."""
    count = exact(params.get("transmitters", Decimal(1)), "transmitters")
    if count.denominator != 1:
        raise ValueError(f"transmitters is {float(count):g}; write 1, or 0 to listen only")
    return int(count)

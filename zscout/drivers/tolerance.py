"""How long an RC that is not well keeps its holders, and is offered while free. Pure; time is passed in.

A device that stops answering may be rebooted by its holder's own test. Until the deadline its RC is *unwell*; from then
on it is lost. The time counts from when it became unwell, at the earliest from the beginning or the end of the hold."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any, Final, NamedTuple

from zscout.mesh import Refused
from zscout.types import SECOND, Grant, Ns

MAX_OUTAGE: Final = 86_400.0
"""Seconds that a client can announce."""


class _Expected(NamedTuple):
    """What a holder has announced: one outage that is over at a time, and how long each may last."""

    until: Ns = 0
    each: Ns = 0


class Tolerance:
    def __init__(self, held: Ns, free: Ns, most: Ns) -> None:
        """`most`: the longest outage that a holder can announce."""
        self._held, self._free, self._most = held, free, most
        self.why = ""
        """Empty while it is well."""
        self.since: Ns = 0
        """When it became unwell."""
        self._from: Ns = 0
        """When it was first held, or free, as it is now."""
        self._holds: dict[Grant, _Expected] = {}

    def unwell(self, why: str, now: Ns) -> None:
        if not self.why:
            self.since = now
        self.why = why

    def well(self) -> None:
        self.why = ""

    def changed(self, held: Collection[Grant], going_on: Mapping[Grant, Grant], now: Ns) -> None:
        """These grants are in force. `going_on`: by grant the one that it continues."""
        before = self._holds
        self._holds = {grant: before.get(going_on.get(grant, grant), _Expected()) for grant in held}
        if not any(going_on.get(grant, grant) in before for grant in held) and (before or held):
            self._from = now

    def expect(self, grant: Grant, do: Mapping[str, Any], now: Ns) -> float:
        """A holder announces an outage of `seconds`, or with `each` outages that each last as long at most. Return the
        seconds that are tolerated. Raises Refused."""
        seconds, each = do.get("seconds"), do.get("each", False)
        if isinstance(seconds, bool) or not isinstance(seconds, int | float) or not isinstance(each, bool):
            raise Refused("bad_command", "expect_outage needs seconds, as in seconds = 60; `each` is true or false")
        if not (math.isfinite(seconds) and 0 < seconds <= MAX_OUTAGE):
            raise Refused("bad_command", f"seconds must lie between 0 and {MAX_OUTAGE:g}")
        span, known = min(round(seconds * SECOND), self._most), self._holds.get(grant, _Expected())
        self._holds[grant] = known._replace(each=span) if each else known._replace(until=now + span)
        return span / SECOND

    @property
    def lost_at(self) -> Ns | None:
        """When it is lost unless it is well before; None while it is well."""
        if not self.why:
            return None
        begun = max(self.since, self._from)
        if not self._holds:
            return begun + self._free
        each = max(self._held, *(expected.each for expected in self._holds.values()))
        return max(begun + each, *(expected.until for expected in self._holds.values()))

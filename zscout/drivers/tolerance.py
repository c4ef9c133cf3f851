"""The time for which an unwell RC keeps its holders, or remains available while free. Pure; time is passed in.

A device that stops answering may be rebooting in its holder's own test. Its driver calls `RcHandle.unwell`. Until the
deadline the RC is *unwell*, afterwards lost. The time counts from the failure, or from the later begin or end of the
hold."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from typing import Any, Final, NamedTuple

from zscout.mesh import Refused
from zscout.types import SECOND, Grant, Ns

MAX_OUTAGE: Final = 86_400.0
"""Seconds that a client can announce."""


class _Expected(NamedTuple):
    """A holder's announced outages: a single outage that ends by `until`, and the longest duration of `each`."""

    until: Ns = 0
    each: Ns = 0


class Tolerance:
    def __init__(self, held: Ns, free: Ns, most: Ns) -> None:
        """Times tolerated while held and while free, and the longest outage that a holder can announce."""
        self._held, self._free, self._most = held, free, most
        self.why = ""
        """Empty while it is well."""
        self.since: Ns = 0
        """Time at which it became unwell."""
        self._from: Ns = 0
        """Time at which it was last granted or became free."""
        self._holds: dict[Grant, _Expected] = {}

    def unwell(self, why: str, now: Ns) -> None:
        if not self.why:
            self.since = now
        self.why = why

    def well(self) -> None:
        self.why = ""

    def changed(self, held: Collection[Grant], continued: Mapping[Grant, Grant], now: Ns) -> None:
        """Update the grants in force. `continued`: by grant, the earlier grant that it continues."""
        before = self._holds
        self._holds = {grant: before.get(continued.get(grant, grant), _Expected()) for grant in held}
        if not any(continued.get(grant, grant) in before for grant in held) and (before or held):
            self._from = now

    def expect(self, grant: Grant, do: Mapping[str, Any], now: Ns) -> float:
        """Note an outage of `seconds`, with `each` any number of them. Return the tolerated seconds. Raises Refused."""
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
        """Time at which it is lost unless it recovers; None while it is well."""
        if not self.why:
            return None
        begun = max(self.since, self._from)
        if not self._holds:
            return begun + self._free
        each = max(self._held, *(expected.each for expected in self._holds.values()))
        return max(begun + each, *(expected.until for expected in self._holds.values()))

"""The holds that end for maintenance, and the bookings in conflict with it."""

from __future__ import annotations

import sys
from collections.abc import Collection, Sequence
from typing import Any

from zscout.cli.booked import label, when_words
from zscout.cli.ownership import confirm
from zscout.cli.requests.waiting import comment, hold_json, hold_text, request_words
from zscout.keyexpr import host_in, is_pattern, matcher
from zscout.messages import BookedDate, BookingsTold, BookingView, HoldView, RcmState
from zscout.terminal import clean, clock, print_line, span


class Displaced:
    """Holds and bookings that maintenance of `needs` at this priority displaces. `spans`: its dates, by fleet time."""

    def __init__(
        self,
        needs: Collection[str],
        spans: Sequence[tuple[float, float]],
        priority: int,
        state: RcmState,
        answer: BookingsTold,
    ) -> None:
        self._priority = priority
        self.rcs = {view.rc for view in state.rcs if any(covers(need, view.rc, view.host) for need in needs)}
        self.ends: list[tuple[HoldView, float]] = []
        """Holds that end for it, with the seconds until then: its first date, or the end of the minimum runtime."""
        self.stays: list[HoldView] = []
        """Holds that it waits for."""
        before = max(0.0, min((start for start, _ in spans), default=answer.time) - answer.time)
        for hold in state.holds:
            if self.rcs.isdisjoint(hold.needs):
                continue
            if hold.keep and hold.priority <= priority:
                self.ends.append((hold, max(before, hold.remaining)))
            elif hold.keep or hold.remaining > before:
                self.stays.append(hold)
        self.bookings: list[tuple[BookingView, BookedDate]] = []
        """Bookings that lose dates, each with the first date it loses."""
        for booking in answer.bookings:
            if not booking.maintenance and booking.priority < priority:
                lost = (date for date in booking.dates if self._meets(booking, date, spans))
                self.bookings += [(booking, date) for date in lost][:1]

    def _meets(self, booking: BookingView, date: BookedDate, spans: Sequence[tuple[float, float]]) -> bool:
        at_one_time = any(start < date.end and date.start < end for start, end in spans)
        return at_one_time and not self.rcs.isdisjoint(date.bound.get(need, need) for need in booking.needs)

    def __bool__(self) -> bool:
        return bool(self.ends or self.bookings)

    def lines(self) -> list[str]:
        return [
            *(f"ends {self._words(hold)}, {_at(ends_in)}{comment(hold.who)}" for hold, ends_in in self.ends),
            *(f"waits for {hold_text(hold, self._priority)}: {self._rcs(hold)}" for hold in self.stays),
            *(f"takes from {label(booking)}: {when_words(booking, date, None)}" for booking, date in self.bookings),
        ]

    def _words(self, hold: HoldView) -> str:
        return f"{request_words(hold.arc, hold.who, hold.client)}, priority {hold.priority}: {self._rcs(hold)}"

    def _rcs(self, hold: HoldView) -> str:
        return ", ".join(sorted(self.rcs & hold.needs.keys()))

    def as_json(self) -> dict[str, Any]:
        return {
            "ends": [hold_json(hold) | {"ends_in": round(ends_in, 3)} for hold, ends_in in self.ends],
            "waits_for": list(map(hold_json, self.stays)),
            "bookings": [{"id": booking.id, "name": booking.name} for booking, _ in self.bookings],
        }

    async def agree(self, name: str, *, yes: bool) -> None:
        """Print the lines on stderr; ask if anything is displaced. Raises Failed: for a no; without a terminal, code
        2."""
        for line in self.lines():
            print_line(clean(f"{name} {line}"), sys.stderr)
        if self and not yes:
            unasked = "stdin is not a terminal, so I can't ask before displacing others; add --yes"
            await confirm(f"Put {', '.join(sorted(self.rcs))} in maintenance?", unasked, "nothing was booked", code=2)


def _at(seconds: float) -> str:
    return f"at {clock(seconds)} (in {span(seconds)})" if seconds > 0 else "at once"


def covers(need: str, rc: str, host: str) -> bool:
    return need == rc or (matcher(need)(rc) if is_pattern(need) else host_in(need) == host)

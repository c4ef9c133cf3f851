"""The leader's bookings, for the timeline. Pure; times are passed in."""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Iterator
from datetime import UTC, datetime
from typing import Final, TypeAlias

from zscout.messages import BookedDate, BookingsTold, BookingView
from zscout.services.recorder.ahead import Bar, chart, rows_of
from zscout.services.recorder.blueprint import AHEAD
from zscout.services.recorder.colours import ALERT, FAILED, MAINTENANCE
from zscout.services.recorder.drawing import Drawing

AGAIN: Final = 60.0
"""Seconds after which charts are redrawn without a change, as time passes."""
STALE: Final = 60.0
"""Seconds without an answer after which the charts are marked as outdated."""
MAX_EVENTS: Final = 50
"""Events caused by one answer."""
AHEAD_OF_NOW: Final = ("open", "taken", "conflict")
"""States of dates that are not over."""

Key: TypeAlias = tuple[str, int]
"""A booking's id, and the start of one of its dates."""
Dated: TypeAlias = tuple[BookingView, BookedDate]
Event: TypeAlias = tuple[str, str]
"""Text and level."""


class BookingTracker:
    """Draws bookings, and logs their changes as events; `colour` returns the RGBA of a name."""

    def __init__(self, drawing: Drawing, colour: Callable[[str], int]) -> None:
        self._drawing, self._colour = drawing, colour
        self.rows = 0
        """Rows of the charts; 0 without bookings."""
        self._bookings: list[BookingView] | None = None
        """None before the first answer."""
        self._zero = 0.0
        """Fleet time of second 0."""
        self._received = self._drawn = 0.0
        """Times of the last answer, and of the last drawing."""
        self._stale = False

    def take(self, at: float, answer: BookingsTold) -> None:
        self._received, self._zero = at, answer.time - at
        bookings = [booking for booking in answer.bookings if not booking.unbooked]
        if bookings != self._bookings:
            self._log_changes(at, bookings)
            self._bookings = bookings
            self._draw(at)

    def tick(self, at: float) -> None:
        """Called regularly."""
        if self._bookings is not None and (at - self._drawn >= AGAIN or (at - self._received > STALE) != self._stale):
            self._draw(at)

    def _draw(self, at: float) -> None:
        self._drawn, self._stale = at, at - self._received > STALE
        now = self._zero + (self._received if self._stale else at)
        bars = [bar for booking in self._bookings or () for bar in self._bars(booking, now)]
        self.rows = rows_of(bars, now)
        for ahead in AHEAD:
            for name, layer in chart(bars, now, ahead, self.rows, stale=self._stale).items():
                self._drawing.show(at, f"{ahead.entity}/{name}", layer.shape, **layer.fields)
        self._drawing.arrange()

    def _bars(self, booking: BookingView, now: float) -> Iterator[Bar]:
        """Yield a bar for each RC of each date within the charts."""
        latest = now + max(ahead.seconds for ahead in AHEAD)
        for date in booking.dates:
            if date.state not in AHEAD_OF_NOW or not (date.start < latest and now < date.end):
                continue
            colour = MAINTENANCE if booking.maintenance else self._colour(booking.name)
            kind = "broken" if booking.broken else "maintenance" if booking.maintenance else ""
            text = f"{kind}: {_named(booking)}" if kind else booking.name
            taken = date.state == "taken"
            if date.state == "conflict":
                colour, text = FAILED, f"{text}, in conflict"
            elif date.danger:
                colour, text = ALERT, f"{text}, in danger"
            elif taken:
                text = f"{text}, taken up"
            for rc in _rcs(booking, date):
                yield Bar(rc, date.start, date.end, text, colour, thick=taken, hatched=booking.maintenance)

    def _log_changes(self, at: float, bookings: list[BookingView]) -> None:
        """Log changes as events. The first answer gives only warnings: the rest did not happen now."""
        first, before, after = self._bookings is None, _dates(self._bookings or ()), _dates(bookings)
        known = {booking.id for booking in self._bookings or ()}
        words = [] if first else [_made(booking) for booking in bookings if booking.id not in known and booking.dates]
        words += [news for key, (booking, date) in after.items() for news in _news(booking, date, before.get(key))]
        words += _gone(
            [dated for key, dated in before.items() if key not in after],
            {booking.id for booking in bookings},
            self._zero + at,
        )
        for text, level in words[:MAX_EVENTS]:
            self._drawing.event(at, text, level)
        if len(words) > MAX_EVENTS:
            self._drawing.event(at, f"and {len(words) - MAX_EVENTS} more changes of bookings")


def _dates(bookings: Iterable[BookingView]) -> dict[Key, Dated]:
    return {
        (booking.id, date.start): (booking, date)
        for booking in bookings
        for date in booking.dates
        if date.state in AHEAD_OF_NOW
    }


def _made(view: BookingView) -> Event:
    if view.broken:
        return f"{', '.join(_rcs(view, view.dates[0]))} reported broken by {view.owner}: {_named(view)}", "WARN"
    again = "" if not view.every else ", and every day" if view.every == 1 else f", and every {view.every} days"
    return f"{_subject(view)} is made: {', '.join(_rcs(view, view.dates[0]))}, {_span(view.dates[0])}{again}", "INFO"


def _news(view: BookingView, date: BookedDate, before: Dated | None) -> Iterator[Event]:
    state, danger = ("open", "") if before is None else (before[1].state, before[1].danger)
    if date.state == "conflict" and (state, danger) != ("conflict", date.danger):
        yield f"{_subject(view)}, {_span(date)}, can't be: {date.danger or 'another takes precedence'}", "WARN"
    elif date.danger and date.danger != danger:
        yield f"{_subject(view)} may not start {_span(date)}: {date.danger}", "WARN"
    elif (state == "conflict" and date.state != state) or (danger and not date.danger):
        yield f"{_subject(view)}, {_span(date)}, stands again", "INFO"
    elif date.state == "taken" and before is not None and state != "taken":
        yield f"{_subject(view)} is taken up", "INFO"


def _gone(gone: Iterable[Dated], known: Container[str], now: float) -> Iterator[Event]:
    """Yield events of dates that disappeared, unless they were taken up. `known`: the present bookings."""
    given_up = set[str]()
    for view, date in gone:
        if date.state == "taken" or now >= date.end:
            continue
        if not view.maintenance and now >= date.start + float(view.patience):
            yield f"{_subject(view)} has lapsed: it was not taken up", "WARN"
        elif view.id in known:
            yield f"{_subject(view)}, {_span(date)}, is given up", "INFO"
        elif view.id not in given_up:
            given_up.add(view.id)
            rcs = ", ".join(_rcs(view, date))
            yield f"{rcs} no longer reported broken" if view.broken else f"{_subject(view)} is given up", "INFO"


def _rcs(booking: BookingView, date: BookedDate) -> list[str]:
    return booking.maintained or list(dict.fromkeys(date.bound.get(need, need) for need in booking.needs))


def _subject(booking: BookingView) -> str:
    owner = f" of {booking.owner}" if booking.owner else ""
    return f"{'maintenance' if booking.maintenance else 'booking'} {booking.name}{owner}"


def _named(booking: BookingView) -> str:
    """The comment of a report of broken devices, else the booking's name."""
    comment = booking.who.comment if booking.broken and booking.who is not None else ""
    return comment or booking.name


def _span(date: BookedDate) -> str:
    """`Fri 27 Nov, 10:00 to 11:30 UTC`."""
    start, end = (datetime.fromtimestamp(at, UTC) for at in (date.start, date.end))
    until = f"{end:%H:%M}" if start.date() == end.date() else f"{end:%a %d %b, %H:%M}"
    return f"{start:%a %d %b, %H:%M} to {until} UTC"

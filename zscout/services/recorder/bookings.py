"""Bookings as the leader tells of them, put together for the timeline: pure; times are passed in."""

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
"""Seconds until the charts are drawn anew though no booking has changed: now goes on."""
STALE: Final = 60.0
"""Seconds without word of bookings after which the charts show that."""
MAX_TOLD: Final = 50
"""Events that one answer may make."""
AHEAD_OF_NOW: Final = ("open", "taken", "conflict")
"""States of dates that are not over."""

Key: TypeAlias = tuple[str, int]
"""A booking's id, and when a date of it starts."""
Dated: TypeAlias = tuple[BookingView, BookedDate]
Event: TypeAlias = tuple[str, str]
"""Words and level."""


class BookingTracker:
    """Draws what is booked, and tells what changes; `colour` gives a name its RGBA."""

    def __init__(self, drawing: Drawing, colour: Callable[[str], int]) -> None:
        self._drawing, self._colour = drawing, colour
        self.rows = 0
        """That the charts take; 0: nothing is booked."""
        self._bookings: list[BookingView] | None = None
        """None: nobody has told yet."""
        self._zero = 0.0
        """Fleet time of second 0."""
        self._told = self._drawn = 0.0
        """When bookings were told last, and drawn."""
        self._stale = False

    def told(self, at: float, told: BookingsTold) -> None:
        """All bookings there are."""
        self._told, self._zero = at, told.time - at
        bookings = [one for one in told.bookings if not one.unbooked]
        if bookings != self._bookings:
            self._tell(at, bookings)
            self._bookings = bookings
            self._draw(at)

    def tick(self, at: float) -> None:
        """What time alone brings: call it now and then."""
        if self._bookings is not None and (at - self._drawn >= AGAIN or (at - self._told > STALE) != self._stale):
            self._draw(at)

    def _draw(self, at: float) -> None:
        self._drawn, self._stale = at, at - self._told > STALE
        now = self._zero + (self._told if self._stale else at)
        bars = [bar for one in self._bookings or () for bar in self._bars(one, now)]
        self.rows = rows_of(bars, now)
        for ahead in AHEAD:
            for name, layer in chart(bars, now, ahead, self.rows, stale=self._stale).items():
                self._drawing.show(at, f"{ahead.entity}/{name}", layer.shape, **layer.fields)
        self._drawing.arrange()

    def _bars(self, booking: BookingView, now: float) -> Iterator[Bar]:
        """One for each RC of each date that a chart may show."""
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

    # In words

    def _tell(self, at: float, bookings: list[BookingView]) -> None:
        """What is another than it was. At first only what people should look at: the rest did not happen now."""
        first, before, after = self._bookings is None, _dates(self._bookings or ()), _dates(bookings)
        known = {one.id for one in self._bookings or ()}
        words = [] if first else [_made(one) for one in bookings if one.id not in known and one.dates]
        words += [news for key, (one, date) in after.items() for news in _news(one, date, before.get(key))]
        words += _gone(
            [one for key, one in before.items() if key not in after], {one.id for one in bookings}, self._zero + at
        )
        for text, level in words[:MAX_TOLD]:
            self._drawing.event(at, text, level)
        if len(words) > MAX_TOLD:
            self._drawing.event(at, f"and {len(words) - MAX_TOLD} more changes of bookings")


def _dates(bookings: Iterable[BookingView]) -> dict[Key, Dated]:
    return {(one.id, date.start): (one, date) for one in bookings for date in one.dates if date.state in AHEAD_OF_NOW}


def _made(one: BookingView) -> Event:
    if one.broken:
        return f"{', '.join(_rcs(one, one.dates[0]))} reported broken by {one.owner}: {_named(one)}", "WARN"
    again = "" if not one.every else ", and every day" if one.every == 1 else f", and every {one.every} days"
    return f"{_subject(one)} is made: {', '.join(_rcs(one, one.dates[0]))}, {_span(one.dates[0])}{again}", "INFO"


def _news(one: BookingView, date: BookedDate, before: Dated | None) -> Iterator[Event]:
    state, danger = ("open", "") if before is None else (before[1].state, before[1].danger)
    if date.state == "conflict" and (state, danger) != ("conflict", date.danger):
        yield f"{_subject(one)}, {_span(date)}, can't be: {date.danger or 'another stands'}", "WARN"
    elif date.danger and date.danger != danger:
        yield f"{_subject(one)} may not start {_span(date)}: {date.danger}", "WARN"
    elif (state == "conflict" and date.state != state) or (danger and not date.danger):
        yield f"{_subject(one)}, {_span(date)}, stands again", "INFO"
    elif date.state == "taken" and before is not None and state != "taken":
        yield f"{_subject(one)} is taken up", "INFO"


def _gone(gone: Iterable[Dated], known: Container[str], now: float) -> Iterator[Event]:
    """Of dates that are told no more: who had taken one up is spoken of elsewhere. `known`: bookings that are there."""
    given_up = set[str]()
    for one, date in gone:
        if date.state == "taken" or now >= date.end:
            continue
        if not one.maintenance and now >= date.start + float(one.patience):
            yield f"{_subject(one)} has lapsed: nobody took it up", "WARN"
        elif one.id in known:
            yield f"{_subject(one)}, {_span(date)}, is given up", "INFO"
        elif one.id not in given_up:
            given_up.add(one.id)
            rcs = ", ".join(_rcs(one, date))
            yield f"{rcs} no longer reported broken" if one.broken else f"{_subject(one)} is given up", "INFO"


def _rcs(booking: BookingView, date: BookedDate) -> list[str]:
    return booking.maintained or list(dict.fromkeys(date.bound.get(need, need) for need in booking.needs))


def _subject(booking: BookingView) -> str:
    owner = f" of {booking.owner}" if booking.owner else ""
    return f"{'maintenance' if booking.maintenance else 'booking'} {booking.name}{owner}"


def _named(booking: BookingView) -> str:
    """The comment of a report of broken devices if it has one, else the booking's name."""
    comment = booking.who.comment if booking.broken and booking.who is not None else ""
    return comment or booking.name


def _span(date: BookedDate) -> str:
    """`Fri 27 Nov, 10:00 to 11:30 UTC`."""
    start, end = (datetime.fromtimestamp(at, UTC) for at in (date.start, date.end))
    until = f"{end:%H:%M}" if start.date() == end.date() else f"{end:%a %d %b, %H:%M}"
    return f"{start:%a %d %b, %H:%M} to {until} UTC"

"""From sightings, picture by picture, to events: when something moved, and where. Pure: time is passed in."""

from __future__ import annotations

from typing import Final, NamedTuple

from zscout.behaviors.perception.motion import MEMORY, Box, Seen

GAP: Final = 1.0
"""Seconds without motion that end an event; what moves again sooner goes on with it."""


class Event(NamedTuple):
    """A stretch of motion. Times are seconds of the clock by which the pictures came."""

    start: float
    """Of the first picture in which what moves was seen."""
    end: float
    """Of the last one."""
    peak: float
    """Of the picture in which it covered most."""
    boxes: tuple[Box, ...]
    """All that moved at the peak, largest first, in pixels of the source."""
    area: Box
    """Around all that moved from start to end."""
    frames: int
    """Pictures with motion."""
    going_on: bool = False
    """It was not over when the watch was."""


class EventTracker:
    """Takes what a MotionDetector sees. Each event comes back once, when it is over."""

    def __init__(self, gap: float = GAP) -> None:
        if not gap > 0:
            raise ValueError(f"a gap of {gap} s: it is above 0")
        self._gap = gap
        self._event: Event | None = None
        self._most = 0
        self._first: tuple[float, tuple[Box, ...]] | None = None
        """A sighting that the next picture may confirm."""

    @property
    def current(self) -> Event | None:
        """The event that is not over yet, as far as it goes."""
        return self._event

    def see(self, time: float, seen: Seen) -> Event | None:
        """Takes what was seen at `time`, which never goes back. The event that had ended before, if any."""
        ended = self.quiet(time)
        if not seen.moving:
            if seen.boxes and self._event is None and not self._recent(time):
                self._first = time, seen.boxes
            return ended
        if self._event is None:
            # What is certain only now began with the sighting that it confirms.
            start, boxes = self._first if self._first is not None and self._recent(time) else (time, ())
            frames = 1 if boxes else 0
            self._event = Event(start, time, time, seen.boxes, around((*boxes, *seen.boxes)), frames)
            self._most, self._first = -1, None
        area = sum(box.width * box.height for box in seen.boxes)
        if area > self._most:
            self._most = area
            self._event = self._event._replace(peak=time, boxes=seen.boxes)
        self._event = self._event._replace(
            end=time, area=around((self._event.area, *seen.boxes)), frames=self._event.frames + 1
        )
        return ended

    def quiet(self, time: float) -> Event | None:
        """No picture came until `time`. The event that is over by that, if any."""
        if self._event is None or time - self._event.end <= self._gap:
            return None
        return self._done()

    def close(self) -> Event | None:
        """The watch is over. The event that was going on, if any."""
        event = self._done()
        return event._replace(going_on=True) if event is not None else None

    def _done(self) -> Event | None:
        event, self._event, self._first = self._event, None, None
        return event

    def _recent(self, time: float) -> bool:
        return self._first is not None and time - self._first[0] <= MEMORY


def around(boxes: tuple[Box, ...]) -> Box:
    """The box around all of these; an empty one around none."""
    if not boxes:
        return Box(0, 0, 0, 0)
    left, top = min(box.x for box in boxes), min(box.y for box in boxes)
    right = max(box.x + box.width for box in boxes)
    return Box(left, top, right - left, max(box.y + box.height for box in boxes) - top)

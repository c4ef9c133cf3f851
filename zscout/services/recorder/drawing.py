"""Primitives of a recording: lanes of bars, curves, shapes that stay until they change, and events.

Names and texts come from the mesh: their number and length are bounded here, and characters that the viewer can't show
are replaced."""

from __future__ import annotations

import math
import os
import re
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence, Sized
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import rerun as rr

from zscout.messages import Who
from zscout.services.recorder.blueprint import TIME, WALL_TIME
from zscout.services.recorder.colours import OPERATOR, OTHER, PALE
from zscout.types import clean

ROOM: Final = 1 << 16
"""Bytes of free space below which a disk counts as full."""
MAX_SECONDS: Final = 9e9
"""Limit of times: Rerun counts nanoseconds in 64 bits."""
CURVE_TICK: Final = 5.0
"""Seconds for which points of curves are collected: a viewer needs time for each chunk, however small."""
MAX_SLOTS: Final = 8
"""Rows of one lane; further bars are counted in its last row."""
MAX_STATE: Final = 120
MAX_EVENT: Final = 500
"""Characters of a bar's text, and of an event."""
COMPONENT: Final = "component "
"""Prefix of the command of a request made by a component, not by a person."""
# Latin, Greek and Cyrillic letters, dashes, quotation marks, arrows. The viewer's font lacks other characters, and
# drawing such a character ends the viewer.
_UNKNOWN: Final = re.compile(
    "[^ -~\u00a1-\u0148\u014a-\u017f\u0391-\u03c9\u0400-\u045f"
    "\u2013\u2014\u2018\u2019\u201c\u201d\u2026\u20ac\u2190\u2192]"
)


class Drawing:
    """One recording on one timeline, written to each of `streams`. `at`: seconds, below MAX_SECONDS in size, else
    ValueError is raised. Once `closed`, nothing is written."""

    def __init__(self, *streams: rr.RecordingStream) -> None:
        self.streams = list(streams)
        self.epoch: float | None = None
        """Wall-clock time of second 0, as from `time.time()`; None if the timeline has durations."""
        self.closed = False
        self.begin, self.end = math.inf, -math.inf
        self._static: dict[str, tuple[rr.AsComponents, ...]] = {}
        """Static data logged, by entity."""
        self._shown: dict[str, tuple[Callable[..., rr.AsComponents], dict[str, Any]]] = {}
        """The present shape and its fields, by entity."""
        self._noted: set[str] = set()
        self._points: dict[str, list[tuple[float, float]]] = {}
        """Collected points (time and value), by entity."""
        self._gathered = math.inf
        """Time of the oldest collected point."""

    def log(self, at: float | None, entity: str, *what: rr.AsComponents) -> None:
        """Log at a time, or statically for all times if `at` is None."""
        if self.closed:
            return
        if at is not None:
            self._reaches(at)
        else:
            self._static[entity] = what
        for stream in self.streams:
            self._write(stream, at, entity, *what)

    def _reaches(self, at: float) -> None:
        if not abs(at) < MAX_SECONDS:
            raise ValueError(f"timeline: {at} is not a time in seconds; give a number below {MAX_SECONDS:g}")
        self.begin, self.end = min(self.begin, at), max(self.end, at)

    def point(self, at: float, entity: str, value: float) -> None:
        """Add a point to a curve; it may be written seconds later."""
        if self.closed:
            return
        self._reaches(at)
        self._points.setdefault(entity, []).append((at, value))
        self._gathered = min(self._gathered, at)
        self.pass_points(at)

    def pass_points(self, at: float = math.inf) -> None:
        """Write collected points if the oldest is CURVE_TICK seconds old at `at`."""
        if at - self._gathered < CURVE_TICK:
            return
        for entity, points in self._points.items():
            self.columns(entity, [at for at, _ in points], rr.Scalars.columns(scalars=[value for _, value in points]))
        self._points.clear()
        self._gathered = math.inf

    def columns(self, entity: str, times: Sequence[float], columns: rr.ComponentColumnList) -> None:
        """Log at many times as one chunk, without changing `begin` and `end`."""
        at = [time if self.epoch is None else self.epoch + time for time in times]
        index = rr.TimeColumn(TIME, duration=at) if self.epoch is None else rr.TimeColumn(WALL_TIME, timestamp=at)
        for stream in self.streams:
            stream.send_columns(entity, indexes=[index], columns=columns)

    def restate(self, stream: rr.RecordingStream, at: float) -> None:
        """Write the static data and the present shapes to a stream that starts at `at`."""
        for entity, what in self._static.items():
            self._write(stream, None, entity, *what)
        for entity, (shape, fields) in self._shown.items():
            self._write(stream, at, entity, _shaped(shape, fields))

    def _write(self, stream: rr.RecordingStream, at: float | None, entity: str, *what: rr.AsComponents) -> None:
        # Rerun keeps a time for each thread.
        if at is not None and self.epoch is None:
            stream.set_time(TIME, duration=at)
        elif at is not None and self.epoch is not None:
            stream.set_time(WALL_TIME, timestamp=self.epoch + at)
        stream.log(entity, *what, static=at is None)

    def show(self, at: float, entity: str, shape: Callable[..., rr.AsComponents], **fields: Any) -> None:
        """Show this shape at the entity from `at` on; erase it if its first field is empty."""
        if not next(iter(fields.values())):
            if entity in self._shown:
                self.erase(at, entity)
        elif self._shown.get(entity) != (shape, fields):
            self.show_again(at, entity, shape, **fields)

    def show_again(self, at: float, entity: str, shape: Callable[..., rr.AsComponents], **fields: Any) -> None:
        """Show a shape even if it has not changed."""
        self._shown[entity] = shape, fields
        self.log(at, entity, _shaped(shape, fields))

    def erase(self, at: float, entity: str) -> None:
        """End the entity's shape or curve: no line connects to the next point."""
        self._shown.pop(entity, None)
        self.log(at, entity, rr.Clear(recursive=False))

    def curve(self, entity: str, name: str, colour: int, width: float, **more: Any) -> None:
        self.log(None, entity, rr.SeriesLines(names=[clean_text(name)], colors=[colour], widths=[width], **more))

    def event(self, at: float, text: str, level: str = "INFO", *, operator: bool = False) -> None:
        """Log one line of text; `level` is one of Rerun's; `operator`: caused by an operator."""
        # Always a colour: without it the viewer takes the previous line's.
        colour = OPERATOR if operator else PALE
        self.log(at, "events", rr.TextLog(clean_text(text, MAX_EVENT), level=level, color=colour))

    def warn(self, at: float, text: str, *, operator: bool = False) -> None:
        self.event(at, text, "WARN", operator=operator)

    def presence(self, at: float, text: str, level: str = "INFO") -> None:
        """Log a change of presence, in a separate list, as these would bury the events."""
        self.log(at, "presence", rr.TextLog(clean_text(text, MAX_EVENT), level=level))

    def note(self, at: float, text: str) -> None:
        """Report once that something is left out."""
        if text not in self._noted:
            self._noted.add(text)
            self.warn(at, f"timeline: {text}")

    def room(self, at: float, known: Sized, limit: int, others: str) -> bool:
        """Return True if `known` may grow; if not, note that there are "more than `limit` `others`"."""
        if len(known) < limit:
            return True
        self.note(at, f"more than {limit} {others}")
        return False

    def arrange(self) -> None:
        """Called when there may be something new to lay out."""

    def flush(self, seconds: float) -> None:
        """Return when all is written. Raises RuntimeError or ValueError if that fails."""
        self.pass_points()
        for stream in self.streams:
            stream.flush(timeout_sec=seconds)


def unwritten(stream: rr.RecordingStream, path: Path, seconds: float) -> str:
    """Why data is not in the file after `seconds`; or "". Rerun's writer ends at its first error: only a flush shows
    it."""
    try:
        stream.flush(timeout_sec=seconds)
    except (RuntimeError, ValueError) as error:
        with suppress(OSError):
            found = os.statvfs(path)
            if found.f_bavail * found.f_frsize < ROOM:
                return f"{path} can't be written: its disk is full; free some"
        return f"{path} can't be written ({error}); name another place"
    return ""


def disconnect(stream: rr.RecordingStream, seconds: float) -> bool:
    """Return True if that took at most `seconds`. A hanging viewer can block it: then a daemon thread keeps waiting."""
    thread = threading.Thread(target=stream.disconnect, name="rerun-disconnect", daemon=True)
    thread.start()
    thread.join(seconds)
    return not thread.is_alive()


def _shaped(shape: Callable[..., rr.AsComponents], fields: dict[str, Any]) -> rr.AsComponents:
    if "colors" in fields:
        # Rerun would read a list of three or four numbers as a single colour.
        fields = fields | {"colors": np.array(fields["colors"], np.uint32)}
    return shape(**fields)


class HolderRow(NamedTuple):
    """A request that holds a device; `operator` is True for an operator's priority; `robots` are those of its gang."""

    arc: str
    operator: bool = False
    robots: tuple[str, ...] = ()


@dataclass(slots=True)
class _Lane:
    colours: dict[str, int] = field(default_factory=dict)
    """Colours by text, the least recently used first."""
    slots: list[str] = field(default_factory=list)
    """The name in each row, empty for a free row."""
    rows: int = 0
    """0 if only its past is known."""


class Lanes:
    """The lanes in one folder, at most `limit`; `others` ends the note that there are more. `colours`: texts of a lane
    that keep their colour; beyond it the least recently used loses its colour. `depth`: parts of a name, separated by
    `/`, that become parts of the entity. `slots`: the most rows of a lane."""

    def __init__(
        self,
        drawing: Drawing,
        folder: str,
        limit: int,
        others: str,
        *,
        colours: int = 256,
        depth: int = 4,
        slots: int = MAX_SLOTS,
    ) -> None:
        self._drawing, self._folder, self._limit, self._others = drawing, folder, limit, others
        self._colours, self._depth, self._slots = colours, depth, slots
        self._lanes: dict[str, _Lane] = {}
        """By entity: different names may be cleaned to the same."""

    @property
    def rows(self) -> int:
        return sum(lane.rows for lane in self._lanes.values())

    @property
    def entities(self) -> dict[str, int]:
        """Rows by entity, without lanes of which only the past is known."""
        return {entity: lane.rows for entity, lane in self._lanes.items() if lane.rows}

    @property
    def only_past(self) -> tuple[str, ...]:
        """Entities of which only the past is known."""
        return tuple(sorted(entity for entity, lane in self._lanes.items() if not lane.rows))

    def entity(self, name: str) -> str:
        return clean_path(self._folder, name, self._depth)

    def texts(self, name: str) -> Mapping[str, int] | None:
        """The texts with a colour in the lane of this name; None if there is no such lane."""
        lane = self._lanes.get(clean_path(self._folder, name, self._depth))
        return None if lane is None else lane.colours

    def show(self, at: float, name: str, shown: Mapping[str, tuple[str, int]]) -> None:
        """From `at` on, the lane shows exactly these: text and RGBA by the name of their subject. Each gets a row."""
        entity = clean_path(self._folder, name, self._depth)
        lane = self._lane(at, entity)
        if lane is None:
            return
        rows = [shown.get(row, (row, OTHER)) for row in _seat(lane, (name for name in shown if name), self._slots)]
        self._configure(entity, lane, rows)
        lane.rows = len(rows)
        self._drawing.show(at, entity, rr.StateChange, state=[text for text, _ in rows])

    def past(self, name: str, changes: Sequence[tuple[float, Sequence[tuple[str, int]]]]) -> None:
        """Draw the past of a lane, by time: text and RGBA of each row, an empty text for a free row."""
        entity = clean_path(self._folder, name, self._depth)
        lane = self._lane(0.0, entity)
        if lane is None or not changes:
            return
        self._configure(entity, lane, [row for _, rows in changes for row in rows])
        texts = [[text for text, _ in rows] for _, rows in changes]
        column = rr.StateChange.columns(state=[text for row in texts for text in row])
        self._drawing.columns(entity, [at for at, _ in changes], column.partition([len(row) for row in texts]))

    def _lane(self, at: float, entity: str) -> _Lane | None:
        """The lane of an entity; None if there are too many."""
        if entity not in self._lanes:
            if not self._drawing.room(at, self._lanes, self._limit, self._others):
                return None
            self._lanes[entity] = _Lane()
        return self._lanes[entity]

    def _configure(self, entity: str, lane: _Lane, rows: Iterable[tuple[str, int]]) -> None:
        news = [self._learn(lane, text, colour) for text, colour in rows if text]
        if any(news):
            colours = np.array(list(lane.colours.values()), np.uint32)
            self._drawing.log(None, entity, rr.StateConfiguration(values=list(lane.colours), colors=colours))

    def _learn(self, lane: _Lane, text: str, colour: int) -> bool:
        """Set a text's colour; return True if it is new to the viewer."""
        known = lane.colours.pop(text, None)
        lane.colours[text] = colour
        if len(lane.colours) > self._colours:
            del lane.colours[next(iter(lane.colours))]
        return known != colour


def _seat(lane: _Lane, names: Iterable[str], most: int) -> list[str]:
    """Names by row. Bars that stay keep their row, and the number of rows never decreases."""
    wanted = dict.fromkeys(names)
    crowded = len(wanted) > most
    rows = most - 1 if crowded else most
    slots = [name if name in wanted and row < rows else "" for row, name in enumerate(lane.slots)]
    for name in (name for name in wanted if name not in slots):
        if "" in slots[:rows]:
            slots[slots.index("")] = name
        elif len(slots) < rows:
            slots.append(name)
    lane.slots = slots
    if not crowded:
        return slots or [""]
    return [*slots[:rows], f"{len(wanted) - rows} more"]


def clean_path(folder: str, name: str, depth: int = 4) -> str:
    """The entity of a name with up to `depth` parts separated by `/`."""
    parts = (re.sub(r"[^A-Za-z0-9_.-]", "_", part)[:64] for part in name.split("/")[:depth])
    return f"/{folder}/{'/'.join(part or '_' for part in parts)}"


def with_person(name: str, who: Who | None) -> str:
    """A request's name with its person: `survey (alice)`."""
    if who is None or not (who.user or who.host) or who.command.startswith(COMPONENT):
        return name
    return f"{name} ({clean(who.user or who.host)})"


def with_detail(word: str, detail: str) -> str:
    """The text of a bar; empty without a word."""
    return clean_text(f"{word} · {detail}" if word and detail else word)


def clean_text(text: str, limit: int = MAX_STATE) -> str:
    """One line of at most `limit` characters; those missing in the viewer's font, which would end it, are replaced."""
    line = _UNKNOWN.sub("?", " ".join(clean(text[: 2 * limit]).split()))
    return line if len(line) <= limit else line[: limit - 1] + "…"

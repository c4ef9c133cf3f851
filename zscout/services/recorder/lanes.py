"""Lanes of a state timeline, and names and texts from the mesh made fit for Rerun."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from contextlib import AbstractContextManager
from functools import wraps
from typing import Concatenate, Final, ParamSpec, Protocol, TypeVar, cast

import numpy as np
import rerun as rr

MAX_SLOTS: Final = 8
"""Rows of one lane that shows several things; more of them are summed up in the last row."""
MAX_STATE: Final = 120
"""Characters."""
# Latin, Greek and Cyrillic letters, dashes, quotation marks, arrows. The viewer's font lacks others, and the
# viewer ends where it is to draw what its font lacks.
_UNKNOWN: Final = re.compile(
    "[^ -~\u00a1-\u0148\u014a-\u017f\u0391-\u03c9\u0400-\u045f"
    "\u2013\u2014\u2018\u2019\u201c\u201d\u2026\u20ac\u2190\u2192]"
)

P = ParamSpec("P")


class Writer(Protocol):
    """What writes to a recording at a time of its own."""

    def writing(self, at: float) -> AbstractContextManager[bool]:
        """Sets the time, in seconds; yields whether anything is written still."""


W = TypeVar("W", bound=Writer)


def written(method: Callable[Concatenate[W, float, P], None]) -> Callable[Concatenate[W, float, P], None]:
    """Runs the method at its time, and not at all once the recording is closed."""

    @wraps(method)
    def write(self: W, at: float, *args: P.args, **kwargs: P.kwargs) -> None:
        with self.writing(at) as open_still:
            if open_still:
                method(self, at, *args, **kwargs)

    return cast("Callable[Concatenate[W, float, P], None]", write)


class Lane:
    """One lane of a state timeline: what it shows, and the texts it has given a colour.

    `capacity`: distinct texts that keep their colour; past it, the one longest unused loses it."""

    def __init__(self, path: list[object], capacity: int) -> None:
        self.path = path
        self.capacity = capacity
        self.states: list[str] | None = None
        self.colours: dict[str, int] = {}
        """By text, the one longest unused first."""
        self.slots: list[str] = []
        """What each row shows, "" where it is free."""

    @property
    def rows(self) -> int:
        return len(self.states or [""])

    def seat(self, names: Iterable[str]) -> list[str]:
        """Names by row. Whoever stays keeps the row, so that no bar jumps; no row is taken away."""
        wanted = dict.fromkeys(names)
        crowded = len(wanted) > MAX_SLOTS
        rows = MAX_SLOTS - 1 if crowded else MAX_SLOTS
        self.slots = [name if name in wanted else "" for name in self.slots[:rows]] + [""] * len(
            self.slots[rows:]
        )
        for name in (name for name in wanted if name not in self.slots):
            if "" in self.slots[:rows]:
                self.slots[self.slots.index("")] = name
            elif len(self.slots) < rows:
                self.slots.append(name)
        if not crowded:
            return self.slots or [""]
        return [*self.slots[:rows], f"{len(wanted) - rows} more"]

    def show(self, recording: rr.RecordingStream, rows: list[tuple[str, int]]) -> None:
        """Logs text and colour (RGBA) of each row at the recording's time, where anything is new."""
        news = [self._learn(state, colour) for state, colour in rows if state]
        if any(news):
            configuration = rr.StateConfiguration(
                values=list(self.colours), colors=np.array(list(self.colours.values()), np.uint32)
            )
            recording.log(self.path, configuration, static=True)
        states = [state for state, _ in rows]
        if states != self.states:
            self.states = states
            recording.log(self.path, rr.StateChange(state=states))

    def _learn(self, state: str, colour: int) -> bool:
        """Whether the colour is new to the viewer."""
        known = self.colours.pop(state, None)
        self.colours[state] = colour
        if len(self.colours) > self.capacity:
            del self.colours[next(iter(self.colours))]
        return known != colour


def rows_of(lanes: Mapping[str, Lane]) -> int:
    """Rows of all these lanes."""
    return sum(lane.rows for lane in lanes.values())


def clean_path(folder: str, name: str, depth: int = 4) -> list[object]:
    """The entity of something with this name, which may have up to `depth` parts with `/` between."""
    parts = (re.sub(r"[^A-Za-z0-9_.-]", "_", part)[:64] for part in name.split("/")[:depth])
    return [*folder.split("/"), *(part or "_" for part in parts)]


def clean_text(text: str, limit: int = MAX_STATE) -> str:
    """One line of at most `limit` characters, of letters that the viewer has: one that it lacks ends it."""
    line = " ".join(text[: 2 * limit].split())
    line = "".join(
        letter if _UNKNOWN.match(letter) is None else "?" for letter in line if letter.isprintable()
    )
    return line if len(line) <= limit else line[: limit - 1] + "…"

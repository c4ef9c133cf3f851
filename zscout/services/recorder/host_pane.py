"""The hosts' part of the timeline: load curves with marks on them, what runs where, and what it uses.

Everything is logged at the time that the recording stands at. Entities are bounded, whatever is published.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple, TypeAlias

import rerun as rr

from zscout.services.recorder.blueprint import TIME
from zscout.services.recorder.colours import LINES, MARKS, OTHER, STATES
from zscout.services.recorder.lanes import (
    Lane,
    clean_path,
    clean_text,
    rows_of,
)

MAX_HOSTS: Final = 256
HOST_STATES: Final = 256
"""Distinct texts of one host's lane that keep their colour."""
MAX_CURVES: Final = 32
"""Components whose use is drawn at one time: the heaviest."""
MAX_DRAWN: Final = 256
"""Components that ever have curves, in one recording."""
HEAVIER: Final = 1.5
"""By this factor a component must be heavier than one that has curves to take its place."""
GIGABYTE: Final = 1e9
"""Bytes that weigh as much as one core."""
SMOOTHING: Final = 0.1
"""Part of a component's weight that is its last report's."""
SAME_MOMENT: Final = 1.0
"""Marks of one host within so many seconds stand above each other."""
MAX_STACK: Final = 10
SILENCE: Final = 10.0
"""Seconds without a report after which a load curve is interrupted."""

Mark: TypeAlias = Literal["placed", "restarted", "left", "came", "given_up"]


class Running(NamedTuple):
    """A component on a host. `state` is empty while it just runs; `ready` if it has begun to work."""

    component: str
    state: str = ""
    ready: bool = True


class Use(NamedTuple):
    """What a component uses: `cpu` in cores, `memory` in bytes."""

    component: str
    cpu: float
    memory: float

    @property
    def weight(self) -> float:
        return self.cpu + self.memory / GIGABYTE


@dataclass(slots=True)
class _Marked:
    """A host's latest marks: since when, how many, and how high they began."""

    at: float
    count: int
    height: float


class HostPane:
    """`note` logs once that something is left out; `colour` gives a component its RGBA."""

    def __init__(
        self,
        recording: rr.RecordingStream,
        note: Callable[[float, str], None],
        colour: Callable[[str], int],
    ) -> None:
        self._recording, self._note, self._colour = recording, note, colour
        self._loads: dict[str, float] = {}
        """The last load average, by host."""
        self._reported: dict[str, float] = {}
        """When it was reported."""
        self._peak = 1.0
        self._lanes: dict[str, Lane] = {}
        self._marked: dict[str, _Marked] = {}
        self._looks: set[Mark] = set()
        self._curves: dict[tuple[str, str], float] = {}
        """Weight of each component that has curves now, by host and component."""
        self._drawn: set[tuple[str, str]] = set()

    @property
    def rows(self) -> int:
        """Rows of all hosts' lanes."""
        return rows_of(self._lanes)

    def load(self, at: float, host: str, load1: float, cpu: float | None) -> None:
        if host not in self._loads:
            if len(self._loads) >= MAX_HOSTS:
                self._note(at, f"more than {MAX_HOSTS} hosts: the load of the others is not drawn")
                return
            line = rr.SeriesLines(
                names=[clean_text(host)], colors=[LINES[len(self._loads) % len(LINES)]], widths=[2.0]
            )
            self._loads[host] = 0.0
            for folder in ("load", "cpu"):
                self._recording.log(clean_path(folder, host), line, static=True)
        if at - self._reported.get(host, at) > SILENCE:
            self._break_off(at, host)
        self._reported[host] = at
        for folder, value in (("load", load1), ("cpu", cpu)):
            if value is not None and math.isfinite(value):
                self._recording.log(clean_path(folder, host), rr.Scalars(value))
        if math.isfinite(load1):
            self._loads[host] = load1
            self._peak = max(self._peak, load1)

    def _break_off(self, at: float, host: str) -> None:
        """Nobody knows what the load was while the host was silent: no line is drawn through that time."""
        self._recording.set_time(TIME, duration=self._reported[host] + SILENCE)
        for folder in ("load", "cpu"):
            self._recording.log(clean_path(folder, host), rr.Clear(recursive=False))
        self._recording.set_time(TIME, duration=at)

    def runs(self, at: float, host: str, components: Iterable[Running]) -> None:
        if host not in self._lanes and len(self._lanes) >= MAX_HOSTS:
            self._note(at, f"more than {MAX_HOSTS} hosts: what runs on the others is not shown")
            return
        lane = self._lanes.setdefault(host, Lane(clean_path("host", host), HOST_STATES))
        shown: dict[str, tuple[str, int]] = {"": ("", OTHER)}
        for one in components:
            text = clean_text(f"{one.component} · {one.state}" if one.state else one.component)
            colour = self._colour(one.component) if one.ready else STATES["waiting"]
            shown[one.component] = text, colour
        rows = lane.seat(name for name in shown if name)
        lane.show(self._recording, [shown.get(row, (row, OTHER)) for row in rows])

    def mark(self, at: float, host: str, mark: Mark, component: str) -> None:
        if mark not in self._looks:
            self._looks.add(mark)
            colour, marker = MARKS[mark]
            # Those of one name have one line in the legend.
            look = rr.SeriesPoints(
                names=["components"], colors=[colour], markers=[marker], marker_sizes=[7.0]
            )
            self._recording.log(["mark", mark], look, static=True)
        stack = self._marked.get(host)
        if stack is None or at - stack.at > SAME_MOMENT:
            if stack is None and len(self._marked) >= MAX_HOSTS:
                return
            stack = self._marked[host] = _Marked(at, 0, self._loads.get(host, 0.0))
        height = stack.height + 0.06 * self._peak * min(stack.count, MAX_STACK)
        stack.count += 1
        self._recording.log(
            ["mark", mark],
            rr.Scalars(height),
            rr.AnyValues(component=clean_text(component), host=clean_text(host)),
        )

    def uses(self, at: float, host: str, uses: Iterable[Use]) -> None:
        known = {
            use.component: use
            for use in uses
            if math.isfinite(use.weight) and use.cpu >= 0 and use.memory >= 0
        }
        for key in [key for key in self._curves if key[0] == host and key[1] not in known]:
            self._end_curve(key)
        for use in sorted(known.values(), key=lambda use: use.weight, reverse=True):
            key = host, use.component
            if key not in self._curves and not self._make_room(at, key, use.weight):
                continue
            weight = self._curves.get(key, use.weight)
            self._curves[key] = weight + SMOOTHING * (use.weight - weight)
            for path, value in zip(_paths(key), (use.cpu, use.memory / 1e6), strict=True):
                self._recording.log(path, rr.Scalars(value))

    def _make_room(self, at: float, key: tuple[str, str], weight: float) -> bool:
        """Whether a component may have curves from now on."""
        if key not in self._drawn and len(self._drawn) >= MAX_DRAWN:
            self._note(at, f"more than {MAX_DRAWN} components had curves: what others use is not drawn")
            return False
        if len(self._curves) >= MAX_CURVES:
            lightest = min(self._curves, key=self._curves.__getitem__)
            if weight < HEAVIER * self._curves[lightest]:
                return False
            self._end_curve(lightest)
        if key not in self._drawn:
            self._drawn.add(key)
            host, component = key
            line = rr.SeriesLines(
                names=[clean_text(f"{component}, {host}")], colors=[self._colour(component)], widths=[1.5]
            )
            for path in _paths(key):
                self._recording.log(path, line, static=True)
        return True

    def _end_curve(self, key: tuple[str, str]) -> None:
        """The line breaks off here, and does not go on to where it may be seen again."""
        del self._curves[key]
        for path in _paths(key):
            self._recording.log(path, rr.Clear(recursive=False))


def _paths(key: tuple[str, str]) -> tuple[list[object], list[object]]:
    host, component = (part.replace("/", "_") for part in key)
    name = f"{host}/{component}"
    return clean_path("use/cpu", name), clean_path("use/memory", name)

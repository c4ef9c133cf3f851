"""The hosts' part of the timeline: load curves with marks on them, what runs where, and what it uses."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple, TypeAlias

import rerun as rr

from zscout.services.recorder.colours import LINES, MARKS, STATES
from zscout.services.recorder.drawing import Drawing, Lanes, clean_path, clean_text, with_detail

MAX_HOSTS: Final = 256
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
class _Host:
    reported: float
    """When its load was."""
    load: float = 0.0


@dataclass(slots=True)
class _Marked:
    """A host's latest marks: since when, how many, and how high they began."""

    at: float
    count: int
    height: float


class HostPane:
    """Draws hosts; `colour` gives a component its RGBA."""

    def __init__(self, drawing: Drawing, colour: Callable[[str], int]) -> None:
        self._drawing, self._colour = drawing, colour
        self.lanes = Lanes(drawing, "host", MAX_HOSTS, "hosts: what runs on the others is not shown")
        self.placing = False
        """There are components, if only none now: a fleet without them has no use for empty panes."""
        self._hosts: dict[str, _Host] = {}
        self._peak = 1.0
        self._marked: dict[str, _Marked] = {}
        self._looks: set[Mark] = set()
        self._curves: dict[tuple[str, str], float] = {}
        """Weight of each component that has curves now, by host and component."""
        self._drawn: set[tuple[str, str]] = set()

    def load(self, at: float, host: str, load1: float, cpu: float | None = None) -> None:
        """A host's load average over 1 minute and, kept under `/cpu`, its CPU use (0 to 1).

        What is not a finite number leaves a gap."""
        entities = clean_path("load", host), clean_path("cpu", host)
        known = self._hosts.get(host)
        if known is None:
            others = "hosts: the load of the others is not drawn"
            if not self._drawing.room(at, self._hosts, MAX_HOSTS, others):
                return
            for entity in entities:
                self._drawing.curve(entity, host, LINES[len(self._hosts) % len(LINES)], 2.0)
            known = self._hosts[host] = _Host(at)
        if at - known.reported > SILENCE:
            # What the load was meanwhile is not known: no line is drawn through that time.
            for entity in entities:
                self._drawing.erase(known.reported + SILENCE, entity)
        known.reported = at
        for entity, value in zip(entities, (load1, cpu), strict=True):
            if value is not None and math.isfinite(value):
                self._drawing.log(at, entity, rr.Scalars(value))
        if math.isfinite(load1):
            known.load, self._peak = load1, max(self._peak, load1)

    def runs(self, at: float, host: str, components: Iterable[Running]) -> None:
        """From `at` on, exactly these components are on the host; none if empty. Each gets a row."""
        self.placing = True
        self._drawing.arrange()
        shown = dict[str, tuple[str, int]]()
        for one in components:
            colour = self._colour(one.component) if one.ready else STATES["waiting"]
            shown[one.component] = with_detail(one.component, one.state), colour
        self.lanes.show(at, host, shown)

    def mark(self, at: float, host: str, mark: Mark, component: str) -> None:
        """Marks on the host's load curve what happened to a component there."""
        entity = f"/mark/{mark}"
        if mark not in self._looks:
            self._looks.add(mark)
            colour, marker = MARKS[mark]
            # Those of one name have one line in the legend.
            look = rr.SeriesPoints(
                names=["components"], colors=[colour], markers=[marker], marker_sizes=[7.0]
            )
            self._drawing.log(None, entity, look)
        stack = self._marked.get(host)
        if stack is None or at - stack.at > SAME_MOMENT:
            if stack is None and len(self._marked) >= MAX_HOSTS:
                return
            known = self._hosts.get(host)
            stack = self._marked[host] = _Marked(at, 0, known.load if known is not None else 0.0)
        height = stack.height + 0.06 * self._peak * min(stack.count, MAX_STACK)
        stack.count += 1
        words = rr.AnyValues(component=clean_text(component), host=clean_text(host))
        self._drawing.log(at, entity, rr.Scalars(height), words)

    def uses(self, at: float, host: str, uses: Iterable[Use]) -> None:
        """What all components of a host use; the curve of one that is not named ends."""
        known = {
            use.component: use
            for use in uses
            if math.isfinite(use.weight) and use.cpu >= 0 and use.memory >= 0
        }
        for key in [key for key in self._curves if key[0] == host and key[1] not in known]:
            self._end_curve(at, key)
        for use in sorted(known.values(), key=lambda use: use.weight, reverse=True):
            key = host, use.component
            if key not in self._curves and not self._make_room(at, key, use.weight):
                continue
            weight = self._curves.get(key, use.weight)
            self._curves[key] = weight + SMOOTHING * (use.weight - weight)
            for entity, value in zip(_entities(key), (use.cpu, use.memory / 1e6), strict=True):
                self._drawing.log(at, entity, rr.Scalars(value))

    def _make_room(self, at: float, key: tuple[str, str], weight: float) -> bool:
        """Whether a component may have curves from now on."""
        others = "components had curves: what others use is not drawn"
        if key not in self._drawn and not self._drawing.room(at, self._drawn, MAX_DRAWN, others):
            return False
        if len(self._curves) >= MAX_CURVES:
            lightest = min(self._curves, key=self._curves.__getitem__)
            if weight < HEAVIER * self._curves[lightest]:
                return False
            self._end_curve(at, lightest)
        if key not in self._drawn:
            self._drawn.add(key)
            host, component = key
            for entity in _entities(key):
                self._drawing.curve(entity, f"{component}, {host}", self._colour(component), 1.5)
        return True

    def _end_curve(self, at: float, key: tuple[str, str]) -> None:
        del self._curves[key]
        for entity in _entities(key):
            self._drawing.erase(at, entity)


def _entities(key: tuple[str, str]) -> tuple[str, str]:
    name = "/".join(part.replace("/", "_") for part in key)
    return clean_path("use/cpu", name), clean_path("use/memory", name)

"""The floor's part of the timeline: a building's plan, who is where in it, and where robots came from.

Everything is logged at the time that the recording stands at, in pixels of the plan's picture.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Final, NamedTuple

import rerun as rr

from zscout.drivers.image_size import png_size
from zscout.services.recorder.colours import (
    ALERT,
    CAMERA,
    HIDDEN,
    IN_THE_OPEN,
    PALE,
    PERSON,
    bright,
    faded,
    rgba,
)
from zscout.services.recorder.lanes import clean_text

MIN_METRES: Final = 0.5
MAX_METRES: Final = 200.0
"""Of a building's width and depth."""
MAX_SIDE: Final = 4_096
"""Pixels of the plan's longer side."""
MARGIN: Final = 0.1
"""Part of a building's size by which something may stand outside and still be drawn."""
TRAIL: Final = 60.0
"""Seconds for which a robot's way is shown."""
TRAIL_STEP: Final = 0.5
"""Seconds between two points of it."""
MOVED: Final = 0.02
"""Metres; who moved less stands still."""
MAX_NAMED: Final = 12
"""Robots up to which each has its doing beside its name."""
MAX_TRAILS: Final = 256
ARROW: Final = 0.055
"""Length of a heading's arrow, as part of the building's longer side."""
SIGHT: Final = 0.13
"""Likewise, of a camera's field of view."""
VIEW: Final = math.radians(65)
"""A Scout's camera sees this wide."""
WIDE: Final = 0.2
LINE: Final = 0.055
"""Room that a name takes, likewise."""
MAX_STACK: Final = 6
"""Names that give way to each other in one place."""
RING: Final = 24
"""Corners of a circle."""

Spots = list[tuple[float, float]]


class RobotMark(NamedTuple):
    """A robot in the building: metres, radians; its colour says how it is, `words` what it does."""

    name: str
    x: float
    y: float
    heading: float
    camera: bool = False
    hidden: bool = False
    colour: int | None = None
    """RGBA, where its being hidden or not does not decide it."""
    words: str = ""
    alert: bool = False


class PersonMark(NamedTuple):
    name: str
    x: float
    y: float


class FloorPlan:
    """One building at a time."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._recording = recording
        self.size: tuple[int, int] | None = None
        """Of the plan's picture, in pixels; None before there is one."""
        self._metres = (1.0, 1.0)
        self._trails: dict[str, deque[tuple[float, float, float]]] = {}
        """Seconds, x and y in pixels, by robot."""
        self._drawn: dict[str, object] = {}
        """What was logged last, by entity."""

    def plan(self, width: float, depth: float, png: bytes) -> str:
        """Takes the plan of a building of `width` by `depth` metres; returns why not, or an empty text."""
        if not (MIN_METRES <= width <= MAX_METRES and MIN_METRES <= depth <= MAX_METRES):
            return f"it is {width:g} by {depth:g} m; a building has {MIN_METRES:g} to {MAX_METRES:g} m"
        size = png_size(png)
        if size is None:
            return "its plan is not a PNG picture"
        if max(size) > MAX_SIDE:
            return f"its plan is {size[0]} by {size[1]} pixels; {MAX_SIDE} a side are shown at most"
        self.clear()
        self.size, self._metres = size, (width, depth)
        # Static: a server that forgets its oldest data for want of memory must keep the plan.
        image = rr.EncodedImage(contents=png, media_type="image/png", draw_order=-20.0)
        self._recording.log("floor/plan", image, static=True)
        return ""

    def clear(self) -> None:
        """Nobody is known to be anywhere; the plan stays."""
        for entity in list(self._drawn):
            self._erase(entity)
        self._trails.clear()

    def show(
        self, at: float, robots: Sequence[RobotMark], people: Sequence[PersonMark], caption: str
    ) -> None:
        """Where all are from now on; nothing before there is a plan. Who is far outside is left out."""
        if self.size is None:
            return
        inside = [robot for robot in robots if self._is_near(robot.x, robot.y)]
        walking = [person for person in people if self._is_near(person.x, person.y)]
        self._follow(at, inside)
        self._robots(inside)
        self._people(walking)
        self._names(inside, walking)
        words = clean_text(caption)
        middle = [(self.size[0] / 2, 0.0)]
        self._draw(
            "floor/caption",
            words or None,
            lambda: rr.Points2D(middle, radii=[0.0], colors=[PALE], labels=[words], show_labels=True),
        )

    def _robots(self, robots: Sequence[RobotMark]) -> None:
        spots = [self._pixel(robot.x, robot.y) for robot in robots]
        colours = [_colour(robot) for robot in robots]
        self._draw(
            "floor/robots",
            (spots, colours) if robots else None,
            lambda: rr.Points2D(spots, radii=[-7.0], colors=rgba(colours), draw_order=30.0),
        )
        vectors = [self._vector(robot.heading, ARROW) for robot in robots]
        self._draw(
            "floor/headings",
            (spots, vectors, colours) if robots else None,
            lambda: rr.Arrows2D(
                origins=spots, vectors=vectors, colors=rgba(colours), radii=[-1.5], draw_order=25.0
            ),
        )
        views = [self._view(robot) for robot in robots if robot.camera]
        self._draw(
            "floor/views",
            views or None,
            lambda: rr.LineStrips2D(views, colors=[faded(CAMERA, 0.8)], radii=[-1.0], draw_order=10.0),
        )
        rings = [self._ring(robot.x, robot.y) for robot in robots if robot.alert]
        self._draw(
            "floor/alerts",
            rings or None,
            lambda: rr.LineStrips2D(rings, colors=[ALERT], radii=[-2.5], draw_order=20.0),
        )

    def _people(self, people: Sequence[PersonMark]) -> None:
        spots = [self._pixel(person.x, person.y) for person in people]
        self._draw(
            "floor/people",
            spots or None,
            lambda: rr.Points2D(spots, radii=[-9.0], colors=[PERSON], draw_order=15.0),
        )

    def _names(self, robots: Sequence[RobotMark], people: Sequence[PersonMark]) -> None:
        """Apart from the points: a text must be brighter, and gives way to one that it would cover."""
        in_full = len(robots) <= MAX_NAMED
        words = [f"{one.name} · {one.words}" if one.words and in_full else one.name for one in robots]
        names = [clean_text(word) for word in (*words, *(person.name for person in people))]
        colours = [bright(colour) for colour in (*map(_colour, robots), *(PERSON for _ in people))]
        places: Spots = []
        for place in [*((one.x, one.y) for one in robots), *((one.x, one.y) for one in people)]:
            x, y = self._pixel(*place)
            for _ in range(MAX_STACK):
                if not any(
                    abs(x - left) < WIDE * self._longer and abs(y - top) < LINE * self._longer
                    for left, top in places
                ):
                    break
                y += LINE * self._longer
            places.append((x, round(y, 1)))
        self._draw(
            "floor/names",
            (places, names, colours) if names else None,
            lambda: rr.Points2D(
                places, radii=[0.0], colors=rgba(colours), labels=names, show_labels=True, draw_order=40.0
            ),
        )

    def _follow(self, at: float, robots: Sequence[RobotMark]) -> None:
        step = MOVED * self._scale
        for robot in robots:
            if robot.name not in self._trails and len(self._trails) >= MAX_TRAILS:
                continue
            trail = self._trails.setdefault(robot.name, deque(maxlen=round(TRAIL / TRAIL_STEP)))
            x, y = self._pixel(robot.x, robot.y)
            if not trail or (at - trail[-1][0] >= TRAIL_STEP and math.dist(trail[-1][1:], (x, y)) >= step):
                trail.append((at, x, y))
        colours = {robot.name: _colour(robot) for robot in robots}
        strips: list[Spots] = []
        shades: list[int] = []
        for name in list(self._trails):
            trail = self._trails[name]
            while trail and at - trail[0][0] > TRAIL:
                trail.popleft()
            if not trail:
                del self._trails[name]
            elif len(trail) > 1 and name in colours:
                strips.append([(x, y) for _, x, y in trail])
                shades.append(faded(colours[name], 0.55))
        self._draw(
            "floor/trails",
            (strips, shades) if strips else None,
            lambda: rr.LineStrips2D(strips, colors=rgba(shades), radii=[-1.0], draw_order=5.0),
        )

    def _draw(self, entity: str, what: object, shape: Callable[[], rr.AsComponents]) -> None:
        """Logs what differs from what was logged last; None takes it away."""
        if self._drawn.get(entity) == what:
            return
        if what is None:
            self._erase(entity)
        else:
            self._drawn[entity] = what
            self._recording.log(entity, shape())

    def _erase(self, entity: str) -> None:
        del self._drawn[entity]
        self._recording.log(entity, rr.Clear(recursive=False))

    # From metres to pixels

    @property
    def _scale(self) -> float:
        """Pixels of a metre."""
        assert self.size is not None  # noqa: S101
        return self.size[0] / self._metres[0]

    @property
    def _longer(self) -> float:
        assert self.size is not None  # noqa: S101
        return float(max(self.size))

    def _is_near(self, x: float, y: float) -> bool:
        width, depth = self._metres
        return -MARGIN * width <= x <= (1 + MARGIN) * width and -MARGIN * depth <= y <= (1 + MARGIN) * depth

    def _pixel(self, x: float, y: float) -> tuple[float, float]:
        """The plan's rows begin at the largest y."""
        assert self.size is not None  # noqa: S101
        (width, height), (metres_x, metres_y) = self.size, self._metres
        return round(x * width / metres_x, 1), round((metres_y - y) * height / metres_y, 1)

    def _vector(self, heading: float, part: float) -> tuple[float, float]:
        length = part * self._longer
        return round(length * math.cos(heading), 1), round(-length * math.sin(heading), 1)

    def _view(self, robot: RobotMark) -> Spots:
        x, y = self._pixel(robot.x, robot.y)
        ends = [self._vector(robot.heading + turn * VIEW / 8, SIGHT) for turn in range(-4, 5)]
        return [(x, y), *((x + dx, y + dy) for dx, dy in ends), (x, y)]

    def _ring(self, x: float, y: float) -> Spots:
        left, top = self._pixel(x, y)
        return [(left + dx, top + dy) for dx, dy in self._circle()]

    def _circle(self) -> Iterator[tuple[float, float]]:
        for corner in range(RING + 1):
            yield self._vector(2 * math.pi * corner / RING, ARROW)


def _colour(robot: RobotMark) -> int:
    if robot.colour is not None:
        return robot.colour
    return HIDDEN if robot.hidden else IN_THE_OPEN

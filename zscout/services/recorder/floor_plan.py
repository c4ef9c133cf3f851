"""The floor's part of the timeline: a building's plan, who is where in it, and where robots came from.

Drawn in pixels of the plan's picture.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple

import rerun as rr

from zscout.drivers.image_size import png_size
from zscout.services.recorder.colours import ALERT, CAMERA, HIDDEN, IN_THE_OPEN, PALE, PERSON, bright, faded
from zscout.services.recorder.drawing import Drawing, clean_text

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

Spot = tuple[float, float]


class Layer(NamedTuple):
    """How one kind of thing on the plan is drawn."""

    shape: Callable[..., rr.AsComponents]
    field: str
    """Of the shape: where it is."""
    radius: float
    """Below 0: in points of the screen, whatever the zoom."""
    order: float | None = None
    """A layer of a higher one covers it."""


LAYERS: Final = {
    "trails": Layer(rr.LineStrips2D, "strips", -1.0, 5.0),
    "views": Layer(rr.LineStrips2D, "strips", -1.0, 10.0),
    "people": Layer(rr.Points2D, "positions", -9.0, 15.0),
    "alerts": Layer(rr.LineStrips2D, "strips", -2.5, 20.0),
    "headings": Layer(rr.Arrows2D, "vectors", -1.5, 25.0),
    "robots": Layer(rr.Points2D, "positions", -7.0, 30.0),
    "names": Layer(rr.Points2D, "positions", 0.0, 40.0),
    "caption": Layer(rr.Points2D, "positions", 0.0),
}
"""By entity below `floor`."""


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

    @property
    def shade(self) -> int:
        if self.colour is not None:
            return self.colour
        return HIDDEN if self.hidden else IN_THE_OPEN


class PersonMark(NamedTuple):
    name: str
    x: float
    y: float


class FloorPlan:
    """One building at a time."""

    def __init__(self, drawing: Drawing) -> None:
        self._drawing = drawing
        self.size: tuple[int, int] | None = None
        """Of the plan's picture, in pixels; None before there is one."""
        self._metres = (1.0, 1.0)
        self._longer = 1.0
        self._trails: dict[str, deque[tuple[float, Spot]]] = {}
        """Seconds and place, by robot."""

    def plan(self, at: float, width: float, depth: float, png: bytes) -> str:
        """Takes the plan of a building of `width` by `depth` metres; returns why not, or an empty text."""
        if not (MIN_METRES <= width <= MAX_METRES and MIN_METRES <= depth <= MAX_METRES):
            return f"it is {width:g} by {depth:g} m; a building has {MIN_METRES:g} to {MAX_METRES:g} m"
        size = png_size(png)
        if size is None:
            return "its plan is not a PNG picture"
        if max(size) > MAX_SIDE:
            return f"its plan is {size[0]} by {size[1]} pixels; {MAX_SIDE} a side are shown at most"
        self.clear(at)
        self.size, self._longer = size, float(max(size))
        self._metres = width, depth
        # For all times: a server that forgets its oldest data for want of memory must keep the plan.
        image = rr.EncodedImage(contents=png, media_type="image/png", draw_order=-20.0)
        self._drawing.log(None, "/floor/plan", image)
        return ""

    def clear(self, at: float) -> None:
        """From `at` on, it is not known where anybody is; the plan stays."""
        for layer in LAYERS:
            self._draw(at, layer, [], [])
        self._trails.clear()

    def show(
        self, at: float, robots: Sequence[RobotMark], people: Sequence[PersonMark], caption: str
    ) -> None:
        """Where all are from `at` on; nothing before there is a plan. Who is far outside is left out."""
        if self.size is None:
            return
        robots = [robot for robot in robots if self._is_near(robot)]
        people = [person for person in people if self._is_near(person)]
        spots = [self._pixel(robot) for robot in robots]
        walkers = [self._pixel(person) for person in people]
        shades = [robot.shade for robot in robots]
        self._draw_trails(at, robots, spots)
        self._draw(at, "robots", spots, shades)
        vectors = [self._vector(robot.heading, ARROW) for robot in robots]
        self._draw(at, "headings", vectors, shades, origins=spots)
        seen = [
            [spot, *(self._beside(spot, one.heading + turn * VIEW / 8, SIGHT) for turn in range(-4, 5)), spot]
            for one, spot in zip(robots, spots, strict=True)
            if one.camera
        ]
        self._draw(at, "views", seen, [faded(CAMERA, 0.8)])
        rings = [
            [self._beside(spot, math.tau * corner / RING, ARROW) for corner in range(RING + 1)]
            for one, spot in zip(robots, spots, strict=True)
            if one.alert
        ]
        self._draw(at, "alerts", rings, [ALERT])
        self._draw(at, "people", walkers, [PERSON])
        # Names stand apart from the points: a text must be brighter.
        in_full = len(robots) <= MAX_NAMED
        names = [f"{one.name} · {one.words}" if one.words and in_full else one.name for one in robots]
        texts = [clean_text(name) for name in (*names, *(person.name for person in people))]
        colours = [bright(colour) for colour in (*shades, *(PERSON for _ in people))]
        places = self._places([*spots, *walkers])
        self._draw(at, "names", places, colours, labels=texts, show_labels=True)
        words = clean_text(caption)
        middle = [(self.size[0] / 2, 0.0)] if words else []
        self._draw(at, "caption", middle, [PALE], labels=[words], show_labels=True)

    def _draw(self, at: float, layer: str, what: Sequence[Any], colours: list[int], **more: Any) -> None:
        shape, field, radius, order = LAYERS[layer]
        fields = {field: what, "colors": colours, "radii": [radius], "draw_order": order}
        self._drawing.show(at, f"/floor/{layer}", shape, **fields, **more)

    def _places(self, spots: Sequence[Spot]) -> list[Spot]:
        """Where names stand: each gives way to one that it would cover."""
        wide, line = WIDE * self._longer, LINE * self._longer
        places: list[Spot] = []
        for x, y in spots:
            for _ in range(MAX_STACK):
                if not any(abs(x - left) < wide and abs(y - top) < line for left, top in places):
                    break
                y += line
            places.append((x, round(y, 1)))
        return places

    def _draw_trails(self, at: float, robots: Sequence[RobotMark], spots: Sequence[Spot]) -> None:
        assert self.size is not None  # noqa: S101
        step = MOVED * self.size[0] / self._metres[0]
        for robot, spot in zip(robots, spots, strict=True):
            if robot.name not in self._trails and len(self._trails) >= MAX_TRAILS:
                continue
            trail = self._trails.setdefault(robot.name, deque(maxlen=round(TRAIL / TRAIL_STEP)))
            if not trail or (at - trail[-1][0] >= TRAIL_STEP and math.dist(trail[-1][1], spot) >= step):
                trail.append((at, spot))
        for name, trail in list(self._trails.items()):
            while trail and at - trail[0][0] > TRAIL:
                trail.popleft()
            if not trail:
                del self._trails[name]
        colours = {robot.name: robot.shade for robot in robots}
        shown = [name for name, trail in self._trails.items() if len(trail) > 1 and name in colours]
        strips = [[spot for _, spot in self._trails[name]] for name in shown]
        self._draw(at, "trails", strips, [faded(colours[name], 0.55) for name in shown])

    # From metres to pixels

    def _is_near(self, one: RobotMark | PersonMark) -> bool:
        width, depth = self._metres
        return (
            -MARGIN * width <= one.x <= (1 + MARGIN) * width
            and -MARGIN * depth <= one.y <= (1 + MARGIN) * depth
        )

    def _pixel(self, one: RobotMark | PersonMark) -> Spot:
        """The plan's rows begin at the largest y."""
        assert self.size is not None  # noqa: S101
        (width, height), (metres_x, metres_y) = self.size, self._metres
        return round(one.x * width / metres_x, 1), round((metres_y - one.y) * height / metres_y, 1)

    def _vector(self, heading: float, part: float) -> Spot:
        length = part * self._longer
        return round(length * math.cos(heading), 1), round(-length * math.sin(heading), 1)

    def _beside(self, spot: Spot, heading: float, part: float) -> Spot:
        dx, dy = self._vector(heading, part)
        return spot[0] + dx, spot[1] + dy

"""The floor's part of the timeline: a building's plan with robots, people and trails, in pixels of its picture."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

import rerun as rr

from zscout.drivers.image_size import png_size
from zscout.keyexpr import Sender
from zscout.messages import BuildingPlan, BuildingPoses, Placed
from zscout.services.recorder.colours import ALERT, CAMERA, HIDDEN, IN_THE_OPEN, PALE, PERSON, bright, faded
from zscout.services.recorder.drawing import Drawing, clean_text

MIN_METRES: Final = 0.5
MAX_METRES: Final = 200.0
"""Limit of a building's width and depth."""
MAX_SIDE: Final = 4_096
"""Pixels of the plan's longer side."""
MARGIN: Final = 0.1
"""Share of a building's size within which objects outside are still drawn."""
TRAIL: Final = 60.0
"""Seconds of a robot's trail."""
TRAIL_STEP: Final = 0.5
"""Seconds between two points of a trail."""
MOVED: Final = 0.02
"""Metres of movement that add a point to a trail."""
IN_FULL: Final = 12
"""Up to so many robots have their activity beside their names."""
MAX_NAME: Final = 24
"""Characters of a name on the floor and on pictures."""
MAX_OTHERS: Final = 2_000
POSE_SPACING: Final = 0.09
"""Seconds between two records of positions."""
SILENCE: Final = 10.0
"""Seconds without a message from a building after which positions are unknown, and another building may be shown."""
PLAN_AGAIN: Final = 5.0
"""Seconds until the query for a plan is repeated."""
MAX_TRAILS: Final = 256
ARROW: Final = 0.055
"""Length of a heading's arrow, as a share of the plan's longer side."""
SIGHT: Final = 0.13
"""Length of a camera's field of view, as a share of the longer side."""
VIEW: Final = math.radians(65)
"""Angle of view of a Scout's camera."""
WIDE: Final = 0.2
LINE: Final = 0.055
"""Width and height of a name, as shares of the longer side."""
MAX_STACK: Final = 6
"""Names in one place that avoid each other."""
RING: Final = 24
"""Corners of a circle."""

Spot = tuple[float, float]


class Layer(NamedTuple):
    """The style of one kind of object on the plan."""

    shape: Callable[..., rr.AsComponents]
    field: str
    """The shape's field with the positions."""
    radius: float
    """If negative, in points of the screen, independent of the zoom."""
    order: float | None = None
    """Layers of a higher order cover it."""


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


class Look(NamedTuple):
    """A robot's activity, and its colour (RGBA), None for the colour of a hidden or visible robot."""

    words: str = ""
    colour: int | None = None
    alert: bool = False


@dataclass(slots=True)
class _Building:
    sender: Sender
    seen_at: float
    time: float = 0.0
    """The building's own time."""
    asked: float = -PLAN_AGAIN
    name: str = ""
    planned: bool = False
    refused: bool = False


class FloorPlan:
    """Draws one building at a time; `look` returns the appearance of a robot by its name."""

    def __init__(self, drawing: Drawing, look: Callable[[str], Look]) -> None:
        self._drawing, self._look = drawing, look
        self.size: tuple[int, int] | None = None
        """Size of the plan's picture in pixels; None before there is a plan."""
        self._metres = (1.0, 1.0)
        self._trails: dict[str, deque[tuple[float, Spot]]] = {}
        """Times and places, by robot."""
        self._building: _Building | None = None
        self._others: set[Sender] = set()

    def poses(self, at: float, sender: Sender, poses: BuildingPoses) -> None:
        building = self._building
        if building is not None and building.sender != sender and at - building.seen_at <= SILENCE:
            if sender not in self._others and len(self._others) < MAX_OTHERS:
                self._others.add(sender)
                self._drawing.warn(at, f"a second building, of {sender}, is not shown beside that at {building.sender}")
            return
        if building is None or building.sender != sender or poses.time < building.time - 1:
            # If time goes back, the same client simulates another building now.
            self._building = building = _Building(sender, at)
            self._others.discard(sender)
        elif building.planned and at - building.seen_at < POSE_SPACING:
            return
        building.seen_at, building.time = at, poses.time
        if building.planned:
            minutes, seconds = divmod(max(0, int(poses.time)), 60)
            speed = "" if poses.speed == 1 else f" · {poses.speed:g} times as fast"
            self._show(at, poses, f"{building.name} · {minutes}:{seconds:02}{speed}")

    def tick(self, at: float) -> None:
        building = self._building
        if building is not None and building.planned and at - building.seen_at > SILENCE:
            building.planned = False
            self._clear(at)
            self._drawing.warn(at, f"building {building.name} is silent: positions are unknown")

    def wants_plan(self, at: float) -> Sender | None:
        """The client to query for its building's plan now, if any."""
        building = self._building
        if building is None or building.planned or building.refused:
            return None
        if at - building.seen_at > SILENCE or at - building.asked < PLAN_AGAIN:
            return None
        building.asked = at
        return building.sender

    def plan(self, at: float, sender: Sender, plan: BuildingPlan) -> None:
        building = self._building
        if building is None or building.sender != sender or building.planned:
            return
        building.name = clean_text(plan.name, MAX_NAME)
        width, depth, size = plan.width, plan.depth, png_size(plan.picture)
        why = ""
        if not (MIN_METRES <= width <= MAX_METRES and MIN_METRES <= depth <= MAX_METRES):
            why = f"it is {width:g} by {depth:g} m; a building has {MIN_METRES:g} to {MAX_METRES:g} m"
        elif size is None:
            why = "its plan is not a PNG picture"
        elif max(size) > MAX_SIDE:
            why = f"its plan is {size[0]} by {size[1]} pixels; {MAX_SIDE} a side are shown at most"
        if why or size is None:
            building.refused = True
            self._drawing.warn(at, f"building {building.name} of {sender} can't be shown: {why}")
            return
        building.planned = True
        self._clear(at)
        self.size, self._metres = size, (width, depth)
        # Static: a server that drops its oldest data must keep the plan.
        image = rr.EncodedImage(contents=plan.picture, media_type="image/png", draw_order=-20.0)
        self._drawing.log(None, "/floor/plan", image)
        self._drawing.arrange()

    def _clear(self, at: float) -> None:
        """From `at` on, positions are unknown; the plan stays."""
        for layer in LAYERS:
            self._draw(at, layer, [], [])
        self._trails.clear()

    def _show(self, at: float, poses: BuildingPoses, caption: str) -> None:
        """Draw all positions from `at` on, except those far outside."""
        robots = [robot for robot in poses.robots if self._is_near(robot)]
        people = [person for person in poses.people if self._is_near(person)]
        looks = [self._look(robot.name) for robot in robots]
        names = [clean_text(robot.name, MAX_NAME) for robot in robots]
        spots = [self._pixel(robot) for robot in robots]
        walkers = [self._pixel(person) for person in people]
        shades = [
            look.colour or (HIDDEN if robot.hidden else IN_THE_OPEN) for robot, look in zip(robots, looks, strict=True)
        ]
        self._draw_trails(at, names, spots, shades)
        self._draw(at, "robots", spots, shades)
        self._draw(at, "headings", [self._vector(robot.heading, ARROW) for robot in robots], shades, origins=spots)
        seen = [
            [spot, *(self._beside(spot, robot.heading + turn * VIEW / 8, SIGHT) for turn in range(-4, 5)), spot]
            for robot, spot in zip(robots, spots, strict=True)
            if robot.camera
        ]
        self._draw(at, "views", seen, [faded(CAMERA, 0.8)])
        rings = [
            [self._beside(spot, math.tau * corner / RING, ARROW) for corner in range(RING + 1)]
            for look, spot in zip(looks, spots, strict=True)
            if look.alert
        ]
        self._draw(at, "alerts", rings, [ALERT])
        self._draw(at, "people", walkers, [PERSON])
        # Names are separate from the points: a text must be brighter.
        if len(robots) <= IN_FULL:
            names = [f"{name} · {look.words}" if look.words else name for name, look in zip(names, looks, strict=True)]
        texts = [*map(clean_text, names), *(clean_text(person.name, MAX_NAME) for person in people)]
        colours = [bright(colour) for colour in (*shades, *(PERSON for _ in people))]
        places = self._places([*spots, *walkers])
        self._draw(at, "names", places, colours, labels=texts, show_labels=True)
        middle = [(self.size[0] / 2, 0.0)] if self.size is not None else []
        self._draw(at, "caption", middle, [PALE], labels=[clean_text(caption)], show_labels=True)

    def _draw(self, at: float, layer: str, what: Sequence[Any], colours: list[int], **more: Any) -> None:
        shape, field, radius, order = LAYERS[layer]
        fields = {field: what, "colors": colours, "radii": [radius], "draw_order": order}
        self._drawing.show(at, f"/floor/{layer}", shape, **fields, **more)

    def _places(self, spots: Sequence[Spot]) -> list[Spot]:
        """Positions of names, moved down where they would cover another."""
        longer = max(self.size or (1, 1))
        wide, line = WIDE * longer, LINE * longer
        places: list[Spot] = []
        for x, y in spots:
            for _ in range(MAX_STACK):
                if not any(abs(x - left) < wide and abs(y - top) < line for left, top in places):
                    break
                y += line
            places.append((x, round(y, 1)))
        return places

    def _draw_trails(self, at: float, names: Sequence[str], spots: Sequence[Spot], shades: Sequence[int]) -> None:
        step = MOVED * (self.size or (1, 1))[0] / self._metres[0]
        for name, spot in zip(names, spots, strict=True):
            if name not in self._trails and len(self._trails) >= MAX_TRAILS:
                continue
            trail = self._trails.setdefault(name, deque(maxlen=round(TRAIL / TRAIL_STEP)))
            if not trail or (at - trail[-1][0] >= TRAIL_STEP and math.dist(trail[-1][1], spot) >= step):
                trail.append((at, spot))
        for name, trail in list(self._trails.items()):
            while trail and at - trail[0][0] > TRAIL:
                trail.popleft()
            if not trail:
                del self._trails[name]
        colours = dict(zip(names, shades, strict=True))
        shown = [name for name, trail in self._trails.items() if len(trail) > 1 and name in colours]
        strips = [[spot for _, spot in self._trails[name]] for name in shown]
        self._draw(at, "trails", strips, [faded(colours[name], 0.55) for name in shown])

    def _is_near(self, placed: Placed) -> bool:
        width, depth = self._metres
        return (
            -MARGIN * width <= placed.x <= (1 + MARGIN) * width and -MARGIN * depth <= placed.y <= (1 + MARGIN) * depth
        )

    def _pixel(self, placed: Placed) -> Spot:
        """Convert metres to pixels: the plan's rows begin at the largest y."""
        (width, height), (metres_x, metres_y) = self.size or (1, 1), self._metres
        return round(placed.x * width / metres_x, 1), round((metres_y - placed.y) * height / metres_y, 1)

    def _vector(self, heading: float, part: float) -> Spot:
        length = part * max(self.size or (1, 1))
        return round(length * math.cos(heading), 1), round(-length * math.sin(heading), 1)

    def _beside(self, spot: Spot, heading: float, part: float) -> Spot:
        dx, dy = self._vector(heading, part)
        return spot[0] + dx, spot[1] + dy

"""Ray caster over upright boxes and cylinders, for a camera 4 cm above the floor.

All rays of a picture's column meet an upright surface at the same depth (Wolfenstein's trick), so the slab test in
the plane is done per column, and only heights are tested per pixel, within the part of the picture that the body can
cover. Depths are along the optical axis, which is level; the horizon is in the middle.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zscout.simulation.building.plan import Plan
from zscout.simulation.building.solids import Cuboids, Floats

WIDTH: Final = 160
HEIGHT: Final = 120
EYE: Final = 0.04  # m, height of the camera
VIEW: Final = math.radians(65)  # horizontal field of view
FOCAL: Final = WIDTH / 2 / math.tan(VIEW / 2)  # pixels
HORIZON: Final = HEIGHT // 2
NEAR: Final = 0.01
FIRST_BOX: Final = 6
"""Surface numbers: 0 floor, 1 ceiling, 2 to 5 outer walls, then boxes, then moving bodies."""

LATERAL: Final[Floats] = ((WIDTH / 2 - 0.5 - np.arange(WIDTH)) / FOCAL).astype(np.float32)
"""Tangent of each column's angle, left positive."""
SLOPE: Final[Floats] = ((HORIZON - 0.5 - np.arange(HEIGHT)) / FOCAL).astype(np.float32)
"""Tangent of each row's angle, up positive; never 0."""
_STEEPEST: Final = float(SLOPE[0])
FLOOR_DEPTH: Final[Floats] = (-EYE / SLOPE[HORIZON:]).astype(np.float32)
"""Depth of the floor by row below the horizon, m."""
ALL: Final = slice(0, WIDTH)  # columns


class Cylinder(NamedTuple):
    """An upright moving cylinder: a leg, a trunk, another robot. `light` is the light on the floor there."""

    x: float
    y: float
    radius: float
    low: float
    high: float
    shade: float
    light: float
    person: bool


def columns_of(x: float, y: float, heading: float, body: Cylinder) -> slice | None:
    """The columns that the cylinder may cover, seen from (x, y) along `heading`; None if out of view."""
    away_x, away_y = body.x - x, body.y - y
    away = math.hypot(away_x, away_y)
    if away <= body.radius:
        return ALL
    middle = math.remainder(math.atan2(away_y, away_x) - heading, math.tau)
    spread = math.asin(body.radius / away)
    left, right = min(middle + spread, VIEW / 2), max(middle - spread, -VIEW / 2)
    if left < right:
        return None
    # Column c looks along the tangent (WIDTH / 2 - 0.5 - c) / FOCAL; one more at each side for rounding.
    first, last = (WIDTH / 2 - 0.5 - FOCAL * math.tan(angle) for angle in (left, right))
    return slice(max(0, math.floor(first) - 1), min(WIDTH, math.ceil(last) + 2))


@dataclass(frozen=True, slots=True)
class Geometry:
    """The surface and depth of each pixel, for all rows and the columns cast."""

    surface: NDArray[np.int16]  # shape (120, columns)
    depth: Floats  # m along the optical axis, shape (120, columns)
    ways: Floats  # direction in the plan of each column per metre of depth, shape (2, columns)
    stop: Floats  # depth of the first surface that hides all behind it, by column
    entry: Floats  # depth at which each column meets the sides of each box, shape (boxes, columns)
    side: NDArray[np.int8]  # side of the box that is met, numbered as in `Lit.patches`
    along: Floats  # m along that side from its start


class Caster:
    def __init__(self, plan: Plan, boxes: Cuboids) -> None:
        self._plan, self._boxes = plan, boxes
        self.first_moving = FIRST_BOX + len(boxes)  # surface number of the first moving body

    def cast(self, x: float, y: float, heading: float, columns: slice = ALL) -> Geometry:
        """The fixed scene from (x, y) along `heading`, for a part of the picture's columns."""
        forward = np.array([np.cos(heading), np.sin(heading)], np.float32)
        left = np.array([-forward[1], forward[0]], np.float32)
        ways = forward[:, None] + left[:, None] * LATERAL[columns]
        wall, wall_depth = self._walls(x, y, ways)
        entry, leave, side, along = self._meet(x, y, ways)
        low, high = self._boxes.low, self._boxes.high
        tall = (low[:, None] <= 0.001) & (high[:, None] >= EYE + entry * _STEEPEST) & (entry > NEAR)
        stop = np.minimum(np.where(tall & (entry < leave), entry, np.inf).min(0, initial=np.inf), wall_depth)
        seen = (entry < leave) & (entry <= stop)
        ceiling = (self._plan.height - EYE) / SLOPE[:HORIZON]
        depth = np.concatenate((ceiling, FLOOR_DEPTH))[:, None] * np.ones_like(wall_depth)
        surface = np.zeros(depth.shape, np.int16)
        surface[:HORIZON] = 1
        behind = wall_depth < depth
        np.copyto(depth, wall_depth, where=behind)
        np.copyto(surface, (2 + wall).astype(np.int16), where=behind)
        for number in np.flatnonzero(seen.any(1)):
            _draw(
                int(number) + FIRST_BOX, seen[number], entry[number], leave[number], float(low[number]),
                float(high[number]), depth, surface,
            )  # fmt: skip
        return Geometry(surface, depth, ways, stop, entry, side, along)

    def with_moving(self, seen: Geometry, x: float, y: float, moving: list[Cylinder]) -> Geometry:
        """`seen`, cast from (x, y), with moving bodies in front."""
        table = np.array([body[:5] for body in moving], np.float32).reshape(-1, 5)
        entry, leave = _meet_round(x, y, seen.ways, table)
        here = (entry < leave) & (entry <= seen.stop)
        depth, surface = seen.depth.copy(), seen.surface.copy()
        for number in np.flatnonzero(here.any(1)):
            _draw(
                int(number) + self.first_moving, here[number], entry[number], leave[number], float(table[number, 3]),
                float(table[number, 4]), depth, surface,
            )  # fmt: skip
        return replace(seen, surface=surface, depth=depth)

    def _walls(self, x: float, y: float, ways: Floats) -> tuple[NDArray[np.intp], Floats]:
        plan = self._plan
        with np.errstate(divide="ignore"):
            west, east = -x / ways[0], (plan.width - x) / ways[0]
            to = np.stack((-y / ways[1], east, (plan.depth - y) / ways[1], west))
        to[to <= 0] = np.inf
        nearest = to.argmin(0)
        return nearest, to[nearest, np.arange(len(nearest))].astype(np.float32)

    def _meet(self, x: float, y: float, ways: Floats) -> tuple[Floats, Floats, NDArray[np.int8], Floats]:
        boxes = self._boxes
        dx, dy = x - boxes.x, y - boxes.y
        start_x, start_y = dx * boxes.cos + dy * boxes.sin, dy * boxes.cos - dx * boxes.sin
        way_x = boxes.cos[:, None] * ways[0] + boxes.sin[:, None] * ways[1] + np.float32(1e-9)
        way_y = boxes.cos[:, None] * ways[1] - boxes.sin[:, None] * ways[0] + np.float32(1e-9)
        inverse_x, inverse_y = 1 / way_x, 1 / way_y
        middle_x, spread_x = -start_x[:, None] * inverse_x, boxes.half_width[:, None] * np.abs(inverse_x)
        middle_y, spread_y = -start_y[:, None] * inverse_y, boxes.half_depth[:, None] * np.abs(inverse_y)
        enter_x, enter_y = middle_x - spread_x, middle_y - spread_y
        leave = np.minimum(middle_x + spread_x, middle_y + spread_y)
        on_x = enter_x > enter_y
        entry = np.maximum(np.where(on_x, enter_x, enter_y), NEAR)
        side = np.where(on_x, np.where(way_x > 0, 3, 1), np.where(way_y > 0, 0, 2)).astype(np.int8)
        at = np.where(
            on_x,
            start_y[:, None] + entry * way_y + boxes.half_depth[:, None],
            start_x[:, None] + entry * way_x + boxes.half_width[:, None],
        )
        length = np.where(on_x, boxes.half_depth[:, None], boxes.half_width[:, None]) * 2
        # Sides 2 and 3 run in the opposite direction.
        return entry, leave, side, np.where(side >= 2, length - at, at)


def _draw(
    number: int,
    seen: NDArray[np.bool_],
    entry: Floats,
    leave: Floats,
    low: float,
    high: float,
    depth: Floats,
    surface: NDArray[np.int16],
) -> None:
    """Draw a box or cylinder into `depth` and `surface` where it is nearer."""
    columns = np.flatnonzero(seen)
    a, b = int(columns[0]), int(columns[-1]) + 1
    nearest, farthest = float(entry[a:b].min()), float(leave[a:b].max())
    if farthest <= NEAR:
        return
    nearest = max(nearest, NEAR)
    top = (high - EYE) / (nearest if high > EYE else farthest)
    bottom = (low - EYE) / (nearest if low < EYE else farthest)
    first = max(0, int(HORIZON - 0.5 - top * FOCAL))
    last = min(HEIGHT, int(HORIZON + 1.5 - bottom * FOCAL))
    if first >= last:
        return
    slope = SLOPE[first:last, None]
    to_low, to_high = (low - EYE) / slope, (high - EYE) / slope
    here = np.maximum(entry[a:b], np.minimum(to_low, to_high))
    old = depth[first:last, a:b]
    hit = here <= np.minimum(leave[a:b], np.maximum(to_low, to_high))
    hit &= here < old
    np.copyto(old, here, where=hit)
    surface[first:last, a:b][hit] = number


def _meet_round(x: float, y: float, ways: Floats, table: Floats) -> tuple[Floats, Floats]:
    """Depths at which columns enter and leave circles; `table` rows are (x, y, radius, ...)."""
    dx, dy, radius = (x - table[:, 0])[:, None], (y - table[:, 1])[:, None], table[:, 2][:, None]
    a = ways[0] ** 2 + ways[1] ** 2
    b = dx * ways[0] + dy * ways[1]
    root = b * b - a * (dx * dx + dy * dy - radius * radius)
    reach = np.sqrt(np.maximum(root, 0))
    missed = root <= 0
    enter = np.where(missed, np.inf, np.maximum((-b - reach) / a, NEAR)).astype(np.float32)
    return enter, np.where(missed, -np.inf, (-b + reach) / a).astype(np.float32)

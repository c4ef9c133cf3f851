"""A robot's camera: a ray caster over upright boxes and cylinders, seen from 4 cm above the floor. Level camera,
pinhole, horizon in the middle; depths are along the optical axis.

What stands upright meets all rays of a picture's column at the same depths (Wolfenstein's trick), so the slab
test in the plane is done per column, and only the heights per pixel, within the part of the picture that the
thing can cover at all. Light comes from `light`, sampled between its cells by OpenCV's remap.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zscout.simulation.light import FACES, Lit
from zscout.simulation.plan import Plan
from zscout.simulation.solids import Boxes, Floats
from zscout.simulation.textures import floor_albedo, grain

WIDTH: Final = 160
HEIGHT: Final = 120
EYE: Final = 0.04
"""Height of the camera, m."""
VIEW: Final = np.deg2rad(65)
"""Horizontal field of view, radians."""
FOCAL: Final = float(WIDTH / 2 / np.tan(VIEW / 2))
"""Pixels."""
HORIZON: Final = HEIGHT // 2
NEAR: Final = 0.01
FIRST_BOX: Final = 6
"""Surface numbers: 0 the floor, 1 the ceiling, 2 to 5 the outer walls, then boxes, then what moves."""

Picture = NDArray[np.uint8]

LATERAL: Final[Floats] = ((WIDTH / 2 - 0.5 - np.arange(WIDTH)) / FOCAL).astype(np.float32)
"""Tangent of each column's angle, left positive."""
SLOPE: Final[Floats] = ((HORIZON - 0.5 - np.arange(HEIGHT)) / FOCAL).astype(np.float32)
"""Tangent of each row's angle, up positive; never 0."""
_STEEPEST: Final = float(SLOPE[0])
_FLOOR_DEPTH: Final[Floats] = (-EYE / SLOPE[HORIZON:]).astype(np.float32)
_FAR_ROWS: Final = 14
"""Rows below the horizon that cover so much floor that it is taken at several depths and averaged."""
_SUBROWS: Final = 4


class Cylinder(NamedTuple):
    """An upright cylinder that moves: a leg, a trunk, another robot. `light` is that on the floor there."""

    x: float
    y: float
    radius: float
    low: float
    high: float
    shade: float
    light: float
    person: bool


@dataclass(frozen=True, slots=True)
class Geometry:
    """Which surface each pixel shows, and how deep."""

    surface: NDArray[np.int16]
    """Shape (120, 160)."""
    depth: Floats
    """Metres along the optical axis, shape (120, 160)."""
    ways: Floats
    """Plan direction of each column per metre of depth, shape (2, 160)."""
    entry: Floats
    """Depth at which each column meets the sides of each box and cylinder, shape (n, 160)."""
    side: NDArray[np.int8]
    """Which side of a box that is, as `Lit.patches` has it."""
    along: Floats
    """Metres along that side from its start."""


class Camera:
    """Pictures of one plan."""

    def __init__(self, plan: Plan, boxes: Boxes, lit: Lit) -> None:
        self._plan = plan
        self._boxes = boxes
        self._lit = lit
        self._floor = lit.floor * floor_albedo(plan, lit.cell, lit.floor.shape[1:])
        shades = np.concatenate((np.full(4, plan.wall_shade, np.float32), np.repeat(boxes.shade, FACES)))
        self._atlas = lit.atlas * np.repeat(shades, lit.patches[:, 1])[:, None]
        self._grain = grain()
        _add_windows(plan, lit, self._atlas)
        first = lit.patches[:, 0].astype(np.float32)
        self._first = first
        self._rows = lit.patches[:, 1].astype(np.float32) - 1
        self._columns = lit.patches[:, 2].astype(np.float32) - 1
        lengths = np.stack((boxes.half_width, boxes.half_depth, boxes.half_width, boxes.half_depth), 1) * 2
        self._lengths = lengths
        self.first_moving = FIRST_BOX + len(boxes)
        self._sources = np.zeros(2, np.float32)
        self._floor_now = self._floor[0]
        self._atlas_now = self._atlas[0]

    def geometry(self, x: float, y: float, heading: float, moving: list[Cylinder]) -> Geometry:
        """What is seen from (x, y) along `heading`, with what moves beside the plan's own boxes."""
        forward = np.array([np.cos(heading), np.sin(heading)], np.float32)
        left = np.array([-forward[1], forward[0]], np.float32)
        ways = forward[:, None] + left[:, None] * LATERAL
        wall, wall_depth = self._walls(x, y, ways)
        entry, leave, side, along = self._meet(x, y, ways)
        boxes = self._boxes
        low, high = boxes.low, boxes.high
        if moving:
            table = np.array([body[:5] for body in moving], np.float32)
            enter_round, leave_round = _meet_round(x, y, ways, table)
            entry, leave = np.concatenate((entry, enter_round)), np.concatenate((leave, leave_round))
            blank = np.zeros(enter_round.shape)
            side = np.concatenate((side, blank.astype(np.int8)))
            along = np.concatenate((along, blank.astype(np.float32)))
            low, high = np.concatenate((low, table[:, 3])), np.concatenate((high, table[:, 4]))
        # Nothing is seen behind a wall, or behind what fills its column from floor to the picture's top.
        tall = (low[:, None] <= 0.001) & (high[:, None] >= EYE + entry * _STEEPEST) & (entry > NEAR)
        stop = np.minimum(np.where(tall & (entry < leave), entry, np.inf).min(0, initial=np.inf), wall_depth)
        seen = (entry < leave) & (entry <= stop)
        ceiling = (self._plan.height - EYE) / SLOPE[:HORIZON]
        depth = np.concatenate((ceiling, _FLOOR_DEPTH))[:, None] * np.ones((1, WIDTH), np.float32)
        surface = np.zeros((HEIGHT, WIDTH), np.int16)
        surface[:HORIZON] = 1
        behind = wall_depth < depth
        np.copyto(depth, wall_depth, where=behind)
        np.copyto(surface, (2 + wall).astype(np.int16), where=behind)
        for number in np.flatnonzero(seen.any(1)):
            _draw(
                int(number) + FIRST_BOX, seen[number], entry[number], leave[number], float(low[number]),
                float(high[number]), depth, surface,
            )  # fmt: skip
        return Geometry(surface, depth, ways, entry, side, along)

    def linear(
        self, x: float, y: float, heading: float, moving: list[Cylinder], lamps: float, windows: float
    ) -> Floats:
        """The picture as linear light, shape (120, 160), before the camera's own doing; `lamps` and `windows`
        are factors on their light."""
        now = np.array([lamps, windows], np.float32)
        if not np.array_equal(now, self._sources):
            self._sources = now
            self._floor_now = cv2.addWeighted(self._floor[0], lamps, self._floor[1], windows, 0)
            self._atlas_now = cv2.addWeighted(self._atlas[0], lamps, self._atlas[1], windows, 0)
        seen = self.geometry(x, y, heading, moving)
        picture = np.empty((HEIGHT, WIDTH), np.float32)
        self._paint_floor(x, y, seen, moving, picture)
        picture[:HORIZON] = 0.8 * float(self._lit.ambient @ now)
        self._paint_upright(x, y, seen, moving, picture)
        return picture

    # Geometry

    def _walls(self, x: float, y: float, ways: Floats) -> tuple[NDArray[np.intp], Floats]:
        plan = self._plan
        with np.errstate(divide="ignore"):
            to = np.stack((-y / ways[1], (plan.width - x) / ways[0], (plan.depth - y) / ways[1], -x / ways[0]))
        to[to <= 0] = np.inf
        nearest = to.argmin(0)
        return nearest, to[nearest, np.arange(WIDTH)].astype(np.float32)

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
        # Sides 2 and 3 are run through the other way round.
        return entry, leave, side, np.where(side >= 2, length - at, at)

    # Light

    def _paint_floor(
        self, x: float, y: float, seen: Geometry, moving: list[Cylinder], picture: Floats
    ) -> None:
        cell = self._lit.cell
        depths = seen.depth[HORIZON:]
        at_x = x + depths * seen.ways[0]
        at_y = y + depths * seen.ways[1]
        light = cv2.remap(
            self._floor_now, at_x / cell - 0.5, at_y / cell - 0.5, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        below = np.arange(_FAR_ROWS)[:, None] + (np.arange(_SUBROWS) + 0.5) / _SUBROWS
        part = (EYE * FOCAL / below).astype(np.float32).reshape(-1, 1)
        far = cv2.remap(
            self._floor_now,
            (x + part * seen.ways[0]) / cell - 0.5,
            (y + part * seen.ways[1]) / cell - 0.5,
            cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )
        light[:_FAR_ROWS] = far.reshape(_FAR_ROWS, _SUBROWS, WIDTH).mean(1)
        # 4 mm to a cell of grain, and the finer the farther: it fades where a pixel covers more.
        fine = cv2.remap(self._grain, at_x * 250, at_y * 250, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        light *= 1 + fine * _GRAIN_FADE
        for body in moving:
            if body.low > 0.1:
                continue
            square = (at_x - body.x) ** 2 + (at_y - body.y) ** 2
            light *= 1 - 0.6 * np.exp(square * (-0.5 / (body.radius * 1.3) ** 2))
        picture[HORIZON:] = light

    def _paint_upright(
        self, x: float, y: float, seen: Geometry, moving: list[Cylinder], picture: Floats
    ) -> None:
        flat = seen.surface.ravel()
        pixels = np.flatnonzero(flat >= 2)
        if not len(pixels):
            return
        row, column = np.divmod(pixels, WIDTH)
        depth = seen.depth.ravel()[pixels]
        number = flat[pixels].astype(np.intp)
        height = EYE + SLOPE[row] * depth
        map_x, map_y, run = self._wall_maps(x, y, seen, height, column, depth, number)
        count = len(self._boxes)
        standing = np.flatnonzero((number >= FIRST_BOX) & (number < FIRST_BOX + count))
        self._box_maps(x, y, seen, standing, number, column, depth, height, map_x, map_y, run)
        light = cv2.remap(
            self._atlas_now, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        ).ravel()
        texture = cv2.remap(
            self._grain, run * 40, height * 40, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
        ).ravel()
        broad = cv2.remap(
            self._grain, run * 5, height * 3, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP
        ).ravel()
        light *= 1 + 0.35 * texture + 0.6 * broad
        skirting = (number < FIRST_BOX) & (height < 0.07)
        light[skirting] *= 0.7
        bodies = np.flatnonzero(number >= FIRST_BOX + count)
        if len(bodies):
            self._paint_moving(x, y, seen, moving, bodies, number - FIRST_BOX - count, column, depth, light)
        picture.ravel()[pixels] = light

    def _wall_maps(
        self,
        x: float,
        y: float,
        seen: Geometry,
        height: Floats,
        column: NDArray[np.intp],
        depth: Floats,
        number: NDArray[np.intp],
    ) -> tuple[Floats, Floats, Floats]:
        """Places in the atlas for pixels of the outer walls; metres along the wall."""
        plan = self._plan
        wall = np.minimum(number - 2, 3)
        at_x, at_y = x + depth * seen.ways[0][column], y + depth * seen.ways[1][column]
        # Wall 0 is run from x=0 to x=width, 1 up, 2 back, 3 down, as the corners of the room go.
        run = np.where(wall % 2 == 0, at_x, at_y)
        length = np.where(wall % 2 == 0, plan.width, plan.depth).astype(np.float32)
        share = run / length
        share = np.where(wall >= 2, 1 - share, share)
        map_x = share * self._columns[wall]
        map_y = self._first[wall] + np.clip(height / plan.height, 0, 1) * self._rows[wall]
        return map_x.astype(np.float32), map_y.astype(np.float32), (run + 7.3 * wall).astype(np.float32)

    def _box_maps(
        self,
        x: float,
        y: float,
        seen: Geometry,
        standing: NDArray[np.intp],
        number: NDArray[np.intp],
        column: NDArray[np.intp],
        depth: Floats,
        height: Floats,
        map_x: Floats,
        map_y: Floats,
        run: Floats,
    ) -> None:
        """The same for pixels of boxes, written into the maps."""
        boxes = self._boxes
        box = number[standing] - FIRST_BOX
        key = box * WIDTH + column[standing]
        deep = depth[standing]
        entry = seen.entry.ravel()[key]
        side = seen.side.ravel()[key].astype(np.intp)
        along = seen.along.ravel()[key]
        face = 4 + FACES * box + side
        share_u = along / self._lengths[box, side]
        share_v = (height[standing] - boxes.low[box]) / (boxes.high[box] - boxes.low[box])
        under = np.flatnonzero(deep > entry + 1e-5)
        if len(under):
            which, at = box[under], column[standing][under]
            dx = x + deep[under] * seen.ways[0][at] - boxes.x[which]
            dy = y + deep[under] * seen.ways[1][at] - boxes.y[which]
            cos, sin = boxes.cos[which], boxes.sin[which]
            share_u[under] = (dx * cos + dy * sin) / (2 * boxes.half_width[which]) + 0.5
            share_v[under] = (dy * cos - dx * sin) / (2 * boxes.half_depth[which]) + 0.5
            face[under] = 4 + FACES * which + 4
        map_x[standing] = np.clip(share_u, 0, 1) * self._columns[face]
        map_y[standing] = self._first[face] + np.clip(share_v, 0, 1) * self._rows[face]
        run[standing] = along + box * 1.7

    def _paint_moving(
        self,
        x: float,
        y: float,
        seen: Geometry,
        moving: list[Cylinder],
        bodies: NDArray[np.intp],
        which: NDArray[np.intp],
        column: NDArray[np.intp],
        depth: Floats,
        light: Floats,
    ) -> None:
        """A cylinder is brightest on the side towards the picture's left: where the light comes from matters
        little for what moves."""
        table = np.array([(b.x, b.y, b.radius, b.shade * b.light) for b in moving], np.float32)[which[bodies]]
        at = column[bodies]
        dx = x + depth[bodies] * seen.ways[0][at] - table[:, 0]
        dy = y + depth[bodies] * seen.ways[1][at] - table[:, 1]
        round_ = (dx * 0.6 + dy * 0.8) / table[:, 2]
        light[bodies] = table[:, 3] * (0.65 + 0.35 * np.clip(round_, -1, 1))


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
    """Draws one box or cylinder into `depth` and `surface`, where it is nearer."""
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


def _add_windows(plan: Plan, lit: Lit, atlas: Floats) -> None:
    """Windows shine themselves: texels of the outer walls that lie in one."""
    for light in plan.lights:
        if light.kind != "window":
            continue
        edges = np.array([light.y, plan.width - light.x, plan.depth - light.y, light.x])
        wall = int(edges.argmin())
        first, rows, columns = (int(one) for one in lit.patches[wall])
        length = plan.width if wall % 2 == 0 else plan.depth
        middle = (light.x, light.y, plan.width - light.x, plan.depth - light.y)[wall]
        run = np.linspace(0, length, columns)
        height = np.linspace(0, plan.height, rows)
        inside = (np.abs(height - light.z) <= light.depth / 2)[:, None] & (np.abs(run - middle) <= light.width / 2)
        bright = 4 * light.power / max(light.width * light.depth, 0.1)
        atlas[1, first : first + rows, :columns][inside] = bright


_GRAIN_FADE: Final[Floats] = (1 / (1 + (_FLOOR_DEPTH**2 / (EYE * FOCAL) / 0.008) ** 2))[:, None].astype(np.float32)

"""A robot's camera: surfaces found by `casting`, painted as linear light from `light`; `sensor` makes grey levels.

Since light adds up, the fixed scene of a camera at rest is painted once for each kind of light, and moving bodies
are painted over the sum.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from zscout.simulation.building.casting import (
    EYE,
    FIRST_BOX,
    FLOOR_DEPTH,
    FOCAL,
    HEIGHT,
    HORIZON,
    SLOPE,
    WIDTH,
    Caster,
    Cylinder,
    Geometry,
    columns_of,
)
from zscout.simulation.building.light import FACES, Lit
from zscout.simulation.building.plan import Plan
from zscout.simulation.building.solids import Cuboids, Floats
from zscout.simulation.building.textures import floor_albedo, grain

Picture = NDArray[np.uint8]
"""Grey levels, shape (120, 160), row 0 at the top."""

_FAR_ROWS: Final = 14  # rows below the horizon whose floor is averaged over _SUBROWS depths
_SUBROWS: Final = 4
_SHADE: Final = 5.0  # extent of a moving body's shadow in radii
MAX_VIEWS: Final = 64  # cached poses, 0.5 MB each: more than there are watched cameras at rest
_GRAIN_FADE: Final = (1 / (1 + (FLOOR_DEPTH**2 / (EYE * FOCAL) / 0.008) ** 2)).astype(np.float32)[:, None]
"""Visible share of the floor's grain by row: a pixel that covers much floor shows the mean."""


def shaded_by(x: float, y: float, heading: float, body: Cylinder) -> slice | None:
    """The columns that may show a body's shadow on the floor from (x, y) along `heading`, or None."""
    return None if body.low > 0.1 else columns_of(x, y, heading, body._replace(radius=_SHADE * body.radius))


@dataclass(slots=True)
class _View:
    seen: Geometry
    at_x: Floats  # place on the floor of each pixel below the horizon, m, shape (60, 160)
    at_y: Floats
    lit: tuple[Floats, Floats] | None = None
    """The scene in the light of lamps and of windows; None until the second look from this pose."""


class Camera:
    def __init__(self, plan: Plan, boxes: Cuboids, lit: Lit) -> None:
        self._plan, self._boxes, self._lit = plan, boxes, lit
        self.caster = Caster(plan, boxes)
        self._floor = lit.floor * floor_albedo(plan, lit.cell, lit.floor.shape[1:])
        shades = np.concatenate((np.full(4, plan.wall_shade, np.float32), np.repeat(boxes.shade, FACES)))
        self._atlas = lit.atlas * np.repeat(shades, lit.patches[:, 1])[:, None]
        self._grain = grain()
        _add_windows(plan, lit, self._atlas)
        self._first, rows, columns = lit.patches.T.astype(np.float32)
        self._rows, self._columns = rows - 1, columns - 1
        self._lengths = np.stack((boxes.half_width, boxes.half_depth) * 2, 1) * 2
        self._views: OrderedDict[tuple[float, float, float], _View] = OrderedDict()

    def linear(
        self, x: float, y: float, heading: float, moving: list[Cylinder], lamps: float, windows: float
    ) -> Floats:
        """The picture as linear light, shape (120, 160); `lamps` and `windows` are factors on their light."""
        view = self._views.pop((x, y, heading), None)
        if view is None:
            view = self._cast(x, y, heading)
            floor = cv2.addWeighted(self._floor[0], lamps, self._floor[1], windows, 0)
            atlas = cv2.addWeighted(self._atlas[0], lamps, self._atlas[1], windows, 0)
            ambient = self._lit.ambient @ np.array([lamps, windows], np.float32)
            picture = self._paint(x, y, view, floor, atlas, float(ambient))
        else:
            if view.lit is None:
                first, second = (
                    self._paint(x, y, view, self._floor[kind], self._atlas[kind], float(self._lit.ambient[kind]))
                    for kind in (0, 1)
                )
                view.lit = first, second
            picture = np.asarray(cv2.addWeighted(view.lit[0], lamps, view.lit[1], windows, 0), np.float32)
        self._views[x, y, heading] = view
        if len(self._views) > MAX_VIEWS:
            self._views.popitem(last=False)
        if moving:
            self._shade(x, y, heading, view, moving, picture)
            self._paint_moving(x, y, self.caster.with_moving(view.seen, x, y, moving), moving, picture)
        return picture

    def _cast(self, x: float, y: float, heading: float) -> _View:
        seen = self.caster.cast(x, y, heading)
        depths = seen.depth[HORIZON:]
        return _View(seen, x + depths * seen.ways[0], y + depths * seen.ways[1])

    def _paint(self, x: float, y: float, view: _View, floor: Floats, atlas: Floats, ambient: float) -> Floats:
        picture = np.empty((HEIGHT, WIDTH), np.float32)
        self._paint_floor(x, y, view, floor, picture)
        picture[:HORIZON] = 0.8 * ambient
        self._paint_upright(x, y, view.seen, atlas, picture)
        return picture

    def _paint_floor(self, x: float, y: float, view: _View, floor: Floats, picture: Floats) -> None:
        cell, ways = self._lit.cell, view.seen.ways
        light = _between(floor, view.at_x / cell - 0.5, view.at_y / cell - 0.5)
        below = np.arange(_FAR_ROWS)[:, None] + (np.arange(_SUBROWS) + 0.5) / _SUBROWS
        part = (EYE * FOCAL / below).astype(np.float32).reshape(-1, 1)
        far_x, far_y = x + part * ways[0], y + part * ways[1]
        far = _between(floor, far_x / cell - 0.5, far_y / cell - 0.5)
        light[:_FAR_ROWS] = far.reshape(_FAR_ROWS, _SUBROWS, WIDTH).mean(1)
        # A cell of grain is 4 mm; it fades where a pixel covers more.
        fine = _between(self._grain, view.at_x * 250, view.at_y * 250, tiled=True)
        picture[HORIZON:] = light * (1 + fine * _GRAIN_FADE)

    def _shade(self, x: float, y: float, heading: float, view: _View, moving: list[Cylinder], picture: Floats) -> None:
        floor = view.seen.surface[HORIZON:] == 0
        for body in moving:
            if (shaded := shaded_by(x, y, heading, body)) is None:
                continue
            square = (view.at_x[:, shaded] - body.x) ** 2 + (view.at_y[:, shaded] - body.y) ** 2
            left = 1 - 0.6 * np.exp(square * (-0.5 / (body.radius * 1.3) ** 2))
            light = picture[HORIZON:, shaded]
            np.multiply(light, left, out=light, where=floor[:, shaded])

    def _paint_upright(self, x: float, y: float, seen: Geometry, atlas: Floats, picture: Floats) -> None:
        flat = seen.surface.ravel()
        pixels = np.flatnonzero(flat >= 2)
        if not len(pixels):
            return
        row, column = np.divmod(pixels, WIDTH)
        depth = seen.depth.ravel()[pixels]
        number = flat[pixels].astype(np.intp)
        height = EYE + SLOPE[row] * depth
        map_x, map_y, run = self._wall_maps(x, y, seen, height, column, depth, number)
        standing = np.flatnonzero(number >= FIRST_BOX)
        self._box_maps(x, y, seen, standing, number, column, depth, height, map_x, map_y, run)
        light = _between(atlas, map_x, map_y).ravel()
        texture = _between(self._grain, run * 40, height * 40, tiled=True).ravel()
        broad = _between(self._grain, run * 5, height * 3, tiled=True).ravel()
        light *= 1 + 0.35 * texture + 0.6 * broad
        light[(number < FIRST_BOX) & (height < 0.07)] *= 0.7  # skirting boards
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
        """Atlas columns and rows for pixels of outer walls, and metres along the wall."""
        plan = self._plan
        wall = np.minimum(number - 2, 3)
        at_x, at_y = x + depth * seen.ways[0][column], y + depth * seen.ways[1][column]
        # Walls run counter-clockwise: 0 along +x, 1 along +y, 2 along -x, 3 along -y.
        run = np.where(wall % 2 == 0, at_x, at_y)
        share = run / np.where(wall % 2 == 0, plan.width, plan.depth).astype(np.float32)
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
        """Overwrite the maps of `_wall_maps` where a box hides the wall."""
        boxes = self._boxes
        box = number[standing] - FIRST_BOX
        key = box * WIDTH + column[standing]
        deep = depth[standing]
        side = seen.side.ravel()[key].astype(np.intp)
        along = seen.along.ravel()[key]
        face = 4 + FACES * box + side
        share_u = along / self._lengths[box, side]
        share_v = (height[standing] - boxes.low[box]) / (boxes.high[box] - boxes.low[box])
        under = np.flatnonzero(deep > seen.entry.ravel()[key] + 1e-5)
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

    def _paint_moving(self, x: float, y: float, seen: Geometry, moving: list[Cylinder], picture: Floats) -> None:
        """Shade each cylinder from the same side in any light: the shading only makes it look round."""
        flat = seen.surface.ravel()
        pixels = np.flatnonzero(flat >= self.caster.first_moving)
        column, depth = pixels % WIDTH, seen.depth.ravel()[pixels]
        bodies = np.array([(b.x, b.y, b.radius, b.shade * b.light) for b in moving], np.float32)
        table = bodies[flat[pixels] - self.caster.first_moving]
        dx = x + depth * seen.ways[0][column] - table[:, 0]
        dy = y + depth * seen.ways[1][column] - table[:, 1]
        round_ = (dx * 0.6 + dy * 0.8) / table[:, 2]
        picture.ravel()[pixels] = table[:, 3] * (0.65 + 0.35 * np.clip(round_, -1, 1))


def _between(image: Floats, x: Floats, y: Floats, *, tiled: bool = False) -> Floats:
    """Interpolate `image` at columns `x` and rows `y`; beyond its edge it is tiled, or the edge repeats."""
    border = cv2.BORDER_WRAP if tiled else cv2.BORDER_REPLICATE
    return np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=border), np.float32)


def _add_windows(plan: Plan, lit: Lit, atlas: Floats) -> None:
    for light in plan.lights:
        if light.kind != "window":
            continue
        edges = np.array([light.y, plan.width - light.x, plan.depth - light.y, light.x])
        wall = int(edges.argmin())
        first, rows, columns = lit.patches[wall].tolist()
        length = plan.width if wall % 2 == 0 else plan.depth
        middle = (light.x, light.y, plan.width - light.x, plan.depth - light.y)[wall]
        run = np.linspace(0, length, columns)
        height = np.linspace(0, plan.height, rows)
        high, wide = np.abs(height - light.z) <= light.depth / 2, np.abs(run - middle) <= light.width / 2
        bright = 4 * light.power / max(light.width * light.depth, 0.1)
        atlas[1, first : first + rows, :columns][high[:, None] & wide] = bright

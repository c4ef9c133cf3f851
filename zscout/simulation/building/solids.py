"""Walls and furniture as upright boxes, for light, robots and cameras."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zscout.simulation.building.plan import Furniture, Plan, Wall

Floats = NDArray[np.float32]

SLAB: Final = 0.03  # m, thickness of a table's top and a chair's seat
SEAT: Final = 0.45  # m, height of a chair's seat


class Cuboid(NamedTuple):
    """An upright box, turned about its middle by `turn`; metres."""

    x: float
    y: float
    half_width: float
    half_depth: float
    turn: float
    low: float
    high: float
    shade: float


@dataclass(frozen=True, slots=True)
class Cuboids:
    """Boxes as float32 arrays of shape (n,)."""

    x: Floats
    y: Floats
    half_width: Floats
    half_depth: Floats
    cos: Floats
    sin: Floats
    low: Floats
    high: Floats
    shade: Floats

    def __len__(self) -> int:
        return len(self.x)

    def corners(self) -> Floats:
        """The four corners of each footprint in circular order, shape (n, 4, 2)."""
        across = self.half_width[:, None] * np.array([-1, 1, 1, -1], np.float32)
        along = self.half_depth[:, None] * np.array([-1, -1, 1, 1], np.float32)
        x = self.x[:, None] + across * self.cos[:, None] - along * self.sin[:, None]
        y = self.y[:, None] + across * self.sin[:, None] + along * self.cos[:, None]
        return np.stack((x, y), axis=2)

    def where(self, chosen: NDArray[np.bool_]) -> Cuboids:
        return Cuboids(*(getattr(self, name)[chosen] for name in self.__slots__))


def cuboids_of(plan: Plan) -> Cuboids:
    found = [_partition(wall, plan.height, plan.wall_shade) for wall in plan.walls]
    for piece in plan.furniture:
        found += parts(piece)
    return as_arrays(found)


def as_arrays(boxes: Iterable[Cuboid]) -> Cuboids:
    table = np.array([tuple(box) for box in boxes], np.float32).reshape(-1, 8)
    x, y, half_width, half_depth, turn, low, high, shade = np.ascontiguousarray(table.T)
    return Cuboids(x, y, half_width, half_depth, np.cos(turn), np.sin(turn), low, high, shade)


def parts(piece: Furniture) -> list[Cuboid]:
    wide, deep = piece.width / 2, piece.depth / 2
    low, high, leg = piece.clearance, piece.height, piece.leg
    match piece.kind:
        case "solid" | "shelf":
            return [_part(piece, 0, 0, wide, deep, 0, high)]
        case "table":
            top = max(high - SLAB, high / 2)
            return [_part(piece, 0, 0, wide, deep, top, high), *_legs(piece, top)]
        case "desk":
            top = max(high - SLAB, high / 2)
            panels = [_part(piece, side * (wide - leg / 2), 0, leg / 2, deep, 0, top) for side in (-1, 1)]
            back = _part(piece, 0, deep - leg / 4, wide - leg, leg / 4, top * 0.4, top)
            return [_part(piece, 0, 0, wide, deep, top, high), *panels, back]
        case "chair":
            seat = min(SEAT, high * 0.6)
            back = _part(piece, 0, deep - leg / 2, wide, leg / 2, seat, high)
            return [_part(piece, 0, 0, wide, deep, seat - SLAB, seat), back, *_legs(piece, seat - SLAB)]
        case "sofa":
            seat = low + (high - low) * 0.45
            arm = low + (high - low) * 0.75
            thick = min(0.18, wide / 4)
            back = _part(piece, 0, deep - thick / 2, wide, thick / 2, low, high)
            arms = [_part(piece, side * (wide - thick / 2), 0, thick / 2, deep, low, arm) for side in (-1, 1)]
            return [_part(piece, 0, 0, wide, deep, low, seat), back, *arms, *_legs(piece, low)]
        case "raised" | "bed":
            return [_part(piece, 0, 0, wide, deep, low, high), *_legs(piece, low)]


def _legs(piece: Furniture, high: float) -> list[Cuboid]:
    leg = piece.leg / 2
    x, y = piece.width / 2 - leg, piece.depth / 2 - leg
    return [_part(piece, a * x, b * y, leg, leg, 0, high) for a in (-1, 1) for b in (-1, 1) if high > 0]


def _part(
    piece: Furniture, x: float, y: float, half_width: float, half_depth: float, low: float, high: float
) -> Cuboid:
    cos, sin = float(np.cos(piece.turn)), float(np.sin(piece.turn))
    middle = piece.x + x * cos - y * sin, piece.y + x * sin + y * cos
    return Cuboid(*middle, half_width, half_depth, piece.turn, low, high, piece.shade)


def _partition(wall: Wall, height: float, shade: float) -> Cuboid:
    (x0, y0), (x1, y1) = wall.start, wall.end
    length, turn = float(np.hypot(x1 - x0, y1 - y0)), float(np.arctan2(y1 - y0, x1 - x0))
    half = wall.thickness / 2
    return Cuboid((x0 + x1) / 2, (y0 + y1) / 2, length / 2 + half, half, turn, 0, height, shade)

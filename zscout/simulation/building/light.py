"""The light of a room, computed once per plan: finely on the floor, coarsely on walls and furniture.

Lamps and windows are grids of points (soft shadows). A box hides from the floor each such point, and each direction
of the sky (walls and ceiling), within a convex shadow that OpenCV fills (projective shadows: Blinn, "Me and my (fake)
shadow", 1988). Directions of the sky are spread evenly over the disc, which weighs them by the cosine (Malley's
method). Furniture that hides the sky returns a share of the floor's light nearby, so light falls off inwards. Faces
are sampled at a few points, by rays against all boxes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from zscout.simulation.building.plan import Light, Noise, Plan, Receiver
from zscout.simulation.building.solids import Cuboids, Floats, cuboids_of

FINEST: Final = 0.025  # m of a floor cell, if the floor has at most MAX_CELLS
MAX_CELLS: Final = 40_000
SKY: Final = 96  # directions of the sky over the floor
FACE_SKY: Final = 24
ATLAS_WIDTH: Final = 32
FLUX: Final = 3.2  # intensity of a lamp of power 1: about 0.5 in the middle of 20 m2 below a ceiling of 2.5 m
AMBIENT: Final = 0.9  # light from walls and ceiling, as a share of the mean direct light on the floor
RETURNED: Final = 0.07  # share of the floor's light returned by furniture close above or beside it
FACES: Final = 5  # visible faces of a box, see `Lit.patches`
_SHIFT: Final = 4


@dataclass(frozen=True, slots=True)
class Lit:
    """Linear light by kind of source (index 0 lamps, 1 windows); 0.5 is usual."""

    cell: float  # m; the middle of cell [row, column] is at ((column + 0.5) cell, (row + 0.5) cell)
    floor: Floats  # shape (2, rows, columns)
    atlas: Floats  # light on faces, their patches in a column, shape (2, rows, ATLAS_WIDTH)
    patches: NDArray[np.int32]
    """Per face: first row, rows, columns of its patch; shape (faces, 3). 0 to 3: the outer walls y=0,
    x=width, y=depth, x=0; then for each box its sides -y, +x, +y, -x in its own axes, and its underside."""
    ambient: NDArray[np.float32]  # light from the sky, shape (2,)


def light_of(plan: Plan) -> Lit:
    """The light of a plan, cached by everything that affects it."""
    bare = {"people": (), "robots": (), "rugs": (), "covering": "plain", "noise": Noise(), "receiver": Receiver()}
    return _bake(msgspec.structs.replace(plan, name="", **bare))


@lru_cache(maxsize=16)
def _bake(plan: Plan) -> Lit:
    boxes = cuboids_of(plan)
    cell = max(FINEST, float(np.sqrt(plan.width * plan.depth / MAX_CELLS)))
    shape = (round(plan.depth / cell), round(plan.width / cell))
    kinds = [[light for light in plan.lights if light.kind == kind] for kind in ("lamp", "window")]
    sky = _floor_sky(boxes, cell, shape)
    floor = np.zeros((2, *shape), np.float32)
    ambient = np.zeros(2, np.float32)
    for kind, lights in enumerate(kinds):
        direct = _floor_direct(plan, lights, boxes, cell, shape)
        ambient[kind] = AMBIENT * float(direct.mean())
        first = direct + ambient[kind] * sky
        total = first
        for _ in range(4):
            total = first + (1 - sky) * RETURNED * cv2.GaussianBlur(total, (0, 0), 0.06 / cell)
        floor[kind] = cv2.GaussianBlur(total, (0, 0), 0.02 / cell)
    patches = _patches(plan, boxes)
    atlas = _faces(plan, boxes, kinds, patches, floor, cell, ambient)
    return Lit(cell, floor, atlas, patches, ambient)


def _points_of(light: Light, plan: Plan, across: int) -> tuple[Floats, Floats]:
    """Points of a light's area, shape (n, 3), and its direction, shape (3,)."""
    steps = ((np.arange(across) + 0.5) / across - 0.5).astype(np.float32)
    a, b = (grid.ravel() for grid in np.meshgrid(steps * light.width, steps * light.depth))
    flat = np.zeros_like(a)
    if light.kind == "lamp":
        z = light.z or plan.height - 0.02
        return np.stack((light.x + a, light.y + b, flat + z), 1), np.array([0, 0, -1], np.float32)
    edges = np.array([light.y, plan.width - light.x, plan.depth - light.y, light.x])
    side = int(edges.argmin())
    inward = np.array([[0, 1], [-1, 0], [0, -1], [1, 0]], np.float32)[side]
    x = light.x + (a if side % 2 == 0 else flat) + 0.01 * inward[0]
    y = light.y + (flat if side % 2 == 0 else a) + 0.01 * inward[1]
    return np.stack((x, y, light.z + b), 1).astype(np.float32), np.array([*inward, 0], np.float32)


def _shade_into(mask: NDArray[np.uint8], shadows: Floats, cell: float) -> None:
    """Set the convex hull of each box's points to 0; `shadows` has shape (n, 8, 2), metres."""
    scaled = np.clip((shadows / cell - 0.5) * (1 << _SHIFT), -300_000, 300_000).astype(np.int32)
    for points in scaled:
        cv2.fillConvexPoly(mask, cv2.convexHull(points), 0, shift=_SHIFT)


def _floor_direct(plan: Plan, lights: list[Light], boxes: Cuboids, cell: float, shape: tuple[int, int]) -> Floats:
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    x, y = (x + 0.5) * cell, (y + 0.5) * cell
    total = np.zeros(shape, np.float32)
    corners = boxes.corners()
    mask = np.empty(shape, np.uint8)
    for light in lights:
        points, facing = _points_of(light, plan, 4)
        intensity = FLUX * light.power / len(points)
        for point in points:
            across, along = point[0] - x, point[1] - y
            square = across * across + along * along + point[2] * point[2]
            leaving = -(across * facing[0] + along * facing[1] + point[2] * facing[2])
            got = intensity * np.maximum(leaving, 0) * point[2] / (square * square)
            mask.fill(1)
            cast = []
            for height in (boxes.low, boxes.high):
                # A box that reaches above the light is cut just below it, since its shadow is endless.
                height = np.minimum(height, point[2] - 0.02)
                away = (point[2] / (point[2] - height))[:, None, None]
                cast.append(point[:2] + (corners - point[:2]) * away)
            under = boxes.low < point[2] - 0.02
            _shade_into(mask, np.concatenate(cast, axis=1)[under], cell)
            total += got * mask
    return total


def _disc(count: int) -> tuple[Floats, Floats]:
    """`count` points spread evenly over the unit disc: a sunflower."""
    number = np.arange(count, dtype=np.float32)
    radius = np.sqrt((number + 0.5) / count)
    angle = number * np.float32(np.pi * (3 - np.sqrt(5)))
    return radius * np.cos(angle), radius * np.sin(angle)


def _floor_sky(boxes: Cuboids, cell: float, shape: tuple[int, int]) -> Floats:
    total = np.zeros(shape, np.float32)
    mask = np.empty(shape, np.uint8)
    corners = boxes.corners()
    for x, y in zip(*_disc(SKY), strict=True):
        slope = np.array([x, y], np.float32) / np.sqrt(max(1 - x * x - y * y, 1e-4))
        mask.fill(1)
        cast = [corners - slope * height[:, None, None] for height in (boxes.low, boxes.high)]
        _shade_into(mask, np.concatenate(cast, axis=1), cell)
        total += mask
    return np.asarray(total / SKY, np.float32)


def _patches(plan: Plan, boxes: Cuboids) -> NDArray[np.int32]:
    def patch(length: float, height: float) -> tuple[int, int]:
        return min(20, max(2, round(height / 0.12) + 1)), min(ATLAS_WIDTH, max(2, round(length / 0.15) + 1))

    sizes = [patch(length, plan.height) for length in (plan.width, plan.depth) * 2]
    for width, depth, low, high in zip(boxes.half_width * 2, boxes.half_depth * 2, boxes.low, boxes.high, strict=True):
        sizes += [patch(length, high - low) for length in (width, depth, width, depth)]
        sizes.append(patch(width, depth) if low > 0 else (1, 1))
    table = np.zeros((len(sizes), 3), np.int32)
    table[:, 1:] = sizes
    table[1:, 0] = np.cumsum(table[:-1, 1])
    return table


def _face_points(plan: Plan, boxes: Cuboids, patches: NDArray[np.int32]) -> tuple[Floats, Floats]:
    """Points on all faces and their normals, of shape (points, 3), in the order of the patches."""
    corners = boxes.corners()
    room = np.array([[0, 0], [plan.width, 0], [plan.width, plan.depth], [0, plan.depth]], np.float32)
    points, normals = [], []
    for face, (_, rows, columns) in enumerate(patches):
        across, along = np.meshgrid(np.linspace(0.02, 0.98, columns), np.linspace(0.02, 0.98, rows))
        u, v = across.ravel()[:, None].astype(np.float32), along.ravel().astype(np.float32)
        box, side = divmod(face - 4, FACES)
        if face >= 4 and side == 4:
            a, b, _, d = corners[box]
            flat = a + u * (b - a) + v[:, None] * (d - a)
            points.append(np.column_stack((flat, np.full(len(u), boxes.low[box] - 0.004, np.float32))))
            normals.append(np.tile(np.array([0, 0, -1], np.float32), (len(u), 1)))
            continue
        if face < 4:
            side, ring, low, high, sign = face, room, 0.0, plan.height, -1.0
        else:
            ring, low, high, sign = corners[box], float(boxes.low[box]), float(boxes.high[box]), 1.0
        a, b = ring[side], ring[(side + 1) % 4]
        way = (b - a) / max(float(np.hypot(*(b - a))), 1e-6)
        out = np.array([way[1], -way[0]], np.float32) * sign
        flat = a + u * (b - a) + out * 0.004
        points.append(np.column_stack((flat, low + v * (high - low))))
        normals.append(np.tile(np.array([*out, 0], np.float32), (len(u), 1)))
    return np.concatenate(points).astype(np.float32), np.concatenate(normals).astype(np.float32)


def hidden(origin: Floats, way: Floats, reach: Floats, boxes: Cuboids) -> NDArray[np.bool_]:
    """True for each ray that meets a box within `reach` times its way; origin and way (n, 3), reach (n,)."""
    found = np.zeros(len(origin), np.bool_)
    tiny = np.float32(1e-9)
    with np.errstate(over="ignore", invalid="ignore"):
        inverse_z = 1 / (way[:, 2] + tiny)
        for number in range(len(boxes)):
            cos, sin = boxes.cos[number], boxes.sin[number]
            dx, dy = origin[:, 0] - boxes.x[number], origin[:, 1] - boxes.y[number]
            enter, leave = np.zeros_like(reach), reach
            for start, speed, half in (
                (dx * cos + dy * sin, way[:, 0] * cos + way[:, 1] * sin, boxes.half_width[number]),
                (dy * cos - dx * sin, way[:, 1] * cos - way[:, 0] * sin, boxes.half_depth[number]),
            ):
                inverse = 1 / (speed + tiny)
                middle, spread = -start * inverse, np.abs(half * inverse)
                enter, leave = np.maximum(enter, middle - spread), np.minimum(leave, middle + spread)
            low = (boxes.low[number] - origin[:, 2]) * inverse_z
            high = (boxes.high[number] - origin[:, 2]) * inverse_z
            enter = np.maximum(enter, np.minimum(low, high))
            leave = np.minimum(leave, np.maximum(low, high))
            found |= enter < leave
    return found


def _faces(
    plan: Plan,
    boxes: Cuboids,
    kinds: list[list[Light]],
    patches: NDArray[np.int32],
    floor: Floats,
    cell: float,
    ambient: NDArray[np.float32],
) -> Floats:
    points, normals = _face_points(plan, boxes, patches)
    got = np.zeros((2, len(points)), np.float32)
    for kind, lights in enumerate(kinds):
        for light in lights:
            sources, facing = _points_of(light, plan, 2)
            for source in sources:
                way = source - points
                square = (way * way).sum(1)
                arriving, leaving = (way * normals).sum(1), -(way @ facing)
                seen = np.flatnonzero((arriving > 0) & (leaving > 0))
                seen = seen[~hidden(points[seen], way[seen], np.ones(len(seen), np.float32), boxes)]
                strength = FLUX * light.power / len(sources)
                got[kind, seen] += strength * arriving[seen] * leaving[seen] / (square[seen] ** 2)
    got += _face_sky(plan, points, normals, boxes, floor, cell, ambient)
    atlas = np.zeros((2, int(patches[-1, 0] + patches[-1, 1]), ATLAS_WIDTH), np.float32)
    at = 0
    for first, rows, columns in patches:
        size = int(rows * columns)
        atlas[:, first : first + rows, :columns] = got[:, at : at + size].reshape(2, rows, columns)
        at += size
    return atlas


def _face_sky(
    plan: Plan,
    points: Floats,
    normals: Floats,
    boxes: Cuboids,
    floor: Floats,
    cell: float,
    ambient: NDArray[np.float32],
) -> Floats:
    """Light on faces from walls, ceiling, floor and furniture, by a single bounce."""
    rows, columns = floor.shape[1:]

    def on_floor(x: Floats, y: Floats) -> Floats:
        column = np.clip(x / cell, 0, columns - 1).astype(np.intp)
        return floor[:, np.clip(y / cell, 0, rows - 1).astype(np.intp), column]

    total = np.zeros((2, len(points)), np.float32)
    below = on_floor(points[:, 0], points[:, 1]) * (0.5 * RETURNED)
    other = np.stack((-normals[:, 1], normals[:, 0], np.zeros(len(normals), np.float32)), 1)
    other[np.abs(normals[:, 2]) > 0.5] = (1, 0, 0)
    third = np.cross(normals, other)
    for a, b in zip(*_disc(FACE_SKY), strict=True):
        up = np.sqrt(max(1 - a * a - b * b, 0.0))
        way = (a * other + b * third + up * normals).astype(np.float32)
        # To the floor, or farther than any room is wide.
        fall = np.minimum(way[:, 2], -1e-3)
        reach = np.where(way[:, 2] < -1e-3, -points[:, 2] / fall, 30).astype(np.float32)
        end_x, end_y = points[:, 0] + way[:, 0] * reach, points[:, 1] + way[:, 1] * reach
        down = (way[:, 2] < 0) & (end_x > 0) & (end_x < plan.width) & (end_y > 0) & (end_y < plan.depth)
        sky = np.where(down, plan.floor_shade * on_floor(end_x, end_y), ambient[:, None])
        total += np.where(hidden(points, way, reach, boxes), below, sky)
    return np.asarray(total / FACE_SKY, np.float32)

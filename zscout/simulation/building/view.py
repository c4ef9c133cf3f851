"""A building from above: its plan as a picture, and current positions.

The floor shows its light. Pieces on the floor are solid; pieces that robots drive under are outlined and show the
shadow below; thin lines are people's paths.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from zscout.messages.behaviors import MAX_PEOPLE, MAX_PLAN, MAX_ROBOTS, BuildingPlan, BuildingPoses, Placed
from zscout.simulation.building.light import light_of
from zscout.simulation.building.plan import ROBOT_HEIGHT, Furniture, Light, Plan
from zscout.simulation.building.solids import Cuboids, as_arrays, cuboids_of, parts
from zscout.simulation.building.world import World

Picture = NDArray[np.uint8]
Colour = tuple[int, int, int]

SCALE: Final = 200.0  # pixels per metre, if no side gets larger than MAX_SIDE
MAX_SIDE: Final = 1000  # pixels
MAX_PNG: Final = MAX_PLAN * 7 // 10  # bytes; JSON takes a third more
SHRINK: Final = 0.8
BRIGHT: Final = 1.6  # light of a white floor, in medians
_GAMMA: Final = 1 / 2.2
_SUB: Final = 4  # bits of a pixel's fraction in OpenCV's drawing
_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX

# Blue, green, red.
_NIGHT: Final = np.array([52, 34, 26], np.float32)
_DAY: Final = np.array([222, 240, 248], np.float32)
_INK: Final = (58, 42, 34)
_PAPER: Final = (250, 250, 250)
_WOOD: Final = (104, 132, 158)
_WALL: Final = (92, 88, 86)
_RUG: Final = (110, 84, 126)
_LAMP: Final = (60, 200, 255)
_WINDOW: Final = (236, 178, 84)
_WAY: Final = (150, 110, 60)


def building_plan(plan: Plan) -> BuildingPlan:
    """The plan as a message, its picture shrunk to MAX_PNG."""
    scale = min(SCALE, MAX_SIDE / max(plan.width, plan.depth))
    while len(png := plan_picture(plan, scale)) > MAX_PNG:
        scale *= SHRINK
    return BuildingPlan(name=plan.name[:64], width=plan.width, depth=plan.depth, picture=png)


def plan_picture(plan: Plan, scale: float = SCALE) -> bytes:
    """A PNG of the plan within its outer walls, at `scale` pixels per metre, x to the right, y up."""
    picture = _Sheet(plan, scale)
    picture.rugs()
    picture.ways()
    picture.walls()
    for piece in plan.furniture:
        picture.furniture(piece)
    for light in plan.lights:
        picture.light(light)
    picture.names()
    return cv2.imencode(".png", picture.pixels, [cv2.IMWRITE_PNG_COMPRESSION, 9])[1].tobytes()


def poses(world: World, speed: float = 1.0) -> BuildingPoses:
    robots = [
        Placed(
            name=name[:64],
            x=body.x,
            y=body.y,
            heading=body.heading,
            camera=body.camera or 0,
            hidden=body.still and world.is_dark(name),
        )
        for name, body in list(world.bodies.items())[:MAX_ROBOTS]
    ]
    people = [
        Placed(name=person.name[:64], x=walker.x, y=walker.y)
        for person, walker in zip(world.plan.people, world.walkers, strict=True)
        if walker.here
    ]
    return BuildingPoses(time=world.time, speed=speed, robots=robots, people=people[:MAX_PEOPLE])


class _Sheet:
    def __init__(self, plan: Plan, scale: float) -> None:
        self.plan, self.scale = plan, scale
        size = max(2, round(plan.width * scale)), max(2, round(plan.depth * scale))
        light = light_of(plan).floor.sum(axis=0)
        share = np.clip(light / max(float(np.median(light)) * BRIGHT, 1e-6), 0, 1) ** _GAMMA
        # The map's rows go up, a picture's rows down.
        share = cv2.resize(share[::-1].astype(np.float32), size, interpolation=cv2.INTER_CUBIC).clip(0, 1)
        self.pixels: Picture = (_NIGHT + share[..., None] * (_DAY - _NIGHT)).astype(np.uint8)
        self._names: list[tuple[str, float, float, float]] = []

    def rugs(self) -> None:
        for rug in self.plan.rugs:
            flat = Furniture("rug", "solid", rug.x, rug.y, rug.width, rug.depth, 0.01, rug.turn)
            self._fill(as_arrays(parts(flat)), _RUG, 0.35)

    def ways(self) -> None:
        for person in self.plan.people:
            line = self._pixels(np.array(person.path, np.float32))
            cv2.polylines(self.pixels, [line], False, _WAY, 1, cv2.LINE_AA, _SUB)

    def walls(self) -> None:
        plan = self.plan
        if plan.walls:
            inside = cuboids_of(plan)
            self._fill(inside.where(np.arange(len(inside)) < len(plan.walls)), _WALL, 1.0)
        high, wide = self.pixels.shape[:2]
        cv2.rectangle(self.pixels, (0, 0), (wide - 1, high - 1), _WALL, max(2, round(self.scale * 0.03)))

    def furniture(self, piece: Furniture) -> None:
        boxes = as_arrays(parts(piece))
        stands = boxes.low < ROBOT_HEIGHT
        over = boxes.where(~stands)
        if len(over):
            self._fill(over, _WOOD, 0.22)
            self._outline(over, _INK)
        self._fill(boxes.where(stands), _WOOD if not len(over) else _INK, 1.0)
        if not len(over):
            self._outline(boxes, _INK)
        across = abs(np.cos(piece.turn)) * piece.width + abs(np.sin(piece.turn)) * piece.depth
        self._names.append((piece.name, piece.x, piece.y, float(across)))

    def light(self, light: Light) -> None:
        if light.kind == "window":
            along_x = min(light.y, self.plan.depth - light.y) < min(light.x, self.plan.width - light.x)
            half = light.width / 2
            way = np.array([[half, 0], [-half, 0]] if along_x else [[0, half], [0, -half]], np.float32)
            ends = self._pixels(way + np.array([light.x, light.y], np.float32))
            cv2.polylines(self.pixels, [ends], False, _WINDOW, max(3, round(self.scale * 0.06)), cv2.LINE_AA, _SUB)
            return
        ((x, y),) = self._pixels(np.array([[light.x, light.y]], np.float32))
        radius = max(4, round(self.scale * 0.05)) << _SUB
        cv2.circle(self.pixels, (int(x), int(y)), radius, _LAMP, -1, cv2.LINE_AA, _SUB)
        cv2.circle(self.pixels, (int(x), int(y)), radius, _INK, 1, cv2.LINE_AA, _SUB)

    def names(self) -> None:
        """Draw last, so that nothing covers names; a rim makes them legible on dark and light floor."""
        high, wide = self.pixels.shape[:2]
        for name, x, y, across in self._names:
            text, size = name.replace("_", " "), 0.5
            room = max(across * self.scale - 4, 56.0)
            (width, height), _ = cv2.getTextSize(text, _FONT, size, 1)
            if width > room:
                size = max(0.36, size * room / width)
                (width, height), _ = cv2.getTextSize(text, _FONT, size, 1)
            left = int(np.clip(x * self.scale - width / 2, 4, max(4, wide - width - 4)))
            low = (self.plan.depth - y) * self.scale + height / 2
            base = left, int(np.clip(low, height + 4, max(height + 4, high - 5)))
            # Not a thicker text below: in OpenCV 5 that is also wider.
            for way_x, way_y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                at = base[0] + way_x, base[1] + way_y
                cv2.putText(self.pixels, text, at, _FONT, size, _PAPER, 1, cv2.LINE_AA)
            cv2.putText(self.pixels, text, base, _FONT, size, _INK, 1, cv2.LINE_AA)

    def _pixels(self, places: NDArray[np.float32]) -> NDArray[np.int32]:
        """Places [x, y] in metres, shape (..., 2), as OpenCV's fixed-point pixels."""
        flipped = places * np.array([1, -1], np.float32) + np.array([0, self.plan.depth], np.float32)
        fixed: NDArray[np.int32] = np.round(flipped * self.scale * (1 << _SUB)).astype(np.int32)
        return fixed

    def _fill(self, boxes: Cuboids, colour: Colour, cover: float) -> None:
        corners = self._pixels(boxes.corners())
        if cover >= 1:
            for corner in corners:
                cv2.fillConvexPoly(self.pixels, corner, colour, cv2.LINE_AA, _SUB)
            return
        mask = np.zeros(self.pixels.shape[:2], np.uint8)
        for corner in corners:
            cv2.fillConvexPoly(mask, corner, 255, cv2.LINE_AA, _SUB)
        part = (mask.astype(np.float32) * (cover / 255))[..., None]
        self.pixels = (self.pixels + part * (np.array(colour, np.float32) - self.pixels)).astype(np.uint8)

    def _outline(self, boxes: Cuboids, colour: Colour) -> None:
        cv2.polylines(self.pixels, list(self._pixels(boxes.corners())), True, colour, 1, cv2.LINE_AA, _SUB)

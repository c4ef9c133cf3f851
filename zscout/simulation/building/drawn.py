"""Plausible rooms drawn at random, with hiding places and decoys.

A room has a door, a window, one or two lamps, low furniture that robots drive under (sofas, beds, sideboards), tables
and chairs, solid pieces (shelves, cartons, a black box), and sometimes a dark rug. People cross it from the door and
back. Pieces never overlap, and a robot can pass between them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from typing import Final, NamedTuple

import cv2
import msgspec
import numpy as np

from zscout.simulation.building.plan import Covering, Furniture, Kind, Light, Noise, Person, Plan, Receiver, Robot, Rug
from zscout.simulation.building.world import World

TRIES: Final = 30  # rooms drawn at most for a plan
WAY: Final = 0.28  # m between two pieces
HIDES: Final = 2  # least hiding places of a room
HIDE_AREA: Final = 0.06  # m2, least dark floor of a hiding place, for the middle of a robot
FIRST_ROBOT: Final = 33
DOOR: Final = 0.9
STRIDE: Final = 0.25  # m between a walker's way and furniture


class Template(NamedTuple):
    """A kind of piece, and the ranges of its measures, metres."""

    name: str
    kind: Kind
    width: tuple[float, float]
    depth: tuple[float, float]
    height: tuple[float, float]
    clearance: tuple[float, float] = (0.12, 0.12)
    shade: tuple[float, float] = (0.25, 0.5)
    at_wall: bool = True


LOW: Final = (
    Template("sofa", "sofa", (1.4, 2.1), (0.75, 0.95), (0.75, 0.9), (0.10, 0.14)),
    Template("armchair", "sofa", (0.8, 0.95), (0.8, 0.95), (0.8, 0.9), (0.10, 0.14)),
    Template("bed", "bed", (0.9, 1.6), (1.9, 2.0), (0.45, 0.6), (0.12, 0.20)),
    Template("sideboard", "raised", (1.2, 1.8), (0.45, 0.55), (0.7, 0.85), (0.11, 0.15)),
    Template("wardrobe", "raised", (1.0, 1.6), (0.55, 0.65), (1.8, 2.0), (0.10, 0.14)),
)
"""Robots drive under these, and it is dark there."""
OTHERS: Final = (
    Template("table", "table", (1.0, 1.6), (0.7, 0.9), (0.7, 0.76), at_wall=False),
    Template("coffee_table", "table", (0.7, 1.1), (0.5, 0.6), (0.4, 0.46), at_wall=False),
    Template("desk", "desk", (1.2, 1.6), (0.65, 0.8), (0.72, 0.76)),
    Template("chair", "chair", (0.4, 0.46), (0.4, 0.46), (0.85, 0.95), at_wall=False),
    Template("chair", "chair", (0.4, 0.46), (0.4, 0.46), (0.85, 0.95), at_wall=False),
    Template("shelf", "shelf", (0.8, 1.4), (0.28, 0.36), (1.2, 2.0)),
    Template("carton", "solid", (0.35, 0.5), (0.3, 0.45), (0.3, 0.5), shade=(0.3, 0.45), at_wall=False),
    Template("black_box", "solid", (0.3, 0.45), (0.25, 0.4), (0.3, 0.45), shade=(0.03, 0.06), at_wall=False),
    Template("plant", "solid", (0.25, 0.35), (0.25, 0.35), (0.5, 1.2), shade=(0.1, 0.3)),
)
COVERINGS: Final[tuple[Covering, ...]] = ("plain", "planks", "tiles", "carpet")


def drawn_plan(seed: int, *, robots: int = 4) -> Plan:
    """A room of 3.2 to 6.5 m a side, reproducible, with at least HIDES hiding places that robots can reach. Raises
    ValueError if none of TRIES rooms has them."""
    rng = np.random.default_rng((seed, 0xD7A))
    for _ in range(TRIES):
        plan = _room(rng, f"drawn-{seed}")
        if len(hiding_places(plan)) >= HIDES:
            with suppress(ValueError):
                return with_robots(plan, robots, seed=seed)
    raise ValueError(f"no room of {TRIES} drawn from seed {seed} had {HIDES} places to hide; use another seed")


def with_robots(plan: Plan, count: int, *, seed: int = 0) -> Plan:
    """Add `count` robots, scout33, scout35 and so on, on open and lit floor. Raises ValueError if they have no room."""
    bare = msgspec.structs.replace(plan, robots=())
    world, rng = World(bare), np.random.default_rng((seed, 0x5C0))
    robots: list[Robot] = []
    for number in range(count):
        for _ in range(500):
            pose = world.random_start(rng)
            if all(math.dist((pose.x, pose.y), (other.x, other.y)) > WAY for other in robots):
                break
        else:
            raise ValueError(f"{plan.name} has no open floor for {count} robots")
        name = FIRST_ROBOT + 2 * number
        x, y, heading = (round(value, 3) for value in pose)
        robots.append(Robot(f"scout{name}", name, x, y, heading))
    return msgspec.structs.replace(plan, robots=tuple(robots))


def hiding_places(plan: Plan) -> list[float]:
    """Square metres of each hiding place that a robot can reach from the open floor."""
    truth = World(msgspec.structs.replace(plan, robots=())).truth
    if not truth.open.any():
        return []
    _, parts = cv2.connectedComponents(truth.standing.astype(np.uint8), connectivity=4)
    counts = np.bincount(parts[truth.open])
    # Robots start on the largest piece of floor.
    dark = truth.dark & (parts == int(np.argmax(counts)))
    _, _, stats, _ = cv2.connectedComponentsWithStats(dark.astype(np.uint8), connectivity=4)
    areas = stats[1:, cv2.CC_STAT_AREA] * truth.cell**2
    return [float(area) for area in areas if area >= HIDE_AREA]


def _uniform(rng: np.random.Generator, low: float, high: float, digits: int = 2) -> float:
    return round(float(rng.uniform(low, high)), digits)


def _room(rng: np.random.Generator, name: str) -> Plan:
    width, depth = (round(float(side), 2) for side in rng.uniform(3.2, 6.5, 2))
    door = _uniform(rng, 0.8, width - 0.8)
    furniture = [Furniture("door", "solid", door, 0.02, DOOR, 0.04, 2.05, shade=0.75)]
    # The floor before the door stays free.
    taken = [_Footprint(door, 0.5, DOOR, 1.0, 0.0)]
    low = [LOW[int(at)] for at in rng.choice(len(LOW), int(rng.integers(2, 4)), replace=False)]
    chosen = rng.permutation(len(OTHERS))[: int(rng.integers(3, len(OTHERS) + 1))]
    for template in [*low, *(OTHERS[int(at)] for at in chosen)]:
        piece = _put(rng, template, width, depth, taken, len(furniture))
        if piece is not None:
            furniture.append(piece)
    window = _uniform(rng, 0.9, width - 0.9)
    lamps = [
        Light(
            f"lamp{number + 1}",
            round(width * at, 2),
            round(depth / 2 + float(rng.uniform(-0.4, 0.4)), 2),
            width=0.4,
            depth=0.4,
            power=round(float(rng.uniform(0.7, 1.1)) * width * depth / 20, 2),
        )
        for number, at in enumerate((0.5,) if width < 5 else (0.3, 0.7))
    ]
    sun = Light("window", window, depth, 1.4, 1.2, 1.0, _uniform(rng, 0.3, 1.0), "window")
    measures = [_uniform(rng, low, high) for low, high in ((0.8, 1.6), (0.6, 1.2), (-0.4, 0.4), (0.08, 0.3))]
    rug = Rug(round(width / 2, 2), round(depth / 2, 2), *measures)
    return Plan(
        name=name,
        width=width,
        depth=depth,
        height=_uniform(rng, 2.4, 2.8),
        covering=COVERINGS[int(rng.integers(len(COVERINGS)))],
        floor_shade=_uniform(rng, 0.3, 0.5),
        wall_shade=_uniform(rng, 0.5, 0.7),
        noise=Noise(flicker=_uniform(rng, 0, 0.02, 3)),
        receiver=Receiver(x=round(width - 0.2, 2), y=0.2),
        furniture=tuple(furniture),
        rugs=(rug,) if rng.random() < 0.5 else (),
        lights=(*lamps, sun),
        people=_people(rng, door, width, depth, taken[1:]),
    )


class _Footprint(NamedTuple):
    x: float
    y: float
    width: float
    depth: float
    turn: float

    def gap(self, x: float, y: float) -> float:
        """Metres from a place to the piece; at most 0 inside."""
        cos, sin = math.cos(-self.turn), math.sin(-self.turn)
        across = abs((x - self.x) * cos - (y - self.y) * sin) - self.width / 2
        along = abs((x - self.x) * sin + (y - self.y) * cos) - self.depth / 2
        outside = math.hypot(max(across, 0), max(along, 0))
        return outside if outside > 0 else max(across, along)

    def corners(self) -> list[tuple[float, float]]:
        cos, sin = math.cos(self.turn), math.sin(self.turn)
        halves = [(a * self.width / 2, b * self.depth / 2) for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
        middles = [(a * self.width / 2, b * self.depth / 2) for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1), (0, 0))]
        return [(self.x + a * cos - b * sin, self.y + a * sin + b * cos) for a, b in halves + middles]

    def clear_of(self, others: Sequence[_Footprint], way: float) -> bool:
        return all(
            other.gap(*corner) >= way and self.gap(*back) >= way
            for other in others
            for corner, back in zip(self.corners(), other.corners(), strict=True)
        )


def _put(
    rng: np.random.Generator, template: Template, width: float, depth: float, taken: list[_Footprint], number: int
) -> Furniture | None:
    """Add a piece to `taken` where it has room; None if it has none."""
    wide, deep, high, clearance, shade = (
        _uniform(rng, *measure)
        for measure in (template.width, template.depth, template.height, template.clearance, template.shade)
    )
    for _ in range(60):
        if template.at_wall:
            side = int(rng.integers(4))
            turn = (0.0, math.pi / 2, math.pi, -math.pi / 2)[side]
            off = deep / 2 + float(rng.uniform(0.02, 0.06))
            length = width if side in (0, 2) else depth
            if length < wide + 0.3:
                continue
            along = float(rng.uniform(wide / 2 + 0.05, length - wide / 2 - 0.05))
            x, y = ((along, depth - off), (off, along), (along, off), (width - off, along))[side]
        else:
            turn = float(rng.uniform(-math.pi, math.pi))
            x, y = float(rng.uniform(0.5, width - 0.5)), float(rng.uniform(0.6, depth - 0.5))
        footprint = _Footprint(x, y, wide, deep, turn)
        if not template.at_wall and not all(
            WAY < px < width - WAY and WAY < py < depth - WAY for px, py in footprint.corners()
        ):
            continue
        if footprint.clear_of(taken, WAY):
            taken.append(footprint)
            name, at = f"{template.name}{number}", (round(x, 3), round(y, 3))
            return Furniture(name, template.kind, *at, wide, deep, high, round(turn, 4), clearance, shade=shade)
    return None


def _people(
    rng: np.random.Generator, door: float, width: float, depth: float, taken: Sequence[_Footprint]
) -> tuple[Person, ...]:
    """One or two people who come in, walk straight from place to place, and leave."""
    people = []
    for number in range(int(rng.integers(1, 3))):
        path = [(door, -0.6), (door, 0.6)]
        for _ in range(200):
            x, y = float(rng.uniform(0.4, width - 0.4)), float(rng.uniform(0.5, depth - 0.4))
            if math.dist(path[-1], (x, y)) > 0.8 and _walkable(path[-1], (x, y), taken):
                path.append((round(x, 2), round(y, 2)))
            if len(path) == 5:
                break
        speed, first, every = _uniform(rng, 0.7, 1.3), _uniform(rng, 10, 40, 1), _uniform(rng, 20, 60, 1)
        way = (*path, *path[-2::-1])
        people.append(Person(f"person{number + 1}", way, speed, first, every, shade=_uniform(rng, 0.12, 0.45)))
    return tuple(people)


def _walkable(start: tuple[float, float], end: tuple[float, float], taken: Sequence[_Footprint]) -> bool:
    steps = max(2, round(math.dist(start, end) / 0.1))
    return all(
        piece.gap(start[0] + (end[0] - start[0]) * n / steps, start[1] + (end[1] - start[1]) * n / steps) > STRIDE
        for n in range(steps + 1)
        for piece in taken
    )

"""A building on paper: the TOML that describes one, read strictly."""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta, Struct

from zscout.packets import MAX_ROBOT
from zscout.strict import Where, check_name, check_unique, read_toml

MAX_WALLS: Final = 24
MAX_FURNITURE: Final = 60
MAX_RUGS: Final = 16
MAX_LIGHTS: Final = 8
MAX_PEOPLE: Final = 8
MAX_ROBOTS: Final = 16
MAX_CORNERS: Final = 16
MAX_BYTES: Final = 100_000
PORCH: Final = 1.0
"""Metres beyond the outer walls that a person's path may begin and end at: they come in by a door."""
ROBOT_HEIGHT: Final = 0.05
"""Metres; what stands higher above the floor than this is driven under."""

Size = Annotated[float, Meta(ge=0.01, le=20)]
Place = Annotated[float, Meta(ge=-2, le=22)]
Angle = Annotated[float, Meta(ge=-7, le=7)]
Shade = Annotated[float, Meta(ge=0.01, le=0.95)]
Share = Annotated[float, Meta(ge=0, le=1)]
Point = Annotated[tuple[Place, ...], Meta(max_length=2)]
"""A place [x, y] in metres. Two numbers: checked after reading."""

Kind = Literal["solid", "table", "desk", "chair", "raised", "sofa", "bed", "shelf"]
Covering = Literal["plain", "planks", "tiles", "carpet"]


class Wall(Struct, frozen=True, forbid_unknown_fields=True):
    """A partition between two points, up to the ceiling."""

    start: Point
    end: Point
    thickness: Annotated[float, Meta(ge=0.02, le=1)] = 0.1


class Furniture(Struct, frozen=True, forbid_unknown_fields=True):
    """One piece: its middle, its extent before it is turned about that, and how far it is off the floor.

    `solid` and `shelf` stand on the floor; a `table` is a slab on four legs, a `chair` has a back as well, a
    `desk` panels at its sides; `raised`, `sofa` and `bed` are bodies on short feet, `clearance` above it."""

    name: str
    kind: Kind
    x: Place
    y: Place
    width: Annotated[float, Meta(ge=0.03, le=6)]
    depth: Annotated[float, Meta(ge=0.03, le=6)]
    height: Annotated[float, Meta(ge=0.01, le=4)]
    turn: Angle = 0.0
    clearance: Annotated[float, Meta(ge=0, le=2)] = 0.12
    leg: Annotated[float, Meta(ge=0.02, le=0.3)] = 0.05
    """Metres of a leg or foot, square."""
    shade: Shade = 0.4
    """Share of the light that it gives back."""


class Rug(Struct, frozen=True, forbid_unknown_fields=True):
    """A flat thing on the floor. A dark one looks like shadow and hides nobody."""

    x: Place
    y: Place
    width: Annotated[float, Meta(ge=0.05, le=10)]
    depth: Annotated[float, Meta(ge=0.05, le=10)]
    turn: Angle = 0.0
    shade: Shade = 0.2


class Light(Struct, frozen=True, forbid_unknown_fields=True):
    """A lamp that shines down from `z` (none given: the ceiling), or a window in an outer wall.

    A window is `width` along its wall by `depth` in height, `z` its middle; only it follows the daylight."""

    name: str
    x: Place
    y: Place
    z: Annotated[float, Meta(ge=0, le=6)] = 0.0
    width: Size = 0.5
    depth: Size = 0.5
    power: Annotated[float, Meta(ge=0, le=1000)] = 1.0
    """1 gives a usual room of 20 m2 its usual light."""
    kind: Literal["lamp", "window"] = "lamp"


class Person(Struct, frozen=True, forbid_unknown_fields=True):
    """Somebody who walks a path now and then; between walks he is out of the building."""

    name: str
    path: Annotated[tuple[Point, ...], Meta(max_length=MAX_CORNERS)]
    speed: Annotated[float, Meta(ge=0.1, le=3)] = 1.0
    first: Annotated[float, Meta(ge=0, le=100_000)] = 20.0
    """Seconds until the first walk."""
    every: Annotated[float, Meta(ge=1, le=100_000)] = 60.0
    """Seconds from the end of a walk to the next."""
    jitter: Share = 0.3
    """Share of `first` and `every` by which they may differ from walk to walk."""
    walks: Annotated[int, Meta(ge=0, le=1_000_000)] = 0
    """How many walks at most; 0: no end."""
    shade: Shade = 0.25


class Robot(Struct, frozen=True, forbid_unknown_fields=True):
    """A Scout at its start."""

    name: str
    id: Annotated[int, Meta(ge=0, le=MAX_ROBOT)]
    x: Place
    y: Place
    heading: Angle = 0.0
    slip: Annotated[float, Meta(ge=0, le=0.3)] = 0.03
    """How much the wheels differ from what they are told: a constant share each, and noise beside it."""


class Noise(Struct, frozen=True, forbid_unknown_fields=True):
    """What spoils pictures; 1 is a usual cheap camera."""

    sensor: Annotated[float, Meta(ge=0, le=10)] = 1.0
    """Factor on the camera's own noise."""
    analog: Annotated[float, Meta(ge=0, le=10)] = 1.0
    """Factor on what the air adds."""
    flicker: Annotated[float, Meta(ge=0, le=0.5)] = 0.01
    """Share by which lamps differ from picture to picture."""
    daylight: Annotated[float, Meta(ge=0, le=0.95)] = 0.1
    """Share by which windows grow brighter and darker, slowly."""
    daylight_period: Annotated[float, Meta(ge=10, le=100_000)] = 600.0
    """Seconds from bright to bright."""


class Receiver(Struct, frozen=True, forbid_unknown_fields=True):
    """Where the video receivers stand."""

    x: Place = 0.0
    y: Place = 0.0
    range: Annotated[float, Meta(ge=1, le=1_000)] = 30.0
    """Metres at which half of the picture is noise."""


class Plan(Struct, frozen=True, forbid_unknown_fields=True):
    """A building of one outer rectangle, from (0, 0) to (`width`, `depth`), metres."""

    name: str
    width: Annotated[float, Meta(ge=1.5, le=20)]
    depth: Annotated[float, Meta(ge=1.5, le=20)]
    height: Annotated[float, Meta(ge=1.8, le=6)] = 2.5
    covering: Covering = "planks"
    floor_shade: Shade = 0.4
    wall_shade: Shade = 0.6
    noise: Noise = Noise()
    receiver: Receiver = Receiver()
    walls: Annotated[tuple[Wall, ...], Meta(max_length=MAX_WALLS)] = msgspec.field(name="wall", default=())
    furniture: Annotated[tuple[Furniture, ...], Meta(max_length=MAX_FURNITURE)] = ()
    rugs: Annotated[tuple[Rug, ...], Meta(max_length=MAX_RUGS)] = msgspec.field(name="rug", default=())
    lights: Annotated[tuple[Light, ...], Meta(max_length=MAX_LIGHTS)] = msgspec.field(
        name="light", default=()
    )
    people: Annotated[tuple[Person, ...], Meta(max_length=MAX_PEOPLE)] = msgspec.field(
        name="person", default=()
    )
    robots: Annotated[tuple[Robot, ...], Meta(max_length=MAX_ROBOTS)] = msgspec.field(
        name="robot", default=()
    )


def load_plan(path: Path) -> Plan:
    """Reads a building. Raises BadInput, which names file, key and remedy."""
    # Here, since what stands where is made of plans.
    from zscout.simulation.collisions import check_starts

    plan = read_toml(path, Plan, max_bytes=MAX_BYTES)
    top = Where(str(path))
    check_plan(plan, top)
    check_starts(plan, top)
    return plan


def shipped_plans() -> dict[str, Path]:
    """The buildings that come with zscout, by name."""
    folder = Path(str(resources.files("zscout.simulation"))) / "buildings"
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def check_plan(plan: Plan, top: Where) -> None:
    """Refuses a plan whose parts do not go together. Raises BadInput."""
    check_name(plan.name, top / "name")
    if not plan.lights:
        raise (top / "light").bad("there is none", "add a [[light]]: cameras see nothing without")
    named: tuple[tuple[str, Sequence[Furniture | Light | Person | Robot]], ...] = (
        ("furniture", plan.furniture),
        ("light", plan.lights),
        ("person", plan.people),
        ("robot", plan.robots),
    )
    for key, things in named:
        for number, thing in enumerate(things):
            check_name(thing.name, (top / key).item(number, thing.name) / "name")
        check_unique([thing.name for thing in things], top / key, "name")
    check_unique([str(robot.id) for robot in plan.robots], top / "robot", "id")
    for number, wall in enumerate(plan.walls):
        where = (top / "wall").item(number)
        _check_point(wall.start, plan, where / "start")
        _check_point(wall.end, plan, where / "end")
        if math.dist(wall.start, wall.end) < 0.05:
            raise where.bad("is shorter than 0.05 m", "move its end")
    flat_things: tuple[tuple[str, Sequence[Furniture | Rug | Robot]], ...] = (
        ("furniture", plan.furniture),
        ("rug", plan.rugs),
        ("robot", plan.robots),
    )
    for key, flat in flat_things:
        for number, placed in enumerate(flat):
            name = getattr(placed, "name", "")
            _check_point((placed.x, placed.y), plan, (top / key).item(number, name))
    for number, piece in enumerate(plan.furniture):
        _check_piece(piece, plan, (top / "furniture").item(number, piece.name))
    for number, light in enumerate(plan.lights):
        _check_light(light, plan, (top / "light").item(number, light.name))
    for number, person in enumerate(plan.people):
        where = (top / "person").item(number, person.name) / "path"
        if len(person.path) < 2:
            raise where.bad(f"has {len(person.path)} point(s)", "write two or more, as in [[0.5, 1], [3, 1]]")
        for corner, point in enumerate(person.path):
            _check_point(point, plan, where.item(corner, person.name), PORCH)
        if all(math.dist(person.path[0], point) < 0.1 for point in person.path):
            raise where.bad("leads nowhere", "move one of its points by 0.1 m or more")


def _check_point(point: tuple[float, ...], plan: Plan, where: Where, beyond: float = 0.0) -> None:
    if len(point) != 2:
        raise where.bad(f"has {len(point)} number(s)", "write a place as [x, y]")
    x, y = point
    if not (-beyond <= x <= plan.width + beyond and -beyond <= y <= plan.depth + beyond):
        raise where.bad(
            f"({x:g}, {y:g}) is outside",
            f"write x from {0 - beyond:g} to {plan.width + beyond:g}, y from {0 - beyond:g} to "
            f"{plan.depth + beyond:g}",
        )


def _check_piece(piece: Furniture, plan: Plan, where: Where) -> None:
    if piece.height > plan.height:
        remedy = f"write at most {plan.height:g}, the room's"
        raise (where / "height").bad(f"is {piece.height:g} m", remedy)
    if piece.kind in ("raised", "sofa", "bed") and piece.clearance + 0.02 > piece.height:
        remedy = f"write at most {piece.height - 0.02:g}, below the height"
        raise (where / "clearance").bad(f"is {piece.clearance:g} m", remedy)
    if piece.kind not in ("solid", "shelf") and 2 * piece.leg > min(piece.width, piece.depth):
        remedy = f"write at most {min(piece.width, piece.depth) / 2:g}, half of the piece"
        raise (where / "leg").bad(f"is {piece.leg:g} m", remedy)


def _check_light(light: Light, plan: Plan, where: Where) -> None:
    _check_point((light.x, light.y), plan, where)
    if light.z > plan.height:
        raise (where / "z").bad(f"is {light.z:g} m", f"write at most {plan.height:g}, the room's height")
    if light.kind == "window":
        edge = min(light.x, plan.width - light.x, light.y, plan.depth - light.y)
        if edge > 0.01:
            raise where.bad("is a window in no outer wall", "put its x or y on an outer wall")
        if not light.depth / 2 <= light.z <= plan.height - light.depth / 2:
            raise (where / "z").bad(
                f"is {light.z:g} m, so the window leaves its wall",
                "give the height of its middle, half its depth or more from floor and ceiling",
            )

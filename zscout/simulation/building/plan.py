"""The plan of a building, as in its TOML file."""

from __future__ import annotations

from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta, Struct

from zscout.types import MAX_ROBOT

MAX_WALLS: Final = 24
MAX_FURNITURE: Final = 60
MAX_RUGS: Final = 16
MAX_LIGHTS: Final = 8
MAX_PEOPLE: Final = 8
MAX_ROBOTS: Final = 16
MAX_CORNERS: Final = 16
ROBOT_HEIGHT: Final = 0.05  # m; robots drive under anything higher above the floor

Size = Annotated[float, Meta(ge=0.01, le=20)]
Place = Annotated[float, Meta(ge=-2, le=22)]
Angle = Annotated[float, Meta(ge=-7, le=7)]
Shade = Annotated[float, Meta(ge=0.01, le=0.95)]
Share = Annotated[float, Meta(ge=0, le=1)]
Point = Annotated[tuple[Place, ...], Meta(max_length=2)]
"""A place [x, y] in metres; its length is checked after reading."""

Kind = Literal["solid", "table", "desk", "chair", "raised", "sofa", "bed", "shelf"]
Covering = Literal["plain", "planks", "tiles", "carpet"]


class Wall(Struct, frozen=True, forbid_unknown_fields=True):
    """Up to the ceiling."""

    start: Point
    end: Point
    thickness: Annotated[float, Meta(ge=0.02, le=1)] = 0.1


class Furniture(Struct, frozen=True, forbid_unknown_fields=True):
    """A piece by its middle and its extent before it is turned. `solid` and `shelf` touch the floor; a `table` is a
    slab on four legs, a `chair` also has a back, a `desk` panels at its sides; `raised`, `sofa` and `bed` are bodies on
    short feet, `clearance` above the floor."""

    name: str
    kind: Kind
    x: Place
    y: Place
    width: Annotated[float, Meta(ge=0.03, le=6)]
    depth: Annotated[float, Meta(ge=0.03, le=6)]
    height: Annotated[float, Meta(ge=0.01, le=4)]
    turn: Angle = 0.0
    clearance: Annotated[float, Meta(ge=0, le=2)] = 0.12
    leg: Annotated[float, Meta(ge=0.02, le=0.3)] = 0.05  # m, side of a square leg or foot
    shade: Shade = 0.4  # share of the light that is reflected


class Rug(Struct, frozen=True, forbid_unknown_fields=True):
    """A dark rug looks like shadow, but hides no robot."""

    x: Place
    y: Place
    width: Annotated[float, Meta(ge=0.05, le=10)]
    depth: Annotated[float, Meta(ge=0.05, le=10)]
    turn: Angle = 0.0
    shade: Shade = 0.2


class Light(Struct, frozen=True, forbid_unknown_fields=True):
    """A lamp that shines down from `z` (0: the ceiling), or a window in an outer wall, `width` along the wall by
    `depth` in height, `z` its middle; only windows follow the daylight."""

    name: str
    x: Place
    y: Place
    z: Annotated[float, Meta(ge=0, le=6)] = 0.0
    width: Size = 0.5
    depth: Size = 0.5
    power: Annotated[float, Meta(ge=0, le=1000)] = 1.0  # 1 is usual for a room of 20 m2
    kind: Literal["lamp", "window"] = "lamp"


class Person(Struct, frozen=True, forbid_unknown_fields=True):
    """A person who walks a path now and then, and is out of the building between walks."""

    name: str
    path: Annotated[tuple[Point, ...], Meta(max_length=MAX_CORNERS)]
    speed: Annotated[float, Meta(ge=0.1, le=3)] = 1.0
    first: Annotated[float, Meta(ge=0, le=100_000)] = 20.0  # s until the first walk
    every: Annotated[float, Meta(ge=1, le=100_000)] = 60.0  # s from the end of a walk to the next
    jitter: Share = 0.3  # share by which `first` and `every` vary
    walks: Annotated[int, Meta(ge=0, le=1_000_000)] = 0  # most walks; 0: no limit
    shade: Shade = 0.25


class Robot(Struct, frozen=True, forbid_unknown_fields=True):
    """A Scout at its start."""

    name: str
    id: Annotated[int, Meta(ge=0, le=MAX_ROBOT)]
    x: Place
    y: Place
    heading: Angle = 0.0
    slip: Annotated[float, Meta(ge=0, le=0.3)] = 0.03
    """Share by which a wheel's speed differs from its command, as a constant and again as noise."""


class Noise(Struct, frozen=True, forbid_unknown_fields=True):
    """Noise of pictures; factors of 1 are a usual cheap camera."""

    sensor: Annotated[float, Meta(ge=0, le=10)] = 1.0  # factor on the camera's noise
    analog: Annotated[float, Meta(ge=0, le=10)] = 1.0  # factor on the transmission's noise
    flicker: Annotated[float, Meta(ge=0, le=0.5)] = 0.01  # share by which lamps vary between pictures
    daylight: Annotated[float, Meta(ge=0, le=0.95)] = 0.1  # share by which windows vary, slowly
    daylight_period: Annotated[float, Meta(ge=10, le=100_000)] = 600.0  # s


class Receiver(Struct, frozen=True, forbid_unknown_fields=True):
    """The place of the video receivers."""

    x: Place = 0.0
    y: Place = 0.0
    range: Annotated[float, Meta(ge=1, le=1_000)] = 30.0  # m at which half of the picture is noise


class Plan(Struct, frozen=True, forbid_unknown_fields=True):
    """A rectangular building from (0, 0) to (`width`, `depth`), metres."""

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
    lights: Annotated[tuple[Light, ...], Meta(max_length=MAX_LIGHTS)] = msgspec.field(name="light", default=())
    people: Annotated[tuple[Person, ...], Meta(max_length=MAX_PEOPLE)] = msgspec.field(name="person", default=())
    robots: Annotated[tuple[Robot, ...], Meta(max_length=MAX_ROBOTS)] = msgspec.field(name="robot", default=())

"""What behaviors publish about themselves, and a simulated building about its contents, for people to see."""

from __future__ import annotations

from typing import Annotated, TypeAlias

from msgspec import Meta

from zscout.messages.base import LIMITS, Finite, Message, Metres, Radians, Seconds

MAX_BOXES = 32
MAX_DETAIL = 200
MAX_ROBOTS = 64
MAX_PEOPLE = 64
MAX_PLAN = 1_000_000
"""Bytes of the answer with a building's plan."""

Box: TypeAlias = tuple[int, int, int, int]
"""Left, top, width and height in pixels."""
Path: TypeAlias = Annotated[str, Meta(min_length=1, max_length=200)]
Word: TypeAlias = Annotated[str, Meta(max_length=64)]
Detail: TypeAlias = Annotated[str, Meta(max_length=MAX_DETAIL)]


class BehaviorSaid(Message, frozen=True):
    """What a behavior does from now on, or with `alert`, what people should look at."""

    path: Path
    """Its place in the tree of behaviors: `place_sensor_net/scout33/hide`."""
    doing: Word
    """One word: `search`, `approach`, `watch`; empty when it has ended."""
    detail: Detail = ""
    robot: Word = ""
    """The robot RC, as `robot/scout33`, that it is about."""
    camera: Word = ""
    """The framegrabber RC whose pictures `boxes` belong to."""
    alert: bool = False
    boxes: Annotated[list[Box], Meta(max_length=MAX_BOXES)] = []
    """Where in that picture."""


class PlanAsk(Message, frozen=True):
    """Asks a simulated building for its plan."""


class BuildingPlan(Message, frozen=True):
    """A building seen from above."""

    name: Word
    width: Metres
    """Metres along x; the picture's columns."""
    depth: Metres
    """Metres along y; the picture's rows, the largest y at the top."""
    picture: bytes
    """PNG."""


class Placed(Message, frozen=True):
    """Where something stands: metres, radians."""

    name: Word
    x: Metres
    y: Metres
    heading: Radians = 0.0
    camera: int = 0
    """The video channel that it transmits on; 0: none."""
    hidden: bool = False
    """Whether it stands in a truly dark place."""


class BuildingPoses(Message, frozen=True):
    """Where robots and people are in a simulated building: the ground truth."""

    time: Seconds
    """Of the building, in seconds since it began."""
    speed: Finite = 1.0
    """How many of the building's seconds pass in a real one."""
    robots: Annotated[list[Placed], Meta(max_length=MAX_ROBOTS)] = []
    people: Annotated[list[Placed], Meta(max_length=MAX_PEOPLE)] = []


LIMITS[BehaviorSaid] = 8_192
LIMITS[BuildingPoses] = 65_536

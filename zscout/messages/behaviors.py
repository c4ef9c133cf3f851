"""Publications of behaviors and of a simulated building, for display."""

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
    """A behavior's present activity, or, with `alert`, an event that needs a person's attention."""

    path: Path
    """Its place in the tree of behaviors: `place_sensor_net/scout33/hide`."""
    doing: Word
    """One word, such as `search`, `approach` or `watch`; empty when the behavior has ended."""
    detail: Detail = ""
    robot: Word = ""
    """The robot RC concerned, such as `robot/scout33`."""
    camera: Word = ""
    """The framegrabber RC to whose pictures `boxes` refer."""
    alert: bool = False
    boxes: Annotated[list[Box], Meta(max_length=MAX_BOXES)] = []
    """Regions of the picture concerned, in pixels."""


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
    """Position and heading of a robot or person: metres, radians."""

    name: Word
    x: Metres
    y: Metres
    heading: Radians = 0.0
    camera: int = 0
    """The video channel on which it transmits; 0: none."""
    hidden: bool = False
    """True if it is in a place that is really dark."""


class BuildingPoses(Message, frozen=True):
    """Positions of robots and people in a simulated building: the ground truth."""

    time: Seconds
    """Simulated time in seconds since the start."""
    speed: Finite = 1.0
    """Simulated seconds per real second."""
    robots: Annotated[list[Placed], Meta(max_length=MAX_ROBOTS)] = []
    people: Annotated[list[Placed], Meta(max_length=MAX_PEOPLE)] = []


LIMITS[BehaviorSaid] = 8_192
LIMITS[BuildingPoses] = 65_536

"""All that a hider remembers, in one structure: a checkpoint is this, as MessagePack. And what it commands.

Times are seconds of the hider's own clock, which begins at 0 and counts only what passed between pictures:
after a move to another host, whose clock reads otherwise, it goes on. Places are dead-reckoned from where
the hider began: metres, x along its first heading.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

import msgspec

MAX_CHECKPOINT: Final = 64_000
"""Bytes; a hider's own is below 20,000."""
MAX_SIGHTINGS: Final = 120
MAX_BAD: Final = 24
FORM: Final = 1
"""Of the checkpoint; one of another form is refused."""

Phase = Literal[
    "scan", "aim", "roam", "approach", "enter", "face", "settle", "back", "dodge", "leave", "hidden", "check"
]


@dataclass(frozen=True, slots=True)
class WheelCommand:
    """What the wheels are to do now, and why."""

    left: float
    right: float
    """Shares of top speed, -1 to 1."""
    lasts: float
    """Seconds that the wheels may turn without a newer command; 0 with wheels that stand."""
    doing: str
    """One word, the hider's state: search, approach, unstick, enter, turn or hidden."""
    why: str
    """A few words for an operator."""
    hidden: bool = False

    @property
    def moves(self) -> bool:
        return self.left != 0 or self.right != 0


class Sighting(msgspec.Struct, frozen=True):
    """A dark place as it was seen once: heading in radians, metres."""

    heading: float
    distance: float
    width: float
    height: float
    darkness: float
    x: float
    y: float


class Opening(msgspec.Struct, frozen=True):
    """How a scan found one direction. Brightness is linear, in units of the scan's first picture."""

    heading: float
    open_for: float
    """Metres, roughly, to drive there."""
    bright: float
    """Mean over the columns of lit floor over near floor."""
    near: float
    """The floor just ahead."""
    outside: float
    """The lit floor."""
    above: float
    """What is at the top of the picture: a wall or ceiling in the light is bright, the underside of a sofa
    dark."""
    sees_out: float
    """Share of columns that show lit floor."""


class Spot(msgspec.Struct, frozen=True):
    """A place to remember: metres."""

    x: float
    y: float


class Thumb(msgspec.Struct, frozen=True):
    """A part of an earlier picture, to see whether anything moves."""

    at: float
    data: bytes


class HidingState(msgspec.Struct):
    """See the module's head. Arrays are kept as bytes."""

    form: int = FORM
    phase: Phase = "scan"
    began: float = 0.0
    """When this phase began."""
    clock: float = 0.0
    last_now: float | None = None
    interval: float = 0.2
    """Seconds between good pictures, smoothed."""
    dice: int = 0
    stopped: bool = False
    """The hold is lost; nothing is done until it is back."""

    heading: float = 0.0
    x: float = 0.0
    y: float = 0.0

    left: float = 0.0
    right: float = 0.0
    ends: float = 0.0
    """When the wheels' last command runs out."""
    hopping: bool = False
    """A measured turn (or step) is under way, or its picture not yet still."""
    expected: float = 0.0
    """Radians that the hop was to turn."""
    hop_length: float = 0.0
    """Metres that it was to go ahead."""
    anchor: bytes = b""
    """Strip before the hop."""
    previous: bytes = b""
    """Strip of the last picture."""
    tones: bytes = b""
    """Tones of the last picture."""
    anchor_tones: bytes = b""
    """And of that before the hop."""
    opened: float = 1.0
    """By how much the camera opened since the scan began."""
    thumbs: list[Thumb] = msgspec.field(default_factory=list)
    noise: float = 1.0
    """Grey levels by which thumbs differ while nothing moves."""
    floors: list[Thumb] = msgspec.field(default_factory=list)
    """Strips of the near floor over the last second of driving."""
    halted: int = 0
    """Pictures in a row that showed the same floor in spite of driving."""
    print: int = 0
    """CRC of the last picture: the same again is a frozen picture."""
    spoiled_since: float | None = None
    spoiled_how: str = ""
    last_good: float = 0.0

    turned: float = 0.0
    """Radians turned since the scan, or the facing, began."""
    hops: int = 0
    sightings: list[Sighting] = msgspec.field(default_factory=list)
    openings: list[Opening] = msgspec.field(default_factory=list)
    target: Sighting | None = None
    seen_target: float = 0.0
    """When the target was last seen."""
    goal: float = 0.0
    """Heading to turn to, or metres to go, as the phase has it."""
    left_to_go: float = 0.0
    next_phase: Phase = "scan"
    bad: list[Spot] = msgspec.field(default_factory=list)
    """Where hiding failed, or the robot could not get."""
    scans: int = 0
    bumps: int = 0
    blocked: list[float] = msgspec.field(default_factory=list)
    """Headings in which it bumped since the last scan."""
    at_edge: bool = False
    """The last bump was at the edge of a dark place."""
    visited: list[Spot] = msgspec.field(default_factory=list)
    """Where it has looked around."""
    tries: int = 0
    """Bumps on the way to this target."""
    faces: int = 0
    """Full turns in this dark place."""
    shifted: bool = False
    """It moved since it turned to the light."""
    note: str = ""
    """Why this phase."""
    why: str = ""
    """As last reported."""


def distance(one: Spot | Sighting | HidingState, other: Spot | Sighting | HidingState) -> float:
    """Metres from one to the other."""
    return math.hypot(one.x - other.x, one.y - other.y)


def wrapped(angle: float) -> float:
    """The same angle within -pi to pi."""
    return math.remainder(angle, math.tau)

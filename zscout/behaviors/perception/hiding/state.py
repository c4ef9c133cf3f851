"""A hider's memory, one structure that its checkpoint holds as MessagePack, and the moves of all phases. Pure.

Times are seconds of the hider's own clock, from 0, counted between pictures only, so that it survives a move to another
host. Places are dead-reckoned metres from the start, x along the first heading. A *hop* is a short turn on the spot,
measured once the picture is still. A *cruise* is a drive by short commands with a time to live, one per picture."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from zscout.behaviors.perception.darkness import View
from zscout.behaviors.perception.hiding.compass import BANDS, SCALE, Strip, Tones, brighter, floor_strip, turned
from zscout.behaviors.perception.lens import COLUMNS, Picture

MAX_CHECKPOINT: Final = 64_000  # bytes; a hider's own is below 20,000
MAX_BAD: Final = 24
MAX_SIGHTINGS: Final = 120
FORM: Final = 1  # version of the checkpoint; others are refused
WHEEL_BASE: Final = 0.11  # metres between a Scout's two wheels
TOP_SPEED: Final = 0.30  # metres per second, of each wheel
TOP_SPIN: Final = 2 * TOP_SPEED / WHEEL_BASE  # radians per second with opposed wheels at full speed
STRAIGHT: Final = 0.7  # share of top speed of a straight step
LONGEST_HOP: Final = math.radians(44)
SETTLES: Final = 0.15  # seconds after a hop before its picture may count: the motors' lag
LAGS: Final = 0.33  # seconds after a hop when a turn as expected counts as finished
SETTLED: Final = 1.0  # seconds after a hop when its picture counts even if it seems to move
SURE: Final = 0.35  # least likeness of a credible turn
WATCHED: Final = 0.5  # seconds of driving that change the near floor
SAME_FLOOR: Final = 0.5  # likeness of unchanged floor: 0.6 to 0.95 when stuck, below 0.35 otherwise
BRIGHTER: Final = 4.0  # brightness, against the floor here, of the floor in a column that sees out

Phase = Literal[
    "scan", "aim", "roam", "approach", "enter", "face", "settle", "back", "dodge", "leave", "hidden", "check"
]
PHASES_OF: Final[dict[str, tuple[Phase, ...]]] = {
    "search": ("scan", "aim", "roam"),
    "approach": ("approach",),
    "enter": ("enter",),
    "turn": ("face", "settle"),
    "unstick": ("back", "dodge", "leave"),
    "hidden": ("hidden", "check"),
}
"""Phases by the state that people see."""
WORDS: Final = {phase: word for word, phases in PHASES_OF.items() for phase in phases}


@dataclass(frozen=True, slots=True)
class WheelCommand:
    left: float
    right: float  # shares of top speed, -1 to 1
    lasts: float  # seconds until the wheels stop without a newer command; 0 for still wheels
    doing: str  # the state: search, approach, unstick, enter, turn or hidden
    why: str  # a few words for an operator
    hidden: bool = False

    @property
    def moves(self) -> bool:
        return self.left != 0 or self.right != 0


Step: TypeAlias = WheelCommand | Phase  # a command, or the phase that continues with the same picture


class Sighting(msgspec.Struct, frozen=True):
    """A dark place in one picture: heading in radians, metres."""

    heading: float
    distance: float
    width: float
    height: float
    darkness: float
    x: float
    y: float


class Opening(msgspec.Struct, frozen=True):
    """One direction of a scan. Brightness is linear, in units of the scan's first picture."""

    heading: float
    open_for: float  # metres, roughly, to drive there
    bright: float  # mean over the columns of lit floor over near floor
    near: float  # the floor just ahead
    outside: float  # the lit floor
    above: float  # top of the picture: bright for a lit wall or ceiling, dark for the underside of a sofa
    sees_out: float  # share of columns that show lit floor


class Spot(msgspec.Struct, frozen=True):
    """A remembered place, in metres."""

    x: float
    y: float


class Thumb(msgspec.Struct, frozen=True):
    at: float
    data: bytes


class HidingState(msgspec.Struct):
    """All memory of a hider; see the module. Arrays are kept as bytes."""

    form: int = FORM
    phase: Phase = "scan"
    began: float = 0.0
    clock: float = 0.0
    last_now: float | None = None
    interval: float = 0.2  # seconds between good pictures, smoothed
    dice: int = 0
    stopped: bool = False  # the hold is lost; wait until it is back

    heading: float = 0.0
    x: float = 0.0
    y: float = 0.0

    left: float = 0.0
    right: float = 0.0
    ends: float = 0.0  # end of the wheels' last command
    hopping: bool = False  # true until a turn or step is finished and measured
    expected: float = 0.0  # radians intended
    hop_length: float = 0.0  # metres intended
    anchor: bytes = b""  # strip before the hop
    previous: bytes = b""  # strip of the last picture
    tones: bytes = b""  # tones of the last picture
    anchor_tones: bytes = b""  # tones before the hop
    opened: float = 1.0  # factor by which the camera opened since the scan began
    thumbs: list[Thumb] = msgspec.field(default_factory=list)
    noise: float = 1.0  # grey levels by which thumbs differ while nothing moves
    floors: list[Thumb] = msgspec.field(default_factory=list)
    """Strips of the near floor over the last second of driving."""
    halted: int = 0  # pictures in a row that showed the same floor in spite of driving
    print: int = 0  # CRC of the last picture: a repetition is a frozen picture
    spoiled_since: float | None = None
    spoiled_how: str = ""
    last_good: float = 0.0

    turned: float = 0.0  # radians turned since the scan, or the facing, began
    hops: int = 0
    sightings: list[Sighting] = msgspec.field(default_factory=list)
    openings: list[Opening] = msgspec.field(default_factory=list)
    target: Sighting | None = None
    seen_target: float = 0.0  # last sight of the target in this phase
    goal: float = 0.0  # heading or distance, depending on the phase
    left_to_go: float = 0.0
    next_phase: Phase = "scan"
    bad: list[Spot] = msgspec.field(default_factory=list)  # places where hiding failed, or that could not be reached
    scans: int = 0
    bumps: int = 0
    blocked: list[float] = msgspec.field(default_factory=list)  # headings of bumps since the last scan
    at_edge: bool = False  # the last bump was at the edge of a dark place
    visited: list[Spot] = msgspec.field(default_factory=list)  # places of former scans
    tries: int = 0  # bumps on the way to this target
    faces: int = 0  # full turns in this dark place
    shifted: bool = False  # moved since it turned to the light
    note: str = ""  # reason of this phase
    why: str = ""  # as last reported

    def go(self, phase: Phase) -> None:
        self.phase, self.began = phase, self.clock
        self.hopping, self.hops, self.shifted, self.seen_target = False, 0, False, self.clock
        self.thumbs, self.floors, self.halted = [], [], 0

    def act(self, left: float, right: float, lasts: float, why: str) -> WheelCommand:
        if left == 0 and right == 0:
            lasts = 0.0
        self.left, self.right, self.ends = left, right, self.clock + lasts
        self.why = why
        return WheelCommand(left, right, lasts, self.word, why, self.phase == "hidden")

    @property
    def word(self) -> str:
        # Aiming belongs to the next phase.
        facing = self.phase == "aim" and self.next_phase == "settle"
        return WORDS["settle" if facing else self.phase]

    def stand(self, why: str) -> WheelCommand:
        return self.act(0.0, 0.0, 0.0, why)

    def rest(self, why: str) -> WheelCommand:
        """Let the last command run out: return it with its remaining time."""
        lasts = self.ends - self.clock
        if lasts > 0.01:
            return WheelCommand(self.left, self.right, lasts, self.word, why)
        return WheelCommand(0.0, 0.0, 0.0, self.word, why)

    @property
    def here_for(self) -> float:
        return self.clock - self.began

    def roll(self) -> float:
        """0 to 1, from the seed: a step of splitmix64."""
        self.dice = (self.dice + 0x9E3779B97F4A7C15) & 0xFFFFFFFFFFFFFFFF
        mixed = self.dice
        mixed = ((mixed ^ (mixed >> 30)) * 0xBF58476D1CE4E5B9) & 0xFFFFFFFFFFFFFFFF
        mixed = ((mixed ^ (mixed >> 27)) * 0x94D049BB133111EB) & 0xFFFFFFFFFFFFFFFF
        return float((mixed ^ (mixed >> 31)) >> 11) / float(1 << 53)

    def point(self, heading: float, distance: float) -> tuple[float, float]:
        return self.x + distance * math.cos(heading), self.y + distance * math.sin(heading)

    def hop(self, angle: float, why: str) -> WheelCommand:
        """Turn on the spot by `angle`, at most `LONGEST_HOP`; the remainder needs further hops."""
        angle = max(-LONGEST_HOP, min(LONGEST_HOP, angle))
        speed = 0.5 if abs(angle) > 0.25 else 0.3
        wheel = math.copysign(speed, angle)
        self._measure(angle, 0.0)
        return self.act(-wheel, wheel, abs(angle) / (TOP_SPIN * speed), why)

    def step_straight(self, distance: float, why: str) -> WheelCommand:
        """Drive straight by `distance` metres (negative: back) and wait for a still picture."""
        wheel = math.copysign(STRAIGHT, distance)
        self._measure(0.0, distance)
        return self.act(wheel, wheel, abs(distance) / (TOP_SPEED * STRAIGHT), why)

    def _measure(self, angle: float, distance: float) -> None:
        self.hopping, self.expected, self.hop_length = True, angle, distance
        self.anchor, self.anchor_tones = self.previous, self.tones

    def settled(self, strip: Strip, tones: Tones, picture: Picture) -> bool:
        """Return True if the hop is over and measured."""
        thumb = cv2.resize(picture, (40, 30), interpolation=cv2.INTER_AREA).astype(np.uint8)
        moved = difference(self.thumbs[-1].data, thumb) if self.thumbs else 255.0
        self.thumbs = [Thumb(self.clock, thumb.tobytes())]
        over = self.clock - self.ends
        if over < SETTLES:
            return False
        turn = turned(unpack(self.anchor), strip, self.expected)
        still = moved <= 1.6 * self.noise + 0.4
        # A complete turn needs no second look.
        done = over >= LAGS and self.expected and turn.likeness >= 0.5 and abs(turn.angle / self.expected - 1) < 0.2
        if not still and not done and over < SETTLED:
            return False
        if moved <= 3 * self.noise + 0.5:
            # Nothing moves: differences are noise.
            self.noise = max(0.3, 0.7 * self.noise + 0.3 * moved)
        self.hopping = False
        angle = turn.angle if turn.likeness >= SURE or self.hop_length else self.expected
        if turn.likeness >= SURE and self.anchor_tones:
            old = np.frombuffer(self.anchor_tones, np.uint8).reshape(tones.shape)
            self.opened *= brighter(old, tones, angle)
        self.heading += angle
        self.turned += angle
        self.x, self.y = self.point(self.heading, self.hop_length)
        self.hops += 1
        return True

    def cruise(self, speed: float, spin: float, why: str) -> WheelCommand:
        """Drive at `speed` (m/s, ahead positive) and `spin` (rad/s, left positive) until the next picture."""
        half = spin * WHEEL_BASE / 2
        left, right = (speed - half) / TOP_SPEED, (speed + half) / TOP_SPEED
        most = max(1.0, abs(left), abs(right))
        lasts = min(1.0, max(0.3, 2.2 * self.interval))
        return self.act(left / most, right / most, lasts, why)

    @property
    def pace(self) -> float:
        """Speed, in metres per second, that suits the rate of pictures."""
        return min(0.24, 0.07 / self.interval)

    def cruised(self, least: float) -> bool:
        """Return True if this phase has driven `least` metres."""
        return self.pace * self.here_for >= least

    def advanced(self, seconds: float, strip: Strip) -> None:
        """Dead reckoning over the time since the last picture, while cruising."""
        ran = min(seconds, max(0.0, self.ends - (self.clock - seconds)))
        if ran <= 0:
            return
        self.x, self.y = self.point(self.heading, (self.left + self.right) / 2 * TOP_SPEED * ran)
        if self.previous and not self.hopping:
            spin = (self.right - self.left) * TOP_SPEED / WHEEL_BASE
            turn = turned(unpack(self.previous), strip, spin * ran, math.radians(15))
            self.heading += turn.angle if turn.likeness >= SURE else spin * ran

    def blocked_by(self, picture: Picture) -> bool:
        """Return True if the floor stayed the same while driving: the robot pushes against something."""
        floor = floor_strip(picture)
        since = self.clock - max(WATCHED, 1.5 * self.interval)
        old = [thumb for thumb in self.floors if thumb.at <= since]
        kept = [*old[-1:], *(thumb for thumb in self.floors if thumb.at > since)]
        self.floors = [*kept[-11:], Thumb(self.clock, floor.tobytes())]
        same = bool(old) and turned(unpack(old[-1].data), floor, 0.0, 0.3).likeness >= SAME_FLOOR
        self.halted = self.halted + 1 if same else 0
        return self.halted >= 2

    def sight(self, view: View) -> None:
        for place in view.places:
            heading = self.heading + place.bearing
            x, y = self.point(heading, place.distance)
            self.sightings.append(Sighting(heading, place.distance, place.width, place.height, place.darkness, x, y))
        self.sightings = self.sightings[-MAX_SIGHTINGS:]
        self.openings.append(self.opening(view))

    def opening(self, view: View) -> Opening:
        """Farther views have more structure around the horizon: 2 grey levels up to 0.7 m, 5 at 1 m, 8 beyond 1.5 m
        (simulated)."""
        middle = unpack(self.previous)[9:15, COLUMNS // 4 : -COLUMNS // 4].astype(np.float32)
        return Opening(
            heading=self.heading,
            open_for=float(np.abs(middle).mean()) / SCALE / 5,
            bright=float(view.contrast.mean()),
            near=view.near / self.opened,
            outside=view.outside / self.opened,
            above=view.above / self.opened,
            sees_out=float((view.contrast >= BRIGHTER).mean()),
        )

    def note_bad(self, x: float, y: float) -> None:
        self.bad = [*self.bad, Spot(x, y)][-MAX_BAD:]


def distance(place: Spot | Sighting | HidingState, other: Spot | Sighting | HidingState) -> float:
    return math.hypot(place.x - other.x, place.y - other.y)


def wrapped(angle: float) -> float:
    return math.remainder(angle, math.tau)


def difference(grey: bytes, thumb: NDArray[np.uint8]) -> float:
    """Mean difference in grey levels, corrected for exposure."""
    old = np.frombuffer(grey, np.uint8).astype(np.float32)
    new = thumb.ravel().astype(np.float32)
    gain = (float(old @ new) + 1) / (float(old @ old) + 1)
    return float(np.abs(new - gain * old).mean())


def unpack(strip: bytes) -> Strip:
    if len(strip) != BANDS * COLUMNS:
        return np.zeros((BANDS, COLUMNS), np.int8)
    return np.frombuffer(strip, np.int8).reshape(BANDS, COLUMNS)

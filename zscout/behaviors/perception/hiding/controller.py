"""The machinery that all phases share: turns that are measured, drives that are watched, what was seen where.

A *hop* is a short turn on the spot, after which the controller waits until the picture stands still and
measures how far it truly turned. A *cruise* is a drive with short commands, each with a time to live, one at
every picture.
"""

from __future__ import annotations

import math
import zlib
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from zscout.behaviors.perception.darkness import View
from zscout.behaviors.perception.hiding.compass import (
    BANDS,
    SCALE,
    brighter,
    floor_strip,
    turned,
)
from zscout.behaviors.perception.hiding.state import (
    MAX_BAD,
    HidingState,
    Opening,
    Phase,
    Sighting,
    Spot,
    Thumb,
)
from zscout.behaviors.perception.hiding.wheels import BodyModel, WheelCommand
from zscout.behaviors.perception.lens import COLUMNS, Picture

HOP: Final = math.radians(36)
LONGEST_HOP: Final = math.radians(44)
SETTLES: Final = 0.15
"""Seconds after a hop before its picture may count: the motors' lag."""
LAGS: Final = 0.33
"""Seconds after a hop when a turn that shows as expected is taken to be over."""
SETTLED: Final = 1.0
"""Seconds after a hop when its picture counts even if it still seems to move."""
SURE: Final = 0.35
"""Likeness below which a measured turn is not believed."""
WATCHED: Final = 0.5
"""Seconds of driving after which the near floor is another one."""
SAME_FLOOR: Final = 0.5
"""Likeness of the floor now and then from which on it is the same: 0.6 to 0.95 when stuck, below 0.35
else."""
BRIGHTER: Final = 4.0
"""How many times brighter than here the floor of a column that sees out is."""
_THUMB: Final = (40, 30)

WORDS: Final[dict[Phase, str]] = {
    "scan": "search",
    "aim": "search",
    "roam": "search",
    "approach": "approach",
    "enter": "enter",
    "face": "turn",
    "settle": "turn",
    "back": "unstick",
    "dodge": "unstick",
    "leave": "unstick",
    "hidden": "hidden",
    "check": "hidden",
}


class HidingPhase:
    """One phase of hiding. It keeps nothing of its own: all is in the controller's state."""

    def begin(self, controller: HidingController) -> None:
        """The phase begins; nothing is commanded yet."""

    def step(self, controller: HidingController, view: View) -> WheelCommand:
        """What to do on this picture. After a hop it is called when that is over and measured."""
        raise NotImplementedError

    def stuck(self, controller: HidingController, view: View) -> WheelCommand:
        """It drove, and nothing moved."""
        controller.memory.note, controller.memory.at_edge = "bumped", False
        return controller.then("back", view)


class HidingController:
    """The state of hiding and the moves that use it. Pure."""

    def __init__(self, body: BodyModel, memory: HidingState, phases: dict[Phase, HidingPhase]) -> None:
        self.body, self.memory, self.phases = body, memory, phases

    # Phases

    def go(self, phase: Phase) -> HidingPhase:
        """Changes the phase."""
        memory = self.memory
        memory.phase, memory.began = phase, memory.clock
        memory.hopping = False
        memory.thumbs, memory.floors, memory.halted = [], [], 0
        self.phases[phase].begin(self)
        return self.phases[phase]

    def then(self, phase: Phase, view: View) -> WheelCommand:
        """Changes the phase and takes its first step on the same picture."""
        return self.go(phase).step(self, view)

    def act(self, left: float, right: float, lasts: float, why: str) -> WheelCommand:
        memory = self.memory
        if left == 0 and right == 0:
            lasts = 0.0
        memory.left, memory.right, memory.ends = left, right, memory.clock + lasts
        memory.why = why
        return WheelCommand(left, right, lasts, self.word, why, memory.phase == "hidden")

    @property
    def word(self) -> str:
        """What it is doing, for people."""
        # To aim is part of what follows.
        facing = self.memory.phase == "aim" and self.memory.next_phase == "settle"
        return WORDS["settle" if facing else self.memory.phase]

    def stand(self, why: str) -> WheelCommand:
        return self.act(0.0, 0.0, 0.0, why)

    def rest(self, why: str) -> WheelCommand:
        """Nothing new: what was commanded runs out by itself."""
        memory = self.memory
        rest = max(0.0, memory.ends - memory.clock)
        moving = rest > 0.01
        return WheelCommand(
            memory.left if moving else 0.0,
            memory.right if moving else 0.0,
            rest if moving else 0.0,
            self.word,
            why,
        )

    def keep(self, thumb: NDArray[np.uint8]) -> None:
        """This picture is the one before the next."""
        self.memory.thumbs = [Thumb(self.memory.clock, thumb.tobytes())]

    @property
    def here_for(self) -> float:
        """Seconds in this phase."""
        return self.memory.clock - self.memory.began

    def roll(self) -> float:
        """0 to 1, from the seed: a step of splitmix64."""
        memory = self.memory
        memory.dice = (memory.dice + 0x9E3779B97F4A7C15) & 0xFFFFFFFFFFFFFFFF
        mixed = memory.dice
        mixed = ((mixed ^ (mixed >> 30)) * 0xBF58476D1CE4E5B9) & 0xFFFFFFFFFFFFFFFF
        mixed = ((mixed ^ (mixed >> 27)) * 0x94D049BB133111EB) & 0xFFFFFFFFFFFFFFFF
        return float((mixed ^ (mixed >> 31)) >> 11) / float(1 << 53)

    # Hops

    def hop(self, angle: float, why: str) -> WheelCommand:
        """Turns on the spot by `angle` (at most `LONGEST_HOP`, the rest is for the next hop)."""
        angle = max(-LONGEST_HOP, min(LONGEST_HOP, angle))
        speed = 0.5 if abs(angle) > 0.25 else 0.3
        lasts = abs(angle) / (self.body.top_spin * speed)
        wheel = math.copysign(speed, angle)
        memory = self.memory
        memory.hopping, memory.expected, memory.hop_length = True, angle, 0.0
        memory.anchor, memory.anchor_tones = memory.previous, memory.tones
        return self.act(-wheel, wheel, lasts, why)

    def step_straight(self, distance: float, why: str, speed: float = 0.7) -> WheelCommand:
        """Drives straight by `distance` metres (negative: back) and waits for a still picture."""
        memory = self.memory
        wheel = math.copysign(speed, distance)
        memory.hopping, memory.expected = True, 0.0
        memory.hop_length = distance
        memory.anchor, memory.anchor_tones = memory.previous, memory.tones
        return self.act(wheel, wheel, abs(distance) / (self.body.top_speed * speed), why)

    def settled(self, strip: NDArray[np.int8], tones: NDArray[np.uint8], thumb: NDArray[np.uint8]) -> bool:
        """Whether the hop is over and measured. Until then the caller stands, or lets the wheels turn."""
        memory = self.memory
        over = memory.clock - memory.ends
        if over < SETTLES:
            return False
        turn = turned(unpack(memory.anchor), strip, memory.expected)
        moved = self.change(thumb)
        still = moved <= 1.6 * memory.noise + 0.4
        # A turn that has come as far as it was to go needs no second look.
        done = (
            over >= LAGS and turn.likeness >= 0.5 and abs(turn.angle / memory.expected - 1) < 0.2
            if memory.expected
            else False
        )
        if not still and not done and over < SETTLED:
            return False
        if moved <= 3 * memory.noise + 0.5:
            # Nothing moves: what differs is noise.
            memory.noise = max(0.3, 0.7 * memory.noise + 0.3 * moved)
        memory.hopping = False
        angle = turn.angle if turn.likeness >= SURE or memory.hop_length else memory.expected
        if turn.likeness >= SURE and memory.anchor_tones:
            old = np.frombuffer(memory.anchor_tones, np.uint8).reshape(tones.shape)
            memory.opened *= brighter(old, tones, angle)
        memory.heading += angle
        memory.turned += angle
        memory.x += memory.hop_length * math.cos(memory.heading)
        memory.y += memory.hop_length * math.sin(memory.heading)
        memory.hops += 1
        return True

    # Cruises

    def cruise(self, speed: float, spin: float, why: str) -> WheelCommand:
        """Drives on at `speed` (m/s, ahead positive) and `spin` (rad/s, left positive) until the next
        picture."""
        top = self.body.top_speed
        half = spin * self.body.wheel_base / 2
        left, right = (speed - half) / top, (speed + half) / top
        most = max(1.0, abs(left), abs(right))
        lasts = min(1.0, max(0.3, 2.2 * self.memory.interval))
        return self.act(left / most, right / most, lasts, why)

    @property
    def pace(self) -> float:
        """Metres per second that suit the rate of pictures."""
        return min(0.24, 0.07 / self.memory.interval)

    def advanced(self, seconds: float, strip: NDArray[np.int8]) -> None:
        """Dead reckoning over the time since the last picture, while cruising."""
        memory = self.memory
        ran = min(seconds, max(0.0, memory.ends - (memory.clock - seconds)))
        if ran <= 0:
            return
        top = self.body.top_speed
        speed = (memory.left + memory.right) / 2 * top
        spin = (memory.right - memory.left) * top / self.body.wheel_base
        memory.x += speed * ran * math.cos(memory.heading)
        memory.y += speed * ran * math.sin(memory.heading)
        if memory.previous and not memory.hopping:
            turn = turned(unpack(memory.previous), strip, spin * ran, math.radians(15))
            memory.heading += turn.angle if turn.likeness >= SURE else spin * ran

    def blocked(self, picture: Picture) -> bool:
        """Whether the robot has driven for a while over the same floor: it pushes against something."""
        memory = self.memory
        floor = floor_strip(picture)
        watched = max(WATCHED, 1.5 * memory.interval)
        old = [one for one in memory.floors if one.at <= memory.clock - watched]
        memory.floors = [*old[-1:], *(one for one in memory.floors if one.at > memory.clock - watched)]
        memory.floors = [*memory.floors[-11:], Thumb(memory.clock, floor.tobytes())]
        same = bool(old) and turned(unpack(old[-1].data), floor, 0.0, 0.3).likeness >= SAME_FLOOR
        memory.halted = memory.halted + 1 if same else 0
        return memory.halted >= 2

    def change(self, thumb: NDArray[np.uint8]) -> float:
        """Grey levels by which this picture differs from the one before."""
        memory = self.memory
        return likeness(memory.thumbs[-1].data, thumb) if memory.thumbs else 255.0

    # What was seen where

    def sight(self, view: View) -> None:
        """Adds what this picture shows to the scan's findings."""
        memory = self.memory
        for place in view.places:
            heading = memory.heading + place.bearing
            x = memory.x + place.distance * math.cos(heading)
            y = memory.y + place.distance * math.sin(heading)
            memory.sightings.append(
                Sighting(heading, place.distance, place.width, place.height, place.darkness, x, y)
            )
        memory.openings.append(opening(memory, view))

    def note_bad(self, ahead: float = 0.0) -> None:
        """This place, or the one so far ahead, is not tried again."""
        memory = self.memory
        x = memory.x + ahead * math.cos(memory.heading)
        y = memory.y + ahead * math.sin(memory.heading)
        self.bad_at(x, y)

    def bad_at(self, x: float, y: float) -> None:
        self.memory.bad = [*self.memory.bad, Spot(x, y)][-MAX_BAD:]


def opening(memory: HidingState, view: View) -> Opening:
    """What this picture shows of its direction."""
    opened = memory.opened
    return Opening(
        heading=memory.heading,
        open_for=openness(memory),
        bright=float(view.contrast.mean()),
        near=view.near / opened,
        outside=view.outside / opened,
        above=view.above / opened,
        sees_out=float((view.contrast >= BRIGHTER).mean()),
    )


def openness(memory: HidingState) -> float:
    """Metres, roughly, that this picture's side is open for: the farther one sees, the more there is around
    the horizon. In the simulated building 2 grey levels of structure up to 0.7 m, 5 at 1 m, 8 beyond 1.5
    m."""
    middle = unpack(memory.previous)[9:15, COLUMNS // 4 : -COLUMNS // 4].astype(np.float32)
    return float(np.abs(middle).mean()) / SCALE / 5


def thumb_of(picture: Picture) -> NDArray[np.uint8]:
    return cv2.resize(picture, _THUMB, interpolation=cv2.INTER_AREA).astype(np.uint8)


def likeness(grey: bytes, thumb: NDArray[np.uint8]) -> float:
    """Mean difference in grey levels, whatever the exposure did in between."""
    old = np.frombuffer(grey, np.uint8).astype(np.float32)
    new = thumb.ravel().astype(np.float32)
    gain = (float(old @ new) + 1) / (float(old @ old) + 1)
    return float(np.abs(new - gain * old).mean())


def print_of(picture: Picture) -> int:
    return zlib.crc32(picture.tobytes())


def unpack(strip: bytes) -> NDArray[np.int8]:
    if len(strip) != BANDS * COLUMNS:
        return np.zeros((BANDS, COLUMNS), np.int8)
    return np.frombuffer(strip, np.int8).reshape(BANDS, COLUMNS)

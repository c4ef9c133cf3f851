"""Analog transmission of pictures from cameras to receivers, with seeded noise.

A receiver shows its channel: snow if no robot transmits, a robot's picture with noise, ghosts and torn lines by
distance, and a useless mixture if several robots transmit.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from zscout.simulation.building.camera import Picture
from zscout.simulation.building.plan import Plan
from zscout.simulation.building.solids import Floats
from zscout.simulation.building.world import World

ROWS: Final = 120
COLUMNS: Final = 160
GRAIN: Final = 1.5  # standard deviation in grey levels at full strength
WEAK: Final = 28.0  # added to it without any signal
TORN: Final = 0.02  # share of good pictures in which some lines are torn aside
GHOST: Final = 0.06  # share of the picture that comes again by reflection, without any signal
SOLID: Final = 0.999


class Air:
    def __init__(self, *, seed: int = 0) -> None:
        self._rng = np.random.default_rng((seed, 0xA1))
        self._rows = np.arange(ROWS, dtype=np.float32)[:, None]
        self._columns = np.arange(COLUMNS, dtype=np.float32)[None, :]

    def receive(self, world: World, channel: int) -> Picture:
        """The picture of a receiver on `channel`, uint8 (120, 160). Each call takes a new picture of the cameras."""
        senders = [body for body in world.bodies.values() if body.alive and body.camera == channel]
        if not senders:
            return self._snow()
        if len(senders) > 1:
            return self._jam([world.picture(body.name).astype(np.float32) for body in senders[:3]])
        body = senders[0]
        picture, warmth = world.picture(body.name), body.warmth(world.time)
        if warmth < SOLID:
            share = warmth**3
            return _picture(share * picture.astype(np.float32) + (1 - share) * self._snow().astype(np.float32))
        return self._transmit(picture, strength_at(world.plan, body.x, body.y), world.plan.noise.analog)

    def _transmit(self, picture: Picture, strength: float, analog: float) -> Picture:
        if analog == 0:
            return picture
        rng, weakness = self._rng, 1 - strength
        signal = picture.astype(np.float32)
        ghost = GHOST * weakness * analog
        signal = (1 - ghost) * signal + ghost * np.roll(signal, 7, axis=1)
        # Narrow-band noise: neighbours along a line are alike.
        grain = rng.standard_normal((ROWS, COLUMNS), dtype=np.float32)
        grain[:, 1:] = 0.8 * grain[:, 1:] + 0.6 * grain[:, :-1]
        signal += (GRAIN + WEAK * weakness**2) * analog * grain
        if rng.random() < min(0.5, TORN * analog * (1 + 8 * weakness)):
            tear(signal, rng, bands=int(rng.integers(1, 3)))
        return _picture(signal)

    def _jam(self, pictures: list[Floats]) -> Picture:
        """Carriers beat: bars roll through, lines lose their sync, and the pictures mix."""
        rng = self._rng
        phase = float(rng.uniform(0, 2 * np.pi))
        beat = np.sin(self._rows * rng.uniform(0.25, 0.6) + self._columns * rng.uniform(0.2, 0.9) + phase)
        share = 0.5 + 0.45 * beat.astype(np.float32)
        mixed = share * pictures[0] + (1 - share) * np.roll(pictures[1], int(rng.integers(0, COLUMNS)), axis=1)
        for other in pictures[2:]:
            mixed = 0.6 * mixed + 0.4 * other
        shift = np.cumsum(rng.normal(0, 3.0, ROWS)).astype(np.float32)[:, None]
        across = np.broadcast_to((self._columns + shift) % COLUMNS, (ROWS, COLUMNS)).astype(np.float32)
        down = np.broadcast_to(self._rows, (ROWS, COLUMNS)).astype(np.float32)
        mixed = np.asarray(cv2.remap(mixed, across, down, cv2.INTER_NEAREST), np.float32)
        return _picture(mixed + 35 * rng.standard_normal((ROWS, COLUMNS), dtype=np.float32))

    def _snow(self) -> Picture:
        return _picture(110 + 62 * self._rng.standard_normal((ROWS, COLUMNS), dtype=np.float32))


def tear(signal: Floats | Picture, rng: np.random.Generator, *, bands: int) -> None:
    """Shift some bands of lines aside, as if they lost their sync."""
    for _ in range(bands):
        first = int(rng.integers(0, ROWS - 2))
        last = min(ROWS, first + int(rng.integers(1, 5)))
        signal[first:last] = np.roll(signal[first:last], int(rng.integers(-25, 26)), axis=1)


def strength_at(plan: Plan, x: float, y: float) -> float:
    """Share of a transmitter's signal at the plan's receiver, 0 to 1; a half at the receiver's `range`."""
    away = float(np.hypot(x - plan.receiver.x, y - plan.receiver.y)) / plan.receiver.range
    return 1 / (1 + away * away)


def _picture(signal: Floats) -> Picture:
    picture: Picture = np.clip(signal + 0.5, 0, 255).astype(np.uint8)
    return picture

"""What people report of motion detection in the field: the walker is told soon, and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.behaviors.perception.scenes import HEIGHT, Scene
from zscout.behaviors.perception.motion import Event, EventTracker, MotionDetector

RATE = 10.0
COMES = 6.0
"""Seconds after which the walker of `events` comes."""

Picture = NDArray[np.uint8]
Camera = Callable[[float, float | None], Picture]
"""What it shows at a time, with the walker at a column or without him."""


def events(camera: Camera, *, rate: float = RATE) -> Iterator[Event]:
    """The camera's scene, in which somebody walks from COMES for five seconds, and one more."""
    detector, tracker = MotionDetector(), EventTracker()
    for number in range(round((COMES + 6) * rate)):
        time = number / rate
        walker = 40 * (time - COMES) - 20 if COMES <= time < COMES + 5 else None
        if ended := tracker.see(time, detector.see(time, camera(time, walker))):
            yield ended
    if last := tracker.close():
        yield last


def assert_walker_alone(camera: Camera) -> None:
    told = list(events(camera))
    assert len(told) == 1
    assert COMES <= told[0].start <= COMES + 1
    assert told[0].end >= COMES + 3.5


@pytest.mark.parametrize(
    ("depth", "rolls", "lines"),
    [(0.06, 0.05, 60), (0.12, 0.05, 60), (0.12, 0.37, 60), (0.12, 1.3, 30), (0.2, 0.1, 120), (0.25, 0.5, 60)],
)
def test_light_that_rolls_in_bands_hides_nobody(depth: float, rolls: float, lines: int) -> None:
    """As of mains under a rolling shutter: each line has its light."""
    scene, rows = Scene(20), np.arange(HEIGHT)[:, np.newaxis]

    def camera(time: float, walker: float | None) -> Picture:
        return scene.picture(walker, gain=1 + depth * np.sin(2 * np.pi * (rows / lines + time * rolls)))

    assert_walker_alone(camera)

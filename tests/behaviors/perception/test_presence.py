"""Who moved and stands still is present: until he goes, or for a minute."""

from __future__ import annotations

import pytest

from tests.behaviors.perception.scenes import Scene
from zscout.behaviors.perception.motion import MotionDetector, Seen
from zscout.behaviors.perception.presence import LONGEST

RATE = 4.0


class Watch:
    def __init__(self, seed: int, noise: float = 4.0) -> None:
        self.scene, self.detector, self.time = Scene(seed, noise=noise), MotionDetector(), 0.0
        self.stay(None, 8.0)

    def look(self, at: float | None, gain: float = 1.0) -> Seen:
        self.time += 1 / RATE
        return self.detector.see(self.time, self.scene.picture(at, gain=gain, shade=60))

    def stay(self, at: float | None, seconds: float, gain: float = 1.0) -> list[Seen]:
        return [self.look(at, gain) for _ in range(round(seconds * RATE))]

    def walk(self, start: float, end: float, speed: float = 40.0) -> list[Seen]:
        steps = max(1, round(abs(end - start) / speed * RATE))
        return [self.look(start + (end - start) * step / steps) for step in range(steps + 1)]


SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 6))]


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("noise", [1.0, 4.0, 9.0])
def test_who_stops_is_present_until_he_goes(seed: int, noise: float) -> None:
    watch = Watch(seed, noise)
    assert any(seen.moving for seen in watch.walk(0, 80))
    stands = watch.stay(80, 20.0)
    still = next(number for number, seen in enumerate(stands) if not seen.moving)
    assert still <= 4 * RATE
    assert all(seen.present for seen in stands if not seen.moving)
    assert not any(seen.present and seen.moving for seen in stands)
    assert any(seen.moving for seen in watch.walk(80, 200))
    assert not any(seen.present for seen in watch.stay(None, 10.0)[round(4 * RATE) :])


@pytest.mark.parametrize("seed", SEEDS)
def test_who_walks_through_is_not_present_afterwards(seed: int) -> None:
    watch = Watch(seed)
    assert any(seen.moving for seen in watch.walk(-20, 190))
    assert not any(seen.present for seen in watch.stay(None, 10.0))


def test_for_a_minute_at_most() -> None:
    watch = Watch(1)
    watch.walk(0, 80)
    began = watch.time
    present = [watch.time for _ in range(round((LONGEST + 20) * RATE)) if watch.look(80).present]
    assert LONGEST - 1 <= present[-1] - began <= LONGEST + 4


def test_a_change_of_light_is_nobody() -> None:
    watch = Watch(2)
    watch.walk(-20, 190)
    watch.stay(None, 3.0)
    assert not any(seen.present for seen in watch.stay(None, 5.0, gain=0.8))


def test_a_pause_forgets_who_stood_there() -> None:
    watch = Watch(3)
    watch.walk(0, 80)
    assert watch.stay(80, 6.0)[-1].present
    watch.detector.pause()
    watch.time += 40
    assert not any(seen.present for seen in watch.stay(None, 5.0))

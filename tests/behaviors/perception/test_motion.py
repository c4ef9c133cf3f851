"""The motion detector on made-up scenes, on real recordings, and hidden in a simulated building."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np
import pytest

from studies.robots.watch import Case, Watched, cases, plan_of, watch
from tests.behaviors.perception.recordings import EMPTY_LAWN, GARDEN, HAND, PASSERS_BY, PEOPLE, covered, pictures
from tests.behaviors.perception.scenes import Scene, box_of, overlap
from zscout.behaviors.perception.motion import MAX_SIDE, Box, Event, EventTracker, MotionDetector, Seen, around
from zscout.behaviors.perception.presence import LONGEST
from zscout.simulation.building.plan_file import load_plan, shipped_plans

MISSING = "needs Debian's package opencv-doc (apt-get install opencv-doc)"


def times(rate: float, seconds: float, start: float = 0.0) -> Iterator[float]:
    for number in range(round(rate * seconds)):
        yield start + number / rate


def settled(scene: Scene, rate: float = 10.0, seconds: float = 4.0) -> MotionDetector:
    """A detector that has looked at the empty scene until `seconds`."""
    detector = MotionDetector()
    for time in times(rate, seconds):
        detector.see(time, scene.picture())
    return detector


def paused(scene: Scene) -> MotionDetector:
    """After 8 seconds of the empty scene."""
    detector = settled(scene, rate=4.0, seconds=8.0)
    detector.pause()
    return detector


@pytest.mark.parametrize(
    ("noise", "rate", "seconds"),
    [(1.0, 5.0, 16.0), (1.0, 30.0, 3.0), (5.0, 2.0, 30.0), (12.0, 5.0, 16.0), (12.0, 2.0, 30.0)],
)
def test_nobody_is_no_alarm_and_a_walker_is_one_within_a_second(noise: float, rate: float, seconds: float) -> None:
    scene, detector = Scene(1, noise=noise), MotionDetector()
    assert not any(detector.see(time, scene.picture()).moving for time in times(rate, seconds))
    first, best = None, 0.0
    for time in times(rate, 3.0, seconds):
        walker = 20 + 40 * (time - seconds)
        seen = detector.see(time, scene.picture(walker))
        if seen.moving:
            first = time if first is None else first
            best = max(best, overlap(seen.boxes[0], box_of(walker)))
    assert first is not None
    assert first - seconds <= 1.0
    assert best > 0.5


def told_after(detector: MotionDetector, scene: Scene, start: float, rate: float = 4.0) -> float:
    """Seconds until a walker is seen who comes at `start` and is not much darker than the wall."""
    for time in times(rate, 3.0, start):
        if detector.see(time, scene.picture(20 + 40 * (time - start), shade=80)).moving:
            return time - start
    return math.inf


def test_what_a_camera_shows_as_it_warms_up_is_not_learned() -> None:
    scene, detector = Scene(3, noise=3.0), MotionDetector()
    other = Scene(30, noise=3.0)
    # The channel still shows another robot, then comes what is half snow, then a good picture.
    detector.see(0.0, other.picture())
    for time, snow in ((1.75, 20.0), (2.0, 9.0)):
        spoiled = scene.picture() + scene.rng.normal(0, snow, scene.wall.shape)
        detector.see(time, np.clip(spoiled, 0, 255).astype(np.uint8))
    assert not any(detector.see(time, scene.picture()).moving for time in times(4.0, 1.75, 2.25))
    assert told_after(detector, scene, 4.0) <= 0.5


def test_after_a_pause_the_background_is_known() -> None:
    scene = Scene(4)
    detector = paused(scene)
    # Somebody else's picture, and what is half snow, are waited out.
    assert detector.see(60.0, Scene(40).picture()).learning
    spoiled = scene.picture() + scene.rng.normal(0, 20, scene.wall.shape)
    assert detector.see(61.75, np.clip(spoiled, 0, 255).astype(np.uint8)).learning
    assert detector.see(62.0, scene.picture()).learning
    assert not detector.see(62.25, scene.picture()).learning
    assert told_after(detector, scene, 62.5) <= 0.5


def test_what_has_changed_in_a_pause_is_no_motion() -> None:
    scene = Scene(5)
    detector = paused(scene)
    assert not any(detector.see(time, scene.picture(70)).moving for time in times(4.0, 10.0, 60.0))
    assert told_after(detector, scene, 80.0) <= 1.0


def test_what_has_come_before_white_in_a_pause_is_no_motion() -> None:
    """White hardly has noise, as the camera cuts it off: what stands before it now has."""
    scene = Scene(8, noise=9.0)
    scene.wall[20:110, 40:120] = 275
    detector = paused(scene)
    assert not any(detector.see(time, scene.picture(70, shade=40)).moving for time in times(4.0, 10.0, 60.0))
    assert told_after(detector, scene, 80.0) <= 1.0


def test_lines_that_are_torn_as_a_pause_ends_are_not_learned() -> None:
    scene = Scene(9)
    detector = paused(scene)
    assert detector.see(60.0, scene.picture()).learning
    torn = scene.picture()
    torn[60:70] = np.roll(torn[60:70], 24, axis=1)
    assert not detector.see(60.25, torn).learning
    assert not any(detector.see(time, scene.picture()).moving for time in times(4.0, 5.0, 60.5))


def test_who_walks_as_a_pause_ends_is_told_at_once() -> None:
    scene = Scene(10)
    detector = paused(scene)
    seen = [detector.see(time, scene.picture(20 + 40 * (time - 60))) for time in times(4.0, 1.5, 60.0)]
    assert [one.moving for one in seen[2:]] == [True] * 4
    # He leaves nothing behind of which more could be told.
    assert not any(detector.see(time, scene.picture()).moving for time in times(4.0, 5.0, 63.0))


@pytest.mark.parametrize("apart", [1.25, 2.5, 10.0])
def test_after_a_pause_pictures_may_come_slowly(apart: float) -> None:
    scene = Scene(11)
    detector = settled(scene, rate=1 / apart, seconds=20 * apart)
    detector.pause()
    seen = [detector.see(1000 + apart * number, scene.picture()) for number in range(4)]
    assert [one.learning for one in seen] == [True, True, False, False]
    assert detector.see(1000 + apart * 4, scene.picture(70)).moving
    # And anew, where the robot was moved.
    detector.pause()
    moved = Scene(110)
    assert [detector.see(2000 + apart * number, moved.picture()).learning for number in range(14)][-2:] == [False] * 2
    assert detector.see(2000 + apart * 14, moved.picture(70)).moving


def test_who_was_moved_in_a_pause_learns_anew() -> None:
    detector, scene = paused(Scene(6)), Scene(60)
    assert not any(detector.see(time, scene.picture()).moving for time in times(4.0, 6.0, 60.0))
    assert told_after(detector, scene, 66.0) <= 0.5


def test_who_paused_before_he_knew_anything_learns_anew() -> None:
    scene, detector = Scene(7), MotionDetector()
    detector.see(0.0, Scene(70).picture())
    detector.pause()
    assert not any(detector.see(time, scene.picture()).moving for time in times(4.0, 3.0, 10.0))
    assert told_after(detector, scene, 13.0) < math.inf


def test_pictures_at_uneven_times_with_gaps() -> None:
    scene, detector = Scene(2), MotionDetector()
    moments = np.cumsum(np.random.default_rng(2).exponential(0.3, 100))
    moments[50:] += 40
    assert not any(detector.see(float(time), scene.picture()).moving for time in moments)
    end = float(moments[-1])
    assert any(detector.see(end + 0.3 * n, scene.picture(30 + 12 * n)).moving for n in range(1, 4))


def test_light_that_flickers_drifts_and_is_switched_moves_nothing() -> None:
    scene, detector = Scene(3), settled(Scene(3))
    rng, told = np.random.default_rng(3), []
    for time in times(5, 24, 4):
        drift, switched = 1 - 0.4 * (time - 4) / 24, 0.6 if time > 20 else 1.0
        gain = drift * switched * (1 + 0.08 * np.sin(2 * np.pi * 3.7 * time) + rng.normal(0, 0.02))
        told.append(detector.see(time, scene.picture(gain=gain)).moving)
    assert not any(told)


@pytest.mark.parametrize("light", [1.06, 0.94])
@pytest.mark.parametrize("noise", [1.0, 6.0])
def test_white_has_no_gain(light: float, noise: float) -> None:
    scene = Scene(8, noise=noise)
    scene.wall[10:40, 30:100] = 320  # a window
    detector = settled(scene, rate=5.0, seconds=8.0)
    for time in times(5.0, 2.0, 8.0):
        assert not detector.see(time, scene.picture(gain=light)).boxes
    assert any(
        detector.see(time, scene.picture(20 + 40 * (time - 10), gain=light)).moving for time in times(5.0, 1.0, 10.0)
    )


def test_a_walker_is_seen_while_the_exposure_follows_him() -> None:
    scene = Scene(4)
    detector = settled(scene)
    told = [detector.see(4 + n / 10, scene.picture(30 + 4 * n, gain=1 + 0.03 * n, shade=20)).moving for n in range(10)]
    assert sum(told) >= 8


def test_torn_lines_are_no_motion() -> None:
    scene = Scene(5)
    detector = settled(scene)
    for number, time in enumerate(times(10, 10, 4)):
        picture = scene.picture()
        if number % 7 < 2:
            row = 40 + 2 * (number % 7)
            picture[row : row + 4] = np.roll(picture[row : row + 4], 17, axis=1)
        assert not detector.see(time, picture).moving, time


def test_who_is_in_one_picture_only_is_told() -> None:
    for seed in range(10):
        scene = Scene(seed)
        detector = settled(scene, rate=4.0)
        assert detector.see(4.0, scene.picture(30 + 10 * seed)).moving
        assert not any(detector.see(time, scene.picture()).moving for time in times(4.0, 3.0, 4.25))


@pytest.mark.parametrize("rate", [4.0, 10.0])
def test_a_fault_in_one_picture_is_no_motion(rate: float) -> None:
    """Of the transmission: it lies along the lines, or they stand aside."""
    scene, rng = Scene(15), np.random.default_rng(15)
    detector = settled(scene, rate=rate)
    for number, time in enumerate(times(rate, 240 / rate, 4)):
        picture, first = scene.picture(), int(rng.integers(0, 80))
        rows = slice(first, first + int(rng.integers(4, 40)))
        match number % 12:
            case 0:
                picture[rows] = np.roll(picture[rows], int(rng.integers(3, 26)), axis=1)
            case 4:
                for row in range(rows.start, rows.stop):
                    picture[row] = np.roll(picture[row], int(rng.integers(-25, 26)))
            case 8:
                picture[rows] = rng.integers(0, 256, picture[rows].shape)
        assert not detector.see(time, picture).moving, (number, time)


def test_a_moved_camera_is_learned_anew() -> None:
    scene, elsewhere = Scene(6), Scene(66)
    detector = settled(scene)
    first = detector.see(4.0, elsewhere.picture())
    assert not first.moving
    assert first.learning
    later = [detector.see(time, elsewhere.picture()).moving for time in times(10, 8, 4.1)]
    assert not any(later)


def test_who_stops_is_motion_no_longer_and_leaves_no_ghost() -> None:
    scene = Scene(7)
    detector = settled(scene, rate=5)
    came = [detector.see(time, scene.picture(min(80, 30 + 50 * (time - 4)))).moving for time in times(5, 2, 4)]
    assert sum(came) >= 6
    stands = [detector.see(time, scene.picture(80)).moving for time in times(5, 20, 6)]
    assert not any(stands[50:])
    left = [detector.see(time, scene.picture()).moving for time in times(5, 20, 26)]
    assert not any(left[25:])


def test_two_walkers_are_two_boxes_largest_first() -> None:
    scene = Scene(8)
    detector = settled(scene)
    for number in range(4):
        picture = scene.picture(40 + 2 * number)
        picture[60:90, 120 - number : 128 - number] = 240
        seen = detector.see(4 + number / 10, picture)
    assert len(seen.boxes) == 2
    assert seen.boxes[0].height > seen.boxes[1].height
    assert overlap(seen.boxes[1], (117, 60, 8, 30)) > 0.3


def test_large_colour_pictures_have_boxes_in_their_own_pixels() -> None:
    scene, detector = Scene(9), MotionDetector()
    for time in times(10, 5):
        walker = 80 + 20 * (time - 4) if time >= 4 else None
        large = cv2.resize(scene.picture(walker), (640, 480), interpolation=cv2.INTER_NEAREST)
        seen = detector.see(time, np.asarray(cv2.merge([large, large, large]), np.uint8))
    left, top, width, height = box_of(80 + 20 * 0.9)
    assert seen.moving
    assert overlap(seen.boxes[0], (4 * left, 4 * top, 4 * width, 4 * height)) > 0.5


def test_what_is_no_picture_is_refused() -> None:
    shapes = (120, 160, 4), (0, 160), (7, 160), (8, MAX_SIDE + 1), (160,)
    planes: list[Any] = [np.zeros(shape, np.uint8) for shape in shapes]
    for picture in (*planes, np.zeros((120, 160), np.float32), np.zeros((120, 160), np.uint16)):
        with pytest.raises(ValueError, match="not a picture"):
            MotionDetector().see(0.0, picture)


def test_plain_pictures_and_times_that_go_back_do_no_harm() -> None:
    detector = MotionDetector()
    for number, level in enumerate((0, 0, 0, 0, 255, 255, 7, 7, 0)):
        seen = detector.see(10.0 - number, np.full((120, 160), level, np.uint8))
        assert not seen.moving


@pytest.mark.slow
@pytest.mark.skipif(not PASSERS_BY.exists(), reason=MISSING)
def test_passers_by_of_a_real_recording_are_found_and_nobody_else() -> None:
    whole, lawn = MotionDetector(), MotionDetector()
    rows, columns, empty_until = EMPTY_LAWN
    found = people = 0
    for number, (time, picture) in enumerate(pictures(PASSERS_BY)):
        seen = whole.see(time, picture)
        if time < empty_until:
            part = np.ascontiguousarray(picture[rows, columns])
            assert not lawn.see(time, part).moving, f"the empty lawn moves at {time} s"
        if number >= 10:
            assert seen.moving or number < 12
        for one in PEOPLE.get(number, ()):
            people += 1
            found += max((covered(one, box) for box in seen.boxes), default=0.0) >= 0.5
        if number in PEOPLE:
            for box in seen.boxes:
                assert any(covered(one, box) >= 0.25 for one in PEOPLE[number]), (number, box)
        if number == 160:
            break
    assert people == 13
    assert found >= 8


@pytest.mark.skipif(not GARDEN.exists(), reason=MISSING)
def test_leaves_in_the_wind_hardly_count_and_a_hand_does() -> None:
    detector = MotionDetector()
    told = [(time, detector.see(time, picture).moving) for time, picture in pictures(GARDEN)]
    assert sum(moving for time, moving in told if time < HAND) <= 3
    hand = [moving for time, moving in told if time >= HAND]
    assert any(hand[:2])
    assert sum(hand) >= 11


def test_hidden_in_a_building_it_alerts_to_who_walks_by() -> None:
    """Far from the figures of docs/watching.md, which `python -m studies.watching` measures."""
    sight = Watched()
    for seed in (3, 4):
        case = Case("living_room", 1.0, seed)
        sight.add(watch(plan_of(case), seed=seed, noise=case.noise, seconds=16))
    assert sight.crossings >= 1
    assert (sight.alerted, sight.false_alarms) == (sight.crossings, 0)
    assert sight.empty > 5


def test_a_batch_is_even_however_soon_it_is_cut() -> None:
    names = sorted(shipped_plans())
    some = cases(names, seeds=3, noises=(0.5, 2.0))
    assert len(some) == len(set(some)) == 6 * len(names)
    assert {(case.building, case.noise) for case in some[: 2 * len(names)]} == {
        (name, noise) for name in names for noise in (0.5, 2.0)
    }
    assert {case.seed for case in some[: 2 * len(names)]} == {0}
    assert plan_of(some[0]).people[0].first < load_plan(shipped_plans()[names[0]]).people[0].first


# Who moved and stands still is present: until he goes, or for a minute


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


# From sightings to events


STILL = Seen(False)
A, B, BIG = Box(10, 10, 5, 8), Box(40, 20, 4, 4), Box(12, 10, 30, 30)


def played(tracker: EventTracker, *sights: tuple[float, Seen]) -> list[Event]:
    return [event for time, seen in sights if (event := tracker.see(time, seen)) is not None]


def test_an_event_begins_with_the_sighting_that_was_confirmed_and_ends_with_the_last() -> None:
    tracker = EventTracker()
    events = played(
        tracker,
        (0.0, STILL),
        (1.0, Seen(False, (A,))),
        (1.2, Seen(True, (BIG, B))),
        (1.4, Seen(True, (A,))),
        (1.6, STILL),
        (2.4, STILL),
        (2.5, STILL),
    )
    assert events == [Event(1.0, 1.4, 1.2, (BIG, B), Box(10, 10, 34, 30), 3)]
    assert tracker.current is None
    assert tracker.close() is None


def test_a_short_pause_goes_on_with_the_event_and_a_long_one_ends_it() -> None:
    tracker = EventTracker()
    sights = [(0.0, Seen(True, (A,))), (1.0, Seen(True, (A,))), (2.1, Seen(True, (B,))), (9.0, STILL)]
    events = played(tracker, *sights)
    assert [(event.start, event.end, event.frames) for event in events] == [(0.0, 1.0, 2), (2.1, 2.1, 1)]


def test_a_sighting_long_ago_begins_nothing() -> None:
    tracker = EventTracker()
    played(tracker, (0.0, Seen(False, (A,))), (5.0, Seen(True, (B,))))
    assert tracker.current == Event(5.0, 5.0, 5.0, (B,), B, 1)


def test_pictures_that_stay_away_end_it_as_well_and_what_was_not_over_says_so() -> None:
    away, last = EventTracker(), EventTracker()
    for tracker in (away, last):
        tracker.see(3.0, Seen(True, (A,)))
    assert away.quiet(4.0) is None
    ended, closed = away.quiet(4.1), last.close()
    assert ended is not None
    assert closed is not None
    assert (ended.going_on, closed.going_on) == (False, True)
    assert (away.quiet(9.0), last.close()) == (None, None)


def test_boxes_around() -> None:
    assert (around((A, B)), around(())) == (Box(10, 10, 34, 14), Box(0, 0, 0, 0))

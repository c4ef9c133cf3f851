"""Who is at it, and who stands in: told as a transcript of events and effects."""

from __future__ import annotations

import random
from collections.abc import Iterator

import numpy as np
import pytest

from tests.behaviors.perception.scenes import Scene
from zscout.behaviors.perception.lens import COLUMNS, ROWS
from zscout.behaviors.sensor_net.net import ABSENCE_TIMEOUT, RETRY, Effect, SensorNet, StartRobot
from zscout.behaviors.sensor_net.place_robot import Slots
from zscout.behaviors.sensor_net.scout import LATELY, Scout
from zscout.messages import MotionLimits

STORIES = {
    "all that are wanted begin once they are there": """
        2 of a b c
        0 there a          -> start a
        1 there a b c      -> start b
        2 there a b c      ->
        """,
    "a robot that is not seen is replaced by the next that is free": """
        2 of a b c
        0 there a b c      -> start a, start b
        1 a search         ->
        5 a lost           -> stop a, start c
        6 a watch          ->
        7 c hide           ->
        """,
    "a robot may be away for a while": """
        1 of a b
        0 there a b        -> start a
        1 there b          ->
        9 there a b        ->
        10 there b         ->
        19 there b         ->
        20 there b         -> stop a, start b
        21 there a b       ->
        22 b lost          -> stop b, start a
        """,
    "nobody is replaced by one that has just gone too": """
        1 of a b c
        0 there a b c      -> start a
        1 there b c        ->
        12 there c         -> stop a, start c
        """,
    "with nobody left, the one lost for longest is tried again after a while": """
        1 of a b
        0 there a b        -> start a
        1 a lost           -> stop a, start b
        2 b lost           -> stop b
        30 there a b       ->
        61 there a b       -> start a
        """,
    "a behavior that can't be had is like a robot that is lost": """
        1 of a b
        0 there a b        -> start a
        1 failed a         -> stop a, start b
        2 failed a         ->
        """,
    "strangers are not listened to": """
        1 of a
        0 there a          -> start a
        1 x lost           ->
        """,
}


@pytest.mark.parametrize("story", STORIES)
def test_story(story: str) -> None:
    head, *lines = [line.strip() for line in STORIES[story].strip().splitlines()]
    wanted, _, *robots = head.split()
    net = SensorNet(robots, int(wanted))
    for line in lines:
        event, _, effects = line.partition("->")
        said = ", ".join(_told(effect) for effect in _happens(net, event.split()))
        assert f"{event.strip()} -> {said}" == f"{event.strip()} -> {effects.strip()}"


def _happens(net: SensorNet, words: list[str]) -> list[Effect]:
    match words:
        case [at, "there", *robots]:
            return net.there(float(at), robots)
        case [at, "failed", robot]:
            return net.failed(float(at), robot, "no host will do")
        case [at, robot, doing]:
            return net.report(float(at), robot, doing)
    raise AssertionError(words)


def _told(effect: Effect) -> str:
    return f"start {effect.robot}" if isinstance(effect, StartRobot) else f"stop {effect.robot}"


def test_hidden_robots_stay_so_while_they_wait_for_their_turn() -> None:
    net = SensorNet(["a", "b"])
    net.there(0, ["a", "b"])
    for doing in ("search", "hidden", "", "wait", "watch"):
        net.report(1, "a", doing)
        assert net.hidden == (doing != "search")
    assert (net.hidden, net.watching) == (1, 1)
    net.report(2, "a", "alert", alert=True)
    assert (net.watching, net.alerts) == (1, 1)
    net.report(3, "a", "search")
    assert (net.hidden, net.watching) == (0, 0)


@pytest.mark.parametrize(("robots", "wanted"), [([], None), (["a", "a"], None), (["a"], 2), (["a"], 0)])
def test_what_is_no_net(robots: list[str], wanted: int | None) -> None:
    with pytest.raises(ValueError, match=r"robots|wanted"):
        SensorNet(robots, wanted)


@pytest.mark.parametrize("seed", range(40))
def test_as_many_as_wanted_are_at_it_whenever_there_are_enough(seed: int) -> None:
    """Robots come, go, die and return: never more than wanted, started and stopped in turn, and while enough
    are there that were not lost, as many as wanted; memory and recall change nothing."""
    rng = random.Random(seed)  # noqa: S311
    names = [f"r{number}" for number in range(rng.randint(1, 6))]
    wanted = rng.randint(1, len(names))
    net = SensorNet(names, wanted)
    running: set[str] = set()
    now = 0.0
    for effects in _life(rng, net, names):
        now += 1
        for effect in effects:
            if isinstance(effect, StartRobot):
                assert effect.robot not in running
                running.add(effect.robot)
            else:
                running.remove(effect.robot)
        assert running == {m.robot for m in net.members.values() if m.standing == "active"}
        assert len(running) <= wanted
        able = [m for m in net.members.values() if m.there and m.standing != "lost"]
        assert len(running) == wanted or all(m.standing == "active" for m in able)
        again = SensorNet(names, wanted)
        again.recall(net.memory())
        assert again.memory() == net.memory()
    assert now > 0


def _life(rng: random.Random, net: SensorNet, names: list[str]) -> Iterator[list[Effect]]:
    there = set(names)
    for step in range(300):
        now = step * rng.choice((1.0, ABSENCE_TIMEOUT / 2)) if step % 50 else step * RETRY / 20
        match rng.randint(0, 5):
            case 0:
                there ^= {rng.choice(names)}
            case 1:
                yield net.report(now, rng.choice(names), rng.choice(("search", "watch", "lost", "wait", "")))
                continue
            case 2:
                yield net.failed(now, rng.choice(names), "it was given up")
                continue
        yield net.there(now, there)


# What one robot keeps of its turns to watch


def watch_once(scout: Scout, *, somebody: bool) -> None:
    """One turn of a robot that is hidden."""
    alerts = scout.memory()["alerts"] | {"before": scout.alerts.count}
    scout.recall(scout.memory() | {"task": "watch", "held": True, "alerts": alerts})
    scout.alerts.see(1.0, somebody)
    scout.released(2.0)


def test_who_lately_saw_somebody_goes_before_the_others_for_a_while() -> None:
    slots = Slots()
    quiet, lively = slots.of("watch"), slots.of("watch", sooner=True)
    assert (quiet[0], quiet[1] > lively[1]) == (lively[0], True)
    scout, found = Scout(), []
    for somebody in (False, True, *[False] * LATELY):
        watch_once(scout, somebody=somebody)
        found.append(scout.saw_somebody)
    assert found == [False, *[True] * LATELY, False]


def test_a_hide_begins_anew() -> None:
    scout = Scout()
    watch_once(scout, somebody=True)
    scout.held(3.0)
    assert (scout.task, scout.saw_somebody) == ("hide", False)


def test_what_was_kept_before_turns_were_is_taken_up() -> None:
    old = Scout().memory()
    old["alerts"] = {"count": 3}
    scout = Scout()
    scout.recall(old)
    assert (scout.alerts.count, scout.saw_somebody) == (3, False)


@pytest.mark.parametrize(("goes_on", "phase"), [(True, "hidden"), (False, "check")])
def test_who_moves_with_his_hold_goes_on_and_who_lost_it_on_the_way_looks_again(goes_on: bool, phase: str) -> None:
    old, scout = Scout(), Scout()
    old.held(0.0)
    old.hider._robot.phase = "hidden"
    scout.recall(old.memory())
    scout.held(60.0, goes_on=goes_on)
    assert (scout.hider._robot.phase, scout.task) == (phase, "watch")


def a_hidden_scout() -> Scout:
    """In its first turn to watch."""
    scout = Scout()
    scout.held(0.0)
    scout.hider._robot.phase = "hidden"
    scout.released(0.5)
    scout.held(1.0)
    scout.hider._robot.phase = "hidden"
    return scout


def test_a_frozen_picture_is_an_alert_at_its_beginning_and_ends_no_turn() -> None:
    scout = a_hidden_scout()
    still = np.random.default_rng(0).integers(90, 110, (ROWS, COLUMNS), np.uint8)
    steps = []
    for number in range(20):
        scout.frozen = 10.0 + number
        steps.append(scout.see(1 + number, still, "video/a"))
    assert [step.alert for step in steps] == [True] + 19 * [False]
    assert {(step.doing, step.blind, step.over) for step in steps} == {("blind", False, False)}
    assert steps[5].detail == "frozen: the same picture for 15 s"
    scout.frozen = 0.0
    scout.see(22.0, np.add(still, 1, dtype=np.uint8), "video/a")
    scout.frozen = 10.0
    assert scout.see(23.0, still, "video/a").alert


def test_what_moves_after_a_while_of_bad_pictures_is_another_event() -> None:
    scout = a_hidden_scout()
    assert scout.alerts.see(1.0, True) == "start"
    snow = np.random.default_rng(0).integers(0, 255, (ROWS, COLUMNS), np.uint8)
    steps = [scout.see(1 + number / 4, snow, "video/a") for number in range(1, 20)]
    assert {step.doing for step in steps} == {"blind"}
    assert [step.quiet for step in steps].count(True) == 1
    assert scout.alerts.see(6.0, True) == "start"


@pytest.mark.parametrize(
    ("limits", "alerts"),
    [
        (None, 1),
        (MotionLimits([[0, 0, 1, 0.2]], 0.01, 1.0), 1),
        (MotionLimits([[0, 0, 1, 1]]), 0),
        (MotionLimits(min_area=0.3), 0),
        (MotionLimits(min_duration=5.0), 0),
    ],
)
def test_a_scout_keeps_to_what_its_framegrabber_says_of_motion(limits: MotionLimits | None, alerts: int) -> None:
    scout, scene = a_hidden_scout(), Scene(4)
    for number in range(40):
        scout.limit(limits)
        scout.see(2 + number / 5, scene.picture(6 * (number - 15) if 15 < number < 35 else None), "video/a")
    assert scout.alerts.count == alerts

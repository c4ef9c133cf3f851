"""Who is at it, and who stands in: told as a transcript of events and effects."""

from __future__ import annotations

import random
from collections.abc import Iterator

import pytest

from zscout.behaviors.sensor_net.net import ABSENCE_TIMEOUT, RETRY, Effect, SensorNet, StartRobot

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

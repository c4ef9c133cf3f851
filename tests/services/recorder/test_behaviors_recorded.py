"""Behaviors and devices in real recordings: lanes, alerts, figures, and who says too much."""

from __future__ import annotations

import math
import random
from pathlib import Path
from typing import Any

import pytest
import rerun as rr
import rerun.blueprint as rrb
from msgspec.structs import replace
from rerun.blueprint.api import Container, View

from tests.services.recorder.paper_run import colours, events, lanes, rows
from tests.services.recorder.robot_run import NET, say
from zscout.keyexpr import Sender
from zscout.messages import BehaviorSaid, RcState, Unwell
from zscout.services.recorder import robots
from zscout.services.recorder.blueprint import LEGEND, Layout, RobotLayout, blueprint
from zscout.services.recorder.colours import DOING, OTHER
from zscout.services.recorder.robots import MAX_WAITING, RATE, RateLimiter
from zscout.services.recorder.timeline import Timeline


def test_a_sender_s_last_word_comes_through_whatever_it_says(path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        tracker = timeline.robots
        for number in range(1000):
            say(tracker, number / 1000, f"flood/{number % 3}", "search", Sender("bad", "one"), detail=f"{number}")
            if number % 250 == 0:
                say(tracker, number / 1000, "net/quiet", f"step{number}")
        for tenth in range(10, 30):
            tracker.tick(tenth / 10)
    shown = lanes(path, "/behavior/**")
    assert [states for _, states in shown["/behavior/net/quiet"]] == [["step0"], ["step250"], ["step500"], ["step750"]]
    flood = [shown[f"/behavior/flood/{number}"] for number in range(3)]
    assert {lane[-1][1][0] for lane in flood} == {f"search · {number}" for number in (997, 998, 999)}
    kept = sum(len(lane) for lane in flood)
    assert kept <= 20 + RATE + 3
    (told_of,) = (text for text in events(path) if "too many reports of behaviors" in text)
    assert told_of.startswith("too many reports of behaviors from bad/one: dropped ")
    assert int(told_of.split()[-1]) == 1000 - kept


def test_the_rate_limiter_keeps_its_rate_and_the_newest() -> None:
    """Whatever is said when: never more than the rate and a burst, and at last all paths as said last."""
    for seed in range(20):
        draw, limiter = random.Random(seed), RateLimiter()  # noqa: S311
        at, taken, last = 0.0, list[tuple[float, BehaviorSaid]](), dict[str, BehaviorSaid]()
        for _ in range(600):
            at += draw.choice((0.0, 0.001, 0.02, 0.3 * draw.random()))
            said = BehaviorSaid(f"net/{draw.randrange(30)}", f"{at}")
            last[said.path] = said
            taken += [(at, said)] if limiter.offer(at, NET, said) else []
            if draw.random() < 0.2:
                taken += [(at, waited) for _, waited in limiter.due(at)]
        for _ in range(20):
            at += 0.25
            taken += [(at, waited) for _, waited in limiter.due(at)]
        assert {said.path: said for _, said in taken} == last
        times = [moment for moment, _ in taken]
        for first, begin in enumerate(times):
            within = sum(begin <= moment <= begin + 1 for moment in times[first:])
            assert within <= 2 * RATE + 1
        assert sum(count for _, count in limiter.dropped(at)) == 600 - len(taken)


def test_what_waits_of_a_sender_is_bounded() -> None:
    limiter = RateLimiter()
    for number in range(10_000):
        limiter.offer(0, NET, BehaviorSaid(f"net/{number}", "search"))
    late = [said for at in range(1, 100) for _, said in limiter.due(at)]
    assert len(late) == MAX_WAITING


def test_behaviors_end_with_their_client_unless_they_moved(path: Path) -> None:
    heir = Sender("basil", "net")
    with Timeline("lab", path=path) as timeline:
        tracker = timeline.robots
        say(tracker, 0, "net/a", "search")
        say(tracker, 0, "net/b", "watch")
        say(tracker, 1, "net/a", "approach", heir)
        tracker.left(2, NET)
        tracker.left(3, heir)
        tracker.left(4, heir)
    assert lanes(path, "/behavior/**") == {
        "/behavior/net/a": [(0, ["search"]), (1, ["approach"]), (3, [""])],
        "/behavior/net/b": [(0, ["watch"]), (2, [""])],
    }


def test_lanes_are_bounded_and_keep_their_colours(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robots, "MAX_LANES", 2)
    monkeypatch.setattr(robots, "DETAILS", 5)
    deep = "/".join("abcdefghijk")
    with Timeline("lab", path=path) as timeline:
        tracker = timeline.robots
        for number in range(20):
            say(tracker, number, deep, "search", detail=f"{number}")
        say(tracker, 20, deep, "alert", detail="more\n\x1b[31m")
        say(tracker, 21, "../x y", "dances")
        say(tracker, 22, "third", "search")
        say(tracker, 22, "ended", "")
    assert set(lanes(path, "/behavior/**")) == {"/behavior/a/b/c/d/e/f/g/h", "/behavior/../x_y"}
    texts = [states[0] for _, states in lanes(path, "/behavior/a/**")["/behavior/a/b/c/d/e/f/g/h"]]
    assert texts == [*(f"search · {number}" for number in range(5)), "search", "alert"]
    shades = colours(path, "/behavior/**")
    assert shades["/behavior/a/b/c/d/e/f/g/h"]["search"] == DOING["search"]
    assert shades["/behavior/a/b/c/d/e/f/g/h"]["alert"] == DOING["alert"]
    assert shades["/behavior/../x_y"] == {"dances": OTHER}
    assert events(path) == ["timeline: more than 2 behaviors: the others have no lane"]


def test_alerts_in_words(path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        tracker = timeline.robots
        say(tracker, 0, "net/a", "alert", alert=True, robot="robot/scout33", detail="motion (3)")
        say(tracker, 1, "net/a", "alert", alert=True)
        say(tracker, 2, "net/b", "blind", alert=True, robot="scout35", detail="snow")
        say(tracker, 3, "net/a", "alert", robot="robot/scout33", detail="motion (3)")
    assert events(path) == ["scout33 sees motion (3)", "net/a sees something", "scout35: blind · snow"]
    assert lanes(path, "/behavior/net/b")["/behavior/net/b"] == [(2, ["alert · blind · snow"])]
    assert colours(path, "/behavior/net/b")["/behavior/net/b"]["alert · blind · snow"] == DOING["alert"]


def origins(part: Container | View) -> set[str]:
    """The entities that the panes of a layout look at."""
    if isinstance(part, View):
        return {str(part.origin)}
    return {origin for one in part.contents for origin in origins(one)}


def test_without_figures_there_is_no_pane_for_devices() -> None:
    assert "/device" not in origins(blueprint(Layout()).root_container)
    few, many = (blueprint(Layout(robots=RobotLayout(devices=number))) for number in (1, LEGEND + 1))
    assert "/device" in origins(few.root_container) & origins(many.root_container)


class Watched(rr.RecordingStream):
    """Keeps which panes it was sent."""

    def __init__(self) -> None:
        super().__init__("test")
        self.panes: list[set[str]] = []

    def send_blueprint(self, blueprint: rrb.BlueprintLike, **_: Any) -> None:
        assert isinstance(blueprint, rrb.Blueprint)
        self.panes.append(origins(blueprint.root_container))


def test_the_first_figure_of_a_device_lays_a_live_view_out_anew() -> None:
    with Timeline("lab", path=None) as timeline:
        stream = Watched()
        timeline.streams.append(stream)
        state = RcState("lamp/desk", "cart", "i", sharable=False)
        timeline.robots.state(0, state)
        assert stream.panes == []
        timeline.robots.state(1, replace(state, figures={"level": 50.0}))
        timeline.robots.state(2, replace(state, figures={"level": 60.0}))
        (panes,) = stream.panes
        assert "/device" in panes


def test_devices_figures_and_health(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robots, "MAX_SERIES", 3)
    monkeypatch.setattr(robots, "MAX_FOLLOWED", 2)

    def state(
        at: float, rc: str, health: str = "ok", figures: dict[str, float] | None = None, unwell: str = ""
    ) -> None:
        sick = Unwell(unwell, 1.0, 59.0) if unwell else None
        tracker.state(at, RcState(rc, "cart", "i", sharable=False, health=health, unwell=sick, figures=figures or {}))

    with Timeline("lab", path=path) as timeline:
        tracker = timeline.robots
        state(0, "robot/a", figures={"rate": 1.0, "drops": math.inf})
        state(0.1, "robot/a", figures={"rate": 2.0})
        for at in (1, 2, 30, 31, 32):
            state(at, "robot/a", figures={"rate": 3.0})
        state(33, "robot/b", figures={"x/y": 4.0, "z": 5.0, "w": 6.0})
        state(34, "radio/rf0", "unplugged")
        state(34.1, "radio/rf0", "unplugged again")
        state(35.5, "radio/rf0")
        state(35.6, "radio/rf0")
        state(36, "radio/rf0", "unplugged for good")
        for tick in (36.25, 36.5, 36.75):
            tracker.tick(tick)
        state(40, "lamp/desk", unwell="no answer to ping")
        state(42, "lamp/desk")
        state(44, "lamp/desk", unwell="no answer to ping")
        state(46, "lamp/desk", "no answer to ping for 60 s", unwell="no answer to ping")
        assert not timeline.robots.shown.any
        assert "/device" in origins(blueprint(timeline.layout(live=False)).root_container)
    told_of_a = sorted((at, value) for _, at, value in rows(path, "/device/robot/a/rate", "Scalars:scalars"))
    assert {entity for entity, _, _ in rows(path, "/device/**", "Scalars:scalars")} == {
        "/device/robot/a/rate",
        "/device/robot/b/x_y",
        "/device/robot/b/z",
    }
    assert [(at, value) for at, value in told_of_a if value] == [(0, [1]), (1, [3]), (31, [3])]
    assert events(path) == [
        "timeline: more than 3 figures of devices: the others are not drawn",
        "radio/rf0 fails: unplugged",
        "radio/rf0 is well again",
        "radio/rf0 fails: unplugged for good",
        "lamp/desk is unwell: no answer to ping",
        "lamp/desk is well again",
        "lamp/desk is unwell: no answer to ping",
        "lamp/desk fails: no answer to ping for 60 s",
    ]

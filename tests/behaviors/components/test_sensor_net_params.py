"""Parameters of `place_robot` and `place_sensor_net`: what is wrong is told in one line that names it."""

from __future__ import annotations

from typing import Any

import pytest

from zscout.behaviors.components.component import installed_kinds, is_movable, load_kind
from zscout.behaviors.components.sensor_net import PlaceRobotComponent, PlaceSensorNetComponent, StatusPrinter
from zscout.behaviors.sensor_net.place_robot import PlaceRobot
from zscout.behaviors.sensor_net.place_sensor_net import PlaceSensorNet
from zscout.messages import BehaviorSaid

ONE: dict[str, Any] = {"robot": "robot/scout33"}
TWO: dict[str, Any] = {"robots": ["robot/scout33", "robot/scout35"]}

SHARED: list[tuple[dict[str, Any], str]] = [
    ({"radio": "robot/scout33"}, '"robot/scout33" is not a radio; name one, or a pattern, as in "radio/*"'),
    ({"radio": "rf0"}, '"rf0" is not a radio;'),
    ({"video": None}, "is null; write a text in quotes"),
    ({"video": "video/**"}, '"video/**" is not a video;'),
    ({"framegrabber": ["framegrabber/fgrab1"]}, "is a list;"),
    ({"framegrabber": "framegrabber/a/b"}, '"framegrabber/a/b" is not a framegrabber;'),
    ({"framegrabber": "framegrabber/"}, '"framegrabber/" is not a framegrabber;'),
    ({"framegrabber": "radio/*"}, '"radio/*" is needed already, as the radio; name another device'),
    ({"command_rate": 0}, "is 0; write a number from 0.5 to 50"),
    ({"command_rate": 50.1}, "is 50.1; write a number from 0.5 to 50"),
    ({"command_rate": "5"}, 'is the text "5";'),
    ({"speed": 0}, "is 0; write a number from 0.01 to 100"),
    ({"speed": float("nan")}, "is not a finite number; write a number from 0.01 to 100"),
    ({"speed": True}, "is true;"),
    ({"hide_slot": -1}, "is -1; write a number from 1 to 3600"),
    ({"watch_slot": float("inf")}, "is not a finite number; write a number from 1 to 3600"),
    ({"hide_priority": 1.5}, "is 1.5; write a whole number from -1000 to 1000"),
    ({"watch_priority": 1001}, "is 1001; write a whole number from -1000 to 1000"),
    ({"watch_priority": False}, "is false;"),
    ({"watch_priorty": 1}, "unknown key; did you mean watch_priority, watch_slot or hide_priority?"),
]
"""Wrong for both; the message names the key, and has these words."""

OF_ONE: list[tuple[dict[str, Any], str]] = [
    ({}, "robot: is missing; add one, as in robot/scout33"),
    ({"robot": None}, "robot: is null; write a text in quotes"),
    ({"robot": "scout33"}, 'robot: "scout33" is not the name of a device;'),
    ({"robot": "radio/rf0"}, 'robot: "radio/rf0" is not a robot;'),
    ({"robot": "robot/*"}, 'robot: "robot/*" is not the name of a device;'),
    ({"robot": ["robot/scout33"]}, "robot: is a list;"),
    (ONE | {"above": 3}, "above: is 3; write a text in quotes"),
    (ONE | {"above": "x" * 101}, "Expected `str` of length <= 100 - at `$.above`; correct it"),
    (TWO, "robots: unknown key; did you mean robot?"),
]

OF_NET: list[tuple[dict[str, Any], str]] = [
    ({}, 'robots: is missing; add a list, as in ["robot/scout33"]'),
    ({"robots": None}, "robots: is null; write a list"),
    ({"robots": []}, 'robots: is empty; name one, as in ["robot/scout33"]'),
    ({"robots": "robot/scout33"}, 'robots: is the text "robot/scout33"; write a list'),
    ({"robots": {"robot/scout33": 1}}, "robots: is a table; write a list"),
    ({"robots": [f"robot/scout{number}" for number in range(65)]}, "robots: has 65 entries; at most 64 are allowed"),
    ({"robots": ["robot/scout33", 35]}, "robots[1]: is 35;"),
    ({"robots": ["framegrabber/fgrab1"]}, 'robots[0]: "framegrabber/fgrab1" is not a robot;'),
    ({"robots": ["robot/*"]}, 'robots[0]: "robot/*" is not the name of a device;'),
    ({"robots": ["robot/a", "robot/b", "robot/a"]}, 'robots[2]: "robot/a" is already at robots[0];'),
    (TWO | {"wanted": 0}, "wanted: is 0; write a whole number from 1 to 2"),
    (TWO | {"wanted": 3}, "wanted: is 3; write a whole number from 1 to 2"),
    (TWO | {"wanted": 1.0}, "wanted: is 1.0; write a whole number"),
    (TWO | {"wanted": True}, "wanted: is true; write a whole number"),
    (TWO | {"name": "../net"}, 'name: "../net" is not a name;'),
    (TWO | {"name": ""}, 'name: "" is not a name;'),
    (TWO | {"name": ["net"]}, "name: is a list;"),
    (TWO | {"above": "net"}, "above: unknown key; known here: command_rate, framegrabber, hide_priority, hide_slot, "),
]

WRONG = [
    *((PlaceRobotComponent, ONE | wrong, f"{next(iter(wrong))}: {words}") for wrong, words in SHARED),
    *((PlaceSensorNetComponent, TWO | wrong, f"{next(iter(wrong))}: {words}") for wrong, words in SHARED),
    *((PlaceRobotComponent, wrong, words) for wrong, words in OF_ONE),
    *((PlaceSensorNetComponent, wrong, words) for wrong, words in OF_NET),
]


def test_what_is_wrong_is_told_in_one_line() -> None:
    for kind, params, words in WRONG:
        with pytest.raises(ValueError) as told:  # noqa: PT011 - the words are what is tested
            kind(params)
        line = str(told.value)
        assert line.startswith(words)
        assert "\n" not in line
        assert len(line) < 300


def test_what_is_asked_for_reaches_the_behaviors() -> None:
    asked = {"radio": "radio/rf0", "video": "video/$*1", "command_rate": 8, "speed": 2, "watch_priority": -3}
    one = PlaceRobotComponent(ONE | asked | {"above": "net", "hide_slot": 5, "watch_slot": 2.5})
    assert isinstance(one.root, PlaceRobot)
    assert (one.speed, one.root.path) == (2.0, "net/scout33")
    assert one.root.needs.needs() == {
        "robot/scout33": {},
        "radio/rf0": {"command_rate": 8.0, "packet_size": 10},
        "video/$*1": {"transmitters": 1},
        "framegrabber/*": {},
    }
    assert (one.root.slots.of("hide"), one.root.slots.of("watch")) == ((2, 5.0), (-3, 2.5))


def test_a_camera_may_have_a_name_of_any_kind() -> None:
    net = PlaceRobotComponent(ONE | {"framegrabber": "camera/*"})
    assert isinstance(net.root, PlaceRobot)
    assert net.root.needs.framegrabber == "camera/*"


def test_each_robot_of_a_net_is_placed_with_what_the_net_was_told() -> None:
    net = PlaceSensorNetComponent(TWO | {"wanted": 1, "name": "night", "speed": 2, "hide_slot": 9})
    assert isinstance(net.root, PlaceSensorNet)
    assert (net.root.net.wanted, list(net.root.net.members)) == (1, TWO["robots"])
    spec = net._spec_for("robot/scout35", "night")
    assert spec.kind == "place_robot"
    assert spec.params == {"robot": "robot/scout35", "above": "night", "speed": 2, "hide_slot": 9}
    # What the net passes on is good for who gets it.
    placed = PlaceRobotComponent(spec.params)
    assert placed.root.path == "night/scout35"


def test_both_are_installed_and_can_be_moved() -> None:
    there = installed_kinds()
    assert load_kind("place_robot", there["place_robot"]) is PlaceRobotComponent
    assert load_kind("place_sensor_net", there["place_sensor_net"]) is PlaceSensorNetComponent
    for made, same in (
        (PlaceRobotComponent(ONE), PlaceRobotComponent(ONE)),
        (PlaceSensorNetComponent(TWO), PlaceSensorNetComponent(TWO)),
    ):
        assert is_movable(made)
        same.restore(made.checkpoint())
        assert same.checkpoint() == made.checkpoint()


def test_the_output_tells_each_word_once_and_every_alert(capsys: pytest.CaptureFixture[str]) -> None:
    printer, robot = StatusPrinter(), "robot/scout33"
    said = [
        ("approach", "dark place 1.4 m ahead", False),
        ("approach", "dark place 1.3 m ahead", False),
        ("enter", "", False),
        ("alert", "motion 1", True),
        ("alert", "motion 2", True),
        ("", "", False),
        ("enter", "", False),
    ]
    for doing, detail, alert in said:
        printer(BehaviorSaid("net/scout33/hide", doing, detail, robot=robot, alert=alert))
    printer(BehaviorSaid("net", "place", "0 of 2 hidden"))
    printer(BehaviorSaid("net", "place", "1 of 2 hidden"))
    printer(BehaviorSaid("net", "place", "1 of 2 hidden"))
    assert capsys.readouterr().out.splitlines() == [
        "net/scout33/hide approach: dark place 1.4 m ahead",
        "net/scout33/hide enter",
        "net/scout33/hide ALERT: motion 1",
        "net/scout33/hide ALERT: motion 2",
        "net/scout33/hide enter",
        "net place: 0 of 2 hidden",
        "net place: 1 of 2 hidden",
    ]

"""What the recorder writes of robots, read back from real recordings."""

from __future__ import annotations

import math
from itertools import combinations
from pathlib import Path

import pytest

from tests.services.recorder.paper_run import colours, events, lanes, rows
from tests.services.recorder.robot_run import BUILDING, captions, png, poses, record
from tests.services.recorder.test_timeline import lab_of
from zscout.keyexpr import Sender
from zscout.messages import BuildingPlan, Placed
from zscout.services.recorder.colours import DOING, HIDDEN, IN_THE_OPEN, OPERATOR, PERSON, bright
from zscout.services.recorder.timeline import Timeline


@pytest.mark.slow
def test_a_minute_reads_as_it_was(path: Path) -> None:
    record(path)
    shown = lanes(path, "/behavior/**")
    assert set(shown) == {
        *(f"/behavior/place_sensor_net/scout{number}/hide" for number in (33, 34, 35, 36)),
        "/behavior/place_sensor_net/scout33/watch",
    }
    assert shown["/behavior/place_sensor_net/scout33/watch"] == [
        (28, ["watch · 0 alerts"]),
        (35, ["alert · motion (1)"]),
        (38, ["watch · 1 alerts"]),
        (44, [""]),
    ]
    assert "scout33 sees motion (1)" in events(path)
    warned = [at for _, at, level in rows(path, "/events", "TextLog:level") if level == ["WARN"]]
    assert warned == [30, 35, 50]
    told_by = colours(path, "/behavior/**")
    assert all(shade == DOING[text.split(" · ")[0]] for lane in told_by.values() for text, shade in lane.items())

    # Two pictures a second of each camera that was looked through; whom it shows is told by its holder.
    names = [(at, text) for at, text, _ in captions(path, "fgrab1")]
    assert names[:3] == [(0, "scout33 · search"), (3, "scout33 · approach"), (8, "scout33 · enter")]
    assert [name for name in names if 14 <= name[0] <= 36][-2:] == [(28, "scout33 · watch"), (35, "scout33 · alert")]
    assert (30, "scout34 · operator", bright(OPERATOR)) in captions(path, "fgrab2")
    blobs = list(rows(path, "/camera/fgrab1", "EncodedImage:blob"))
    assert sum(value is not None for _, _, value in blobs) == 2 * 60 + 1  # and the dimmed one
    box = list(rows(path, "/camera/fgrab1/boxes", "Boxes2D:half_sizes"))
    assert [(at, value) for _, at, value in box] == [(35, [[13, 22]])]
    assert [at for _, at, _ in rows(path, "/camera/fgrab1/boxes", "Clear:is_recursive")] == [38]

    # The floor: colours by what each robot is, the operator's while he drives.
    shades = {at: value for _, at, value in rows(path, "/floor/robots", "Points2D:colors")}
    assert shades[min(shades)] == [IN_THE_OPEN] * 4
    assert shades[35] == [HIDDEN, OPERATOR, HIDDEN, IN_THE_OPEN]
    assert shades[max(shades)] == [HIDDEN, HIDDEN, HIDDEN, IN_THE_OPEN]
    trails = {at: value for _, at, value in rows(path, "/floor/trails", "LineStrips2D:strips")}
    assert len(trails[max(trails)]) == 4
    assert all(len(strip) <= 120 for strips in trails.values() for strip in strips)
    people = [at for _, at, _ in rows(path, "/floor/people", "Points2D:positions")]
    assert min(people) == 33
    assert max(people) < 41
    assert len(list(rows(path, "/floor/plan", "EncodedImage:blob", static=True))) == 1
    assert len(list(rows(path, "/device/robot/scout33/commands", "Scalars:scalars"))) == 61


def test_what_behaviors_do_has_colours_well_apart() -> None:
    near = {(one, two) for one, two in combinations(DOING, 2) if math.dist(lab_of(DOING[one]), lab_of(DOING[two])) < 20}
    assert not near
    floor = (HIDDEN, IN_THE_OPEN, OPERATOR, PERSON)
    assert min(math.dist(lab_of(one), lab_of(two)) for one, two in combinations(floor, 2)) > 40


def test_places_on_the_floor_are_pixels_of_its_plan(path: Path) -> None:
    far = [Placed("lost", 1e9, 0), Placed("porch", 3.0, -0.3)]
    with Timeline("lab", path=path) as timeline:
        tracker = timeline.robots
        tracker.floor.poses(0, BUILDING, poses([Placed("early", 1, 1)]))
        assert tracker.floor.wants_plan(0) == BUILDING
        tracker.floor.plan(0.1, BUILDING, BuildingPlan("room", 6.0, 4.5, png()))
        tracker.floor.poses(1, BUILDING, poses([Placed("a", 0, 4.5, math.pi / 2), Placed("b", 6, 0), *far[:1]], far))
        # Too soon after the last, and then nothing new.
        tracker.floor.poses(1.01, BUILDING, poses([Placed("a", 3, 3)]))
        tracker.floor.poses(2, BUILDING, poses([Placed("a", 0, 4.5, math.pi / 2), Placed("b", 6, 0)], far))
    spots = [(at, value) for _, at, value in rows(path, "/floor/robots", "Points2D:positions")]
    assert spots == [(1, [[0, 0], [900, 675]])]
    ((_, _, vectors),) = rows(path, "/floor/headings", "Arrows2D:vectors")
    assert vectors[0][0] == pytest.approx(0)
    assert vectors[0][1] < 0 < vectors[1][0]
    ((_, _, walkers),) = rows(path, "/floor/people", "Points2D:positions")
    assert walkers == [[450, 720]]


def test_trails_are_of_the_last_minute(path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        tracker = timeline.robots
        tracker.floor.poses(0, BUILDING, poses([]))
        tracker.floor.plan(0, BUILDING, BuildingPlan("room", 6.0, 4.5, png()))
        for half in range(1, 161):
            tracker.floor.poses(half / 2, BUILDING, poses([Placed("a", half / 40, 2)]))
        for second in range(81, 150):
            tracker.floor.poses(second, BUILDING, poses([Placed("a", 4, 2)]))
    trails = {at: value for _, at, value in rows(path, "/floor/trails", "LineStrips2D:strips")}
    first, last = trails[80][0][0], trails[80][0][-1]
    assert (last[0] - first[0]) / 150 == pytest.approx(3.0, abs=0.05)
    assert max(len(strips[0]) for strips in trails.values()) == 120
    # It stands still, and its way is forgotten.
    assert [at for _, at, _ in rows(path, "/floor/trails", "Clear:is_recursive")] == [140]


@pytest.mark.parametrize(
    ("plan", "why"),
    [
        (BuildingPlan("room", 6.0, 4.5, b"GIF89a"), "its plan is not a PNG picture"),
        (BuildingPlan("room", 6.0, 4.5, png()[:-1]), "its plan is not a PNG picture"),
        (BuildingPlan("room", 6.0, -4.5, png()), "it is 6 by -4.5 m; a building has 0.5 to 200 m"),
        (
            BuildingPlan("room", 6.0, 4.5, png()[:16] + b"\0\1\0\0" + png()[20:]),
            "its plan is 65536 by 675 pixels; 4096 a side are shown at most",
        ),
    ],
)
def test_a_plan_that_can_t_be_shown_is_told_once(path: Path, plan: BuildingPlan, why: str) -> None:
    with Timeline("lab", path=path) as timeline:
        tracker = timeline.robots
        for at in range(20):
            tracker.floor.poses(at, BUILDING, poses([Placed("a", 1, 1)]))
            if tracker.floor.wants_plan(at):
                tracker.floor.plan(at, BUILDING, plan)
        assert not timeline.robots.shown.any
    assert events(path) == [f"building room of anvil/living_room can't be shown: {why}"]
    assert list(rows(path, "/floor/**", "Points2D:positions")) == []


def test_one_building_is_shown_until_it_is_silent(path: Path) -> None:
    other = Sender("basil", "office")
    with Timeline("lab", path=path) as timeline:
        tracker = timeline.robots
        tracker.floor.poses(0, BUILDING, poses([]))
        assert tracker.floor.wants_plan(0) == BUILDING
        # No answer: it is asked again, but not at once.
        assert [at for at in range(1, 8) if tracker.floor.wants_plan(at)] == [5]
        tracker.floor.plan(6, other, BuildingPlan("forged", 6.0, 4.5, png()))
        tracker.floor.plan(6, BUILDING, BuildingPlan("room", 6.0, 4.5, png()))
        for at in range(7, 10):
            tracker.floor.poses(at, BUILDING, poses([Placed("a", 1, 1)]))
            tracker.floor.poses(at, other, poses([Placed("b", 2, 2)]))
        for at in range(10, 22):
            tracker.tick(at)
        tracker.floor.poses(22, other, poses([Placed("b", 2, 2)]))
        assert tracker.floor.wants_plan(22) == other
        tracker.floor.plan(22, other, BuildingPlan("office", 6.0, 4.5, png()))
        tracker.floor.poses(23, other, poses([Placed("b", 2, 2)]))
    assert events(path) == [
        "a second building, of basil/office, is not shown beside that at anvil/living_room",
        "building room is silent: positions are unknown",
    ]
    labels = [(at, value) for _, at, value in rows(path, "/floor/names", "Points2D:labels")]
    assert labels == [(7, ["a"]), (23, ["b"])]
    assert [at for _, at, _ in rows(path, "/floor/robots", "Clear:is_recursive")] == [20]


def test_a_building_that_begins_anew_is_asked_for_its_plan(path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        tracker = timeline.robots
        for at, time, metres in ((0, 50.0, (6.0, 4.5)), (3, 0.0, (12.0, 9.0))):
            tracker.floor.poses(at, BUILDING, poses([], time=time))
            assert tracker.floor.wants_plan(at) == BUILDING
            tracker.floor.plan(at, BUILDING, BuildingPlan("room", *metres, png()))
            tracker.floor.poses(at + 1, BUILDING, poses([Placed("a", 1, 1)], time=time + 1))
            assert tracker.floor.wants_plan(at + 1) is None
    spots = [value for _, _, value in rows(path, "/floor/robots", "Points2D:positions")]
    assert spots == [[[150, 525]], [[75, 600]]]

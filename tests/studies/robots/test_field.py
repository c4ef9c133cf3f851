"""A whole net under virtual time: what must hold at every step of every run, and what comes of one."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import msgspec
import pytest

from studies.robots.field import LATENCY, Field, FieldRun, crewed
from studies.robots.field_figures import Judge, Outcomes, Watcher
from studies.robots.watch import PIXELS
from tests.thorough import times
from zscout.behaviors.sensor_net.place_robot import Slots
from zscout.behaviors.sensor_net.scout import Step
from zscout.drivers.packets import MAX_PACKET
from zscout.simulation.building.plan import Person, Plan
from zscout.simulation.building.plan_file import load_plan, shipped_plans
from zscout.simulation.building.world import World

SHORT = Slots(hide=3.0, watch=2.0)
"""Turns so short that there are many in a few seconds."""
LONGEST_DRIVE = 2.0
"""Seconds that a drive packet of the mind lasts at most, with some to spare."""
PACKET = 0.1
"""Seconds on the line, with another one before it."""
RUNS_OUT = 0.5
"""Seconds in which motors come to stand."""


@pytest.fixture(scope="module")
def room() -> Plan:
    return load_plan(shipped_plans()["living_room"])


@pytest.mark.parametrize("seed", range(times(2)))
def test_what_is_held_is_held_by_one_and_nobody_drives_on(room: Plan, seed: int) -> None:
    """Where packets are lost, a halt may come late: only then two robots transmit on one channel."""
    loss = 0.2 * (seed % 2)
    field = Field(robots=3, channels=2, frame_rate=3, loss=loss, slots=SHORT)
    run = FieldRun(crewed(room, 3), field, seed=seed)
    ended: dict[str, float] = {}
    lasts: list[float] = []
    turns = 0

    def watch(run: FieldRun) -> None:
        nonlocal turns
        now = run.world.time
        held = [rc for one in run.players.values() if one.held for rc in one.held.rcs if "radio" not in rc]
        assert not [rc for rc, holders in Counter(held).items() if holders > 1]
        sending = [body.camera for body in run.world.bodies.values() if body.camera is not None]
        assert loss or len(set(sending)) == len(sending)
        for name, player in run.players.items():
            body = run.world.bodies[name]
            if player.held is not None:
                ended.pop(name, None)
                turns = max(turns, player.turns)
                continue
            since = ended.setdefault(name, now)
            lasts.append(now - since if body.left or body.right else 0.0)

    outcomes = run.run(12.0, watch=watch)
    assert turns > 1
    # A halt may be lost as well: then the last drive packet runs out.
    assert max(lasts) <= (LONGEST_DRIVE if loss else 0) + LATENCY + PACKET
    assert outcomes.longest_stop <= (LONGEST_DRIVE if loss else 0) + LATENCY + PACKET + RUNS_OUT
    assert outcomes.noticed <= outcomes.walks
    assert outcomes.alerted <= outcomes.crossings
    assert outcomes.seconds == pytest.approx(12)


def test_a_run_is_repeated_by_its_seed(room: Plan) -> None:
    field = Field(robots=2, channels=1, frame_rate=3, slots=SHORT)

    def once(seed: int) -> tuple[Outcomes, list[tuple[float, float, float]]]:
        run = FieldRun(crewed(room, 2), field, seed=seed)
        return run.run(6.0), [body.pose for body in run.world.bodies.values()]

    assert once(1) == once(1)
    assert once(1)[1] != once(2)[1]


def test_a_radio_that_is_too_slow_lets_nobody_begin(room: Plan) -> None:
    run = FieldRun(crewed(room, 2), Field(robots=2, channels=2, baud=300), seed=0)
    assert run.run(3.0).holds == 0
    slower = Field(robots=2, channels=2, baud=300, command_rate=2.5, frame_rate=2)
    run = FieldRun(crewed(room, 2), slower, seed=0)
    held: list[int] = []
    run.run(3.0, watch=lambda run: held.append(sum(one.held is not None for one in run.players.values())))
    assert max(held) == 1


def test_the_line_carries_one_packet_at_a_time(room: Plan) -> None:
    run = FieldRun(crewed(room, 1), Field(robots=1, channels=1, baud=1_200, loss=0, frame_rate=1), seed=0)
    packet = MAX_PACKET * 10 / 1_200
    heard: list[float] = []
    for _ in range(3):
        run.send(MAX_PACKET, lambda: heard.append(run.world.time))
    run.run(1.0)
    assert heard == pytest.approx([LATENCY + packet * number for number in (1, 2, 3)], abs=1e-5)


def test_what_must_arrive_does_and_what_is_lost_does_not(room: Plan) -> None:
    run = FieldRun(crewed(room, 1), Field(robots=1, channels=1, loss=0.5, frame_rate=1), seed=0)
    heard: list[str] = []
    for _ in range(60):
        run.send(5, lambda: heard.append("sure"), sure=True)
        run.send(5, lambda: heard.append("drive"))
    run.run(4.0)
    assert heard.count("sure") == 60
    assert 10 < heard.count("drive") < 50


@pytest.mark.parametrize("wrong", [{"robots": 0}, {"channels": 17}, {"baud": 0}, {"loss": 1.0}, {"frame_rate": 0.0}])
def test_a_field_that_cannot_be_is_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"^give|^rates must be"):
        replace(Field(), **wrong)  # type: ignore[arg-type]


def test_a_crew_is_the_plan_s_own_or_drawn(room: Plan) -> None:
    assert [robot.name for robot in crewed(room, 2).robots] == [robot.name for robot in room.robots[:2]]
    six = crewed(room, 6, seed=3)
    assert len({robot.id for robot in six.robots}) == 6
    assert six == crewed(room, 6, seed=3)
    with pytest.raises(ValueError, match="6 robots, not 2"):
        FieldRun(six, Field(robots=2))


Look = tuple[float, int, str]
"""Seconds, pixels of people in view, `watch`, `alert` or `begins` for an alert's first look."""


def looks(text: str, *, begin: float = 10.0) -> list[Look]:
    """One look in every 0.25 s: `.` nobody in view, `p` somebody, upper case or `!` with an alert."""
    words = {".": (0, "watch"), "p": (PIXELS, "watch"), "P": (PIXELS, "alert"), "!": (0, "alert")}
    return [(begin + number / 4, *words[letter]) for number, letter in enumerate(text)]


@pytest.mark.parametrize(
    ("text", "crossings", "alerted", "false_alarms"),
    [
        # Nothing is learned yet in the first two seconds.
        ("pppp............", 0, 0, 0),
        (f"{'.' * 8}pPPPP", 1, 1, 0),
        (f"{'.' * 8}ppppPP", 1, 1, 0),
        (f"{'.' * 8}pppppP", 1, 0, 0),
        (f"{'.' * 8}pp........", 1, 0, 0),
        # The hold ends before it is late.
        (f"{'.' * 8}ppp", 0, 0, 0),
        # What is out of view for less than two seconds is one crossing; the alert lasts a while.
        (f"{'.' * 8}pPP!!..pPP", 1, 1, 0),
        (f"{'.' * 8}pPP!{'.' * 12}pppppp", 2, 1, 0),
        (f"{'.' * 8}!!!!", 0, 0, 1),
        (f"{'.' * 8}pp....!!", 1, 0, 0),
    ],
)
def test_crossings_and_alarms_are_counted_right(text: str, crossings: int, alerted: int, false_alarms: int) -> None:
    out, watcher, doing = Outcomes(), Watcher(), ""
    for now, people, word in looks(text):
        step = Step(0, 0, 0, word, "", alert=word == "alert" and doing != "alert")
        watcher.look(now, people, False, step, lambda: False, out)
        doing = word
    assert (out.crossings, out.alerted, out.false_alarms) == (crossings, alerted, false_alarms)
    assert out.robot_alarms == 0


def test_a_robot_that_drives_is_no_false_alarm() -> None:
    out, watcher = Outcomes(), Watcher()
    watcher.look(10.0, 0, False, Step(0, 0, 0, "alert", "", alert=True), lambda: True, out)
    assert (out.robot_alarms, out.false_alarms) == (1, 0)


def test_the_shadow_of_somebody_out_of_view_is_no_false_alarm() -> None:
    out, watcher, alert = Outcomes(), Watcher(), Step(0, 0, 0, "alert", "", alert=True)
    watcher.look(10.0, 0, True, Step(0, 0, 0, "watch", ""), lambda: False, out)
    watcher.look(11.0, 0, False, alert, lambda: False, out)
    assert (out.shadow_alarms, out.false_alarms) == (1, 0)
    watcher.look(20.0, 0, False, alert, lambda: False, out)
    assert (out.shadow_alarms, out.false_alarms) == (1, 1)


def test_a_walk_counts_when_it_is_over_and_began_when_all_were_placed(room: Plan) -> None:
    """Three walks of ten seconds: before all are placed, then noticed, then not."""
    walk = Person("someone", ((0.3, 0.3), (3.3, 0.3)), speed=0.3, first=1, every=5, jitter=0, walks=3)
    world = World(msgspec.structs.replace(crewed(room, 1), people=(walk,)), seed=0)
    (name,) = world.bodies
    judge = Judge(world, Outcomes(placed={name: None}))
    while world.time < 45:
        world.step(0.1)
        if world.time > 5:
            judge.placed(name)
        judge.stepped(0.1, alarm=20 < world.time < 21)
    assert judge.outcomes.all_placed == pytest.approx(5.1)
    assert (judge.outcomes.walks, judge.outcomes.noticed) == (2, 1)


@pytest.mark.parametrize(("moved", "resumed"), [(False, [0.5]), (True, [])])
def test_a_turn_is_taken_up_again_from_when_the_camera_is_warm(room: Plan, moved: bool, resumed: list[float]) -> None:
    world = World(crewed(room, 1), seed=0)
    (name,) = world.bodies
    body = world.bodies[name]
    judge = Judge(world, Outcomes(placed={name: None}))
    judge.held(name)
    judge.placed(name)
    judge.looked(name, Step(0, 0, 0, "watch", ""), 0.25)
    assert judge.outcomes.resumed == [], "its first turn is none that is taken up again"
    judge.ended(name, preempted=False)
    world.step(0.1)
    judge.held(name)
    body.transmit(1, world.time)
    body.x += moved
    for number in range(26):
        judge.looked(name, Step(0, 0, 0, "watch", "", learning=number < 25), 0.1)
        world.step(0.1)
    assert judge.outcomes.resumed == pytest.approx(resumed)


def test_the_time_to_stand_is_that_after_the_hold(room: Plan) -> None:
    world = World(crewed(room, 1), seed=0)
    (name,) = world.bodies
    body = world.bodies[name]
    judge = Judge(world, Outcomes(placed={name: None}))
    judge.held(name)
    body.command(0.5, -0.5, 1.0, world.time)
    for number in range(40):
        if number == 5:
            judge.ended(name, preempted=True)
        world.step(0.1)
        judge.stepped(0.1, alarm=False)
    # Half a second of its command was left, and the motors run out.
    assert 0.5 <= judge.outcomes.longest_stop <= 1.0
    assert judge.outcomes.turned_unheld == pytest.approx(judge.outcomes.longest_stop, abs=0.11)
    assert judge.outcomes.preemptions == 1

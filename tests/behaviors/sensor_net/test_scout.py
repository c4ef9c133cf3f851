"""What one robot keeps of its turns to watch."""

from __future__ import annotations

import numpy as np
import pytest

from zscout.behaviors.perception.lens import COLUMNS, ROWS
from zscout.behaviors.sensor_net.place_robot import Slots
from zscout.behaviors.sensor_net.scout import LATELY, Scout


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


def test_what_moves_after_a_while_of_bad_pictures_is_another_event() -> None:
    scout = Scout()
    scout.held(0.0)
    scout.hider._robot.phase = "hidden"
    scout.released(0.5)
    scout.held(1.0)
    scout.hider._robot.phase = "hidden"
    assert scout.alerts.see(1.0, True) == "start"
    snow = np.random.default_rng(0).integers(0, 255, (ROWS, COLUMNS), np.uint8)
    steps = [scout.see(1 + number / 4, snow, "video/a") for number in range(1, 20)]
    assert {step.doing for step in steps} == {"blind"}
    assert [step.quiet for step in steps].count(True) == 1
    assert scout.alerts.see(6.0, True) == "start"

"""What one robot keeps of its turns to watch."""

from __future__ import annotations

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

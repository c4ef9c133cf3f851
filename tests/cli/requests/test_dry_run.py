"""`zscout request --dry-run`, and the estimates of `status` and `why`: asked, told, and nothing changed."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator

import pytest

from tests.cli.cli_fleet import CliFleet, fleet_of
from tests.cli.tools import end, held_by, own

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory, fleet_kind: str) -> Iterator[CliFleet]:
    with fleet_of(tmp_path_factory.mktemp("dry"), "robot/a", "robot/b") as fleet:
        yield fleet


def test_it_says_when_it_would_start_and_whom_it_would_preempt(fleet: CliFleet) -> None:
    mine = fleet.holder("mine", "robot/a")
    try:
        take = fleet.zscout("request", "robot/a", "--priority", "5", "--dry-run")
        assert take.stdout == f"request would start at once\nit would preempt {own('mine')}\n"
        wait = fleet.zscout("request", "robot/a", "robot/b", "--dry-run", "--json", "--name", "wide")
        told = json.loads(wait.stdout)
        assert (wait.returncode, told["arc"], told["preempts"]) == (0, "wide", [])
        assert told["starts_in"] > 0
        assert told["reason"] == f"waits for {held_by('mine')}: robot/a"
        state = fleet.state(lambda state: True)
        assert [hold.arc for hold in state.holds] == ["mine"]
        assert not state.queue
    finally:
        end(mine)


def test_what_would_never_start_is_said_with_code_1(fleet: CliFleet) -> None:
    done = fleet.zscout("request", "robot/zz", "--dry-run", "--wait-for-device")
    assert done.returncode == 1
    assert done.stdout == ("request would wait, and no start can be estimated: robot/zz not on the mesh\n")


def test_status_and_why_tell_when_a_waiting_one_may_start(fleet: CliFleet) -> None:
    mine = fleet.holder("mine", "robot/a")
    waiting = fleet.start("request", "robot/a", "--name", "next", "--min-runtime", "1")
    try:
        fleet.state(lambda state: [wait.arc for wait in state.queue] == ["next"])
        status = json.loads(fleet.zscout("status", "--json").stdout)
        [queued] = status["queue"]
        assert queued["starts_in"] > 0
        assert " (in " in fleet.zscout("status").stdout
        assert "it may start at " in fleet.zscout("why", "next").stdout
    finally:
        end(waiting)
        end(mine)


def test_the_next_booking_of_each_device_is_said_beforehand_and_at_the_grant(fleet: CliFleet) -> None:
    done = fleet.zscout("book", "robot/b", "--at", "in 2h", "--for", "1h", "--name", "calib")
    assert done.returncode == 0, done
    try:
        words = r"robot/b is booked by .* \(calib\) from .* to .*"
        dry = fleet.zscout("request", "robot/a", "robot/b", "--dry-run", "--min-runtime", "5m")
        assert re.search(rf"^{words}$", dry.stdout, re.MULTILINE), dry
        shown = json.loads(fleet.zscout("request", "robot/*", "robot/*", "--dry-run", "--json").stdout)
        [date] = shown["dates"]
        assert (date["rc"], date["booking"], date["maintenance"]) == ("robot/b", "calib", False)
        assert 7000 < date["begins_in"] <= 7260
        held = fleet.zscout("request", "robot/b", "--min-runtime", "5m", "--name", "test", "--", "sleep", "1")
        assert held.returncode == 0, held
        assert re.search(rf"^test: {words}$", held.stderr, re.MULTILINE), held
        # It ends for that booking, not before its date.
        words = r"^test: calib \(.*\) has booked robot/b from .*: the hold may end from .* on$"
        assert re.search(words, held.stderr, re.MULTILINE), held
    finally:
        fleet.zscout("booking", "cancel", "calib")

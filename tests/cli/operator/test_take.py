"""`zscout take`: says from whom it takes, asks, and takes."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cli.cli_fleet import CliFleet, fleet_of
from tests.cli.tools import COMMAND, Terminal, by, course, end, events, held_by, out_of, own, read_until
from tests.hang import HANG

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory, fleet_kind: str) -> Iterator[CliFleet]:
    with fleet_of(tmp_path_factory.mktemp("take"), "robot/a", "robot/b", "radio/rf0:rate=10") as fleet:
        yield fleet


def test_a_yes_at_the_terminal_takes_and_ctrl_c_gives_back(fleet: CliFleet) -> None:
    survey = fleet.holder("survey", "robot/a", "robot/b", "--priority", "3")
    with fleet.terminal("take", "robot/a", "--reason", "the gripper\x1b is stuck") as terminal:
        shown = terminal.until("Take robot/a? [y/N] ")
        assert f"operator takes over from {own('survey')}, priority 3, since " in shown
        assert ": robot/a, robot/b" in shown
        terminal.press("y\n")
        terminal.until("operator holds robot/a: yours for ")
        state = fleet.state(lambda state: bool(state.holds))
        assert [(hold.arc, hold.priority, hold.keep) for hold in state.holds] == [("operator", 10, True)]
        assert f"{by('zscout take')}: the gripper is stuck" in fleet.zscout("status").stdout
        terminal.press("\x03")
        assert terminal.code() == 130
    assert survey.wait(HANG) == 1
    told = f"survey lost its grant: preempted by {held_by('operator')}, priority 10: the gripper is stuck"
    assert told in out_of(survey).read()
    assert fleet.idle("robot/a")


@pytest.mark.parametrize("answer", ["n\n", "\x04"])
def test_anything_but_a_yes_takes_nothing(fleet: CliFleet, answer: str) -> None:
    survey = fleet.holder("survey", "robot/a")
    with fleet.terminal("take", "robot/a") as terminal:
        terminal.until("[y/N] ")
        terminal.press(answer)
        terminal.until("zscout: nothing was taken")
        assert terminal.code() == 1
    assert survey.poll() is None
    end(survey)


@pytest.mark.slow
def test_without_a_terminal_it_needs_yes(fleet: CliFleet) -> None:
    survey = fleet.holder("survey", "robot/a")
    refused = fleet.zscout("take", "robot/a", stdin="y\n")
    assert refused.returncode == 1
    assert "add --yes" in refused.stderr
    assert survey.poll() is None
    taken = fleet.zscout("take", "robot/a", "--yes", "--no-keep", "--min-runtime", "8", "--json")
    assert taken.returncode == 0
    preview, granted, ended = course(taken.stdout)
    assert [(hold["arc"], hold["priority"]) for hold in preview["preempts"]] == [("survey", 0)]
    assert (granted["event"], granted["keep"], ended["outcome"]) == ("granted", False, "completed")
    assert survey.wait(HANG) == 1


def test_who_is_asked_sees_whom_it_takes_from_when_the_json_goes_elsewhere(fleet: CliFleet, tmp_path: Path) -> None:
    survey = fleet.holder("survey", "robot/a")
    out = tmp_path / "events.json"
    # A shell at the terminal, as people have it: the JSON goes into a file.
    script = f'exec {shlex.join(COMMAND)} take robot/a --json > "{out}"'
    with Terminal(command=("sh", "-c", script), env=fleet.lab.env) as terminal:
        shown = terminal.until("Take robot/a? [y/N] ")
        assert f"operator takes over from {own('survey')}, priority 0, since " in shown
        assert "{" not in shown
        assert [event["event"] for event in events(out.read_text())] == ["preview"]
        terminal.press("y\n")
        # The RCM has granted it before the program has entered.
        fleet.state(lambda _: "granted" in out.read_text())
        terminal.press("\x03")
        assert terminal.code() == 130
    assert [event["event"] for event in course(out.read_text())] == ["preview", "granted", "ended"]
    assert survey.wait(HANG) == 1


@pytest.mark.slow
def test_timeout_0_tries_once(fleet: CliFleet) -> None:
    """It takes what others yield, and waits for no equal."""
    low = fleet.holder("low", "robot/a")
    taken = fleet.zscout("take", "robot/a", "--yes", "--timeout", "0", "--", "sh", "-c", "exit 6")
    assert taken.returncode == 6, taken.stderr
    assert low.wait(HANG) == 1
    peer = fleet.holder("peer", "robot/b", "--priority", "10")
    once = fleet.zscout("take", "robot/b", "--yes", "--timeout", "0")
    assert once.returncode == 1
    assert f"operator was not granted at once, and is cancelled: waits for {own('peer')}: robot/b" in once.stderr
    end(peer)


def test_what_is_free_is_taken_without_a_question(fleet: CliFleet) -> None:
    done = fleet.zscout("take", "robot/a", "--", "sh", "-c", "exit 6")
    assert done.returncode == 6, done.stderr


def test_who_shares_may_stay_and_equals_are_waited_for(fleet: CliFleet) -> None:
    sharer = fleet.holder("sharer", "radio/rf0:rate=4")
    peer = fleet.holder("peer", "robot/b", "--priority", "10")
    wanted = ("radio/rf0:rate=4", "robot/b", "robot/x", "--wait-for-device")
    done = fleet.zscout("take", *wanted, "--yes", "--timeout", "0.2", "--json")
    assert events(done.stdout), done.stderr
    preview = events(done.stdout)[0]
    assert preview["preempts"] == []
    assert [hold["arc"] for hold in preview["may_preempt"]] == ["sharer"]
    assert [hold["arc"] for hold in preview["waits_for"]] == ["peer"]
    assert preview["absent"] == ["robot/x"]
    assert done.returncode == 1
    assert sharer.poll() is None
    end(sharer)
    end(peer)


@pytest.mark.slow
def test_a_take_that_must_wait_says_so_and_then_holds(fleet: CliFleet) -> None:
    peer = fleet.holder("peer", "robot/b", "--priority", "10")
    taker, lines = fleet.begun(
        f"operator waits for {own('peer')}: robot/b, until ", "take", "robot/b", "--name", "operator", "--", "true"
    )
    assert any(f"operator waits for {own('peer')}, priority 10, " in line for line in lines)
    end(peer)
    read_until(taker, "operator holds robot/b")
    assert taker.wait(HANG) == 0

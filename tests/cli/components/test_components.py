"""`zscout start`, `stop` and `components` on a real mesh: one node, real components."""

from __future__ import annotations

import json
import re
import signal
from collections.abc import Iterator, Sequence
from typing import Any

import pytest

from tests.behaviors.components.kit import ROOT, register_odd_kinds
from tests.cli.cli_fleet import CliFleet
from tests.cli.tools import read_until
from tests.hang import HANG
from zscout.behaviors.client.blocking import connect

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory, fleet_kind: str) -> Iterator[CliFleet]:
    """One node, which also knows kinds that behave badly."""
    fleet = CliFleet(tmp_path_factory.mktemp("components"))
    try:
        register_odd_kinds(fleet.folder / "site")
        fleet.lab.env["PYTHONPATH"] = f"{fleet.folder / 'site'}:{ROOT}"
        fleet.lab.node("anvil", "robot/a")
        fleet.state(lambda state: any(view.present for view in state.rcs))
        fleet.balanced("anvil")
        yield fleet
    finally:
        fleet.close()


def listed(fleet: CliFleet, *args: str) -> list[dict[str, Any]]:
    shown = fleet.zscout("components", "--json", *args)
    assert shown.returncode == 0, shown.stderr
    found: list[dict[str, Any]] = json.loads(shown.stdout)["components"]
    return found


@pytest.mark.slow
def test_start_list_and_stop(fleet: CliFleet) -> None:
    started = fleet.zscout("start", "counter", "--set", "period=0.1", "--set", "rc=robot/a")
    assert (started.returncode, started.stderr) == (0, "")
    assert started.stdout.splitlines()[-1] == "counter runs on anvil"
    fleet.state(lambda state: [hold.arc for hold in state.holds] == ["counter"])

    # What it needs is measured a little later.
    def measured(text: str) -> bool:
        (one,) = json.loads(text)["components"]
        return one["memory"] is not None and one["uptime"] is not None

    (one,) = json.loads(fleet.shown("components", "--json", until=measured))["components"]
    assert (one["component"], one["state"], one["host"], one["movable"]) == ("counter", "running", "anvil", True)
    assert one["spec"]["kind"] == "counter"
    assert one["spec"]["params"] == {"period": 0.1, "rc": "robot/a"}
    assert 0 < one["uptime"] < HANG
    assert one["memory"] > 1_000_000

    row = r"^counter  counter  running  anvil +[0-9:]+ \([0-9.]+ s\) +0 +0 +[0-9.]+ +\d+ MiB"
    plain = fleet.shown("components", until=lambda text: re.search(row, text, re.MULTILINE))
    assert re.search(r"^Fleet test-\w+: 1 of 1 run on 1 host$", plain, re.MULTILINE)

    again = fleet.zscout("start", "counter", "--set", "period=0.1", "--set", "rc=robot/a")
    assert (again.returncode, again.stdout) == (0, "counter already runs on anvil\n")
    assert listed(fleet)[0]["incarnation"] == one["incarnation"]

    other = fleet.zscout("start", "counter", "--set", "period=0.2")
    assert (other.returncode, other.stdout) == (1, "")
    assert other.stderr.startswith(
        "zscout: counter already exists with another kind or other settings; give another --name, "
    )
    assert other.stderr.endswith("zscout component stop counter\n")

    stopped = fleet.zscout("stop", "counter")
    assert (stopped.returncode, stopped.stderr) == (0, "")
    assert stopped.stdout.splitlines()[-1].startswith("counter has ended")
    assert fleet.idle("robot/a")
    assert fleet.zscout("stop", "counter").returncode == 0
    assert [one["state"] for one in listed(fleet)] == ["ended"]


def test_several_are_stopped_at_once_and_what_is_unknown_is_named(fleet: CliFleet) -> None:
    for name in ("blue", "green"):
        assert fleet.zscout("start", "counter", "--name", name).returncode == 0
    stopped = fleet.zscout("stop", "blue", "green", "red", "--json")
    assert stopped.returncode == 1
    states = {one["component"]: one["state"] for one in json.loads(stopped.stdout)["components"]}
    assert states == {"blue": "ended", "green": "ended"}
    assert stopped.stderr.startswith('zscout: unknown component "red"; known: ')
    assert stopped.stderr.count("\n") == 1
    gone = fleet.zscout("components", "gren")
    assert (gone.returncode, gone.stdout) == (1, "")
    assert "did you mean green?" in gone.stderr


def test_json_and_no_wait(fleet: CliFleet) -> None:
    begun = fleet.zscout("start", "counter", "--name", "hasty", "--no-wait", "--json")
    assert begun.returncode == 0, begun.stderr
    assert json.loads(begun.stdout)["component"] == "hasty"
    waited = fleet.zscout("start", "counter", "--name", "hasty", "--json")
    told = json.loads(waited.stdout)
    assert (told["state"], told["host"], told["wanted"]) == ("running", "anvil", True)
    assert fleet.zscout("stop", "hasty").returncode == 0


def test_what_fails_is_given_up_with_its_reason(fleet: CliFleet) -> None:
    # At once, though it is to be started again whenever it fails.
    failed = fleet.zscout("start", "counter", "--name", "bad", "--set", "period=fast", "--restart", "always")
    assert failed.returncode == 1
    assert "bad is given up: " in failed.stderr
    assert 'period: is the text "fast"' in failed.stderr
    (bad,) = listed(fleet, "bad")
    assert (bad["state"], bad["restarts"]) == ("given_up", 1)
    assert 'period: is the text "fast"' in fleet.zscout("components").stdout
    unknown = fleet.zscout("start", "cuonter")
    assert unknown.returncode == 1
    assert 'unknown kind "cuonter"; did you mean counter?' in unknown.stderr
    assert unknown.stderr.count("\n") == 1


def test_the_end_of_its_output_goes_along(fleet: CliFleet) -> None:
    failed = fleet.zscout("start", "missing", "--restart", "never", "--json")
    assert failed.returncode == 1
    assert json.loads(failed.stdout)["state"] == "given_up"
    *tail, line = failed.stderr.splitlines()
    assert "ModuleNotFoundError: No module named 'tests.behaviors.components.nowhere'" in tail
    assert line.startswith("zscout: missing is given up: ")
    shown = fleet.zscout("components", "missing").stdout
    assert "\nThe end of its output:\n" in shown
    assert shown.endswith("\nModuleNotFoundError: No module named 'tests.behaviors.components.nowhere'\n")


@pytest.mark.slow
def test_what_is_done_soon_is_no_failure(fleet: CliFleet) -> None:
    done = fleet.zscout("start", "brief", "--set", "how=return", "--json")
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["state"] in ("running", "ended")
    followed = fleet.until(lambda done: done.returncode == 0, "logs", "brief", "--follow")
    # Beside its own words there may be that its process stood still.
    assert [line for line in followed.stdout.splitlines() if "process stalled" not in line] == ["last words"]
    assert followed.stderr.startswith("-- brief has ended")


@pytest.mark.slow
def test_waiting_for_a_host_says_why_and_stays_placed(fleet: CliFleet) -> None:
    late = fleet.zscout("start", "counter", "--name", "picky", "--label", "gpu", "--timeout", "6")
    assert late.returncode == 1
    assert late.stdout.startswith("picky waits for a host: ")
    assert "gpu" in late.stdout
    assert late.stderr.startswith("zscout: picky does not run after 6.0 s: waits for a host: ")
    assert late.stderr.endswith("; picky stays placed; to end it: zscout component stop picky\n")
    assert listed(fleet, "picky")[0]["state"] == "waiting"

    waiting = fleet.start("start", "counter", "--name", "picky", "--label", "gpu")
    read_until(waiting, "picky waits for a host")
    waiting.send_signal(signal.SIGINT)
    read_until(waiting, "picky stays placed; to end it: zscout component stop picky")
    assert waiting.wait(HANG) == 130
    assert listed(fleet, "picky")[0]["state"] == "waiting"
    assert fleet.zscout("stop", "picky").returncode == 0


@pytest.mark.slow
def test_at_a_terminal_one_line_goes_along(fleet: CliFleet) -> None:
    with fleet.terminal("component", "start", "counter", "--name", "shown", "--label", "gpu") as terminal:
        terminal.until("shown waits for a host: ")
        terminal.press("\x03")
        terminal.until("shown stays placed")
        assert terminal.code() == 130
    assert fleet.zscout("stop", "shown").returncode == 0
    with fleet.terminal("component", "list", "--watch") as terminal:
        terminal.until("q or Ctrl-C ends")
        assert fleet.zscout("start", "counter", "--name", "fresh").returncode == 0
        terminal.until("fresh")
        terminal.press("q")
        assert terminal.code() == 0
    assert fleet.zscout("stop", "fresh").returncode == 0


@pytest.mark.slow
def test_kinds(fleet: CliFleet) -> None:
    shown = fleet.zscout("components", "--kinds")
    assert (shown.returncode, shown.stderr) == (0, "")
    assert re.search(r"^counter +anvil$", shown.stdout, re.MULTILINE)
    (host,) = json.loads(fleet.zscout("components", "--kinds", "--json").stdout)["hosts"]
    assert host["host"] == "anvil"
    assert {"counter", "spin"} <= set(host["kinds"])


@pytest.mark.slow
def test_status_names_components_and_cordoned_hosts(fleet: CliFleet) -> None:
    assert fleet.zscout("start", "still", "--name", "seen").returncode == 0
    moved = fleet.zscout("migrate", "seen")
    assert moved.stderr == "zscout: seen was not moved: seen can't be moved: its kind has no checkpoint()\n"
    # What can't be moved is not waited for.
    drained = fleet.zscout("drain", "anvil")
    assert drained.returncode == 1
    assert "zscout: anvil is not empty: seen stays (it can't be moved; anvil is drained); " in drained.stderr
    assert fleet.zscout("drain", "anvli").returncode == 1
    # Its process shows itself to a newcomer as soon as both are linked.
    row = r"^anvil +leads, cordoned .* node, 1 device, seen$"
    fleet.shown("status", until=lambda text: re.search(row, text, re.MULTILINE))

    def anvil(text: str) -> tuple[list[str], bool]:
        (one,) = (host for host in json.loads(text)["hosts"] if host["host"] == "anvil")
        return one["components"], one["cordoned"]

    fleet.shown("status", "--json", until=lambda text: anvil(text) == (["seen"], True))
    assert fleet.zscout("uncordon", "anvil").stdout == "anvil is used again\n"
    assert "cordoned" not in fleet.zscout("status").stdout
    assert fleet.zscout("stop", "seen").returncode == 0


@pytest.mark.slow
def test_tab_offers_components_hosts_and_kinds(fleet: CliFleet) -> None:
    assert fleet.zscout("start", "counter", "--name", "offered").returncode == 0

    def offers(*words: str, it: Sequence[str]) -> None:
        """Tab again, until that is offered: at each it looks for two seconds at most."""
        line = {"COMP_WORDS": " ".join(words), "COMP_CWORD": str(len(words) - 1)}
        wanted = [f"plain,{one}" for one in it]
        fleet.until(lambda done: done.stdout.split() == wanted, env=line | {"_ZSCOUT_COMPLETE": "bash_complete"})

    offers("zscout", "stop", "off", it=["offered"])
    offers("zscout", "stop", "offered", "off", it=[])
    offers("zscout", "logs", "off", it=["offered"])
    offers("zscout", "drain", "an", it=["anvil"])
    offers("zscout", "start", "coun", it=["counter"])
    offers("zscout", "request", "ro", it=["robot/a"])
    offers("zscout", "status", "an", it=["anvil"])
    offers("zscout", "status", "anvil", "an", it=[])
    with connect("desk", fleet=fleet.lab.fleet, host="test") as lab, lab.hold("surveying", {"robot/a": {}}):
        offers("zscout", "why", "surv", it=["surveying"])
        offers("zscout", "status", "surv", it=["surveying"])
    assert fleet.zscout("stop", "offered").returncode == 0

"""`zscout drain`, `uncordon` and `maintain` of hosts, with real nodes: what is granted meanwhile, and who is told."""

from __future__ import annotations

import json
import re
import signal
from collections.abc import Iterator
from typing import Any

import pytest

from tests.cli.cli_fleet import CliFleet, in_lab
from tests.cli.tools import by, end, held_by, out_of, read_until
from tests.hang import HANG
from tests.live.lab import Lab

pytestmark = pytest.mark.live
STAYS = "anvil stays cordoned; to use it again: zscout uncordon anvil\n"
TAKEN_AWAY = 75
ME = by("").partition(" ")[0]


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory, fleet_kind: str) -> Iterator[CliFleet]:
    fleet = CliFleet(tmp_path_factory.mktemp("drained"), candidates=("anvil", "bellows"))
    try:
        fleet.lab.node("anvil", "robot/a", "robot/c")
        fleet.lab.node("bellows", "robot/b")
        there(fleet)
        yield fleet
    finally:
        fleet.close()


@pytest.fixture(autouse=True)
def nothing_is_left(fleet: CliFleet) -> Iterator[None]:
    yield
    for booking in told(fleet, "booking", "list")["bookings"]:
        fleet.zscout("booking", "cancel", booking["id"], "--yes")


def there(fleet: CliFleet) -> None:
    fleet.state(lambda state: {view.rc for view in state.rcs if view.present} == {"robot/a", "robot/b", "robot/c"})


def told(fleet: CliFleet, *args: str) -> dict[str, Any]:
    done = fleet.zscout(*args, "--json")
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def cordoned(fleet: CliFleet) -> list[str]:
    return [host["host"] for host in told(fleet, "status")["hosts"] if host["cordoned"]]


@pytest.mark.essential
def test_drain_names_the_holder_and_waits_for_its_end(fleet: CliFleet) -> None:
    holder = fleet.holder("furnace", "robot/a", "--min-runtime", "10m", "--", "sleep", "1000")
    drained = fleet.zscout("drain", "anvil", "--comment", "new disk")
    assert (drained.returncode, drained.stdout) == (1, "")
    words = rf"zscout: anvil is not empty: {re.escape(held_by('furnace'))} holds robot/a until \d\d:\d\d at the latest"
    remedy = "wait for holds with --wait, or end them with --now"
    assert re.fullmatch(f"{words}; {remedy}; {STAYS}", drained.stderr), drained.stderr
    # Nobody is granted its devices any more; others' are.
    first = fleet.waits("late", "robot/c", until=lambda line: "waits" in line)
    assert first.startswith(f"late waits: maintenance of robot/c by drain-anvil ({ME}): new disk"), first
    assert fleet.zscout("request", "robot/b", "--", "true").returncode == 0
    shown = fleet.zscout("status").stdout
    assert re.search(
        rf"^robot/c +exclusive +maintenance +anvil +drain-anvil \({ME}\) until cancelled$", shown, re.MULTILINE
    )
    assert cordoned(fleet) == ["anvil"]
    late = fleet.zscout("drain", "anvil", "--timeout", "1")
    assert late.returncode == 1
    assert late.stderr.startswith("zscout: anvil is not empty after 1.0 s: furnace"), late.stderr
    waiting = fleet.start("drain", "anvil", "--wait")
    read_until(waiting, f"anvil: {held_by('furnace')} holds robot/a until ")
    end(holder)
    assert waiting.wait(HANG) == 0
    assert out_of(waiting).read() == f"anvil is empty; {STAYS}"
    assert fleet.zscout("drain", "anvil").stdout == f"anvil is empty; {STAYS}"
    assert [one["name"] for one in told(fleet, "booking", "list")["bookings"]] == ["drain-anvil"]
    assert fleet.zscout("uncordon", "anvil").stdout == "anvil is used again\n"
    assert cordoned(fleet) == []
    assert fleet.zscout("request", "robot/c", "--", "true").returncode == 0


@pytest.mark.slow
def test_drain_now_ends_holds_within_their_minimum_runtimes(fleet: CliFleet) -> None:
    holder = fleet.holder("furnace", "robot/a", "--min-runtime", "10m", "--", "sleep", "1000")
    assert fleet.zscout("drain", "anvil").returncode == 1
    drained = fleet.zscout("drain", "anvil", "--now", "--comment", "smoke")
    assert (drained.returncode, drained.stdout) == (0, f"anvil is empty; {STAYS}")
    # It replaces the drain that waited.
    assert [one["urgent"] for one in told(fleet, "booking", "list")["bookings"]] == [True]
    read_until(holder, f"maintenance of robot/a by drain-anvil-2 ({ME}): smoke")
    assert holder.wait(HANG) == TAKEN_AWAY
    assert fleet.zscout("uncordon", "anvil").returncode == 0
    assert told(fleet, "booking", "list")["bookings"] == []


@pytest.mark.slow
def test_a_drain_outlives_the_leader_and_a_restart_of_its_node(fleet: CliFleet) -> None:
    assert fleet.zscout("drain", "anvil").returncode == 0
    leader = told(fleet, "status")["rcm"]["host"]
    for host in (leader, {"anvil": "bellows", "bellows": "anvil"}[leader], "anvil"):
        fleet.lab.nodes[host].send_signal(signal.SIGKILL)
        fleet.lab.nodes[host].wait(HANG)
        fleet.lab.node(host, *{"anvil": ("robot/a", "robot/c"), "bellows": ("robot/b",)}[host])
        there(fleet)
        fleet.waits("late", "robot/c", until=lambda line: "maintenance of robot/c by drain-anvil" in line)
        assert cordoned(fleet) == ["anvil"]
    fleet.zscout("uncordon", "anvil")
    assert fleet.zscout("request", "robot/c", "--", "true").returncode == 0


def test_an_unknown_host_is_a_typo(fleet: CliFleet) -> None:
    for command in ("drain", "uncordon"):
        done = fleet.zscout(command, "anvli")
        assert (done.returncode, done.stderr) == (
            1 if command == "drain" else 0,
            'zscout: unknown host "anvli"; did you mean anvil?\n',
        )
    done = fleet.zscout("maintain", "c", "--at", "now", "--for", "1h")
    assert (done.returncode, done.stderr) == (2, 'zscout: unknown host "c"; did you mean robot/c?\n')


@pytest.mark.slow
def test_maintain_names_whom_it_displaces_and_asks(fleet: CliFleet) -> None:
    holder = fleet.holder("furnace", "robot/a", "--min-runtime", "10m")
    fleet.zscout("book", "robot/c", "--at", "in 2h", "--for", "1h", "--name", "survey")
    words = ("maintain", "anvil", "robot/$*c", "--at", "now", "--for", "4h")
    unasked = fleet.zscout(*words)
    ends, takes, error = unasked.stderr.splitlines()
    assert unasked.returncode == 2
    assert re.fullmatch(
        rf"maintenance ends {re.escape(held_by('furnace'))}, priority 0: robot/a, at .* \(in .*\)", ends
    )
    assert re.fullmatch(rf"maintenance takes from survey \(\w{{8}}\) of {ME}: .*", takes)
    assert error == "zscout: stdin is not a terminal, so I can't ask before displacing others; add --yes"
    assert [one["name"] for one in told(fleet, "booking", "list")["bookings"]] == ["survey"]
    with fleet.terminal(*words) as person:
        person.until("Put robot/a, robot/c in maintenance? [y/N] ")
        person.press("n\n")
        assert person.code() == 1
    made = told(fleet, *words, "--yes", "--name", "greased")
    assert made["maintained"] == ["robot/a", "robot/c"]
    assert [one["arc"] for one in made["displaced"]["ends"]] == ["furnace"]
    assert [one["name"] for one in made["displaced"]["bookings"]] == ["survey"]
    # Where nobody is displaced nobody is asked.
    free = fleet.zscout("maintain", "robot/b", "--at", "now", "--for", "1h", "--name", "bees")
    assert (free.returncode, free.stderr) == (0, "")
    listed = {one["name"]: one["dates"][0] for one in told(fleet, "booking", "list")["bookings"]}
    assert listed["survey"]["state"] == "conflict"
    # A date may be up to a second ahead.
    fleet.shown("status", until=re.compile("^anvil .*cordoned", re.MULTILINE).search)
    assert "all devices of anvil, robot/$*c" in fleet.zscout("booking", "list").stdout
    end(holder)
    refused = fleet.zscout("uncordon", "anvil")
    assert refused.returncode == 1
    assert "anvil is in maintenance; end that with zscout booking cancel" in refused.stderr


async def _other_strategy(lab: Lab) -> None:
    lab.node("anvil", "robot/a")
    await lab.begun()
    drained = await lab.zscout("drain", "anvil")
    granted = 'its devices are still granted: only strategy "adaptive" drains them'
    assert (drained.returncode, drained.stdout) == (0, f"anvil is empty; {granted}; {STAYS}")
    assert (await lab.zscout("uncordon", "anvil")).stdout == "anvil is used again\n"


test_with_another_strategy_only_components_leave = pytest.mark.slow(in_lab(strategy="priority")(_other_strategy))

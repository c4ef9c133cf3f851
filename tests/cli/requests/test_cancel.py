"""`zscout cancel` and `zscout release`: end what others asked for, by name or by id."""

from __future__ import annotations

import json
from collections.abc import Iterator

import pytest

from tests.cli.cli_fleet import CliFleet, fleet_of
from tests.cli.tools import end, out_of
from tests.hang import HANG
from zscout.behaviors.client.blocking import connect
from zscout.messages import Who

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory, fleet_kind: str) -> Iterator[CliFleet]:
    with fleet_of(tmp_path_factory.mktemp("give"), "robot/a", "robot/b") as fleet:
        yield fleet


def test_release_ends_a_hold_and_its_command(fleet: CliFleet) -> None:
    running, _ = fleet.begun(
        "works", "request", "robot/a", "--name", "survey", "--", "sh", "-c", "echo works; exec sleep 1000"
    )
    done = fleet.zscout("release", "survey")
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("survey (")
    assert done.stdout.endswith("was running: released\n")
    assert running.wait(HANG) == 75
    assert "survey lost its grant: released by " in out_of(running).read()
    assert fleet.idle("robot/a")


def test_cancel_ends_a_wait_by_id(fleet: CliFleet) -> None:
    blocker = fleet.holder("blocker", "robot/a")
    waiting, _ = fleet.begun("survey waits", "request", "robot/a", "--name", "survey")
    (view,) = fleet.state(lambda state: len(state.queue) == 1).queue
    refused = fleet.zscout("release", "survey")
    assert refused.returncode == 1
    assert "is waiting and holds nothing; to cancel it: zscout cancel survey" in refused.stderr
    done = fleet.zscout("cancel", view.id, "--json")
    assert done.returncode == 0, done.stderr
    (arc,) = json.loads(done.stdout)["arcs"]
    assert (arc["arc"], arc["id"], arc["client"]) == ("survey", view.id, view.client)
    assert (arc["was"], arc["state"], arc["outcome"]) == ("queued", "ended", "cancelled")
    assert waiting.wait(HANG) == 1
    assert "survey was not granted: cancelled by " in out_of(waiting).read()
    end(blocker)


def test_a_name_of_several_is_refused_with_the_list(fleet: CliFleet) -> None:
    twins = [fleet.holder("twin", f"robot/{name}") for name in "ab"]
    refused = fleet.zscout("cancel", "twin")
    assert refused.returncode == 1
    assert refused.stderr.count("\n") == 1
    holds = fleet.state(lambda state: len(state.holds) == 2).holds
    names = [f"{hold.client}/{hold.id}" for hold in holds]
    assert refused.stderr.startswith('zscout: 2 requests are called "twin": ')
    assert all(f"{name} (running)" in refused.stderr for name in names)
    assert fleet.zscout("cancel", names[0]).returncode == 0
    (left,) = fleet.state(lambda state: len(state.holds) == 1).holds
    assert f"{left.client}/{left.id}" == names[1]
    again = fleet.holder("twin", min(holds[0].needs))
    assert fleet.zscout("cancel", "twin", "--all").stdout.count("was running: cancelled") == 2
    assert fleet.idle("robot/a", "robot/b")
    assert [twin.wait(HANG) for twin in (*twins, again)] == [1, 1, 1]


def test_an_unknown_arc_is_one_line(fleet: CliFleet) -> None:
    done = fleet.zscout("cancel", "nobody")
    assert (done.returncode, done.stdout) == (1, "")
    assert (
        done.stderr
        == 'zscout: no request "nobody" holds or waits; see zscout status, or zscout booking list for bookings\n'
    )
    device = fleet.zscout("release", "a").stderr
    assert device.endswith("; robot/a is a device: zscout status robot/a shows which requests hold it or wait\n")


def test_anothers_request_is_asked_about(fleet: CliFleet) -> None:
    with connect("script", fleet=fleet.lab.fleet_of("bob"), host="bob") as lab:
        lab.client.who = Who("bob", "test")
        arc = lab.run(lab.client.request("survey", {"robot/a": {}}, min_runtime=60))
        lab.run(lab.client.granted(arc))
        for word in ("cancel", "release"):
            done = fleet.zscout(word, "survey")
            assert done.returncode == 1, done
            assert done.stderr == (
                f"zscout: survey (bob/script/{arc.id}) of bob@test is not yours; to {word} it all the same, add --yes\n"
            )
        done = fleet.zscout("cancel", "survey", "--yes", "--json")
        assert json.loads(done.stdout)["arcs"] == [
            {"arc": "survey", "id": arc.id, "client": "bob/script", "was": "running"}
            | {"state": "ended", "outcome": "cancelled"}
        ]

"""A program that reboots its device, on a real mesh: the hold goes on, whatever becomes of leader and nodes."""

from __future__ import annotations

import asyncio
import json
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.live.bench import until
from tests.live.closed import ClosedLab
from tests.live.lab import Lab, LeaderWatch, awaited
from zscout.behaviors.client.arc import hold
from zscout.behaviors.client.bookings import BookingsClient
from zscout.behaviors.client.client import Client, RequestRefused
from zscout.messages import RcState, Unwell

pytestmark = pytest.mark.live

BOARD = "dut/board"
APART = "candidate = false\n"
LONG = 'tolerate = "5m"\n'
SHORT = "tolerate = 0.5\n"


def board(folder: Path, more: str = "") -> str:
    """A device that works as long as there is no file `down`."""
    health = f'["sh", "-c", "test ! -e {folder}/down"]'
    return f'[[rc]]\nname = "{BOARD}"\ndriver = "command"\nhealth = {health}\nevery = 0.5\n{more}'


async def device(lab: Lab, client: Client, so: Callable[[RcState], object]) -> RcState:
    """Its state, as soon as it is so."""
    return await awaited(lambda: lab.rc(client, BOARD), so)


async def unwell(lab: Lab, client: Client) -> Unwell:
    state = await device(lab, client, lambda state: state.unwell)
    assert state.unwell is not None
    assert state.health == "ok"
    return state.unwell


@pytest.mark.slow
async def test_a_command_reboots_the_device_that_it_holds(tmp_path: Path, lab: Lab) -> None:
    down, up = tmp_path / "down", tmp_path / "up"
    lab.node("rcs", extra=board(tmp_path, LONG))
    client = await lab.client("crew")
    await lab.ready(client, BOARD)
    program = f"touch {down}; until test -e {up}; do sleep 0.02; done; rm {down}; sleep 1; echo passed"
    running = asyncio.create_task(lab.zscout("request", BOARD, "--name", "test", "--", "sh", "-c", program))
    said = await unwell(lab, client)
    assert said.why == "health ended with exit code 1"
    assert 200 < said.left <= 300
    higher = await client.request("higher", {BOARD: {}}, priority=5, min_runtime=1)
    await until(lambda: "unwell" in higher.reason)
    assert higher.reason == f"{BOARD} is unwell: health ended with exit code 1"
    assert "unwell since " in (await lab.zscout("status")).stdout
    [device] = json.loads((await lab.zscout("status", "--json")).stdout)["rcs"]
    assert (device["health"], device["unwell"]["why"]) == ("ok", said.why)
    await client.end(higher)
    up.touch()
    done = await running
    assert (done.returncode, done.stdout) == (0, "passed\n"), done.stderr
    told = [line for line in done.stderr.splitlines() if line.startswith(f"{BOARD} is ")]
    assert told[0].startswith(f"{BOARD} is unwell since ")
    assert "health ended with exit code 1; lost in " in told[0]
    assert told[1:] == [f"{BOARD} is well again"]


@pytest.mark.slow
async def test_the_events_of_a_token_have_its_unwell_devices(tmp_path: Path, lab: Lab) -> None:
    down, file = tmp_path / "down", tmp_path / "events.json"
    lab.node("rcs", extra=board(tmp_path, LONG))
    client = await lab.client("crew")
    await lab.ready(client, BOARD)
    acquired = await lab.zscout("acquire", BOARD, "--for", "1h", "--json-file", str(file))
    assert acquired.returncode == 0, acquired.stderr

    def written() -> list[str]:
        return [json.loads(line)["event"] for line in file.read_text().splitlines()]

    down.touch()
    await until(lambda: "unwell" in written())
    down.unlink()
    await until(lambda: "well" in written())
    released = await lab.zscout("release", acquired.stdout.strip())
    assert released.returncode == 0, released.stderr


@pytest.mark.slow
async def test_the_leader_dies_while_a_device_is_unwell(tmp_path: Path) -> None:
    async with Lab(tmp_path, candidates=("a", "b")) as lab:
        lab.node("rcs", extra=APART + board(tmp_path, LONG))
        lab.node("a")
        client = await lab.client("crew")
        await lab.ready(client, BOARD)
        lab.node("b")
        await lab.candidates(client, "b")
        leaders = LeaderWatch(client)
        async with hold(client, "test", {BOARD: {}}, confirmed=True) as held:
            (tmp_path / "down").touch()
            await unwell(lab, client)
            lab.signal("a", signal.SIGKILL)
            await leaders.lost("a")
            await lab.state(client, lambda state: state.host == "b" and bool(state.holds))
            waits = await (await lab.client("other")).request("next", {BOARD: {}})
            await until(lambda: waits.reason.startswith(f"{BOARD} is unwell"))
            (tmp_path / "down").unlink()
            await device(lab, client, lambda state: state.unwell is None)
            assert held.active
        await until(lambda: waits.grant is not None)


@pytest.mark.slow
async def test_a_device_is_lost_after_what_it_tolerates_and_kept_for_what_was_announced(
    tmp_path: Path, lab: Lab
) -> None:
    down = tmp_path / "down"
    lab.node("rcs", extra=board(tmp_path, SHORT + "tolerate_max = 300\n"))
    client = await lab.client("crew")
    await lab.ready(client, BOARD)
    program = ("--", "sh", "-c", f"touch {down}; sleep 3; rm {down}; echo passed")
    lost = await lab.zscout("request", BOARD, *program)
    assert (lost.returncode, "was lost: health ended with exit code 1" in lost.stderr) == (75, True), lost.stderr
    down.unlink(missing_ok=True)
    await lab.ready(client, BOARD)
    kept = await lab.zscout("request", BOARD, "--tolerate", "10m", *program)
    assert (kept.returncode, kept.stdout) == (0, "passed\n"), kept.stderr
    assert f"--tolerate 10 min is more than the devices allow: {BOARD} tolerates 5 min" in kept.stderr
    async with hold(client, "test", {BOARD: {}}, confirmed=True) as held:
        assert await held.expect_outage(20) == {BOARD: 20.0}
        down.touch()
        await unwell(lab, client)
        # Free, it is lost at once.
    await until(lambda: not held.active)
    assert (await device(lab, client, lambda state: state.health != "ok")).unwell is None


@pytest.mark.slow
@pytest.mark.parametrize("how", ["killed", "frozen"])
async def test_a_node_that_goes_loses_the_hold_and_forgets_that_its_device_is_unwell(tmp_path: Path, how: str) -> None:
    async with Lab(tmp_path, lease=1.0, candidates=("a",)) as lab:
        lab.node("a")
        node = lab.node("rcs", extra=APART + board(tmp_path, LONG))
        client = await lab.client("crew")
        await lab.ready(client, BOARD)
        arc = await client.request("test", {BOARD: {}}, min_runtime=60)
        await until(lambda: arc.grant is not None)
        (tmp_path / "down").touch()
        await unwell(lab, client)
        lab.signal("rcs", signal.SIGKILL if how == "killed" else signal.SIGSTOP)
        await until(lambda: arc.state == "queued")
        if how == "killed":
            node.wait()
            lab.node("rcs", extra=APART + board(tmp_path, LONG))
        else:
            lab.signal("rcs", signal.SIGCONT)
        await device(lab, client, lambda state: state.health != "ok")
        assert arc.grant is None
        (tmp_path / "down").unlink()
        await until(lambda: arc.grant is not None)


@pytest.mark.slow
async def test_a_holder_reports_its_device_broken_and_only_operators_get_it_until_it_is_well(lab: Lab) -> None:
    lab.node("small", "robot/a", "robot/b")
    client = await lab.client("crew")
    await lab.ready(client, "robot/a", "robot/b")
    async with hold(client, "test", {"robot/a": {}, "robot/b": {}}) as held:
        await held.report_broken("its gripper is bent", "robot/a")
        with pytest.raises(KeyError):
            await held.report_broken("not mine", "robot/c")
        assert held.active
    waits = await (await lab.client("other")).request("next", {"robot/a": {}})
    await until(lambda: "is broken, as" in waits.reason)
    assert waits.reason.endswith(": its gripper is bent")
    status = (await lab.zscout("status")).stdout
    assert "broken: its gripper is bent (" in status
    again = await lab.zscout("maintain", "robot/a", "--broken", "it smokes")
    assert again.stdout == "robot/a: broken, until zscout maintain robot/a --well\n"
    assert (await lab.zscout("request", "robot/a", "--priority", "10", "--", "true")).returncode == 0
    assert waits.grant is None
    well = await lab.zscout("maintain", "robot/a", "--well")
    assert (well.returncode, well.stdout) == (0, "robot/a: granted again\n"), well.stderr
    await until(lambda: waits.grant is not None)
    none = await lab.zscout("maintain", "robot/a", "--well")
    assert (none.returncode, none.stderr) == (1, "zscout: no report that robot/a is broken; see zscout booking list\n")


@pytest.mark.slow
async def test_in_a_secured_fleet_who_holds_a_device_and_operators_report_it_broken(tmp_path: Path) -> None:
    async with ClosedLab(tmp_path) as lab:
        lab.node("anvil", "robot/a", "robot/b")
        bob, eve, ada = await lab.person("bob"), await lab.person("eve"), await lab.person("ada")
        await lab.ready(bob, "robot/a", "robot/b")
        async with hold(bob, "test", {"robot/a": {}}) as held:
            for rcs in (["robot/b"], ["robot/a", "robot/b"]):
                with pytest.raises(RequestRefused, match=r"bob \(client\) may not report devices broken .* not hold"):
                    await BookingsClient(bob).report_broken(rcs, "no power")
            with pytest.raises(RequestRefused, match=r"eve \(client\) may not report"):
                await BookingsClient(eve).report_broken(["robot/a"], "no power")
            await held.report_broken("no power")
        [report] = (await BookingsClient(ada).list()).bookings
        assert (report.broken, report.owner, report.priority) == (True, "bob", 10)
        with pytest.raises(RequestRefused, match=r"eve \(client\) may not"):
            await BookingsClient(eve).unbook(report.id)
        async with hold(ada, "repair", {"robot/a": {}}, priority=10):
            await BookingsClient(ada).report_broken(["robot/b"], "no light")
        for one in (await BookingsClient(ada).list()).bookings:
            await BookingsClient(ada).unbook(one.id)
        async with hold(eve, "test", {"robot/a": {}, "robot/b": {}}):
            pass

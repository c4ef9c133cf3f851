"""Devices that need time to start, on a real mesh: the time of a hold begins when all of them have begun, whatever
becomes of the leader and of nodes meanwhile."""

from __future__ import annotations

import asyncio
import json
import signal
from pathlib import Path

import pytest

from tests.live.bench import until
from tests.live.lab import Lab, LeaderWatch
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.request import OpenArc
from zscout.mesh import clock
from zscout.types import SECOND

pytestmark = [pytest.mark.live, pytest.mark.slow]

SLOW, OTHER, QUICK = "dut/slow", "dut/other", "robot/x"
APART = "candidate = false\n"
RUNS = 2.0
"""Seconds asked for: less than a start takes here."""
PATIENCE = 3.0
"""Seconds in which a hold of RUNS would be over, had its time begun."""


def device(rc: str, folder: Path) -> str:
    """A device that starts when its file is there. Each start is noted."""
    go, told = folder / rc.replace("/", "-"), folder / "starts"
    start = f"echo {rc} >> {told}; until test -e {go}; do sleep 0.02; done"
    return f'[[rc]]\nname = "{rc}"\ndriver = "command"\nstart = ["sh", "-c", "{start}"]\ntimeout = 100\n'


def let_start(folder: Path, *rcs: str) -> None:
    for rc in rcs:
        (folder / rc.replace("/", "-")).touch()


async def asked(client: Client, *rcs: str) -> OpenArc:
    """A request that is granted, and whose devices start."""
    arc = await client.request("job", {rc: {} for rc in rcs}, min_runtime=RUNS, keep=False)
    await until(lambda: arc.ready is not None)
    return arc


async def has_its_time(arc: OpenArc) -> None:
    """From when its devices are ready."""
    await until(lambda: arc.ready is None)
    assert arc.grant is not None
    began = clock.now()
    await until(lambda: not arc.open)
    assert arc.outcome == "completed"
    assert (clock.now() - began) / SECOND > RUNS - 0.5


async def test_a_program_asks_for_less_time_than_its_device_needs_to_start(tmp_path: Path, lab: Lab) -> None:
    lab.node("rcs", extra=device(SLOW, tmp_path))
    client = await lab.client("crew")
    await lab.ready(client, SLOW)
    program = ("sh", "-c", "echo $ZSCOUT_REMAINING; sleep 1; echo finished")
    running = asyncio.create_task(lab.zscout("request", SLOW, "--name", "job", "--release-after", "2s", "--", *program))
    state = await lab.state(client, lambda state: any(hold.waits is not None for hold in state.holds))
    assert 90 < (state.holds[0].waits or 0) <= 100
    assert state.holds[0].remaining == RUNS
    dry = await lab.zscout("request", SLOW, "--dry-run")
    assert dry.stdout.splitlines()[-1] == "then it is starting, ready in about 100 s"
    assert "starting, ready in about " in (await lab.zscout("why", "job")).stdout
    assert "starting, ready in about " in (await lab.zscout("status")).stdout
    told = json.loads((await lab.zscout("status", "--json")).stdout)
    assert told["holds"][0]["waits"] > 80
    await asyncio.sleep(PATIENCE)
    assert not running.done()
    let_start(tmp_path, SLOW)
    done = await running
    assert (done.returncode, done.stdout.splitlines()[1:]) == (0, ["finished"])
    assert 1.5 < float(done.stdout.split()[0]) <= RUNS
    assert "starting, ready in about 100 s" in done.stderr
    assert (tmp_path / "starts").read_text().split() == [SLOW]


async def test_a_gang_begins_when_the_last_of_its_devices_has(tmp_path: Path, lab: Lab) -> None:
    lab.node("rcs", QUICK, extra=device(SLOW, tmp_path))
    lab.node("small", extra=APART + device(OTHER, tmp_path))
    client = await lab.client("crew")
    await lab.ready(client, SLOW, OTHER, QUICK)
    arc = await asked(client, SLOW, OTHER, QUICK)
    let_start(tmp_path, SLOW)
    await asyncio.sleep(PATIENCE)
    await lab.held_by(client, QUICK, "job")
    await lab.held_by(client, SLOW, "job")
    assert arc.ready is not None
    let_start(tmp_path, OTHER)
    await has_its_time(arc)


async def test_the_leader_dies_while_a_device_starts(tmp_path: Path) -> None:
    async with Lab(tmp_path, candidates=("a", "b")) as lab:
        lab.node("rcs", QUICK, extra=APART + device(SLOW, tmp_path))
        lab.node("a")
        client = await lab.client("crew")
        await lab.ready(client, SLOW, QUICK)
        lab.node("b")
        await lab.candidates(client, "b")
        leaders = LeaderWatch(client)
        arc = await asked(client, SLOW, QUICK)
        grant = arc.grant
        lab.signal("a", signal.SIGKILL)
        await leaders.lost("a")
        state = await lab.state(client, lambda state: state.host == "b" and bool(state.holds))
        assert 80 < (state.holds[0].waits or 0) <= 100
        await asyncio.sleep(PATIENCE)
        assert arc.grant == grant
        let_start(tmp_path, SLOW)
        await has_its_time(arc)
        assert (tmp_path / "starts").read_text().split() == [SLOW]


@pytest.mark.parametrize("how", ["killed", "frozen"])
async def test_the_node_of_a_device_that_starts_is_gone_for_a_while(tmp_path: Path, how: str) -> None:
    async with Lab(tmp_path, lease=1.0, candidates=("a",)) as lab:
        lab.node("a")
        node = lab.node("rcs", extra=APART + device(SLOW, tmp_path))
        client = await lab.client("crew")
        await lab.ready(client, SLOW)
        arc = await asked(client, SLOW)
        grant = arc.grant
        lab.signal("rcs", signal.SIGKILL if how == "killed" else signal.SIGSTOP)
        await until(lambda: arc.state == "queued")
        if how == "killed":
            node.wait()
            lab.node("rcs", extra=APART + device(SLOW, tmp_path))
        else:
            lab.signal("rcs", signal.SIGCONT)
        await until(lambda: arc.ready is not None and arc.grant != grant)
        await asyncio.sleep(PATIENCE)
        let_start(tmp_path, SLOW)
        await has_its_time(arc)

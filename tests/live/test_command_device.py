"""A device that is switched by commands, on a real mesh: who holds it enters when it has been started."""

from __future__ import annotations

import asyncio
import signal
from pathlib import Path

import pytest

from tests.hang import HANG
from tests.live.lab import Lab
from zscout.behaviors.client.arc import Revoked, hold
from zscout.behaviors.client.client import Client, RequestRefused

pytestmark = pytest.mark.live

ADDED = """
[[rc]]
name = "%s"
driver = "command"
start = ["true"]
stop = ["true"]
timeout = 100
"""
TABLE = """
[[rc]]
name = "psu/bench"
driver = "command"
start = ["sh", "-c", 'sleep 2; echo "$ZSCOUT_PARAMETERS" >> "%(told)s"']
stop = ["sh", "-c", 'echo stop >> "%(told)s"']
parameters = { voltage = 30.0 }
timeout = 100
"""


@pytest.mark.slow
async def test_a_slow_start_is_waited_for_and_told_of(tmp_path: Path, lab: Lab) -> None:
    told = tmp_path / "told"
    lab.node("small", extra=TABLE % {"told": told})
    client = await lab.client("crew")
    await lab.ready(client, "psu/bench")
    program = ("--", "sh", "-c", f"echo enter >> {told}")
    held = await lab.zscout("request", "psu/bench:voltage=12", *program)
    assert held.returncode == 0, held.stderr
    assert told.read_text().splitlines()[:2] == ['{"voltage": 12.0}', "enter"]
    assert "starting, ready in about " in held.stderr
    for asked, why in (
        ({"voltage": 31}, "can never start: voltage 31 of 30 at psu/bench"),
        ({"current": 1}, "psu/bench has no parameter current; it has voltage"),
    ):
        with pytest.raises(RequestRefused, match=why):
            await client.request("bench", {"psu/bench": asked}, min_runtime=1)
    assert told.read_text().split().count("enter") == 1


@pytest.mark.slow
async def test_sighup_starts_new_devices_and_stops_removed_ones_while_others_are_held(lab: Lab) -> None:
    lab.node("small", extra=ADDED % "psu/kept" + ADDED % "psu/old")
    client = await lab.client("crew")
    await lab.ready(client, "psu/kept", "psu/old")

    async def old(other: Client) -> None:
        async with hold(other, "old", {"psu/old": {}}, confirmed=True):
            file = lab.folder / "small.toml"
            file.write_text(file.read_text().replace("psu/old", "psu/new"))
            lab.signal("small", signal.SIGHUP)
            await asyncio.sleep(HANG)

    async with hold(client, "kept", {"psu/kept": {}}, confirmed=True) as held:
        with pytest.raises(Revoked, match="psu/old was lost: it was removed from the node file of small"):
            await old(await lab.client("other"))
        await lab.ready(client, "psu/kept", "psu/new")
        async with hold(client, "new", {"psu/new": {}}, confirmed=True):
            state = await lab.state(client, lambda state: len(state.holds) == 2)
        assert held.grant in [view.grant for view in state.holds]
    assert "SIGHUP: applied rc.psu/new, rc.psu/old" in lab.log("small")

"""What becomes of the knowledge of devices when leaders change, start anew, and are cut off from each other."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from tests.mesh.kit import run, until
from tests.services.rcm.kit import FakeFleet, sees
from zscout.drivers.generic import ExclusiveDriver
from zscout.drivers.instances import InstanceState
from zscout.drivers.resource_controller import ResourceController
from zscout.mesh.supervision import StallWatch
from zscout.services.rcm.candidate import Candidate
from zscout.services.rcm.inventory import FILE
from zscout.types import SECOND

RC = "robot/a"


async def test_the_next_leader_knows_what_went_while_another_led() -> None:
    fleet = FakeFleet("x", "y", "z")
    first, heir = fleet.candidate("x"), fleet.candidate("y")
    rc = fleet.rc(RC)
    await until(lambda: first.rcm)
    await fleet.joined(rc)
    fleet.network.kill(rc.mesh)
    await asyncio.sleep(60)
    # This one has not seen it ever.
    late = fleet.candidate("z")
    await asyncio.sleep(1)
    for dies, leads in ((first, heir), (heir, late)):
        fleet.network.kill(dies.mesh)
        await until(lambda leads=leads: leads.rcm)  # type: ignore[misc]
        view = await sees(fleet.watcher, RC, present=False)
        assert (view.host, view.reason) == ("devices", "the node of devices is gone")
        assert view.gone is not None
        assert 60 < view.gone < 80


async def test_it_is_kept_over_a_restart_of_the_only_candidate(tmp_path: Path) -> None:
    fleet = FakeFleet()
    candidate = fleet.candidate("x", tmp_path)
    rc = fleet.rc(RC)
    await until(lambda: candidate.rcm)
    await fleet.joined(rc)
    await until((tmp_path / FILE).exists)
    fleet.network.kill(rc.mesh)
    fleet.network.kill(candidate.mesh)
    anew = fleet.candidate("x", tmp_path)
    await until(lambda: anew.rcm)
    view = await sees(fleet.watcher, RC, present=False)
    assert (view.host, view.reason) == ("devices", "the node of devices is gone")


async def test_a_file_that_is_none_is_replaced(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / FILE).write_text('{"written": "now"')
    fleet = FakeFleet()
    candidate = fleet.candidate("x", tmp_path)
    await until(lambda: candidate.rcm)
    await until(lambda: "homes" not in (tmp_path / FILE).read_text() or "now" not in (tmp_path / FILE).read_text())
    await candidate.stop()
    assert "can't be read, and is not used" in caplog.text


async def test_what_was_only_asked_for_is_no_device() -> None:
    fleet = FakeFleet()
    fleet.rcm()
    client = fleet.client("one")
    assert (await client.ask("ghost", "robot/nowhere")).reason == "robot/nowhere not on the mesh"
    assert (await fleet.state()).rcs == []


async def test_a_device_that_is_lost_from_the_beginning_says_why() -> None:
    fleet = FakeFleet()
    fleet.rcm()
    rc = fleet.rc(RC, health="/dev/video9 can't be opened")
    view = await sees(fleet.watcher, RC, reason="/dev/video9 can't be opened")
    assert (view.present, view.host, view.gone) == (False, "devices", None)
    client = fleet.client("one")
    answer = await client.ask("look", RC)
    assert answer.reason == "robot/a is lost: /dev/video9 can't be opened"
    assert answer.why is not None
    assert (answer.why.code, answer.why.detail) == ("absent", "/dev/video9 can't be opened")
    assert "/dev/video9 can't be opened" in (await client.ask("any", "robot/*")).reason
    rc.health = "ok"
    rc.publish()
    await until(lambda: rc.arcs == ["look"])


class Station:
    """A host with a node: it may lead, and it offers the RC."""

    def __init__(self, fleet: FakeFleet, host: str) -> None:
        self.mesh = fleet.mesh(host)
        self.candidate = Candidate(self.mesh, fleet.fleet)
        lease = fleet.fleet.timing.hold_lease / SECOND
        stall = StallWatch(self.mesh.now).start()
        self.rc = ResourceController(self.mesh, RC, ExclusiveDriver(), hold_lease=lease, stall=stall)

    async def start(self) -> None:
        self.candidate.start()
        await self.rc.start()

    @property
    def serves(self) -> bool:
        return self.rc.instances.state is InstanceState.SERVES


async def test_two_owners_through_a_partition_and_a_merge() -> None:
    """Each half says that the other owner is not seen; after the merge one serves, and the other is named."""
    fleet = FakeFleet("ws1", "ws2")
    one, two = Station(fleet, "ws1"), Station(fleet, "ws2")
    await one.start()
    await sees(one.mesh, RC, host="ws1", present=True)
    await two.start()
    await sees(one.mesh, RC, host="ws1", duplicates=["ws2"], unseen={})
    assert (one.serves, two.serves) == (True, False)
    assert two.rc.instances.duplicate_of == "robot/a at ws1"

    fleet.cut(one.mesh, two.mesh)
    here = await sees(one.mesh, RC, host="ws1", present=True, duplicates=[])
    there = await sees(two.mesh, RC, host="ws2", present=True, duplicates=[])
    assert (list(here.unseen), list(there.unseen)) == (["ws2"], ["ws1"])
    assert (one.serves, two.serves) == (True, True)

    healed = fleet.watcher.now()
    fleet.network.heal()
    await until(lambda: one.serves != two.serves)
    assert fleet.watcher.now() - healed < fleet.fleet.timing.hold_lease
    served, other = (one, two) if one.serves else (two, one)
    named, stands_by = served.mesh.me.host, other.mesh.me.host
    view = await sees(served.mesh, RC, host=named, present=True, duplicates=[stands_by], unseen={})
    assert view.reason == ""
    assert other.rc.instances.duplicate_of == f"robot/a at {named}"
    await asyncio.sleep(5)
    assert (served.serves, other.serves) == (True, False)

    # One that is stopped in order is no other owner that nobody sees.
    await other.rc.stop()
    await sees(served.mesh, RC, host=named, duplicates=[], unseen={})


def test_of_two_that_hold_nothing_the_one_at_home_is_meant_by_a_new_leader() -> None:
    """Without a word of the fleet file it is the one on the lesser host name."""

    async def led(home: str) -> str:
        fleet = FakeFleet("x")
        fleet.fleet = fleet.fleet.__class__(
            **{name: getattr(fleet.fleet, name) for name in fleet.fleet.__struct_fields__} | {"devices": {home: (RC,)}}
        )
        for host in ("h1", "h2"):
            mesh = fleet.mesh(host)
            rc = ResourceController(mesh, RC, ExclusiveDriver(), hold_lease=3.0, stall=StallWatch(mesh.now).start())
            await rc.start()
            rc.instances.take(rc.instance)  # as though it had not seen the other one
        candidate = fleet.candidate("x")
        await until(lambda: candidate.rcm)
        view = await sees(fleet.watcher, RC, present=True)
        await candidate.stop()
        return view.host

    assert [run(led(home)) for home in ("h1", "h2")] == ["h1", "h2"]

"""A fleet with certificates: who is who, what a role may do, and that a fleet without is another world."""

from __future__ import annotations

import asyncio
import signal
import socket
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from tests.hang import HANG
from tests.live.closed import DAY, ClosedLab
from tests.live.lab import Lab
from zscout.behaviors.client.arc import Revoked, hold
from zscout.behaviors.client.client import RequestRefused
from zscout.config.fleet import load_fleet
from zscout.config.strict import BadInput
from zscout.keyexpr import Role, Sender, valid_name
from zscout.mesh import ZenohMesh

pytestmark = pytest.mark.live
SECOND = timedelta(seconds=1)


@pytest.mark.essential
async def test_two_persons_and_a_node_on_one_machine(lab: ClosedLab) -> None:
    """Each is known by its own name, whatever its user is called there, and a person's machine by a field."""
    lab.node("anvil", "robot/a", "robot/b")
    ada, bob = await lab.person("ada", "arm"), await lab.person("bob", "arm")
    await lab.ready(ada, "robot/a", "robot/b")
    await lab.ready(bob, "robot/a", "robot/b")
    async with hold(ada, "survey", {"robot/a": {}}), hold(bob, "survey", {"robot/b": {}}):
        state = await lab.state(ada, lambda state: len(state.holds) == 2)
        assert {view.client for view in state.holds} == {"ada/arm", "bob/arm"}
        machine = valid_name(socket.gethostname())
        whose = sorted((view.who.user, view.who.host) for view in state.holds if view.who is not None)
        assert whose == [("ada", machine), ("bob", machine)]


@pytest.mark.slow
async def test_a_secured_fleet_and_an_open_one_never_mix(tmp_path: Path) -> None:
    """On one network, under one name: nobody of the one is seen in the other."""
    (tmp_path / "open").mkdir()
    (tmp_path / "closed").mkdir()
    async with ClosedLab(tmp_path / "closed") as closed, Lab(tmp_path / "open") as plain:
        named = plain.fleet_file.read_text().replace(plain.fleet.name, closed.fleet.name)
        own, other = plain.fleet.mesh.multicast_address, closed.fleet.mesh.multicast_address
        plain.fleet_file.write_text(named.replace(own, other))
        plain.fleet = load_fleet(plain.fleet_file)
        closed.node("anvil", "robot/a")
        plain.node("stranger", "robot/z")
        ada, anybody = await closed.person("ada"), await plain.client()
        inside = await closed.ready(ada, "robot/a")
        outside = await plain.ready(anybody, "robot/z")
        assert {view.rc for view in inside.rcs} == {"robot/a"}
        assert {view.rc for view in outside.rcs} == {"robot/z"}
        for client, hosts in ((ada, {"anvil"}), (anybody, {"stranger"})):
            tokens = await client.mesh.living(client.mesh.keys.alive_any(Role.NODE), timeout=HANG)
            assert {token.host for token in tokens} == hosts


@pytest.mark.slow
async def test_what_roles_say_is_enforced_and_taken_anew_at_sighup(lab: ClosedLab) -> None:
    lab.node("anvil", "robot/a", "robot/b")
    bob, ada = await lab.person("bob"), await lab.person("ada")
    await lab.ready(bob, "robot/a", "robot/b")
    with pytest.raises(RequestRefused, match=r"bob \(client\) may not request priority 10; at most 9; ada may"):
        async with hold(bob, "survey", {"robot/a": {}}, priority=10):
            pass

    async def survey() -> None:
        async with hold(bob, "survey", {"robot/a": {}}, min_runtime=600):
            async with hold(ada, "operator", {"robot/b": {}}, priority=10):
                pass
            fleet = lab.fleet_file.read_text()
            lab.fleet_file.write_text(fleet.replace('client = ["bob", "eve"]', 'client = ["eve"]'))
            lab.signal("anvil", signal.SIGHUP)
            await asyncio.sleep(HANG)

    with pytest.raises(Revoked, match="the fleet file, which names its owner under no role"):
        await survey()
    with pytest.raises(RequestRefused, match="bob, which has no role here, may not request devices"):
        async with hold(bob, "survey", {"robot/a": {}}):
            pass
    # Who was not touched, and who is named from now on, goes on.
    async with hold(ada, "operator", {"robot/a": {}}, priority=10):
        pass


async def test_a_certificate_of_another_name_is_told_before_joining(tmp_path: Path, lab: ClosedLab) -> None:
    with pytest.raises(
        BadInput, match=r'is the certificate of "bob", but this host is "ada"; put the certificate of "ada" there'
    ):
        await ZenohMesh.open(lab.fleet_of("bob"), Sender("ada", "c1"))
    lab.authority.issue("mallory", tmp_path / "keys" / "mallory", DAY, datetime.now(UTC))
    with pytest.raises(BadInput, match=r"mallory has no role in fleet .*; name it in the fleet file's \[roles\]"):
        await ZenohMesh.open(lab.fleet_of("mallory"), Sender("mallory", "c1"))


@pytest.mark.slow
async def test_certificates_that_are_renewed_in_place_end_no_hold(tmp_path: Path, lab: ClosedLab) -> None:
    """Past the end of those by which all links were made, the hold goes on and a newcomer is let in."""
    # So short a life that it ends in this test, and longer than this machine takes to start all.
    began = time.monotonic()
    lab.node("cart", "radio/r")
    lab.node("anvil", "robot/a")
    await lab.ready(await lab.person("ada"), "robot/a", "radio/r")
    life = timedelta(seconds=max(20.0, 8 * (time.monotonic() - began)))
    await lab.stop()
    for name in ("anvil", "cart", "bob", "eve"):
        lab.authority.renew(tmp_path / "keys" / name, life, datetime.now(UTC))
    ends = datetime.now(UTC) + life
    lab.node("cart", "radio/r")
    lab.node("anvil", "robot/a")
    bob = await lab.person("bob")
    await lab.ready(bob, "robot/a", "radio/r")
    needs: dict[str, dict[str, float]] = {"robot/a": {}, "radio/r": {}}
    async with hold(bob, "survey", needs, min_runtime=600) as held:
        assert datetime.now(UTC) < ends
        for name in ("anvil", "cart", "bob", "eve"):
            lab.authority.renew(tmp_path / "keys" / name, DAY, datetime.now(UTC))
        while datetime.now(UTC) < ends + 4 * SECOND:  # noqa: ASYNC110 - a time of day
            await asyncio.sleep(0.1)
        state = await lab.state(bob, lambda state: bool(state.holds))
        assert [(view.arc, view.grant) for view in state.holds] == [("survey", held.grant)]
    eve = await lab.person("eve")
    await lab.ready(eve, "robot/a", "radio/r")
    async with hold(eve, "newcomer", needs):
        pass

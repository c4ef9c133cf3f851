"""What works on a plain fleet works on a secured one, for the roles that may."""

from __future__ import annotations

import asyncio
import json
import signal
from pathlib import Path

import pytest

from tests.hang import HANG
from tests.live.closed import ClosedLab
from tests.live.lab import awaited
from zscout.behaviors.client.arc import Revoked, hold
from zscout.behaviors.client.client import RequestRefused
from zscout.messages import ComponentSpec, ComponentView, LoadReport, RcAsk, RcState, StartComponent, StopComponent
from zscout.types import Term

pytestmark = pytest.mark.live


def env_of(lab: ClosedLab, name: str) -> dict[str, str]:
    """The environment of a person's shell."""
    return {**lab.env, "ZSCOUT_KEYS": str(lab.folder / "keys" / name)}


@pytest.mark.slow
async def test_a_component_starts_and_holds_on_a_secured_fleet(lab: ClosedLab) -> None:
    lab.node("anvil", "robot/a")
    ada = await lab.person("ada")
    await lab.ready(ada, "robot/a")
    done = await lab.zscout("component", "start", "counter", "--set", "rc=robot/a", env=env_of(lab, "bob"))
    assert done.returncode == 0, done.stderr
    await lab.state(ada, lambda state: any(hold.client.startswith("anvil/counter.") for hold in state.holds))
    done = await lab.zscout("component", "list", env=env_of(lab, "wall"))
    assert "running" in done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("name", ["wall", "bob"])
async def test_health_and_capacity_of_devices_are_shown_to_everybody(lab: ClosedLab, name: str) -> None:
    """RCs answer a state's question of all, who may not ask them for a promise."""
    lab.node("anvil", "robot/a:rate=10")
    person = await lab.person(name)
    await lab.ready(person, "robot/a")
    done = await lab.zscout("status", "--json", env=env_of(lab, name))
    (device,) = json.loads(done.stdout)["rcs"]
    assert (device["health"], device["capacity"]) == ("ok", {"rate": 10.0})
    forged = RcAsk(promise=Term(9, "forger"))
    reply = await person.mesh.ask_one(
        person.mesh.keys.ask_rc_state("robot/a", person.mesh.me), forged, RcState, timeout=HANG
    )
    assert reply is not None
    assert reply.message is not None
    assert reply.message.term.counter < 9


@pytest.mark.slow
async def test_a_component_is_its_starters_and_moves_by_an_operators_word(lab: ClosedLab) -> None:
    """It counts against its starter's quota on either host; nobody but the placer has a node start anything."""
    lab.fleet_file.write_text(lab.fleet_file.read_text() + "[quotas.bob]\narcs = 1\n")
    lab.node("anvil", "robot/a", "robot/b")
    lab.node("cart")
    ada, bob = await lab.person("ada"), await lab.person("bob")
    await lab.ready(bob, "robot/a", "robot/b")
    start = "component", "start", "counter", "--set", "rc=robot/a", "--host", "anvil", "--host", "cart"
    assert (await lab.zscout(*start, env=env_of(lab, "bob"))).returncode == 0

    async def held_from() -> set[str]:
        state = await ada.state()
        return set() if state is None else {hold.client.partition("/")[0] for hold in state.holds}

    (there,) = await awaited(held_from, bool)
    other = {"anvil": "cart", "cart": "anvil"}[there]
    for host in (there, other):
        await awaited(held_from, lambda hosts, host=host: hosts == {host})  # type: ignore[misc]
        with pytest.raises(RequestRefused, match="bob has 1 open requests, its quota"):
            await bob.request("survey", {"robot/b": {}})
        if host == there:
            assert (
                await lab.zscout("component", "migrate", "counter", "--to", other, "--yes", env=env_of(lab, "ada"))
            ).returncode == 0
    for order in (StartComponent("c", 1, ComponentSpec("counter")), StopComponent("counter")):
        key = bob.mesh.keys.component("anvil", bob.mesh.me)
        reply = await awaited(lambda: bob.mesh.ask_one(key, order, ComponentView, timeout=HANG), bool)  # noqa: B023
        assert reply is not None
        assert reply.problem is not None
        assert "bob (client) may not order a node to" in reply.problem.message


@pytest.mark.slow
async def test_a_name_is_removed_by_the_edit_after_a_mistake_and_status_says_both(lab: ClosedLab) -> None:
    """A mistake leaves the old rights in force, and shows in `status`; a host without the edit shows as well."""
    lab.node("anvil", "robot/a")
    lab.node("cart", "radio/r")
    ada, bob = await lab.person("ada"), await lab.person("bob")
    await lab.ready(ada, "robot/a", "radio/r")
    await lab.ready(bob, "robot/a", "radio/r")
    loads: dict[str, LoadReport] = {}
    ada.mesh.subscribe(ada.mesh.keys.load_any, LoadReport, lambda _key, load: loads.update({load.host: load}))

    async def seen() -> dict[str, LoadReport]:
        return loads

    before = lab.fleet_file.read_text()
    removed = before.replace('client = ["bob", "eve"]', 'client = ["eve"]')
    lab.fleet_file.write_text(f"{removed}[quotas.bob]\narcs = 1\n")
    lab.signal("anvil", signal.SIGHUP)
    await awaited(seen, lambda loads: "anvil" in loads and loads["anvil"].fault)
    assert "fleet.toml: quotas.bob: " in loads["anvil"].fault
    removing = asyncio.Event()

    async def survey() -> None:
        async with hold(bob, "survey", {"robot/a": {}}):
            removing.set()
            await asyncio.sleep(HANG)

    surveying = asyncio.create_task(survey())
    await removing.wait()
    done = await lab.zscout("status", env=env_of(lab, "ada") | {"ZSCOUT_FLEET": str(sound(lab, before))})
    assert "anvil uses older settings" in done.stdout
    lab.fleet_file.write_text(f"{removed}[quotas.eve]\narcs = 1\n")
    lab.signal("anvil", signal.SIGHUP)
    with pytest.raises(Revoked, match="the fleet file, which names its owner under no role"):
        await surveying
    await awaited(seen, lambda loads: not loads["anvil"].fault)
    await awaited(seen, lambda loads: "cart" in loads and loads["cart"].rights != loads["anvil"].rights)
    done = await lab.zscout("status", env=env_of(lab, "ada"))
    assert "cart: enforces other roles than this fleet file" in done.stdout
    lab.signal("cart", signal.SIGHUP)
    await awaited(seen, lambda loads: loads["cart"].rights == loads["anvil"].rights)


def sound(lab: ClosedLab, text: str) -> Path:
    """A copy of the fleet file."""
    file = lab.folder / "sound.toml"
    file.write_text(text)
    return file


@pytest.mark.slow
async def test_a_persons_program_follows_the_fleet_file(lab: ClosedLab) -> None:
    """Who is named in it later is let in by programs that run."""
    text = lab.fleet_file.read_text()
    lab.fleet_file.write_text(text.replace(', "eve"]', "]"))
    lab.node("anvil", "robot/a")
    ada = await lab.person("ada")
    await lab.ready(ada, "robot/a")
    door = ada.mesh._admission  # type: ignore[attr-defined]

    async def members() -> set[str]:
        return {member.name for member in door.security.members}

    await awaited(members, lambda names: "eve" not in names)
    lab.fleet_file.write_text(text)
    await awaited(members, lambda names: "eve" in names)
    lab.fleet_file.write_text(text + "[nonsense")
    assert HANG
    async with hold(ada, "survey", {"robot/a": {}}):
        pass

"""What the fuzzer has found, each by itself."""

from __future__ import annotations

import asyncio
import json
import logging
import sys
from pathlib import Path
from types import FrameType
from typing import Any

import pytest
from msgspec import structs

from tests.fuzz.fleet import Fleet, in_fleet
from tests.mesh.kit import run, until
from tests.services.rcm.kit import FakeFleet
from zscout.config.fleet import default_fleet
from zscout.keyexpr import Role, Sender, Token
from zscout.messages import RcState, RcView
from zscout.rcm.devices import ExpectedDevices, SeenHome, homes_in
from zscout.services.rcm.inventory import FILE, Inventory
from zscout.testing.memory import MemoryNetwork
from zscout.types import SECOND


def state(**fields: Any) -> bytes:
    said = {"rc": "robot/a", "host": "devices", "instance": "i1", "sharable": False, "term": [1, "rcm"], "seq": 1}
    return json.dumps(said | fields).encode()


@pytest.mark.parametrize("number", ["NaN", "sNaN", "-Infinity", "1e999999", "1E-999999"])
def test_what_is_no_number_is_not_passed_on(number: str) -> None:
    """A leader repeats what RCs say of their parameters: with a NaN nobody could read its state any more."""

    async def story() -> None:
        fleet = FakeFleet()
        fleet.rcm()
        await fleet.joined(fleet.rc("robot/a"))
        transport = fleet.mesh("x", "stranger")._transport
        for bound in (number, "7"):
            parameters = [{"name": "speed", "bound": bound}]
            transport.put(fleet.watcher.keys.rc_state("robot/a"), state(parameters=parameters), RcState)
            await asyncio.sleep(0.1)
            (view,) = (await fleet.state()).rcs
            assert view.parameters is None or str(view.parameters[0].bound) == "7"
        assert view.parameters is not None

    run(story())


def test_an_rc_that_answers_under_anothers_name_takes_nobodys_place() -> None:
    async def story() -> None:
        fleet = FakeFleet()
        rcm = fleet.rcm()
        await fleet.joined(fleet.rc("robot/a"))
        thief = fleet.rc("robot/x", instance="i2")
        thief.name = "robot/a"
        await asyncio.sleep(0.1)
        thief.publish()
        await asyncio.sleep(0.1)
        real = rcm.roster.reported("robot/a")
        assert real is not None
        assert real.instance == "i1"
        assert rcm.roster.reported("robot/x") is None

    run(story())


def test_an_instance_that_was_told_to_stand_by_serves_again() -> None:
    """One forged publication names another instance of radio/r, that does not exist: its leader goes on to mean this
    one, and is to say so."""

    async def story(fleet: Fleet) -> None:
        (leader,) = fleet.leaders
        assert leader.rcm is not None
        said = {"term": leader.rcm.term, "seq": leader.rcm.seq, "prev": leader.rcm.seq, "every": 0.5}
        said |= {"rcs": {"radio/r": []}, "instances": {"radio/r": "forged"}}
        fleet.stranger.put(fleet.stranger.mesh.keys.grants, json.dumps(said).encode())
        await asyncio.sleep(0.1)
        fleet.leave()
        await fleet.serves()

    errors, _ = in_fleet(story)
    assert not errors


def test_a_publication_that_was_never_made_is_believed_for_a_hold_lease() -> None:
    """One of the leader's own term, and of a number far above its own: RCs took all that it published for old."""

    async def story(fleet: Fleet) -> float:
        (leader,) = fleet.leaders
        assert leader.rcm is not None
        said = {"term": leader.rcm.term, "seq": 2**63, "prev": 2**63, "every": 0.5}
        fleet.stranger.put(fleet.stranger.mesh.keys.grants, json.dumps(said).encode())
        await asyncio.sleep(0.1)
        fleet.leave()
        at = leader.mesh.now()
        await fleet.serves()
        await until(lambda: fleet.held is not None and fleet.held.grant in fleet.rcs["robot/b"].holds.held)
        return (leader.mesh.now() - at) / SECOND

    errors, seconds = in_fleet(story)
    assert not errors
    assert seconds < 10


@pytest.mark.parametrize("counter", [2**52 - 1, 2**64])
@pytest.mark.parametrize("witness", ["the leader", "an RC", "a client"])
def test_who_asks_for_the_last_terms_believes_none_beyond_them(witness: str, counter: int) -> None:
    """Who took one for its own could never lead, nor hear anybody, again. The stranger speaks in the name of somebody
    who is seen, and who speaks as well."""

    async def story(fleet: Fleet) -> None:
        (leader,) = fleet.leaders
        assert leader.rcm is not None
        name, keys = leader.rcm.term.rcm, fleet.stranger.mesh.keys
        rc = {"rc": "robot/b", "host": "b", "instance": "x", "sharable": False, "term": [counter, "f"]}
        key, answer = {
            "the leader": (keys.rcm_state, {"term": [counter, name], "seq": 1, "host": "a"}),
            "an RC": (keys.rc_state("robot/b"), rc),
            "a client": (
                keys.requests(client := fleet.clients["victim"].mesh.me),
                {"client": str(client), "requests": [], "term": [counter, "f"]},
            ),
        }[witness]
        fleet.stranger.serve(key, lambda: (json.dumps(answer).encode(), True))
        said = {"term": [2**52 - 1, "f"], "seq": 1, "prev": 1, "every": 0.5}
        fleet.stranger.put(keys.grants, json.dumps(said).encode())
        await asyncio.sleep(3)
        fleet.leave()
        assert max(one.known.counter for one in fleet.candidates) < 100
        assert max(rc.holds.term.counter for rc in fleet.rcs.values()) < 100
        await fleet.serves()

    errors, _ = in_fleet(story)
    assert not errors


def test_an_rc_is_as_sharable_as_it_says_now() -> None:
    """Somebody may have answered in its place as it joined: then it was asked for votes for ever, and gave none."""

    async def story() -> None:
        fleet = FakeFleet()
        fleet.rcm()
        rc = fleet.rc("radio/r", accept=None)
        await fleet.joined(rc)
        rc.sharable = False
        rc.publish()
        await asyncio.sleep(0.1)
        assert (await fleet.client("one").ask("arc", "radio/r")).state == "running"
        assert not rc.proposals

    run(story())


def test_an_instance_that_two_hosts_show_is_that_of_the_first() -> None:
    """The second token that went ended the RCM; one that went made the RC be gone."""

    async def story() -> None:
        fleet = FakeFleet()
        fleet.rcm()
        rc = fleet.rc("robot/a")
        await fleet.joined(rc)
        forged = [fleet.mesh(host, "stranger").alive(Token(host, Role.RC, rc.name, rc.instance)) for host in "xy"]
        await asyncio.sleep(0.1)
        for token in forged:
            token.close()
        await asyncio.sleep(1)
        assert [view.present for view in (await fleet.state()).rcs] == [True]
        rc.token.close()
        await asyncio.sleep(1)
        assert [view.present for view in (await fleet.state()).rcs] == [False]
        assert not fleet.failures

    run(story())


def test_a_host_without_a_name_is_not_remembered() -> None:
    async def story() -> None:
        fleet = FakeFleet()
        rcm = fleet.rcm()
        rc = fleet.rc("robot/a")
        await fleet.joined(rc)
        for leaving in (False, True):
            rc.publisher.put(structs.replace(rc.state(), host="*" * 1_000_000, leaving=leaving))
            await asyncio.sleep(0.1)
        assert [*rcm.inventory.devices._devices["robot/a"].homes] == ["devices"]

    run(story())


def test_a_leaders_list_of_devices_takes_no_more_than_its_length() -> None:
    def calls(number: int) -> int:
        views = [RcView(f"robot/x{count}", True, False, host="h") for count in range(number)]
        devices, called = ExpectedDevices({}), 0

        def count(_frame: FrameType, event: str, _arg: object) -> None:
            nonlocal called
            called += event == "call"

        sys.setprofile(count)
        try:
            devices.remember(homes_in(views), 0)
        finally:
            sys.setprofile(None)
        return called

    few = calls(200)
    assert calls(800) < 6 * few


@pytest.mark.parametrize(
    "content",
    [
        b'{"written":-1e308,"homes":[{"rc":"robot/a","host":"h"}]}',
        b'{"written":1e308,"homes":[{"rc":"robot/a","host":"h","ago":1e9}]}',
        b'{"written":0,"homes":[{"rc":"robot/a","host":"h","parameters":[{"name":"x","bound":"NaN"}]}]}',
        b'{"written":0,"homes":' + b"[" * 100_000,
        b"\xff\0",
        b"",
    ],
)
def test_a_file_of_devices_that_is_none_is_not_used(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, content: bytes
) -> None:
    (tmp_path / FILE).write_bytes(content)

    async def story() -> list[SeenHome]:
        mesh = MemoryNetwork().open("f", Sender("h", "node"))
        return Inventory(mesh, default_fleet(), tmp_path).devices.homes(mesh.now())

    assert run(story()) == []
    (warning,) = caplog.records
    assert warning.levelno == logging.WARNING
    assert "\n" not in warning.getMessage()

"""What is refused at once because it can never start."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from decimal import Decimal
from types import SimpleNamespace
from typing import Any

import pytest

from tests.services.rcm.booked_fleet import do
from tests.services.rcm.kit import FakeFleet, Refusal, fleet_of, grant_of, request
from zscout.mesh import Refused
from zscout.messages import Amounts, Foresee, Foresight, Parameter, Parameters, RcState
from zscout.rcm.device_check import DeviceCheck
from zscout.rcm.devices import ExpectedDevices
from zscout.types import SECOND

RADIO = [
    Parameter("command_rate", "packets/s", Decimal(10), Decimal(5), unless=["packet_size"]),
    Parameter("packet_size", "bytes", default=Decimal(10)),
]
KNOWN: dict[str, Parameters | None] = {
    "radio/rf0": RADIO,
    "radio/rf1": [Parameter("command_rate", bound=Decimal(100))],
    "robot/arm1": [],
    "gpu/old": None,
}


def refusal(*needs: str, waits: bool = False, may_wait: bool = True, params: Mapping[str, float] | None = None) -> str:
    """The code and the text; empty where it is let in."""
    amounts: Amounts = {name: Decimal(str(value)) for name, value in (params or {}).items()}
    wanted, devices = dict.fromkeys(needs, amounts), ExpectedDevices({"anvil": KNOWN})
    for rc, parameters in KNOWN.items():
        devices.report(RcState(rc, "anvil", "1", sharable=False, parameters=parameters))
    nobody: Any = SimpleNamespace(is_known=lambda _: False, reported=lambda _: None)
    try:
        DeviceCheck(devices, nobody, 0).check(0, wanted, waits=waits, may_wait=may_wait)
    except Refused as refused:
        problem = refused.problem
        return f"{problem.code}: {problem.message}" + (f" ({problem.remedy})" if problem.remedy else "")
    return ""


@pytest.mark.parametrize(
    ("need", "params"),
    [
        ("radio/rf0", {}),
        ("radio/rf0", {"command_rate": 10}),
        # Shorter packets: the RC itself has to say.
        ("radio/rf0", {"command_rate": 14, "packet_size": 7}),
        # Who does not say what it knows is asked as before.
        ("gpu/old", {"speed": 1e9}),
        # One of them takes it.
        ("radio/*", {"command_rate": 50}),
        ("*/arm1", {}),
    ],
)
def test_what_may_start_is_let_in(need: str, params: dict[str, float]) -> None:
    assert refusal(need, params=params) == ""


@pytest.mark.parametrize(
    ("need", "params", "words"),
    [
        ("robot/arn1", {}, "unknown_device: unknown device robot/arn1; did you mean robot/arm1?"),
        ("tank/*", {}, "unknown_device: no device matches tank/*"),
        ("radio/rf0", {"command_rate": 50}, "too_much: can never start: command_rate 50 of 10 packets/s at radio/rf0"),
        ("radio/*", {"command_rate": 101}, "too_much: can never start: command_rate 101 of 10"),
        ("radio/rf0", {"comand_rate": 5}, "unknown_parameter: radio/rf0 has no parameter comand_rate; did you mean"),
        ("radio/rf0", {"x": 5}, "unknown_parameter: radio/rf0 has no parameter x; it has command_rate, packet_size"),
        ("robot/arm1", {"speed": 1}, "unknown_parameter: robot/arm1 has no parameter speed; it has none"),
    ],
)
def test_what_can_never_start_is_refused_with_what_to_mend(need: str, params: dict[str, float], words: str) -> None:
    assert refusal(need, params=params).startswith(words)


@pytest.mark.parametrize(
    ("needs", "words"),
    [
        (["radio/*", "radio/*#2"], ""),
        (["radio/*", "robot/arm1"], ""),
        (
            ["radio/*", "radio/*#2", "radio/*#3"],
            "unknown_device: 3 devices that match radio/* are requested, but only radio/rf0, radio/rf1 can be used",
        ),
        (["robot/*", "robot/arm1"], "unknown_device: robot/* is requested, but none but those you named"),
        (["tank/*"], "unknown_device: no device matches tank/*"),
    ],
)
def test_more_of_a_pattern_than_the_fleet_knows_of_is_refused(needs: list[str], words: str) -> None:
    refused = refusal(*needs, may_wait=False)
    assert refused.startswith(words)
    assert bool(refused) is bool(words)
    may_wait = refusal(*needs)
    assert may_wait.startswith(words)
    assert may_wait.endswith(" (wait_for_device)") is bool(words)
    assert "wait_for_device" not in refused
    assert refusal(*needs, waits=True) == ""


def test_who_waits_for_a_device_is_still_told_of_bad_parameters() -> None:
    assert refusal("robot/nowhere", waits=True) == ""
    assert refusal("radio/rf0", waits=True, params={"command_rate": 11}).startswith("too_much")


async def test_the_leader_refuses_what_it_knows_only_to_who_asks_for_that() -> None:
    fleet = FakeFleet()
    fleet.rcm()
    await fleet.joined(fleet.rc("radio/rf0", parameters=RADIO), fleet.rc("robot/arm1"))
    client = fleet.client("one")
    with pytest.raises(Refusal, match="too_much: can never start: command_rate 50 of 10"):
        await client.ask("much", "radio/rf0:50", check=True)
    # A foreign client is queued, as ever: by a veto here.
    assert (await client.ask("foreign", "radio/rf0:50")).state == "running"
    # So soon it may not know all devices yet.
    assert (await client.ask("early", "robot/arn1", check=True)).state == "queued"
    assert (await client.ask("early", "robot/arn1")).state == "queued"
    await asyncio.sleep(fleet.fleet.timing.hold_lease / SECOND)
    with pytest.raises(Refusal, match="unknown_device: unknown device robot/arn1; did you mean robot/arm1"):
        await client.ask("early", "robot/arn1")
    with pytest.raises(Refusal, match="unknown_device: unknown device robot/arn2; did you mean robot/arm1"):
        await client.ask("typo", "robot/arn2", check=True)
    assert (await client.ask("patient", "robot/arn2", check=True, wait_for_device=True)).state == "queued"
    again = await client.ask("patient", "robot/arn2", check=True)
    assert again.state == "queued", "an open request is only told how it stands"
    # What carries a place was let in by an RCM before.
    placed = request("placed", "robot/arn3", check=True, place=again.place)
    assert (await client.do(placed)).state == "queued"
    assert grant_of(await client.ask("arm", "robot/arm1", check=True)).seq

    with pytest.raises(Refusal, match="unknown_device"):
        await do(client, Foresee("f", "dry", {"robot/arn2": {}}, 0, Decimal(1), check=True), Foresight)


async def test_more_of_a_pattern_than_the_fleet_knows_of_is_refused_at_the_first_asking() -> None:
    fleet, (rc, _) = await fleet_of("robot/arm1", "robot/arm2")
    client = fleet.client("one")
    three = "robot/*", "robot/*#2", "robot/*#3"
    assert (await client.ask("early", *three, check=True)).state == "queued", "it may not know all devices yet"
    await asyncio.sleep(fleet.fleet.timing.hold_lease / SECOND)
    fleet.network.kill(rc.mesh)
    await asyncio.sleep(2)
    with pytest.raises(Refusal, match=r"unknown_device: 3 devices that match .* but only robot/arm1, robot/arm2 can"):
        await client.ask("three", *three, check=True)
    assert (await client.ask("two", *three[:2], check=True)).state == "queued", "an absent device counts"
    assert (await client.ask("foreign", *three)).state == "queued"
    assert (await client.ask("patient", *three, check=True, wait_for_device=True)).state == "queued"


async def test_a_device_that_went_is_waited_for() -> None:
    fleet, (rc,) = await fleet_of("robot/arm1")
    client = fleet.client("one")
    await asyncio.sleep(fleet.fleet.timing.hold_lease / SECOND)
    fleet.network.kill(rc.mesh)
    await asyncio.sleep(2)
    notice = await client.ask("patient", "robot/arm1", check=True)
    assert (notice.state, notice.reason) == ("queued", "robot/arm1 is lost: the node of devices is gone")
    (view,) = (await fleet.state()).rcs
    assert (view.rc, view.present, view.host, view.reason) == (
        "robot/arm1",
        False,
        "devices",
        "the node of devices is gone",
    )
    assert view.gone == pytest.approx(2, abs=0.1)

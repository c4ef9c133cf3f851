"""`zscout.testing` as the author of a driver, a behavior or a component uses it."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from zscout import CommandRefused, Component, ComponentContext, Revoked, holds
from zscout.messages import Parameter
from zscout.testing import FakeDevice, MemoryFleet, in_virtual_time, until

ECHO = {"name": "echo", "value": 7}


@in_virtual_time
async def test_a_device_begins_obeys_and_is_safe_in_the_end() -> None:
    arm = FakeDevice(answers={"measure": 21.5})
    async with MemoryFleet({"arm/left": arm}) as fleet:
        async with fleet.hold("weigh", {"arm/left": {}}) as held:
            assert await fleet.holder("arm/left") == "weigh"
            assert (await held.command("arm/left", ECHO)).result == 7
            assert (await held.command("arm/left", {"name": "measure"})).result == 21.5
        await until(lambda: arm.calls[-1] == "safe")
        assert await fleet.holder("arm/left") == ""
        assert arm.calls[-4:] == ["echo 7", "measure", "end weigh", "safe"]


@pytest.mark.essential
@in_virtual_time
async def test_minutes_pass_at_once_and_priority_preempts() -> None:
    async with MemoryFleet({"arm/left": FakeDevice()}) as fleet:
        started = asyncio.get_running_loop().time()

        async def survey() -> None:
            async with fleet.hold("survey", {"arm/left": {}}, client="student", min_runtime=1200):
                await asyncio.sleep(1200)

        surveying = asyncio.ensure_future(survey())
        await asyncio.sleep(240)
        async with fleet.hold("rescue", {"arm/left": {}}, priority=5):
            with pytest.raises(Revoked):
                await surveying
        assert asyncio.get_running_loop().time() - started > 240


@in_virtual_time
async def test_a_sharable_device_votes_and_bounds_its_parameters() -> None:
    radio = FakeDevice(sharable=True, parameters=[Parameter("rate", "packets/s")])
    async with (
        MemoryFleet({"radio/rf0": radio}) as fleet,
        fleet.hold("one", {"radio/rf0": {"rate": 1}}, client="one"),
        fleet.hold("other", {"radio/rf0": {"rate": 2}}, client="other"),
    ):
        radio.refuses = "the channel is jammed"
        fleet.rcs["radio/rf0"].rules_changed()
        with pytest.raises(TimeoutError):
            async with fleet.hold("third", {"radio/rf0": {"rate": 3}}, client="third", timeout=30):
                pass


@in_virtual_time
async def test_a_hold_survives_the_leader() -> None:
    async with MemoryFleet({"arm/left": FakeDevice()}, candidates=("anvil", "bellows")) as fleet:
        async with fleet.hold("weigh", {"arm/left": {}}) as held:
            await fleet.kill_leader()
            assert (await held.command("arm/left", ECHO)).result == 7
        with pytest.raises(ValueError, match="two candidates"):
            await fleet.kill_leader()


@in_virtual_time
async def test_a_command_that_fails_is_refused_to_its_holder() -> None:
    arm = FakeDevice()
    arm.fails_on.add("echo")
    async with MemoryFleet({"arm/left": arm}) as fleet, fleet.hold("weigh", {"arm/left": {}}) as held:
        with pytest.raises(CommandRefused):
            await held.command("arm/left", ECHO)


class Survey(Component):
    """The component of docs/components.md."""

    def __init__(self, params: dict[str, Any]) -> None:
        self.done = 0

    async def run(self, context: ComponentContext) -> None:
        async for attempt in holds(context.client, context.component, {"arm/left": {}}):
            async with attempt as held:
                while True:
                    await held.command("arm/left", {"name": "echo", "value": self.done})
                    self.done += 1
                    await context.safe_point()
                    await asyncio.sleep(1)

    def checkpoint(self) -> bytes:
        return str(self.done).encode()

    def restore(self, state: bytes) -> None:
        self.done = int(state)


@in_virtual_time
async def test_a_component_is_checkpointed_and_goes_on_elsewhere() -> None:
    arm = FakeDevice()
    async with MemoryFleet({"arm/left": arm}) as fleet:
        async with fleet.running(Survey({}), "survey") as first:
            await until(lambda: len(arm.commands) == 3)
            state = await first.checkpoint()
            count = len(arm.commands)
        assert state == str(count).encode()
        restored = Survey({})
        restored.restore(state)
        async with fleet.running(restored, "again"):
            await until(lambda: len(arm.commands) == count + 1)
    assert [command["value"] for command in arm.commands] == [*range(count + 1)]


@in_virtual_time
async def test_what_a_component_raises_fails_its_test() -> None:
    class Broken(Component):
        async def run(self, context: ComponentContext) -> None:
            raise RuntimeError("out of paper")

    async with MemoryFleet() as fleet:
        with pytest.raises(RuntimeError, match="out of paper"):
            async with fleet.running(Broken({})) as broken:
                await until(broken.task.done)

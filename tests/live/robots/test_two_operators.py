"""Two operators and one robot: the later one has it and the earlier one is told; they do not take turns."""

from __future__ import annotations

import asyncio

import pytest

from tests.hang import HANG
from tests.live.lab import Lab
from zscout.behaviors.sensor_net.held_robot import RobotNeeds
from zscout.behaviors.teleop import Pilot, Teleop

pytestmark = pytest.mark.live

RCS = ("robot/scout33", "radio/rf0", "video/ch1", "framegrabber/fgrab1")
OFFERED = ("robot/scout33", "radio/rf0:command_rate = 50, packet_size = 1000", "video/ch1:transmitters = 1", RCS[3])
AFTER_A_SLOT = 2.5
"""Seconds: an operator's hold may be displaced by another's after one."""


class Operator:
    def __init__(self, lab: Lab) -> None:
        self.lab, self.told = lab, asyncio.Event()

    async def __aenter__(self) -> Teleop:
        client = await self.lab.client()
        await self.lab.ready(client, *RCS)
        self.teleop = Teleop(client, RobotNeeds(RCS[0]), Pilot(), priority=10, changed=self.told.set)
        self.running = asyncio.create_task(self.teleop.run())
        return self.teleop

    async def __aexit__(self, *exc: object) -> None:
        self.running.cancel()
        await asyncio.gather(self.running, return_exceptions=True)

    async def comes_to(self, state: str, why: str = "") -> None:
        async with asyncio.timeout(HANG):
            while self.teleop.state != state or why not in self.teleop.why:
                self.told.clear()
                await self.told.wait()


@pytest.mark.slow
async def test_the_later_operator_keeps_it_and_the_earlier_is_told(lab: Lab) -> None:
    lab.node("a", *OFFERED)
    one, two = Operator(lab), Operator(lab)
    async with one as first, two as second:
        first.take()
        await one.comes_to("driving")
        second.take()
        # Equals wait until the other has had its second, and say for what.
        await two.comes_to("driving")
        await one.comes_to("free", "taken by")
        await asyncio.sleep(AFTER_A_SLOT)
        assert (first.state, second.state) == ("free", "driving")
        # Who wants it again only has to say so.
        first.take()
        await one.comes_to("driving")
        await two.comes_to("free", "taken by")


async def test_who_waits_is_told_for_what(lab: Lab) -> None:
    lab.node("a", *OFFERED[:3])
    operator = Operator(lab)
    operator_rcs = RCS[:3]
    client = await lab.client()
    await lab.ready(client, *operator_rcs)
    teleop = Teleop(client, RobotNeeds(RCS[0]), Pilot(), priority=10, changed=operator.told.set)
    operator.teleop, operator.running = teleop, asyncio.create_task(teleop.run())
    teleop.take()
    await operator.comes_to("waiting", "framegrabber")
    teleop.give_back()
    await operator.comes_to("free")
    await operator.__aexit__()

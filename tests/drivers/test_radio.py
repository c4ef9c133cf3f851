"""A radio on a real mesh: whom it hears, what it and a video channel carry, and how it is lost."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path

import pytest

from tests.drivers.post import GANG, RADIO, TURN, Post, held, is_in, obeyed, robot
from tests.drivers.ptys import PtyLine
from tests.live.bench import answer, comes_to, until
from tests.live.lab import Lab
from zscout.behaviors.client.client import Client, CommandRefused
from zscout.drivers.generic import VideoDriver
from zscout.drivers.packets import CameraPacket, DrivePacket, HaltPacket, StopPacket
from zscout.drivers.radio import RadioDriver

pytestmark = [pytest.mark.live, pytest.mark.real_time]


class Mast(Post):
    """A radio with its line, a robot and three channels, an RCM and a client."""

    async def ready(self, folder: Path) -> Client:
        self.lab.node("a")
        client = await self.lab.client()
        self.line = PtyLine(folder / "tty")
        self.driver = RadioDriver(str(self.line.link), baud=9600, bound=0.25)
        self.radio = await self.rc("mast", "radio/rf0", self.driver)
        self.robot = await self.rc("cart", "robot/r1", robot(1))
        for number in (1, 2, 3):
            await self.rc("mast", f"video/ch{number}", VideoDriver())
        await self.lab.ready(client, "radio/rf0", "robot/r1", "video/ch1", "video/ch3")
        return client


async def test_who_is_heard_by_a_radio_and_what_a_gang_must_have(tmp_path: Path) -> None:
    async with Lab(tmp_path) as lab, Mast(lab) as post:
        client = await post.ready(tmp_path)
        line = post.line
        arc, grant = await held(client, "hide", GANG)

        # Who is heard: the holder, the node of its robot, and for what stops the robot its node alone.
        drive = {"name": "drive", "robot": 1, "left": 1, "right": 1, "lasts": 0.1}
        halt = {"name": "halt", "robot": 1, "rc": "robot/r1"}
        for host, who, do, under, code in (
            ("test", client.mesh.me.client, drive, grant, "done"),
            ("cart", "node", drive, grant, "done"),
            ("cart", "thief", drive, grant, "wrong_client"),
            ("alien", "node", drive, grant, "wrong_client"),
            ("cart", "node", drive, None, "no_grant"),
            ("cart", "node", halt, None, "done"),
            ("cart", "node", halt | {"name": "stop"}, None, "done"),
            ("cart", "node", halt | {"rc": "robot/r2"}, None, "no_grant"),
            ("cart", "node", {"name": "halt", "robot": 1}, None, "no_grant"),
            ("cart", "thief", halt, None, "no_grant"),
            ("alien", "node", halt, None, "no_grant"),
            ("cart", "node", drive | {"robot": 255}, grant, "bad_command"),
            ("cart", "node", {"name": "sing"}, grant, "unknown_command"),
        ):
            assert await post.says(host, who, "radio/rf0", do, under) == code, (host, who, do)
        assert await post.says("cart", "node", "robot/r1", {"name": "stop"}, None) == "no_grant"

        # Another ARC on the radio: this robot is not its own; one without an RC is whoever's.
        other, shared = await held(client, "other", RADIO)
        assert await answer(obeyed(client, "radio/rf0", shared, drive)) == "not_yours"
        assert await answer(obeyed(client, "radio/rf0", shared, drive | {"robot": 77})) == "done"
        since = len(line.heard)
        await client.end(other)
        await line.until(is_in(HaltPacket, 77), since=since)

        await client.end(arc)

        # What a gang must have for a robot to do as it is told.
        for needs, do, word in (
            (
                {"robot/r1": {}},
                TURN,
                "your request holds no radio, so it can't reach the robot; request radio/rf0 as well",
            ),
            ({"robot/r1": {}, **RADIO}, {"name": "camera", "on": True}, "request video/* as well"),
            (GANG | {"video/ch2": {}}, {"name": "camera", "on": True}, "one transmitter"),
            ({"robot/r1": {}, "video/ch3": {}, **RADIO}, {"name": "camera", "on": True}, "no channel for video/ch3"),
        ):
            arc, grant = await held(client, "poor", needs)
            with pytest.raises(CommandRefused, match=re.escape(word)):
                await obeyed(client, "robot/r1", grant, do)
            await client.end(arc)

        # The vote reaches who asks; all of its figures are tried in test_airtime.py.
        fast = {"radio/rf0": {"command_rate": 45}}
        first, _ = await held(client, "first", fast)
        second = await client.request("second", fast, min_runtime=600)
        await comes_to(second, "queued", "radio/rf0 refuses more: its holders would send 90 of 86.4 packets/s")
        await client.end(second)
        await client.end(first)
        assert post.driver.figures()["longest_wait_ms"] > 0
    line.unplug()


async def test_what_a_radio_and_a_channel_carry_and_how_a_radio_is_lost(tmp_path: Path) -> None:
    async with Lab(tmp_path) as lab, Mast(lab) as post:
        client = await post.ready(tmp_path)
        line, driver, radio, r1 = post.line, post.driver, post.radio, post.robot
        arc, grant = await held(client, "hide", GANG)

        # What comes faster than was asked for is replaced by the newest, at the robot or at the radio.
        since = len(line.heard)
        done = await asyncio.gather(
            *(obeyed(client, "robot/r1", grant, TURN | {"left": number / 40, "lasts": 0.2}) for number in range(1, 41))
        )
        # Where this process stood still meanwhile, what follows the newest comes in the same reading.
        last = await line.until(
            lambda packets: any(isinstance(p, DrivePacket) and p.left > 0.99 for p in packets) and packets, since=since
        )
        replaced = sum(answered.result == {"replaced": True} for answered in done)
        assert replaced + driver.figures()["replaced"] >= 40 - sum(isinstance(p, DrivePacket) for p in last)
        # Handed over, the robot goes on driving: no safe state between, and only the heir is obeyed.
        heir, since = await lab.client(), len(line.heard)
        await obeyed(client, "robot/r1", grant, TURN)
        client.internals.pause()
        heir.internals.expect(client.internals.open_requests())
        await client.internals.hand_over_all(heir.mesh.me)
        inherited = await heir.request("hide", GANG, min_runtime=600)
        under = await heir.granted(inherited)
        assert under is not None
        await obeyed(heir, "robot/r1", under, TURN | {"left": 1})
        await line.until(lambda packets: any(isinstance(p, DrivePacket) and p.left == 1 for p in packets), since=since)
        assert not is_in(HaltPacket)(line.packets[since:])
        assert await answer(obeyed(client, "robot/r1", grant, TURN)) == "ended"
        client.internals.resume()
        await heir.end(inherited)

        send, _ = await held(client, "send", {"video/ch1": {}})
        two = await client.request("two", {"video/ch1": {"transmitters": 1}}, min_runtime=600)
        await comes_to(two, "queued", "send transmits on it already; two would spoil each other")
        await held(client, "listen", {"video/ch1": {"transmitters": 0}})
        assert send.state == "running"
        await client.end(two)
        await client.end(send)

        # Unplugged: all who hold it lose it, and the robots that need it are not to be had.
        arc, grant = await held(client, "hide", GANG)
        await obeyed(client, "robot/r1", grant, TURN)
        line.unplug()
        await until(lambda: arc.state == "queued" and radio.health != "ok" and r1.health != "ok")
        assert "was unplugged" in radio.health or "is not there" in radio.health
        assert r1.health.startswith("radio/rf0: ")
        since = len(line.heard)
        line.plug()
        again = await client.granted(arc)
        assert again is not None
        assert again > grant
        await until(lambda: radio.health == r1.health == "ok")
        assert isinstance((await line.until(lambda packets: packets, since=since))[0], HaltPacket)
        await obeyed(client, "robot/r1", again, TURN)
        await line.until(is_in(DrivePacket), since=since)

        # The radio's node goes: the robot can't be stopped, so it is not to be had.
        post.rcs.remove(radio)
        await radio.stop()
        await until(lambda: arc.state == "queued" and r1.health == "radio/rf0 is not offered")
        assert isinstance(line.packets[-1], HaltPacket | StopPacket | CameraPacket)
    line.unplug()

"""Robots driven over a real mesh: robot RC and radio RC on two nodes, packets on a pty."""

from __future__ import annotations

import asyncio
import re
import signal
from collections.abc import Awaitable
from pathlib import Path
from typing import Any

import pytest

from tests.drivers.ptys import PtyLine
from tests.live.bench import answer, comes_to, until
from tests.live.lab import START, Lab
from zscout import clock
from zscout.behaviors.client import Client, CommandRefused
from zscout.behaviors.request import OpenArc
from zscout.drivers.base import Driver, ResourceController
from zscout.drivers.radio import RadioDriver
from zscout.drivers.robot import RobotDriver
from zscout.drivers.video import VideoDriver
from zscout.keyexpr import Sender
from zscout.mesh import Mesh
from zscout.messages import Command, Done
from zscout.packets import Camera, Drive, Halt, Packet, Stop
from zscout.scheduling.model import SECOND, Grant, Ns
from zscout.stall import StallWatch

pytestmark = pytest.mark.live

RADIO = {"radio/rf0": {"command_rate": 10}}
GANG: dict[str, Any] = {"robot/r1": {}, "video/ch1": {}, **RADIO}
TURN = {"name": "drive", "left": 0.5, "right": -0.5, "lasts": 5}


def mast(lab: Lab, line: PtyLine, *, host: str = "mast") -> None:
    lab.node(
        host,
        extra=f"""
        [[rc]]
        name = "radio/rf0"
        driver = "radio"
        port = "{line.link}"
        [[rc]]
        name = "video/ch1"
        driver = "video"
        [[rc]]
        name = "video/ch2"
        driver = "video"
        [[rc]]
        name = "video/ch3"
        driver = "video"
        """,
    )


def cart(lab: Lab, host: str, robot: int, **how: float) -> None:
    lab.node(
        host,
        extra=f"""candidate = false
        [[rc]]
        name = "robot/r{robot}"
        driver = "robot"
        id = {robot}
        radio = "radio/rf0"
        channels = {{ "video/ch1" = 1, "video/ch2" = 7 }}
        {chr(10).join(f"{key} = {value}" for key, value in how.items())}
        """,
    )


async def held(client: Client, name: str, needs: dict[str, Any], **how: Any) -> tuple[OpenArc, Grant]:
    arc = await client.request(name, needs, **({"min_runtime": 600} | how))
    grant = await client.granted(arc)
    assert grant is not None
    return arc, grant


def is_in(kind: type[Packet], robot: int = 1) -> Any:
    """The first such packet to a robot, if there is one."""
    return lambda packets: next(
        (packet for packet in packets if isinstance(packet, kind) and packet.robot == robot), None
    )


def test_a_robot_is_driven_only_by_its_holder_and_stops_whenever_nobody_drives_it(tmp_path: Path) -> None:
    async def story() -> None:
        line = PtyLine(tmp_path / "tty")
        async with Lab(tmp_path) as lab:
            mast(lab, line)
            cart(lab, "cart", 1)
            brief = asyncio.create_task(lab.holder("brief"))
            client = await lab.client()
            await lab.ready(client, "robot/r1", "radio/rf0", "video/ch1")
            # Nobody knows what it did before: it was halted first.
            assert isinstance(line.packets[0], Halt)

            def drive(grant: Grant, **how: Any) -> Any:
                return client.command("robot/r1", grant, TURN | how)

            async def driving(order: Awaitable[Any]) -> int:
                """Waits until the robot drives by this order; what it hears from then on has this number."""
                since = len(line.heard)
                await order
                await line.until(is_in(Drive), since=since)
                return len(line.heard)

            assert await answer(drive(Grant((await lab.state(client, lambda _: True)).term, 0))) == "free"
            arc, grant = await held(client, "hide", GANG)
            since = len(line.heard)
            done = await drive(grant, lasts=0.3)
            assert 0 < done.result["after"] < 1
            packet = await line.until(is_in(Drive), since=since)
            assert (packet.left, packet.right, packet.lasts) == (
                pytest.approx(0.5, abs=0.01),
                pytest.approx(-0.5, abs=0.01),
                0.3,
            )
            await client.command("robot/r1", grant, {"name": "camera", "on": True})
            assert (await line.until(is_in(Camera), since=since)).channel == 1
            await client.command("robot/r1", grant, {"name": "camera", "on": False})
            await line.until(lambda packets: [p for p in packets if p == Camera(1, p.number, 0)], since=since)

            for do, word in (
                ({"name": "drive", "left": 2, "right": 0, "lasts": 1}, "bad_command"),
                ({"name": "drive", "left": 0, "right": 0, "lasts": 6}, "bad_command"),
                ({"name": "drive", "left": 0, "right": 0, "lasts": 1, "up": 1}, "bad_command"),
                ({"name": "camera"}, "bad_command"),
                ({"name": "halt"}, "unknown_command"),
            ):
                assert await answer(client.command("robot/r1", grant, do)) == word

            # A command that lasts, and no other: the dead man's stop.
            since = len(line.heard)
            began = clock.now()
            await drive(grant)
            await line.until(is_in(Stop), since=since)
            assert clock.now() - began > 0.4 * SECOND
            await client.command("robot/r1", grant, TURN | {"left": 0, "right": 0})

            # The hold ends while it drives.
            since = await driving(client.command("robot/r1", grant, TURN))
            began = clock.now()
            await client.end(arc)
            await line.until(is_in(Halt), since=since)
            worst = [("released", line_time(line, Halt, since) - began)]
            assert await answer(drive(grant)) == "ended"

            # Taken over while it drives.
            again, grant = await held(client, "patrol", GANG)
            operator = await lab.client()
            since = await driving(client.command("robot/r1", grant, TURN))
            began = clock.now()
            over, his = await held(operator, "operator", GANG, priority=10)
            await line.until(is_in(Halt), since=since)
            worst.append(("preempted", line_time(line, Halt, since) - began))
            assert await answer(drive(grant)) == "ended"
            # What was said of the halt again does not stop whoever drives next.
            since = await driving(operator.command("robot/r1", his, TURN))
            await line.until(is_in(Stop), since=since)
            assert Halt not in {type(packet) for packet in line.packets[since:]}
            await operator.end(over)

            # Its client is killed while it drives: the RCM sees that, and the RC is told.
            holder = await brief
            await holder.order("ask", arc="brief", needs=GANG, priority=5, min_runtime=600)
            await holder.event("entered")
            since = await driving(holder.order("command", rc="robot/r1", do=TURN))
            began = holder.kill()
            await line.until(is_in(Halt), since=since)
            worst.append(("client killed", line_time(line, Halt, since) - began))

            # The robot's node is killed while it drives: its radio halts what was driven under the hold.
            patrol = await client.granted(again)
            assert patrol is not None
            since = await driving(client.command("robot/r1", patrol, TURN))
            figures = (await lab.rc(client, "robot/r1")).figures
            assert figures["commands"] >= 5
            assert figures["halts"] >= 3
            began = lab.signal("cart", signal.SIGKILL)
            await line.until(is_in(Halt), since=since)
            worst.append(("robot's node killed", line_time(line, Halt, since) - began))
        for how, wait in worst:
            print(f"{how}: {wait / 1e6:.1f} ms until the halt is through the line")
        # The hold lease and the mesh's are seconds; nothing here waits for the former.
        assert max(wait for _, wait in worst) < START * SECOND
        line.unplug()

    asyncio.run(asyncio.wait_for(story(), START))


def line_time(line: PtyLine, kind: type[Packet], since: int) -> Ns:
    return next(at for at, packet in line.heard[since:] if isinstance(packet, kind))


class Post:
    """Drivers in the test's own process, each host with a session of its own, and an RCM on another."""

    def __init__(self, lab: Lab) -> None:
        self.lab = lab
        self.meshes: dict[str, Mesh] = {}
        self.rcs: list[ResourceController] = []
        self.stall = StallWatch()

    async def mesh(self, host: str, client: str = "node") -> Mesh:
        name = f"{host}/{client}"
        if name not in self.meshes:
            fleet = self.lab.fleet
            self.meshes[name] = await Mesh.open(fleet.name, Sender(host, client), fleet.mesh)
        return self.meshes[name]

    async def rc(self, host: str, name: str, driver: Driver) -> ResourceController:
        lease = self.lab.fleet.timing.hold_lease / SECOND
        rc = ResourceController(await self.mesh(host), name, driver, hold_lease=lease, stall=self.stall)
        self.rcs.append(rc)
        await rc.start()
        return rc

    async def says(self, host: str, client: str, rc: str, do: dict[str, Any], grant: Grant | None) -> str:
        """The code of what an RC answers to this sender, or `done`."""
        mesh = await self.mesh(host, client)
        key = mesh.keys.command(rc, mesh.me)
        reply = None
        async with asyncio.timeout(START):
            while reply is None:  # a new session takes a moment to find the others
                reply = await mesh.ask_one(key, Command(do=do, grant=grant), Done, timeout=1)
        return "done" if reply.problem is None else reply.problem.code

    async def __aenter__(self) -> Post:
        self.stall.start()
        return self

    async def __aexit__(self, *exc: object) -> None:
        for rc in reversed(self.rcs):
            await rc.stop()
        self.stall.stop()
        for mesh in self.meshes.values():
            await mesh.close()


def robot(number: int) -> RobotDriver:
    channels = {"video/ch1": 1, "video/ch2": 7}
    return RobotDriver(number, radio="radio/rf0", channels=channels, warm_up=0.0, dead_man=0.5)


def test_who_is_heard_by_a_radio_and_what_a_radio_and_a_channel_carry(tmp_path: Path) -> None:
    async def story() -> None:
        line = PtyLine(tmp_path / "tty")
        async with Lab(tmp_path) as lab, Post(lab) as post:
            lab.node("a")
            client = await lab.client()
            driver = RadioDriver(str(line.link), baud=9600, bound=0.25)
            radio = await post.rc("mast", "radio/rf0", driver)
            r1 = await post.rc("cart", "robot/r1", robot(1))
            for number in (1, 2, 3):
                await post.rc("mast", f"video/ch{number}", VideoDriver())
            await lab.ready(client, "radio/rf0", "robot/r1", "video/ch1", "video/ch3")
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
            assert await answer(client.command("radio/rf0", shared, drive)) == "not_yours"
            assert await answer(client.command("radio/rf0", shared, drive | {"robot": 77})) == "done"
            since = len(line.heard)
            await client.end(other)
            await line.until(is_in(Halt, 77), since=since)

            # What comes faster than was asked for is replaced by the newest, at the robot or at the radio.
            since = len(line.heard)
            done = await asyncio.gather(
                *(
                    client.command("robot/r1", grant, TURN | {"left": number / 40, "lasts": 0.2})
                    for number in range(1, 41)
                )
            )
            last = await line.until(
                lambda packets: (
                    packets and isinstance(packets[-1], Drive) and packets[-1].left > 0.99 and packets
                ),
                since=since,
            )
            replaced = sum(answered.result == {"replaced": True} for answered in done)
            assert replaced + driver.figures()["replaced"] >= 40 - sum(isinstance(p, Drive) for p in last)
            # Handed over, the robot goes on driving: no safe state between, and only the heir is obeyed.
            heir, since = await lab.client(), len(line.heard)
            await client.command("robot/r1", grant, TURN)
            client.pause()
            heir.expect(client.open_requests())
            await client.hand_over_all(heir.mesh.me)
            inherited = await heir.request("hide", GANG, min_runtime=600)
            under = await heir.granted(inherited)
            assert under is not None
            await heir.command("robot/r1", under, TURN | {"left": 1})
            await line.until(
                lambda packets: any(isinstance(p, Drive) and p.left == 1 for p in packets), since=since
            )
            assert not is_in(Halt)(line.packets[since:])
            assert await answer(client.command("robot/r1", grant, TURN)) == "ended"
            client.resume()
            await heir.end(inherited)

            # What a gang must have for a robot to do as it is told.
            for needs, do, word in (
                (
                    {"robot/r1": {}},
                    TURN,
                    "your ARC holds no radio: nothing reaches the robot; ask also for radio/rf0",
                ),
                ({"robot/r1": {}, **RADIO}, {"name": "camera", "on": True}, "ask also for video/*"),
                (GANG | {"video/ch2": {}}, {"name": "camera", "on": True}, "one transmitter"),
                (
                    {"robot/r1": {}, "video/ch3": {}, **RADIO},
                    {"name": "camera", "on": True},
                    "no channel of video/ch3",
                ),
            ):
                arc, grant = await held(client, "poor", needs)
                with pytest.raises(CommandRefused, match=re.escape(word)):
                    await client.command("robot/r1", grant, do)
                await client.end(arc)

            # Votes. Thirteen would each wait for all the others once too long; twelve do not.
            slow = {"radio/rf0": {"command_rate": 5}}
            many = [await held(client, f"s{number}", slow) for number in range(12)]
            for name, params, word in (
                (
                    "late",
                    {"command_rate": 1},
                    "radio/rf0 refuses: a packet could wait 0.267 s, the bound is 0.25 s",
                ),
                (
                    "fast",
                    {"command_rate": 50},
                    "refuses: its holders would send 110 of 86.4 packets/s of 10 bytes",
                ),
                ("vague", {}, "refuses: vague: command_rate is missing"),
            ):
                asked = await client.request(name, {"radio/rf0": params}, min_runtime=600)
                await comes_to(asked, "queued", word)
                await client.end(asked)
            for number in range(100, 105):
                for robot_id, (_, under) in enumerate(many, 100):
                    assert (
                        await answer(
                            client.command(
                                "radio/rf0", under, drive | {"robot": robot_id, "left": (number - 100) / 10}
                            )
                        )
                        == "done"
                    )
            await until(lambda: driver.figures()["waiting"] == 0)
            wait = driver.figures()["longest_wait_ms"]
            print(
                f"twelve holders at 5 packets/s: {wait} ms at most; {line.backlog / 1e6:.1f} ms in the system"
            )
            assert 0 < wait <= 250
            assert line.backlog < SECOND // 4
            for asked, _ in many:
                await client.end(asked)

            send, _ = await held(client, "send", {"video/ch1": {}})
            two = await client.request("two", {"video/ch1": {"transmitters": 1}}, min_runtime=600)
            await comes_to(two, "queued", "send transmits on it already; two would spoil each other")
            await held(client, "listen", {"video/ch1": {"transmitters": 0}})
            assert send.state == "running"
            await client.end(two)
            await client.end(send)

            # Unplugged: all who hold it lose it, and the robots that need it are not to be had.
            arc, grant = await held(client, "hide", GANG)
            await client.command("robot/r1", grant, TURN)
            line.unplug()
            await until(lambda: arc.state == "queued" and radio.health != "ok" and r1.health != "ok")
            assert "was unplugged" in radio.health or "is not there" in radio.health
            assert r1.health.startswith("radio/rf0: ")
            since = len(line.heard)
            line.plug()
            again = await client.granted(arc)
            assert again is not None
            assert again > grant
            assert radio.health == r1.health == "ok"
            assert isinstance((await line.until(lambda packets: packets, since=since))[0], Halt)
            await client.command("robot/r1", again, TURN)
            await line.until(is_in(Drive), since=since)

            # The radio's node goes: the robot can't be stopped, so it is not to be had.
            post.rcs.remove(radio)
            await radio.stop()
            await until(lambda: arc.state == "queued" and r1.health == "radio/rf0 is not there")
            assert isinstance(line.packets[-1], Halt | Stop | Camera)
        line.unplug()

    asyncio.run(asyncio.wait_for(story(), START))

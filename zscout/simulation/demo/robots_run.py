"""`zscout demo robots`: a building, three nodes with its devices, and a placed net.

The demo observes publications only: of the RCM, of behaviors, and robots' true positions."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from zscout.behaviors.client.client import Client
from zscout.behaviors.client.placer_client import PlacerClient
from zscout.behaviors.sensor_net.held_robot import RobotNeeds
from zscout.behaviors.sensor_net.net import HIDDEN, WATCHING
from zscout.behaviors.teleop import Pilot, Teleop, Way
from zscout.mesh import clock
from zscout.messages import BehaviorSaid, BuildingPoses, ComponentSpec, Grants
from zscout.ports import free_port
from zscout.simulation.building.bodies import WARM_UP
from zscout.simulation.building.node_file import RADIO, device_tables, framegrabber_name
from zscout.simulation.demo.runner import BUILDING, HOSTS, DemoRunner
from zscout.types import SECOND, Ns

NET: Final = "place_sensor_net"
BAUD: Final = 1_200  # of the demo's radio: enough for commands of two robots, not of three
BOUND: Final = 0.5  # s that a packet may wait
FRAME_RATE: Final = 10.0  # of the framegrabbers, frames per second of the building
FRAMEGRABBERS: Final = 2
START: Final = 40.0  # s until everything must be present
# Seconds of the building: from the start of the net to the operator's takeover, length of the drive, and least and
# most time that the hidden net is watched (longest if no person walks by).
TAKEOVER: Final = 37.5
DRIVES: Final = 9.0
GUARDS: Final = (15.0, 60.0)
WORST: Final = 150.0  # s of real time after which the demo ends, placed or not
PATROL: Final[tuple[tuple[Way, float], ...]] = (("forward", 2.25), ("left", 1.5), ("forward", 2.25), ("right", 1.5))
"""The operator's keys, each with its seconds of the building."""


@dataclass(slots=True)
class RobotsObserved:
    robots: list[str]
    hidden: set[str] = field(default_factory=set)  # as reported
    truly: set[str] = field(default_factory=set)  # in a dark place, by the building's ground truth
    watching: set[str] = field(default_factory=set)
    placed_at: float | None = None  # s of the demo until all were hidden for the first time
    alerts: int = 0
    grants: int = 0
    preemptions: int = 0
    turns: int = 0  # holds that ended for an ARC of the same rank
    waits: list[float] = field(default_factory=list)  # s from a behavior's "wait" to its next report
    takeover: float | None = None  # s from the operator's key to the robot's first own command
    taken: str = ""
    resumed_after: float | None = None  # s from the operator's release until the robot's behavior resumed
    doing: dict[str, str] = field(default_factory=dict)  # reported activity by robot
    simulated: float = 0.0  # s of the building

    def summary(self) -> dict[str, Any]:
        waits = sorted(self.waits)
        return {
            "robots": len(self.robots),
            "hidden": sorted(self.hidden),
            "truly_dark": sorted(self.truly),
            "placed_after": self.placed_at,
            "alerts": self.alerts,
            "grants": self.grants,
            "turns": self.turns,
            "preemptions": self.preemptions,
            "waits": len(waits),
            "longest_wait": waits[-1] if waits else 0.0,
            "median_wait": waits[len(waits) // 2] if waits else 0.0,
            "takeover": self.takeover,
            "taken": self.taken,
            "resumed_after": self.resumed_after,
            "simulated": self.simulated,
        }


class RobotsDemo(DemoRunner):
    """`zero` is the start of the net."""

    def __init__(
        self,
        folder: Path,
        building: str,
        ids: Mapping[str, int],
        *,
        seed: int,
        speed: float,
        show: Callable[[float, str], None],
        on_live: Callable[[str], Awaitable[None]] | None = None,
    ) -> None:
        """`building` is an argument of `zscout simulate`, `ids` the robots' ids on the air by RC."""
        super().__init__(folder, show, on_live)
        self._ids = ids
        self.robots = list(ids)
        self.seen = RobotsObserved(self.robots)
        self.building, self.seed, self.speed = building, seed, speed
        self.driven: str | None = None  # the robot held by the operator
        self._client: Client | None = None
        self._waiting: dict[str, Ns] = {}
        self._news = asyncio.Event()
        self._returned_at: Ns | None = None

    async def play(self) -> None:
        client = await self._start()
        spec = ComponentSpec("place_sensor_net", {"robots": self.robots, "speed": self.speed})
        self.zero = clock.now()
        placer = PlacerClient(client.mesh)
        await placer.place(NET, spec)
        operator = asyncio.create_task(self._operator(client))
        try:
            with suppress(TimeoutError):
                async with asyncio.timeout(WORST):
                    await self._all_hidden()
                    await operator
                    await self._all_hidden()
                    await self._guard()
        finally:
            operator.cancel()
            await asyncio.gather(operator, return_exceptions=True)
        self.event("the net is ended, and all nodes with it")
        await placer.stop(NET, wait=5.0)

    async def _all_hidden(self) -> None:
        while len(self.seen.hidden) < len(self.robots):
            self._news.clear()
            await self._news.wait()

    async def _guard(self) -> None:
        """Wait for an alert within the bounds of GUARDS."""
        alerts = self.seen.alerts
        least, most = (seconds / self.speed for seconds in GUARDS)
        await asyncio.sleep(least)
        with suppress(TimeoutError):
            async with asyncio.timeout(most - least):
                while self.seen.alerts == alerts:
                    self._news.clear()
                    await self._news.wait()

    async def _operator(self, client: Client) -> None:
        await asyncio.sleep(TAKEOVER / self.speed)
        robot = next((name for name in self.robots if self.seen.doing.get(name) not in (None, "wait")), self.robots[0])
        pilot = Pilot(0.5)
        teleop = Teleop(client, RobotNeeds(robot), pilot, priority=client.fleet.operator_priority)
        driving = asyncio.create_task(teleop.run())
        self.seen.taken = self.driven = robot
        self.event(f"an operator takes {robot}")
        try:
            end = clock.now() + round(DRIVES / self.speed * SECOND)
            while clock.now() < end:
                for way, seconds in PATROL:
                    until = clock.now() + round(seconds / self.speed * SECOND)
                    while clock.now() < min(until, end):
                        # A terminal repeats a key held down.
                        pilot.press(clock.now() / SECOND, way)
                        teleop.take()
                        await asyncio.sleep(0.05)
            self.seen.takeover = teleop.takeover
        finally:
            teleop.give_back()
            self.driven = None
            self._returned_at = clock.now()
            self.event(f"the operator gives {robot} back")
            driving.cancel()
            await asyncio.gather(driving, return_exceptions=True)

    async def _start(self) -> Client:
        self.write_fleet()
        port = free_port("127.0.0.1", 0)
        line = self.folder / "radio0"
        await self.start(
            BUILDING,
            [
                *("-m", "zscout.cli.main", "simulate", self.building, "--mesh", "--json"),
                *("--seed", str(self.seed), "--speed", f"{self.speed:g}", "--baud", str(BAUD)),
                *("--http", f"127.0.0.1:{port}", "--radio", str(line), "--loss", "0.02"),
            ],
        )
        await self.start_nodes(self._devices(port, line))
        client = self._client = await Client.connect("demo", fleet=self.fleet(), host="operator")
        mesh, keys = client.mesh, client.mesh.keys
        mesh.subscribe(keys.behavior_any, BehaviorSaid, self._on_behavior)
        mesh.subscribe(keys.grants, Grants, self._on_grants)
        mesh.subscribe(keys.building_poses_any, BuildingPoses, self._on_poses)
        grabbers = [framegrabber_name(number) for number in range(1, FRAMEGRABBERS + 1)]
        there = self.all_there(mesh, *HOSTS, *self.robots, RADIO, *grabbers)
        await self.within(START, there, "the nodes, robots and cameras were not all there")
        return client

    def _devices(self, port: int, line: Path) -> dict[str, str]:
        """Radio and channels are on the first host, robots on the second, framegrabbers on first and third."""
        tables = device_tables(
            port=str(line),
            baud=BAUD,
            bound=BOUND,
            robots=self._ids,
            urls=[f"http://127.0.0.1:{port}/ch{number}" for number in range(1, FRAMEGRABBERS + 1)],
            warm_up=WARM_UP / self.speed,
            rate=FRAME_RATE * self.speed,
            framegrabbers=FRAMEGRABBERS,
        )
        first, second, third = HOSTS
        on_first = "".join([tables.radio, *tables.videos, tables.framegrabbers[0]])
        return {first: on_first, second: "".join(tables.robots), third: "".join(tables.framegrabbers[1:])}

    async def close(self) -> None:
        if self._client is not None:
            await self._client.close()

    def _on_behavior(self, _key: str, status: BehaviorSaid) -> None:
        if status.robot not in self.robots or not status.path.startswith(f"{NET}/"):
            return
        now, seen, robot = clock.now(), self.seen, status.robot
        before = seen.doing.get(robot)
        if status.doing == "wait":
            self._waiting.setdefault(robot, now)
        elif robot in self._waiting:
            seen.waits.append((now - self._waiting.pop(robot)) / SECOND)
            if robot == seen.taken and self._returned_at is not None and seen.resumed_after is None:
                seen.resumed_after = (now - self._returned_at) / SECOND
                self.event(f"{robot} continues: {status.doing}")
        if status.doing:
            seen.doing[robot] = status.doing
        (seen.watching.add if status.doing in WATCHING else seen.watching.discard)(robot)
        if status.doing in WATCHING | {"hidden"} and robot not in seen.hidden:
            seen.hidden.add(robot)
            found = status.detail.removeprefix("hidden: ") if status.doing == "hidden" else ""
            self.event(f"{robot} is hidden" + (f": {found}" if found else ""))
        elif status.doing not in HIDDEN | {"wait", ""} and robot in seen.hidden:
            seen.hidden.discard(robot)
            self.event(f"{robot} is not hidden any more")
        if len(seen.hidden) == len(self.robots) and seen.placed_at is None:
            seen.placed_at = self.elapsed()
            self.event("all robots are hidden")
        if status.alert:
            seen.alerts += 1
            self.event(f"ALERT: {robot} sees {status.detail}")
        elif status.doing != before and status.doing not in WATCHING | {"", "wait", "hidden"}:
            self.event(f"{robot} {status.doing}" + (f": {status.detail}" if status.detail else ""))
        self._news.set()

    def _on_grants(self, _key: str, grants: Grants) -> None:
        for revoked in grants.revoked:
            if revoked.outcome == "preempted":
                self.seen.preemptions += 1
                self.event(f"{revoked.arc} is {revoked.reason}")
            self.seen.turns += revoked.outcome == "completed"
        self.seen.grants += len({holder.grant for holders in grants.rcs.values() for holder in holders})

    def _on_poses(self, _key: str, poses: BuildingPoses) -> None:
        self.seen.simulated = poses.time
        self.seen.truly = {f"robot/{placed.name}" for placed in poses.robots if placed.hidden} & set(self.robots)

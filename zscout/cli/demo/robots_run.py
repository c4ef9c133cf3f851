"""The processes of `zscout demo robots`: a building, three nodes with its devices, and a net that is placed.

What happens is followed as anybody on the mesh may: what the RCM publishes, what behaviors say, and, because
the building is a simulated one, where its robots truly stand.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from zscout import clock
from zscout.behaviors import placing
from zscout.behaviors.client import Client
from zscout.behaviors.piloting import Pilot, Way
from zscout.behaviors.sensor_net.held_robot import RobotNeeds
from zscout.behaviors.teleop import Teleop
from zscout.cli.demo.processes import BUILDING, HOSTS, Processes, free_ports
from zscout.config import load_fleet
from zscout.keyexpr import Role, Token
from zscout.mesh import Declared
from zscout.messages import BehaviorSaid, BuildingPoses, ComponentSpec, Grants
from zscout.scheduling.model import SECOND, Ns

NET: Final = "place_sensor_net"
RADIO: Final = "radio/rf0"
BAUD: Final = 1_200
"""Of the demo's radio: room for the commands of two robots, not for those of three."""
FRAMEGRABBERS: Final = 2
START: Final = 40.0
"""Seconds within which everything must be there."""
TAKEOVER: Final = 37.5
"""Seconds of the building from the beginning of the net to the operator's takeover."""
DRIVES: Final = 9.0
"""Seconds of the building that the operator drives."""
GUARDS: Final = (15.0, 60.0)
"""Seconds of the building that the net is watched once all are hidden: at least, and at most if nobody
walks by."""
WORST: Final = 150.0
"""Seconds of ours after which the demo ends, placed or not."""
PATROL: Final[tuple[tuple[Way, float], ...]] = (
    ("forward", 2.25),
    ("left", 1.5),
    ("forward", 2.25),
    ("right", 1.5),
)
"""What the operator does, in seconds of the building."""


@dataclass(slots=True)
class Seen:
    """What the demo saw."""

    robots: list[str]
    hidden: set[str] = field(default_factory=set)
    """That say so."""
    truly: set[str] = field(default_factory=set)
    """That truly stand in the dark, as the building knows."""
    watching: set[str] = field(default_factory=set)
    placed_at: float | None = None
    """When all were hidden for the first time, in seconds of the demo."""
    alerts: int = 0
    grants: int = 0
    preemptions: int = 0
    turns: int = 0
    """Holds that ended because another of the same rank had its turn."""
    waits: list[float] = field(default_factory=list)
    """Seconds from a behavior's "wait" to its next word."""
    takeover: float | None = None
    """Seconds from the operator's key to the robot's first own command."""
    taken: str = ""
    resumed_after: float | None = None
    """Seconds from the operator's giving back to the robot's behavior going on."""
    doing: dict[str, str] = field(default_factory=dict)
    """By robot: what it says that it does."""
    simulated: float = 0.0
    """Seconds of the building."""


class RobotsDemo:
    """The whole demo. Use as an async context manager: no process is left afterwards.

    `tell(at, text)` gets each event in words, `at` in seconds since the net began."""

    def __init__(
        self,
        folder: Path,
        building: str,
        ids: Mapping[str, int],
        *,
        seed: int,
        speed: float,
        tell: Callable[[float, str], None],
    ) -> None:
        """`building` as `zscout simulate` knows it, `ids` of the robots in it, on the air, by RC."""
        self._ids = ids
        self.robots = list(ids)
        self.seen = Seen(self.robots)
        self.building, self.seed, self.speed = building, seed, speed
        self.zero: Ns | None = None
        self.driven: str | None = None
        """The robot that the operator has now."""
        self._folder = folder
        self._processes = Processes(folder)
        self._tell = tell
        self._client: Client | None = None
        self._declared: list[Declared] = []
        self._waiting: dict[str, Ns] = {}
        self._news = asyncio.Event()
        self._back_at: Ns | None = None

    async def run(self) -> None:
        """Plays it to its end. Raises Failed, MeshError."""
        await self._processes.watched(self._play())

    async def _play(self) -> None:
        await self._start()
        client = self._client
        assert client is not None  # noqa: S101
        spec = ComponentSpec("place_sensor_net", {"robots": self.robots, "speed": self.speed})
        self.zero = clock.now()
        await placing.place(client, NET, spec)
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
        self._say("the net is ended, and all nodes with it")
        await placing.stop(client, NET, wait=5.0)

    async def _all_hidden(self) -> None:
        while len(self.seen.hidden) < len(self.robots):
            self._news.clear()
            await self._news.wait()

    async def _guard(self) -> None:
        """For a while, and until something was alerted."""
        alerts = self.seen.alerts
        least, most = (seconds / self.speed for seconds in GUARDS)
        await asyncio.sleep(least)
        with suppress(TimeoutError):
            async with asyncio.timeout(most - least):
                while self.seen.alerts == alerts:
                    self._news.clear()
                    await self._news.wait()

    async def _operator(self, client: Client) -> None:
        """In the middle of it, a human takes one robot, drives it about and gives it back."""
        await asyncio.sleep(TAKEOVER / self.speed)
        robot = next(
            (one for one in self.robots if self.seen.doing.get(one) not in (None, "wait")), self.robots[0]
        )
        pilot = Pilot(0.5)
        teleop = Teleop(client, RobotNeeds(robot), pilot, priority=client.fleet.operator_priority)
        driving = asyncio.create_task(teleop.run())
        self.seen.taken = self.driven = robot
        self._say(f"an operator takes {robot}")
        try:
            end = clock.now() + round(DRIVES / self.speed * SECOND)
            while clock.now() < end:
                for way, seconds in PATROL:
                    until = clock.now() + round(seconds / self.speed * SECOND)
                    while clock.now() < min(until, end):
                        # As a terminal repeats a key that is held down.
                        pilot.press(clock.now() / SECOND, way)
                        teleop.take()
                        await asyncio.sleep(0.05)
            self.seen.takeover = teleop.takeover
        finally:
            teleop.give_back()
            self.driven = None
            self._back_at = clock.now()
            self._say(f"the operator gives {robot} back")
            driving.cancel()
            await asyncio.gather(driving, return_exceptions=True)

    # Starting

    async def _start(self) -> None:
        """Starts the building and the nodes, and waits until all are there."""
        processes = self._processes
        processes.write_fleet()
        (port,) = free_ports(1)
        line = self._folder / "radio0"
        await processes.start(
            BUILDING,
            [
                *("-m", "zscout.cli.main", "simulate", self.building, "--mesh", "--json"),
                *("--seed", str(self.seed), "--speed", f"{self.speed:g}", "--baud", str(BAUD)),
                *("--http", f"127.0.0.1:{port}", "--radio", str(line), "--loss", "0.02"),
            ],
        )
        await processes.start_nodes(self._devices(port, line))
        fleet = load_fleet(processes.fleet_file)
        client = self._client = await Client.connect("demo", fleet=fleet, host="operator")
        missing = {Role.RCM, Role.RECORDER, *HOSTS, *self.robots, RADIO}
        missing |= {f"framegrabber/fgrab{number + 1}" for number in range(FRAMEGRABBERS)}
        complete = asyncio.Event()

        def there(token: Token, alive: bool) -> None:
            if alive:
                missing.difference_update(
                    (token.role, token.name, token.host if token.role == Role.NODE else "")
                )
            if not missing:
                complete.set()

        keys = client.mesh.keys
        self._declared = [
            client.mesh.watch(keys.alive_any(), there),
            client.mesh.subscribe(keys.behavior_any, BehaviorSaid, self._on_said),
            client.mesh.subscribe(keys.grants, Grants, self._on_grants),
            client.mesh.subscribe(keys.building_poses_any, BuildingPoses, self._on_poses),
        ]
        await processes.within(START, complete.wait(), "the nodes, robots and cameras were not all there")

    def _devices(self, port: int, line: Path) -> dict[str, str]:
        """The devices' part of the node files, by host: radio and channels on the first, robots on the
        second, framegrabbers on first and third."""
        videos = {f"video/ch{number + 1}": number + 1 for number in range(FRAMEGRABBERS)}
        channels = _table({rc: str(number) for rc, number in videos.items()})
        sources = _table({rc: f'"http://127.0.0.1:{port}/ch{number}"' for rc, number in videos.items()})
        first, second, third = HOSTS
        radio = _rc(RADIO, "radio", port=f'"{line}"', baud=str(BAUD), bound="0.5")
        robots = [
            _rc(
                robot,
                "robot",
                id=str(self._ids[robot]),
                radio=f'"{RADIO}"',
                channels=channels,
                warm_up=f"{2 / self.speed:g}",
            )
            for robot in self.robots
        ]
        grabbers = [
            _rc(
                f"framegrabber/fgrab{number + 1}",
                "framegrabber",
                sources=sources,
                rate=f"{10 * self.speed:g}",
            )
            for number in range(FRAMEGRABBERS)
        ]
        return {
            first: radio + "".join(_rc(rc, "video") for rc in videos) + grabbers[0],
            second: "".join(robots),
            third: "".join(grabbers[1:]),
        }

    # What is seen

    def _on_said(self, _key: str, said: BehaviorSaid) -> None:
        if said.robot not in self.robots or not said.path.startswith(f"{NET}/"):
            return
        now, seen, robot = clock.now(), self.seen, said.robot
        before = seen.doing.get(robot)
        if said.doing == "wait":
            self._waiting.setdefault(robot, now)
        elif robot in self._waiting:
            seen.waits.append((now - self._waiting.pop(robot)) / SECOND)
            if robot == seen.taken and self._back_at is not None and seen.resumed_after is None:
                seen.resumed_after = (now - self._back_at) / SECOND
                self._say(f"{robot} goes on: {said.doing}")
        if said.doing:
            seen.doing[robot] = said.doing
        (seen.watching.add if said.doing in ("watch", "alert") else seen.watching.discard)(robot)
        if said.doing in ("hidden", "watch", "alert") and robot not in seen.hidden:
            seen.hidden.add(robot)
            found = said.detail.removeprefix("hidden: ") if said.doing == "hidden" else ""
            self._say(f"{robot} is hidden" + (f": {found}" if found else ""))
        elif said.doing not in ("hidden", "watch", "alert", "blind", "wait", "") and robot in seen.hidden:
            seen.hidden.discard(robot)
            self._say(f"{robot} is not hidden any more")
        if len(seen.hidden) == len(self.robots) and seen.placed_at is None:
            seen.placed_at = self._elapsed()
            self._say("all robots are hidden")
        if said.alert:
            seen.alerts += 1
            self._say(f"ALERT: {robot} sees {said.detail}")
        elif said.doing != before and said.doing not in ("", "wait", "watch", "alert", "hidden"):
            self._say(f"{robot} {said.doing}" + (f": {said.detail}" if said.detail else ""))
        self._news.set()

    def _on_grants(self, _key: str, said: Grants) -> None:
        for revoked in said.revoked:
            if revoked.outcome == "preempted":
                self.seen.preemptions += 1
                self._say(f"{revoked.arc} is {revoked.reason}")
            self.seen.turns += revoked.outcome == "completed"
        self.seen.grants += len({holder.grant for holders in said.rcs.values() for holder in holders})

    def _on_poses(self, _key: str, poses: BuildingPoses) -> None:
        self.seen.simulated = poses.time
        self.seen.truly = {f"robot/{one.name}" for one in poses.robots if one.hidden} & set(self.robots)

    def _elapsed(self) -> float:
        return (clock.now() - self.zero) / SECOND if self.zero is not None else 0.0

    def _say(self, text: str) -> None:
        self._tell(self._elapsed(), text)

    async def __aenter__(self) -> Self:
        await self._processes.__aenter__()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for declared in self._declared:
            declared.close()
        if self._client is not None:
            await self._client.close()
        await self._processes.__aexit__(kind, error, trace)


def _rc(name: str, driver: str, **keys: str) -> str:
    lines = "".join(f"{key} = {value}\n" for key, value in keys.items())
    return f'[[rc]]\nname = "{name}"\ndriver = "{driver}"\n{lines}'


def _table(pairs: dict[str, str]) -> str:
    return "{ " + ", ".join(f'"{key}" = {value}' for key, value in pairs.items()) + " }"

"""`python -m studies frames`: the time from a robot's picture to the resulting motor command, through the mesh, and the
cost of a robot's behavior.

The building, the node with its devices, and each robot's `place_robot` are separate processes. The radio's line goes
through this process: it notes when a packet's bytes come out of the driver's pty, and forwards them. A picture's time
is when the framegrabber had read it. A drive packet results from its robot's newest picture, or from the picture before
if the newest already had a command."""

from __future__ import annotations

import argparse
import asyncio
import bisect
import json
import os
import subprocess
import sys
import tempfile
import tty
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, closing, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import psutil

from benchmarks.loop import run
from benchmarks.stats import Row, Samples, table
from tests.hang import HANG
from tests.live.lab import Lab
from tests.live.placing import Placing
from zscout.behaviors.client.client import Client
from zscout.drivers.packets import DrivePacket, PacketDecoder
from zscout.mesh import clock
from zscout.messages import ComponentList, ListComponents
from zscout.types import SECOND

BUILDING: Final = "living_room"
ROBOTS: Final = (33, 35, 37, 39)
FRAME_RATE: Final = 10.0
BAUD: Final = 115_200
"""Fast, so that the line's own time (1.5 ms for two packets) is negligible."""
COMMAND_RATE: Final = 20
"""Above the frame rate: no command waits for its share of the radio."""
AIM: Final = 0.25
"""Aim for the median, as a part of the frame interval."""


class Tap:
    """The radio's line: bytes from the driver's pty are noted with their times, and forwarded to the building's."""

    def __init__(self, port: str) -> None:
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self._slave = slave
        self._building = os.open(port, os.O_WRONLY | os.O_NOCTTY)
        self._decoder = PacketDecoder()
        self.port = os.ttyname(slave)
        self.drives: list[tuple[float, int]] = []
        """Drive packets: time in seconds, and robot."""

    def _read(self) -> None:
        now, data = clock.now() / SECOND, os.read(self._master, 4_096)
        self.drives += [(now, packet.robot) for packet in self._decoder.feed(data) if isinstance(packet, DrivePacket)]
        os.write(self._building, data)

    def __enter__(self) -> Self:
        asyncio.get_running_loop().add_reader(self._master, self._read)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        asyncio.get_running_loop().remove_reader(self._master)
        for descriptor in (self._master, self._slave, self._building):
            os.close(descriptor)


class Pictures:
    """The times when each robot's pictures were read."""

    def __init__(self, lab: Lab, client: Client, count: int) -> None:
        self._lab, self._client = lab, client
        self.read: dict[int, list[float]] = {robot: [] for robot in ROBOTS}
        self._tasks = [asyncio.create_task(self._follow(f"framegrabber/fgrab{number + 1}")) for number in range(count)]

    async def _follow(self, framegrabber: str) -> None:
        robots: dict[Any, int] = {}
        with closing(self._client.mesh.frames(self._client.mesh.keys.frame(framegrabber))) as frames:
            while True:
                frame = await frames.next(1.0)
                if frame is None or frame.head.grant is None:
                    continue
                grant = frame.head.grant
                if grant not in robots:
                    for holder in (await self._lab.rc(self._client, framegrabber)).holders:
                        robot = next(rc for rc in holder.rcs if rc.startswith("robot/"))
                        robots[holder.grant] = int(robot.removeprefix("robot/scout"))
                if grant in robots:
                    self.read[robots[grant]].append(frame.head.time)

    async def close(self) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)


def latencies(pictures: list[float], drives: list[float]) -> list[float]:
    """Seconds from a picture to the resulting drive packet, for each packet. Both lists are in order."""
    found, used = [], -1
    for at in drives:
        newest = bisect.bisect_left(pictures, at) - 1
        # A behavior acts once on a picture: if the newest already had its command, this packet was late.
        number = newest - 1 if newest == used else newest
        if number >= 0:
            found.append(at - pictures[number])
        used = newest
    return found


@asynccontextmanager
async def building(folder: Path, robots: int) -> AsyncIterator[tuple[dict[str, Any], str]]:
    """The output of `zscout simulate`, and the node file that it wrote."""
    node = folder / "devices.toml"
    command = [sys.executable, "-m", "zscout.cli.main", "simulate", BUILDING, "--json", "--seed", "1"]
    command += ["--baud", str(BAUD), "--channels", str(robots), "--framegrabbers", str(robots)]
    command += ["--frames", f"{FRAME_RATE:g}", "--node", str(node)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)  # noqa: ASYNC220 - it is a moment
    assert process.stdout is not None
    try:
        output = json.loads(await asyncio.to_thread(process.stdout.readline))
        yield output, node.read_text()
    finally:
        process.terminate()
        await asyncio.to_thread(process.wait)
        process.stdout.close()


async def of_robots(folder: Path, robots: int, seconds: float) -> list[Row]:
    """Rows for this number of robots at once, measured over `seconds`."""
    ids = ROBOTS[:robots]
    async with building(folder, robots) as (output, devices), Lab(folder) as lab:
        with Tap(output["radio"]["port"]) as tap:
            tables = devices.partition("[[rc]]")[2]
            lab.node("lab", extra=f"[[rc]]{tables}".replace(output["radio"]["port"], tap.port))
            client = await lab.client()
            placing = Placing(client)
            await lab.ready(client, "radio/rf0", f"framegrabber/fgrab{robots}", f"robot/scout{ids[-1]}")
            for robot in ids:
                params = {"robot": f"robot/scout{robot}", "command_rate": COMMAND_RATE}
                await placing.place(f"place{robot}", "place_robot", params)
            pictures = Pictures(lab, client, robots)
            async with asyncio.timeout(2 * HANG):
                while {robot for _, robot in tap.drives} < set(ids):  # noqa: ASYNC110 - in other processes
                    await asyncio.sleep(0.05)
            listed = await placing.get(ListComponents(), ComponentList, "lab")
            behaviors = [psutil.Process(view.pid) for view in listed.components if view.pid]
            node = psutil.Process(lab.nodes["lab"].pid)
            begin, before = clock.now() / SECOND, (spent(behaviors), spent([node]))
            await asyncio.sleep(seconds)
            end = clock.now() / SECOND
            shares = [
                100 * (now - then) / (end - begin) / robots
                for now, then in zip((spent(behaviors), spent([node])), before, strict=True)
            ]
            await pictures.close()
    samples, frames = Samples(), 0
    for robot in ids:
        read = pictures.read[robot]
        frames += sum(begin <= at < end for at in read)
        for took in latencies(read, [at for at, who in tap.drives if who == robot and begin <= at < end]):
            samples.add(took)
    return rows_of(robots, samples, frames / (end - begin) / robots, shares)


def rows_of(robots: int, samples: Samples, rate: float, shares: list[float]) -> list[Row]:
    who = "1 robot" if robots == 1 else f"{robots} robots"
    ratio = samples.median * FRAME_RATE
    return [
        Row(
            f"{who}: picture to motor command",
            samples.median * 1e3,
            "ms",
            samples.p99 * 1e3,
            ratio,
            "frame interval",
            AIM,
            rounds=len(samples.values),
        ),
        Row(f"{who}: pictures, each", rate, "frames/s"),
        Row(f"{who}: CPU of a behavior", shares[0], "% of a core"),
        Row(f"{who}: CPU of the devices' node, per robot", shares[1], "% of a core"),
    ]


def spent(processes: list[psutil.Process]) -> float:
    """In seconds."""
    total = 0.0
    for process in processes:
        with suppress(psutil.NoSuchProcess):
            times = process.cpu_times()
            total += float(times.user + times.system)
    return total


async def measure(seconds: float, progress: Callable[[str], None], counts: tuple[int, ...] = (1, 2, 4)) -> list[Row]:
    """All rows. `progress` is called with the name of the next measurement."""
    rows: list[Row] = []
    for robots in counts:
        progress(f"pictures to motor commands: {robots} of {len(ROBOTS)} robots")
        with tempfile.TemporaryDirectory(prefix="zscout-bench-") as name:
            rows += await of_robots(Path(name), robots, seconds)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m studies frames", description=__doc__)
    parser.add_argument("--robots", type=int, choices=(1, 2, 3, 4), help="only this number (default: 1, 2 and 4)")
    parser.add_argument("--seconds", type=float, default=30.0, help="duration of a measurement (default: 30)")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    args = parser.parse_args()
    load = os.getloadavg()[0]
    counts = (args.robots,) if args.robots else (1, 2, 4)
    rows = run(measure(args.seconds, lambda text: print(text, file=sys.stderr, flush=True), counts))
    if args.json:
        print(json.dumps({"building": BUILDING, "rows": [row.as_json() for row in rows]}, indent=2))
        return
    print(table(rows))
    print(f"\n{os.cpu_count()} cores; load average {load:.2f} before, {os.getloadavg()[0]:.2f} after.")

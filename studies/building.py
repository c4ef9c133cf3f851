"""`python -m studies building`: the cost of serving a simulated building, with real readers on its cameras.

The building runs as `zscout simulate` in its own process. Its robots' cameras are switched on over its serial port, and
OpenCV reads the streams here. The processor time of the building's process is compared with the time for only drawing
the same robots' pictures.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import cv2
import psutil
import serial

from benchmarks.stats import Row, table
from zscout.drivers.packets import CameraPacket, DrivePacket, encode
from zscout.simulation.building.plan import Plan
from zscout.simulation.building.plan_file import load_plan, shipped_plans
from zscout.simulation.building.world import World

AIM = 50.0
"""Percent of one core for four robots at 10 frames/s."""
WARM_UP = 3.0
"""Seconds from the cameras' start until they are measured."""
TIMEOUTS = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, 10_000, cv2.CAP_PROP_READ_TIMEOUT_MSEC, 10_000]
BAUD = 9600


class Reader(threading.Thread):
    """Reads a camera's stream like a framegrabber."""

    def __init__(self, url: str) -> None:
        super().__init__(daemon=True)
        self.frames = 0
        self._url = url
        self._ended = threading.Event()

    def run(self) -> None:
        capture = cv2.VideoCapture(self._url, cv2.CAP_FFMPEG, TIMEOUTS)
        while not self._ended.is_set() and capture.read()[0]:
            self.frames += 1
        capture.release()

    def end(self) -> None:
        self._ended.set()
        self.join(10)


@contextmanager
def simulating(building: str, robots: int) -> Iterator[tuple[psutil.Process, dict[str, Any]]]:
    command = [sys.executable, "-m", "zscout.cli.main", "simulate", building, "--json", "--seed", "1"]
    command += ["--baud", str(BAUD), "--channels", str(robots)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        yield psutil.Process(process.pid), json.loads(process.stdout.readline())
    finally:
        process.terminate()
        process.wait()


def measure(building: str, robots: int, seconds: float) -> list[Row]:
    plan = load_plan(shipped_plans()[building])
    plan_robots = plan.robots[:robots]
    if len(plan_robots) < robots:
        raise SystemExit(f"{building} has {len(plan.robots)} robots; write --robots {len(plan.robots)} or less")
    bare = bare_picture(plan, robots)
    with ExitStack() as stack:
        process, output = stack.enter_context(simulating(building, robots))
        port = stack.enter_context(serial.Serial(output["radio"]["port"], BAUD, timeout=1, write_timeout=5))
        idle = spent(process, 3.0)
        for number, robot in enumerate(plan_robots):
            port.write(encode(CameraPacket(robot.id, 0, number + 1)))
        readers = [Reader(channel["url"]) for channel in output["channels"]]
        for reader in readers:
            reader.start()
            stack.callback(reader.end)
        time.sleep(WARM_UP)
        before = [reader.frames for reader in readers]
        busy = spent(process, seconds, lambda number: keep_moving(port, plan, robots, number))
        frames = sum(reader.frames for reader in readers) - sum(before)
    again = bare_picture(plan, robots)
    render = statistics.median(bare + again)
    return [
        Row("bare picture, CPU", render * 1e3, "ms", rounds=len(bare + again)),
        Row("building, no readers", idle * 100, "% of a core"),
        Row(f"building, {robots} cameras watched", busy * 100, "% of a core", aim=AIM if robots == 4 else None),
        Row("frames read", frames / seconds, "frames/s", aim=9.5 * robots, at_least=True),
        Row(
            "frame served, CPU",
            busy * seconds / frames * 1e3,
            "ms",
            ratio=busy * seconds / frames / render,
            against="bare picture",
            rounds=frames,
        ),
    ]


def keep_moving(port: serial.Serial, plan: Plan, robots: int, number: int) -> None:
    """Turn each robot on the spot, alternately left and right, so that all pictures differ."""
    for robot in plan.robots[:robots]:
        wheel = 0.2 if number // 10 % 2 else -0.2
        port.write(encode(DrivePacket(robot.id, number % 256, wheel, -wheel, 1.0)))


def spent(process: psutil.Process, seconds: float, meanwhile: Any = None) -> float:
    """The processor time of a process in seconds per second. `meanwhile(n)` is called twice a second."""
    start, begin, number = cpu(process), time.monotonic(), 0
    while time.monotonic() - begin < seconds:
        time.sleep(0.5)
        if meanwhile is not None:
            meanwhile(number := number + 1)
    return (cpu(process) - start) / (time.monotonic() - begin)


def cpu(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


def bare_picture(plan: Plan, robots: int) -> list[float]:
    """Processor seconds for each single picture of the plan's robots."""
    cv2.setNumThreads(1)
    world, took = World(plan, seed=1), []
    names = [robot.name for robot in plan.robots[:robots]]
    for _ in range(40):
        world.step(0.1)
        for name in names:
            world.bodies[name].command(0.2, -0.2, 1.0, world.time)
            start = time.thread_time()
            world.picture(name)
            took.append(time.thread_time() - start)
    return took[robots:]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m studies building", description=__doc__)
    parser.add_argument("--building", default="living_room", choices=list(shipped_plans()))
    parser.add_argument("--robots", type=int, default=4, choices=range(1, 16), metavar="N")
    parser.add_argument("--seconds", type=float, default=20.0, help="duration of the measurement (default: 20)")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    args = parser.parse_args()
    rows = measure(args.building, args.robots, args.seconds)
    if args.json:
        print(json.dumps({"building": args.building, "rows": [row.as_json() for row in rows]}, indent=2))
        return
    print(table(rows))

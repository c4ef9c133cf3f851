"""Costs of whole processes: the duration of `zscout --help`, and CPU and memory of an idle node."""

from __future__ import annotations

import asyncio
import subprocess
import sys
import time
from pathlib import Path

import psutil

from benchmarks.stats import Row, Samples
from tests.live.lab import Lab

IDLE = 10.0
"""Seconds over which idle CPU is measured."""
SETTLED = 3.0
"""Seconds to wait before that, until nodes have started."""
MEGA = 1e6


def help_time(rounds: int) -> list[Row]:
    """Measure `zscout --help` and a Python that does nothing, in turn; the first run of each is a warm-up."""
    zscout = str(Path(sys.executable).with_name("zscout"))
    commands = {"nothing": [sys.executable, "-c", "pass"], "help": [zscout, "--help"]}
    samples = {name: Samples() for name in commands}
    for number in range(-1, rounds):
        for name, command in commands.items():
            start = time.perf_counter()
            subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
            if number >= 0:
                samples[name].add(time.perf_counter() - start)
    asked, nothing = samples["help"], samples["nothing"]
    name = f"zscout --help ({asked.median / nothing.median:.1f} x python -c pass)"
    return [Row(name, asked.median, "s", asked.p99, aim=0.25, rounds=rounds)]


async def idle(lab: Lab) -> list[Row]:
    """Measure memory and CPU of nodes without requests. The recorder, a separate process, is not included."""
    await asyncio.sleep(SETTLED)
    nodes = {host: psutil.Process(process.pid) for host, process in lab.nodes.items()}

    def used() -> dict[str, float]:
        times = {host: node.cpu_times() for host, node in nodes.items()}
        return {host: spent.user + spent.system for host, spent in times.items()}

    before, start = used(), time.monotonic()
    await asyncio.sleep(IDLE)
    seconds = time.monotonic() - start
    shares = {host: (spent - before[host]) / seconds * 100 for host, spent in used().items()}
    leader = "lead"
    others = [host for host in nodes if host != leader]
    memory = {host: node.memory_info().rss / MEGA for host, node in nodes.items()}
    rcs = "6 RCs"
    return [
        Row("idle CPU, node that leads", shares[leader], "% of a core", aim=1.0),
        Row(f"idle CPU, node with {rcs}", max(shares[host] for host in others), "% of a core", aim=1.0),
        Row("RSS, node that leads", memory[leader], "MB", aim=80.0),
        Row(f"RSS, node with {rcs}", max(memory[host] for host in others), "MB", aim=80.0),
    ]


def memory_after(lab: Lab) -> list[Row]:
    """Measure the memory of the same nodes after all other measurements."""
    sizes = [psutil.Process(process.pid).memory_info().rss / MEGA for process in lab.nodes.values()]
    return [Row("RSS, largest node after all rounds", max(sizes), "MB", aim=80.0)]

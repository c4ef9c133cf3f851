"""A node that reports the number of load reports that its balancer received, and its own resource use.

`python -m studies.counted_node NODE_FILE` is a child process (see child.py): a `zscout-node` that counts.
"""

from __future__ import annotations

import asyncio
import functools
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

from benchmarks.child import ready
from benchmarks.loop import run
from zscout.config.node import load_node
from zscout.node import run_node
from zscout.placement.balancer import Balancer


class Count:
    def __init__(self) -> None:
        self.calls = 0

    def of(self, method: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(method)
        def counted(*args: Any) -> None:
            self.calls += 1
            method(*args)

        return counted


async def main(file: Path) -> None:
    stop, count = asyncio.Event(), Count()
    Balancer.reported = count.of(Balancer.reported)  # type: ignore[method-assign]
    task = asyncio.create_task(run_node(load_node(file), stop))
    process = psutil.Process(os.getpid())
    ready()
    while await asyncio.to_thread(sys.stdin.readline):
        spent = process.cpu_times()
        counts = {"reports": count.calls, "cpu": spent.user + spent.system, "memory": process.memory_info().rss}
        print(json.dumps(counts), flush=True)
    stop.set()
    await task


if __name__ == "__main__":
    run(main(Path(sys.argv[1])))

"""`python -m studies publication`: the cost of a publication on `rcm/grants` for its leader, by receiving sessions.

The listeners process it like clients: they keep the latest publication, without waking up. They are child processes
with ten sessions each: `python -m studies.publication listen FLEET_FILE SESSIONS`. Each publication contains a grant of
five RCs, at an even pace. Its cost is the call itself, and the processor time of the publishing process, with Zenoh's
threads, minus its idle use."""

from __future__ import annotations

import argparse
import asyncio
import statistics
import sys
import tempfile
import time
from contextlib import ExitStack
from decimal import Decimal
from pathlib import Path

from benchmarks.child import child, ready
from benchmarks.loop import run
from tests.live.lab import Lab
from zscout.config.fleet import load_fleet
from zscout.keyexpr import Sender
from zscout.mesh import ZenohMesh
from zscout.messages import Grants, Holder
from zscout.types import Grant, Place, Term

SESSIONS = (2, 20, 100)
EACH = 10
"""Sessions of a child process."""
PACE = 0.005
"""Seconds between publications."""
SETTLED = 3.0
TERM = Term(1, "0123456789ab")
RCS = [f"robot/r{number}" for number in range(5)]


async def listen(fleet_file: Path, sessions: int) -> None:
    fleet = load_fleet(fleet_file)
    meshes = [await ZenohMesh.open(fleet, Sender("test", f"l{number}")) for number in range(sessions)]
    kept = [mesh.poll_latest(mesh.keys.grants, Grants) for mesh in meshes]
    ready()
    await asyncio.to_thread(sys.stdin.read)
    for mesh in meshes:
        await mesh.close()
    assert kept


def granted(number: int) -> Grants:
    """Five RCs to one holder."""
    grant = Grant(TERM, number)
    holder = Holder("0123456789ab", "survey", "anvil/c1", grant, Place(TERM, 1), RCS, Decimal(60), 60.0)
    return Grants(TERM, number, number - 1, 0.5, {rc: [holder] for rc in RCS}, [], dict.fromkeys(RCS, "0123456789ab"))


async def measure(sessions: int, count: int) -> tuple[float, float]:
    """Seconds of the call, and of processor time, for a publication."""
    with tempfile.TemporaryDirectory(prefix="zscout-bench-") as name, ExitStack() as stack:
        lab = Lab(Path(name))
        while sessions:
            some = min(EACH, sessions)
            stack.enter_context(child("publication", "listen", str(lab.fleet_file), str(some)))
            sessions -= some
        async with await ZenohMesh.open(lab.fleet, Sender("test", "leader")) as mesh:
            publisher = mesh.publisher(mesh.keys.grants, Grants)
            publisher.put(granted(1))
            await asyncio.sleep(SETTLED)
            idle = time.process_time()
            await asyncio.sleep(count * PACE)
            idle = time.process_time() - idle
            calls, spent = [], time.process_time()
            for number in range(count):
                message, began = granted(number + 2), time.perf_counter()
                publisher.put(message)
                calls.append(time.perf_counter() - began)
                await asyncio.sleep(PACE)
            return statistics.median(calls), (time.process_time() - spent - idle) / count


def main() -> None:
    if sys.argv[1:2] == ["listen"]:
        run(listen(Path(sys.argv[2]), int(sys.argv[3])))
        return
    parser = argparse.ArgumentParser(prog="python -m studies publication", description=__doc__)
    parser.add_argument("--count", type=int, default=1_000, help="publications for each number of sessions")
    asked = parser.parse_args()
    print(f"{'sessions':>8}  {'the call':>10}  {'processor time':>14}")
    for sessions in SESSIONS:
        call, spent = run(measure(sessions, asked.count))
        print(f"{sessions:>8}  {call * 1e6:>7.0f} us  {spent * 1e6:>11.0f} us", flush=True)


if __name__ == "__main__":
    main()

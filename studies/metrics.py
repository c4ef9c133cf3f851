"""`python -m studies metrics`: the cost of Prometheus figures for a node.

A scrape over a real socket, including its client's part: of a small node, and of a node with 64 RCs that leads the
largest fleet with distinct label values. Then the time that counting adds to a grant and its release, after all answers
are sent; and the memory of a real leading node, with and without `[metrics]` and `[notify]`."""

from __future__ import annotations

import asyncio
import tempfile
import time
from collections.abc import AsyncIterator, Sequence
from pathlib import Path

import psutil

from benchmarks.loop import run
from benchmarks.process import MEGA, SETTLED
from benchmarks.stats import Row, Samples, table
from tests.live.lab import Lab
from zscout.config.access import AccessPolicy
from zscout.mesh.exchange import MAX_CODES
from zscout.mesh.supervision import clock
from zscout.scheduling.core import Core
from zscout.scheduling.model import ArcRequest, Event, LeadTaken, RcJoined, Released, Requested
from zscout.services.metrics import server as server_module
from zscout.services.metrics.figures import MAX_RCS, MAX_WAITERS, HoldFigures, Value
from zscout.services.metrics.figures import Samples as Figures
from zscout.services.metrics.server import MetricsServer
from zscout.services.rcm.digest import Began, HoldDigest, HoldListener
from zscout.types import SECOND, Params, RcName, Term

EVERY = 15.0
"""Seconds between scrapes."""
AIM = 0.2
"""Percent of a core."""
OWN = 64
"""Most RCs of a node."""
TABLES = {"neither": "", "[metrics]": "[metrics]", "[notify]": '[notify]\nurls = ["json://127.0.0.1:9/"]'}
"""Tables in the node file for the measurement of memory, by name."""
ASK = b"GET /metrics HTTP/1.1\r\nHost: x\r\n\r\n"


def figures(rcs: int, waiters: int) -> HoldFigures:
    """The figures of a leader with holders of all RCs."""
    found = HoldFigures(AccessPolicy())
    for number in range(max(rcs, waiters)):
        rc = f"robot/scout{number % rcs}"
        request = ArcRequest(f"h/c/{number}", "h/c", {rc: {}}, number % waiters, SECOND)
        found.on_began(Began(request, (rc,), 0, number * SECOND, SECOND))
    return found


async def scrapes(rcs: int, waiters: int, rounds: int) -> tuple[Samples, Samples, int]:
    """Processor seconds of a scrape in this process, seconds for which it blocked the event loop, and its bytes."""
    holds, spent, stood = figures(rcs, waiters), Samples(), Samples()
    commands: dict[tuple[str, ...], Value] = {(f"robot/scout{number}",): 5.0 for number in range(min(rcs, OWN))}
    refused: dict[tuple[str, ...], Value] = {(*rc, f"code_{code}"): 1.0 for rc in commands for code in range(4)}

    def read() -> Figures:
        began = time.perf_counter()
        found: Figures = holds.samples(clock.now(), leading=True)
        found["zscout_commands_total"], found["zscout_commands_refused_total"] = dict(commands), dict(refused)
        found["zscout_refusals_total"] = {(f"code_{code}",): 1 for code in range(MAX_CODES)}
        stood.add(time.perf_counter() - began)
        return found

    server, size = MetricsServer(read, "127.0.0.1", 0), 0
    await server.start()
    for _ in range(rounds):
        before = time.process_time()
        reader, writer = await asyncio.open_connection("127.0.0.1", server.port)
        writer.write(ASK)
        size = len(await reader.read())
        writer.close()
        spent.add(time.process_time() - before)
    await server.stop()
    return spent, stood, size


def instants(listeners: Sequence[HoldListener], rounds: int) -> Samples:
    """Seconds for the request, grant and release of an ARC with five RCs."""
    core, samples = Core(), Samples()
    digest = HoldDigest(core, listeners) if listeners else None
    needs: dict[RcName, Params] = {f"robot/r{number}": {} for number in range(5)}
    core.handle(0, *(RcJoined(rc, sharable=False) for rc in needs), LeadTaken(Term(1, "bench")))
    for number in range(rounds):
        arc, began = f"h/c/{number}", time.perf_counter()
        events: list[Event] = [Requested(ArcRequest(arc, "h/c", needs, 0, 60 * SECOND)), Released(arc)]
        for event in events:
            effects = core.handle(number, event)
            if digest is not None:
                digest.take(number, [event], effects)
        samples.add(time.perf_counter() - began)
    return samples


async def memory() -> AsyncIterator[Row]:
    for name, tables in TABLES.items():
        with tempfile.TemporaryDirectory() as folder:
            async with Lab(Path(folder)) as lab:
                lab.node("anvil", "robot/a", extra=tables)
                await lab.ready(await lab.client(), "robot/a")
                await asyncio.sleep(SETTLED)
                size = psutil.Process(lab.nodes["anvil"].pid).memory_info().rss
        yield Row(f"RSS, leading node, {name}", size / MEGA, "MB")


async def measure() -> list[Row]:
    server_module.FRESH = -1.0  # type: ignore[misc]  # build new figures for each
    rows = []
    for name, rcs, waiters, rounds in (("6 RCs", 6, 3, 300), (f"{MAX_RCS:,} RCs", MAX_RCS, MAX_WAITERS, 30)):
        spent, stood, size = await scrapes(rcs, waiters, rounds)
        rows += [
            Row(
                f"CPU of a scrape, {name}, {size / 1000:.0f} kB",
                spent.median * 1e3,
                "ms",
                spent.p99 * 1e3,
                rounds=rounds,
            ),
            Row(f"one each {EVERY:g} s, {name}", spent.median / EVERY * 100, "% of a core", aim=AIM, rounds=rounds),
            Row(f"event loop reads them, {name}", stood.median * 1e3, "ms", stood.p99 * 1e3, rounds=rounds),
        ]
    without, counted = Samples(), Samples()
    for _ in range(10):
        without.values += instants((), 1_000).values
        counted.values += instants((HoldFigures(AccessPolicy()),), 1_000).values
    added = counted.median - without.median
    rows.append(Row("core: grant and release of 5 RCs", without.median * 1e6, "us", without.p99 * 1e6, rounds=10_000))
    rows.append(Row("counting them, after the answers", added * 1e6, "us", rounds=10_000))
    return rows + [row async for row in memory()]


def main() -> None:
    print(table(run(measure())))

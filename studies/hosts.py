"""`python -m studies hosts`: a balancer with the reports of many hosts, as ratios to a bare query.

The hosts are simulated, but their reports are real: each has its own key and is published once a second by real
sessions. A node leads, and its balancer is asked for the best of all hosts. The number of hosts is doubled until
answers take longer than END bare queries, or reports are lost.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import platform
import random
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import zenoh

from benchmarks import bare
from benchmarks.child import Child, child
from benchmarks.loop import run
from benchmarks.stats import Samples
from tests.hang import HANG
from tests.live.lab import Lab
from zscout import messages
from zscout.behaviors.client.client import Client
from zscout.messages import HostRanking, RankAsk, RankedHost
from zscout.placement.balancer import MAX_HOSTS

HOT = 3
"""Number of repetitions in a row, of which the last counts, as in latency.py."""
PAUSE = 0.03
"""Longest pause in seconds between two rounds, so that they come at random moments of the node's work."""
END = 10.0
QUIET, ASKED = 4.0, 8.0
"""Seconds without queries to the balancer, and seconds with queries."""
MEGA = 1e6
ANSWER = HostRanking([RankedHost(f"host{n}", 0.5, "x" * 75) for n in range(RankAsk().at_most)], "composite", "as asked")
"""A typical answer, for its length."""


@dataclass(frozen=True)
class Figures:
    """Figures for one number of hosts, in seconds, bytes, and shares of one core."""

    hosts: int
    idle: float
    """CPU before there were hosts."""
    cpu: float
    """CPU while hosts report, without queries."""
    memory_before: int
    memory: int
    bare: float
    answer: float
    answer_p99: float
    bare_p99: float
    rounds: int
    sent: int
    missed: int

    @property
    def ratio(self) -> float:
        return self.answer / self.bare

    @property
    def ended(self) -> bool:
        return self.ratio > END or self.missed > 0


class Node:
    """The leading node, and its counts of itself."""

    def __init__(self, process: Child) -> None:
        self._process = process

    async def counts(self) -> dict[str, Any]:
        self._process.order({})
        counts: dict[str, Any] = await asyncio.to_thread(self._process.report)
        return counts

    async def share(self, seconds: float) -> float:
        """Its share of a core over `seconds`."""
        before, start = await self.counts(), time.monotonic()
        await asyncio.sleep(seconds)
        spent = (await self.counts())["cpu"] - before["cpu"]
        return float(spent / (time.monotonic() - start))

    async def settled(self, reports: int) -> int:
        """The number of received reports, when it has all of them or no more arrive."""
        last, now = -1, 0
        while last < now < reports:
            last = now
            await asyncio.sleep(1)
            now = (await self.counts())["reports"]
        return now


async def rank(client: Client) -> HostRanking | None:
    reply = await client.mesh.ask_one(client.mesh.keys.ask_rank(client.mesh.me), RankAsk(), HostRanking, timeout=5)
    return reply.message if reply is not None else None


async def ranked(client: Client, hosts: int) -> None:
    async with asyncio.timeout(HANG):
        while True:
            answer = await rank(client)
            if answer is not None and len(answer.hosts) + answer.more >= hosts:
                return
            await asyncio.sleep(0.1)


async def measure(folder: Path, hosts: int, quiet: float = QUIET, asked: float = ASKED) -> Figures:
    with ExitStack() as stack:
        lab = Lab(folder, candidates=["lead"])
        file = folder / "lead.toml"
        file.write_text('[node]\nhost = "lead"\nfleet = "fleet.toml"\nload = false\n')
        node = Node(stack.enter_context(child("counted_node", str(file))))
        address = lab.fleet.mesh.multicast_address.replace("224.0.0.224", "224.0.0.225")
        size = len(messages.encode(ANSWER))
        stack.enter_context(child("bare", address, bare.KEY, "--bytes", str(size)))
        session = stack.enter_context(zenoh.open(bare.settings(address)))
        bare_query = bare.BareQuery(messages.encode(RankAsk()))
        bare_query.choose(session)
        async with lab:
            client = await lab.client("asker")
            await lab.ready(client)
            before = await node.counts()
            idle = await node.share(quiet / 2)
            files = str(lab.fleet_file), str(hosts)
            reporters = await asyncio.to_thread(stack.enter_context, child("host_reports", *files))
            reporters.order({"do": "start"})
            await asyncio.to_thread(reporters.report)
            await ranked(client, hosts)
            cpu = await node.share(quiet)
            answers, bares = Samples(), Samples()
            until = time.monotonic() + asked
            while time.monotonic() < until:
                for _ in range(HOT):
                    reference = bare_query.once()
                for _ in range(HOT):
                    start = time.perf_counter()
                    answer = await rank(client)
                    took = time.perf_counter() - start
                    assert answer is not None, "the balancer did not answer"
                bares.add(reference)
                answers.add(took)
                await asyncio.sleep(random.uniform(0, PAUSE))  # noqa: S311
            memory = (await node.counts())["memory"]
            reporters.order({"do": "stop"})
            sent = await asyncio.to_thread(reporters.report)
            received = await node.settled(sent)
    return Figures(
        hosts=hosts,
        idle=idle,
        cpu=cpu,
        memory_before=before["memory"],
        memory=memory,
        bare=bares.median,
        answer=answers.median,
        answer_p99=answers.p99,
        bare_p99=bares.p99,
        rounds=len(answers.values),
        sent=sent,
        missed=sent - received,
    )


def table(all_found: list[Figures]) -> str:
    times_of, rest = ("answer", "p99", "bare", "p99"), f"{'ratio':>8}{'p99':>8}{'node CPU':>10}{'RSS':>8}"
    lines = [f"{'hosts':>7}" + "".join(f"{name:>10}" for name in times_of) + rest + f"{'sent':>9}{'missed':>8}"]
    for point in all_found:
        times = "".join(f"{t * 1e3:>7.2f} ms" for t in (point.answer, point.answer_p99, point.bare, point.bare_p99))
        ratios = f"{point.ratio:>8.1f}{point.answer_p99 / point.bare_p99:>8.1f}"
        use = f"{point.cpu:>9.1%} {point.memory / MEGA:>4.0f} MB"
        lines.append(f"{point.hosts:>7,}{times}{ratios}{use}{point.sent:>9,}{point.missed:>8,}")
    first = all_found[0]
    lines.append(
        f"\nBefore there were hosts the node used {first.idle:.1%} of a core and "
        f"{first.memory_before / MEGA:.0f} MB. Node CPU is without queries;"
        "\nratios are to the bare query's median and p99."
    )
    last = all_found[-1]
    if last.ended:
        what = f"answers take {last.ratio:.1f} bare queries, {last.missed:,} reports are missed"
        lines.append(f"It ends at {last.hosts:,} hosts: {what}.")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m studies hosts", description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    parser.add_argument("--hosts", type=int, help="only this number (default: 1,000, doubled until answers are slow)")
    args = parser.parse_args()
    if args.hosts is not None and not 1 <= args.hosts <= MAX_HOSTS:
        parser.error(f"--hosts: {args.hosts} is not from 1 to {MAX_HOSTS}, the limit of a balancer")
    found: list[Figures] = []
    hosts = args.hosts or 1_000
    while True:
        print(f"{hosts:,} hosts", file=sys.stderr, flush=True)
        with tempfile.TemporaryDirectory(prefix="zscout-bench-") as name:
            try:
                found.append(run(measure(Path(name), hosts)))
            except TimeoutError:
                print(f"{hosts:,} hosts were not all ranked within {HANG:.0f} s", file=sys.stderr)
                break
        if args.hosts is not None or found[-1].ended or hosts == MAX_HOSTS:
            break
        hosts = min(2 * hosts, MAX_HOSTS)
    if not found:
        sys.exit(1)
    if args.json:
        machine = {"cores": os.cpu_count(), "python": platform.python_version()}
        points = [asdict(point) | {"ratio": point.ratio, "ended": point.ended} for point in found]
        print(json.dumps({"machine": machine, "hosts": points}, indent=2))
        return
    print(table(found))
    print(f"{os.cpu_count()} cores, Python {platform.python_version()}, load average {os.getloadavg()[0]:.1f}.")

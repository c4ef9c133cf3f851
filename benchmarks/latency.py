"""Latencies as a program on the mesh sees them, each against the bare query of the same rounds."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable
from pathlib import Path

import zenoh

from benchmarks import bare, face
from benchmarks.child import child
from benchmarks.stats import Row, Samples, of_latency
from tests.live.lab import Lab
from zscout import messages
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.request import Needs, OpenArc
from zscout.config.scheduling_policy import StrategyName
from zscout.messages import Ask, HostRanking, Notice, RankAsk, StateAsk

EXCLUSIVE = [f"robot/r{number}" for number in range(10)]
SHARABLE = ["radio/rf0", "video/ch1"]
HOT = 3
"""Times that each thing is done in a row, of which the last counts: an idle processor and cold caches cost
more than anything that is measured here, and most where many processes take part."""
HOLD = 60.0


def fleet_of(folder: Path, strategy: StrategyName = "adaptive") -> Lab:
    """The RCM's node apart from those of the RCs, as on a mesh; not started yet."""
    return Lab(folder, candidates=["lead"], strategy=strategy)


def start(lab: Lab) -> None:
    lab.node("lead")
    lab.node("left", *EXCLUSIVE[0::2], f"{SHARABLE[0]}:rate=10")
    lab.node("right", *EXCLUSIVE[1::2], f"{SHARABLE[1]}:rate=10")


async def running(client: Client, arc: OpenArc) -> None:
    """Waits for the grant, without the confirmation at the RCs."""
    while arc.state != "running":
        assert arc.open, f"{arc.name} ended: {arc.reason}"
        await client.changed(arc)


class Programs:
    """Two programs in one fleet, and what they do."""

    def __init__(self, client: Client, second: Client) -> None:
        self.client, self.second = client, second

    @classmethod
    async def of(cls, lab: Lab) -> Programs:
        made = cls(await lab.client("bench"), await lab.client("second"))
        await lab.ready(made.client, *EXCLUSIVE, *SHARABLE)
        return made

    def grant(self, needs: Needs, *, confirm: bool = False) -> Callable[[], Awaitable[float]]:
        async def measured() -> float:
            start = time.perf_counter()
            arc = await self.client.request("bench", needs, min_runtime=HOLD)
            await (self.client.granted(arc) if confirm else running(self.client, arc))
            took = time.perf_counter() - start
            await self.client.end(arc)
            return took

        return measured

    def release_to_next(self, needs: Needs) -> Callable[[], Awaitable[float]]:
        async def measured() -> float:
            holder = await self.client.request("holder", needs, min_runtime=HOLD)
            await running(self.client, holder)
            waiter = await self.second.request("waiter", needs, min_runtime=HOLD)
            assert waiter.state == "queued"
            start = time.perf_counter()
            released = asyncio.create_task(self.client.end(holder))
            await running(self.second, waiter)
            took = time.perf_counter() - start
            await released
            await self.second.end(waiter)
            return took

        return measured


async def latencies(lab: Lab, paper: Lab, rounds: int, progress: Callable[[str], None]) -> list[Row]:
    """Rows for the bare query, its asyncio face, the grants and the release; `paper` is a fleet under the
    strategy `priority`."""
    programs, papers = await Programs.of(lab), await Programs.of(paper)
    client = programs.client
    one: Needs = {EXCLUSIVE[0]: {}}
    five: Needs = {name: {} for name in EXCLUSIVE[:5]}
    votes: Needs = {name: {"rate": 4} for name in SHARABLE}
    ask = len(messages.encode(Ask("0123456789ab", "bench", {EXCLUSIVE[0]: {}}, 0, 60)))  # type: ignore[arg-type]
    address = lab.fleet.mesh.multicast_address.replace("224.0.0.224", "224.0.0.225")

    bare_query = bare.BareQuery(b"x" * ask)

    async def face_query() -> float:
        start = time.perf_counter()
        reply = await client.mesh.ask_one(face.key(client.mesh.keys), StateAsk(arc="x" * ask), Notice, timeout=5)
        took = time.perf_counter() - start
        assert reply is not None, "the face did not answer"
        return took

    async def ranking() -> float:
        start = time.perf_counter()
        reply = await client.mesh.ask_one(client.mesh.keys.rank, RankAsk(), HostRanking, timeout=5)
        took = time.perf_counter() - start
        assert reply is not None, "the balancer did not answer"
        return took

    measured: dict[str, Callable[[], Awaitable[float]]] = {
        "query, asyncio face": face_query,
        "balancer's answer": ranking,
        "grant, 1 RC": programs.grant(one),
        "1 RC under priority": papers.grant(one),
        "grant, 5 RCs": programs.grant(five),
        "5 RCs under priority": papers.grant(five),
        "grant, 2 votes": programs.grant(votes),
        "2 votes under priority": papers.grant(votes),
        "grant and confirmation, 1 RC": programs.grant(one, confirm=True),
        "grant and confirmation, 5 RCs": programs.grant(five, confirm=True),
        "grant and confirmation, 2 votes": programs.grant(votes, confirm=True),
        "release to next grant": programs.release_to_next(one),
        "release under priority": papers.release_to_next(one),
    }
    aims = {
        "balancer's answer": 1.2,
        "grant, 1 RC": 1.5,
        "grant, 5 RCs": 1.5,
        "grant, 2 votes": 2.6,
        "release to next grant": 2.0,
    }
    samples = {name: Samples() for name in measured}
    bare_samples = Samples()
    size = len(messages.encode(face.NOTICE))
    with (
        child("face", str(lab.fleet_file)),
        child("bare", address, bare.KEY, "--bytes", str(size)),
        zenoh.open(bare.settings(address)) as session,
    ):
        while await client.mesh.ask_one(face.key(client.mesh.keys), None, Notice, timeout=1) is None:
            progress("looking for the asyncio face")
        way = bare_query.choose(session)
        progress(f"bare query: {way}, {ask} bytes out, {size} back")
        for number in range(-rounds // 10, rounds):
            for name, measure in measured.items():
                for _ in range(HOT):
                    reference = bare_query.once()
                for _ in range(HOT):
                    took = await measure()
                if number >= 0:
                    samples[name].add(took)
                    bare_samples.add(reference)
            if number % 100 == 0:
                progress(f"latencies: round {max(number, 0)} of {rounds}")
    rows = [of_latency("bare query", bare_samples, bare_samples)]
    rows += [of_latency(name, samples[name], bare_samples, aim=aims.get(name)) for name in measured]
    return rows

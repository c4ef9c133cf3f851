"""Latencies as a program on the mesh sees them, each against the bare query of the same rounds."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
import tarfile
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import ExitStack, contextmanager
from io import BytesIO
from pathlib import Path

import zenoh

from benchmarks import bare, face
from benchmarks.child import Child, child
from benchmarks.programs import EXCLUSIVE, HOT
from benchmarks.stats import Row, Samples, of_latency
from tests.live.lab import Lab
from zscout import messages
from zscout.config.scheduling_policy import StrategyName
from zscout.messages import Ask, HostRanking, Notice, RankAsk, StateAsk

ROOT = Path(__file__).parents[1]
MEASURED = [
    ("grant", "1 RC"),
    ("grant", "5 RCs"),
    ("grant", "2 votes"),
    ("body entered", "1 RC"),
    ("body entered", "5 RCs"),
    ("body confirmed", "5 RCs"),
    ("body confirmed", "2 votes"),
    ("release to next grant", "1 RC"),
]
AIMS = {
    ("grant", "1 RC"): 2.0,
    ("grant", "5 RCs"): 2.0,
    ("grant", "2 votes"): 3.5,
    ("body entered", "1 RC"): 2.2,
    ("body entered", "5 RCs"): 2.2,
    ("body confirmed", "5 RCs"): 3.5,
    ("release to next grant", "1 RC"): 2.0,
}


def fleet_of(folder: Path, strategy: StrategyName = "adaptive") -> Lab:
    """Not started yet."""
    return Lab(folder, candidates=["lead"], strategy=strategy)


def commit(name: str, folder: Path) -> Path:
    """The tree of a commit, in `folder`."""
    archive = subprocess.run(["git", "-C", str(ROOT), "archive", name], capture_output=True, check=True).stdout
    with tarfile.open(fileobj=BytesIO(archive)) as tree:
        tree.extractall(folder, filter="data")
    return folder


async def hot(ask: Callable[[], Awaitable[object]]) -> float:
    """Seconds of the last of HOT questions in a row."""
    for _ in range(HOT):
        began = time.perf_counter()
        reply = await ask()
        took = time.perf_counter() - began
        assert reply is not None, "no answer"
    return took


@contextmanager
def programs(folder: Path, tree: Path = ROOT, strategy: StrategyName = "adaptive") -> Iterator[Child]:
    """Two programs in a fleet of their own, all of that tree's commit."""
    folder.mkdir()
    command = [sys.executable, "-P", str(ROOT / "benchmarks" / "programs.py"), str(folder), strategy]
    process = Child(command, env=os.environ | {"PYTHONPATH": str(tree)}, cwd=tree)
    try:
        process.report()
        yield process
    finally:
        process.close()


async def latencies(
    lab: Lab, folder: Path, rounds: int, progress: Callable[[str], None], before: str | None = None
) -> list[Row]:
    """Rows for the bare query, its asyncio face, and what programs wait for: of this tree, of the commit `before`,
    and of a fleet under the strategy `priority`."""
    client = await lab.client("bench")
    ask = len(messages.encode(Ask("0123456789ab", "bench", {EXCLUSIVE[0]: {}}, 0, 60)))  # type: ignore[arg-type]
    address = lab.fleet.mesh.multicast_address.replace("224.0.0.224", "224.0.0.225")

    bare_query = bare.BareQuery(b"x" * ask)

    async def face_query() -> float:
        key, asked = face.key(client.mesh.keys), StateAsk(arc="x" * ask)
        return await hot(lambda: client.mesh.ask_one(key, asked, Notice, timeout=5))

    async def ranking() -> float:
        return await hot(lambda: client.mesh.ask_one(client.mesh.keys.rank, RankAsk(), HostRanking, timeout=5))

    measured: dict[str, Callable[[], Awaitable[float]]] = {
        "query, asyncio face": face_query,
        "balancer's answer": ranking,
    }
    aims: dict[str, float] = {"balancer's answer": 1.2}

    def add(fleet: Child, of: str) -> None:
        for what, needs in MEASURED:

            async def ordered(what: str = what, needs: str = needs) -> float:
                fleet.order([what, needs])
                took: float = await asyncio.to_thread(fleet.report)
                return took

            measured[f"{what}, {needs}{of}"] = ordered
            if not of and (what, needs) in AIMS:
                aims[f"{what}, {needs}"] = AIMS[what, needs]

    size = len(messages.encode(face.NOTICE))
    with ExitStack() as stack:
        add(stack.enter_context(programs(folder / "now")), "")
        if before is not None:
            tree = commit(before, folder / "tree")
            add(stack.enter_context(programs(folder / "before", tree)), f" ({before})")
        add(stack.enter_context(programs(folder / "paper", strategy="priority")), " under priority")
        stack.enter_context(child("face", str(lab.fleet_file)))
        stack.enter_context(child("bare", address, bare.KEY, "--bytes", str(size)))
        session = stack.enter_context(zenoh.open(bare.settings(address)))
        while await client.mesh.ask_one(face.key(client.mesh.keys), None, Notice, timeout=1) is None:
            progress("looking for the asyncio face")
        way = bare_query.choose(session)
        progress(f"bare query: {way}, {ask} bytes out, {size} back")
        samples = {name: Samples() for name in measured}
        bare_samples = Samples()
        for number in range(-rounds // 10, rounds):
            for name, measure in measured.items():
                for _ in range(HOT):
                    reference = bare_query.once()
                took = await measure()
                if number >= 0:
                    samples[name].add(took)
                    bare_samples.add(reference)
            if number % 100 == 0:
                progress(f"latencies: round {max(number, 0)} of {rounds}")
    rows = [of_latency("bare query", bare_samples, bare_samples)]
    rows += [of_latency(name, samples[name], bare_samples, aim=aims.get(name)) for name in measured]
    return rows

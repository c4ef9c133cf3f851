"""Latencies as a program on the mesh sees them, each compared with the bare query of the same rounds."""

from __future__ import annotations

import asyncio
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
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
TURNS = 5
WARM_UP = 10
ANSWER = len(messages.encode(face.NOTICE))
"""Bytes."""
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
    """Return a lab whose nodes are not started yet."""
    return Lab(folder, candidates=["lead"], strategy=strategy)


def commit(name: str, folder: Path) -> Path:
    """Unpack the tree of a commit in `folder`."""
    archive = folder.with_suffix(".tar")
    subprocess.run(["git", "-C", str(ROOT), "archive", f"--output={archive}", name], check=True)
    shutil.unpack_archive(archive, folder)
    return folder


async def hot(ask: Callable[[], Awaitable[object]]) -> float:
    """Return the seconds of the last of HOT consecutive queries."""
    for _ in range(HOT):
        began = time.perf_counter()
        reply = await ask()
        took = time.perf_counter() - began
        assert reply is not None, "no answer"
    return took


@contextmanager
def programs(folder: Path, tree: Path = ROOT, strategy: StrategyName = "adaptive") -> Iterator[Child]:
    """Run two programs in a fleet of their own, all from the commit in `tree`."""
    folder.mkdir()
    command = [sys.executable, "-P", str(ROOT / "benchmarks" / "programs.py"), str(folder), strategy]
    process = Child(command, env=os.environ | {"PYTHONPATH": str(tree)}, cwd=tree)
    try:
        process.report()
        yield process
    finally:
        process.close()


async def latencies(folder: Path, rounds: int, progress: Callable[[str], None], before: str | None = None) -> list[Row]:
    """Return rows for the bare query and the latencies: of this tree, of the commit `before`, and of a fleet with the
    strategy `priority`. Each has the machine to itself, in turns of a few rounds."""
    ask = len(messages.encode(Ask("0123456789ab", "bench", {EXCLUSIVE[0]: {}}, 0, 60)))  # type: ignore[arg-type]
    fleets: dict[str, tuple[Path, StrategyName]] = {"": (ROOT, "adaptive")}
    if before is not None:
        fleets[f" ({before})"] = commit(before, folder / "tree"), "adaptive"
    fleets[" under priority"] = ROOT, "priority"
    samples = {f"{what}, {needs}{of}": Samples() for of in fleets for what, needs in MEASURED}
    bare_samples = {of: Samples() for of in fleets}
    with bare_query(folder, ask) as query:
        progress(f"bare query: {query.way}, {ask} bytes out, {ANSWER} back")
        for turn in range(TURNS):
            for of, (tree, strategy) in fleets.items():
                progress(f"latencies{of}: turn {turn + 1} of {TURNS}")
                with programs(folder / f"fleet-{turn}{len(of)}", tree, strategy) as fleet:
                    for number in range(-WARM_UP, rounds // TURNS):
                        for what, needs in MEASURED:
                            reference = query.hot()
                            fleet.order([what, needs])
                            took = await asyncio.to_thread(fleet.report)
                            if number >= 0:
                                samples[f"{what}, {needs}{of}"].add(took)
                                bare_samples[of].add(reference)
    rows = [of_latency("bare query", bare_samples[""], bare_samples[""])]
    for of in fleets:
        for what, needs in MEASURED:
            name, aim = f"{what}, {needs}{of}", AIMS.get((what, needs)) if not of else None
            rows.append(of_latency(name, samples[name], bare_samples[of], aim=aim))
    return rows


async def questions(lab: Lab, folder: Path, rounds: int, progress: Callable[[str], None]) -> list[Row]:
    """Return rows for a query through zscout's asyncio interface, and for the balancer's answer."""
    client = await lab.client("bench")
    key, asked = face.key(client.mesh.keys), StateAsk(arc="x" * 100)

    async def face_query() -> object:
        return await client.mesh.ask_one(key, asked, Notice, timeout=5)

    async def ranking() -> object:
        return await client.mesh.ask_one(client.mesh.keys.ask_rank(client.mesh.me), RankAsk(), HostRanking, timeout=5)

    measured = {"query, asyncio face": (face_query, None), "balancer's answer": (ranking, 1.2)}
    samples, bare_samples = {name: Samples() for name in measured}, Samples()
    with bare_query(folder, len(messages.encode(asked))) as query, child("face", str(lab.fleet_file)):
        while await client.mesh.ask_one(key, None, Notice, timeout=1) is None:
            progress("looking for the asyncio face")
        for number in range(-WARM_UP, rounds):
            for name, (question, _) in measured.items():
                reference = query.hot()
                took = await hot(question)
                if number >= 0:
                    samples[name].add(took)
                    bare_samples.add(reference)
    await client.close()
    lab.clients.remove(client)
    return [of_latency(name, samples[name], bare_samples, aim=aim) for name, (_, aim) in measured.items()]


@contextmanager
def bare_query(folder: Path, size: int) -> Iterator[bare.BareQuery]:
    """Prepare a bare query of `size` bytes, on a mesh of its own."""
    lab = fleet_of(folder)  # keeps its multicast address reserved
    address = lab.fleet.mesh.multicast_address
    with child("bare", address, bare.KEY, "--bytes", str(ANSWER)), zenoh.open(bare.settings(address)) as session:
        query = bare.BareQuery(b"x" * size)
        query.choose(session)
        yield query

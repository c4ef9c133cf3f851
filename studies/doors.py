"""`python -m studies doors`: the cost of certificates, and the damage that a stranger does to an open fleet.

A fleet with certificates (TLS, and access rules with 20 names) and a plain fleet take turns on one machine. A stranger
sends 400 MB in one message, and leads in term 10^12 while a fleet starts and a node restarts. Members flood a fleet
with certificates, as far as their roles allow, while another client asks."""

from __future__ import annotations

import argparse
import asyncio
import os
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path

from benchmarks.loop import run
from benchmarks.stats import Row, Samples, of_latency, table
from tests.live.closed import DAY, ROLES, ClosedLab
from tests.live.lab import Lab
from tests.live.test_floods import floods
from tests.live.test_plain_doors import HUGE, MIB, mad_leader, peak
from zscout.behaviors.client.arc import hold
from zscout.behaviors.client.client import Client
from zscout.mesh.zenoh_mesh import zenoh_config
from zscout.messages import RcmState, StateAsk

NAMES = 20
SENDER = """
import sys, zenoh
settings, base, size = sys.argv[1:]
with zenoh.open(zenoh.Config.from_json5(settings)) as session:
    def answered():
        return any(session.get(f"{base}/rcm/state", payload=b"{}", timeout=1.0))
    while not answered():
        pass
    session.put(f"{base}/rcm/grants", bytes(int(size)), congestion_control=zenoh.CongestionControl.BLOCK)
    answered()
"""
WARM = 5


async def entered(client: Client, rc: str = "radio/a") -> float:
    """Seconds from a request to the beginning of its body."""
    start = time.perf_counter()
    took = 0.0
    async with hold(client, "bench", {rc: {}}):
        took = time.perf_counter() - start
    return took  # noqa: RET504


async def asked(client: Client) -> float:
    start = time.perf_counter()
    await client.mesh.ask_one(
        client.mesh.keys.ask_state(client.mesh.me), StateAsk(holds_only=True), RcmState, timeout=5
    )
    return time.perf_counter() - start


async def cost(folder: Path, rounds: int) -> list[Row]:
    more = [f"more{number}" for number in range(NAMES - 7)]
    roles = ROLES.replace('viewer = ["wall"]', f'viewer = ["wall", {", ".join(map(repr, more))}]')
    (folder / "closed").mkdir()
    (folder / "plain").mkdir()
    async with ClosedLab(folder / "closed", roles=roles) as closed, Lab(folder / "plain") as plain:
        for name in more:
            closed.authority.issue(name, folder / "closed" / "keys" / name, DAY, datetime.now(UTC))
        for lab in (closed, plain):
            lab.node("anvil", extra="load = false")
            lab.node("cart", "radio/a", extra="load = false\ncandidate = false")
        clients = {"with TLS and rules": await closed.person("ada"), "plain": await plain.client()}
        for lab, client in zip((closed, plain), clients.values(), strict=True):
            await lab.ready(client, "radio/a")
        grants, queries = ({name: Samples() for name in clients} for _ in range(2))
        for number in range(rounds + WARM):
            for name, client in clients.items():
                took = await entered(client), await asked(client)
                if number >= WARM:
                    grants[name].add(took[0])
                    queries[name].add(took[1])
        await closed.stop()
    secured, bare = (list(samples.values()) for samples in (grants, queries))
    return [
        of_latency("request to body, plain", secured[1], secured[1], against="itself"),
        of_latency("request to body, TLS and 20 names", secured[0], secured[1], aim=1.1, against="plain"),
        of_latency("state query, TLS and 20 names", bare[0], bare[1], against="plain"),
    ]


async def beside_floods(folder: Path, rounds: int) -> list[Row]:
    """Measure while 500 queries and requests of three members are outstanding all the time, on the same machine."""
    alone, beside = Samples(), Samples()
    async with ClosedLab(folder) as lab:
        lab.node("anvil", "robot/a", "robot/b")
        client = await lab.person("ada")
        await lab.ready(client, "robot/a", "robot/b")
        for _ in range(rounds):
            alone.add(await entered(client, "robot/b"))
        async with floods(lab):
            for _ in range(rounds):
                beside.add(await entered(client, "robot/b"))
    return [
        of_latency("request to body beside floods", beside, alone, against="no floods"),
        Row("the same, at most", max(beside.values), "s", aim=0.5, rounds=rounds),
    ]


async def huge_message(folder: Path) -> list[Row]:
    """Memory and longest silence of a node that receives 400 MB."""
    async with Lab(folder) as lab:
        node = lab.node("anvil", "robot/a")
        client = await lab.client()
        await lab.ready(client, "robot/a")
        gaps, before, over = [0.0], peak(node.pid), asyncio.Event()

        async def keep_asking() -> None:
            while not over.is_set():
                gaps.append(await asked(client))

        asking = asyncio.create_task(keep_asking())
        settings = str(zenoh_config(lab.fleet.mesh))
        sender = await asyncio.create_subprocess_exec(
            sys.executable, "-c", SENDER, settings, f"zscout/{lab.fleet.name}", str(HUGE)
        )
        assert await sender.wait() == 0
        over.set()
        await asking
        return [
            Row("memory that 400 MB in one message add", (peak(node.pid) - before) / MIB, "MiB", aim=20),
            Row("longest state query meanwhile", max(gaps) * 1e3, "ms", aim=100, rounds=len(gaps)),
        ]


async def mad_term(folder: Path, rounds: int) -> list[Row]:
    """Time from the end of a leader in term 10^12 to the first grant."""
    took = Samples()
    for number in range(rounds):
        (folder / str(number)).mkdir()
        async with Lab(folder / str(number), lease=1.0) as lab:
            async with mad_leader(lab):
                lab.node("a", "robot/a")
                lab.node("b", "robot/b")
                client = await lab.client()
                await lab.living(client, "rc", lambda found: {"a", "b"} <= set(found))
                lab.nodes["a"].kill()
                lab.node("a", "robot/a")
                await lab.candidates(client, "a", "b")
            start = time.perf_counter()
            arc = await client.request("survey", {"robot/a": {}, "robot/b": {}}, wait_for_device=True)
            assert await client.granted(arc)
            took.add(time.perf_counter() - start)
    return [Row("grant after a leader of term 10^12 has left, at most", max(took.values), "s", aim=5, rounds=rounds)]


async def measure(rounds: int, mad: int) -> list[Row]:
    with tempfile.TemporaryDirectory(prefix="zscout-doors-") as name:
        folders = [Path(name, part) for part in ("cost", "floods", "huge", "mad")]
        for folder in folders:
            folder.mkdir()
        return [
            *await cost(folders[0], rounds),
            *await beside_floods(folders[1], rounds),
            *await huge_message(folders[2]),
            *await mad_term(folders[3], mad),
        ]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m studies doors", description=__doc__)
    parser.add_argument("--rounds", type=int, default=200, help="of each latency (default: 200)")
    parser.add_argument("--mad", type=int, default=5, help="fleets that start beside a mad leader (default: 5)")
    args = parser.parse_args()
    before = os.getloadavg()[0]
    print(table(run(measure(args.rounds, args.mad))))
    print(f"load average {before:.2f} before, {os.getloadavg()[0]:.2f} after; {os.cpu_count()} cores")

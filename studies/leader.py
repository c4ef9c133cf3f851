"""`python -m studies leader`: measures of the leader, from its source and from fleets of real nodes."""

from __future__ import annotations

import argparse
import ast
import asyncio
import itertools
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any, Final
from zoneinfo import ZoneInfo

import psutil

from benchmarks.grant_path import ASKING, IDLE, trace
from benchmarks.loop import run
from benchmarks.stats import Row, Samples, table
from studies.booking_cost import on_shared_rcs
from tests.live import test_floods
from tests.live.closed import ClosedLab
from tests.live.lab import Lab
from zscout.behaviors.client.arc import hold
from zscout.behaviors.client.bookings import BookingsClient
from zscout.behaviors.client.client import Client
from zscout.messages import Grants
from zscout.types import SECOND

ROOT: Final = Path(__file__).parents[1] / "zscout"
LEADER: Final = ("rcm/*.py", "services/rcm/*.py", "services/bookings/*.py", "scheduling/calendar.py")
"""The modules of the leader, including the calendar, which now belongs to the core."""
MOST_PARAMETERS: Final = 8
MOST_ATTRIBUTES: Final = 20
SERIES: Final = 49
"""Weekly bookings of one RC: some 420 dates within 60 days."""
FLOODED: Final = 3.0
"""Seconds of a flood."""
HEARTBEAT: Final = 0.5

Function = ast.FunctionDef | ast.AsyncFunctionDef


def sources(patterns: tuple[str, ...]) -> Iterator[ast.Module]:
    for path in itertools.chain.from_iterable(map(ROOT.glob, patterns)):
        yield ast.parse(path.read_text())


def by_source() -> list[Row]:
    lines = sum(path.read_text().count("\n") for pattern in LEADER for path in ROOT.glob(pattern))
    classes = [node for tree in sources(LEADER) for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
    wide = [node.name for node in classes if parameters(node) > MOST_PARAMETERS]
    large = [node.name for node in classes if len(attributes(node)) > MOST_ATTRIBUTES]
    assigned = [found for tree in sources(("**/*.py",)) for found in callbacks(tree)]
    return [
        Row("lines of the leader", lines, "", aim=4_200),
        Row(_named("callbacks assigned after construction", assigned), len(assigned), "", aim=0),
        Row(_named(f"constructors with more than {MOST_PARAMETERS} parameters", wide), len(wide), "", aim=0),
        Row(_named(f"classes with more than {MOST_ATTRIBUTES} attributes", large), len(large), "", aim=0),
    ]


def _named(what: str, found: list[str]) -> str:
    return f"{what}: {', '.join(found)}" if found else what


def parameters(of: ast.ClassDef) -> int:
    """The number of parameters of the class's constructor, without `self`."""
    made = [node for node in of.body if isinstance(node, Function) and node.name == "__init__"]
    return sum(len(node.args.posonlyargs + node.args.args + node.args.kwonlyargs) - 1 for node in made)


def attributes(of: ast.ClassDef) -> set[str]:
    """The attributes that the class's methods assign to `self`."""
    assigned = [node for node in ast.walk(of) if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store)]
    return {node.attr for node in assigned if _is_self(node.value)}


def callbacks(tree: ast.Module) -> Iterator[str]:
    """Yield attributes of other objects to which own methods or lambdas are assigned, or that are named `on_...`."""
    methods = {node.name for node in ast.walk(tree) if isinstance(node, Function) and not node.decorator_list}
    for node in (node for node in ast.walk(tree) if isinstance(node, ast.Assign)):
        value, targets = node.value, [target for target in node.targets if isinstance(target, ast.Attribute)]
        own = isinstance(value, ast.Attribute) and _is_self(value.value) and value.attr in methods
        for target in targets:
            if not _is_self(target.value) and (own or isinstance(value, ast.Lambda) or target.attr.startswith("on_")):
                yield ast.unparse(target)


def _is_self(value: ast.expr) -> bool:
    return isinstance(value, ast.Name) and value.id == "self"


async def one_grant(folder: Path) -> list[Row]:
    """The calls at the leader from a client's request to the beginning of the body."""
    calls = await trace(folder)
    start = next(at for at, *where in calls["client"] if tuple(where) == ASKING)
    end, leads = calls["client"][-1][0], calls["leader"]
    idle = {tuple(where) for at, *where in leads if start - IDLE * SECOND < at < start}
    made = [where for at, *where in leads if start <= at < end and tuple(where) not in idle]
    return [
        Row("calls at the leader for one uncontended grant", len(made), "", aim=100),
        Row("modules in them", len({module for module, _ in made}), "", aim=12),
    ]


async def processor_time(folder: Path, rounds: int) -> list[Row]:
    """The leading node's processor time for a request and its release, without its idle use."""
    async with Lab(folder, candidates=["lead"]) as lab:
        node = psutil.Process(lab.node("lead", extra="load = false").pid)
        lab.node("device", "robot/x", extra="load = false")
        client = await lab.client()
        await lab.ready(client, "robot/x")

        async def used(seconds: float, asked: int) -> tuple[float, float]:
            before, began = _spent(node), time.monotonic()
            for _ in range(asked):
                async with hold(client, "measured", {"robot/x": {}}):
                    pass
            await asyncio.sleep(seconds)
            return _spent(node) - before, time.monotonic() - began

        await used(1.0, 20)
        idle, over = await used(10.0, 0)
        spent, took = await used(0.0, rounds)
        each = (spent - idle * took / over) / rounds
        return [Row("leader's processor time for a request and its release", 1e3 * each, "ms", aim=0.8, rounds=rounds)]


def _spent(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


async def takeover(folder: Path, candidates: int) -> list[Row]:
    """Time from the leader's death to a grant, with dates on a voting RC."""
    names = [f"m{number}" for number in range(candidates)]
    async with Lab(folder, candidates=names) as lab:
        for name in names:
            lab.node(name)
        lab.node("device", "robot/x", "radio/s:rate=100000")
        client = await lab.client()
        leader = (await lab.ready(client, "robot/x", "radio/s")).host
        await lab.candidates(client, *names)
        bookings, zone = BookingsClient(client), ZoneInfo("UTC")
        first, began = datetime.now(zone) + timedelta(days=1), time.perf_counter()
        for number in range(SERIES):
            start = first + timedelta(hours=3 * number)
            until = start + timedelta(days=180)
            await bookings.book({"radio/s": {"rate": 1}}, start, 5_400, name=f"w{number}", every=7, until=until)
        booked = time.perf_counter() - began
        dates = sum(len(view.dates) for view in (await bookings.list()).bookings)
        began = time.perf_counter()
        lab.nodes[leader].kill()
        async with hold(client, "next", {"robot/x": {}}):
            took = time.perf_counter() - began
    of = f"{dates} dates on a voting RC, {candidates} candidates"
    return [
        Row(f"{SERIES} weekly bookings one after the other, {candidates} candidates", booked, "s", aim=2.0),
        Row(f"first grant after a takeover, {of}", took, "s", aim=0.6),
    ]


async def flooded(folder: Path) -> list[Row]:
    """The leader's silence beyond a heartbeat, and the wait of an honest client, under each flood."""
    rows = []
    async with ClosedLab(folder) as lab:
        lab.node("anvil", "robot/a", "robot/b")
        wall, bob, eve, ada = [await lab.person(name) for name in ("wall", "bob", "eve", "ada")]
        await lab.ready(ada, "robot/a", "robot/b")
        await test_floods.crowd(eve)
        received = list[float]()
        ada.mesh.subscribe(ada.mesh.keys.grants, Grants, lambda *_: received.append(time.monotonic()))
        for name, asking in test_floods.each(wall, bob, eve).items():
            task = asyncio.create_task(asking)
            received[:] = [time.monotonic()]
            waits = await _honest(ada)
            task.cancel()
            with suppress(asyncio.CancelledError):
                await task
            silent = max(after - before for before, after in itertools.pairwise([*received, time.monotonic()]))
            rows += [
                Row(f"silence under a flood of {name}", max(0.0, silent - HEARTBEAT), "s", aim=0.1),
                Row("an honest client's grant beside it", waits.median, "s", p99=waits.p99, rounds=len(waits.values)),
            ]
    return rows


async def _honest(client: Client) -> Samples:
    waits, over = Samples(), time.monotonic() + FLOODED
    while time.monotonic() < over:
        began = time.monotonic()
        async with hold(client, "honest", {"robot/b": {}}, min_runtime=1):
            waits.add(time.monotonic() - began)
        await asyncio.sleep(0.05)
    return waits


async def live(folder: Path, rounds: int) -> list[Row]:
    rows, parts = list[Row](), dict[str, Callable[[Path], Any]]()
    parts["grant"] = one_grant
    parts["time"] = lambda at: processor_time(at, rounds)
    parts["two"] = lambda at: takeover(at, 2)
    parts["three"] = lambda at: takeover(at, 3)
    parts["floods"] = flooded
    for name, measure in parts.items():
        (folder / name).mkdir()
        rows += await measure(folder / name)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m studies leader", description=__doc__)
    parser.add_argument("--rounds", type=int, default=500, help="requests (default: 500)")
    parser.add_argument("--source", action="store_true", help="only the measures of the source")
    args = parser.parse_args()
    rows = by_source()
    if not args.source:
        with tempfile.TemporaryDirectory(prefix="zscout-leader-") as name:
            rows += run(live(Path(name), args.rounds))
        rows += on_shared_rcs(args.rounds // 5, 1)
    print(table(rows))

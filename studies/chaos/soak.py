"""`make soak`: a fleet at work for hours, live and in virtual time, and the resources that it uses at the beginning, in
the middle and at the end. Exit code 0: nothing grew; 1: something grew or a promise was broken; 2: it can't run
here."""

from __future__ import annotations

import argparse
import asyncio
import gc
import json
import shutil
import statistics
import sys
import tempfile
import time
from collections import Counter, OrderedDict, defaultdict, deque
from pathlib import Path
from typing import Any, Final, TypeAlias

import psutil

from studies.chaos import net
from studies.chaos.run import Fleet, NotServed
from studies.chaos.work import NODES, OWN_CLIENTS
from studies.faults import simulation
from studies.faults.simulation import Result, Simulation, Size, simulate
from zscout.rcm.request_log import MAX_LINES

Figures: TypeAlias = dict[str, float]
LOOKS: Final = 60
"""Number of looks in a live run. The beginning, the middle and the end are medians of a tenth of them."""
ROOM: Final = {"links": 0, "descriptors": 4, "memory_mb": 12, "latency_ms": 5, "objects": MAX_LINES}
"""Growth allowed from the beginning to the end, in addition to a tenth: the leader's history fills up."""
FAULTS_PER_HOUR: Final = 60
COLLECT_EVERY: Final = 20.0
CONTAINERS: Final = {list, dict, set, tuple, deque, OrderedDict, defaultdict, Counter}


def live(hours: float, folder: Path) -> tuple[list[dict[str, Figures]], list[str]]:
    """The resources that each process of zscout uses, by look, without faults; and texts of failures."""
    looks: list[dict[str, Figures]] = []
    with Fleet(folder, "soak", traced=False) as fleet:
        for _ in range(LOOKS):
            fleet.watch.waits.clear()
            try:
                fleet.rest(hours * 3600 / LOOKS, lambda: shorten(folder))
            except NotServed as error:
                return looks, [str(error)]
            standing = fleet.links.standing(fleet.processes.pids())
            used = {host: use(fleet.processes.pids()[host]) for host in NODES + OWN_CLIENTS}
            for host, figures in used.items():
                figures["links"] = sum(len(ports) // 2 for pair, ports in standing.items() if host in pair)
            used["near clients"] = {"latency_ms": round(1000 * statistics.median(fleet.watch.waits or [60.0]), 2)}
            looks.append(used)
    return looks, []


def use(pid: int) -> Figures:
    process = psutil.Process(pid)
    return {"memory_mb": round(process.memory_info().rss / 1e6, 1), "descriptors": process.num_fds()}


def shorten(folder: Path) -> None:
    """Truncate logs whose lines have been read."""
    for log in folder.glob("*.log"):
        if log.stat().st_size > 20_000_000:
            with log.open("r+b") as file:
                file.truncate(0)


class Soaked(Simulation):
    """Counts objects in memory at intervals. Drops the run's story, which would be most of them."""

    looks: list[dict[str, Figures]]

    def __init__(self, *words: Any, **more: Any) -> None:
        super().__init__(*words, **more)
        self.result.lines = deque(maxlen=1000)  # type: ignore[assignment]
        Soaked.looks = []

    async def _look(self) -> None:
        collecting = asyncio.create_task(self._collect())
        try:
            await super()._look()
        finally:
            collecting.cancel()

    async def _collect(self) -> None:
        every, due = self.size.span / LOOKS, self.size.span / LOOKS
        while True:
            await asyncio.sleep(COLLECT_EVERY)
            gc.collect()
            if (due := due - COLLECT_EVERY) <= 0:
                due += every
                Soaked.looks.append({"simulated fleet": {"objects": product_objects()}})


def product_objects() -> int:
    """Number of objects of zscout and of items in their containers, without the simulator's: its checker remembers
    all."""
    own = [thing for thing in gc.get_objects() if _is_product(thing)]
    seen, count = set(map(id, own)), 0
    while own:
        count += 1
        for thing in gc.get_referents(own.pop()):
            if id(thing) not in seen and (_is_product(thing) or type(thing) in CONTAINERS):
                seen.add(id(thing))
                own.append(thing)
    return count


def _is_product(thing: object) -> bool:
    module = type(thing).__module__
    # Tuples are left out, because the checker remembers grants and places.
    return (
        module.startswith("zscout.")
        and not module.startswith("zscout.testing.")
        and not isinstance(thing, type | tuple)
    )


def virtual(hours: float) -> tuple[list[dict[str, Figures]], Result]:
    size = Size(hosts=3, clients=6, faults=round(FAULTS_PER_HOUR * hours), span=hours * 3600, pause=30.0)
    whole, simulation.Simulation = simulation.Simulation, Soaked  # type: ignore[misc]
    try:
        result = simulate(1, size)
        return Soaked.looks, result
    finally:
        simulation.Simulation = whole  # type: ignore[misc]


def thirds(looks: list[dict[str, Figures]]) -> dict[str, dict[str, list[float]]]:
    """By process and measure: the values at the beginning, in the middle and at the end."""
    some = max(1, len(looks) // 10)
    # Without the first look, before which not all one-time allocations were made.
    parts = [looks[1 : 1 + some] or looks[:1], looks[len(looks) // 2 :][:some], looks[-some:]]
    measures = {host: list(figures) for host, figures in looks[0].items()}
    return {
        host: {name: [statistics.median(look[host][name] for look in part) for part in parts] for name in names}
        for host, names in measures.items()
    }


def grown(found: dict[str, dict[str, list[float]]]) -> list[str]:
    return [
        f"{host}: {name} {begin:g} -> {middle:g} -> {end:g}"
        for host, measures in found.items()
        for name, (begin, middle, end) in measures.items()
        if end > 1.1 * begin + ROOM[name]
    ]


def main() -> int:
    options = argparse.ArgumentParser(prog="python -m studies soak", description=__doc__)
    options.add_argument("--hours", type=float, default=8.0, help="live, and in virtual time (8)")
    options.add_argument("--live", type=float, help="hours live, if different from --hours")
    options.add_argument("--virtual", type=float, help="hours of virtual time, if different from --hours")
    options.add_argument("--json", action="store_true", help="print the report as JSON; always so in a pipe")
    asked = options.parse_args()
    hours = {"live": asked.live, "virtual": asked.virtual}
    hours = {name: asked.hours if value is None else value for name, value in hours.items()}
    found: dict[str, Any] = {"hours": hours, "wrong": []}
    if hours["live"]:
        try:
            net.check()
        except net.NoNamespaces as error:
            print(f"soak: {error}", file=sys.stderr)
            return 2
        net.end_on_signals()
        folder = Path(tempfile.mkdtemp(prefix="zscout-soak-"))
        try:
            looks, wrong = live(hours["live"], folder)
        except KeyboardInterrupt:
            print("soak: interrupted", file=sys.stderr)
            return 130
        finally:
            shutil.rmtree(folder, ignore_errors=True)
        found["live"] = thirds(looks) if looks else {}
        found["wrong"] += wrong
    if hours["virtual"]:
        began = time.monotonic()
        looks, result = virtual(hours["virtual"])
        found["virtual"] = thirds(looks) if looks else {}
        found["virtual_took_s"] = round(time.monotonic() - began)
        found["wrong"] += result.broken
    found["wrong"] += [text for part in ("live", "virtual") for text in grown(found.get(part, {}))]
    if asked.json or not sys.stdout.isatty():
        print(json.dumps(found))
    else:
        for part in ("live", "virtual"):
            for host, measures in found.get(part, {}).items():
                for name, values in measures.items():
                    print(f"{part:8} {host:16} {name:12}" + "".join(f"{value:>12g}" for value in values))
        print("\n".join(found["wrong"]) or "nothing grew")
    return 1 if found["wrong"] else 0

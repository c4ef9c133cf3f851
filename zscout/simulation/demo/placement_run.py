"""`zscout demo placement`: three nodes that report the load of their own process tree, and components that use CPU."""

from __future__ import annotations

import asyncio
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from zscout import terminal
from zscout.behaviors.client.placer_client import PlacerClient
from zscout.behaviors.client.request import RequestRefused
from zscout.keyexpr import Sender
from zscout.mesh import Mesh, ZenohMesh
from zscout.messages import ComponentSpec, HostRanking, LoadReport, Placements, RankAsk
from zscout.simulation import DemoFailed
from zscout.simulation.demo.runner import HOSTS, DemoRunner
from zscout.simulation.demo.screen import keep_recording
from zscout.types import Policy

NETS: Final = 3
NET: Final = ("locate-dark", "servo", "hide", "watch")  # the components of a Place Sensor Net in the paper
CPU: Final = 0.05  # share of a core that each component uses
START: Final = 30.0  # s until everything must be present
PLACE: Final = 20.0
REPORT: Final = 20.0
GAP: Final = 5.0
SCENARIOS: Final = {"at-once": 0.0, "staggered": GAP}  # s between the starts of two nets
TITLES: Final = {"at-once": "all at once", "staggered": f"one net every {GAP:g} s"}
SHOWN: Final = 2  # reports of each host while all components work


@dataclass(slots=True)
class PlacementTrial:
    policy: Policy
    gap: float  # s between the starts of two nets; 0: all at once
    placed: dict[str, str] = field(default_factory=dict)
    loads: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    """By host: (seconds since the first start, cores used by its components)."""

    def counts(self) -> dict[str, int]:
        hosts = list(self.placed.values())
        return {host: hosts.count(host) for host in HOSTS}

    def spread(self) -> int:
        """Components on the fullest host less components on the emptiest."""
        counts = self.counts().values()
        return max(counts) - min(counts)

    def apart(self) -> float:
        """Final difference between the most and the least loaded host, in cores."""
        latest = [curve[-1][1] for curve in self.loads.values() if curve]
        return max(latest) - min(latest) if latest else 0.0


class PlacementDemo(DemoRunner):
    """A trial on three fresh nodes, so that no load of an earlier trial remains. `zero` is the first start."""

    def __init__(self, folder: Path, trial: PlacementTrial, show: Callable[[float, str], None]) -> None:
        super().__init__(folder, show)
        self.trial = trial
        self._mesh: Mesh | None = None
        self._shown: dict[str, str] = {}
        self._running: dict[str, set[str]] = {}  # by host, components in its newest report
        self._reported = asyncio.Event()

    async def play(self) -> None:
        mesh = await self._start()
        self.zero = mesh.now()
        names = [[f"{part}-{net + 1}" for part in NET] for net in range(NETS)]
        batches = names if self.trial.gap else [[name for net in names for name in net]]
        for number, batch in enumerate(batches):
            if number:
                await asyncio.sleep(self.trial.gap)
            await asyncio.gather(*map(self._place, batch))
        await self.within(REPORT, self._all_reported(), "no load report listed all components")
        await asyncio.gather(*(self._stop(name) for net in names for name in net))

    async def _start(self) -> Mesh:
        """Start the nodes and wait until all are present and ranked."""
        await self.start_nodes({}, 'load = "tree"\n')
        mesh = self._mesh = await ZenohMesh.open(self.fleet(), Sender("demo", "watch"))
        self._placer = PlacerClient(mesh)
        mesh.subscribe(mesh.keys.load_any, LoadReport, self._on_load)
        mesh.subscribe(mesh.keys.placements, Placements, self._on_placements)
        await self.within(START, self.all_there(mesh, *HOSTS), "the nodes did not find each other")
        await self.within(START, self._all_ranked(mesh), "the balancer did not rank all nodes")
        return mesh

    async def _all_ranked(self, mesh: Mesh) -> None:
        while True:
            reply = await mesh.ask_one(mesh.keys.ask_rank(mesh.me), RankAsk(), HostRanking, timeout=1)
            if reply is not None and reply.message is not None and len(reply.message.hosts) == len(HOSTS):
                return
            await asyncio.sleep(0.1)

    async def _all_reported(self) -> None:
        while sum(map(len, self._running.values())) < len(self.trial.placed):
            self._reported.clear()
            await self._reported.wait()
        lengths = {host: len(curve) for host, curve in self.trial.loads.items()}
        while any(len(curve) < lengths[host] + SHOWN for host, curve in self.trial.loads.items()):
            self._reported.clear()
            await self._reported.wait()

    async def _place(self, name: str) -> None:
        spec = ComponentSpec("spin", {"cpu": CPU}, "never", metric="load_average", policy=self.trial.policy)
        try:
            placement = await self._placer.place(name, spec, wait=PLACE)
        except RequestRefused as refused:
            raise DemoFailed(f"{name}: {refused}") from refused
        if placement.state != "running" or placement.host is None:
            raise DemoFailed(f"{name} is not running: {placement.reason or placement.state} {placement.tail}")
        self.trial.placed[name] = placement.host

    async def _stop(self, name: str) -> None:
        try:
            await self._placer.stop(name, wait=PLACE / 2)
        except RequestRefused as refused:
            raise DemoFailed(f"{name}: {refused}") from refused

    def _on_placements(self, _key: str, placements: Placements) -> None:
        for placed in placements.components:
            words = f"{placed.component} {placed.state}" + (f" on {placed.host}" if placed.host else "")
            if self._shown.get(placed.component) != words and placed.state in ("running", "moving", "given_up"):
                self.event(f"{words}: {placed.reason}" if placed.reason else words)
            self._shown[placed.component] = words

    def _on_load(self, _key: str, report: LoadReport) -> None:
        if self.zero is not None and report.host in HOSTS:
            self._running[report.host] = {use.component for use in report.components}
            used = sum(use.cpu for use in report.components)
            self.trial.loads.setdefault(report.host, []).append((self.elapsed(), used))
            self._reported.set()

    async def close(self) -> None:
        if self._mesh is not None:
            await self._mesh.close()


async def play(chosen: Sequence[tuple[str, Policy]], out: Path | None, *, as_json: bool) -> int:
    """Run each scenario and policy on fresh nodes; returns the exit code. Raises DemoFailed, MeshError."""
    began, done = time.monotonic(), []

    def show(at: float, text: str) -> None:
        if not as_json:
            terminal.print_line(f"{at:7.2f} s  {terminal.clean(text)}")

    for number, (scenario, policy) in enumerate(chosen, start=1):
        if not as_json:
            title = f"{policy}, {TITLES[scenario]}"
            terminal.print_line(f"Trial {number} of {len(chosen)}: {title}; starting three nodes")
        with tempfile.TemporaryDirectory(prefix="zscout-demo-") as folder:
            trial = PlacementTrial(policy, SCENARIOS[scenario])
            async with PlacementDemo(Path(folder), trial, show) as demo:
                await demo.run()
            if out is not None:
                keep_recording(Path(folder), out / f"{scenario}-{policy}.rrd")
        done.append((scenario, trial))
    failures = [why for scenario, trial in done if (why := _failure(scenario, trial))]
    if as_json:
        trials = [{"scenario": scenario, **_as_object(trial)} for scenario, trial in done]
        terminal.print_json({"trials": trials, "failures": failures})
        return 1 if failures else 0
    terminal.print_line("")
    _table(done)
    terminal.print_line("")
    for why in failures:
        terminal.print_line(why)
    if not failures:
        terminal.print_line(f"As Figure 3 has it, and its cure ({time.monotonic() - began:.0f} s).")
    if out is not None:
        terminal.print_line(f"Recordings: {out}; look at one: zscout view {out}/at-once-pending.rrd")
    return 1 if failures else 0


def _failure(scenario: str, trial: PlacementTrial) -> str:
    """Describe how the trial differs from the paper, "" if it does not."""
    counts = "-".join(map(str, trial.counts().values()))
    if trial.policy == "pending" and trial.spread() > 1:
        return f"pending, {TITLES[scenario]}: {counts} is not within one component"
    if trial.policy == "least_loaded" and scenario == "at-once" and max(trial.counts().values()) < 12:
        return f"least_loaded, all at once: {counts}, where the paper has all on one host"
    if scenario == "staggered" and not all(trial.counts().values()):
        return f"{trial.policy}, {TITLES[scenario]}: {counts} leaves a host unused"
    return ""


def _table(done: list[tuple[str, PlacementTrial]]) -> None:
    hosts = list(done[0][1].counts())
    rows = [
        [
            TITLES[scenario],
            trial.policy,
            *map(str, trial.counts().values()),
            str(trial.spread()),
            f"{trial.apart():.2f}",
        ]
        for scenario, trial in done
    ]
    terminal.print_table(
        ["started", "policy", *hosts, "spread", "load apart"],
        rows,
        title="Components of three Place Sensor Nets on each host; load apart in cores, at the end",
    )


def _as_object(trial: PlacementTrial) -> dict[str, object]:
    return {
        "policy": trial.policy,
        "gap": trial.gap,
        "apart": trial.apart(),
        "hosts": trial.counts(),
        "spread": trial.spread(),
        "placed": trial.placed,
        "loads": trial.loads,
    }

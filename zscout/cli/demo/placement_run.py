"""The processes of `zscout demo placement`: three nodes that each report the load of what they started, and
components that really work."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from zscout import clock
from zscout.balancing.model import Policy
from zscout.cli.common import Failed
from zscout.cli.demo.processes import HOSTS, Processes
from zscout.config import load_fleet
from zscout.keyexpr import Role, Sender, Token
from zscout.mesh import Declared, Mesh
from zscout.messages import (
    ComponentSpec,
    EndComponent,
    HostRanking,
    LoadReport,
    PlaceComponent,
    Placement,
    Placements,
    RankAsk,
)
from zscout.scheduling.model import SECOND, Ns

NETS: Final = 3
NET: Final = ("locate-dark", "servo", "hide", "watch")
"""The components of one Place Sensor Net, as the paper has it."""
CPU: Final = 0.05
"""Share of a core that each component burns."""
START: Final = 30.0
"""Seconds within which everything must be there."""
PLACE: Final = 20.0
REPORT: Final = 20.0
SHOWN: Final = 2
"""Reports of each host while all components work."""
TRIES: Final = 3


@dataclass(slots=True)
class Trial:
    """Three Place Sensor Nets under one policy, and what was seen of them."""

    policy: Policy
    gap: float
    """Seconds from one net to the next; 0: all at once."""
    placed: dict[str, str] = field(default_factory=dict)
    loads: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    """By host: seconds since the first start, cores that its components used."""

    def counts(self) -> dict[str, int]:
        """Components on each host."""
        hosts = list(self.placed.values())
        return {host: hosts.count(host) for host in HOSTS}

    def spread(self) -> int:
        """Components on the fullest host less those on the emptiest."""
        counts = self.counts().values()
        return max(counts) - min(counts)

    def apart(self) -> float:
        """Highest less lowest of what components use on a host, in cores, at the end."""
        latest = [curve[-1][1] for curve in self.loads.values() if curve]
        return max(latest) - min(latest) if latest else 0.0


class PlacementDemo:
    """Three nodes and one trial on them: another trial would begin with the loads that this one left. Use as
    an async context manager: no process is left afterwards.

    `tell(at, text)` gets each event in words, `at` in seconds since the first start."""

    def __init__(self, folder: Path, trial: Trial, tell: Callable[[float, str], None]) -> None:
        self.trial = trial
        self._processes = Processes(folder)
        self._tell = tell
        self._mesh: Mesh | None = None
        self._zero: Ns | None = None
        self._declared: list[Declared] = []
        self._told: dict[str, str] = {}
        self._running: dict[str, set[str]] = {}
        """Components by host, as its newest report has them."""
        self._reported = asyncio.Event()

    async def run(self) -> None:
        """Starts three Place Sensor Nets, sees them work, and ends them. Raises Failed, MeshError."""
        await self._processes.watched(self._play())

    async def _play(self) -> None:
        await self._start()
        self._zero = clock.now()
        names = [[f"{part}-{net + 1}" for part in NET] for net in range(NETS)]
        if self.trial.gap:
            for number, net in enumerate(names):
                if number:
                    await asyncio.sleep(self.trial.gap)
                await asyncio.gather(*map(self._place, net))
        else:
            await asyncio.gather(*(self._place(name) for net in names for name in net))
        await self._processes.within(REPORT, self._shown(), "no load report told of all components")
        await asyncio.gather(*(self._ask(EndComponent(name)) for net in names for name in net))

    async def _start(self) -> None:
        """Starts the nodes, and waits until all are there and report."""
        await self._processes.start_nodes({}, 'load = "tree"\n')
        fleet = load_fleet(self._processes.fleet_file)
        mesh = self._mesh = await Mesh.open(fleet.name, Sender("demo", "watch"), fleet.mesh)
        missing, complete = {Role.RCM, Role.RECORDER, *HOSTS}, asyncio.Event()

        def there(what: str) -> None:
            missing.discard(what)
            if not missing:
                complete.set()

        def seen(token: Token, alive: bool) -> None:
            if alive:
                there(token.role)

        def reported(_key: str, report: LoadReport) -> None:
            there(report.host)
            self._on_load(report)

        self._declared = [
            mesh.subscribe(mesh.keys.load_any, LoadReport, reported),
            mesh.subscribe(mesh.keys.placements, Placements, self._on_placements),
            mesh.watch(mesh.keys.alive_any(), seen),
        ]
        await self._processes.within(START, complete.wait(), "the nodes did not find each other")
        await self._processes.within(START, self._all_ranked(), "the balancer did not hear of all nodes")

    async def _all_ranked(self) -> None:
        assert self._mesh is not None  # noqa: S101
        while True:
            reply = await self._mesh.ask_one(self._mesh.keys.rank, RankAsk(), HostRanking, timeout=1)
            if reply is not None and reply.message is not None and len(reply.message.hosts) == len(HOSTS):
                return
            await asyncio.sleep(0.1)

    async def _shown(self) -> None:
        """Waits until the reports have told of all components, and then once more of each host."""
        while sum(map(len, self._running.values())) < len(self.trial.placed):
            self._reported.clear()
            await self._reported.wait()
        lengths = {host: len(curve) for host, curve in self.trial.loads.items()}
        while any(len(curve) < lengths[host] + SHOWN for host, curve in self.trial.loads.items()):
            self._reported.clear()
            await self._reported.wait()

    async def _place(self, name: str) -> None:
        spec = ComponentSpec("spin", {"cpu": CPU}, "never", metric="load_average", policy=self.trial.policy)
        placement = await self._ask(PlaceComponent(name, spec, wait=PLACE))
        if placement.state != "running" or placement.host is None:
            raise Failed(f"{name} does not run: {placement.reason or placement.state} {placement.tail}")
        self.trial.placed[name] = placement.host

    async def _ask(self, operation: PlaceComponent | EndComponent) -> Placement:
        """Asks the placer; again, where no answer came. Raises Failed."""
        assert self._mesh is not None  # noqa: S101
        why = "the placer did not answer"
        for _ in range(TRIES):
            reply = await self._mesh.ask_one(
                self._mesh.keys.placer, operation, Placement, timeout=operation.wait + 2
            )
            if reply is not None and reply.message is not None:
                return reply.message
            if reply is not None and reply.problem is not None:
                why = reply.problem.message
        raise Failed(f"{operation.component}: {why}")

    # What is seen

    def _on_placements(self, _key: str, told: Placements) -> None:
        for one in told.components:
            words = f"{one.component} {one.state}" + (f" on {one.host}" if one.host else "")
            if self._told.get(one.component) != words and one.state in ("running", "moving", "given_up"):
                self._tell(self._elapsed(), f"{words}: {one.reason}" if one.reason else words)
            self._told[one.component] = words

    def _on_load(self, report: LoadReport) -> None:
        if self._zero is not None and report.host in HOSTS:
            self._running[report.host] = {use.component for use in report.components}
            used = sum(use.cpu for use in report.components)
            self.trial.loads.setdefault(report.host, []).append((self._elapsed(), used))
            self._reported.set()

    def _elapsed(self) -> float:
        return (clock.now() - self._zero) / SECOND if self._zero is not None else 0.0

    async def __aenter__(self) -> Self:
        await self._processes.__aenter__()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._mesh is not None:
            await self._mesh.close()
        await self._processes.__aexit__(kind, error, trace)


def as_object(trial: Trial) -> dict[str, object]:
    """For --json."""
    return {
        "policy": trial.policy,
        "gap": trial.gap,
        "apart": trial.apart(),
        "hosts": trial.counts(),
        "spread": trial.spread(),
        "placed": trial.placed,
        "loads": trial.loads,
    }

"""`zscout demo table1`: three nodes, the paper's five behaviors, and a process that watches.

After the first request it only subscribes: its queries to the RCM would be part of the picture."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Final

import msgspec

from zscout.keyexpr import Sender
from zscout.mesh import Mesh, ZenohMesh
from zscout.messages import Grants, LoadReport, RcmState, StateAsk, decimal_seconds
from zscout.scheduling.reason import ended, waits
from zscout.simulation.building.node_file import rc_table
from zscout.simulation.demo.arc import ArcReport, ArcSpec
from zscout.simulation.demo.runner import HOSTS, DemoRunner
from zscout.simulation.demo.tables import Observed
from zscout.simulation.workload import Arrival, Workload
from zscout.types import NO_TERM, SECOND, Grant, Ns, Term

START: Final = 30.0  # s until everything must be present
ANSWER: Final = 5.0
LATE: Final = 5.0  # s that an ARC's end may be late


class Table1Demo(DemoRunner):
    """A run of a workload; `zero` is the first request."""

    def __init__(
        self,
        folder: Path,
        workload: Workload,
        show: Callable[[float, str], None],
        on_live: Callable[[str], Awaitable[None]] | None = None,
    ) -> None:
        super().__init__(folder, show, on_live)
        self.workload = workload
        self.seen = Observed()
        self._behaviors: dict[str, asyncio.subprocess.Process] = {}
        self._milestones: dict[tuple[str, str], asyncio.Event] = {}  # by ARC and milestone
        self._mesh: Mesh | None = None
        self._newest: tuple[Term, int] = (NO_TERM, 0)
        self._shown: set[Grant] = set()
        self._published = asyncio.Event()

    async def play(self) -> None:
        devices = {host: self.workload.rcs[at :: len(HOSTS)] for at, host in enumerate(HOSTS)}
        await self.start_nodes(
            {host: "".join(rc_table(rc.name, "exclusive") for rc in rcs) for host, rcs in devices.items()}
        )
        await self._start_arcs()
        self._mesh = await ZenohMesh.open(self.fleet(), Sender("demo", "watch"))
        await self.within(START, self._all_ready(self._mesh), "the nodes did not find each other")
        ready = (self._milestone(arrival.request.arc, "ready").wait() for arrival in self.workload.arrivals)
        await self.within(START, asyncio.gather(*ready), "the behaviors did not find the nodes")
        self.event("all nodes, devices and behaviors are there")
        # In the file's order; at the same instant each request waits for the answer to the request before.
        for arrival in sorted(self.workload.arrivals, key=lambda arrival: arrival.at):
            if self.zero is not None:
                await asyncio.sleep(max(0, arrival.at / SECOND - self.elapsed()))
            await self._signal(arrival.request.arc)
        done = [self._milestone(arrival.request.arc, "done").wait() for arrival in self.workload.arrivals]
        assert self.zero is not None  # noqa: S101
        left = _latest_end(self.workload.arrivals) / SECOND - self.elapsed()
        await self.within(left + LATE, asyncio.gather(*done), "not all requests had their time")
        await self.within(ANSWER, self._all_free(), "the leader did not publish the last end")

    async def _all_ready(self, mesh: Mesh) -> None:
        mesh.subscribe(mesh.keys.grants, Grants, self._on_grants)
        mesh.subscribe(mesh.keys.load_any, LoadReport, self._on_load)
        await self.all_there(mesh)
        wanted = {rc.name for rc in self.workload.rcs}
        while True:
            reply = await mesh.ask_one(mesh.keys.ask_state(mesh.me), StateAsk(), RcmState, timeout=1.0)
            state = reply.message if reply is not None else None
            if state is not None and wanted <= {view.rc for view in state.rcs if view.present}:
                return
            await asyncio.sleep(0.05)

    async def _start_arcs(self) -> None:
        for number, arrival in enumerate(self.workload.arrivals):
            request = arrival.request
            arc = ArcSpec(
                host=HOSTS[number % len(HOSTS)],
                arc=request.arc,
                needs=tuple(sorted(request.needs)),
                priority=request.priority,
                min_runtime=decimal_seconds(request.min_runtime),
            )
            process = await self.start(request.arc, ["-m", "zscout.simulation.demo.arc"], piped=True)
            self._behaviors[request.arc] = process
            assert process.stdin is not None  # noqa: S101
            process.stdin.write(msgspec.json.encode(arc) + b"\n")
            self.spawn(self._follow(process, arc))

    async def close(self) -> None:
        if self._mesh is not None:
            await self._mesh.close()

    async def _signal(self, arc: str) -> None:
        stdin = self._behaviors[arc].stdin
        assert stdin is not None  # noqa: S101
        stdin.write(b"\n")
        await self.within(ANSWER, self._milestone(arc, "answered").wait(), f"{arc} got no answer")

    def _milestone(self, arc: str, what: str) -> asyncio.Event:
        return self._milestones.setdefault((arc, what), asyncio.Event())

    async def _follow(self, process: asyncio.subprocess.Process, arc: ArcSpec) -> None:
        assert process.stdout is not None  # noqa: S101
        while line := await process.stdout.readline():
            report = msgspec.json.decode(line, type=ArcReport)
            match report.what:
                case "asked":
                    if self.zero is None:
                        self.zero = self.seen.zero = report.at
                    needs = f"{', '.join(arc.needs)}; priority {arc.priority}"
                    self.event(f"{arc.arc} asks for {needs}", report.at)
                case "answered" if report.detail:
                    self.event(f"{arc.arc} {waits(report.detail, report.why)}", report.at)
                case "entered":
                    self.seen.entered(arc.arc, arc.needs, report.at)
                case "left":
                    self.seen.left(arc.arc, report.at)
            self._milestone(arc.arc, report.what).set()

    def _on_grants(self, _key: str, grants: Grants) -> None:
        assert self._mesh is not None  # noqa: S101
        at = self._mesh.now()
        if (grants.term, grants.seq) < self._newest:
            return
        self._newest = (grants.term, grants.seq)
        for revoked in grants.revoked:
            self.event(f"{revoked.arc} {ended(revoked.outcome, revoked.reason, revoked.why)}", at)
        for holder in (holder for held in grants.rcs.values() for holder in held):
            if holder.grant not in self._shown:
                self._shown.add(holder.grant)
                rcs, seconds = ", ".join(holder.rcs), float(holder.min_runtime)
                self.event(f"{holder.arc} runs on {rcs} for {seconds:g} s", at)
        for rc, held in grants.rcs.items():
            self.seen.published(rc, [holder.arc for holder in held], at)
        self._published.set()

    async def _all_free(self) -> None:
        while not self.seen.free:
            self._published.clear()
            await self._published.wait()

    def _on_load(self, key: str, report: LoadReport) -> None:
        if report.host in HOSTS:
            self.seen.loads[report.host] = report


def _latest_end(arrivals: Sequence[Arrival]) -> Ns:
    """Latest end if all ran in sequence, from the last arrival (ns)."""
    return max(arrival.at for arrival in arrivals) + sum(arrival.request.min_runtime for arrival in arrivals)

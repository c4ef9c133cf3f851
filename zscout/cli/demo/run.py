"""The processes of `zscout demo`: three nodes, the paper's five behaviors, and one place that watches.

The watching place only listens once the first ARC has asked: asking the RCM would be part of what is shown.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import msgspec

from zscout import clock
from zscout.cli.demo.arc import Part, Word
from zscout.cli.demo.processes import HOSTS, Processes
from zscout.cli.demo.tables import Observed
from zscout.config import load_fleet
from zscout.keyexpr import Role, Sender, Token
from zscout.mesh import Declared, Mesh
from zscout.messages import Grants, LoadReport, RcmState, StateAsk
from zscout.scheduling.model import NO_TERM, SECOND, Grant, Ns, Term
from zscout.scheduling.workload import Arrival, Workload
from zscout.services import views

START: Final = 30.0
"""Seconds within which everything must be there."""
ANSWER: Final = 5.0
LATE: Final = 5.0
"""Seconds that an ARC's end may be late before the demo gives up."""


class Demo:
    """One run of a workload. Use as an async context manager: no process is left afterwards.

    `tell(at, text)` gets each event in words, `at` in seconds since the first ARC asked.
    """

    def __init__(self, folder: Path, workload: Workload, tell: Callable[[float, str], None]) -> None:
        self.workload, self._tell = workload, tell
        self.seen = Observed()
        self._processes = Processes(folder)
        self._behaviors: dict[str, asyncio.subprocess.Process] = {}
        self._tasks: list[asyncio.Task[None]] = []
        self._words: dict[tuple[str, str], asyncio.Event] = {}
        self._mesh: Mesh | None = None
        self._newest: tuple[Term, int] = (NO_TERM, 0)
        self._told: set[Grant] = set()
        self._published = asyncio.Event()
        self._declared: list[Declared] = []

    async def run(self) -> None:
        """Plays the whole workload. Raises Failed, MeshError, BadInput."""
        await self._processes.watched(self._play())

    async def _play(self) -> None:
        devices = {host: self.workload.rcs[at :: len(HOSTS)] for at, host in enumerate(HOSTS)}
        await self._processes.start_nodes(
            {
                host: "".join(f'[[rc]]\nname = "{rc.name}"\ndriver = "exclusive"\n' for rc in rcs)
                for host, rcs in devices.items()
            }
        )
        await self._start_arcs()
        fleet = load_fleet(self._processes.fleet_file)
        self._mesh = await Mesh.open(fleet.name, Sender("demo", "watch"), fleet.mesh)
        await self._processes.within(START, self._all_there(self._mesh), "the nodes did not find each other")
        ready = (self._word(arrival.request.arc, "ready").wait() for arrival in self.workload.arrivals)
        await self._processes.within(START, asyncio.gather(*ready), "the behaviors did not find the nodes")
        self._tell(0.0, "all nodes, devices and behaviors are there")
        # In the order of the file; who asks in one instant asks one after the other's answer.
        for arrival in sorted(self.workload.arrivals, key=lambda arrival: arrival.at):
            if self.seen.zero is not None:
                await asyncio.sleep(max(0, self.seen.zero + arrival.at - clock.now()) / SECOND)
            await self._signal(arrival.request.arc)
        done = [self._word(arrival.request.arc, "done").wait() for arrival in self.workload.arrivals]
        assert self.seen.zero is not None  # noqa: S101
        left = (self.seen.zero + _latest_end(self.workload.arrivals) - clock.now()) / SECOND
        await self._processes.within(left + LATE, asyncio.gather(*done), "not all ARCs had their time")
        await self._processes.within(ANSWER, self._all_free(), "the RCM did not publish the last end")

    # Processes

    async def _all_there(self, mesh: Mesh) -> None:
        missing, complete = {Role.RCM, Role.RECORDER}, asyncio.Event()

        def seen(token: Token, alive: bool) -> None:
            if alive:
                missing.discard(token.role)
            if not missing:
                complete.set()

        self._declared = [
            mesh.subscribe(mesh.keys.grants, Grants, self._on_grants),
            mesh.subscribe(mesh.keys.load_any, LoadReport, self._on_load),
            mesh.watch(mesh.keys.alive_any(), seen),
        ]
        await complete.wait()
        wanted = {rc.name for rc in self.workload.rcs}
        while True:
            reply = await mesh.ask_one(mesh.keys.rcm_state, StateAsk(), RcmState, timeout=1.0)
            state = reply.message if reply is not None else None
            if state is not None and wanted <= {view.rc for view in state.rcs if view.present}:
                return
            await asyncio.sleep(0.05)

    async def _start_arcs(self) -> None:
        for number, arrival in enumerate(self.workload.arrivals):
            request = arrival.request
            part = Part(
                host=HOSTS[number % len(HOSTS)],
                arc=request.arc,
                needs=tuple(sorted(request.needs)),
                priority=request.priority,
                min_runtime=views.seconds(request.min_runtime),
            )
            process = await self._processes.start(request.arc, ["-m", "zscout.cli.demo.arc"], speaks=True)
            self._behaviors[request.arc] = process
            assert process.stdin is not None  # noqa: S101
            process.stdin.write(msgspec.json.encode(part) + b"\n")
            self._tasks.append(asyncio.create_task(self._hear(process, part)))

    async def __aenter__(self) -> Self:
        await self._processes.__aenter__()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._mesh is not None:
            await self._mesh.close()
        await self._processes.__aexit__(kind, error, trace)
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    # What happens

    async def _signal(self, arc: str) -> None:
        """Has an ARC ask, and waits for its answer."""
        stdin = self._behaviors[arc].stdin
        assert stdin is not None  # noqa: S101
        stdin.write(b"\n")
        await self._processes.within(ANSWER, self._word(arc, "answered").wait(), f"{arc} got no answer")

    def _word(self, arc: str, what: str) -> asyncio.Event:
        return self._words.setdefault((arc, what), asyncio.Event())

    async def _hear(self, process: asyncio.subprocess.Process, part: Part) -> None:
        """Follows what a behavior says."""
        assert process.stdout is not None  # noqa: S101
        while line := await process.stdout.readline():
            word = msgspec.json.decode(line, type=Word)
            match word.what:
                case "asked":
                    if self.seen.zero is None:
                        self.seen.zero = word.at
                    self._say(
                        word.at, f"{part.arc} asks for {', '.join(part.needs)}; priority {part.priority}"
                    )
                case "answered" if word.detail:
                    self._say(word.at, f"{part.arc} waits: {word.detail}")
                case "entered":
                    self.seen.entered(part.arc, part.needs, word.at)
                case "left":
                    self.seen.left(part.arc, word.at)
                case _:
                    pass
            self._word(part.arc, word.what).set()

    def _on_grants(self, _key: str, said: Grants) -> None:
        at = clock.now()
        if (said.term, said.seq) < self._newest:
            return
        self._newest = (said.term, said.seq)
        for revoked in said.revoked:
            why = revoked.reason if revoked.reason.startswith(revoked.outcome) else ""
            self._say(at, f"{revoked.arc} {why or f'{revoked.outcome}: {revoked.reason}'}")
        for holder in (holder for held in said.rcs.values() for holder in held):
            if holder.grant not in self._told:
                self._told.add(holder.grant)
                self._say(
                    at, f"{holder.arc} runs on {', '.join(holder.rcs)} for {float(holder.min_runtime):g} s"
                )
        for rc, held in said.rcs.items():
            self.seen.published(rc, [holder.arc for holder in held], at)
        self._published.set()

    async def _all_free(self) -> None:
        while not self.seen.free:
            self._published.clear()
            await self._published.wait()

    def _on_load(self, key: str, report: LoadReport) -> None:
        if report.host in HOSTS:
            self.seen.loads[report.host] = report

    def _say(self, at: Ns, text: str) -> None:
        zero = self.seen.zero
        self._tell((at - zero) / SECOND if zero is not None else 0.0, text)


def _latest_end(arrivals: Sequence[Arrival]) -> Ns:
    """When everything is over even if it runs one after the other, each once more after a preemption."""
    return max(arrival.at for arrival in arrivals) + sum(arrival.request.min_runtime for arrival in arrivals)

"""A fleet under faults in virtual time: the real services and clients, each process on a mesh in memory.

A seed always gives the same run, byte for byte: the work, the faults, the network's delays, and the clock and
randomness of every process. At the end all faults are over, and all requests must be served."""

from __future__ import annotations

import asyncio
import gc
import hashlib
import logging
import math
import random
from collections import Counter
from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from functools import partial
from typing import Any, Final, TypeVar

import msgspec
from msgspec.structs import replace

from studies.faults import forgers, plan
from studies.faults.bookers import Booker, Hosts
from studies.faults.booking_promises import BookingPromises
from studies.faults.components import DEEDS, KINDS, Deeds, SimulatedComponent, operate, report_load
from studies.faults.device import Device, WatchedCapacity, WatchedExclusive
from studies.faults.excuses import IMPATIENCE, Excuses
from studies.faults.liars import lie
from studies.faults.plan import OPERATIONS, Fault
from studies.faults.programs import Work, steal_places
from studies.faults.promises import LEFT_OVER, Promises
from zscout import trace
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.request import OpenArc
from zscout.config.access import AccessPolicy, Roles
from zscout.config.fleet import default_fleet
from zscout.config.node import ComponentsConfig
from zscout.drivers.confirm_server import ConfirmServer
from zscout.drivers.last_holder import LastHolder
from zscout.drivers.resource_controller import ResourceController
from zscout.drivers.tolerance import Tolerance
from zscout.keyexpr import Role, Sender, Token, new_instance
from zscout.mesh.supervision import StallWatch, Supervisor
from zscout.messages import MAX_COUNTER, Grants
from zscout.scheduling.reason import ReasonCode
from zscout.services.bookings.keeper import BookingKeeper
from zscout.services.node.component_host import ComponentHost
from zscout.services.rcm.candidate import Candidate, CandidateParts
from zscout.services.rcm.rcm import Rcm
from zscout.testing.memory import MemoryMesh, MemoryNetwork, MemoryTransport
from zscout.testing.virtual_time import PROCESS, START, Process, VirtualTimeLoop
from zscout.types import NO_TERM, SECOND, Grant, Place, Term

T = TypeVar("T")


class TermMemory:
    """A disk with the highest term, which outlives processes."""

    term: Term = NO_TERM

    def read(self) -> Term:
        return self.term

    async def write(self, term: Term) -> None:
        self.term = term


DEVICES: Final[Mapping[str, Mapping[str, Fraction] | None]] = {
    "robot/a": None,
    "robot/b": None,
    "robot/c": None,
    "framegrabber/f": None,
    "radio/r": {"rate": Fraction(10)},
}
EXCLUSIVE: Final = tuple(rc for rc, capacity in DEVICES.items() if capacity is None)
REBOOTS: Final = 8.0
"""Longest outage of a device in seconds, in runs with unwell devices."""
TOLERATED: Final = 60 * SECOND
"""The outage that RCs tolerate."""
REPORTED_WITHIN: Final = 1.0
"""Seconds without any fault after which a leader knows that a device is unwell, and earlier grants have arrived."""
SLOW: Final[Mapping[str, float]] = {"robot/a": 4.0, "framegrabber/f": 1.0}
"""Seconds that some devices need to start, in runs with slow devices."""
DRIFT: Final = 0.001
"""Largest difference between the rates of two clocks."""
SERVED_WITHIN: Final = 60.0
"""Seconds after the last fault within which all requests must be served."""
FORGOTTEN: Final = 0.3
"""Share of declarations that are lost when links return incompletely."""
SETTLE: Final = 2.0
"""Seconds that RCs settle."""
SETTLED_WITHIN: Final = 60.0
"""Seconds after the last service within which all keepers know the same bookings. Keepers are asked every 30 s; a
keeper without a query for 40 s reopens its session."""
COPIED_AT: Final = 10.0
"""Seconds after the beginning at which disks are copied."""
LOOK_EVERY: Final = 0.05
FORGED_EVERY: Final = 0.25
OPERATOR: Final = "h0/operator"
THIEF: Final = "h0/thief"
PLACES_KEY: Final = bytes(32)


@dataclass(frozen=True, slots=True)
class Size:
    """The size and kind of a run."""

    hosts: int = 3
    """Hosts with a candidate. Half of the runs have another host without a candidate."""
    clients: int = 4
    components: int = 2
    faults: int = 6
    span: float = 30.0
    """Seconds with faults and new requests."""
    pause: float = 3.0
    """Longest time in seconds from a request of a program to its next."""
    direct: bool = False
    """Many programs use devices past their RCs."""
    thief: bool = False
    """Managers share a key, and a program requests at the places of others. Commands arrive twice."""
    moves_only: bool = False
    """Only nodes fail, in the steps of a component's move: no other fault excuses a broken promise."""
    liars: bool = False
    """The fleet has certificates, and members lie about terms."""
    bookers: int = 0
    """Programs that book, give up and take up."""
    slow: bool = False
    """Two devices need time to start for a holder."""
    unwell: bool = False
    """Devices fail temporarily now and then."""
    commands: bool = False
    """Many programs run commands: they are protected for longer than they rank by."""
    forger: bool = False
    """The fleet has certificates, and a member lists, reports and keeps forgeries."""

    @classmethod
    def of(cls, seed: int) -> Size:
        """The kind of a run. Of ten runs one is long with many clients; one each has failing moves, programs that use
        devices past their RCs, commands, a thief, and liars; two have bookings. Every twentieth run has a forger, every
        fortieth slow devices, every eightieth unwell devices."""
        match seed % 10:
            case 3 | 4:
                return cls(bookers=2, clients=3, faults=4, span=40.0)
            case 8:
                return cls(direct=True, span=40.0)
            case 9:
                return cls(hosts=4, clients=20, faults=30, span=300.0, pause=60.0)
            case 7:
                return cls(moves_only=True)
            case 2:
                return cls(commands=True)
            case 0:
                return cls(thief=True)
            case 6:
                return cls(liars=True)
            case 5 if seed % 20 == 5:
                return cls(forger=True)
            case 5 if seed % 40 == 35:
                return cls(slow=True)
            case 5 if seed % 80 == 15:
                return cls(unwell=True)
        return cls()


@dataclass(slots=True)
class Result:
    seed: int
    faults: list[Fault]
    broken: list[str] = field(default_factory=list)
    """Broken promises, each with the time."""
    lines: list[str] = field(default_factory=list)
    trace: list[str] = field(default_factory=list)
    """The events of holds in order (`zscout.trace`)."""
    digest: str = ""
    """Digest of all messages that arrived, in order."""
    counts: Counter[str] = field(default_factory=Counter)
    served_after: float = 0.0
    """Seconds from the end of the last fault until all requests were served."""


def simulate(
    seed: int, size: Size | None = None, faults: Sequence[Fault] | None = None, *, traced: bool = False
) -> Result:
    """Simulate a run. `faults` replaces the faults drawn by the seed; `traced`: keep the trace of holds."""
    fleet = Simulation(seed, size or Size.of(seed), faults, traced=traced)
    logger, handler = logging.getLogger("zscout"), _Lines(fleet)
    before = logger.level, logger.propagate
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    trace.log.setLevel(logging.DEBUG)
    logger.propagate = False
    collecting = gc.isenabled()
    gc.disable()  # collected objects could otherwise act at random points of the run
    try:
        with asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
            runner.get_loop().set_exception_handler(fleet.on_exception)
            return runner.run(fleet.run())
    finally:
        logger.removeHandler(handler)
        logger.level, logger.propagate = before
        trace.log.setLevel(logging.NOTSET)
        if collecting:
            gc.enable()


class Simulation:
    def __init__(self, seed: int, size: Size, faults: Sequence[Fault] | None, *, traced: bool = False) -> None:
        self.seed, self.size, self._traced = seed, size, traced
        self.random = random.Random(f"fleet {seed}")  # noqa: S311 - failures must be repeatable
        self.hosts = [f"h{number}" for number in range(size.hosts + (self.random.random() < 0.5))]
        self.candidates_at = self.hosts[: size.hosts]
        self.clients = {f"{self.random.choice(self.hosts)}/c{number}": None for number in range(size.clients)}
        fleet = default_fleet()
        self.fleet = replace(fleet, strategy=self.random.choice(("priority", "adaptive")))
        if size.bookers:
            self.fleet = replace(self.fleet, strategy="adaptive")
        if size.commands:
            self.fleet = replace(self.fleet, min_runtime=SECOND // 2, command_min_runtime=20 * SECOND)
        if size.forger:
            self.fleet = forgers.closed(replace(self.fleet, strategy="adaptive"), self.hosts, self.candidates_at)
        self.where = {rc: f"{self.random.choice(self.hosts)}/{self._program(rc)}" for rc in DEVICES}
        """The process of each RC: its host's node, or a process of its own without a candidate."""
        bookers = [f"{self.random.choice(self.hosts)}/b{number}" for number in range(size.bookers)]
        self.clients |= dict.fromkeys(bookers)
        self.running: dict[str, tuple[Process, MemoryMesh]] = {}
        self.candidates: dict[str, Candidate] = {}
        self.excused: set[str] = set()
        """Clients that need not be served at the end."""
        self.keepers: dict[str, BookingKeeper] = {}
        """The keepers of live processes, by host."""
        self.rcs: dict[str, ResourceController] = {}
        self.programs: dict[str, Client] = {}
        self.busy: dict[str, set[str]] = {}
        """By program: its ARCs that are not over."""
        self.present: list[Fault] = []
        """The present faults."""
        self.calm_since = START
        """When the last fault ended."""
        self.everybody = [
            *dict.fromkeys((*(f"{host}/node" for host in self.hosts), *self.where.values(), *self.clients))
        ]
        if size.moves_only:
            drawn = plan.draw_moves(seed, self.everybody, count=size.faults, span=size.span)
        else:
            drawn = plan.draw(seed, self.everybody, self.hosts, sorted(DEVICES), count=size.faults, span=size.span)
        if size.liars:
            drawn = plan.draw_lies(seed, self.hosts, size.span, drawn)
            roles = Roles(manager=tuple(self.hosts))
            self.fleet = replace(self.fleet, access=AccessPolicy(roles=roles))
        self.term_disks = {host: TermMemory() for host in self.hosts}
        if size.bookers:
            drawn = plan.draw_for_bookings(seed, self.hosts, size.span, drawn)
        if size.direct:
            # A second instance has its own device, which no program of the first instance uses.
            drawn = [fault for fault in drawn if fault.kind != "double"]
        self.last_holders = {rc: LastHolder() for rc in DEVICES}
        """The last holders that RCs keep on disk."""
        self.faults = drawn if faults is None else list(faults)
        self.cuts: Counter[tuple[str, str]] = Counter()
        self.result = Result(seed, self.faults)
        self.idle, self.failed = asyncio.Event(), asyncio.Event()
        self._had: dict[str, set[tuple[str, Place]]] = {}
        """By instance of an RC: its holding ARCs at the last look."""

    def _program(self, rc: str) -> str:
        return "node" if self.random.random() < 0.6 else f"rc-{rc.replace('/', '-')}"

    async def run(self) -> Result:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualTimeLoop)
        self.loop, loop.isolated = loop, True
        self.network = MemoryNetwork(
            lease=self.fleet.mesh.lease,
            impatience=IMPATIENCE,
            relink=plan.RELINK,
            seed=self.seed,
            closed=self.size.liars,
        )
        self._digest = hashlib.blake2b(digest_size=16)
        self.network.trace = self._trace
        self.devices = {rc: self._device(rc) for rc in DEVICES}
        calm = lambda: 0.0 if self.present else loop.now - self.calm_since  # noqa: E731
        DEEDS.set(Deeds(self.broken, calm, lambda: self.work.over, self.busy))
        self.component = type("Component", (SimulatedComponent,), {"processes": self})
        touched = self.devices if self.size.direct else None
        counts = self.result.counts
        self.work = Work(DEVICES, self.size.pause, counts, self.log, self.broken, self.size.commands, touched)
        self.promises = Promises(
            self.broken,
            lambda: loop.now,
            self.fleet.timing.hold_lease / SECOND,
            strict=self.fleet.strategy == "priority",
            thief=THIEF,
        )
        self.excuses = Excuses(
            hosts=self.hosts,
            candidates_at=self.candidates_at,
            where=self.where,
            faults=self.faults,
            fleet=self.fleet,
            leading=lambda: {host: at.rcm.term for host, at in self.candidates.items() if at.rcm is not None},
            terms=self.promises.terms,
            now=lambda: loop.now,
        )
        self.equipment = Hosts(self.seed, self.hosts, lambda: loop.now, booked=self.size.bookers > 0)
        self.booked = BookingPromises(
            self.broken,
            lambda: loop.now,
            self.keepers,
            self.equipment.disks,
            self.equipment.believed,
            self.candidates_at,
            lambda: not self.present,
            lambda host, call: self.running[f"{host}/node"][0].run(call),
        )
        bookers = [name for name in self.clients if name.split("/")[1].startswith("b")]
        self.bookers = {name: Booker(name, self.work, self.booked) for name in bookers}
        for name in (*self.everybody, OPERATOR):
            self.start(name)
        loop.call_later(COPIED_AT, self.equipment.copy_disks)
        if self.size.thief:
            self.network.twice = ("command",)
            process, mesh = self.open_process(THIEF)
            process.main = process.run(asyncio.create_task, self._guard(steal_places(mesh, lambda: self.work.over)))
        if self.size.forger:
            process, mesh = self.open_process(forgers.FORGER)
            forging = forgers.forge(mesh, DEVICES, lambda: self.work.over)
            process.main = process.run(asyncio.create_task, self._guard(forging))
        look = asyncio.create_task(self._look())
        reboots = asyncio.create_task(self._reboot_devices())
        timers = [loop.call_later(fault.at, self._begin, fault) for fault in self.faults]
        done = asyncio.create_task(self._served())
        failed = asyncio.create_task(self.failed.wait())
        await asyncio.wait({done, failed}, return_when=asyncio.FIRST_COMPLETED)
        for timer in timers:
            timer.cancel()
        for task in (look, reboots, done, failed):
            task.cancel()
        self.result.digest = self._digest.hexdigest()
        for process, mesh in tuple(self.running.values()):
            process.kill()
            self.network.kill(mesh)
        return self.result

    def _goes_round_dates(self) -> set[str]:
        """Clients with ARCs that wait because of bookings: after a month, later dates may be near."""
        leaders = [candidate.rcm for candidate in self.candidates.values() if candidate.rcm is not None]
        return {
            arc.request.client
            for rcm in leaders
            for arc in rcm.core.status().queued
            if arc.reason is not None and arc.reason.code in (ReasonCode.MAINTENANCE, ReasonCode.BOOKED)
        }

    async def _served(self) -> None:
        """Wait until all faults are over and all requests are served, and check the end."""
        await asyncio.sleep(self.size.span)
        self.work.over = True
        end = max([self.size.span, *(fault.at + fault.lasts for fault in self.faults)])
        await asyncio.sleep(max(0.0, START + end - self.loop.now))
        self.log("all faults are over")
        mended = self.loop.now
        try:
            async with asyncio.timeout(SERVED_WITHIN):
                await self.idle.wait()
        except TimeoutError:
            self.excused = self._goes_round_dates()
            late = [
                f"{name} {arc}" for name, arcs in self.busy.items() for arc in sorted(arcs) if name not in self.excused
            ]
            if late:
                self.broken(f"not served within {SERVED_WITHIN:g} s: {', '.join(late)}")
        self.result.served_after = self.loop.now - mended
        await asyncio.sleep(LEFT_OVER)
        if self.bookers:
            await self._bookings_settled()
        faults = [(START + fault.at, START + fault.at + fault.lasts + plan.RELINK) for fault in self.faults]
        self.promises.at_end(self._alive(self.programs), self._leaders(), faults, self.excused)
        self.result.counts["terms"] += len(self.promises.terms)

    async def _bookings_settled(self) -> None:
        """Wait until all keepers know the same bookings, and check them against the acknowledgements."""
        try:
            async with asyncio.timeout(SETTLED_WITHIN):
                while self.booked.unsettled(self._leading_hosts()):  # noqa: ASYNC110 - there is no event for it
                    await asyncio.sleep(LOOK_EVERY)
        except TimeoutError:
            why = self.booked.unsettled(self._leading_hosts())
            self.broken(f"bookings are not the same everywhere within {SETTLED_WITHIN:g} s: {why}")
            return
        restarted = any(fault.kind == "restart" for fault in self.faults)
        self.result.counts += self.booked.at_end(self._leading_hosts(), jumped=restarted)

    def log(self, text: str) -> None:
        process = PROCESS.get()
        who = "" if process is None else process.name
        self.result.lines.append(f"{self.loop.now - START:8.3f}  {who:8}  {text}")

    def broken(self, text: str) -> None:
        process = PROCESS.get()
        if process is not None and process.dead:
            return
        self.log(f"BROKEN: {text}")
        self.result.broken.append(f"{self.loop.now - START:.3f} {text}")
        self.failed.set()

    def on_exception(self, _loop: object, context: dict[str, Any]) -> None:
        self.broken(f"an unhandled error: {context.get('exception') or context['message']!r}")

    def _trace(self, source: str, target: str, kind: str, args: tuple[Any, ...]) -> None:
        self.result.counts["messages"] += 1
        payload = next((arg for arg in args if isinstance(arg, bytes)), b"")
        self._digest.update(f"{self.loop.now:.9f} {source} {target} {kind} ".encode() + payload)

    def on_trace(self, line: str) -> None:
        if self._traced:
            self.result.trace.append(line)
        self.promises.event(msgspec.json.decode(line))

    async def _look(self) -> None:
        while True:
            await asyncio.sleep(LOOK_EVERY)
            silence = {
                key: process.run(rc.mesh.now) - rc.holds.last_contact
                for key, rc in self.rcs.items()
                if not (process := self.running[key.split()[0]][0]).stopped
            }
            clients = self._alive(self.programs)
            unled = {
                name: self.running[name][0].run(client.mesh.now) - client.internals.rcm._last_contact
                for name, client in clients.items()
            }
            # With two instances of an RC on one mesh, the fleet counts as calm.
            calm = all(fault.kind == "double" for fault in self.present)
            lasting = dict(self.booked.look(self._leading_hosts(), calm=not self.present)) if self.bookers else {}
            self.promises.look(clients, self.rcs, self._leaders(), silence, calm=calm, lasting=lasting)
            if self.size.unwell:
                self._check_unwell_devices()
            if self.size.forger:
                for why in filter(None, map(forgers.believed, self._leaders().values())):
                    self.broken(f"a leader believes a forger: {why}")
            self.promises.check_reverted_clients(clients, unled)
            if self.size.liars:
                self.promises.check_leaders_terms(self._leaders())
            if self.work.over and not any(self.busy.values()):
                self.idle.set()

    def _alive(self, of: dict[str, T]) -> dict[str, T]:
        """The items whose processes are not stopped."""
        return {name: item for name, item in of.items() if not self.running[name][0].stopped}

    def _leaders(self) -> dict[str, Rcm]:
        candidates = {f"{host}/node": candidate for host, candidate in self.candidates.items()}
        return {name: at.rcm for name, at in self._alive(candidates).items() if at.rcm is not None}

    def _leading_hosts(self) -> dict[str, Rcm]:
        return {name.split("/")[0]: rcm for name, rcm in self._leaders().items()}

    def start(self, name: str) -> None:
        process, mesh = self.open_process(name)
        process.run(self._start, process, name, mesh)

    def _start_all(self, names: Iterable[str]) -> None:
        for name in names:
            if self.running[name][0].dead:
                self.start(name)

    def open_process(self, name: str) -> tuple[Process, MemoryMesh]:
        rng = self.random
        process = Process(
            name,
            seed=(self.seed, rng.random()),
            rate=1 + rng.uniform(-DRIFT, DRIFT) / 2,
            boot=rng.uniform(100, 1_000_000),
        )
        self.running[name] = process, process.run(self.network.open, self.fleet.name, Sender(*name.split("/")))
        self._cut()
        return self.running[name]

    def end_process(self, name: str, reached: MemoryTransport | None = None) -> None:
        """Kill the process. Of its last messages only those to `reached` arrive, or by default a random part."""
        process, mesh = self.running.get(name, (None, None))
        self.busy.pop(name, None)
        if process is not None and mesh is not None and not process.dead:
            # In this order, so that clean-up code can't send messages.
            self.network.kill(mesh, reached)
            process.kill()
        if "." in name:  # a component's process, whose name is not used again
            self.running.pop(name, None)

    def _start(self, process: Process, name: str, mesh: MemoryMesh) -> None:
        host, program = name.split("/")
        main: Coroutine[Any, Any, None]
        if name not in self.clients:
            mesh.watch_links()
        if program == "node":
            main = self._node(host, mesh)
        elif name in self.where.values():
            main = self._offer_all(mesh, StallWatch(mesh.now).start())
        elif name == OPERATOR:
            main = operate(mesh, self.work, self.size.components)
        else:
            main = self._client(name, mesh)
        process.main = asyncio.create_task(self._guard(main))

    async def _guard(self, main: Coroutine[Any, Any, None]) -> None:
        try:
            await main
        except BaseException as error:
            self.broken(f"it ended with {error!r}")
            raise

    async def _node(self, host: str, mesh: MemoryMesh) -> None:
        stall = StallWatch(mesh.now).start()
        mesh_token = mesh.alive(Token(host, Role.NODE, "node", new_instance()))
        await self._offer_all(mesh, stall)
        leads = host in self.candidates_at
        keeper = BookingKeeper(
            mesh,
            self.equipment.disks[host],
            candidate=leads,
            wall=partial(self.equipment.wall, host),
            synchronised=partial(self.equipment.kept.__getitem__, host),
        )
        if leads:
            self.keepers[host] = keeper
            key = PLACES_KEY if self.size.thief or self.size.liars or self.size.forger else None
            parts = CandidateParts(places_key=key, keeper=keeper, disk=self.term_disks[host])
            candidate = self.candidates[host] = Candidate(mesh, self.fleet, parts)
            candidate.start()
        elif self.size.bookers and str(mesh.me) in self.where.values():
            self.keepers[host] = keeper
            keeper.start(Supervisor("the keeper of bookings", self._on_failure))
        component_host = ComponentHost(
            mesh, self.fleet, ComponentsConfig(), self._on_failure, kinds=lambda: KINDS, process=self.component
        )
        await component_host.start()
        await report_load(mesh)
        mesh_token.close()

    def _device(self, rc: str) -> Device:
        starts = SLOW.get(rc, 0.0) if self.size.slow else 0.0
        return Device(rc, DEVICES[rc], self.broken, self.log, now=lambda: self.loop.now, starts=starts)

    async def _offer(
        self, name: str, device: Device, mesh: MemoryMesh, stall: StallWatch, confirmations: ConfirmServer | None = None
    ) -> ResourceController:
        driver = WatchedExclusive(device) if device.capacity is None else WatchedCapacity(device)
        lease = self.fleet.timing.hold_lease / SECOND
        last = self.last_holders[name] if device is self.devices[name] else LastHolder()
        how: dict[str, Any] = {"settle": SETTLE, "last_holder": last, "on_failure": self._on_failure}
        how["confirmations"] = confirmations
        how["tolerance"] = Tolerance(TOLERATED, TOLERATED, TOLERATED) if self.size.unwell else None
        rc = ResourceController(mesh, name, driver, hold_lease=lease, stall=stall, **how)
        await rc.start()
        self.rcs[f"{mesh.me} {name}"] = rc
        return rc

    async def _offer_all(self, mesh: MemoryMesh, stall: StallWatch) -> None:
        confirmations = ConfirmServer(mesh)
        for rc in [rc for rc, at in self.where.items() if at == str(mesh.me)]:
            await self._offer(rc, self.devices[rc], mesh, stall, confirmations)

    async def _spare(self, name: str, mesh: MemoryMesh, leaves: asyncio.Event) -> None:
        """Offer another device of this name on another host, until `leaves` is set."""
        rc = await self._offer(name, self._device(name), mesh, StallWatch(mesh.now).start())
        await leaves.wait()
        await rc.stop()
        self.rcs.pop(f"{mesh.me} {name}", None)

    def _lives(self, name: str) -> bool:
        return not self.running[name][0].dead

    def _highest(self) -> int:
        return max((term.counter for term in self.promises.terms), default=0)

    async def _forge(self, mesh: MemoryMesh, jump: int) -> None:
        """Without a token."""
        term = Term(min(self._highest() + jump, MAX_COUNTER), new_instance())
        while True:
            mesh.put(mesh.keys.grants, Grants(term, 1, 1, FORGED_EVERY, {}, []))
            await asyncio.sleep(FORGED_EVERY)

    async def _reboot_devices(self) -> None:
        rng = random.Random(f"unwell {self.seed}")  # noqa: S311
        while self.size.unwell and not self.work.over:
            await asyncio.sleep(rng.uniform(1.0, REBOOTS / 2))
            name, why = rng.choice(EXCLUSIVE), "its device reboots"
            self._each(self._instances(name), lambda rc: rc.unwell(why))  # noqa: B023 - called before the next round
            self.result.counts["unwell"] += 1
            await asyncio.sleep(rng.uniform(1.0, REBOOTS))
            self._each(self._instances(name), ResourceController.recover)

    def _instances(self, name: str) -> dict[str, ResourceController]:
        return {key: rc for key, rc in self.rcs.items() if rc.name == name}

    def _check_unwell_devices(self) -> None:
        """Check that unwell devices begin only for operators, and for holds that continue others."""
        had, self._had = (
            self._had,
            {
                key: {(entry.holder.id, entry.holder.place) for entry in rc.holds.held.values()}
                for key, rc in self.rcs.items()
            },
        )
        calm = 0.0 if self.present else self.loop.now - self.calm_since
        for key, rc in self.rcs.items():
            process, _ = self.running[key.split()[0]]
            unwell_for = process.run(lambda rc: rc.unwell_for, rc)
            if key not in had or process.stopped or min(unwell_for, calm) < REPORTED_WITHIN:
                continue
            for entry in rc.holds.held.values():
                holder = entry.holder
                continued = (holder.id, holder.place) in had[key] or holder.continues
                if not continued and holder.priority < self.fleet.operator_priority:
                    self.broken(f"{rc.name} begins for {holder.client} {holder.arc}, and is unwell")

    def _on_failure(self, error: Exception) -> None:
        self.broken(f"a service failed: {error!r}")

    async def _client(self, name: str, mesh: MemoryMesh) -> None:
        client = self.programs[name] = Client.on(mesh, self.fleet)
        # A leader that has just begun may know nothing of an RC that is down.
        client.waits_for_devices = True
        busy = self.busy[name] = set()
        self.watch(name, client)
        if name in self.bookers:
            await self.bookers[name].run(client, busy)
            await client.close()
            # Requests that it gave up without a leader end with its token.
            del self.programs[name]
            return
        await asyncio.gather(*(self.work.run(client, f"{mesh.me.client}-{number}", busy) for number in range(2)))

    def watch(self, name: str, client: Client) -> None:
        began: dict[str, tuple[Grant | None, float, list[str]]] = {}
        """By ARC: its last grant, when it became known here, and its RCs."""

        def on_news(arc: OpenArc) -> None:
            self.log(f"{arc.name} {arc.state} {arc.outcome or ''} {arc.reason}")
            self.booked.news(arc, self._leading_hosts())
            grant, since, rcs = began.get(arc.id, (None, 0.0, []))
            touched = self.excuses.felt(since, name, *rcs, *arc.rcs, *arc.needs)
            self.promises.notified(name, arc, client.internals.term, touched=touched)
            slow = [self.devices[rc] for rc in rcs if self.devices[rc].starts]
            if slow and grant is not None and arc.grant is None:
                del began[arc.id]
                if arc.outcome == "completed" and not touched:
                    ready = [device.ready.get(grant) for device in slow]
                    self.promises.had_its_time(name, arc, rcs, ready)
            if arc.grant is not None and arc.grant != grant:
                began[arc.id] = arc.grant, self.loop.now - START, arc.rcs

        client.internals.watch(on_news)

    def _begin(self, fault: Fault) -> None:
        self.log(f"FAULT {fault}")
        self.result.counts["faults"] += 1
        end: Callable[[], object]
        match fault.kind:
            case "freeze" | "stall":
                (name,) = fault.whom
                process, mesh = self.running[name]
                if process.stopped or process.dead:
                    return
                if fault.kind == "freeze":
                    self.network.freeze(mesh)
                    end = lambda: self.network.thaw(mesh)  # noqa: E731
                else:
                    process.stop()
                    end = process.resume
            case "kill":
                armed = {name: self.running[name][1] for name in fault.whom if not self.running[name][0].dead}
                if not armed:
                    return
                for name, mesh in armed.items():
                    if fault.both:
                        self._kill(name, fault)
                    else:
                        self.network.after_sending(mesh, fault.message, partial(self._kill, name, fault))
                end = partial(self._revive, fault, armed.values())
            case "cut" | "isolate" | "part":
                pairs = self._pairs(fault)
                self.cuts.update(pairs)
                self._cut()
                end = lambda: self._mend(pairs)  # noqa: E731
            case "disturb":
                self.network.disturb({fault.message: fault.how})
                end = lambda: self.network.disturb({})  # noqa: E731
            case "double":
                rc, host = fault.whom
                if self.where[rc].startswith(f"{host}/"):
                    return
                name, leaves = f"{host}/spare{self.result.counts['faults']}", asyncio.Event()
                process, mesh = self.open_process(name)
                process.main = process.run(asyncio.create_task, self._guard(self._spare(rc, mesh, leaves)))
                end = leaves.set if fault.both else lambda: self._kill_spare(name, rc)
            case "forge":
                name = f"{fault.whom[0]}/stranger{self.result.counts['faults']}"
                process, mesh = self.open_process(name)
                process.main = process.run(asyncio.create_task, self._forge(mesh, fault.jump))
                end = lambda: self.end_process(name)  # noqa: E731
            case "lie":
                name = f"{fault.whom[0]}/liar{self.result.counts['faults']}"
                process, mesh = self.open_process(name)
                lying = lie(fault.message, mesh, self._highest, fault.jump)
                process.main = process.run(asyncio.create_task, self._guard(lying))
                end = lambda: self.end_process(name)  # noqa: E731
            case "nodes":
                names = [name for name in self.everybody if name not in self.clients and self._lives(name)]
                for name in names:
                    self._take_down(name)
                if fault.jump:
                    for disk in self.term_disks.values():
                        disk.term = NO_TERM
                    self.promises.led.clear()
                end = partial(self._start_all, names)
            case "fail":
                failing = {key: rc for key, rc in self.rcs.items() if rc.name == fault.whom[0]}
                self._each(failing, lambda rc: rc.fail("its device failed"))
                end = lambda: self._each(failing, ResourceController.recover)  # noqa: E731
            case "forget":
                pairs = self._pairs(fault)
                self.cuts.update(pairs)
                self._cut()
                end = lambda: self._come_back(pairs)  # noqa: E731
            case "old disk":
                (host,) = fault.whom
                if self.running[f"{host}/node"][0].dead:
                    return
                self._kill(f"{host}/node", fault)
                with self.booked.destroying():
                    self.equipment.restore_disk(host)
                end = partial(self._start_all, [f"{host}/node"])
            case "restart":
                names = [name for name in self.everybody if not self.running[name][0].dead]
                with self.booked.destroying():
                    for name in names:
                        self._take_down(name)
                DEEDS.get().done.clear()  # no component continues from earlier work
                self.equipment.pass_by(fault.jump)
                end = partial(self._start_all, names)
            case "disk":
                self.equipment.fail(fault.whom)
                end = partial(self.equipment.fail, fault.whom, fails=False)
            case "clock":
                for host in fault.whom:
                    self.equipment.set_clock(host, fault.jump)
                end = lambda: None  # noqa: E731
        self.present.append(fault)
        self._note_delays()
        self.loop.call_later(fault.lasts, self._end, fault, end)

    def _each(self, rcs: Mapping[str, ResourceController], call: Callable[[ResourceController], None]) -> None:
        """Call a function in the live processes of these RCs, when they run again."""
        for key, rc in rcs.items():
            process, _ = self.running[key.split()[0]]
            if self.rcs.get(key) is rc and not process.dead:
                process.run(self.loop.call_soon, call, rc)

    def _end(self, fault: Fault, end: Callable[[], object]) -> None:
        self.log(f"OVER  {fault.kind} {' '.join(fault.whom)}")
        self.excuses.on_over(fault)
        end()
        self.loop.call_later(fault.felt, self._forget_fault, fault)

    def _forget_fault(self, fault: Fault) -> None:
        self.present.remove(fault)
        self._note_delays()
        self.calm_since = self.loop.now

    def _note_delays(self) -> None:
        lost = {fault.message for fault in self.present if fault.kind == "disturb" and fault.how.lost == 1}
        self.promises.unheard = not lost.isdisjoint(("grants", "alive"))
        if any(fault.kind in plan.DELAYS for fault in self.present):
            self.promises.delayed = math.inf
        else:
            self.promises.delayed = min(self.promises.delayed, self.loop.now)

    def _kill(self, name: str, fault: Fault, reached: MemoryTransport | None = None) -> None:
        if fault in self.excuses.killed or self.running[name][0].dead:
            return
        self.excuses.killed[fault] = name, self.loop.now - START
        with self.booked.destroying():
            self._take_down(name, reached if fault.message in OPERATIONS else None)

    def _take_down(self, name: str, reached: MemoryTransport | None = None) -> None:
        self.end_process(name, reached)
        host, program = name.split("/")
        if program == "node":
            self.keepers.pop(host, None)
            for other in [other for other in self.running if other.startswith(f"{host}/") and "." in other]:
                self.end_process(other)
            self.candidates.pop(host, None)
        for rc in [key for key in self.rcs if key.startswith(f"{name} ")]:
            del self.rcs[rc]
        if name in self.clients:
            self.programs.pop(name, None)
            self.promises.forget_client(name)

    def _revive(self, fault: Fault, armed: Iterable[MemoryMesh]) -> None:
        for mesh in armed:
            self.network.after_sending(mesh, "", None)
        if fault in self.excuses.killed:
            self.start(self.excuses.killed[fault][0])

    def _kill_spare(self, name: str, rc: str) -> None:
        self.end_process(name)
        self.rcs.pop(f"{name} {rc}", None)

    def _pairs(self, fault: Fault) -> list[tuple[str, str]]:
        if fault.kind == "cut":
            source, target = fault.whom
            return [(source, target), (target, source)] if fault.both else [(source, target)]
        side = set(fault.whom)
        return [(host, other) for host in self.hosts for other in self.hosts if (host in side) != (other in side)]

    def _mend(self, pairs: list[tuple[str, str]]) -> None:
        self.cuts.subtract(pairs)
        self._cut()

    def _come_back(self, pairs: list[tuple[str, str]]) -> None:
        self.network.forgetful = FORGOTTEN
        self._mend(pairs)
        self.network.forgetful = 0.0

    def _cut(self) -> None:
        cuts = +self.cuts
        self.network.cut_where(lambda source, target: (source.split("/")[0], target.split("/")[0]) in cuts)


class _Lines(logging.Handler):
    """Adds the logs of services to the transcript. A logged error is a broken promise."""

    def __init__(self, fleet: Simulation) -> None:
        super().__init__()
        self._fleet = fleet

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if record.name == trace.log.name:
            self._fleet.on_trace(text)
            return
        if record.exc_info and record.exc_info[1] is not None:
            text += f" ({record.exc_info[1]!r})"
        if record.levelno >= logging.ERROR:
            self._fleet.broken(text)
        else:
            self._fleet.log(text)

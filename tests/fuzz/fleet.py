"""A fleet in memory, in virtual time, with a stranger beside it: nodes, RCs, components, clients and a recorder as they
are. What they log as an error, or let fall, is kept."""

from __future__ import annotations

import asyncio
import gc
import logging
import random
import re
import tempfile
from collections.abc import Callable, Coroutine, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec

from studies.faults.components import SimulatedComponent, report_load
from tests.fuzz.hostile import Hostile, Names, is_one
from tests.fuzz.key_table import PROTOCOL, Row, read_rows
from zscout import messages
from zscout.behaviors.client.client import Client, CommandRefused, RequestRefused
from zscout.behaviors.client.placer_client import PlacerClient
from zscout.behaviors.client.request import OpenArc
from zscout.behaviors.components.component import Component, ComponentContext
from zscout.config.fleet import default_fleet
from zscout.config.node import ComponentsConfig, JournalConfig
from zscout.drivers.generic import CapacityDriver, ExclusiveDriver
from zscout.drivers.resource_controller import ResourceController
from zscout.keyexpr import Role, Sender, Token, new_instance
from zscout.mesh.supervision import StallWatch
from zscout.mesh.transport import Collector, Quality, TransportQuery
from zscout.messages import ComponentSpec, Problem, Recorded
from zscout.services.journal.journal import Journal
from zscout.services.node.component_host import ComponentHost
from zscout.services.rcm.candidate import Candidate, CandidateParts
from zscout.services.recorder.recorder import Recorder
from zscout.services.recorder.timeline import Timeline
from zscout.testing.memory import MemoryMesh, MemoryNetwork, MemoryTransport
from zscout.testing.virtual_time import Process, VirtualTimeLoop
from zscout.types import SECOND

T = TypeVar("T")
START: Final = 1_700_000_000.0
"""The wall clock when a fleet begins."""

ROWS: Final = read_rows(PROTOCOL.read_text())
KIND: Final = "worker"
SERVED_WITHIN: Final = 120.0
"""Seconds of virtual time in which all is well again once the stranger has gone, whatever it said."""
LONG_HOLD: Final = 10_000.0
"""Seconds; no run takes as long."""
STRANGER: Final = "x/stranger"
LAST_TERM: Final = re.compile(rb"45035996273704\d\d")
"""One of the last terms is believed by the word of those whose tokens are seen (docs/protocol.md, "Absurd terms"), and
after it there are none: without access control, who says so in an answer ends a fleet. No stranger does that here."""


class Worker(Component):
    """Does nothing, and can be moved."""

    def __init__(self, params: dict[str, Any]) -> None:
        self.state = b""

    async def run(self, context: ComponentContext) -> None:
        while True:
            await asyncio.sleep(0.5)
            await context.safe_point()

    def checkpoint(self) -> bytes:
        return b"state"

    def restore(self, state: bytes) -> None:
        self.state = state


def in_fleet(
    story: Callable[[Fleet], Coroutine[Any, Any, T]], recording: Path | None = None, seed: int = 0
) -> tuple[list[str], T]:
    """Runs a story beside a fleet that serves. Returns what was logged as an error, or raised and seen by nobody, and
    what the story does."""
    fleet = Fleet(seed)

    async def run() -> T:
        try:
            await fleet.start(recording)
            return await story(fleet)
        finally:
            fleet.kill()

    with _logged(fleet.errors), asyncio.Runner(loop_factory=VirtualTimeLoop) as runner:
        runner.get_loop().set_exception_handler(
            lambda _, context: fleet.errors.append(f"nobody saw {context.get('exception') or context['message']!r}")
        )
        told = runner.run(run())
    return fleet.errors, told


@contextmanager
def _logged(errors: list[str]) -> Iterator[None]:
    handler, logger = _Errors(errors), logging.getLogger("zscout")
    level, propagates = logger.level, logger.propagate
    logger.addHandler(handler)
    logger.setLevel(logging.WARNING)
    logger.propagate = False
    collecting = gc.isenabled()
    gc.disable()  # what dies is to die at its place in the run
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.level, logger.propagate = level, propagates
        if collecting:
            gc.enable()


class _Errors(logging.Handler):
    def __init__(self, errors: list[str]) -> None:
        super().__init__()
        self._errors = errors

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()  # raises where the words do not go together
        if record.levelno >= logging.ERROR or record.exc_info:
            error = record.exc_info[1] if record.exc_info else None
            self._errors.append(f"{text} ({error!r}, {_place(error)})")


def _place(error: BaseException | None) -> str:
    """Where it was raised."""
    trace = error.__traceback__ if error is not None else None
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return "" if trace is None else f"{Path(trace.tb_frame.f_code.co_filename).name}:{trace.tb_lineno}"


class Fleet:
    """Hosts a and b, and programs on desk. `desk/victim` holds robot/b throughout, if nobody disturbs it."""

    def __init__(self, seed: int) -> None:
        self.errors: list[str] = []
        self.fleet = msgspec.structs.replace(default_fleet(), candidates=("a", "b"))
        self.seed = seed
        self.running: dict[str, tuple[Process, MemoryMesh]] = {}
        self.clients: dict[str, Client] = {}
        self.candidates: list[Candidate] = []
        self.rcs: dict[str, ResourceController] = {}
        self.component = type("InFleet", (SimulatedComponent,), {"processes": self})
        self.held: OpenArc | None = None
        self._asked = 0
        self.stranger: Stranger
        self._folders = ExitStack()
        """Of journals."""

    # Processes, also those of components

    def open_process(self, name: str) -> tuple[Process, MemoryMesh]:
        process = Process(name, seed=self.seed)
        mesh = process.run(self.network.open, self.fleet.name, Sender(*name.split("/")))
        self.running[name] = process, mesh
        return process, mesh

    def end_process(self, name: str) -> None:
        process, mesh = self.running.pop(name, (None, None))
        if process is not None and mesh is not None:
            self.network.kill(mesh)
            process.kill()

    def watch(self, name: str, client: Client) -> None:
        pass

    def leave(self) -> None:
        """The stranger goes, with all that it has declared."""
        self.end_process(STRANGER)

    def hears(self, row: Row) -> bool:
        """Whether anybody but the stranger serves a row's key, subscribes to it, or watches its tokens."""
        key = f"zscout/{self.fleet.name}/{row.expression}"
        others = [node for node in self.network.nodes if str(node) != STRANGER]
        declared = [one for node in others for one in (node.queryables, node.subscribers, node._watchers)]
        return any(one.matching(key) for one in declared)

    def kill(self) -> None:
        for name in tuple(self.running):
            self.end_process(name)
        self._folders.close()

    async def start(self, recording: Path | None) -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualTimeLoop)
        loop.isolated = True
        self.network = MemoryNetwork(seed=self.seed)
        for host, rcs in (("a", ("robot/a", "radio/r")), ("b", ("robot/b",))):
            process, mesh = self.open_process(f"{host}/node")
            process.main = process.run(asyncio.create_task, self._node(mesh, rcs))
        for name in ("victim", "asker"):
            process, mesh = self.open_process(f"desk/{name}")
            self.clients[name] = process.run(lambda mesh: Client.on(mesh, self.fleet), mesh)
        if recording is not None:
            process, mesh = self.open_process("desk/recorder")
            process.main = process.run(asyncio.create_task, self._record(mesh, recording))
        self.stranger = Stranger(self.open_process(STRANGER)[1])
        self.held = await self._in("victim", self._hold())
        await self._in("asker", self._place())

    async def _in(self, client: str, work: Coroutine[Any, Any, T]) -> T:
        """Does some of a client's work as its process would."""
        return await self.running[f"desk/{client}"][0].run(asyncio.create_task, work)

    async def _node(self, mesh: MemoryMesh, rcs: tuple[str, ...]) -> None:
        stall, host = StallWatch(mesh.now).start(), mesh.me.host
        tokens = [mesh.alive(Token(host, Role.NODE, "node", new_instance()))]
        mesh.watch_links()
        lease = self.fleet.timing.hold_lease / SECOND
        for name in rcs:
            driver = CapacityDriver({"rate": Fraction(10)}) if name.startswith("radio") else ExclusiveDriver()
            rc = self.rcs[name] = ResourceController(
                mesh, name, driver, hold_lease=lease, settle=1.0, stall=stall, on_failure=self._failed
            )
            await rc.start()
        folder = Path(self._folders.enter_context(tempfile.TemporaryDirectory(prefix="zscout-fuzz-")))
        journal = Journal(
            mesh, folder, JournalConfig(), self.fleet.silence / SECOND, lambda: START + mesh.now() / SECOND
        )
        journal.start()
        candidate = Candidate(mesh, self.fleet, CandidateParts(journal=journal))
        candidate.start()
        self.candidates.append(candidate)
        components = ComponentHost(
            mesh,
            self.fleet,
            ComponentsConfig(),
            self._failed,
            kinds=lambda: {KIND: f"{__name__}:{Worker.__name__}"},
            process=self.component,
        )
        await components.start()
        await report_load(mesh)
        tokens.clear()

    async def _record(self, mesh: MemoryMesh, path: Path) -> None:
        where = Recorded(str(path), 1, "127.0.0.1", 1)
        with Timeline(self.fleet.name, path=path) as timeline:
            await Recorder(mesh, self.fleet, timeline, where=lambda: where).run(asyncio.Event())

    def _failed(self, error: Exception) -> None:
        self.errors.append(f"a service failed: {error!r}")

    # What serves

    @property
    def leaders(self) -> list[Candidate]:
        return [one for one in self.candidates if one.rcm is not None]

    async def _hold(self) -> OpenArc:
        client = self.clients["victim"]
        client.waits_for_devices = True
        arc = await client.request("held", {"robot/b": {}}, priority=0, min_runtime=LONG_HOLD, keep=True)
        assert await client.granted(arc) is not None
        return arc

    async def _place(self) -> None:
        with PlacerClient(self.running["desk/asker"][1]) as placer:
            await placer.place("w1", ComponentSpec(KIND, restart="always"), wait=5.0)
            while placer.placements["w1"].state != "running":
                await placer.wait_changed()

    async def elect(self) -> None:
        """Those that lead step down and stand again: another may lead meanwhile, or the same."""
        for one in self.leaders:
            process = self.running[f"{one.mesh.me.host}/node"][0]
            await process.run(asyncio.create_task, one.stop())
            process.run(asyncio.get_running_loop().call_later, 3.0, one.start)

    def standing(self) -> object:
        """What no stranger may disturb that is not believed: the term, the hold, its place, what is placed."""
        assert self.held is not None
        return (
            [
                (one.rcm.term, sorted(arc.id for arc in one.rcm.core.status(9).queued))
                for one in self.leaders
                if one.rcm
            ],
            self.held.grant,
            self.held._place,
            {name: (rc.holds.term, rc.health, list(rc.holds.held)) for name, rc in sorted(self.rcs.items())},
            [client.internals.term for client in self.clients.values()],
            sorted(self.running),
        )

    async def serves(self) -> None:
        """A request for robot/a and the radio is granted and obeyed, and given back, before long."""
        self._asked += 1
        try:
            async with asyncio.timeout(SERVED_WITHIN):
                while not await self._in("asker", self._try()):  # noqa: ASYNC110 - asked each time
                    await asyncio.sleep(0.5)
        except TimeoutError:
            self.errors.append("no request was served any more")

    async def _try(self) -> bool:
        client, needs = self.clients["asker"], {"robot/a": {}, "radio/r": {"rate": 1}}
        try:
            arc = await client.request(f"good-{self._asked}", needs, priority=9, min_runtime=5, wait_for_device=True)
            while (grant := await client.granted(arc, confirmed=True)) is not None:
                done = await client.command("robot/a", grant, {"name": "echo", "value": self._asked})
                await client.end(arc)
                return bool(done.result == self._asked)
        except (RequestRefused, CommandRefused):
            pass  # of a leader that is about to go: it asks again
        return False


class Stranger:
    """A session on the network that sends bytes, and answers with bytes."""

    def __init__(self, mesh: MemoryMesh) -> None:
        self.mesh = mesh
        self._heard: list[tuple[Row, bytes, bool]] = []
        self._said: set[bytes] = set()
        """What it has answered: itself as well."""
        self._tokens: list[Callable[[], None]] = []

    @property
    def _session(self) -> MemoryTransport:
        session = self.mesh._transport.current
        assert isinstance(session, MemoryTransport)
        return session

    def put(self, key: str, payload: bytes, attachment: bytes | None = None) -> None:
        self._session.publish(key, payload, attachment, Quality.CONTROL)

    def ask(self, row: Row, key: str, payload: bytes | None) -> None:
        self._session.get(key, payload, None, 5.0, _Answers(row, self._heard))

    def misunderstood(self) -> list[str]:
        """What it was answered that is no message of the protocol."""
        found = []
        for row, payload, ok in self._heard:
            if payload in self._said or (not ok and payload == b"Timeout"):
                continue
            kinds: tuple[type, ...] = row.answers if ok else (Problem,)
            if not any(is_one(payload, kind, messages.MAX_STATE) for kind in kinds):
                found.append(f"{row.key} answers {payload[:300]!r}")
            elif not ok and messages.decode(payload, Problem).code == "internal":
                found.append(f"{row.key} answers that it failed")
        return found

    def serve(self, key: str, answer: Callable[[], tuple[bytes, bool]]) -> None:
        """Answers whatever is asked there, on that key, or the question's where that has wildcards."""

        def on_query(query: TransportQuery) -> None:
            payload, ok = answer()
            self._said.add(payload)
            if ok:
                query.reply((query.key if "*" in key else key).replace("*", "a"), payload, type(self))
            else:
                query.reply_error(payload, type(self))

        self._session.queryable(key, on_query)

    def token(self, key: str) -> None:
        self._tokens.append(self._session.token(key))

    def withdraw(self) -> None:
        """Its tokens go."""
        for undeclare in self._tokens:
            undeclare()
        self._tokens.clear()


@dataclass(slots=True)
class _Answers(Collector):
    row: Row
    heard: list[tuple[Row, bytes, bool]]

    def on_reply(self, key: str, payload: bytes, ok: bool) -> None:
        self.heard.append((self.row, payload, ok))

    def on_final(self) -> None:
        pass


# What the stranger says


HOSTS: Final = ("a", "b", "desk", "x")
FIELDS: Final = {
    "host": HOSTS,
    "to": (*HOSTS, "desk/asker", "x/stranger"),
    "client": ("desk/victim", "desk/asker", STRANGER, "desk/nobody"),
    "rc": ("robot/a", "robot/b", "radio/r", "robot/x"),
    "rcs": ("robot/a", "robot/b", "radio/r", "robot/*"),
    "needs": ("robot/a", "robot/b", "radio/r", "robot/*", "robot/x"),
    "bound": ("robot/*", "robot/a"),
    "kept": ("1800000000", "0"),
    "unconfirmed": ("robot/a", "robot/b"),
    "instances": ("robot/a", "robot/b", "radio/r"),
    "params": ("rate", "x"),
    "capacity": ("rate",),
    "component": ("w1", "w2"),
    "forgotten": ("w1", "w2"),
    "cordoned": HOSTS,
    "hosts": HOSTS,
    "kind": (KIND, "nothing"),
    "kinds": (KIND,),
    "id": ("r1", "r2"),
    "others": ("r1", "r2"),
    "arc": ("held", "good-1", "x"),
    "health": ("ok", "broken"),
    "name": ("confirm", "echo", "leaving", "left"),
}  # fmt: skip


class Script:
    """What a stranger does, by numbers: each of its deeds is one of a row, and drawn from a seed of its own."""

    def __init__(self, fleet: Fleet) -> None:
        self.fleet = fleet
        self.base = f"zscout/{fleet.fleet.name}/"

    def names(self) -> Names:
        known = {client.internals.term for client in self.fleet.clients.values()} | {
            one.rcm.term for one in self.fleet.leaders if one.rcm is not None
        }
        highest = max(known)
        terms = [
            *known, (highest.counter + 1, "f"), (highest.counter + 7, "~"), (0, ""), (10**12, "f"), (2**52 - 1, "f"),
        ]  # fmt: skip
        instances = [rc.instance for rc in self.fleet.rcs.values()]
        held = self.fleet.held
        ids = (*FIELDS["id"], held.id if held is not None else "r3")
        return Names(terms, {**FIELDS, "instance": (*instances, "f"), "id": ids, "others": ids})

    def hostile(self, row: Row, seed: int) -> Hostile:
        return Hostile(random.Random(f"{row.key} {seed}"), self.names())  # noqa: S311 - what failed once must fail again

    def said(self, row: Row, faults: int, seed: int) -> tuple[str, bytes]:
        """A key and a payload for it."""
        hostile = self.hostile(row, seed)
        return self.base + hostile.key(row, faults), hostile.payload((*row.asked, *row.published), faults)

    def do(self, row: Row, faults: int, seed: int) -> str:
        """One deed, in words."""
        hostile, stranger = self.hostile(row, seed), self.fleet.stranger
        rng = hostile.rng
        key = self.base + hostile.key(row, faults)
        ways = [way for way, kinds in (("ask", row.asked), ("put", row.published), ("serve", row.answers)) if kinds]
        way = rng.choice(ways or ["token"])
        words = f"{way} {key[:300]!r}"
        if way == "token":
            stranger.token(key)
        elif way == "serve":
            kinds = row.answers if rng.randrange(4) else (*row.answers, Problem)

            def answer() -> tuple[bytes, bool]:
                return LAST_TERM.sub(b"4503599000000000", hostile.payload(kinds, faults)), rng.randrange(4) > 0

            stranger.serve(self.base + row.expression if rng.randrange(2) else key, answer)
        else:
            payload = hostile.payload(row.asked if way == "ask" else row.published, faults)
            words += f" {payload[:2_000]!r}"
            if way == "ask":
                stranger.ask(row, key, payload)
            elif row.attached:
                stranger.put(key, rng.randbytes(rng.choice((0, 3, 4_000))), payload)
            else:
                stranger.put(key, payload)
        return words

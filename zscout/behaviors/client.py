"""A program's side of the mesh: asks for ARCs, follows what becomes of them, commands what it holds."""

from __future__ import annotations

import asyncio
import logging
import os
import random
import socket
from collections.abc import Callable, Coroutine, Mapping
from decimal import Decimal
from typing import Any, Self

import msgspec

from zscout import clock
from zscout.behaviors.request import Needs, OpenArc, amounts
from zscout.config import Fleet, fleet_from_env
from zscout.keyexpr import Role, Sender, Token, check_name, new_instance, valid_name
from zscout.mesh import Declared, Mesh, Refused, Reply, Request
from zscout.messages import (
    Cancel,
    ClientRequests,
    Command,
    Done,
    Foresee,
    Foresight,
    HandOver,
    Notice,
    Problem,
    RcAsk,
    RcmState,
    Release,
    StateAsk,
    absurd,
)
from zscout.scheduling.model import NO_TERM, SECOND, Grant, Ns, Term
from zscout.stall import StallWatch

log = logging.getLogger(__name__)

QUERY_TIMEOUT = 1.0
ASK_AGAIN = 5.0
"""Seconds between two askings of an open request, give or take a fifth."""
BACKOFF = (0.05, 1.0)
"""Seconds before a question that nobody answered is repeated: first, and at most."""
CONFIRM_TIMEOUT = 1.0
LOOKS = 10
"""How often within a hold lease a client looks whether the RCM spoke."""
END_TRIES = 3
TRY_AGAIN = frozenset({"busy", "not_leading", "internal", "queue_full"})


class RequestRefused(Exception):
    """The RCM will not take this request as it is; the message says why."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(problem.message)
        self.code = problem.code


class CommandRefused(Exception):
    """An RC did not obey; `code` is the protocol's, or `unknown` where no answer came."""

    def __init__(self, rc: str, problem: Problem) -> None:
        super().__init__(f"{rc}: {problem.message}")
        self.code = problem.code


class _Spoken(msgspec.Struct, frozen=True):
    """What a client reads of the RCM's publications."""

    term: Term


class Client:
    """One program on the mesh. Open with `async with Client.connect(...)`."""

    def __init__(self, mesh: Mesh, fleet: Fleet) -> None:
        self.mesh, self.fleet = mesh, fleet
        self.term: Term = NO_TERM
        """The highest term heard or promised; older words are ignored."""
        self._arcs: dict[str, OpenArc] = {}
        self._changed: dict[str, asyncio.Event] = {}
        self._watchers: list[Callable[[OpenArc], None]] = []
        self._leaders: set[Token] = set()
        self._leader_came = asyncio.Event()
        self._heard: Ns = clock.now()
        self._stall = StallWatch()
        self._declared: list[Declared] = []
        self._tasks: set[asyncio.Task[None]] = set()

    @classmethod
    async def connect(
        cls, name: str | None = None, *, fleet: Fleet | None = None, host: str | None = None
    ) -> Self:
        """Joins the mesh. `name` must be the only one of this host; the default is.

        Without a `fleet`, the one that ZSCOUT_FLEET names, or the default. Raises MeshError, BadInput."""
        fleet = fleet or fleet_from_env()
        host = host or os.environ.get("ZSCOUT_HOST") or valid_name(socket.gethostname())
        me = Sender(check_name(host, "host"), check_name(name or f"client-{new_instance()}", "client"))
        client = cls(await Mesh.open(fleet.name, me, fleet.mesh), fleet)
        client._start()
        return client

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self.close()

    def _start(self) -> None:
        keys, mesh = self.mesh.keys, self.mesh
        self._stall.start()
        self._spoken = mesh.overhear(keys.grants, _Spoken)
        self._declared = [
            mesh.subscribe(keys.notice(mesh.me), Notice, self._on_notice),
            mesh.serve(keys.requests(mesh.me), RcAsk, self._on_requests),
            self._spoken,
            mesh.watch(keys.alive_any(Role.RCM), self._on_leader),
            mesh.alive(Token(mesh.me.host, Role.CLIENT, mesh.me.client, new_instance())),
        ]
        self._spawn(self._keep_asking())
        self._spawn(self._watch_lease())

    async def close(self) -> None:
        """Gives back everything and leaves the mesh."""
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await asyncio.gather(*(self.end(arc) for arc in list(self._arcs.values()) if arc.open))
        for declared in reversed(self._declared):
            declared.close()
        self._stall.stop()
        await self.mesh.close()

    @property
    def leader(self) -> str | None:
        """The host whose node leads, or None where no RCM is seen."""
        return next((token.host for token in sorted(self._leaders)), None)

    # Requests

    async def request(
        self,
        name: str,
        needs: Needs,
        *,
        priority: int = 0,
        min_runtime: float | Decimal = 1.0,
        keep: bool = False,
    ) -> OpenArc:
        """Asks for an ARC and returns when the RCM has answered, for as long as that takes.

        A need names an RC, or is a pattern that any one RC meets: `framegrabber/*`; `framegrabber/*#2` is one
        more. Raises RequestRefused where the request can't be taken as it is."""
        arc = OpenArc(
            id=new_instance(),
            name=check_name(name, "arc"),
            needs=amounts(needs),
            priority=priority,
            min_runtime=min_runtime if isinstance(min_runtime, Decimal) else Decimal(str(min_runtime)),
            keep=keep,
            since=clock.now(),
        )
        self._arcs[arc.id] = arc
        self._changed[arc.id] = asyncio.Event()
        try:
            await self._submit(arc)
        except BaseException:
            self._forget(arc)
            raise
        return arc

    async def changed(self, arc: OpenArc) -> None:
        """Waits until there is a new word about `arc`."""
        event = self._changed.get(arc.id)
        if event is not None:
            event.clear()
            await event.wait()

    async def granted(self, arc: OpenArc) -> Grant | None:
        """Waits until `arc` is granted and all its RCs have confirmed it; None if it ended instead."""
        while arc.open:
            if arc.state == "running" and arc.grant is not None:
                grant = arc.grant
                refusal = await self._confirm(arc, grant)
                if arc.grant != grant:
                    continue
                if refusal is None:
                    return grant
                log.warning("the grant of %s is given back: %s", arc.name, refusal)
                await self.end(arc)
                raise refusal
            await self.changed(arc)
        return None

    async def _confirm(self, arc: OpenArc, grant: Grant) -> CommandRefused | None:
        """Asks all RCs of a grant, side by side, whether they know of it."""

        async def one(rc: str) -> CommandRefused | None:
            try:
                await self.command(rc, grant, {"name": "confirm"}, timeout=CONFIRM_TIMEOUT)
            except CommandRefused as refused:
                return refused
            return None

        refusals = await asyncio.gather(*(one(rc) for rc in arc.rcs))
        return next((refused for refused in refusals if refused is not None), None)

    async def end(self, arc: OpenArc) -> None:
        """Gives back a hold, or leaves the queue. Tried a few times; the RCM sees our token die otherwise."""
        operation = Release(id=arc.id) if arc.state == "running" else Cancel(id=arc.id)
        arc.finish(
            "released" if arc.state == "running" else "cancelled", "given up by this client", clock.now()
        )
        self._wake(arc)
        key = self.mesh.keys.schedule(self.mesh.me)
        for _ in range(END_TRIES):
            replies = await self.mesh.ask(key, operation, Notice, timeout=QUERY_TIMEOUT, enough=_answered)
            if any(reply.message is not None for reply in replies):
                break
            if self.leader is None:
                break
        self._forget(arc)

    def complete(self, arc: OpenArc) -> None:
        """An ARC has had its time by this host's clock; RCs and RCM end it by theirs."""
        arc.finish("completed", "its minimum runtime is over", clock.now())
        self._wake(arc)
        self._forget(arc)

    async def hand_over(self, arc: OpenArc, to: Sender) -> None:
        """Lets a running ARC go on in another client. Raises RequestRefused."""
        key = self.mesh.keys.schedule(self.mesh.me)
        reply = await self.mesh.ask_one(key, HandOver(id=arc.id, to=str(to)), Notice, timeout=QUERY_TIMEOUT)
        if reply is None or reply.message is None:
            unknown = Problem("unknown", "the RCM did not answer; ask how the ARC stands")
            raise RequestRefused(reply.problem or unknown if reply is not None else unknown)

    def watch(self, watcher: Callable[[OpenArc], None]) -> None:
        """Calls `watcher(arc)` at every new word about any of this client's requests."""
        self._watchers.append(watcher)

    # Operators' questions

    async def state(
        self, arc: str | None = None, *, forecast: bool = False, timeout: float = QUERY_TIMEOUT
    ) -> RcmState | None:
        """How things stand at the RCM, with the story of `arc` if one is named, and with a `forecast` of
        when who waits will start; None if no RCM answered."""
        asked = StateAsk(arc=arc, forecast=forecast)
        replies = await self.mesh.ask(
            self.mesh.keys.rcm_state, asked, RcmState, timeout=timeout, enough=_answered
        )
        states = [reply.message for reply in replies if reply.message is not None]
        return max(states, key=lambda state: state.term, default=None)

    async def foresee(
        self, name: str, needs: Needs, *, priority: int, min_runtime: Decimal, keep: bool = False
    ) -> Foresight | None:
        """What would come of a request, without making it; None if no RCM answered. Raises RequestRefused."""
        asked = Foresee(
            id=new_instance(),
            arc=name,
            needs=amounts(needs),
            priority=priority,
            min_runtime=min_runtime,
            keep=keep,
        )
        key = self.mesh.keys.schedule(self.mesh.me)
        reply = await self.mesh.ask_one(key, asked, Foresight, timeout=QUERY_TIMEOUT)
        if reply is not None and reply.problem is not None:
            raise RequestRefused(reply.problem)
        return reply.message if reply is not None else None

    async def command(
        self, rc: str, grant: Grant, do: Mapping[str, Any], *, ttl: float = 1.0, timeout: float = 2.0
    ) -> Done:
        """Has an RC do something under `grant`. Raises CommandRefused."""
        key = self.mesh.keys.command(rc, self.mesh.me)
        command = Command(grant=grant, do=dict(do), ttl=ttl)
        reply = await self.mesh.ask_one(key, command, Done, timeout=timeout)
        if reply is None:
            raise CommandRefused(rc, Problem("unknown", "no answer; it may have been done or not"))
        if reply.message is None:
            raise CommandRefused(rc, reply.problem or Problem("unknown", "no reason given"))
        return reply.message

    # What is heard

    def _on_notice(self, _key: str, notice: Notice) -> None:
        if notice.term < self.term or absurd(notice.term, self.term):
            return
        self.term = notice.term
        arc = self._arcs.get(notice.id)
        if arc is not None:
            self._take(arc, notice)
        elif notice.state == "running":
            # A grant that nobody here asked for, or gave up meanwhile, is given back.
            self._spawn(self._give_back(notice.id))

    def _take(self, arc: OpenArc, notice: Notice) -> None:
        if arc.take(notice, clock.now()):
            self._wake(arc)
            if not arc.open:
                self._forget(arc)

    def _wake(self, arc: OpenArc) -> None:
        event = self._changed.get(arc.id)
        if event is not None:
            event.set()
        for watcher in self._watchers:
            watcher(arc)

    def _on_requests(self, request: Request[RcAsk]) -> None:
        promise = request.message.promise
        if promise is not None:
            if promise < self.term or absurd(promise, self.term):
                raise Refused("old_term", f"this client obeys term {self.term.counter}", self.term)
            self.term = promise
        arcs = [arc.told(clock.now()) for arc in self._arcs.values() if arc.open]
        request.answer(ClientRequests(client=str(self.mesh.me), requests=arcs))

    def _rcm_spoke(self) -> bool:
        # As at the RCs: one that was replaced, or that nobody can believe, keeps no hold alive.
        terms = [said.term for said in self._spoken.take()]
        return any(term >= self.term and not absurd(term, self.term) for term in terms)

    def _on_leader(self, token: Token, alive: bool) -> None:
        if alive:
            self._leaders.add(token)
            self._leader_came.set()
        else:
            self._leaders.discard(token)

    # Asking

    async def _submit(self, arc: OpenArc) -> None:
        """Asks until the RCM has answered. Raises RequestRefused."""
        pause, longest = BACKOFF
        while arc.state == "asking":
            self._leader_came.clear()
            replies = await self._ask(arc)
            if arc.state != "asking":
                return
            problem = next((reply.problem for reply in replies if reply.problem is not None), None)
            if problem is not None and problem.code not in TRY_AGAIN:
                arc.state, arc.reason = "refused", problem.message
                raise RequestRefused(problem)
            if problem is not None:
                arc.reason = problem.message
            elif self.leader is None:
                arc.reason = "no RCM is on the mesh; start zscout-node"
            self._wake(arc)
            try:
                async with asyncio.timeout(pause * random.uniform(0.8, 1.2)):  # noqa: S311
                    await self._leader_came.wait()
            except TimeoutError:
                pause = min(longest, pause * 2)

    async def _ask(self, arc: OpenArc) -> list[Reply[Notice]]:
        key = self.mesh.keys.schedule(self.mesh.me)
        replies = await self.mesh.ask(
            key, arc.ask(clock.now()), Notice, timeout=QUERY_TIMEOUT, enough=_answered
        )
        for reply in replies:
            notice = reply.message
            if notice is not None and notice.term >= self.term and not absurd(notice.term, self.term):
                self.term = notice.term
                self._take(arc, notice)
        return replies

    async def _keep_asking(self) -> None:
        """Asks open requests again at every change of RCM, and every few seconds."""
        while True:
            self._leader_came.clear()
            try:
                async with asyncio.timeout(ASK_AGAIN * random.uniform(0.8, 1.2)):  # noqa: S311
                    await self._leader_came.wait()
            except TimeoutError:
                pass
            for arc in list(self._arcs.values()):
                if arc.open:
                    await self._ask(arc)

    async def _watch_lease(self) -> None:
        """Ends holds when no RCM was heard for the hold lease: their RCs have ended them as well."""
        lease = self.fleet.timing.hold_lease
        while True:
            await asyncio.sleep(lease / SECOND / LOOKS)
            if self._rcm_spoke():
                # It may have spoken right after the last look.
                self._heard = clock.now() - lease // LOOKS
            if clock.now() - self._heard < lease or self._stall.fresh():
                continue
            for arc in list(self._arcs.values()):
                if arc.state == "running":
                    arc.lose("no RCM was heard for the hold lease", clock.now())
                    self._wake(arc)

    async def _give_back(self, request_id: str) -> None:
        key = self.mesh.keys.schedule(self.mesh.me)
        await self.mesh.ask(key, Release(id=request_id), Notice, timeout=QUERY_TIMEOUT)

    def _forget(self, arc: OpenArc) -> None:
        self._arcs.pop(arc.id, None)
        self._changed.pop(arc.id, None)

    def _spawn(self, coroutine: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


def _answered(reply: Reply[Any]) -> bool:
    return reply.message is not None or reply.problem is not None

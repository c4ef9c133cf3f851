"""A program's side of the mesh: asks for ARCs, follows what becomes of them, commands what it holds."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
from collections.abc import Callable, Coroutine, Mapping, Sequence
from decimal import Decimal
from typing import Any, Self

from zscout import clock
from zscout.behaviors.asking import ASK_AGAIN, BACKOFF, END_TRIES, QUERY_TIMEOUT, TRY_AGAIN, Asking, answered
from zscout.behaviors.book import Book
from zscout.behaviors.hearing import LOOKS, Hearing
from zscout.behaviors.moving import Moving
from zscout.behaviors.refusals import CommandRefused, RequestRefused
from zscout.behaviors.request import Needs, OpenArc, amounts
from zscout.config import Fleet, fleet_from_env
from zscout.keyexpr import Role, Sender, Token, check_name, new_instance, valid_name
from zscout.mesh import Declared, Mesh
from zscout.messages import (
    Command,
    Done,
    Foresee,
    Foresight,
    HandOver,
    Notice,
    OpenRequest,
    Problem,
    RcmState,
    StateAsk,
)
from zscout.scheduling.model import Grant, Term

__all__ = [
    "ASK_AGAIN",
    "BACKOFF",
    "END_TRIES",
    "LOOKS",
    "QUERY_TIMEOUT",
    "TRY_AGAIN",
    "Client",
    "CommandRefused",
    "RequestRefused",
]

log = logging.getLogger(__name__)

CONFIRM_TIMEOUT = 1.0


class Client:
    """One program on the mesh. Open with `async with Client.connect(...)`."""

    def __init__(self, mesh: Mesh, fleet: Fleet) -> None:
        self.mesh, self.fleet = mesh, fleet
        self._book = Book()
        self._hearing = Hearing(mesh, fleet, self._book)
        self._asking = Asking(mesh, self._book, self._hearing)
        self._moving = Moving(mesh, self._book, self._hearing, self._asking, self._spawn)
        self._may_end = asyncio.Event()
        """Set unless the client is paused, and once it has left."""
        self._may_end.set()
        self._left = False
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
        self._declared = [
            mesh.subscribe(keys.notice(mesh.me), Notice, self._on_notice),
            *self._hearing.start(),
            mesh.alive(Token(mesh.me.host, Role.CLIENT, mesh.me.client, new_instance())),
        ]
        self._spawn(self._asking.keep_asking())
        self._spawn(self._hearing.watch_lease())

    async def close(self) -> None:
        """Gives back everything and leaves the mesh."""
        if self._left:
            return
        self._book.resumed.set()
        self._may_end.set()
        await self._stop_tasks()
        await asyncio.gather(*(self.end(arc) for arc in self._book.open))
        await self.leave()

    async def leave(self) -> None:
        """Leaves the mesh without ending anything or giving it back: for who has handed over all. What is
        still this client's goes when the RCM sees that its token has gone."""
        if self._left:
            return
        self._left = True
        self._may_end.set()
        await self._stop_tasks()
        for declared in reversed(self._declared):
            declared.close()
        self._hearing.stop()
        await self.mesh.close()

    async def _stop_tasks(self) -> None:
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    @property
    def term(self) -> Term:
        """The highest term heard or promised; older words are ignored."""
        return self._hearing.term

    @property
    def leader(self) -> str | None:
        """The host whose node leads, or None where no RCM is seen."""
        return self._hearing.leader

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
        more. Raises RequestRefused where the request can't be taken as it is.

        An ARC of this name and these needs that another client hands over is returned instead, as it is."""
        wanted = amounts(needs)
        expected = await self._moving.claim(check_name(name, "arc"), wanted)
        if expected is not None:
            return expected
        arc = OpenArc(
            id=new_instance(),
            name=name,
            needs=wanted,
            priority=priority,
            min_runtime=min_runtime if isinstance(min_runtime, Decimal) else Decimal(str(min_runtime)),
            keep=keep,
            since=clock.now(),
        )
        self._book.enter(arc)
        try:
            await self._asking.submit(arc)
        except BaseException:
            self._book.forget(arc)
            raise
        return arc

    async def changed(self, arc: OpenArc) -> None:
        """Waits until there is a new word about `arc`."""
        await self._book.changed(arc)

    async def granted(self, arc: OpenArc) -> Grant | None:
        """Waits until `arc` is granted and all its RCs have confirmed it; None if it ended instead.

        Nothing is entered while the client is paused, nor is what it hands over told as ended."""
        while True:
            await self._book.resumed.wait()
            if not arc.open:
                return None
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
        """Gives back a hold, or leaves the queue: once the client is no longer paused, if that was not handed
        over then. Tried a few times; the RCM sees our token die otherwise."""
        await self._may_end.wait()
        if self._left:
            return
        if arc.state == "moved":
            self._book.forget(arc)
            return
        await self._asking.end(arc)

    def complete(self, arc: OpenArc) -> None:
        """An ARC has had its time by this host's clock; RCs and RCM end it by theirs."""
        arc.finish("completed", "its minimum runtime is over", clock.now())
        self._book.wake(arc)
        self._book.forget(arc)

    async def hand_over(self, arc: OpenArc, to: Sender) -> None:
        """Lets one ARC, queued or running, go on in another client. Raises RequestRefused."""
        operation = HandOver(id=arc.id, to=str(to))
        reply = await self.mesh.ask_one(self._asking.key, operation, Notice, timeout=QUERY_TIMEOUT)
        if reply is None or reply.message is None:
            unknown = Problem("unknown", "the RCM did not answer; ask how the ARC stands")
            raise RequestRefused(reply.problem or unknown if reply is not None else unknown)

    def watch(self, watcher: Callable[[OpenArc], None]) -> None:
        """Calls `watcher(arc)` at every new word about any of this client's requests."""
        self._book.watch(watcher)

    # Moving: all that this client has goes on in another one

    def pause(self) -> None:
        """From now on nothing is asked again or ended and no body is entered or interrupted; the RCM is heard
        as before. Until `resume`, `take_back`, `close` or `leave`."""
        self._moving.pause()
        self._may_end.clear()

    @property
    def paused(self) -> bool:
        return not self._book.resumed.is_set()

    async def resumed(self) -> None:
        """Waits while the client is paused; without end where it leaves like that."""
        await self._book.resumed.wait()

    def resume(self) -> None:
        """Goes on. All that is open is asked again, and what was withheld happens now."""
        self._may_end.set()
        self._moving.resume()

    def open_requests(self) -> list[OpenRequest]:
        """What is queued or running: what `hand_over_all` would hand over now."""
        now = clock.now()
        return [arc.told(now) for arc in self._book.standing]

    def expect(self, requests: Sequence[OpenRequest]) -> None:
        """These will be handed to this client: `request` then returns them, by name and needs. They replace
        what was expected before and has not come.

        What has come and was not asked for within 10 s is given back. Raises BadName, and ValueError for more
        than 256 of them, or for one that is open here."""
        self._moving.expect(requests)

    @property
    def expected_came(self) -> asyncio.Event:
        """Set at the first word about an ARC that is expected: from then on it is this client's."""
        return self._moving.came

    async def hand_over_all(self, to: Sender) -> None:
        """Hands all `open_requests` of this paused client to another one, which expects them, in one step. On
        return that is done, and they go on there.

        Raises RequestRefused where nothing was handed over; with code `unknown` where no RCM could tell
        within 10 s: call it again; or see to it that the other client is gone, and `take_back`."""
        await self._moving.hand_over_all(to)

    def take_back(self) -> None:
        """The client to which all was handed is gone: this one goes on, and asks anew for each, at its place.

        Bodies are interrupted as by any other lost hold. What was not handed over after all, where that was
        unknown, simply stands."""
        self._may_end.set()
        self._moving.take_back()

    # Operators' questions

    async def state(
        self, arc: str | None = None, *, forecast: bool = False, timeout: float = QUERY_TIMEOUT
    ) -> RcmState | None:
        """How things stand at the RCM, with the story of `arc` if one is named, and with a `forecast` of
        when who waits will start; None if no RCM answered."""
        asked = StateAsk(arc=arc, forecast=forecast)
        replies = await self.mesh.ask(
            self.mesh.keys.rcm_state, asked, RcmState, timeout=timeout, enough=answered
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
        reply = await self.mesh.ask_one(self._asking.key, asked, Foresight, timeout=QUERY_TIMEOUT)
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
        if not self._hearing.believe(notice.term):
            return
        arc = self._book.arcs.get(notice.id)
        if arc is not None:
            self._book.take(arc, notice)
        elif not self._moving.heard(notice) and notice.state == "running":
            # A grant that nobody here asked for, or gave up meanwhile, is given back.
            self._spawn(self._asking.give_back(notice.id))

    def _spawn(self, coroutine: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

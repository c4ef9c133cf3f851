"""A program's side of the mesh: requests ARCs, follows what becomes of them, commands what it holds."""

from __future__ import annotations

import asyncio
import itertools
import logging
import os
import socket
from collections.abc import Callable, Coroutine, Generator, Mapping
from contextlib import ExitStack, closing
from decimal import Decimal
from typing import Any, Final, Generic, Self, TypeVar

from msgspec.structs import replace

from zscout import messages
from zscout.behaviors.client.confirmation import NOT_DONE, NOT_HELD, Confirmations
from zscout.behaviors.client.direct import DirectHold
from zscout.behaviors.client.handover import MovableClient
from zscout.behaviors.client.identity import checked_comment, this_program
from zscout.behaviors.client.rcm_link import QUERY_TIMEOUT, TRY_AGAIN
from zscout.behaviors.client.request import (
    CommandRefused,
    Needs,
    NoRcm,
    OpenArc,
    RequestRefused,
    amounts,
    check_seconds,
)
from zscout.config.certificates import read_certificates
from zscout.config.fleet import FLEET_VARIABLE, Fleet, beside, fleet_from_env
from zscout.keyexpr import Role, Sender, Token, check_name, new_instance, valid_name
from zscout.mesh import Declaration, Mesh, ZenohMesh
from zscout.mesh.exchange import naming_versions
from zscout.mesh.supervision import Supervisor, done_within
from zscout.messages import Done, Foresight, Notice, Problem, RcmState, Who
from zscout.types import SECOND, Grant, Ns, Term

__all__ = ["QUERY_TIMEOUT", "TRY_AGAIN", "Client", "CommandRefused", "NoRcm", "RequestRefused"]

log = logging.getLogger(__name__)

LOOK_FOR_RCM: Final = 3.0
"""Seconds in which a mesh that has an RCM shows it."""
LOOK_FOR_TAKEOVER: Final = 5.0
"""The same where a candidate is seen."""
MAX_NAMED: Final = 5
LAST_WORD: Final = 0.5
"""Seconds at most for which a client that closes tells RCs that its programs are gone."""
TOLD_WITHIN = 1.0
"""Seconds within which a notice says so too; else the RC is believed."""
RENEW_TOKEN: Final[Ns] = SECOND // 2
"""A client that is dropped again after its token was renewed renews it no sooner."""


class Client(MovableClient):
    """One program on the mesh. Open with `async with Client.connect(...) as client`, or `await
    Client.connect(...)` and `close` it."""

    def __init__(self, mesh: Mesh, fleet: Fleet) -> None:
        super().__init__(mesh, fleet, Supervisor(f"client {mesh.me}", self._failed))
        self.who: Who | None = None
        """Who asks, as others are told; `connect` fills it in."""
        self._leaving: asyncio.Task[None] | None = None
        self._declared: list[Declaration] = []
        self._token: Declaration | None = None
        self._instance = ""
        """Of its token."""
        self._commanded = itertools.count(1)
        self._shown: Ns = 0
        """When the present token was declared."""
        self._denied: set[Grant] = set()
        """Grants that an RC says are over, and no notice yet."""
        self._confirmations = Confirmations(
            mesh,
            fleet,
            self._store,
            self._rcm,
            self._supervisor,
            self._command,
            lambda arc: self._supervisor.spawn(self._ask_again(arc)),
        )
        self.waits_for_devices = False
        """Whether its requests wait for what nobody knows, instead of being refused, if they do not say."""

    @classmethod
    def connect(
        cls, name: str | None = None, *, fleet: Fleet | None = None, host: str | None = None
    ) -> Connecting[Self]:
        """Joins the mesh: await the result, or enter it. `name` must be the only one of this host; the default is.

        Without a `fleet`, the one that ZSCOUT_FLEET names, or the default. Raises MeshError, BadInput."""
        return Connecting(cls._connect(name, fleet, host))

    @classmethod
    async def _connect(cls, name: str | None, fleet: Fleet | None, host: str | None) -> Self:
        fleet = fleet or fleet_from_env()
        machine = valid_name(socket.gethostname())
        if fleet.security is not None:
            # Keys have the certificate's name: of this machine, or of who runs this program.
            host = host or read_certificates(fleet.security).name
        host = host or os.environ.get("ZSCOUT_HOST") or machine
        me = Sender(check_name(host, "host"), check_name(name or f"client-{new_instance()}", "client"))
        client = cls(await ZenohMesh.open(replace(fleet, mesh=beside(fleet.mesh)), me), fleet)
        client.who = this_program(host if fleet.security is None else machine)
        return client.start()

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self.close()

    def start(self) -> Self:
        """Declares on the mesh what a client has; `connect` does so."""
        keys, mesh = self.mesh.keys, self.mesh
        self._declared = [mesh.subscribe(keys.notice(mesh.me), Notice, self._on_notice), *self._rcm.start()]
        mesh.watch_links()
        self._store.ask_again = self._on_dropped
        self._renew_token()
        self._supervisor.spawn(self._rcm.keep_asking())
        self._supervisor.spawn(self._rcm.watch_lease())
        return self

    def _renew_token(self) -> None:
        """Shows that this client lives, by a token that nobody can have taken for gone."""
        mesh = self.mesh
        self._instance = new_instance()
        token = mesh.alive(Token(mesh.me.host, Role.CLIENT, mesh.me.client, self._instance))
        if self._token is not None:
            self._token.close()
        self._token, self._shown = token, mesh.now()

    def _on_dropped(self, arc: OpenArc) -> None:
        # All that was dropped together is asked for with one token.
        if arc.outcome == "client_lost" and self.mesh.now() - self._shown > RENEW_TOKEN:
            self._renew_token()
        self._supervisor.spawn(self._ask_again(arc))

    async def close(self) -> None:
        """Gives back everything and leaves the mesh."""
        try:
            if self._leaving is None:
                self._store.resumed.set()
                self._may_end.set()
                await self._supervisor.close()
                await asyncio.gather(*(self.end(arc) for arc in self._store.open))
                if telling := self._confirmations.telling:
                    await asyncio.wait(telling, timeout=LAST_WORD)
        finally:
            await self.leave()

    async def leave(self) -> None:
        """Leaves the mesh without ending anything or giving it back: for who has handed over all. What is
        still this client's goes when the RCM sees that its token has gone."""
        self._leaving = self._leaving or asyncio.create_task(self._leave())
        # Its token must go even if the caller is cancelled.
        await asyncio.shield(self._leaving)

    async def _leave(self) -> None:
        self._may_end.set()
        try:
            await self._supervisor.close()
        finally:
            for telling in self._confirmations.telling:
                telling.cancel()
            for declared in (*filter(None, [self._token]), *reversed(self._declared)):
                declared.close()
            await self.mesh.close()

    def _failed(self, error: Exception) -> None:
        """A task of this client failed: its holds end here, and at the RCM when its token has gone."""
        for arc in self._store.open:
            arc.finish("lost", f"this client failed: {error!r}", self.mesh.now())
            self._store.notify(arc)
        self._leaving = self._leaving or asyncio.create_task(self._leave())

    @property
    def term(self) -> Term:
        """The highest term received or promised; what is of an older one is ignored."""
        return self._rcm.term

    @property
    def leader(self) -> str | None:
        """The host whose node leads, or None where no RCM is seen."""
        return self._rcm.leader

    async def see_rcm(self, seconds: float = LOOK_FOR_RCM, takeover: float = LOOK_FOR_TAKEOVER) -> None:
        """Returns as soon as an RCM is seen. Raises NoRcm where none is within `seconds`, or within `takeover` where a
        candidate is seen, which may be about to take the lead."""
        if self.leader is not None:
            return
        seen, candidates = asyncio.Event(), set[Token]()

        def on_token(token: Token, alive: bool) -> None:
            if token.role == Role.CANDIDATE:
                (candidates.add if alive else candidates.discard)(token)
            elif alive:
                seen.set()

        with ExitStack() as stack:
            for role in (Role.RCM, Role.CANDIDATE):
                stack.enter_context(closing(self.mesh.watch(self.mesh.keys.alive_any(role), on_token)))
            if await done_within(seconds, seen.wait()):
                return
            if candidates and await done_within(max(0.0, takeover - seconds), seen.wait()):
                return
        nobody = f"no leader is on the mesh of fleet {self.fleet.name}"
        if candidates:
            names = ", ".join(sorted(token.host for token in candidates)[:MAX_NAMED])
            raise NoRcm(f"{nobody}, though {names} could lead; see the log of zscout-node there")
        links = self.mesh.links()
        who = f"{links} link{'s' * (links > 1)} to other programs" if links else "no other program either"
        raise NoRcm(
            f"{nobody} ({who}); start zscout-node on a host, or check the fleet file (--fleet, ${FLEET_VARIABLE}): "
            "`zscout doctor` finds the cause"
        )

    # Requests

    async def request(
        self,
        name: str,
        needs: Needs,
        *,
        priority: int = 0,
        min_runtime: float | Decimal | None = None,
        keep: bool = True,
        estimate: bool = False,
        direct: bool = False,
        comment: str = "",
        wait_for_device: bool | None = None,
        booking: str = "",
        continues: str = "",
    ) -> OpenArc:
        """Asks for an ARC and returns when the RCM has answered, for as long as that takes.

        Once granted it is protected for `min_runtime` seconds (default: the fleet's, 60), and held until somebody of
        equal or higher priority waits for what it holds; without `keep`, it ends when they are over.

        A need names an RC, or is a pattern that any one RC meets: `framegrabber/*`; `framegrabber/*#2` is one
        more. With `estimate` its notices say when it will start. `direct`: its program touches devices past their RCs;
        see `direct_hold`. The `comment` is shown to others. What can never start is refused at once: a parameter that
        its RC does not know, more of one than that ever carries, and, unless it is to `wait_for_device` (default:
        `waits_for_devices`), a need that nobody knows. With a `booking`, by its id, it takes that up, whose needs and
        priority it has (`BookingsClient.terms`), and waits for its next date. It `continues` this client's ARC of that
        name, which holds less at a lower priority: where it takes over all RCs of that one in one step, their devices
        are not made safe in between. Raises RequestRefused where the request can't be taken as it is, ValueError for
        too long a comment.

        An ARC of this name and these needs that another client hands over is returned instead, as it is."""
        wanted = amounts(needs)
        who = replace(self.who or Who(), comment=checked_comment(comment)) if comment else self.who
        arc = await self._claim(check_name(name, "arc"), wanted)
        if arc is None:
            seconds, now = self._protected(min_runtime), self.mesh.now()
            arc = OpenArc(new_instance(), name, wanted, priority, seconds, keep, estimate, direct, since=now)
            arc.who, arc.booking, arc.continues = who, booking, continues
            arc.check, arc.wait_for_device = True, self._waits(wait_for_device)
            self._store.add(arc)
        elif estimate:
            # Nobody has said that of it here: from the next asking on.
            arc.estimate = True
        try:
            await self._rcm.submit(arc)
        except BaseException as error:
            self._store.forget(arc)
            if not isinstance(error, RequestRefused):
                # The RCM may have it.
                self._supervisor.spawn(self._rcm.give_back(messages.Cancel(id=arc.id)))
            raise
        return arc

    def _protected(self, min_runtime: float | Decimal | None) -> Decimal:
        """In seconds; what nobody gave is the fleet's. Raises ValueError."""
        if min_runtime is not None:
            check_seconds("min_runtime", min_runtime)
        return Decimal(self.fleet.min_runtime) / SECOND if min_runtime is None else Decimal(str(min_runtime))

    def _waits(self, wait_for_device: bool | None) -> bool:
        return self.waits_for_devices if wait_for_device is None else wait_for_device

    async def changed(self, arc: OpenArc) -> None:
        """Waits until there is news of `arc`."""
        await self._store.changed(arc)

    async def granted(self, arc: OpenArc, *, confirmed: bool = False) -> Grant | None:
        """Waits until `arc` is granted; None if it ended instead. Its RCs are asked beside whether they know of it, and
        if not, it is taken away again: `arc` has no grant then, and waits for another one.

        With `confirmed`, and for a direct request, it waits until all RCs have confirmed it, which they do once they
        have settled; raises CommandRefused where one refuses it for a reason that waiting does not mend.

        Nothing is entered while the client is paused, nor is what it hands over reported as ended."""
        while True:
            await self._store.resumed.wait()
            if not arc.open:
                return None
            if arc.state != "running" or arc.grant is None:
                await self.changed(arc)
                continue
            grant = arc.grant
            confirmation = self._confirmations.begin(arc, grant)
            if not (confirmed or arc.direct):
                return grant
            await confirmation.over()
            if arc.grant == grant and confirmation.all:
                return grant
            if arc.grant == grant and confirmation.refused is not None:
                await self.end(arc)
                raise confirmation.refused

    async def confirmed(self, arc: OpenArc) -> bool:
        """Waits until all RCs of the present grant have confirmed it. False: they do not, or it is over."""
        if (grant := arc.grant) is None:
            return False
        confirmation = self._confirmations.begin(arc, grant)
        await confirmation.over()
        return arc.grant == grant and confirmation.all

    def direct_hold(self, grant: Grant) -> DirectHold | None:
        """For who runs the program of a direct request: how long its hold may be relied on, and what is to be told when
        the program is gone. None where the request was not direct, or that has been told."""
        return self._confirmations.direct(grant)

    async def end(self, arc: OpenArc) -> None:
        """Gives back a hold, or leaves the queue: once the client is no longer paused, if that was not handed
        over then. The program of a direct one is gone by then. Tried a few times; the RCM sees our token die
        otherwise."""
        await self._may_end.wait()
        if self._leaving is not None:
            return
        if arc.state == "moved":
            self._store.forget(arc)
            return
        self._confirmations.program_is_gone(arc)
        await self._rcm.end(arc)

    def complete(self, arc: OpenArc) -> None:
        """An ARC has had its time by this host's clock, and its body has returned; RCs and RCM end it by theirs."""
        self._confirmations.program_is_gone(arc)
        self.expire(arc)

    def expire(self, arc: OpenArc) -> None:
        """An ARC has had its time by this host's clock: it is not asked for any more, though a direct body may clear
        up yet."""
        arc.finish("completed", "its minimum runtime is over", self.mesh.now())
        self._store.notify(arc)
        self._store.forget(arc)

    async def hand_over(self, arc: OpenArc, to: Sender) -> None:
        """Lets one ARC, queued or running, go on in another client. Raises RequestRefused."""
        reply = await self._rcm.query(messages.HandOver(id=arc.id, to=str(to)))
        if reply is None or reply.message is None:
            unknown = Problem("unknown", "the leader did not answer; ask how the request stands")
            raise RequestRefused(reply.problem or unknown if reply is not None else unknown)

    def watch(self, watcher: Callable[[OpenArc], None]) -> None:
        """Calls `watcher(arc)` whenever there is news of any of this client's requests."""
        self._store.watchers.append(watcher)

    # Operators' questions

    async def state(
        self, arc: str | None = None, *, forecast: bool = False, timeout: float = QUERY_TIMEOUT
    ) -> RcmState | None:
        """The RCM's state, with the history of `arc` if one is named, and with a `forecast` of when those who
        wait will start; None if no RCM answered."""
        asked = messages.StateAsk(arc=arc, forecast=forecast)
        reply = await self.mesh.ask_one(self.mesh.keys.rcm_state, asked, RcmState, timeout=timeout)
        return reply.message if reply is not None else None

    async def foresee(
        self,
        name: str,
        needs: Needs,
        *,
        priority: int = 0,
        min_runtime: float | Decimal | None = None,
        keep: bool = True,
        wait_for_device: bool | None = None,
    ) -> Foresight | None:
        """What would come of a request, without making it; None if no RCM answered. Raises RequestRefused."""
        seconds = self._protected(min_runtime)
        waits, wanted = self._waits(wait_for_device), amounts(needs)
        asked = messages.Foresee(
            new_instance(), name, wanted, priority, seconds, keep, check=True, wait_for_device=waits
        )
        answered = await self.mesh.ask_one(self._rcm.key, asked, Foresight, timeout=QUERY_TIMEOUT)
        reply = naming_versions(answered, self._rcm.who)
        if reply is not None and reply.problem is not None:
            raise RequestRefused(reply.problem)
        return reply.message if reply is not None else None

    async def command(
        self, rc: str, grant: Grant, do: Mapping[str, Any], *, ttl: float = 1.0, timeout: float = 2.0
    ) -> Done:
        """Has an RC do something under `grant`. An RC that may not know of it yet, or settles, has `ttl` seconds to
        confirm it. Raises CommandRefused."""
        began = self.mesh.now()
        try:
            return await self._command(rc, grant, do, ttl=ttl, timeout=timeout)
        except CommandRefused as refused:
            confirmation = self._confirmations.pending(grant)
            if confirmation is None or refused.code not in NOT_DONE:
                raise
            left = ttl - (self.mesh.now() - began) / SECOND
            if not await done_within(max(0.0, left), confirmation.over()) or not confirmation.all:
                raise
        return await self._command(rc, grant, do, ttl=ttl, timeout=timeout)

    async def _command(
        self, rc: str, grant: Grant, do: Mapping[str, Any], *, ttl: float = 1.0, timeout: float = 2.0
    ) -> Done:
        key = self.mesh.keys.command(rc, self.mesh.me)
        id_ = f"{self._instance}-{next(self._commanded)}"
        command = messages.Command(grant=grant, do=dict(do), ttl=ttl, id=id_)
        reply = await self.mesh.ask_one(key, command, Done, timeout=timeout)
        if reply is None:
            raise CommandRefused(rc, Problem("unknown", "no answer; it may or may not have been done"))
        if reply.message is None:
            refused = CommandRefused(rc, reply.problem or Problem("unknown", "no reason given"))
            arc = next((arc for arc in self._store.open if arc.grant == grant), None)
            if refused.code in NOT_HELD and arc is not None and grant not in self._denied:
                self._denied.add(grant)
                self._supervisor.call_later(TOLD_WITHIN, self._lose, arc, grant, str(refused))
            raise refused
        return reply.message

    def _lose(self, arc: OpenArc, grant: Grant, reason: str) -> None:
        """An RC of this grant does not know it any more, and no notice has said so."""
        self._denied.discard(grant)
        if arc.grant == grant and arc.id in self._store.arcs and self._store.resumed.is_set():
            arc.lose(reason, self.mesh.now())
            self._store.notify(arc)
            self._supervisor.spawn(self._ask_again(arc))

    def _on_notice(self, _key: str, notice: Notice) -> None:
        if not self._rcm.accept(notice.term):
            return
        if (arc := self._store.arcs.get(notice.id)) is not None:
            self._store.take(arc, notice)
        elif not self._take_moving(notice) and notice.id not in self._store.withdrawn:
            # What nobody here asked for, or what was over here before an RCM that took the lead heard of it.
            if notice.state == "running":
                self._supervisor.spawn(self._rcm.give_back(messages.Release(id=notice.id)))
            elif notice.state == "queued":
                self._supervisor.spawn(self._rcm.give_back(messages.Cancel(id=notice.id)))


C = TypeVar("C", bound=Client)


class Connecting(Coroutine[Any, Any, C], Generic[C]):
    """A client on its way to the mesh: await it, or enter it, which closes it at the end of the body."""

    def __init__(self, connecting: Coroutine[Any, Any, C]) -> None:
        self._connecting = connecting
        self._client: C | None = None

    def __await__(self) -> Generator[Any, Any, C]:
        return self._connecting.__await__()

    async def __aenter__(self) -> C:
        self._client = await self._connecting
        return self._client

    async def __aexit__(self, *exc: object) -> None:
        if self._client is not None:
            await self._client.close()

    # A coroutine as before, which a task can run.

    def send(self, value: Any) -> Any:
        return self._connecting.send(value)

    def throw(self, *error: Any) -> Any:
        return self._connecting.throw(*error)

    def close(self) -> None:
        self._connecting.close()

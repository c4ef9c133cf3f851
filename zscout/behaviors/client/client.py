"""A program's connection to the mesh: requests devices, follows the requests, and commands held devices."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Coroutine, Generator, Mapping
from contextlib import ExitStack, closing
from decimal import Decimal
from typing import Any, Final, Generic, Self, TypeVar

from msgspec.structs import replace

from zscout import messages
from zscout.behaviors.client.confirmation import NOT_DONE
from zscout.behaviors.client.identity import checked_comment, host_of, this_machine, this_program
from zscout.behaviors.client.internals import ClientInternals
from zscout.behaviors.client.rcm_link import QUERY_TIMEOUT, TRY_AGAIN
from zscout.behaviors.client.remedies import CHECK_FLEET
from zscout.behaviors.client.request import (
    CommandRefused,
    Needs,
    NoRcm,
    OpenArc,
    RequestRefused,
    amounts,
    check_seconds,
)
from zscout.config.fleet import Fleet, beside, fleet_from_env
from zscout.keyexpr import USERS, Role, Sender, Token, check_name, check_new_name, new_instance
from zscout.mesh import Mesh, ZenohMesh
from zscout.mesh.exchange import naming_versions
from zscout.mesh.supervision import done_within
from zscout.messages import Done, Foresight, Problem, RcmState, Who
from zscout.types import SECOND, Grant

__all__ = ["QUERY_TIMEOUT", "TRY_AGAIN", "Client", "CommandRefused", "NoRcm", "RequestRefused"]

log = logging.getLogger(__name__)

LOOK_FOR_RCM: Final = 3.0
"""Seconds within which an existing leader is visible."""
LOOK_FOR_TAKEOVER: Final = 5.0
"""Seconds to wait for a leader if a node is visible that may lead."""
MAX_NAMED: Final = 5


class Client:
    """A program's connection to the mesh. Open it with `async with Client.connect(...) as client`, or `await
    Client.connect(...)` and `close` it."""

    def __init__(self, mesh: Mesh, fleet: Fleet) -> None:
        self.mesh, self.fleet = mesh, fleet
        # For zscout's own modules; may change without notice.
        self.internals = own = ClientInternals(mesh, fleet)
        self._store, self._rcm, self._supervisor = own.store, own.rcm, own.supervisor
        self._confirmations = own.confirmations
        self.who: Who | None = None
        """User, host and command, shown to other people. `connect` sets it."""
        self.waits_for_devices = False
        """Default of the argument `wait_for_device`."""

    @classmethod
    def connect(
        cls, name: str | None = None, *, fleet: Fleet | None = None, host: str | None = None
    ) -> Connecting[Self]:
        """Join the mesh: await the result, or use it with `async with`. `name` must be unique on this host; the default
        is random. `fleet` defaults to the fleet file named by $ZSCOUT_FLEET, else to the default fleet. `host` defaults
        to $ZSCOUT_HOST, else to the name of this machine; in a secured fleet, to the name in the certificate. Raises
        MeshError, BadInput."""
        return Connecting(cls._connect(name, fleet, host))

    @classmethod
    async def _connect(cls, name: str | None, fleet: Fleet | None, host: str | None) -> Self:
        fleet = fleet or fleet_from_env()
        host = host or host_of(fleet)
        me = Sender(check_name(host, "host"), check_name(name or f"client-{new_instance()}", "client"))
        client = cls.on(await ZenohMesh.open(replace(fleet, mesh=beside(fleet.mesh)), me), fleet)
        client.who = this_program(host if fleet.security is None else this_machine())
        return client

    @classmethod
    def on(cls, mesh: Mesh, fleet: Fleet) -> Self:
        """Return a client on an open mesh, which it closes: for tests, on a `zscout.testing.MemoryMesh`."""
        client = cls(mesh, fleet)
        client.internals.start()
        return client

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Give back everything held or requested, and leave the mesh."""
        await self.internals.close()

    @property
    def leader(self) -> str | None:
        """The host of the leading node; None while no leader is visible."""
        return self._rcm.leader

    async def see_rcm(self, seconds: float = LOOK_FOR_RCM, takeover: float = LOOK_FOR_TAKEOVER) -> None:
        """Return as soon as a leader is visible. Raises NoRcm if none appears within `seconds`, or within `takeover`
        seconds if a node is visible that may lead."""
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
        no_leader = f"no leader is on the mesh of fleet {self.fleet.name}"
        if candidates:
            names = ", ".join(sorted(token.host for token in candidates)[:MAX_NAMED])
            raise NoRcm(f"{no_leader}, though {names} could lead; see the log of zscout-node there")
        links = self.mesh.links()
        others = f"{links} link{'s' * (links > 1)} to other programs" if links else "no other program either"
        raise NoRcm(f"{no_leader} ({others})", CHECK_FLEET)

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
        until_done: bool = False,
    ) -> OpenArc:
        """Request devices, and return when the leader has answered, however long that takes.

        The result is passed to the other methods. Its `state` is `queued`, `running` or `ended`; it has a `reason`, and
        while it runs a `grant` and its `rcs`.

        Once granted, the hold is protected for `min_runtime` seconds (default: the fleet's, 60), and continues until a
        request of equal or higher priority waits for one of its devices. With `keep=False` it ends after `min_runtime`.

        `needs` maps each need to its parameters: `{"robot/scout33": {}}`. A need is a device, or a pattern that any one
        matching device satisfies: `framegrabber/*`, and `framegrabber/*#2` for one more.

        - `estimate`: the returned request has an estimated start.
        - `direct`: the program also reaches its devices past zscout; `zscout.hold(direct=True)` handles what follows.
        - `comment`: shown to other people.
        - `wait_for_device`: wait for an unknown device instead of raising (default: `waits_for_devices`).
        - `booking`: the id of a booking to take up. The request has its needs and priority (`BookingsClient.terms`),
          and waits for its next date.
        - `continues`: the name of this client's request whose hold this one replaces. It must hold less, at a lower
          priority. If all its devices pass over in one step, they are not made safe in between.
        - `until_done`: without `min_runtime`, protect the hold for the fleet's `command_min_runtime` (an hour) or, if
          sooner, until the next booking, maintenance or reservation of its devices.

        If another client is handing over a request of this name and these needs, that request is returned.

        Raises RequestRefused if the request can never be granted as it is, ValueError if the comment is too long."""
        wanted = amounts(needs)
        who = replace(self.who or Who(), comment=checked_comment(comment)) if comment else self.who
        arc = await self.internals.claim(check_new_name(name, "arc"), wanted)
        if arc is None:
            seconds, now = self._protected(min_runtime), self.mesh.now()
            arc = OpenArc(new_instance(), name, wanted, priority, seconds, keep, estimate, direct, since=now)
            arc.who, arc.booking, arc.continues = who, booking, continues
            arc.until_done = until_done and min_runtime is None and keep
            arc._check, arc._wait_for_device = True, self._waits(wait_for_device)
            self._store.add(arc)
        elif estimate:
            # The request was handed over without it: the next submission asks for estimates.
            arc.estimate = True
        try:
            await self._rcm.submit(arc)
        except BaseException as error:
            self._store.forget(arc)
            if not isinstance(error, RequestRefused):
                # The RCM may have the request.
                self._supervisor.spawn(self._rcm.give_back(messages.Cancel(id=arc.id)))
            raise
        return arc

    def _protected(self, min_runtime: float | Decimal | None) -> Decimal:
        """Return `min_runtime` in seconds, by default the fleet's. Raises ValueError."""
        if min_runtime is not None:
            check_seconds("min_runtime", min_runtime)
        return Decimal(self.fleet.min_runtime) / SECOND if min_runtime is None else Decimal(str(min_runtime))

    def _waits(self, wait_for_device: bool | None) -> bool:
        return self.waits_for_devices if wait_for_device is None else wait_for_device

    async def changed(self, arc: OpenArc) -> None:
        """Wait for the next change of the request `arc`."""
        await self._store.changed(arc)

    async def granted(self, arc: OpenArc, *, confirmed: bool = False) -> Grant | None:
        """Wait until the request `arc` is granted, and return the grant; None if the request ended instead.

        Meanwhile its devices are asked to confirm the grant. If one does not within a second, the grant is withdrawn
        and the request waits again. With `confirmed`, and for a direct request, return only when all devices have
        confirmed the grant, which they do once they are ready. Raises CommandRefused if a device refuses it for a
        reason that does not pass with time."""
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

    async def end(self, arc: OpenArc) -> None:
        """Give back a hold, or take a request out of the queue. Return when the leader has answered, or after a few
        tries."""
        await self.internals.end(arc)

    async def hand_over(self, arc: OpenArc, to: Sender) -> None:
        """Pass one request, queued or running, to the client `to`. Raises RequestRefused."""
        reply = await self._rcm.query(messages.HandOver(id=arc.id, to=str(to)))
        if reply is None or reply.message is None:
            unknown = Problem("unknown", "the leader did not answer; the request may or may not have been handed over")
            raise RequestRefused(reply.problem or unknown if reply is not None else unknown)

    async def state(
        self, arc: str | None = None, *, forecast: bool = False, timeout: float = QUERY_TIMEOUT
    ) -> RcmState | None:
        """Return the leader's state: devices, holds and the queue. None if no leader answered within `timeout` seconds.
        With `arc` (a request's id) it includes that request's history; with `forecast`, the estimated starts."""
        asked = messages.StateAsk(arc=arc, forecast=forecast)
        reply = await self.mesh.ask_one(self.mesh.keys.ask_state(self.mesh.me), asked, RcmState, timeout=timeout)
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
        """Return the consequences that a request would have, without making it (a dry run). None if no leader answered.
        Takes the arguments of `request`. Raises RequestRefused."""
        if self.mesh.keys.closed and (why := self.fleet.access.refusal(self.mesh.me.host, "request devices", USERS)):
            raise RequestRefused(Problem("not_allowed", why))
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
        """Have the device `rc` carry out a command under `grant`, and return its answer; its `result` is the device's
        result. If the device does not know the grant yet, or is not ready, the command waits there for at most `ttl`
        seconds. `timeout`: seconds to wait for the answer. Raises CommandRefused."""
        began = self.mesh.now()
        try:
            return await self.internals.command(rc, grant, do, ttl=ttl, timeout=timeout)
        except CommandRefused as refused:
            confirmation = self._confirmations.pending(grant)
            if confirmation is None or refused.code not in NOT_DONE:
                raise
            left = ttl - (self.mesh.now() - began) / SECOND
            if not await done_within(max(0.0, left), confirmation.over()) or not confirmation.all:
                raise
        return await self.internals.command(rc, grant, do, ttl=ttl, timeout=timeout)


C = TypeVar("C", bound=Client)


class Connecting(Coroutine[Any, Any, C], Generic[C]):
    """The result of `Client.connect`: await it, or use it with `async with`, which closes the client."""

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

    # It is a coroutine too, so that a task can run it.

    def send(self, value: Any) -> Any:
        return self._connecting.send(value)

    def throw(self, *error: Any) -> Any:
        return self._connecting.throw(*error)

    def close(self) -> None:
        self._connecting.close()

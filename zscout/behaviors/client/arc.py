"""An ARC in a few lines: a context manager that waits for the grant and ends its body when it is over.

    async with Client.connect() as client:
        async with hold(client, "survey", {"robot/scout33": {}}) as held:
            await held.command("robot/scout33", {"name": "echo", "value": 1})

A hold is protected for its minimum runtime (the fleet's, 60 s), and goes on until somebody of equal or higher
priority waits for what it holds; with `keep=False` it ends when its minimum runtime is over. The body is cancelled when
the hold is taken away before that (`Revoked` comes out of the `async with`), and when its time is over (nothing comes
out, and `held.completed` is true). `holds` asks again, and goes again when it is granted again:

    async for attempt in holds(client, "survey", {"robot/scout33": {}}):
        async with attempt as held:
            ...

A need may be a pattern, which any one RC meets: with `{"framegrabber/*": {}}` as needs,
`held.rc("framegrabber/*")` is the one that was given, and `held.command("framegrabber/*", ...)` goes to it.

The body begins at the grant. Whether its RCs know of it is seen to beside: one that does not confirm it within a second
ends the body, and what is commanded meanwhile waits at the RC for as long as its `ttl`. A body that needs its devices
ready from the first line on says `confirmed=True`, or awaits `held.confirmed()`.

A body that touches devices past their RCs says `direct=True`. It begins when all have confirmed. When its hold ends it
is cancelled, and its `finally` and `except CancelledError` run to their end, in at most nine tenths of what its RCs
settle; the next holder waits for that.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Mapping
from contextlib import suppress
from decimal import Decimal
from typing import Any

from zscout.behaviors.client.client import Client
from zscout.behaviors.client.direct import DirectHold
from zscout.behaviors.client.request import HoldEnd, Needs, OpenArc, check_seconds
from zscout.keyexpr import is_pattern
from zscout.messages import Done
from zscout.types import SECOND, Grant, Ns

log = logging.getLogger(__name__)


class Revoked(Exception):
    """The hold was taken away; `outcome` is the protocol's word, the message the reason."""

    def __init__(self, arc: OpenArc, ending: HoldEnd | None = None) -> None:
        ending = ending or arc.ending or HoldEnd(arc.outcome or "lost", arc.reason, arc.by)
        super().__init__(ending.reason or ending.outcome)
        self.outcome = ending.outcome
        self.by = ending.by


class Held:
    """A hold in force, inside the body."""

    def __init__(self, client: Client, arc: OpenArc, grant: Grant) -> None:
        self._client = client
        self.arc = arc
        self.grant = grant
        self.rcs: list[str] = list(arc.rcs)
        """All that it holds, sorted."""
        self.bound: dict[str, str] = dict(arc.bound)
        """By each pattern of the needs: the RC that meets it."""

    def rc(self, need: str) -> str:
        """The RC that meets a need: `held.rc("framegrabber/*")`; an RC that is held meets its own name.

        Raises KeyError for what was not asked for."""
        rc = self.bound.get(need, need)
        if rc not in self.rcs:
            asked = ", ".join(sorted(self.arc.needs))
            raise KeyError(f"{need} is not a need of {self.arc.name}; it asked for {asked}")
        return rc

    def now(self) -> Ns:
        """The time by this host's clock."""
        return self._client.mesh.now()

    @property
    def active(self) -> bool:
        """Whether the hold is still in force, as far as this client knows."""
        return self.arc.grant == self.grant

    @property
    def remaining(self) -> float:
        """Seconds of the minimum runtime that are left."""
        return (self.arc.end - self.now()) / SECOND

    @property
    def completed(self) -> bool:
        """Whether the hold is over because it had its time: its minimum runtime, and with `keep` somebody waited."""
        if self.active:
            return not self.arc.keep and self.remaining <= 0 and not self.settling
        return self.arc.outcome == "completed"

    @property
    def settling(self) -> bool:
        """Whether some of its RCs still settle. If that lasts until its time is over, it is asked for once more."""
        return self.arc.settling == self.grant

    async def confirmed(self) -> bool:
        """Waits until all RCs have confirmed this hold, which they do once they have settled. False: it is over."""
        return self.active and await self._client.confirmed(self.arc) and self.active

    async def command(self, need: str, do: Mapping[str, Any], *, ttl: float = 1.0) -> Done:
        """Has one of the held RCs do something: the one of this name, or that meets this pattern.

        Raises CommandRefused, and KeyError for a pattern that was not asked for."""
        rc = self.rc(need) if is_pattern(need) else need
        return await self._client.command(rc, self.grant, do, ttl=ttl)

    async def resumed(self) -> None:
        """Waits while the client is paused: what becomes of the hold meanwhile counts from then on."""
        await self._client.resumed()

    async def over(self) -> None:
        """Waits until the hold is over; for bodies that work elsewhere."""
        # A timer may go off a little before its time by this host's clock.
        while self.active and not self.completed:
            with suppress(TimeoutError):
                async with asyncio.timeout(None if self.arc.keep or self.settling else self.remaining):
                    await self._client.changed(self.arc)


class Attempt:
    """One entry into an ARC's body, or one after the other: `again` lets a hold that was taken away be waited for
    once more, and one that was kept and had its time be asked for anew. `timeout` in seconds, for each wait."""

    def __init__(
        self,
        client: Client,
        ask: dict[str, Any],
        *,
        again: bool = False,
        timeout: float | None = None,
        confirmed: bool = False,
    ) -> None:
        for what, value in (("timeout", timeout), ("min_runtime", ask["min_runtime"])):
            if value is not None:
                check_seconds(what, value)
        self._client, self._ask, self._again, self._timeout = client, ask, again, timeout
        self._confirmed = confirmed
        self.arc: OpenArc | None = None
        self._anew = False
        """Whether what was kept is to be asked for anew."""
        self._entered: tuple[Held, asyncio.Task[Any], asyncio.Task[None], DirectHold | None] | None = None
        """The hold, its body, what cancels the body when the hold is over, and what a direct one owes its RCs."""
        self._cancelled = 0
        """How often the body was, for that."""

    @property
    def goes_on(self) -> bool:
        """Whether its ARC is to be waited for once more."""
        return self._anew or (self.arc is not None and self.arc.open)

    async def asked(self) -> OpenArc:
        """The request, made now where it was not yet, for who wants to know of it while it waits. Raises
        RequestRefused."""
        if self._anew or self.arc is None:
            self.arc, self._anew = None, False
            self.arc = await self._client.request(**self._ask)
        return self.arc

    async def granted(self) -> Held:
        """Waits for the grant, requested where it was not yet. Raises Revoked, RequestRefused, TimeoutError."""
        try:
            async with asyncio.timeout(self._timeout):
                grant = await self._client.granted(await self.asked(), confirmed=self._confirmed)
        except (asyncio.CancelledError, TimeoutError) as error:
            why = self.arc.reason if self.arc is not None else "no leader has answered"
            if self.arc is not None:
                await self._client.end(self.arc)
            if isinstance(error, asyncio.CancelledError):
                raise
            raise TimeoutError(f"{self._ask['name']} was not granted within {self._timeout:g} s: {why}") from None
        assert self.arc is not None  # noqa: S101 - it was asked for
        if grant is None:
            raise Revoked(self.arc)
        return Held(self._client, self.arc, grant)

    async def __aenter__(self) -> Held:
        held, body = await self.granted(), asyncio.current_task()
        assert body is not None  # noqa: S101 - this is a coroutine
        direct, self._cancelled = self._client.direct_hold(held.grant), 0
        self._entered = held, body, asyncio.create_task(self._interrupt_when_over(held, body, direct)), direct
        return held

    async def _interrupt_when_over(self, held: Held, body: asyncio.Task[Any], direct: DirectHold | None) -> None:
        await held.over()
        await held.resumed()
        self._cancel(body)
        if direct is not None:
            direct.end()
            if held.active:
                # By our clock it had its time. An RCM that takes the lead as it clears up would queue it again.
                self._client.expire(held.arc)
            await asyncio.sleep(max(0, direct.gone_by - held.now()) / SECOND)
            log.warning("%s cleans up too long after its hold; interrupting it, the next holder begins", held.arc.name)
            self._cancel(body)

    def _cancel(self, body: asyncio.Task[Any]) -> None:
        self._cancelled += 1
        body.cancel()

    async def __aexit__(self, kind: type[BaseException] | None, *_error: object) -> bool:
        assert self._entered is not None  # noqa: S101 - entered before left
        held, body, watch, direct = self._entered
        arc = held.arc
        watch.cancel()
        if direct is not None:
            direct.returned()
        # As asyncio.timeout does it: a cancellation from outside that came as well is not swallowed.
        left = [body.uncancel() for _ in range(self._cancelled)]
        interrupted = left[-1:] == [0] and kind is asyncio.CancelledError
        if held.completed:
            # What somebody released is not to be had again.
            by_hand = arc.why is not None and arc.why.code == "released"
            self._anew = self._again and interrupted and arc.keep and not by_hand
            self._client.complete(arc)
            return interrupted
        # Whose body was interrupted is over for it, though a new RCM may have found that it stands all the same.
        if not interrupted and (held.active or kind is not None):
            if arc.open:
                await self._client.end(arc)
            return False
        if self._again and arc.open:
            return interrupted
        revoked = Revoked(arc)
        if arc.open:
            await self._client.end(arc)
        raise revoked from None


_ASKED = ("name", "needs", "priority", "min_runtime", "keep", "direct", "comment", "wait_for_device", "booking")


def _ask(*values: Any) -> dict[str, Any]:
    """What `Client.request` is given."""
    return dict(zip(_ASKED, values, strict=True))


def hold(
    client: Client,
    name: str,
    needs: Needs,
    *,
    priority: int = 0,
    min_runtime: float | Decimal | None = None,
    keep: bool = True,
    direct: bool = False,
    confirmed: bool = False,
    timeout: float | None = None,
    comment: str = "",
    wait_for_device: bool | None = None,
    booking: str = "",
) -> Attempt:
    """An ARC as an async context manager; see the module's text. `min_runtime` in seconds, by default the fleet's;
    `confirmed`: it is entered when all RCs have confirmed the grant; the `comment` is shown to others;
    `wait_for_device` and `booking` as `Client.request` has them.

    Entering raises TimeoutError where it was not granted within `timeout` seconds: it is cancelled then."""
    ask = _ask(name, needs, priority, min_runtime, keep, direct, comment, wait_for_device, booking)
    return Attempt(client, ask, timeout=timeout, confirmed=confirmed)


async def holds(
    client: Client,
    name: str,
    needs: Needs,
    *,
    priority: int = 0,
    min_runtime: float | Decimal | None = None,
    keep: bool = True,
    direct: bool = False,
    confirmed: bool = False,
    comment: str = "",
    wait_for_device: bool | None = None,
    booking: str = "",
    estimate: bool = False,
    continues: str = "",
) -> AsyncIterator[Attempt]:
    """The same, entered again whenever it was ended for others and is granted again, until a body ends by itself, or
    without `keep` has had its time. `estimate` and `continues` as `Client.request` has them."""
    ask = _ask(name, needs, priority, min_runtime, keep, direct, comment, wait_for_device, booking)
    ask |= {"estimate": estimate, "continues": continues}
    attempt = Attempt(client, ask, again=True, confirmed=confirmed)
    yield attempt
    while attempt.goes_on:
        yield attempt

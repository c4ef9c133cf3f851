"""Holds as context managers: `hold` for a single hold, `holds` for consecutive holds of a request.

    async with Client.connect() as client:
        async for attempt in holds(client, "survey", {"robot/scout33": {}}):
            async with attempt as held:
                await held.command("robot/scout33", {"name": "echo", "value": 1})

The body begins at the grant, while the devices are still confirming it; if a device does not confirm within a second,
the body is cancelled. A command that reaches a device before it knows the grant waits there for at most its `ttl`."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import AsyncGenerator, AsyncIterator, Callable, Mapping
from contextlib import closing, suppress
from decimal import Decimal
from typing import Any, Final

from zscout.behaviors.client.bookings import BookingsClient
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.direct import DirectHold
from zscout.behaviors.client.hold_notices import HoldNotice, NoticeTracker
from zscout.behaviors.client.request import CommandRefused, HoldEnd, Needs, OpenArc, check_seconds
from zscout.keyexpr import is_pattern
from zscout.mesh.frames import Frame
from zscout.messages import Done
from zscout.scheduling.reason import kept
from zscout.types import SECOND, Grant, Ns

log = logging.getLogger(__name__)

UNKNOWN_TO_OLDER: Final = ("unknown_command", "bad_command", "warming")
"""Codes with which a device of an older version refuses an unknown command."""
PICTURE_WAIT: Final = 60.0
"""Longest wait for a picture, in seconds, before the wait is repeated."""


class Revoked(Exception):
    """The hold was taken away, or its time is over. `outcome` is the protocol's, such as `preempted`; `by` names the
    request that took it; the message is the reason."""

    def __init__(self, arc: OpenArc, ending: HoldEnd | None = None) -> None:
        ending = ending or arc._ending or HoldEnd(arc.outcome or "lost", arc.reason, arc.by)
        super().__init__(ending.reason or ending.outcome)
        self.outcome = ending.outcome
        self.by = ending.by


class Held:
    """A hold, inside the body of `async with hold(...)`."""

    def __init__(self, client: Client, arc: OpenArc, grant: Grant) -> None:
        self._client = client
        self.arc = arc
        self.grant = grant
        self.rcs: list[str] = list(arc.rcs)
        """The held devices, sorted."""
        self.bound: dict[str, str] = dict(arc.bound)
        """The device that satisfies each pattern of the needs."""
        self._tracker, self._notices = NoticeTracker(), deque[HoldNotice]()
        self._calling: set[asyncio.Task[None]] = set()

    def rc(self, need: str) -> str:
        """Return the device that satisfies a need: `held.rc("framegrabber/*")`. Raises KeyError for a need that was not
        requested."""
        rc = self.bound.get(need, need)
        if rc not in self.rcs:
            asked = ", ".join(sorted(self.arc.needs))
            raise KeyError(f"{need} is not a need of {self.arc.name}; it requested {asked}")
        return rc

    def now(self) -> Ns:
        """The time in ns since this host booted."""
        return self._client.mesh.now()

    @property
    def active(self) -> bool:
        """True while the hold is in force, as far as this client knows."""
        return self.arc.grant == self.grant

    @property
    def remaining(self) -> float:
        """Seconds left of the minimum runtime, which does not run while devices are starting."""
        return (self.arc.end - max(self.now(), self.arc.ready or 0)) / SECOND

    @property
    def completed(self) -> bool:
        """True if the hold ended after its minimum runtime, rather than before."""
        if self.active:
            return not self.arc.keep and self.remaining <= 0 and not self.settling
        return self.arc.outcome == "completed"

    @property
    def upcoming(self) -> list[HoldNotice]:
        """Notices of the waiting request, and of the booking or maintenance, to which this hold yields next."""
        return list(self.arc.upcoming) if self.active else []

    async def noticed(self) -> HoldNotice | None:
        """Wait for the next notice of a request, booking or maintenance to which the hold yields. Notices that are
        known already come first. None: the hold is over."""
        while True:
            self._notices += self._tracker.take(self.upcoming, self.now()) if self.active else []
            if self._notices:
                return self._notices.popleft()
            if not self.active or self.completed:
                return None
            due, now = self._tracker.next, self.now()
            ends = [] if self.arc.keep or self.settling else [self.arc.end]
            at = min([*ends, *([due] if due is not None else [])], default=None)
            with suppress(TimeoutError):
                async with asyncio.timeout(None if at is None else max(0, at - now) / SECOND):
                    await self._client.changed(self.arc)

    def on_notice(self, callback: Callable[[HoldNotice], object]) -> None:
        """Call `callback` with each notice that `noticed` would return, until the hold is over."""
        task = asyncio.create_task(self._call_back(callback))
        self._calling.add(task)
        task.add_done_callback(self._calling.discard)

    async def _call_back(self, callback: Callable[[HoldNotice], object]) -> None:
        own = Held(self._client, self.arc, self.grant)
        while (notice := await own.noticed()) is not None:
            try:
                callback(notice)
            except Exception:
                log.exception("a callback of %s failed", self.arc.name)

    @property
    def settling(self) -> bool:
        """True while some devices are not ready; the minimum runtime begins when all are. (With devices of zscout
        before 0.3 it runs meanwhile; if none of it is left once they are ready, the request is repeated.)"""
        return self.arc._settling == self.grant or (self.active and self.arc.ready is not None)

    async def confirmed(self) -> bool:
        """Wait until all devices have confirmed the hold, which they do once they are ready. Return False if the hold
        ended."""
        return self.active and await self._client.internals.confirmed(self.arc) and self.active

    async def command(self, need: str, do: Mapping[str, Any], *, ttl: float = 1.0) -> Done:
        """Have a held device carry out a command, and return its answer; its `result` is the device's result. `need` is
        the device's name, or the pattern that it satisfies. If the device is not ready, the command waits for at most
        `ttl` seconds. Raises CommandRefused, and KeyError for a pattern that was not requested."""
        rc = self.rc(need) if is_pattern(need) else need
        return await self._client.command(rc, self.grant, do, ttl=ttl)

    async def expect_outage(self, seconds: float, *, each: bool = False) -> dict[str, float]:
        """Announce an outage of the held devices of up to `seconds`, for example before a test reboots them: it does
        not end the hold. With `each`, this applies to every outage under this hold. Return by device how many seconds
        it tolerates: at most its `tolerate_max`, 0 if it does not support that. Raises CommandRefused."""
        check_seconds("seconds", seconds)
        do = {"name": "expect_outage", "seconds": float(seconds), "each": each}
        tolerated = await asyncio.gather(*(self._announce(rc, do) for rc in self.rcs))
        return dict(zip(self.rcs, tolerated, strict=True))

    async def report_broken(self, reason: str, *needs: str) -> None:
        """Report devices of this hold broken (default: all), with a reason for people. After the hold they are granted
        to operators only, until `zscout maintain DEVICE --well`. Raises RequestRefused; KeyError for a need that was
        not requested; ValueError for a reason that is too long."""
        await BookingsClient(self._client).report_broken([self.rc(need) for need in needs] or self.rcs, reason)

    async def _announce(self, rc: str, do: Mapping[str, Any]) -> float:
        try:
            done = await self._client.command(rc, self.grant, do)
        except CommandRefused as refused:
            if refused.code not in UNKNOWN_TO_OLDER:
                raise
            return 0.0
        known = done.result.get("seconds") if isinstance(done.result, dict) else None
        return float(known) if isinstance(known, int | float) else 0.0

    async def frames(self, need: str) -> AsyncGenerator[Frame, None]:
        """Yield the newest picture of a held framegrabber, again and again until the hold is over; a slow program
        misses some. Pictures of other holds are left out. Raises KeyError for a need that was not requested."""
        mesh, rc = self._client.mesh, self.rc(need)
        over = asyncio.create_task(self.over())
        try:
            with closing(mesh.frames(mesh.keys.frame(rc))) as watch:
                while not over.done():
                    coming = asyncio.create_task(watch.next(PICTURE_WAIT))
                    try:
                        await asyncio.wait((coming, over), return_when=asyncio.FIRST_COMPLETED)
                    finally:
                        coming.cancel()
                    if coming.done() and (frame := coming.result()) and frame.head.grant in (None, self.grant):
                        yield frame
        finally:
            over.cancel()

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self._words}>"

    @property
    def _words(self) -> str:
        if self.active and not self.completed:
            status = f"{self.remaining:.0f} s left" if self.remaining > 0 else kept(self.arc.priority)
        else:
            ending = None if self.active else self.arc._ending
            status = f"over: {ending.reason or ending.outcome}" if ending is not None else "over"
        return f"{self.arc.name}: {', '.join(self.rcs)}; {status}"

    async def resumed(self) -> None:
        """Wait while the program is being moved to another host."""
        await self._client.internals.resumed()

    async def over(self) -> None:
        """Wait until the hold is over, for bodies whose work runs elsewhere."""
        # A timer may fire a little early by this host's clock.
        while self.active and not self.completed:
            with suppress(TimeoutError):
                async with asyncio.timeout(None if self.arc.keep or self.settling else self.remaining):
                    await self._client.changed(self.arc)


class Attempt:
    """The context manager of a body under a hold. With `again` it can be entered repeatedly: after a hold was taken
    away it waits for the next; after a hold that had its minimum runtime and was kept until another request waited, it
    makes a new request. `timeout`: seconds, for each wait."""

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
        self._needs_new_request = False
        """True if the next entry must make a new request."""
        self._entered: tuple[Held, asyncio.Task[Any], asyncio.Task[None], DirectHold | None] | None = None
        """The hold, its body, the task that cancels the body at the end of the hold, and the direct hold, if any."""
        self._cancelled = 0
        """How often the body was cancelled for that."""

    @property
    def goes_on(self) -> bool:
        return self._needs_new_request or (self.arc is not None and self.arc.open)

    async def asked(self) -> OpenArc:
        """Return the request; submit it first if needed. Raises RequestRefused."""
        if self._needs_new_request or self.arc is None:
            self.arc, self._needs_new_request = None, False
            self.arc = await self._client.request(**self._ask)
        return self.arc

    async def granted(self) -> Held:
        """Wait for the grant, after making the request if needed. Raises Revoked, RequestRefused, TimeoutError."""
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
        assert self.arc is not None  # noqa: S101 - `asked` has set it
        if grant is None:
            raise Revoked(self.arc)
        return Held(self._client, self.arc, grant)

    async def __aenter__(self) -> Held:
        held, body = await self.granted(), asyncio.current_task()
        assert body is not None  # noqa: S101 - this is a coroutine
        direct, self._cancelled = self._client.internals.direct_hold(held.grant), 0
        self._entered = held, body, asyncio.create_task(self._interrupt_when_over(held, body, direct)), direct
        return held

    async def _interrupt_when_over(self, held: Held, body: asyncio.Task[Any], direct: DirectHold | None) -> None:
        await held.over()
        await held.resumed()
        self._cancel(body)
        if direct is not None:
            direct.end()
            if held.active:
                # Its time is over by this host's clock. A new leader during the cleanup would queue it again.
                self._client.internals.expire(held.arc)
            await asyncio.sleep(max(0, direct.gone_by - held.now()) / SECOND)
            log.warning("%s still cleans up, and the next hold begins: interrupting it", held.arc.name)
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
        # Like asyncio.timeout, don't swallow an additional cancellation from outside.
        left = [body.uncancel() for _ in range(self._cancelled)]
        interrupted = left[-1:] == [0] and kind is asyncio.CancelledError
        if held.completed:
            # Don't request again a hold that was released by hand.
            by_hand = arc.why is not None and arc.why.code == "released"
            self._needs_new_request = self._again and interrupted and arc.keep and not by_hand
            self._client.internals.complete(arc)
            return interrupted
        # A hold whose body was interrupted has ended for it, even if a new RCM meanwhile continues the hold.
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


_ASKED = (
    *("name", "needs", "priority", "min_runtime", "keep"),
    *("direct", "comment", "wait_for_device", "booking", "until_done"),
)


def _ask(*values: Any) -> dict[str, Any]:
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
    until_done: bool = False,
) -> Attempt:
    """Hold devices for the body of an `async with`, whose target is a `Held`.

    Entering waits for the grant. The body is cancelled when the hold ends: after its minimum runtime the `async with`
    then ends normally, with `held.completed` true; before it, the `async with` raises Revoked.

    Takes the arguments of `Client.request`, and:

    - `confirmed`: enter once all devices have confirmed the grant, instead of at the grant.
    - `direct`: the body also reaches its devices past zscout. It is entered once all devices have confirmed the grant.
      When the hold ends, `finally` and `except CancelledError` have nine tenths of the devices' `settle` to clean up,
      for which the next holder waits.
    - `timeout`: seconds to wait for the grant. Entering raises TimeoutError after that, and the request is cancelled.

    Entering also raises RequestRefused and Revoked."""
    ask = _ask(name, needs, priority, min_runtime, keep, direct, comment, wait_for_device, booking, until_done)
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
    until_done: bool = False,
    estimate: bool = False,
    continues: str = "",
) -> AsyncIterator[Attempt]:
    """Hold devices repeatedly: yield a `hold` to enter, and another whenever the hold was taken away. Ends after a body
    that ended by itself, and with `keep=False` after the minimum runtime. Takes the arguments of `hold` without
    `timeout`, and `estimate` and `continues` of `Client.request`."""
    ask = _ask(name, needs, priority, min_runtime, keep, direct, comment, wait_for_device, booking, until_done)
    ask |= {"estimate": estimate, "continues": continues}
    attempt = Attempt(client, ask, again=True, confirmed=confirmed)
    yield attempt
    while attempt.goes_on:
        yield attempt

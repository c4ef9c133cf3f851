"""Bookings from a program: devices together, from a given time on.

    async with zscout.Client.connect() as client:
        bookings = zscout.BookingsClient(client)
        at = datetime(2026, 12, 1, 14, tzinfo=ZoneInfo("Europe/Berlin"))
        booking = await bookings.book({"robot/arm1": {}, "framegrabber/*": {}}, at, 7200, name="survey")
        ...
        async with zscout.hold(client, "survey", **bookings.terms(booking)) as held:
            ...

Without asyncio: `lab.run(bookings.book(...))`, with `bookings = zscout.BookingsClient(lab.client)`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Collection
from datetime import UTC, datetime, timedelta
from decimal import Decimal
from typing import Any, Final, TypeVar
from zoneinfo import ZoneInfo

from msgspec.structs import replace

from zscout.behaviors.client.client import Client
from zscout.behaviors.client.identity import checked_comment
from zscout.behaviors.client.rcm_link import BACKOFF, TRY_AGAIN
from zscout.behaviors.client.request import Needs, RequestRefused, amounts, check_seconds
from zscout.keyexpr import RANDOM, USERS, valid_name
from zscout.mesh import Reply
from zscout.mesh.exchange import naming_versions
from zscout.messages import (
    WINDOW,
    Book,
    BookingsAsk,
    BookingsTold,
    BookingView,
    FindSlots,
    Message,
    Operation,
    Problem,
    SlotsTold,
    Unbook,
    Who,
)
from zscout.types import SECOND

ANSWER: Final = 5.0
"""Seconds of one query: a booking is stored on a second host's disk before the answer."""
TIMEOUT: Final = 15.0
"""Seconds within which some RCM answers, even if the leader changes meanwhile."""
PATIENCE: Final = 900.0
"""Default time in seconds after its date in which a booking can be taken up."""

MAX_NAMED: Final = 60
"""Most characters of a default name, to which a number may be added."""

M = TypeVar("M", bound=Message)


class RcmSilent(RequestRefused):
    """No leader answered; the operation may or may not have been carried out."""


class BookingsClient:
    """The bookings of a fleet, read and changed through `client`. `timeout`: seconds to wait for a leader's answer."""

    def __init__(self, client: Client, *, timeout: float = TIMEOUT) -> None:
        self._client, self._mesh, self._timeout = client, client.mesh, timeout

    async def list(self, *, owner: str | None = None, rc: str | None = None) -> BookingsTold:
        """Return the bookings that are not over, and the fleet's time. `owner` (a host or a person) and `rc` (a device
        that the booking may use) restrict them. Raises RequestRefused; RcmSilent if no leader answers."""
        question, silent = BookingsAsk(owner=owner, rc=rc), "did not answer; its version may not support bookings"
        return await self._ask_until_answered(
            self._mesh.keys.ask_bookings(self._mesh.me), question, BookingsTold, ANSWER, silent
        )

    async def book(
        self,
        needs: Needs,
        start: datetime,
        runtime: float | Decimal,
        *,
        name: str,
        priority: int = 0,
        patience: float | None = None,
        every: int = 0,
        until: datetime | None = None,
        maintenance: bool = False,
        urgent: bool = False,
        lasting: bool = False,
        broken: bool = False,
        comment: str = "",
    ) -> BookingView:
        """Book all of `needs` together, for `runtime` seconds from `start`. Return once a second host has stored the
        booking.

        The booking lapses `patience` seconds after its start if no request has taken it up (default: 15 min, or its
        whole time if that is shorter). A request takes it up with its `terms`.

        - `every`: repeat it after so many days, at the same local time; the zone of `start` must be a `ZoneInfo`.
        - `until`: repeat it no later than this, at most a year from now.
        - `maintenance`: keep the devices free of holders. A pattern means all devices that match it, and `@anvil` all
          devices of the host anvil, which gets no components meanwhile. Needs the rights of an operator.
        - `urgent`: maintenance also ends holds within their minimum runtimes.
        - `lasting`: maintenance until it is cancelled; `runtime` must be 60 days, and the leader extends it.
        - `broken`: lasting maintenance that ends no hold, and does not bind operators; see `report_broken`.

        Raises RequestRefused, with `code` `not_free` if a device is taken; RcmSilent if no leader answers;
        ValueError for a bad date or span of time."""
        check_seconds("runtime", runtime)
        zone = _zone(start, every)
        if patience is None:
            patience = float(runtime) if maintenance else min(PATIENCE, float(runtime))
        check_seconds("patience", patience)
        return await self.ask(
            Book(
                id=f"{RANDOM.get().getrandbits(128):032x}",
                name=name,
                needs=amounts(needs),
                priority=priority,
                start=_whole_second(start),
                runtime=Decimal(str(runtime)),
                patience=Decimal(str(patience)),
                zone=zone,
                every=every,
                until=None if until is None else _whole_second(until),
                maintenance=maintenance,
                urgent=urgent,
                lasting=lasting,
                broken=broken,
                who=self._who(comment),
            ),
            BookingView,
        )

    async def report_broken(self, rcs: Collection[str], reason: str) -> BookingView:
        """Report devices broken: they are granted to operators only, until the returned booking is cancelled. Holds
        continue. In a secured fleet operators may report any device, others only devices that they hold. If all are
        reported already, that booking is returned. Raises RequestRefused, RcmSilent; ValueError for a reason that is
        too long."""
        known = await self.list()
        for booking in known.bookings:
            if booking.broken and {*rcs} <= {*booking.needs, *booking.maintained} and not booking.unbooked:
                return booking
        return await self.book(
            {rc: {} for rc in rcs},
            datetime.fromtimestamp(int(known.time), UTC),
            WINDOW,
            name=valid_name(f"broken-{'-'.join(min(rcs).split('/'))}")[:MAX_NAMED],
            maintenance=True,
            lasting=True,
            broken=True,
            comment=reason,
        )

    async def unbook(self, booking: str, start: datetime | int | None = None) -> BookingView:
        """Cancel the booking with this id, or only its date that begins at `start` (a datetime, or Unix seconds). A
        request that has taken it up continues. Raises RequestRefused, RcmSilent."""
        at = _whole_second(start) if isinstance(start, datetime) else start
        return await self.ask(Unbook(booking, at, self._client.who), BookingView)

    async def slots(
        self,
        needs: Needs,
        runtime: float | Decimal,
        within: float,
        *,
        start: datetime | None = None,
        priority: int = 0,
        limit: int = 5,
    ) -> SlotsTold:
        """Return the first times at which all of `needs` are free together for `runtime` seconds. The search covers
        `within` seconds from `start` (default: now), and returns at most `limit` times. Raises RequestRefused,
        RcmSilent."""
        check_seconds("runtime", runtime)
        return await self.ask(
            FindSlots(
                id=f"{RANDOM.get().getrandbits(128):032x}",
                needs=amounts(needs),
                priority=priority,
                runtime=Decimal(str(runtime)),
                within=float(within),
                start=None if start is None else _whole_second(start),
                limit=limit,
                who=self._client.who,
            ),
            SlotsTold,
        )

    @staticmethod
    def terms(booking: BookingView) -> dict[str, Any]:
        """Return the arguments with which a request takes up a booking:
        `zscout.hold(client, "survey", **bookings.terms(booking))`."""
        return {
            "needs": booking.needs,
            "priority": booking.priority,
            "min_runtime": booking.runtime,
            "booking": booking.id,
        }

    async def ask(self, operation: Operation, kind: type[M]) -> M:
        """Send an operation until a leader answers; its id makes it idempotent. Raises RequestRefused, RcmSilent."""
        keys, me = self._mesh.keys, self._mesh.me
        if keys.closed and (why := self._client.fleet.access.refusal(me.host, "book", USERS)):
            raise RequestRefused(Problem("not_allowed", why))
        silent = "did not answer; the operation may or may not have been done: see zscout booking list, and try again"
        return await self._ask_until_answered(keys.schedule(me), operation, kind, self._timeout, silent)

    async def _ask_until_answered(self, key: str, question: Message, kind: type[M], within: float, silent: str) -> M:
        deadline = self._mesh.now() + round(min(within, self._timeout) * SECOND)
        pause, longest = BACKOFF
        problem: Problem | None = None
        while True:
            replies = await self._mesh.ask(key, question, kind, timeout=ANSWER, enough=_is_answer)
            for reply in replies:
                if reply.message is not None:
                    return reply.message
            problem = next((reply.problem for reply in replies), problem)
            if replies and problem is not None and problem.code not in TRY_AGAIN:
                who = "the leader" if self._client.leader is None else f"the leader at {self._client.leader}"
                named = naming_versions(replies[0], who)
                raise RequestRefused(problem if named is None or named.problem is None else named.problem)
            if self._mesh.now() > deadline:
                why = "" if problem is None else f" ({problem.message})"
                raise RcmSilent(Problem("unknown", f"the leader of fleet {self._client.fleet.name} {silent}{why}"))
            await asyncio.sleep(pause)
            pause = min(longest, pause * 2)

    def _who(self, comment: str) -> Who | None:
        who = self._client.who
        return replace(who or Who(), comment=checked_comment(comment)) if comment else who


def _is_answer(reply: Reply[Any]) -> bool:
    return reply.message is not None


def _whole_second(at: datetime) -> int:
    """Raises ValueError for a time without a zone."""
    if at.tzinfo is None:
        raise ValueError(f"{at} has no zone; write one: datetime(..., tzinfo=ZoneInfo('Europe/Berlin'))")
    return round(at.timestamp())


def _zone(start: datetime, every: int) -> str:
    """Raises ValueError if a repeated booking has no named zone."""
    if isinstance(start.tzinfo, ZoneInfo):
        return start.tzinfo.key
    if every and start.utcoffset() != timedelta(0):
        raise ValueError("a repeated booking keeps its hour in a zone; write start with a ZoneInfo('Europe/Berlin')")
    return "UTC"

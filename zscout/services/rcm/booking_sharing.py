"""The leader and all who keep bookings: what one has and another has not comes to both.

A booking is kept once another candidate has it; where there is none, once this one's disk has."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Final

from msgspec.structs import replace

from zscout.keyexpr import Keys, Role, Token
from zscout.mesh import Declaration, IncomingQuery, Lane, Mesh, Reply
from zscout.mesh.supervision import Supervisor, done_within
from zscout.messages import BookingRecord, BookingsAsk, BookingsKept, BookingsTold, ShareBookings
from zscout.rcm import steps
from zscout.rcm.authority import Authority
from zscout.services.bookings.fleet_clock import DIFFERS, SAME, agreed, wall_ns
from zscout.services.bookings.keeper import BookingKeeper
from zscout.services.bookings.records import merged
from zscout.services.rcm.bookings import Bookings, oldest
from zscout.types import SECOND, HostName, Ns, Term

log = logging.getLogger(__name__)

SHARE_EVERY: Final = 30.0
"""Seconds from one question to all keepers to the next, where nothing is new."""
AGAIN: Final = 5.0
"""The same where some host does not know the same yet."""
SOON: Final = 0.02
"""Seconds that changes are gathered before they are shared."""
TIMEOUT: Final = 2.0
LOOK: Final = 0.5
"""Seconds within which candidates that live are found."""


def credible(replies: Iterable[Reply[BookingsKept]], keys: Keys, now: Ns) -> list[BookingsKept]:
    """What keepers answered, each for its own host, with the times of `now`: some have waited for the others."""
    told = [(reply, reply.message) for reply in replies if reply.message is not None]
    own = [(now - reply.arrived, message) for reply, message in told if reply.key == keys.bookings(message.host)]
    return [_aged(message, waited / SECOND) for waited, message in own]


def _aged(one: BookingsKept, seconds: float) -> BookingsKept:
    if one.time is None:
        return replace(one, wall=one.wall + seconds)
    return replace(one, wall=one.wall + seconds, time=one.time + seconds, time_age=one.time_age + seconds)


class BookingSharing:
    """Of one term. What comes of it is given to `take`. Before the bookings are settled fleet time is what most clocks
    say, and nothing is forgotten by it."""

    def __init__(
        self,
        mesh: Mesh,
        term: Term,
        keeper: BookingKeeper,
        bookings: Bookings,
        authority: Authority,
        supervisor: Supervisor,
        take: Callable[[steps.Stimulus], None],
    ) -> None:
        self._mesh, self._term, self._keeper, self._authority = mesh, term, keeper, authority
        self._bookings, self._clock, self._supervisor, self._give = bookings, bookings.clock, supervisor, take
        self._declared: list[Declaration] = []
        self._begun = mesh.now()
        self._unshared: dict[str, BookingRecord] = {}
        self._behind = True
        """Whether some host may not have all that is known here."""
        self._not_kept: dict[str, str] = {}
        """By booking: why it is not kept, as it was told last."""
        self._news = asyncio.Event()
        self._sharing = asyncio.Lock()
        self.clocks: dict[HostName, float] = {}
        """By how many seconds the clocks of other hosts differ from fleet time, where it is too much."""

    def start(self) -> None:
        """From now on it answers, and shares what it knows."""
        keys, mesh, guard = self._mesh.keys, self._mesh, self._supervisor.guard
        self._declared = [
            *(
                mesh.serve(key, BookingsAsk, guard(self._answer), lane=Lane.QUESTION)
                for key in (keys.rcm_bookings, keys.rcm_bookings_any)
            ),
            *(mesh.watch(keys.alive_any(role), guard(self._on_token)) for role in (Role.CANDIDATE, Role.NODE)),
        ]
        self._keeper.shared.clear()
        self._supervisor.spawn(self._keep_sharing())
        self._supervisor.spawn(self._watch_others())

    def close(self) -> None:
        for declared in self._declared:
            declared.close()

    @property
    def bookings(self) -> Bookings:
        """At the present time."""
        return self._bookings.at(self._mesh.now())

    def _answer(self, query: IncomingQuery[BookingsAsk]) -> None:
        asked, bookings = query.message, self.bookings
        views = bookings.handler.views(asked.owner, asked.rc)
        query.answer(BookingsTold(bookings.dates.time, views, dict(self.clocks)))

    def _on_token(self, token: Token, alive: bool) -> None:
        if alive and token.host != self._mesh.me.host:
            self.catch_up()

    def tell(self, records: Iterable[BookingRecord]) -> None:
        """These are not as they were: shared soon."""
        if changed := {record.id: record for record in records}:
            self._unshared |= changed
            self._news.set()

    def catch_up(self) -> None:
        """A host has come that may know less, or more."""
        self._behind = True
        self._news.set()

    async def keep(self, record: BookingRecord) -> str:
        """Returns once this is kept: empty, or why it is not."""
        self._unshared[record.id] = record
        async with self._sharing:
            if record.id in self._unshared:
                await self._share()
            return self._not_kept.get(record.id, "")

    async def _watch_others(self) -> None:
        """One that led elsewhere shares its bookings before it steps down."""
        while True:
            await self._keeper.shared.wait()
            self._keeper.shared.clear()
            self.catch_up()
            self._give(steps.Shared(news=True))

    async def _keep_sharing(self) -> None:
        while True:
            if await done_within(AGAIN if self._behind else SHARE_EVERY, self._news.wait()):
                await asyncio.sleep(SOON)
            self._news.clear()
            async with self._sharing:
                why = await self._share()
            self._give(steps.Shared(news=False))
            if why:
                log.warning("bookings are kept by this host alone: %s", why)

    async def _share(self) -> str:
        """Tells all keepers, and hears what they know. Returns why what was told is not kept; empty: it is."""
        keeper, mesh = self._keeper, self._mesh
        sent, self._unshared = self._unshared, {}
        time = self._clock.at(mesh.now()) / SECOND if self.bookings.settled else None
        if time is not None:
            # All forget by the time of one question: else what one has forgotten came back from another.
            keeper.records.forget_old(time)
        records = list(keeper.records) if self._behind else list(sent.values())
        question = ShareBookings(self._term, keeper.records.digest(), records, time)
        saved, replies = await asyncio.gather(
            keeper.save(), mesh.ask(mesh.keys.bookings_any, question, BookingsKept, timeout=TIMEOUT)
        )
        answers, me, why = self._take(replies, question), mesh.me.host, ""
        if sent and not any(one.candidate and one.host != me and _keeps(one, question, sent) for one in answers):
            living = await mesh.living(mesh.keys.alive_any(Role.CANDIDATE), timeout=LOOK)
            if others := sorted({token.host for token in living} - {me}):
                why = f"{', '.join(others[:3])} may lead as well, and did not take it"
            elif not saved:
                why = "no other host may lead, and this one has no disk for it: is its `state` a folder to write to?"
        for booking in sent:
            self._not_kept.pop(booking, None)
        self._not_kept |= dict.fromkeys(sent, why) if why else {}
        return why

    def _take(self, replies: Collection[Reply[BookingsKept]], question: ShareBookings) -> list[BookingsKept]:
        """What keepers answered."""
        now = self._mesh.now()
        heard = credible(replies, self._mesh.keys, now)
        answers = [one for one in heard if self._authority.may_lead(one.host)]
        changed = self._keeper.records.take(record for one in answers for record in one.records)
        known = {record.id: record for record in self._keeper.records}
        latest = replace(question, digest=self._keeper.records.digest())
        # One that is not believed may have more, which changes nothing here.
        self._behind = any(
            reply.message is None
            or (
                reply.message.digest != latest.digest
                if reply.message in answers
                else not _keeps(reply.message, latest, known)
            )
            for reply in replies
        )
        if changed:
            self._give(steps.Shared(news=True))
            self._news.set()
        walls = {one.host: one.wall for one in answers} | {self._mesh.me.host: self._keeper.wall()}
        found, age = oldest(answers), (now - self._clock.since) / SECOND
        if found is not None and found[0] > age + SAME and abs(found[1] - self._clock.at(now)) > DIFFERS * SECOND:
            # This reign began where nobody knew the time of the others.
            self._clock.since = now - round(found[0] * SECOND)
            self._clock.step(found[1], now)
        elif self.bookings.settled or age > (now - self._begun) / SECOND + SAME:
            self._clock.aim(agreed(map(wall_ns, walls.values()), self._clock.at(now)), now)
        else:
            self._clock.step(agreed(map(wall_ns, walls.values())), now)
        time = self._clock.at(now) / SECOND
        walls |= {one.host: one.wall for one in heard}
        self.clocks = {host: wall - time for host, wall in walls.items() if abs(wall - time) > DIFFERS}
        return answers


def _keeps(one: BookingsKept, question: ShareBookings, sent: Mapping[str, BookingRecord]) -> bool:
    """Whether that host knows all that it was `sent`: there may be no room for it."""
    if one.digest == question.digest:
        return True
    known = {record.id: record for record in one.records}
    return all(id_ in known and merged(known[id_], record) == known[id_] for id_, record in sent.items())

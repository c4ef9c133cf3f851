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
from zscout.messages import BookingRecord, BookingsAsk, BookingsKept, BookingsTold, Correction, ShareBookings
from zscout.rcm import steps
from zscout.rcm.authority import Authority
from zscout.services.bookings.dates import DAY
from zscout.services.bookings.fleet_clock import DIFFERS, wall_ns
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
PROMPT: Final[Ns] = SECOND
"""The clock of a host counts as it is read within this time: if it took longer, the answer may have waited."""
LOOK_AT_CLOCK: Final = 1.0
"""Seconds from one look at the own clock to the next: if it was set, all are asked what theirs say."""
STEADY: Final[Ns] = 600 * SECOND
"""Bookings are forgotten by a fleet time that was not set for so long: it may be days ahead."""
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
    """Of one term. What comes of it is given to `take`: records, fleet times and clocks of hosts."""

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
        self._bookings, self._supervisor, self._give = bookings, supervisor, take
        self._declared: list[Declaration] = []
        self._unshared: dict[str, BookingRecord] = {}
        self._behind = True
        """Whether some host may not have all that is known here."""
        self._not_kept: dict[str, str] = {}
        """By booking: why it is not kept, as it was told last."""
        self._news = asyncio.Event()
        self._sharing = asyncio.Lock()
        self._ahead: dict[HostName, Ns] = {}
        """By how much hosts' clocks are ahead of the own monotonic one, as they were read last."""

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
        self._supervisor.spawn(self._watch_clock())

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
        query.answer(BookingsTold(bookings.dates.time, views, self._clocks(), self._corrected()))

    def _corrected(self) -> Correction | None:
        by, at = self._bookings.clock.corrected or (0, 0)
        ago = (self._mesh.now() - at) / SECOND
        return Correction(by / SECOND, ago) if by and ago < DAY else None

    def _clocks(self) -> dict[HostName, float]:
        """By how many seconds hosts' clocks differ from fleet time, where it is too much."""
        fleet = self._bookings.dates.to_fleet(0)
        differ = {host: (ahead - fleet) / SECOND for host, ahead in self._ahead.items()}
        return {host: seconds for host, seconds in differ.items() if abs(seconds) > DIFFERS}

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
            self._give(steps.Shared())

    async def _watch_clock(self) -> None:
        ahead: Ns | None = None
        while True:
            before, ahead = ahead, wall_ns(self._keeper.wall()) - self._mesh.now()
            if before is not None and abs(ahead - before) > DIFFERS * SECOND:
                self._news.set()
            await asyncio.sleep(LOOK_AT_CLOCK)

    async def _keep_sharing(self) -> None:
        while True:
            if await done_within(AGAIN if self._behind else SHARE_EVERY, self._news.wait()):
                await asyncio.sleep(SOON)
            self._news.clear()
            async with self._sharing:
                why = await self._share()
            if why:
                log.warning("bookings are kept by this host alone: %s", why)

    async def _share(self) -> str:
        """Tells all keepers, and hears what they know. Returns why what was told is not kept; empty: it is."""
        keeper, mesh = self._keeper, self._mesh
        sent, self._unshared = self._unshared, {}
        asked = mesh.now()
        time = self.bookings.time if asked - self._bookings.clock.set_at >= STEADY else None
        if time is not None:
            # All forget by the time of one question: else what one has forgotten came back from another.
            keeper.records.forget_old(time)
        records = list(keeper.records) if self._behind else list(sent.values())
        question = ShareBookings(self._term, keeper.records.digest(), records, time)
        saved, replies = await asyncio.gather(
            keeper.save(), mesh.ask(mesh.keys.bookings_any, question, BookingsKept, timeout=TIMEOUT)
        )
        answers, me, why = self._take(replies, question, asked), mesh.me.host, ""
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

    def _take(self, replies: Collection[Reply[BookingsKept]], question: ShareBookings, asked: Ns) -> list[BookingsKept]:
        """What keepers answered to what they were `asked` then."""
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
            self._give(steps.Shared())
            self._news.set()
        prompt = credible((reply for reply in replies if reply.arrived - asked <= PROMPT), self._mesh.keys, now)
        hosts = {one.host: one for one in (*prompt, self._keeper.told("", durable=False))}
        walls = {host: wall_ns(one.wall) for host, one in hosts.items()}
        self._ahead = {host: wall - now for host, wall in walls.items()}
        believed = {*(one.host for one in answers), self._mesh.me.host}
        mine = {host: wall for host, wall in walls.items() if host in believed}
        kept = frozenset(host for host in mine if hosts[host].synchronised)
        self._give(steps.ClocksRead(now, oldest(answers), mine, kept))
        return answers


def _keeps(one: BookingsKept, question: ShareBookings, sent: Mapping[str, BookingRecord]) -> bool:
    """Whether that host knows all that it was `sent`: there may be no room for it."""
    if one.digest == question.digest:
        return True
    known = {record.id: record for record in one.records}
    return all(id_ in known and merged(known[id_], record) == known[id_] for id_, record in sent.items())

"""Exchanges booking records between the leader and all keepers, until all have the same.

A booking is kept once another candidate has stored it; without other candidates, once this host's disk has it."""

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

SHARE_PERIOD_S: Final = 30.0
"""Seconds between questions to all keepers while nothing changes."""
SHARE_AGAIN_S: Final = 5.0
"""Seconds between questions while some host differs."""
GATHER_S: Final = 0.02
"""Seconds for which changes are gathered before they are shared."""
TIMEOUT_S: Final = 2.0
PROMPT: Final[Ns] = SECOND
"""Only answers within this time are readings of a host's clock: later ones may have waited in a queue."""
CLOCK_PERIOD_S: Final = 1.0
"""Seconds between checks of the own clock: if it was set, all hosts are asked for theirs."""
STEADY: Final[Ns] = 600 * SECOND
"""Records are forgotten only if fleet time was not set for this long, as it may be days ahead at first."""
FIND_CANDIDATES_S: Final = 0.5
"""Seconds for finding the tokens of other candidates."""


def credible(replies: Iterable[Reply[BookingsKept]], keys: Keys, now: Ns) -> list[BookingsKept]:
    """The answers that keepers gave for their own hosts, with all times brought forward to `now`."""
    answers = [(reply, reply.message) for reply in replies if reply.message is not None]
    own = [(now - reply.arrived, message) for reply, message in answers if reply.key == keys.bookings(message.host)]
    return [_aged(message, waited / SECOND) for waited, message in own]


def _aged(answer: BookingsKept, seconds: float) -> BookingsKept:
    if answer.time is None:
        return replace(answer, wall=answer.wall + seconds)
    return replace(answer, wall=answer.wall + seconds, time=answer.time + seconds, time_age=answer.time_age + seconds)


class BookingSharing:
    """The exchange in one term. `take` receives the stimuli: new records, fleet times and clocks of hosts."""

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
        self._bookings, self._supervisor, self._on_stimulus = bookings, supervisor, take
        self._declared: list[Declaration] = []
        self._unshared: dict[str, BookingRecord] = {}
        self._behind = True
        """True while some host may lack records that are known here."""
        self._not_kept: dict[str, str] = {}
        """By booking: the reason that the last exchange did not get it kept."""
        self._news = asyncio.Event()
        self._sharing = asyncio.Lock()
        self._ahead: dict[HostName, Ns] = {}
        """By host: its clock less the own monotonic clock, at the last reading."""

    def start(self) -> None:
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
        """The bookings, set to the present time."""
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
        """By host: seconds by which its clock differs from fleet time, if that is too much."""
        fleet = self._bookings.dates.to_fleet(0)
        differ = {host: (ahead - fleet) / SECOND for host, ahead in self._ahead.items()}
        return {host: seconds for host, seconds in differ.items() if abs(seconds) > DIFFERS}

    def _on_token(self, token: Token, alive: bool) -> None:
        if alive and token.host != self._mesh.me.host:
            self.catch_up()

    def share_soon(self, records: Iterable[BookingRecord]) -> None:
        if changed := {record.id: record for record in records}:
            self._unshared |= changed
            self._news.set()

    def catch_up(self) -> None:
        """Exchange all records soon: a host has appeared that may have fewer, or more."""
        self._behind = True
        self._news.set()

    async def keep(self, record: BookingRecord) -> str:
        """Get a record kept. Return the reason if that fails; empty: it is kept."""
        self._unshared[record.id] = record
        async with self._sharing:
            if record.id in self._unshared:
                await self._share()
            return self._not_kept.get(record.id, "")

    async def _watch_others(self) -> None:
        """Take over the records that another leader shared before it stepped down."""
        while True:
            await self._keeper.shared.wait()
            self._keeper.shared.clear()
            self.catch_up()
            self._on_stimulus(steps.Shared())

    async def _watch_clock(self) -> None:
        ahead: Ns | None = None
        while True:
            before, ahead = ahead, wall_ns(self._keeper.wall()) - self._mesh.now()
            if before is not None and abs(ahead - before) > DIFFERS * SECOND:
                self._news.set()
            await asyncio.sleep(CLOCK_PERIOD_S)

    async def _keep_sharing(self) -> None:
        while True:
            if await done_within(SHARE_AGAIN_S if self._behind else SHARE_PERIOD_S, self._news.wait()):
                await asyncio.sleep(GATHER_S)
            self._news.clear()
            async with self._sharing:
                why = await self._share()
            if why:
                log.warning("bookings are kept by this host alone: %s", why)

    async def _share(self) -> str:
        """Exchange records with all keepers. Return the reason if the changed records are not kept; else empty."""
        keeper, mesh = self._keeper, self._mesh
        sent, self._unshared = self._unshared, {}
        asked = mesh.now()
        time = self.bookings.time if asked - self._bookings.clock.set_at >= STEADY else None
        if time is not None:
            # All keepers forget by the time in this question, so that no record returns from a keeper.
            keeper.records.forget_old(time)
        records = list(keeper.records) if self._behind else list(sent.values())
        question = ShareBookings(self._term, keeper.records.digest(), records, time)
        saved, replies = await asyncio.gather(
            keeper.save(), mesh.ask(mesh.keys.bookings_any, question, BookingsKept, timeout=TIMEOUT_S)
        )
        answers, me, why = self._take(replies, question, asked), mesh.me.host, ""
        if sent and not any(
            other.candidate and other.host != me and _keeps(other, question, sent) for other in answers
        ):
            living = await mesh.living(mesh.keys.alive_any(Role.CANDIDATE), timeout=FIND_CANDIDATES_S)
            if others := sorted({token.host for token in living} - {me}):
                why = f"{', '.join(others[:3])} may lead as well, and did not store it"
            elif not saved:
                why = "no other host may lead, and this host can't write it; make its `state` a writable folder"
        for booking in sent:
            self._not_kept.pop(booking, None)
        self._not_kept |= dict.fromkeys(sent, why) if why else {}
        return why

    def _take(self, replies: Collection[Reply[BookingsKept]], question: ShareBookings, asked: Ns) -> list[BookingsKept]:
        """Take over the answers to a question that was `asked` at that time. Return those of hosts that may lead."""
        now = self._mesh.now()
        heard = credible(replies, self._mesh.keys, now)
        answers = [answer for answer in heard if self._authority.may_lead(answer.host)]
        changed = self._keeper.records.take(record for answer in answers for record in answer.records)
        known = {record.id: record for record in self._keeper.records}
        latest = replace(question, digest=self._keeper.records.digest())
        # Further records of a host that is not believed change nothing here.
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
            self._on_stimulus(steps.Shared())
            self._news.set()
        prompt = credible((reply for reply in replies if reply.arrived - asked <= PROMPT), self._mesh.keys, now)
        hosts = {answer.host: answer for answer in (*prompt, self._keeper.answer_to("", durable=False))}
        walls = {host: wall_ns(answer.wall) for host, answer in hosts.items()}
        self._ahead = {host: wall - now for host, wall in walls.items()}
        believed = {*(answer.host for answer in answers), self._mesh.me.host}
        believed_walls = {host: wall for host, wall in walls.items() if host in believed}
        kept = frozenset(host for host in believed_walls if hosts[host].synchronised)
        self._on_stimulus(steps.ClocksRead(now, oldest(answers), believed_walls, kept))
        return answers


def _keeps(answer: BookingsKept, question: ShareBookings, sent: Mapping[str, BookingRecord]) -> bool:
    """Return True if that host has all records that it was `sent`: it may have no room for them."""
    if answer.digest == question.digest:
        return True
    known = {record.id: record for record in answer.records}
    return all(id_ in known and merged(known[id_], record) == known[id_] for id_, record in sent.items())

"""Bookings in one term: fleet time, the dates in the core, who keeps them, and who asks."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from typing import Final, NamedTuple

from zscout.config.fleet import Fleet
from zscout.keyexpr import Role, Sender, Token
from zscout.mesh import Declaration, Lane, Mesh
from zscout.mesh.supervision import Supervisor
from zscout.messages import Amounts, Ask, BookingRecord, BookingsAsk, BookingsKept, Instant, ProposedHolder, decimals
from zscout.rcm.admission import Admission
from zscout.scheduling.booking import BookingConflict, BookingThreatened, Dates
from zscout.scheduling.core import Core
from zscout.scheduling.model import ArcRequest, Effect, Event, Propose, Vote, VoteOverdue
from zscout.scheduling.runtimes import RuntimeEstimator
from zscout.services.bookings.fleet_clock import FleetClock, agreed, wall_ns
from zscout.services.bookings.keeper import BookingKeeper
from zscout.services.rcm.booked_dates import BookedDates, Date
from zscout.services.rcm.booking_handler import BookingHandler
from zscout.services.rcm.booking_sharing import BookingSharing, oldest
from zscout.types import SECOND, ArcId, Ns, Params, Term

log = logging.getLogger(__name__)

SLACK: Final = 0.01
"""Seconds: timers may be a little early."""
BALLOTS: Final = 0.002
"""Seconds for which ballots on a booking are gathered: one for each of its dates."""
GATHERS: Final = 1.0
"""Seconds for which bookings are gathered before it is found out when there is one more date of them to keep."""
LASTS: Final = 3.0
"""Seconds that a danger is waited for to pass: after a change of leader RCs come one after the other."""


class BookedDanger(NamedTuple):
    """That a date of a booking may not be kept, and why; empty: it is safe again."""

    record: BookingRecord
    start: Instant
    why: str
    later: int = 0
    """Dates after that of which the same is to be told."""


class Bookings:
    """`kept`: what keepers answered as the lead was taken. `emit` takes events of one instant, `propose` sends a
    proposal, `check_door` raises Refused for needs that can never be met."""

    def __init__(
        self,
        mesh: Mesh,
        fleet: Fleet,
        term: Term,
        core: Core,
        keeper: BookingKeeper,
        kept: Sequence[BookingsKept],
        admission: Admission,
        supervisor: Supervisor,
        emit: Callable[..., None],
        propose: Callable[[Propose], None],
        check_door: Callable[[Mapping[str, Amounts]], None],
        runtimes: RuntimeEstimator | None,
        on_danger: Callable[[BookedDanger], object],
    ) -> None:
        """`on_danger` is called with dangers that last."""
        self._mesh, self._supervisor, self._keeper = mesh, supervisor, keeper
        now, self._known = mesh.now(), _is_known(keeper, kept, fleet)
        self.settles_at: Ns = now + round(fleet.mesh.lease * SECOND)
        """When the dates of the fleet count as known though nobody has told more of them."""
        time, age = _time(keeper, kept)
        self.clock = FleetClock(time, now, now - round(age * SECOND))
        keeper.records.take(record for one in kept for record in one.records)

        def vote(proposals: Iterable[Propose]) -> None:
            for proposal in proposals:
                propose(proposal)

        self._sharing = BookingSharing(
            mesh,
            term,
            keeper,
            self.clock,
            admission.authority,
            supervisor,
            self._on_news,
            self._redate,
            lambda: self.settled,
        )
        self.dates = BookedDates(core, keeper.records, self.clock, mesh.now, emit, vote, self._sharing.tell)
        self.handler = BookingHandler(
            fleet,
            core,
            keeper,
            self.dates,
            self._sharing,
            admission,
            supervisor,
            emit,
            check_door,
            lambda: self.settled,
            runtimes,
        )
        self._reconciling = self._trying = False
        self._another: asyncio.TimerHandle | None = None
        """What is repeated has one more date within 60 days then."""
        self._booked = False
        """Since that was found."""
        self._told: dict[str, str] = {}
        """Dangers that were told, by date."""
        self._telling = False
        self._on_danger = on_danger
        self._declared: list[Declaration] = []

    @property
    def settled(self) -> bool:
        """Whether the dates of the fleet are known: after a restart of all its hosts, each knows its own only."""
        return self._known or self._mesh.now() >= self.settles_at

    @property
    def time(self) -> float | None:
        """Fleet time, in seconds since 1970 (UTC), as others may go by it; None: it is not settled."""
        return self.dates.time if self.settled else None

    @property
    def age(self) -> float:
        """For how many seconds that time has gone on."""
        return (self._mesh.now() - self.clock.since) / SECOND

    def take_up(self, ask: Ask, sender: Sender) -> str:
        return self.handler.take_up(ask, sender)

    def dated(self, request: ArcRequest) -> ArcRequest:
        return self.dates.dated(request)

    def record(self, booking: str) -> BookingRecord | None:
        return self._keeper.records.get(booking)

    def recovered(self, taken: Collection[str]) -> list[Event]:
        """The events by which the core knows of all dates; `taken`: those that ARCs have taken up."""
        return [self.dates.recovered(taken)]

    async def enter(self, core: Core) -> None:
        """Has the core know of dates, in parts between which others run, before it begins to lead."""
        for part in self.dates.parts():
            core.handle(self._mesh.now(), part)
            await asyncio.sleep(0)

    def start(self) -> None:
        """From now on it answers, and shares what it knows."""
        keys, mesh, guard = self._mesh.keys, self._mesh, self._supervisor.guard
        self._declared = [
            *(
                mesh.serve(key, BookingsAsk, guard(self.handler.answer_bookings), lane=Lane.QUESTION)
                for key in (keys.rcm_bookings, keys.rcm_bookings_any)
            ),
            *(mesh.watch(keys.alive_any(role), guard(self._on_token)) for role in (Role.CANDIDATE, Role.NODE)),
        ]
        self._keeper.on_shared = self._on_shared
        self._sharing.start()
        self._on_news()
        if not self.settled:
            self._supervisor.call_later((self.settles_at - mesh.now()) / SECOND + SLACK, self._on_news)

    def close(self) -> None:
        self._keeper.on_shared = lambda: None
        for declared in self._declared:
            declared.close()
        self.handler.close()

    def note(self, events: Collection[Event], effects: Collection[Effect]) -> None:
        """What has happened in an instant: what follows of it follows in another one."""
        if self.dates.note(effects, settled=self.settled):
            self._on_news()
        if any(isinstance(effect, (BookingThreatened, BookingConflict)) for effect in effects):
            self._tell_soon()
        if not self._booked and any(isinstance(event, Dates) for event in events):
            self._booked = True
            self._supervisor.call_later(GATHERS, self._await_another)
        voted = any(isinstance(event, (Vote, VoteOverdue)) for event in events)
        if voted and self.handler.waits_for_votes and not self._trying:
            self._trying = True
            self._supervisor.call_later(BALLOTS, self._try_again)

    def _try_again(self) -> None:
        self._trying = False
        self.handler.try_again()

    def proposed(self, name: ArcId, params: Params) -> ProposedHolder:
        """A booking as an RC is asked about it."""
        record = self._keeper.records.get(name.partition("@")[0])
        label, owner = (name, "") if record is None else (record.name, record.owner)
        return ProposedHolder(name, label, f"{owner or 'nobody'}/booking", decimals(params))

    def _on_news(self) -> None:
        if not self._reconciling:
            self._reconciling = True
            self._supervisor.call_later(0, self._reconcile)

    def _on_shared(self) -> None:
        """One that led elsewhere has told of its bookings before it stepped down."""
        self._sharing.catch_up()
        self._on_news()

    def _redate(self) -> None:
        if self.dates.redate():
            self._on_news()

    def _reconcile(self) -> None:
        self._reconciling = False
        self.dates.reconcile()
        self._tell_soon()
        self._await_another()

    def _await_another(self) -> None:
        """What is repeated is to have its dates in time."""
        if self._another is not None:
            self._another.cancel()
        until, self._booked = self.dates.until_another(), False
        delay = max(0.0, until) + SLACK
        self._another = self._supervisor.call_later(delay, self._on_news) if math.isfinite(until) else None

    def _tell_soon(self) -> None:
        if not self._telling and self.dates.dangers() != self._told:
            self._telling = True
            self._supervisor.call_later(LASTS, self._tell)

    def _tell(self) -> None:
        """Tells what is not as it was told last, and has been so for a while: the next dates first, as there are bounds
        to what people are told, and once of all dates of a booking."""
        self._telling = False
        before, self._told = self._told, self.dates.dangers()
        news = dict[tuple[str, str], list[Date]]()
        for name in before.keys() | self._told.keys():
            why, date = self._told.get(name, ""), self.dates.date(name)
            if why != before.get(name, "") and date is not None:
                news.setdefault((date.record.id, why), []).append(date)
        found = [
            BookedDanger(*min(dates, key=lambda date: date.start), why, len(dates) - 1)
            for (_, why), dates in news.items()
        ]
        for danger in sorted(found, key=lambda one: (one.start, one.record.id, one.why)):
            words = f"is in danger: {danger.why}" if danger.why else "is safe again"
            log.warning("booking %s of %s %s", danger.record.name, danger.record.owner, words)
            self._on_danger(danger)

    def _on_token(self, token: Token, alive: bool) -> None:
        if alive and token.host != self._mesh.me.host:
            self._sharing.catch_up()


def _time(keeper: BookingKeeper, kept: Sequence[BookingsKept]) -> tuple[Ns, float]:
    """Fleet time, and for how many seconds it has gone on: the oldest that was heard, here or elsewhere. Where nobody
    has heard any it is found out now: the median of the clocks."""
    found = oldest([*kept, keeper.told("", durable=False)])
    if found is not None:
        return found[1], found[0]
    walls = {one.host: one.wall for one in kept} | {keeper.mesh.me.host: keeper.wall()}
    return agreed(map(wall_ns, walls.values())), 0.0


def _is_known(keeper: BookingKeeper, kept: Sequence[BookingsKept], fleet: Fleet) -> bool:
    if keeper.time is not None or any(one.time is not None for one in kept):
        return True
    answered = {keeper.mesh.me.host, *(one.host for one in kept)} & {*fleet.candidates}
    return 2 * len(answered) > len(fleet.candidates) > 0

"""Operations on bookings: what people and programs book, give up, and look for; and who takes a booking up."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from decimal import Decimal
from typing import Final, TypeAlias

from zscout.config.fleet import Fleet
from zscout.keyexpr import BadName, Sender, check_name, is_pattern, matcher
from zscout.mesh import IncomingQuery, Refused
from zscout.mesh.supervision import Supervisor
from zscout.messages import (
    MAX_AHEAD,
    MAX_BOOKINGS,
    MAX_KEPT,
    WINDOW,
    Amounts,
    Ask,
    Book,
    BookingRecord,
    BookingsAsk,
    BookingsTold,
    BookingView,
    FindSlots,
    Operation,
    SlotsTold,
    SlotView,
    Unbook,
    duration,
    exact_amounts,
)
from zscout.rcm.admission import Admission
from zscout.scheduling.booking import Booking
from zscout.scheduling.core import Core
from zscout.scheduling.model import Tick
from zscout.scheduling.runtimes import RuntimeEstimator
from zscout.services.bookings.dates import DAY, dates, told, zone_of
from zscout.services.bookings.keeper import BookingKeeper
from zscout.services.rcm.booked_dates import MAX_CLAIMS, BookedDates, Date, start_of
from zscout.services.rcm.booking_sharing import BookingSharing
from zscout.types import SECOND, Ns

log = logging.getLogger(__name__)

Query: TypeAlias = IncomingQuery[Operation]

MAX_UNDECIDED: Final = 64
"""Operations that wait for votes, or for a keeper, at one time."""
DECIDE_WITHIN: Final = 1.5
"""Seconds: an RC that does not vote is asked again meanwhile."""
NAMED: Final = 3
"""Of what is in the way, so many are named."""


@dataclass(slots=True, eq=False)
class _Undecided:
    """An operation whose votes are not all known yet."""

    query: Query
    decide: Callable[[], bool]
    """Tries; whether it is decided."""
    until: Ns = 0


class BookingHandler:
    """`check_door` raises Refused for what can never start; `settled` says whether the dates of the fleet are known."""

    def __init__(
        self,
        fleet: Fleet,
        core: Core,
        keeper: BookingKeeper,
        dates_: BookedDates,
        sharing: BookingSharing,
        admission: Admission,
        supervisor: Supervisor,
        emit: Callable[..., None],
        check_door: Callable[[Mapping[str, Amounts]], None],
        settled: Callable[[], bool],
        runtimes: RuntimeEstimator | None,
    ) -> None:
        self._fleet, self._core, self._keeper, self._dates, self._sharing = fleet, core, keeper, dates_, sharing
        self._admission, self._supervisor, self._emit, self._check_door = admission, supervisor, emit, check_door
        self._settled = settled
        self._now, self._keys = keeper.mesh.now, keeper.mesh.keys
        self._runtimes = runtimes
        """What is known of how long holds last, for hints."""
        self._undecided: list[_Undecided] = []
        self._keeping = 0

    def close(self) -> None:
        for one in self._undecided:
            one.query.refuse(Refused("not_leading", "this manager stopped leading; try again").problem)

    def on_operation(self, query: Query) -> None:
        if self._fleet.strategy != "adaptive":
            words = f'strategy "{self._fleet.strategy}" has no bookings; set strategy = "adaptive" under [fleet]'
            raise Refused("wrong_strategy", words)
        if not self._settled():
            raise Refused("busy", "the whole fleet restarted and its bookings are not known yet; try again")
        sender = self._keys.sender_of(query.key)
        match query.message:
            case Book():
                self._book(query, query.message, sender)
            case Unbook():
                self._unbook(query, query.message, sender)
            case FindSlots():
                self._find_slots(query, query.message, sender)

    # Booking

    def _book(self, query: Query, wanted: Book, sender: Sender) -> None:
        known = self._keeper.records.get(wanted.id)
        if known is not None:
            self._admission.check_owner(sender, known, "ask for it")
            self._answer_kept(query, known)
            return
        self._admission.check_booking(wanted, sender)
        record = self._record(wanted, sender)
        self._check_room(record)
        self._check_door(wanted.needs)
        self._try(_Undecided(query, lambda: self._decide(query, record)))

    def _record(self, wanted: Book, sender: Sender) -> BookingRecord:
        """Raises Refused for what is no booking."""
        time = self._dates.time
        try:
            check_name(wanted.name, "name of the booking")
            zone_of(wanted.zone)
            runtime, patience = duration(wanted.runtime, "runtime"), duration(wanted.patience, "patience")
            if wanted.maintenance and any(map(is_pattern, wanted.needs)):
                raise ValueError("name each device for maintenance; patterns are not allowed")
        except (BadName, ValueError) as error:
            raise Refused("bad_request", str(error)) from None
        self._check_length(wanted.runtime)
        over = wanted.start + min(patience, runtime) / SECOND
        if over <= time:
            date, now = told(wanted.start, wanted.zone), told(time, wanted.zone)
            raise Refused("bad_date", f"{date} is in the past; by the fleet's clock it is {now}")
        last = wanted.until if wanted.every and wanted.until is not None else wanted.start
        if max(last, wanted.start) > time + MAX_AHEAD:
            raise Refused("bad_date", "a booking can't be more than a year ahead; ask for an earlier date")
        if wanted.every and wanted.until is None:
            raise Refused("bad_date", "a repeated booking needs an end; give until")
        if wanted.every and last < wanted.start:
            raise Refused("bad_date", "until is before the first date; give a later one")
        if wanted.every and runtime > (wanted.every * DAY - 3_600) * SECOND:
            raise Refused("bad_date", "each date would overlap the next; make it shorter, or less often")
        made = self._dates.number()
        fields = {name: getattr(wanted, name) for name in Book.__struct_fields__}
        fields["who"] = self._admission.authority.known_as(sender, wanted.who)
        if wanted.maintenance:
            fields["priority"] = max(wanted.priority, self._fleet.operator_priority)
        return BookingRecord(**fields, owner=sender.host, since=int(time), made=made, changed=made)

    def _check_length(self, runtime: Decimal) -> None:
        if runtime > MAX_AHEAD:
            raise Refused("bad_date", "a booking can't be longer than a year; ask for less")

    def _check_room(self, record: BookingRecord) -> None:
        records, owner = self._keeper.records, record.owner
        most = self._fleet.limits.max_bookings_per_host
        if sum(one.owner == owner and not one.unbooked for one in records) >= most:
            raise Refused("too_many", f"{owner} has {most} bookings, the most allowed; cancel one")
        if len(records) >= MAX_BOOKINGS or records.size >= MAX_KEPT:
            raise Refused("too_many", f"this fleet already has {len(records)} bookings; cancel some")
        if len(self._core.bookings()) + len(self._dates.open_dates(record)) > MAX_CLAIMS:
            raise Refused("too_many", f"{MAX_CLAIMS} dates are booked, the most allowed; repeat it less often")

    def _decide(self, query: Query, record: BookingRecord) -> bool:
        """Whether it is decided: all its dates that are kept free from now on are free, or one is not."""
        unknown, bound = [], dict[int, dict[str, str]]()
        self._emit(Tick())
        # Maintenance goes before what is booked: who is in its way is told.
        for date in [] if record.maintenance else self._dates.open_dates(record):
            claim = self._dates.claim(date)
            found = self._core.slots(claim, claim.start, 1)
            if found.unknown:
                unknown.append((claim, found.unknown))
            elif not found.found:
                query.refuse(Refused("not_free", self._in_the_way(date, claim)).problem)
                return True
            elif found.found[0].bound:
                bound[date.start] = dict(found.found[0].bound)
        if unknown:
            for claim, votes in unknown:
                self._dates.ask(votes, claim)
            return False
        self._dates.change(record, kept=bound)
        self._dates.reconcile()
        when = told(record.start, record.zone)
        log.info("%s books %s: %s at %s", record.owner, record.name, ", ".join(record.needs), when)
        self._answer_kept(query, record, withdraw=True)
        return True

    def _in_the_way(self, date: Date, claim: Booking) -> str:
        """Why a date can't be booked, in words."""
        others = [
            one
            for one, _ in self._core.bookings()
            if one.start < claim.end and claim.start < one.end and _share(one, claim)
        ]
        names = [f"{one.label or one.id} of {one.owner} ({', '.join(one.needs)})" for one in others[:NAMED]]
        more = f" and {len(others) - NAMED} more" if len(others) > NAMED else ""
        why = f"booked then: {'; '.join(names)}{more}" if names else "held, in maintenance or promised to who waits"
        return f"not all of {', '.join(date.record.needs)} are free at {told(date.start, date.record.zone)}: {why}"

    def _answer_kept(self, query: Query, record: BookingRecord, *, withdraw: bool = False) -> None:
        """Answers once it is kept; `withdraw`: forgets it where it can't be."""
        if self._keeping >= MAX_UNDECIDED:
            raise Refused("busy", f"{MAX_UNDECIDED} bookings are already being stored; try again")
        self._keeping += 1
        self._supervisor.spawn(self._keep(query, record.id, withdraw=withdraw))

    async def _keep(self, query: Query, booking: str, *, withdraw: bool) -> None:
        try:
            record = self._keeper.records.get(booking)
            why = await self._sharing.keep(record) if record is not None else "it is over"
        finally:
            self._keeping -= 1
        record = self._keeper.records.get(booking)
        if record is None or why:
            if record is not None and withdraw:
                # Not given up, which is final: another leader may have made it as well, or may have heard of it.
                self._keeper.records.remove(booking)
                self._dates.reconcile()
            query.refuse(Refused("not_kept", f"no other host stored this booking: {why}").problem)
            return
        query.answer(self._dates.view(record))

    # Giving up

    def _unbook(self, query: Query, operation: Unbook, sender: Sender) -> None:
        record = self._keeper.records.get(operation.id)
        if record is None:
            raise Refused("unknown_booking", f"there is no booking {operation.id}; see zscout booking list")
        self._admission.check_owner(sender, record, "unbook it")
        if operation.start is None:
            new = record if record.unbooked else self._dates.change(record, unbooked=True)
        elif operation.start in record.dropped:
            new = record
        elif operation.start in dates(record, operation.start, operation.start + 1):
            new = self._dates.change(record, dropped=sorted({*record.dropped, operation.start}))
        else:
            date = told(operation.start, record.zone)
            raise Refused("bad_date", f"{date} is not a date of {record.name}; see zscout booking list")
        self._dates.reconcile()
        self._answer_kept(query, new)

    # Looking for a time

    def _find_slots(self, query: Query, asked: FindSlots, sender: Sender) -> None:
        self._admission.check_booking(asked, sender)
        needs = {need: exact_amounts(params) for need, params in asked.needs.items()}
        runtime = duration(asked.runtime, "runtime")
        self._check_length(asked.runtime)
        self._check_door(asked.needs)
        now = self._now()
        start = self._dates.local(max(asked.start or 0, -(-self._dates.to_fleet(now) // SECOND)))
        within = min(asked.within, MAX_AHEAD - (start - now) / SECOND)
        if within < 0:
            raise Refused("bad_date", "a booking can't be more than a year ahead; ask for earlier times")
        wanted = Booking(asked.id, needs, asked.priority, start, runtime, runtime, now, owner=sender.host)
        self._try(_Undecided(query, lambda: self._answer_slots(query, asked, wanted, start + round(within * SECOND))))

    def _answer_slots(self, query: Query, asked: FindSlots, wanted: Booking, until: Ns) -> bool:
        self._emit(Tick())
        found = self._core.slots(wanted, until, asked.limit)
        if found.unknown:
            self._dates.ask(found.unknown, wanted)
            return False
        slots = []
        for one in found.found:
            start, latest = -(-self._dates.to_fleet(one.start) // SECOND), self._dates.to_fleet(one.latest) // SECOND
            slots.append(SlotView(start, max(start, latest), dict(one.bound)))
        guess = None if self._runtimes is None else self._core.likely_slot(wanted, until, self._runtimes)
        likely = None if guess is None else -(-self._dates.to_fleet(guess) // SECOND)
        if likely is not None and slots and likely >= slots[0].start:
            likely = None
        query.answer(SlotsTold(asked.id, self._dates.time, slots, found.complete, likely))
        return True

    # Votes

    def _try(self, undecided: _Undecided) -> None:
        if len(self._undecided) >= MAX_UNDECIDED:
            raise Refused("busy", f"{MAX_UNDECIDED} bookings already wait for votes; try again")
        if not undecided.decide():
            undecided.until = self._now() + round(DECIDE_WITHIN * SECOND)
            self._undecided.append(undecided)
            self._supervisor.call_later(DECIDE_WITHIN + 0.01, self.try_again)

    def try_again(self) -> None:
        """Votes have come, or are overdue."""
        undecided, self._undecided = self._undecided, []
        for one in undecided:
            try:
                if one.decide():
                    continue
            except Refused as refused:
                one.query.refuse(refused.problem)
                continue
            if self._now() >= one.until:
                one.query.refuse(Refused("busy", "a shared device did not answer what it can carry; try again").problem)
            else:
                self._undecided.append(one)

    @property
    def waits_for_votes(self) -> bool:
        return bool(self._undecided)

    # Taking up

    def take_up(self, ask: Ask, sender: Sender) -> str:
        """The date that an ARC takes up, as the core calls it; empty where one that goes on finds it over. To that one
        it may be that it is not known here yet. Raises Refused."""
        booking, _, start = ask.booking.partition("@")
        record = self._keeper.records.get(booking)
        goes_on = ask.place is not None or ask.grant is not None
        if record is None or record.unbooked:
            if goes_on:
                return ask.booking if record is None and start_of(ask.booking) is not None else ""
            raise Refused("unknown_booking", f"no booking {booking}, or it was cancelled; see zscout booking list")
        self._admission.check_take_up(ask, sender, record)
        dates_ = [date for date in self._dates.standing(record) if not start or str(date.start) == start]
        free = [date for date in dates_ if self._dates.taken_by(date) is None]
        if free:
            return free[0].id
        if goes_on:
            return next((date.id for date in self._dates.open_dates(record) if str(date.start) == start), "")
        why = "another request uses it" if dates_ else "its dates are over, or another booking takes precedence"
        raise Refused("unknown_booking", f"booking {record.name} can't be used: {why}; see zscout booking list")

    # Telling

    def answer_bookings(self, query: IncomingQuery[BookingsAsk]) -> None:
        asked = query.message
        query.answer(BookingsTold(self._dates.time, self.views(asked.owner, asked.rc), dict(self._sharing.clocks)))

    def views(self, owner: str | None = None, rc: str | None = None) -> list[BookingView]:
        views = []
        for record in self._keeper.records:
            if record.unbooked or (owner is not None and record.owner != owner):
                continue
            if rc is not None and not any(
                need == rc or (is_pattern(need) and matcher(need)(rc)) for need in record.needs
            ):
                continue
            view = self._dates.view(record)
            if view.dates or (record.every and (record.until or 0) > self._dates.time + WINDOW):
                views.append(view)
        return sorted(views, key=lambda view: (view.dates[0].start if view.dates else 1 << 60, view.id))


def _share(one: Booking, other: Booking) -> bool:
    names = {*one.needs, *one.bound.values()}
    return any(rc in names or (is_pattern(rc) and any(matcher(rc)(name) for name in names)) for rc in other.needs)

"""Operations on bookings: book, cancel, find free slots; and requests that use a booking."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from decimal import Decimal
from typing import Final

from zscout.config.fleet import Fleet
from zscout.keyexpr import BadName, Sender, check_name, host_in, is_pattern, matcher
from zscout.messages import (
    MAX_AHEAD,
    MAX_BOOKINGS,
    MAX_KEPT,
    WINDOW,
    Ask,
    Book,
    BookingRecord,
    BookingView,
    FindSlots,
    Operation,
    Proposal,
    ProposedHolder,
    Refused,
    SlotsTold,
    SlotView,
    Unbook,
    decimals,
    duration,
    exact_amounts,
)
from zscout.rcm.admission import Admission
from zscout.rcm.device_check import DeviceCheck
from zscout.rcm.places import request_id
from zscout.rcm.steps import Keep, Proposed, Ticket
from zscout.scheduling.booking import Booking
from zscout.scheduling.core import Core
from zscout.scheduling.model import Propose
from zscout.scheduling.runtimes import RuntimeEstimator
from zscout.services.bookings.dates import DAY, dates, in_zone, zone_of
from zscout.services.bookings.records import Records
from zscout.services.rcm.booked_dates import MAX_CLAIMS, BookedDates, Date, start_of
from zscout.types import SECOND, Need, Ns

MAX_UNDECIDED: Final = 64
"""Operations that wait for votes at one time; and operations that wait for a keeper."""
DECIDE_WITHIN: Final[Ns] = 3 * SECOND // 2
"""The time that an operation waits for votes: enough to ask a silent RC again."""
NAMED: Final = 3
"""Conflicting bookings that a refusal names."""


@dataclass(slots=True, eq=False)
class _Undecided:
    ticket: Ticket
    decide: Callable[[], bool]
    """Try to decide it, and return True if that succeeds."""
    until: Ns = 0


class BookingHandler:
    """Results are added to `out` of the dates."""

    def __init__(
        self,
        fleet: Fleet,
        core: Core,
        records: Records,
        dates_: BookedDates,
        admission: Admission,
        device_check: DeviceCheck,
        runtimes: RuntimeEstimator | None,
    ) -> None:
        self._fleet, self._core, self._records, self._dates = fleet, core, records, dates_
        self._admission, self._device_check = admission, device_check
        self._runtimes = runtimes
        """For hints on when a slot is likely to be free."""
        self.undecided: list[_Undecided] = []
        self._keeping = 0

    def operation(self, ticket: Ticket, sender: Sender, operation: Operation) -> None:
        """The core must be at the present time. Raises Refused."""
        check_name(operation.id, "id")
        match operation:
            case Book():
                self._book(ticket, operation, sender)
            case Unbook():
                self._unbook(ticket, operation, sender)
            case FindSlots():
                self._find_slots(ticket, operation, sender)

    def _book(self, ticket: Ticket, wanted: Book, sender: Sender) -> None:
        if self._is_made(ticket, wanted.id, sender):
            return
        self._admission.check_booking(wanted, sender, held=wanted.broken and self._is_held(wanted.needs, sender))
        record = self._record(wanted, sender)
        named = {need: amounts for need, amounts in wanted.needs.items() if host_in(need) is None}
        self._device_check.check(self._now, named, may_wait=False)
        self._try(_Undecided(ticket, lambda: self._is_made(ticket, record.id, sender) or self._decide(ticket, record)))

    def _is_held(self, needs: Collection[Need], sender: Sender) -> bool:
        """Return True if requests of `sender`, or of clients with the same name, hold all these devices now."""
        arcs = map(self._core.arc, {*self._core.arcs_of(str(sender)), *self._core.arcs_of_owners([sender.host])})
        held = {rc for arc in arcs if arc is not None and arc.hold is not None for rc in arc.needs}
        return held >= {*needs}

    def _is_made(self, ticket: Ticket, booking: str, sender: Sender) -> bool:
        """Answer a repeated operation. Return False if there is no such booking yet. Raises Refused."""
        if (known := self._records.get(booking)) is None:
            return False
        self._admission.check_owner(sender, known, "ask for it")
        self._answer_kept(ticket, known)
        return True

    def _record(self, wanted: Book, sender: Sender) -> BookingRecord:
        """Raises Refused for an invalid booking."""
        time = self._dates.time
        try:
            check_name(wanted.name, "name of the booking")
            zone_of(wanted.zone)
            runtime, patience = duration(wanted.runtime, "runtime"), duration(wanted.patience, "patience")
            if (wanted.urgent or wanted.lasting) and not wanted.maintenance:
                raise ValueError("only maintenance can be urgent or lasting; leave both out")
            if wanted.broken and (wanted.urgent or not wanted.lasting or any(map(host_in, wanted.needs))):
                raise ValueError("broken devices are in lasting maintenance, which is not urgent and names no host")
            if wanted.lasting and (wanted.every or wanted.runtime != WINDOW):
                raise ValueError(f"lasting maintenance is not repeated, and its runtime is {WINDOW} s")
        except (BadName, ValueError) as error:
            raise Refused("bad_request", str(error)) from None
        self._check_length(wanted.runtime)
        over = wanted.start + min(patience, runtime) / SECOND
        if over <= time:
            date, now = in_zone(wanted.start, wanted.zone), in_zone(time, wanted.zone)
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
        fields["who"] = self._admission.authority.certified_who(sender, wanted.who)
        if wanted.maintenance:
            fields["priority"] = max(wanted.priority, self._fleet.operator_priority)
        return BookingRecord(**fields, owner=sender.host, since=int(time), made=made, changed=made)

    def _check_length(self, runtime: Decimal) -> None:
        if runtime > MAX_AHEAD:
            raise Refused("bad_date", "a booking can't be longer than a year; ask for less")

    def _check_room(self, record: BookingRecord) -> None:
        records, owner = self._records, record.owner
        most = self._admission.limits.max_bookings_per_host
        own = [other for other in records if other.owner == owner]
        if sum(not other.unbooked for other in own) >= most:
            raise Refused("too_many", f"{owner} has {most} bookings, the most allowed; cancel one")
        if self._admission.closed:
            self._check_share(record, own)
        if len(records) >= MAX_BOOKINGS or records.size >= MAX_KEPT:
            raise Refused("too_many", f"this fleet already has {len(records)} bookings; cancel some")
        if len(self._core.bookings()) + len(self._dates.open_dates(record)) > MAX_CLAIMS:
            raise Refused("too_many", f"{MAX_CLAIMS} dates are booked, the most allowed; repeat it less often")

    def _check_share(self, record: BookingRecord, own: list[BookingRecord]) -> None:
        """Raises Refused if the owner would have more than half of the fleet's bookings, or dates. A cancelled booking
        counts until its last date is over."""
        if len(own) >= MAX_BOOKINGS // 2:
            words = f"{record.owner} has {len(own)} bookings, cancelled ones included, the most allowed"
            raise Refused("too_many", f"{words}; ask again when some are over")
        dates = sum(booking.owner == record.owner for booking, _ in self._core.bookings())
        if dates + len(self._dates.open_dates(record)) > MAX_CLAIMS // 2:
            most = MAX_CLAIMS // 2
            raise Refused(
                "too_many", f"{record.owner} has {dates} dates booked, of at most {most}; repeat it less often"
            )

    def _decide(self, ticket: Ticket, record: BookingRecord) -> bool:
        """Make the booking if all its dates in the window are free; return False while votes are missing. Raises
        Refused if a date is taken, or there is no room."""
        self._check_room(record)
        unknown, bound = [], dict[int, dict[str, str]]()
        # Maintenance takes precedence over bookings: the owners of conflicting bookings are notified.
        for date in [] if record.maintenance else self._dates.open_dates(record):
            claim = self._dates.claim(date)
            found = self._core.slots(claim, claim.start, 1)
            if found.unknown:
                unknown.append((claim, found.unknown))
            elif not found.found:
                self._refuse(ticket, Refused("not_free", self._in_the_way(date, claim)))
                return True
            elif found.found[0].bound:
                bound[date.start] = dict(found.found[0].bound)
        if unknown:
            for claim, votes in unknown:
                self._dates.out.proposals += map(self.proposal, self._core.ask_votes(votes, claim))
            return False
        self._dates.change(record, kept=bound)
        self._dates.out.events.append(self._dates.reconcile())
        when = in_zone(record.start, record.zone)
        self._dates.out.log.append(f"{record.owner} books {record.name}: {', '.join(record.needs)} at {when}")
        self._answer_kept(ticket, record, withdraw=True)
        return True

    def _in_the_way(self, date: Date, claim: Booking) -> str:
        """The reason that a date can't be booked, as text for people."""
        others = [
            booking
            for booking, _ in self._core.bookings()
            if booking.start < claim.end and claim.start < booking.end and self._share(booking, claim)
        ]
        names = [f"{other.label or other.id} of {other.owner} ({', '.join(other.needs)})" for other in others[:NAMED]]
        more = f" and {len(others) - NAMED} more" if len(others) > NAMED else ""
        why = (
            f"booked then: {'; '.join(names)}{more}" if names else "held, in maintenance or promised to queued requests"
        )
        return f"not all of {', '.join(date.record.needs)} are free at {in_zone(date.start, date.record.zone)}: {why}"

    def _share(self, booking: Booking, other: Booking) -> bool:
        status = self._core.booking(booking.id)
        names = {*booking.needs, *booking.bound.values(), *(() if status is None else status.maintained)}
        return any(rc in names or (is_pattern(rc) and any(map(matcher(rc), names))) for rc in other.needs)

    def _answer_kept(self, ticket: Ticket, record: BookingRecord, *, withdraw: bool = False) -> None:
        """Have the record stored, then answer; `withdraw`: remove it if storing fails."""
        if self._keeping >= MAX_UNDECIDED:
            raise Refused("busy", f"{MAX_UNDECIDED} bookings are already being stored; try again")
        self._keeping += 1
        self._dates.out.keep.append(Keep(ticket, record.id, withdraw))

    def kept(self, keep: Keep, why: str) -> None:
        """A record is stored; or not, for the reason `why`."""
        self._keeping -= 1
        record = self._records.get(keep.booking)
        if record is None or why:
            if record is not None and keep.withdraw:
                # Not cancelled, which is final: another leader may have made it as well, or may have received it.
                self._records.remove(keep.booking)
                self._dates.out.events.append(self._dates.reconcile())
            refused = Refused("not_kept", f"the booking was not stored: {why or 'it is over'}")
            self._refuse(keep.ticket, refused)
        else:
            self._dates.out.answers.append((keep.ticket, self._dates.view(record)))

    def _unbook(self, ticket: Ticket, operation: Unbook, sender: Sender) -> None:
        record = self._records.get(operation.id)
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
            date = in_zone(operation.start, record.zone)
            raise Refused("bad_date", f"{date} is not a date of {record.name}; see zscout booking list")
        self._dates.out.events.append(self._dates.reconcile())
        self._answer_kept(ticket, new)

    def _find_slots(self, ticket: Ticket, asked: FindSlots, sender: Sender) -> None:
        self._admission.check_booking(asked, sender)
        needs = {need: exact_amounts(params) for need, params in asked.needs.items()}
        runtime = duration(asked.runtime, "runtime")
        self._check_length(asked.runtime)
        now = self._now
        self._device_check.check(now, asked.needs, may_wait=False)
        start = self._dates.local(max(asked.start or 0, -(-self._dates.to_fleet(now) // SECOND)))
        within = min(asked.within, MAX_AHEAD - (start - now) / SECOND)
        if within < 0:
            raise Refused("bad_date", "a booking can't be more than a year ahead; ask for earlier times")
        wanted = Booking(asked.id, needs, asked.priority, start, runtime, runtime, now, owner=sender.host)
        self._try(_Undecided(ticket, lambda: self._answer_slots(ticket, asked, wanted, start + round(within * SECOND))))

    def _answer_slots(self, ticket: Ticket, asked: FindSlots, wanted: Booking, until: Ns) -> bool:
        found = self._core.slots(wanted, until, asked.limit)
        if found.unknown:
            self._dates.out.proposals += map(self.proposal, self._core.ask_votes(found.unknown, wanted))
            return False
        slots = []
        for slot in found.found:
            start, latest = -(-self._dates.to_fleet(slot.start) // SECOND), self._dates.to_fleet(slot.latest) // SECOND
            slots.append(SlotView(start, max(start, latest), dict(slot.bound)))
        guess = None if self._runtimes is None else self._core.likely_slot(wanted, until, self._runtimes)
        likely = None if guess is None else -(-self._dates.to_fleet(guess) // SECOND)
        if likely is not None and slots and likely >= slots[0].start:
            likely = None
        self._dates.out.answers.append((ticket, SlotsTold(asked.id, self._dates.time, slots, found.complete, likely)))
        return True

    def _try(self, undecided: _Undecided) -> None:
        if len(self.undecided) >= MAX_UNDECIDED:
            raise Refused("busy", f"{MAX_UNDECIDED} bookings already wait for votes; try again")
        if not undecided.decide():
            undecided.until = self._now + DECIDE_WITHIN
            self.undecided.append(undecided)

    def retry(self, undecided: _Undecided) -> None:
        """Decide an operation after votes arrived; refuse it if they are overdue."""
        try:
            if undecided.decide():
                return
        except Refused as refused:
            self._refuse(undecided.ticket, refused)
            return
        if self._now >= undecided.until:
            self._refuse(
                undecided.ticket, Refused("busy", "a shared device did not report what it can serve; try again")
            )
        else:
            self.undecided.append(undecided)

    def proposal(self, asked: Propose) -> Proposed:
        """The question to an RC. Some of the proposed holders may be bookings."""
        holders = []
        for name, params in asked.holders.items():
            if (arc := self._core.arc(name)) is not None:
                known = request_id(name), arc.name, arc.request.client
            else:
                record = self._records.get(name.partition("@")[0])
                label, owner = (name, "nobody") if record is None else (record.name, record.owner or "nobody")
                known = name, label, f"{owner}/booking"
            holders.append(ProposedHolder(*known, decimals(params)))
        return Proposed(asked.rc, Proposal(proposal=asked.proposal, term=self._core.term, holders=holders))

    def _refuse(self, ticket: Ticket, refused: Refused) -> None:
        self._dates.out.answers.append((ticket, refused.problem))

    @property
    def _now(self) -> Ns:
        return self._dates.now

    def take_up(self, ask: Ask, sender: Sender) -> str:
        """The core's name of the date that a request uses; empty if it is over. An ARC that continues may name an
        unknown one. Raises Refused."""
        booking, _, start = ask.booking.partition("@")
        record = self._records.get(booking)
        continues = ask.place is not None or ask.grant is not None
        if record is None or record.unbooked:
            if continues:
                return ask.booking if record is None and start_of(ask.booking) is not None else ""
            raise Refused("unknown_booking", f"no booking {booking}, or it was cancelled; see zscout booking list")
        self._admission.check_take_up(ask, sender, record)
        dates_ = [date for date in self._dates.dates_in_core(record) if not start or str(date.start) == start]
        free = [date for date in dates_ if (kept := self._core.booking(date.id)) is None or kept.arc is None]
        if free:
            return free[0].id
        if continues:
            return next((date.id for date in self._dates.open_dates(record) if str(date.start) == start), "")
        why = "another request uses it" if dates_ else "its dates are over, or another booking takes precedence"
        raise Refused("unknown_booking", f"booking {record.name} can't be used: {why}; see zscout booking list")

    def views(self, owner: str | None = None, rc: str | None = None) -> list[BookingView]:
        views = []
        for record in self._records:
            if record.unbooked or (owner is not None and record.owner != owner):
                continue
            named = rc is None or any(need == rc or (is_pattern(need) and matcher(need)(rc)) for need in record.needs)
            if not named and not record.maintenance:
                continue
            view = self._dates.view(record)
            if not named and rc not in view.maintained:
                continue
            if view.dates or (record.every and (record.until or 0) > self._dates.time + WINDOW):
                views.append(view)
        return sorted(views, key=lambda view: (view.dates[0].start if view.dates else 1 << 60, view.id))

"""Checks of zscout's promises about bookings under faults (docs/promises.md).

An acknowledgement of an RCM is a fact: a booking was made, or it or one of its dates was given up. Facts survive all
faults except the destruction of every copy, in the memory of booking keepers and on the hosts' disks."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import combinations
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from zscout.behaviors.client.request import OpenArc
from zscout.keyexpr import is_pattern
from zscout.messages import WINDOW, Book, BookedDate, BookingRecord, BookingView, Instant
from zscout.scheduling.booking import Booking
from zscout.services.bookings.dates import dates, last_end
from zscout.services.bookings.fleet_clock import DIFFERS, SAME
from zscout.services.bookings.keeper import BookingKeeper, Disk
from zscout.services.bookings.records import KEEP, Records
from zscout.types import SECOND, ArcId, Grant, Ns, Place, Term

if TYPE_CHECKING:
    from zscout.services.rcm.rcm import Rcm

RUNS_APART: Final = 0.0011
"""Largest rate by which fleet time may run faster or slower than virtual time, on an inexact clock."""
OUT_OF_DATE: Final = 60.0
"""Seconds after a clock was set in which a leader may believe it as it was: a leader reads other hosts' clocks every
30 s, and not while they are cut off."""
AGREE: Final = 0.5
"""Seconds by which a new leader's fleet time may differ from the fleet time that it continues."""
AT_ITS_DATE: Final = 1.5
"""Seconds within which a booking is held, after its date, or after it was taken up if that was later."""
NOT_EXACT: Final[Ns] = SECOND // 4
"""Delay of a date because another leader's fleet time differs."""
EARLY: Final = 0.5
"""Seconds by which a taken booking may begin before its date, for the same reason."""
STEPPED: Final[Ns] = SECOND
"""Fleet time moves by more than this only in a correction, or if another fleet time is continued."""
GIVEN_UP: Final = 0.1
"""Seconds within which a leader that knows that a booking is given up frees its RCs."""


@dataclass(slots=True)
class Life:
    """A booking from the view of its program."""

    book: Book
    made: bool = False
    """True once an RCM has acknowledged it."""
    given_up: bool = False
    """True once the program has asked to unbook it, whatever the outcome."""
    dropped: set[Instant] = field(default_factory=set)
    """The dates that the program has asked to give up."""

    def dates(self) -> list[Instant]:
        return dates(_as_record(self.book), 0, last_end(_as_record(self.book)))

    def give_up(self, start: Instant | None) -> None:
        if start is None:
            self.given_up = True
        else:
            self.dropped.add(start)


@dataclass(slots=True, eq=False)
class Fact:
    booking: str
    what: Instant | str
    """`made`, `unbooked`, or the date that was given up."""
    destroyed: bool = False
    """True if faults have destroyed every copy of it."""

    def __str__(self) -> str:
        return f"{self.booking} {self.what}"

    def known_by(self, record: BookingRecord | None) -> bool:
        if record is None:
            return False
        if self.what == "made":
            return True
        return record.unbooked or self.what in record.dropped


class BookingPromises:
    """`broken(text)` is called for each broken promise. `keepers`: of live processes, by host; `disks`: of all hosts;
    `believed(host, within)`: a host's clock as leaders may believe it that last read it less than `within` seconds ago;
    `calm`: True without a present fault; `inside`: calls a function in the process of a host's node."""

    def __init__(
        self,
        broken: Callable[[str], None],
        now: Callable[[], float],
        keepers: Mapping[str, BookingKeeper],
        disks: Mapping[str, Disk],
        believed: Callable[[str, float], Collection[float]],
        candidates: list[str],
        calm: Callable[[], bool],
        inside: Callable[[str, Callable[[], Any]], Any],
    ) -> None:
        self._broken, self.now, self._calm, self._inside = broken, now, calm, inside
        self._keepers, self._disks, self._believed, self._candidates = keepers, disks, believed, candidates
        self.lives: dict[str, Life] = {}
        self.facts: dict[tuple[str, Instant | str], Fact] = {}
        self._destroyed = 0.0
        """When copies were last destroyed."""
        self._final: dict[BookingKeeper, tuple[str, dict[str, BookingRecord]]] = {}
        """By process: the digest of its records, and the records, at the last look."""
        self._stepped = -1.0
        """When a leader last took over an older fleet time, or corrected its own."""
        self._times: dict[Term, _FleetTime] = {}
        """By term: the fleet time of its leader at the last look."""
        self._former: list[_FleetTime] = []
        """Fleet times before leaders took over an older fleet time, or corrected theirs."""
        self._overheard: dict[Term, _FleetTime] = {}
        """By term of a leader that was never looked at, because it died or was stopped: the fleet time that keepers
        received from it."""
        self._dated: dict[Term, Ns] = {}
        """By term that began without a certain fleet time: 1970 on its leader's clock, at the last look."""
        self._heard: dict[str, Term] = {}
        """By host whose process knew fleet time at the last look: the term of the leader that published it."""
        self._latest = 0.0
        """The latest fleet time that any leader has had."""
        self._known: dict[Term, dict[str, float]] = {}
        """By term and date: since when its leader knows of it."""
        self._claims: dict[Term, dict[str, tuple[Booking, ArcId | None]]] = {}
        """By term and date: its claim at the last look, and the ARC that has taken it up."""
        self._unwanted: dict[Term, tuple[tuple[str, int], list[str]]] = {}
        """By term: dates that are kept though they were given up, after the digest of records and the batch to which
        they belong."""
        self._begun: dict[Term, float] = {}
        """When each term was first seen, or slightly earlier: older holds may be handed over in it."""
        self._looked: dict[Term, int] = {}
        self._running: dict[Term, set[tuple[Place, Ns]]] = {}
        """By term: places and beginnings of holds, which a hand-over keeps."""
        self._present: dict[Term, dict[str, float]] = {}
        """By term and present RC: since when it is present."""
        self._named: dict[Term, Mapping[str, object]] = {}
        """By term and present RC: its instance."""
        self._records: dict[str, set[str]] = {}
        """By host: the bookings that it knew at the last look."""
        self._news: dict[str, set[str]] = {}
        """The same, collected during a look."""

    def asked(self, book: Book) -> Life:
        return self.lives.setdefault(book.id, Life(book))

    def booked(self, life: Life, view: BookingView, asked: float) -> None:
        """An RCM has acknowledged the booking that was requested at `asked`."""
        if view.unbooked:
            if not life.given_up:
                self._broken(f"booking {life.book.name} is unbooked though its program did not give it up")
            return
        life.made = True
        self._establish(life, "made", asked)

    def unbooked(self, life: Life, start: Instant | None, view: BookingView, asked: float) -> None:
        """An RCM has acknowledged that the booking, or its date `start`, is given up, as requested at `asked`."""
        if start is None and not view.unbooked:
            self._broken(f"the answer to unbooking {life.book.name} shows it as booked")
        self._establish(life, "unbooked" if start is None else start, asked)

    def _establish(self, life: Life, what: Instant | str, asked: float) -> None:
        fact = self.facts.setdefault((life.book.id, what), Fact(life.book.id, what))
        memory, disk = self._copies(fact)
        enough = len({*memory, *disk} & {*self._candidates}) > 1
        # A leader that sees no other candidate can use only its own disk.
        # A host that confirmed its copy may be gone while the last hosts are still asked.
        kept = enough or fact.destroyed or self._is_over(fact) or self._destroyed > asked
        if not kept and (self._calm() or not disk):
            where = f"the memory of {sorted(memory)}, and on the disk of {sorted(disk)}"
            self._broken(f"{life.book.name} {what} is acknowledged, and is in {where} alone")

    def news(self, arc: OpenArc, leaders: Mapping[str, Rcm]) -> None:
        """A program has news of a request. `leaders`: by host, of processes that are not stopped."""
        booking, _, start = arc.booking.partition("@")
        mine = self.lives.get(booking)
        if mine is not None and start and arc.state == "running" and not (mine.given_up or int(start) in mine.dropped):
            # Ask the leaders now: a leader that has just begun to publish fleet time was not looked at yet.
            leading = [self._inside(host, partial(_fleet_time, rcm)) for host, rcm in leaders.items()]
            known = [time for time in leading if time is not None]
            known += [self.now() + time.ahead for time in (*self._times.values(), *self._former)]
            now = max(known, default=math.inf)
            if now < int(start) - EARLY:
                self._broken(f"{arc.name} begins {int(start) - now:.1f} s before the date of {mine.book.name}")
        life = self.lives.get((arc.by or "").partition("@")[0])
        if life is not None and arc.outcome == "preempted" and not life.book.maintenance:
            self._broken(f"{arc.name} is preempted for {life.book.name}, which was not taken up")

    def _copies(self, fact: Fact) -> tuple[set[str], set[str]]:
        """The hosts that have the fact in memory, and on disk."""
        memory = {host for host, keeper in self._keepers.items() if fact.known_by(keeper.records.get(fact.booking))}
        return memory, {
            host
            for host, disk in self._disks.items()
            if any(fact.known_by(record) for record in disk.read() if record.id == fact.booking)
        }

    @contextmanager
    def destroying(self) -> Iterator[None]:
        """A context in which processes die or disks are exchanged."""
        facts = [fact for fact in self.facts.values() if not fact.destroyed and not self._is_over(fact)]
        for fact in facts:
            if not any(self._copies(fact)):
                self._broken(f"{fact} was acknowledged, and no copy is left")
        yield
        self._destroyed = self.now()
        for fact in facts:
            fact.destroyed = not any(self._copies(fact))

    def _is_over(self, fact: Fact) -> bool:
        """Return True if the fact may be forgotten."""
        book = self.lives[fact.booking].book
        return last_end(_as_record(book)) + KEEP < self._latest + 1

    def look(self, leaders: Mapping[str, Rcm], *, calm: bool) -> Iterator[tuple[tuple[object, ...], float]]:
        """Yield conditions that must not last, with their longest times. `leaders`: of processes that are not
        stopped."""
        for host, keeper in self._keepers.items():
            self._look_at_records(host, keeper)
        for host, rcm in leaders.items():
            self._look_at_time(host, rcm)
            self._begun.setdefault(rcm.term, self.now() - GIVEN_UP)
            if self._looked.get(rcm.term) != rcm.core.batches:
                self._looked[rcm.term] = rcm.core.batches
                self._look_at_claims(host, rcm)
                self._look_at_grants(host, rcm)
            for name in self._given_up(host, rcm):
                yield (host, "keeps", name, "which was given up"), GIVEN_UP
            now = self._inside(host, rcm.mesh.now)
            for name, (booking, arc) in self._claims[rcm.term].items() if calm else ():
                if arc is not None and booking.start <= now and self._has_no_excuse(rcm, name, booking, arc, now):
                    yield (name, "is taken up, and its date has come, but", arc, "does not run"), AT_ITS_DATE
        for host, keeper in self._keepers.items():
            if (term := keeper.received[0]) not in self._times and keeper.time is not None:
                self._overheard.setdefault(
                    term, self._inside(host, partial(_FleetTime.received_by, keeper, self.now()))
                )
        self._heard = {host: keeper.received[0] for host, keeper in self._keepers.items() if keeper.time is not None}
        self._records = {host: known for host, known in (self._records | self._news).items() if host in self._keepers}
        self._news = {}

    def _look_at_records(self, host: str, keeper: BookingKeeper) -> None:
        """Check that the final parts of a booking are kept wherever they are known."""
        digest, before_it = self._final.get(keeper, ("", {}))
        if keeper.records.digest() == digest and host in self._records:
            return
        # A booking that was over long ago may be forgotten, and may come back from a host that was away.
        self._final[keeper] = keeper.records.digest(), {record.id: record for record in keeper.records}
        self._news[host] = {record.id for record in keeper.records}
        for record in keeper.records:
            before = before_it.get(record.id)
            if before is record:
                continue
            if before is not None and (
                before.unbooked > record.unbooked
                or not {*before.dropped} <= {*record.dropped}
                or not {*before.over} <= {*record.over}
            ):
                self._broken(f"{record.name} was given up or over on {keeper.mesh.me}, and is not any more")

    def _look_at_claims(self, host: str, rcm: Rcm) -> None:
        """Note since when the leader knows of each date."""
        first = rcm.term not in self._known
        # Dates that were in conflict under the last leader may be so at first.
        stood = self._claims[max(self._claims)] if self._claims else {}
        known, kept = self._known.setdefault(rcm.term, {}), self._claims.get(rcm.term, {})
        claims = {booking.id: (booking, arc) for booking, arc in rcm.core.bookings()}
        # A date counts as new if it was absent or is another object without a delay: it was in conflict with a date
        # that is over, or was refused and returned. It is also new if other RCs are bound to its patterns.
        for name in known.keys() - claims.keys():
            del known[name]
        for name in known.keys() & kept.keys():
            (booking, _), (before, _) = claims[name], kept[name]
            again = booking.since != before.since or (booking is not before and booking == before)
            if again or booking.bound != before.bound:
                del known[name]
        for name in claims:
            inherited = first and name in stood and name.partition("@")[0] in self._records.get(host, ())
            known.setdefault(name, 0.0 if inherited else self.now())
        self._claims[rcm.term] = claims

    def _given_up(self, host: str, rcm: Rcm) -> list[str]:
        """Dates that a leader keeps although it knows that they were given up."""
        records = self._keepers[host].records
        of = records.digest(), rcm.core.batches
        if self._unwanted.get(rcm.term, ((), ()))[0] != of:
            found = []
            for name in self._claims[rcm.term]:
                id_, _, start = name.partition("@")
                record = records.get(id_)
                if record is None or record.unbooked or int(start) in record.dropped:
                    found.append(name)
            self._unwanted[rcm.term] = of, found
        return self._unwanted[rcm.term][1]

    def _look_at_time(self, host: str, rcm: Rcm) -> None:
        now, time = self.now(), self._inside(host, partial(_fleet_time, rcm))
        dated = rcm.bookings.dates.local(0)
        if abs(dated - self._dated.get(rcm.term, dated)) > STEPPED:
            # All its dates have changed: it knows of these since now.
            self._known[rcm.term] = dict.fromkeys(self._known.get(rcm.term, ()), now)
        if time is None or rcm.term in self._dated:
            self._dated[rcm.term] = dated
        if time is None:
            return  # after a restart of all hosts, fleet time is not known at once
        self._latest = max(self._latest, time)
        age = self._inside(host, lambda: rcm.mesh.now() - rcm.bookings.clock.since) / SECOND
        current, before = _FleetTime(now, time - now, now - age), self._times.get(rcm.term)
        if before is not None and current.since >= before.since - SAME:
            jump = current.ahead - before.ahead
            if abs(jump) > RUNS_APART * (now - before.at) + 1e-6:
                # It was corrected. Hosts that do not know that may lead meanwhile.
                self._stepped = now
                self._former.append(before)
                nearest = min(abs(clock - time) for host in self._disks for clock in self._believed(host, OUT_OF_DATE))
                where = f"{jump:g} s in term {rcm.term.counter}, {nearest:g} s from the next clock"
                if abs(jump) < DIFFERS - AGREE or nearest > AGREE:
                    self._broken(f"fleet time jumps by {where}")
                elif not self._may_be_median(time, rcm.bookings.clock.hosts):
                    self._broken(f"fleet time jumps to a minority's clock, by {where}")
        elif before is not None or self._heard.get(host, rcm.term) != rcm.term:  # own term: it published and stopped
            if before is not None:
                # Its time began apart from the other hosts, and it has met them now. Hosts that received only its time
                # may lead before they receive the older time.
                self._stepped = now
                self._former.append(before)
            known = [*self._times.values(), *self._former, *self._overheard.values()]
            if not (any(map(current.agrees, known)) and any(map(current.continues, known))):
                self._broken(f"fleet time is {time:.3f} in term {rcm.term.counter}: it continues no earlier fleet time")
        self._times[rcm.term] = current

    def _may_be_median(self, time: float, hosts: Collection[str]) -> bool:
        """Return True if half of the clocks of `hosts` may be at or before `time`, and half at or after it. A leader
        may have read the clock of a silent host before it was set."""
        clocks = [self._believed(host, math.inf) for host in hosts]
        before = sum(min(times) <= time + AGREE for times in clocks)
        after = sum(max(times) >= time - AGREE for times in clocks)
        return 2 * min(before, after) >= len(clocks)

    def _look_at_grants(self, host: str, rcm: Rcm) -> None:
        """Check that no ARC starts that would overlap the date of a known booking of its rank or above."""
        status, local = rcm.core.status(), self._inside(host, rcm.mesh.now)
        now_present = [rc.name for rc in status.rcs if rc.present]
        named, meant = rcm.roster.named(now_present), self._named.get(rcm.term, {})
        # With another instance, the RC was away for an instant.
        present = {rc: at for rc, at in self._present.get(rcm.term, {}).items() if meant.get(rc) == named.get(rc)}
        there = present.keys() & set(now_present)
        self._present[rcm.term] = {rc: present.get(rc, self.now()) for rc in now_present}
        self._named[rcm.term] = named
        for arc in (*status.running, *status.queued):
            if self._claims[rcm.term].get(arc.request.booking, (None, arc.id))[1] is None:
                self._broken(f"{arc.name} would take up {arc.request.booking}, which is open, and has not")
        running = {(arc.place, arc.hold.start): arc for arc in status.running if arc.hold}
        before, self._running[rcm.term] = self._running.get(rcm.term, set()), set(running)
        if self.now() - self._stepped < 1.0:
            return  # its dates are new
        exclusive = {rc.name for rc in status.rcs if rc.present and not rc.sharable}
        has_it = {arc.id for arc in status.running}
        # For patterns, other RCs may be kept at any time.
        waiting = {
            name: (booking, by)
            for name, (booking, by) in self._claims[rcm.term].items()
            if by not in has_it and not any(map(is_pattern, booking.needs))
        }
        for arc in (running[hold] for hold in running.keys() - before):
            assert arc.hold is not None
            if arc.hold.grant.term != rcm.term:
                continue
            began = self.now() - (local - arc.hold.start) / SECOND
            for name, (booking, by) in waiting.items():
                over = booking.lapses if by is None else booking.end
                meet = booking.start + NOT_EXACT < arc.hold.end and arc.hold.start + NOT_EXACT < over
                rcs = booking.needs.keys()
                if (
                    meet
                    and arc.request.priority <= booking.priority
                    # A date that has begun is kept only while all its RCs are present.
                    and (booking.start > arc.hold.start + NOT_EXACT or rcs <= there)
                    and rcs & arc.needs.keys() & exclusive
                    and max(self._known[rcm.term][name], self._begun[rcm.term]) < began
                ):
                    booked = self.lives[name.partition("@")[0]].book.name
                    self._broken(f"{arc.name} begins a hold that overlaps the date of {booked}: {name}")

    def _has_no_excuse(self, rcm: Rcm, name: str, booking: Booking, arc: ArcId, now: Ns) -> bool:
        """Return True if a booking should be held by now and is not: no holder has higher priority, or has held since
        before the leader knew of the booking and all its RCs."""
        status = rcm.core.arc(arc)
        if status is None or status.hold is not None:
            return False
        present = self._present[rcm.term]
        # With the RCs that are kept for its patterns.
        rcs = {booking.bound.get(need, need) for need in booking.needs}
        if not rcs <= present.keys():
            return False
        # While some of its RCs were away, the others were not kept.
        since = max(self._known[rcm.term][name], self._begun[rcm.term], *(present[rc] for rc in rcs))
        known = self.now() - since
        for rc in rcs:
            for holder in rcm.core.holders(rc):
                hold = holder.hold
                if hold is None or holder.request.priority > booking.priority or hold.grant.term != rcm.term:
                    return False
                # A holder beyond its minimum runtime yields.
                if hold.end > now and known < (now - hold.start) / SECOND + GIVEN_UP:
                    return False
        return True

    def unsettled(self, leaders: Mapping[str, Rcm]) -> str:
        """Why not all keepers know the same bookings; empty if they do."""
        if len(leaders) != 1:
            return f"{len(leaders)} leaders"
        own = self._keepers[next(iter(leaders))].records.digest()
        others = [host for host, keeper in self._keepers.items() if keeper.records.digest() != own]
        return f"{', '.join(others)} know other bookings than the leader" if others else ""

    def at_end(self, leaders: Mapping[str, Rcm], *, jumped: bool) -> Counter[str]:
        """Check the end: no fault is left, and `unsettled` is empty. `jumped`: all processes, and fleet time with them,
        were gone at once. Return counts of dates and facts by state."""
        ((host, rcm),) = leaders.items()
        time = self._inside(host, lambda: rcm.bookings.dates.time)
        views = {view.id: view for view in self._inside(host, lambda: rcm.bookings.handler.views())}
        records = self._keepers[host].records
        for fact in self.facts.values():
            life = self.lives[fact.booking]
            if fact.destroyed or self._is_over(fact):
                continue
            record = records.get(fact.booking)
            if record is None or not fact.known_by(record):
                self._broken(f"{life.book.name} {fact.what} was acknowledged, and is lost")
            elif fact.what == "made" and not life.given_up:
                # It may have been held by the fleet time of one half that was not continued.
                over = {start for start in record.over if start < self._latest}
                self._is_listed(life, views.get(fact.booking), over, max(time, self._latest) if jumped else time)
            view = views.get(fact.booking)
            if view is not None and (fact.what == "unbooked" or fact.what in {date.start for date in view.dates}):
                self._broken(f"{life.book.name} {fact.what} is listed, though it was given up")
        self._look_at_conflicts(rcm, records, views)
        states = Counter(f"dates {date.state} at the end" for view in views.values() for date in view.dates)
        destroyed = sum(fact.destroyed for fact in self.facts.values())
        return states + Counter({"acknowledged, and destroyed": destroyed})

    def _is_listed(self, life: Life, view: BookingView | None, over: set[Instant], time: float) -> None:
        states = {} if view is None else {date.start: date.state for date in view.dates}
        for start in dates(_as_record(life.book), time + 1, time + WINDOW - 1):
            if start not in life.dropped | over and states.get(start) not in ("open", "taken", "conflict"):
                self._broken(f"{life.book.name} at {start} is lost: it is {states.get(start, 'not listed')}")

    def _look_at_conflicts(self, rcm: Rcm, records: Records, views: Mapping[str, BookingView]) -> None:
        """Check that of two conflicting dates the better-ranked stands, for exclusive RCs."""
        sharable = {rc.name for rc in rcm.core.status().rcs if rc.sharable or not rc.present}
        stands, not_held = list[_Listed](), list[_Listed]()
        for view in views.values():
            record = records.get(view.id)
            assert record is not None
            for date in view.dates:
                rcs = {date.bound.get(need, need) for need in view.needs} - sharable
                listed = _Listed((-view.priority, record.made, view.id), date, rcs, view)
                (not_held if date.state == "conflict" else stands).append(listed)
        for first, second in combinations(stands, 2):
            both = first.view.maintenance and second.view.maintenance
            if not both and first.view.id != second.view.id and first.meets(second):
                self._broken(f"{first.view.name} and {second.view.name} both stand: {first.date} {second.date}")
        for lost in not_held:
            exact = not any(map(is_pattern, lost.view.needs)) and sharable.isdisjoint(lost.view.needs)
            if exact and not any(other.rank < lost.rank and lost.meets(other) for other in stands):
                self._broken(f"{lost.view.name} at {lost.date.start} is in conflict with none: {lost.date.danger}")


class _FleetTime(NamedTuple):
    at: float
    """When it was read, in virtual time."""
    ahead: float
    """Seconds by which it was ahead of virtual time."""
    since: float
    """Its beginning. If the halves of a fleet restarted apart, there are two fleet times."""

    @classmethod
    def received_by(cls, keeper: BookingKeeper, now: float) -> _FleetTime:
        """The fleet time that a keeper has received from a leader that can't be looked at."""
        assert keeper.time is not None
        return cls(now, keeper.time / SECOND - now, now - keeper.age)

    def agrees(self, before: _FleetTime) -> bool:
        return self.differs(before) <= AGREE

    def continues(self, before: _FleetTime) -> bool:
        """Return True if this may be the same fleet time as `before`: it has the same beginning and differs little."""
        return abs(self.since - before.since) <= SAME and self.differs(before) <= DIFFERS

    def differs(self, before: _FleetTime) -> float:
        """The difference in seconds beyond the drift of clocks."""
        return abs(self.ahead - before.ahead) - 2 * RUNS_APART * (self.at - before.at)


class _Listed(NamedTuple):
    rank: tuple[int, Grant, str]
    date: BookedDate
    rcs: set[str]
    view: BookingView

    def meets(self, other: _Listed) -> bool:
        mine, theirs = self.date, other.date
        return bool(self.rcs & other.rcs) and mine.start < theirs.end and theirs.start < mine.end


def _fleet_time(rcm: Rcm) -> float | None:
    return rcm.bookings.time


def _as_record(book: Book) -> BookingRecord:
    return BookingRecord(**{name: getattr(book, name) for name in Book.__struct_fields__})

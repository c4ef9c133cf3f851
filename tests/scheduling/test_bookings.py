"""Bookings: one that is taken up in time starts at its date or its owner was told, nobody is in the way of maintenance,
nobody else waits longer than promised, and `slots` finds what exhaustive search finds."""

from __future__ import annotations

import itertools
import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction

import pytest
from msgspec import structs

from tests.scheduling.seeds import in_parts
from tests.scheduling.validate import validate
from tests.thorough import times
from zscout.config.scheduling_policy import SchedulingPolicy
from zscout.keyexpr import is_pattern, matcher
from zscout.scheduling.adaptive import Adaptive
from zscout.scheduling.booking import (
    Booked,
    Booking,
    BookingChanged,
    BookingConflict,
    BookingState,
    BookingThreatened,
    Dates,
    Redated,
    Unbooked,
)
from zscout.scheduling.capacity import excess
from zscout.scheduling.core import Core
from zscout.scheduling.forecast import play_instant
from zscout.scheduling.model import (
    ArcRequest,
    ClientLost,
    Effect,
    Event,
    Granted,
    Propose,
    RcJoined,
    RcLost,
    RcReported,
    Released,
    Requested,
    Tick,
    Vote,
    WakeAt,
)
from zscout.scheduling.reason import Reason, ReasonCode
from zscout.scheduling.reservations import yields
from zscout.scheduling.slots import Slot
from zscout.types import Ns, Params, RcName

SEEDS = range(times(1_000))
PATIENCE = 40
POLICY = SchedulingPolicy(patience=PATIENCE)
CAPACITY = {"rate": Fraction(4)}
RADIO: RcName = "radio/rf"
ROBOTS = ["robot/a", "robot/b", "robot/c"]


@dataclass
class Fleet:
    """A core whose RCs vote at once."""

    core: Core = field(default_factory=lambda: Core(Adaptive(), POLICY))
    now: Ns = 0
    effects: list[Effect] = field(default_factory=list)
    wake: Ns | None = None
    served: dict[str, tuple[Ns, Ns]] = field(default_factory=dict)
    """By ARC: since when it had waited, and when it was granted last."""
    away: dict[str, Ns] = field(default_factory=dict)
    """By RC: when it was away last."""
    dangers: dict[str, Reason | None] = field(default_factory=dict)
    """By booking: what was told of it last."""
    redated: set[str] = field(default_factory=set)
    made: dict[str, Booking] = field(default_factory=dict)
    entered: dict[str, Ns] = field(default_factory=dict)
    """By booking: when the core heard of it last. One that had been given up for a while was not there meanwhile."""

    def send(self, *events: Event) -> list[Effect]:
        """All that comes of one instant."""
        for event in events:
            if isinstance(event, Booked):
                self.made[event.booking.id] = event.booking
                self.entered[event.booking.id] = self.now
                self.dangers.pop(event.booking.id, None)
        since = {arc.id: arc.since for arc in self.core._state.all_arcs() if arc.hold is None}
        came = list(itertools.chain.from_iterable(play_instant(self.core, self.now, events, vote)))
        for effect in came:
            if isinstance(effect, WakeAt):
                self.wake = effect.at
            elif isinstance(effect, Granted):
                self.served[effect.arc] = since.get(effect.arc, self.now), self.now
            elif isinstance(effect, BookingChanged) and effect.state is BookingState.UNBOOKED:
                self.dangers.pop(effect.booking, None)
            elif isinstance(effect, BookingThreatened):
                assert effect.reason != self.dangers.get(effect.booking), "told again"
                self.dangers[effect.booking] = effect.reason
        self.away |= {rc.name: self.now for rc in self.core.status(0).rcs if not rc.present}
        validate(self.core)
        self.check_maintenance()
        self.effects += came
        return came

    def check_maintenance(self) -> None:
        """Who holds what is in maintenance began before, and has a higher priority or not had its minimum runtime: then
        it began before the core heard of the maintenance."""
        state = self.core._state
        for claim in state.maintenance.values():
            one = claim.booking
            for rc in state.rcs_in(claim.kept) if one.start <= self.now else ():
                for holder in rc.holders.values():
                    hold, entered = holder.hold, self.entered[one.id]
                    assert hold is not None
                    assert not one.urgent, f"{holder.id} holds in {one.id}"
                    assert hold.start < one.start or hold.start <= entered, f"{holder.id} began in {one.id}"
                    if holder.priority <= one.priority:
                        assert self.now < hold.end, f"{holder.id} outstays its time in {one.id}"
                        assert hold.start <= entered, f"{holder.id} is not over by the date of {one.id}"

    def until(self, now: Ns) -> None:
        """Time passes, and the core is woken as it asked."""
        while self.wake is not None and self.wake < now:
            self.now = max(self.now + 1, self.wake)
            if self.now >= now:
                break
            self.send(Tick())
        self.now = now

    def slots(self, wanted: Booking, until: Ns, limit: int, *, bookings_only: bool = False) -> list[Slot]:
        """Asked until all votes are known."""
        while True:
            told = self.core.slots(wanted, until, limit, bookings_only=bookings_only)
            if not told.unknown:
                return told.found
            votes = self.core._state.votes
            for rc, holders in told.unknown:
                number = votes.propose(rc.name, holders, self.now)
                assert number is not None
                arcs = ((one, self.core._state.voter(one)) for one in sorted(holders))
                params = {one: wanted.needs[rc.name] if arc is None else arc.needs[rc.name] for one, arc in arcs}
                reason = excess(CAPACITY, params.items())
                votes.answer(number, accept=not reason, reason=reason)


def vote(asked: Propose) -> Vote:
    reason = excess(CAPACITY, asked.holders.items())
    return Vote(asked.proposal, accept=not reason, reason=reason)


def joined(rc: str) -> RcJoined:
    return RcJoined(rc, sharable=False, host="left" if rc <= "robot/b" else "right")


def needs(draw: random.Random, *, patterns: bool = False) -> dict[str, Params]:
    wanted: dict[str, Params] = {rc: {} for rc in draw.sample(ROBOTS, draw.randint(1, 2))}
    if patterns and draw.random() < 0.4:
        wanted = {need: {} for need in ("robot/*", "robot/*#2")[: 2 if draw.random() < 0.3 else 1]}
    if draw.random() < 0.4:
        wanted[RADIO] = {"rate": Fraction(draw.randint(1, 4))}
    return wanted


def booking(draw: random.Random, number: int, now: Ns) -> Booking:
    start, runtime = now + draw.randint(0, 30), draw.randint(1, 20)
    patience = draw.randint(1, 10)
    wanted = needs(draw, patterns=True)
    return Booking(f"b{number}", wanted, draw.randint(0, 2), start, runtime, patience, now, owner="h")


def maintenance(draw: random.Random, number: int, now: Ns) -> Booking:
    rcs = draw.sample([*ROBOTS, RADIO], draw.randint(1, 2))
    start, runtime = now + draw.randint(0, 20), draw.randint(1, 15)
    wanted: dict[str, Params] = {rc: {} for rc in rcs}
    others: dict[int, dict[str, Params]] = {1: {"robot/*": {}}, 2: {"@left": {}, "robot/c": {}}}
    wanted = others.get(number % 4, wanted)
    urgent = number % 5 == 0
    return Booking(f"m{number}", wanted, draw.randint(1, 3), start, runtime, 0, now, maintenance=True, urgent=urgent)


def excused(fleet: Fleet, one: Booking) -> bool:
    """Whether what the promise leaves out keeps it from its start: a lost RC, a higher rank, an older promise,
    maintenance, a date that was moved."""
    if one.id in fleet.redated:
        return True
    state = fleet.core._state
    arc = state.claims[one.id].arc
    choices = [rc for need in arc.patterns for rc in state.matching(need)]
    concerned = [*state.rcs_in(arc.named_mask), *choices]
    if any(fleet.away.get(rc.name, -1) >= one.start for rc in concerned):
        return True
    rivals = [*state.running.values(), *state.queued.values()]
    names = {rc.name for rc in concerned}
    for claim in state.claims.values():
        other = claim.booking
        if names & {rc.name for rc in state.rcs_in(claim.mask)} and other.start < one.end and other.end > one.start:
            older = (-other.priority, other.since) <= (-one.priority, one.since)
            if other.maintenance or (other.id != one.id and (older or other.id in fleet.redated)):
                return True
    for rival in rivals:
        if rival is arc or not names & {
            *rival.needs,
            *(rc.name for need in rival.patterns for rc in state.matching(need)),
        }:
            continue
        if rival.priority > one.priority:
            return True
        # Who was starving before the booking was made had its promise first.
        if rival.hold is None and rival.starving and rival.since + PATIENCE // 2 <= one.since:
            return True
        waited, granted = fleet.served.get(rival.id, (fleet.now, fleet.now))
        owed = waited + PATIENCE // 2
        if rival.hold is not None and owed <= min(one.since, granted):
            return True
        # Who had taken up an older one goes on, though it is unbooked meanwhile.
        taken = fleet.made.get(rival.request.booking)
        if taken is not None and taken.since <= one.since:
            return True
    return False


def story(seed: int) -> Iterator[tuple[Fleet, Booking, bool]]:
    """A random run: after each instant, the bookings that are taken up and whose date has come; do they run?"""
    draw = random.Random(seed)  # noqa: S311
    fleet = Fleet()
    fleet.send(*map(joined, ROBOTS), RcJoined(RADIO, sharable=True))
    asked = 0
    gone: list[Booking] = []
    for number in range(60):
        fleet.until(fleet.now + draw.randint(0, 6))
        what = draw.random()
        events: list[Event] = [Tick()]
        open_ones = [one for one, arc in fleet.core.bookings() if arc is None]
        if what < 0.35:
            asked += 1
            wanted = needs(draw, patterns=True)
            keep = draw.random() < 0.2
            request = ArcRequest(f"a{asked}", f"h/c{asked}", wanted, draw.randint(0, 2), draw.randint(1, 25), keep)
            events = [Requested(request)]
        elif what < 0.55:
            one = booking(draw, number, fleet.now)
            if found := fleet.slots(one, one.start + 30, 1):
                events = [Booked(structs.replace(one, start=found[0].start, bound=found[0].bound))]
        elif what < 0.85 and open_ones:
            one = draw.choice(open_ones)
            asked += 1
            request = ArcRequest(
                f"a{asked}", f"h/c{asked}", one.needs, one.priority, one.runtime, draw.random() < 0.2, booking=one.id
            )
            events = [Requested(request)]
        elif what < 0.92 and fleet.core.arcs():
            arc = draw.choice(fleet.core.arcs())
            events = [Released(arc) if draw.random() < 0.5 else ClientLost(f"h/c{arc[1:]}")]
        elif what < 0.95:
            rc = draw.choice(ROBOTS)
            there = fleet.core._state.rc(rc).present
            events = [RcLost(rc) if there else joined(rc)]
        elif what < 0.96:
            events = [Booked(maintenance(draw, number, fleet.now))]
        elif what < 0.975 and open_ones:
            one = draw.choice(open_ones)
            # Maintenance is put off only: who had begun by its first date is not in its way.
            by = draw.randint(1 if one.maintenance else -2, 2)
            if one.start > fleet.now:
                fleet.redated.add(one.id)
            events = [Redated(one.id, one.start + by)]
        elif gone and (one := gone.pop()).end > fleet.now and fleet.core.booking(one.id) is None:
            # As after a conflict: others may have begun meanwhile what is not over by its date.
            fleet.redated.add(one.id)
            events = [Booked(one)]
        elif fleet.core.bookings():
            one = draw.choice(fleet.core.bookings())[0]
            gone += [one] if (at_present := draw.random() < 0.8) else []
            events = [Unbooked(one.id, at_present=at_present)]
        fleet.send(*events)
        for one, arc_id in fleet.core.bookings():
            if arc_id is not None and one.start <= fleet.now:
                yield fleet, one, fleet.core.is_running(arc_id)


@pytest.mark.parametrize("seeds", in_parts(SEEDS, quick=20, size=250))
def test_what_is_taken_up_starts_at_its_date(seeds: Sequence[int]) -> None:
    started = late = 0
    for seed in seeds:
        for fleet, one, runs in story(seed):
            started += runs
            late += not runs
            told = seed, fleet.now, one, fleet.core.arc(fleet.core._state.claims[one.id].arc.id)
            assert runs or excused(fleet, one), told
            assert runs == (fleet.dangers.get(one.id) is None), told
    assert started > len(seeds)
    assert late > len(seeds), "hardly any was in danger: these runs prove nothing"


def exhaustive(fleet: Fleet, wanted: Booking, until: Ns, *, bookings_only: bool = False) -> Ns | None:
    """The first time at which it could be kept, found by trying all, with what is known of all others."""
    state = fleet.core._state
    arc = fleet.core._calendar.stand_in(wanted)

    def others(rc: RcName, start: Ns, end: Ns) -> list[Fraction]:
        """What each of those asks of the RC that have it then."""
        there = [
            holder
            for holder in ({} if bookings_only else state.rc(rc).holders).values()
            if not yields(holder, arc, start)
        ]
        for claim in state.claims.values():
            one = claim.booking
            if claim.mask & state.rc(rc).bit and one.start < end and one.end > start and claim.arc not in there:
                there.append(claim.arc)
        return [Fraction(one.needs[rc].get("rate", 0)) for one in there]

    def free(rc: RcName, need: str, start: Ns) -> bool:
        end = start + wanted.runtime
        closed = [one.booking for one in state.maintenance.values() if one.kept & state.rc(rc).bit]
        if any(one.start < end and one.end > start for one in closed):
            return False
        there = others(rc, start, start + wanted.runtime)
        if rc != RADIO:
            return not there
        return sum(there) + wanted.needs[need].get("rate", 0) <= CAPACITY["rate"]

    rcs = [*ROBOTS, RADIO]
    choices = [[rc for rc in rcs if matcher(need)(rc)] if is_pattern(need) else [need] for need in wanted.needs]
    for start in range(wanted.start, until + 1):
        for chosen in itertools.product(*choices):
            if len({*chosen}) == len(chosen) and all(
                free(rc, need, start) for rc, need in zip(chosen, wanted.needs, strict=True)
            ):
                return start
    return None


@pytest.mark.parametrize("seeds", in_parts(SEEDS, quick=100, size=450))
def test_slots_are_those_of_exhaustive_search(seeds: Sequence[int]) -> None:
    found = none = 0
    for seed in seeds:
        draw = random.Random(f"slots {seed}")  # noqa: S311
        fleet = Fleet(Core(Adaptive(), SchedulingPolicy(patience=None)))
        fleet.send(*map(joined, ROBOTS), RcJoined(RADIO, sharable=True))
        for number in range(6):
            wanted, runtime = needs(draw, patterns=True), draw.randint(1, 15)
            fleet.send(Requested(ArcRequest(f"a{number}", f"h/{number}", wanted, draw.randint(0, 2), runtime)))
            if draw.random() < 0.2:
                fleet.send(Booked(maintenance(draw, number, fleet.now)))
            one = booking(draw, number, fleet.now)
            only = fleet.slots(one, fleet.now + 40, 1, bookings_only=True)
            expected = exhaustive(fleet, one, fleet.now + 40, bookings_only=True)
            assert (only[0].start if only else None) == expected, (seed, number, one)
            expected = exhaustive(fleet, one, fleet.now + 40)
            told = fleet.slots(one, fleet.now + 40, 3)
            assert (told[0].start if told else None) == expected, (seed, number, one)
            for slot in told:
                for start in {slot.start, slot.latest}:
                    assert exhaustive(fleet, structs.replace(one, start=start), start) == start
            found, none = found + len(told), none + (not told)
            if told:
                fleet.send(Booked(structs.replace(one, start=told[0].start, bound=told[0].bound)))
            fleet.until(fleet.now + draw.randint(0, 5))
    assert found > len(seeds)
    assert none > 0


def test_one_that_nobody_takes_up_lapses_and_is_told_once() -> None:
    fleet = Fleet()
    fleet.send(RcJoined("robot/a", sharable=False))
    one = Booking("b", {"robot/a": {}}, 0, 10, 10, 5, 0)
    fleet.send(Booked(one))
    fleet.until(30)
    told = [effect for effect in fleet.effects if isinstance(effect, BookingChanged)]
    assert told == [BookingChanged("b", BookingState.LAPSED)]
    assert not [effect for effect in fleet.effects if isinstance(effect, Granted)]


def test_a_sharable_rc_that_refuses_is_told_before_the_date_and_asked_when_its_rules_change() -> None:
    fleet = Fleet()
    fleet.send(RcJoined(RADIO, sharable=True))
    one = Booking("one", {RADIO: {"rate": Fraction(3)}}, 0, 10, 10, 5, 0)
    two = structs.replace(one, id="two", since=1)
    fleet.send(Booked(one))
    assert not fleet.slots(two, 10, 1)
    fleet.send(Booked(two))
    danger = fleet.dangers["two"]
    assert danger is not None
    assert (danger.code, danger.rcs, danger.by[0].arc) == (ReasonCode.VETOED, (RADIO,), "one")
    (asked,) = (
        effect for effect in fleet.core.handle(1, RcReported(RADIO, rules_changed=True)) if type(effect) is Propose
    )
    assert asked.holders.keys() == {"one", "two"}
    relieved = fleet.core.handle(2, Vote(asked.proposal, accept=True))
    assert BookingThreatened("two", None) in relieved
    assert "one" not in fleet.dangers


def test_a_date_that_runs_is_in_the_way_where_it_is_and_not_where_it_was_to_be() -> None:
    fleet = Fleet()
    fleet.send(*(RcJoined(rc, sharable=False) for rc in ROBOTS[:2]))
    first = Booking("first", {"robot/*": {}}, 0, 10, 10, 5, 0, {"robot/*": "robot/a"})
    fleet.send(Booked(first))
    fleet.until(10)
    fleet.send(
        Requested(ArcRequest("operator", "h/operator", {"robot/a": {}}, 9, 30)),
        Requested(ArcRequest("taker", "h/taker", first.needs, 0, 10, booking="first")),
    )
    status = fleet.core.booking("first")
    assert status is not None
    assert (status.arc, status.bound) == ("taker", {"robot/*": "robot/b"})
    others = [Booking(rc, {rc: {}}, 0, 10, 10, 5, 1) for rc in ROBOTS[:2]]
    fits = [bool(fleet.slots(one, 10, 1, bookings_only=True)) for one in others]
    fleet.send(*map(Booked, others))
    by_id = {one.id: one for one in (first, *others)}

    def losers(*order: str) -> dict[str, str | None]:
        came = fleet.send(Dates(tuple(by_id[name] for name in order)))
        return {effect.booking: effect.by for effect in came if isinstance(effect, BookingConflict)}

    # What it has for a pattern it loses to nobody: it runs.
    found = losers(*ROBOTS[:2], "first"), losers("first", *ROBOTS[:2])
    assert (fits, *found) == ([True, False], {}, {"robot/b": "first"})

"""The dates that stand, judged again only where something has changed, are those that a look at all of them finds; and
an instant of the core is short, however much is booked."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any

import pytest
from msgspec import structs

from tests.scheduling.seeds import in_parts
from tests.scheduling.test_bookings import CAPACITY, RADIO, ROBOTS, Fleet, needs, vote
from tests.thorough import times
from zscout.scheduling import calendar
from zscout.scheduling.adaptive import Adaptive
from zscout.scheduling.booking import Booking, BookingBound, BookingConflict, BookingThreatened, Dates
from zscout.scheduling.capacity import excess
from zscout.scheduling.claim_index import ClaimIndex
from zscout.scheduling.core import Core
from zscout.scheduling.forecast import play_instant
from zscout.scheduling.model import (
    ArcRequest,
    Claim,
    Effect,
    Event,
    Granted,
    LeadTaken,
    Propose,
    RcJoined,
    RcLost,
    Released,
    Requested,
    Tick,
    Vote,
    VoteOverdue,
    WakeAt,
)
from zscout.scheduling.reservations import Reservations
from zscout.types import SECOND, Ns, Term


def booking(draw: random.Random, number: int, now: Ns, *, patterns: bool = False) -> Booking:
    closed = draw.random() < 0.15
    wanted = {rc: {} for rc in draw.sample(ROBOTS, 1)} if closed else needs(draw, patterns=patterns)
    start, runtime = now + draw.randint(100, 160), draw.randint(1, 20)
    return Booking(f"d{number}", wanted, 0, start, runtime, 10, now, owner="h", maintenance=closed)


def meets(one: Booking, other: Booking) -> bool:
    both = one.maintenance and other.maintenance
    return not both and one.start < other.end and other.start < one.end


def standing(ranked: Sequence[Booking], present: set[str]) -> set[str]:
    """Each stands that those of higher rank which stand leave room for."""
    stands: list[Booking] = []
    for one in ranked:
        beside = {rc: [other for other in stands if rc in other.needs and meets(one, other)] for rc in one.needs}
        if not any(rc in present and others and is_full(rc, one, others) for rc, others in beside.items()):
            stands.append(one)
    return {one.id for one in stands}


def is_full(rc: str, one: Booking, others: list[Booking]) -> bool:
    if rc != RADIO or one.maintenance or any(other.maintenance for other in others):
        return True
    for time in {one.start, *(other.start for other in others)}:
        there = [other for other in (one, *others) if other.start <= time < other.end]
        if one.start <= time < one.end and excess(CAPACITY, [(other.id, other.needs[rc]) for other in there]):
            return True
    return False


@pytest.mark.parametrize("seeds", in_parts(range(times(1_000)), quick=30, size=250))
def test_the_dates_that_stand_are_those_of_a_look_at_all(seeds: Sequence[int]) -> None:
    lost = back = 0
    for seed in seeds:
        draw = random.Random(f"calendar {seed}")  # noqa: S311
        fleet, ranked = Fleet(), list[Booking]()
        fleet.send(*(RcJoined(rc, sharable=False) for rc in ROBOTS), RcJoined(RADIO, sharable=True))
        present = {*ROBOTS, RADIO}
        conflicts: set[str] = set()
        for number in range(25):
            fleet.until(fleet.now + draw.randint(0, 2))
            what, events = draw.random(), list[Event]()
            if what < 0.6:
                ranked.insert(draw.randint(0, len(ranked)), booking(draw, number, fleet.now))
            elif what < 0.8 and ranked:
                del ranked[draw.randrange(len(ranked))]
            elif what < 0.85 and ranked:
                by = draw.randint(-20, 20)
                at = draw.randrange(len(ranked))
                ranked[at] = structs.replace(ranked[at], start=ranked[at].start + by)
            elif what < 0.9 and ranked:
                one = draw.choice(ranked)
                if not one.maintenance:
                    request = ArcRequest(f"a{number}", "h/c", one.needs, 0, one.runtime, booking=one.id)
                    events = [Requested(request)]
            else:
                rc = draw.choice(ROBOTS)
                events = [RcLost(rc) if rc in present else RcJoined(rc, sharable=False)]
                present ^= {rc}
            # What an absent RC is, is not known: what is decided once it is back.
            came = fleet.send(*events, Dates(tuple(ranked)))
            for effect in came:
                if isinstance(effect, BookingConflict):
                    lost, back = lost + (effect.by is not None), back + (effect.by is None)
                    conflicts = conflicts | {effect.booking} if effect.by is not None else conflicts - {effect.booking}
            conflicts &= {one.id for one in ranked}
            known = {one.id for one, _ in fleet.core.bookings()}
            assert known | conflicts == {one.id for one in ranked}, (seed, number)
            assert not known & conflicts
            if present == {*ROBOTS, RADIO}:
                assert known == standing(ranked, present), (seed, number)
    assert lost > len(seeds)
    assert back > len(seeds) // 4


@pytest.mark.parametrize("seeds", in_parts(range(times(1_000)), quick=30, size=250))
def test_a_date_by_pattern_is_in_conflict_only_where_no_rc_is_free(seeds: Sequence[int]) -> None:
    bound = 0
    for seed in seeds:
        draw = random.Random(f"patterns {seed}")  # noqa: S311
        fleet, ranked = Fleet(), list[Booking]()
        fleet.send(*(RcJoined(rc, sharable=False) for rc in ROBOTS), RcJoined(RADIO, sharable=True))
        for number in range(20):
            if draw.random() < 0.75 or not ranked:
                ranked.insert(draw.randint(0, len(ranked)), booking(draw, number, fleet.now, patterns=True))
            else:
                del ranked[draw.randrange(len(ranked))]
            came = fleet.send(Dates(tuple(ranked)))
            bound += sum(isinstance(effect, BookingBound) for effect in came)
            stands = [one for one, _ in fleet.core.bookings()]
            rank = {one.id: at for at, one in enumerate(ranked)}
            for one in stands:
                mine = {one.bound.get(need, need) for need in one.needs}
                assert not {need for need in mine if need.startswith("robot/*")}
                for other in stands:
                    its = {other.bound.get(need, need) for need in other.needs}
                    if rank[one.id] < rank[other.id] and meets(one, other):
                        assert not mine & its - {RADIO}, (seed, one, other)
            for one in ranked:
                if fleet.core.booking(one.id) is not None or RADIO in one.needs:
                    continue
                if one.maintenance:  # its time is never searched for
                    before = (other for other in stands if rank[other.id] < rank[one.id] and meets(one, other))
                    assert any({*one.needs} & {other.bound.get(need, need) for need in other.needs} for other in before)
                else:
                    assert not fleet.slots(one, one.start, 1, bookings_only=True), (seed, number, one)
    assert bound > len(seeds)


def many(number: int, rc: str = RADIO, *, apart: Ns = 3_600 * SECOND) -> tuple[Booking, ...]:
    """Dates of which each overlaps the next."""
    day, length = 86_400 * SECOND, apart * 3 // 2
    wanted = {rc: {"rate": Fraction(1)}}
    return tuple(Booking(f"d{at}", wanted, 0, day + at * apart, length, SECOND, at, owner="h") for at in range(number))


def led(number: int) -> tuple[Core, list[Effect]]:
    core = Core(Adaptive())
    joined = [RcJoined(RADIO, sharable=True), RcJoined("robot/a", sharable=False)]
    return core, core.handle(0, *joined, Dates(many(number)), LeadTaken(Term(1, "x")))


def test_dates_that_come_in_parts_are_judged_once_all_are_there() -> None:
    dates = many(300, "robot/a", apart=SECOND)  # each overlaps the next: every other one stands
    core = Core(Adaptive())
    for at in range(0, 300, 100):
        assert not core.handle(0, Dates(dates[at : at + 100], more=True))
    effects = play(core, RcJoined("robot/a", sharable=False), Dates(dates), LeadTaken(Term(1, "x")))
    assert [one.id for one, _ in core.bookings()] == [one.id for one in dates[::2]]
    assert sum(isinstance(effect, BookingConflict) for effect in effects) == 150
    whole = Core(Adaptive())
    assert effects == play(whole, RcJoined("robot/a", sharable=False), Dates(dates), LeadTaken(Term(1, "x")))


def play(core: Core, *events: Event) -> list[Effect]:
    """All but the wakes of one instant."""
    effects = [effect for batch in play_instant(core, 0, events, vote) for effect in batch]
    return [effect for effect in effects if not isinstance(effect, WakeAt)]


def test_an_rc_is_asked_about_few_sets_at_a_time_and_a_grant_waits_for_none() -> None:
    core, effects = led(400)
    open_, asked, most, instants = list[Propose](), 0, 0, 0
    effects = core.handle(0, Requested(ArcRequest("first", "h/c", {"robot/a": {}}, 0, SECOND)))
    assert any(isinstance(effect, Granted) for effect in effects)
    while True:
        instants += 1
        open_ += [effect for effect in effects if isinstance(effect, Propose)]
        most = max(most, len(open_))
        if open_:
            asked += 1
            effects = core.handle(0, vote(open_.pop(0)))
        elif WakeAt(0) in effects:
            effects = core.handle(0, Tick())
        else:
            break
    # Each overlaps the one before it.
    assert asked == 399
    assert most <= calendar.MAX_IN_FLIGHT
    assert not [effect for effect in effects if isinstance(effect, (BookingThreatened, BookingConflict))]


def test_a_silent_rc_is_asked_again_at_times_and_its_dates_stand() -> None:
    core, effects = led(4)
    now: Ns = 0
    wake: Ns | None = None
    for round_ in range(5):
        asked = [effect for effect in effects if isinstance(effect, Propose)]
        assert len(asked) == (3 if round_ == 0 else 1)
        effects += core.handle(now + SECOND // 2, *(VoteOverdue(one.proposal) for one in asked))
        wake = next((effect.at for effect in reversed(effects) if isinstance(effect, WakeAt)), wake)
        assert wake == now + SECOND + (SECOND // 2 if round_ == 0 else 0), "when it is due"
        now = wake
        effects = core.handle(now, Tick())
    assert len(core.bookings()) == 4
    (last,) = (effect for effect in effects if isinstance(effect, Propose))
    effects = core.handle(now + 1, Vote(last.proposal, accept=True))
    assert len([effect for effect in effects if isinstance(effect, Propose)]) == 2, "the others, once it answers"


def counting(name: str, counted: Counter[str]) -> Callable[..., Any]:
    method = getattr(calendar.Calendar, name)

    def count(*args: Any, **more: Any) -> Any:
        counted[name] += 1
        return method(*args, **more)

    return count


def test_a_change_is_followed_up_where_it_overlaps_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Counted, as an instant beside 1,000 dates must not take longer than beside ten."""
    looked_at = Counter[str]()
    for name in ("_report_danger", "_obstacle"):
        monkeypatch.setattr(calendar.Calendar, name, counting(name, looked_at))
    fleet, dates = Fleet(), many(1_000)
    fleet.send(RcJoined(RADIO, sharable=True), Dates(dates))
    assert max(looked_at.values()) < 10_000
    most: dict[str, int] = {}
    added = structs.replace(dates[500], id="added", start=dates[500].start + SECOND, since=2_000)
    events: dict[str, Event] = {
        "booked": Dates((*dates, added)),
        "asked": Requested(ArcRequest("short", "h/c", {RADIO: {"rate": Fraction(1)}}, 0, 60 * SECOND)),
        "released": Released("short"),
        "unbooked": Dates(dates),
    }
    for name, event in events.items():
        before = sum(looked_at.values())
        fleet.send(event)
        most[name] = sum(looked_at.values()) - before
    assert max(most.values()) < 40, most


def test_an_instant_is_bounded_and_asks_for_the_next(monkeypatch: pytest.MonkeyPatch) -> None:
    checked = Counter[str]()
    monkeypatch.setattr(calendar.Calendar, "_report_danger", counting("_report_danger", checked))
    core = Core(Adaptive())
    effects = core.handle(0, RcJoined("robot/a", sharable=False), Dates(many(2_000, "robot/a", apart=4 * SECOND)))
    core.handle(0, LeadTaken(Term(1, "x")))
    instants = 0
    while WakeAt(0) in (effects := core.handle(0, Tick())):
        instants += 1
        assert checked.total() <= calendar.MAX_CHECKS
        checked.clear()
    assert instants >= 2_000 // calendar.MAX_CHECKS
    assert not [effect for effect in effects if isinstance(effect, BookingThreatened)]


def test_the_first_gap_between_dates_is_found_by_a_look_at_each_once_or_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """A request that fits between none of them was compared with 15 dates at each of them: a second of the leader for
    2,000 dates and one forecast."""
    looked, found = 0, ClaimIndex.booked

    def counted(index: ClaimIndex, *args: Any) -> list[Claim]:
        nonlocal looked
        looked += len(claims := found(index, *args))
        return claims

    monkeypatch.setattr(ClaimIndex, "booked", counted)
    core, hour, count = Core(Adaptive()), 3600 * SECOND, 200
    dates = (
        Booking(f"d{number}", {"robot/a": {}}, 0, (48 + 2 * number) * hour, hour, hour, 0) for number in range(count)
    )
    core.handle(0, RcJoined("robot/a", sharable=False), Dates(tuple(dates)), LeadTaken(Term(1, "x")))
    core.handle(0, Requested(ArcRequest("long", "h/c", {"robot/a": {}}, 0, 50 * hour)))
    core.handle(24 * hour, Tick())
    looked = 0
    assert Reservations(core._state).starts == [(48 + 2 * count - 1) * hour]
    assert count <= looked < 2 * count


@pytest.mark.parametrize("by", [10 * SECOND, -3 * SECOND], ids=["put back", "put forward"])
def test_the_date_of_an_absent_booking_follows_a_step_of_the_clock(by: Ns) -> None:
    """A leader that restarted alone may go by a wrong clock at first, and may not know of the booking."""
    core = Core(Adaptive())
    mine = ArcRequest("mine", "h/c", {"robot/a": {}}, 0, SECOND, booking="b@5", not_before=5 * SECOND)
    core.handle(0, RcJoined("robot/a", sharable=False), LeadTaken(Term(1, "x")), Requested(mine))
    core.handle(SECOND, Dates((), moved=by))
    before = core.handle(5 * SECOND + by - 1, Tick())
    assert not [effect for effect in before if isinstance(effect, Granted)]
    assert [effect.arc for effect in core.handle(5 * SECOND + by, Tick()) if isinstance(effect, Granted)] == ["mine"]

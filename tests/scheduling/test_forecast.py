"""The forecast is the core itself, played forward: what it foretells is what comes, if nothing else does."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import chain
from typing import Any

import pytest
from hypothesis import given, settings
from msgspec import structs

from tests.scheduling.seeds import in_parts
from tests.scheduling.test_bookings import POLICY, ROBOTS, booking, maintenance, vote
from tests.scheduling.test_calendar import counting
from tests.scheduling.workloads import voter, workloads
from tests.thorough import times
from zscout.scheduling import calendar
from zscout.scheduling import forecast as forecasts
from zscout.scheduling.adaptive import Adaptive
from zscout.scheduling.booking import Booked, Booking, Dates
from zscout.scheduling.core import Core
from zscout.scheduling.forecast import forecast, play_instant
from zscout.scheduling.model import (
    ArcRequest,
    Event,
    Granted,
    HoldEnded,
    LeadTaken,
    Outcome,
    RcBegins,
    RcJoined,
    Requested,
    Tick,
)
from zscout.simulation.workload import Workload
from zscout.types import SECOND, ArcId, Ns, Params, Term


def request(arc: str, *rcs: str, priority: int = 0, seconds: int = 1, keep: bool = False) -> ArcRequest:
    return ArcRequest(arc, "test/" + arc, {rc: {} for rc in rcs}, priority, seconds * SECOND, keep)


def test_a_newcomer_is_told_whom_it_would_preempt_and_the_core_is_not_touched() -> None:
    core = Core()
    core.handle(0, RcJoined("robot/a", sharable=False), RcJoined("robot/b", sharable=False))
    core.handle(0, Requested(request("mine", "robot/a", seconds=5)))
    core.handle(0, Requested(request("other", "robot/b", seconds=5)))
    before = (core.seq, dict(core._state.running), dict(core._state.queued))
    foretold = forecast(core, SECOND, request("operator", "robot/a", priority=10))
    assert foretold.starts["operator"] == SECOND
    assert foretold.preempts == ["mine"]
    assert foretold.starts["mine"] == 2 * SECOND
    assert before == (core.seq, dict(core._state.running), dict(core._state.queued))


def test_a_kept_hold_is_foretold_to_yield_after_its_time() -> None:
    core = Core()
    core.handle(0, RcJoined("robot/a", sharable=False))
    core.handle(0, Requested(request("kept", "robot/a", seconds=5, keep=True)))
    core.handle(0, Requested(request("next", "robot/a")))
    assert forecast(core, 0).starts == {"next": 5 * SECOND}


def test_starts_are_foretold_with_the_time_that_devices_need_to_begin() -> None:
    core, job = Core(), request("job", "dut/slow", seconds=6)
    core.handle(0, RcJoined("dut/slow", sharable=False, begin_within=20 * SECOND))
    (granted, *_) = core.handle(0, Requested(job))
    assert isinstance(granted, Granted)
    core.handle(0, RcBegins("dut/slow", 20 * SECOND, {granted.grant: 15 * SECOND}))
    core.handle(0, Requested(request("next", "dut/slow", seconds=5)))
    foretold = forecast(core, 0, request("last", "dut/slow", seconds=7))
    assert foretold.starts == {"next": 21 * SECOND, "last": (21 + 20 + 5) * SECOND}
    assert foretold.begin_within == 20 * SECOND
    # It begins sooner than it might have.
    core.handle(3 * SECOND, RcBegins("dut/slow", 20 * SECOND, {granted.grant: None}))
    assert forecast(core, 3 * SECOND).starts == {"next": 9 * SECOND}


@settings(max_examples=times(60))
@given(workloads(keep=False))
def test_what_is_foretold_comes(workload: Workload) -> None:
    """After the last arrival, the forecast's starts are those of the run itself."""
    core, wake = Core(), 0
    starts: dict[ArcId, Ns] = {}

    def step(now: Ns, *events: Event) -> None:
        for effect in chain.from_iterable(play_instant(core, now, events, voter(workload))):
            if isinstance(effect, Granted):
                starts.setdefault(effect.arc, effect.start)
            elif isinstance(effect, HoldEnded):
                assert effect.outcome in (Outcome.COMPLETED, Outcome.PREEMPTED)

    step(0, *(RcJoined(rc.name, rc.sharable) for rc in workload.rcs))
    for arrival in sorted(workload.arrivals, key=lambda arrival: arrival.at):
        # Ends that fall before an arrival come one by one, as they would.
        while (ends := ends_of(core)) and min(ends) < arrival.at:
            step(min(ends), Tick())
        wake = arrival.at
        step(arrival.at, Requested(arrival.request))
    # Only votes that were asked before can be foretold; where one is still unknown, a yes is assumed.
    if any(rc.sharable for rc in workload.rcs):
        return
    foretold = forecast(core, wake).starts
    starts.clear()
    while ends := ends_of(core):
        step(min(ends), Tick())
    assert foretold == starts


def ends_of(core: Core) -> list[Ns]:
    return [arc.hold.end for arc in core._state.running.values() if arc.hold is not None]


def test_many_bookings_bound_how_far_is_looked(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each instant costs more with them: the leader stood still for seconds, and others led."""
    played = 0

    def counted(core: Core, *args: Any) -> Iterator[Any]:
        nonlocal played
        played += 1
        return play_instant(core, *args)

    monkeypatch.setattr(forecasts, "play_instant", counted)
    core = Core(Adaptive())
    core.handle(0, RcJoined("robot/a", sharable=False))
    core.handle(
        0, *(Booked(Booking(f"b{n}", {"robot/a": {}}, 0, n * SECOND, SECOND // 2, 0, 0)) for n in range(1, 1000))
    )
    never = request("never", "robot/a", "robot/b")
    assert "never" not in forecast(core, 0, never).starts
    assert played < 500


def test_bookings_and_maintenance_are_played_through() -> None:
    core = Core(Adaptive())
    core.handle(0, *(RcJoined(f"robot/{name}", sharable=False) for name in "abc"))
    core.handle(0, Requested(request("kept", "robot/a", seconds=2, keep=True)))
    core.handle(0, Booked(Booking("m", {"robot/a": {}}, 10, 5 * SECOND, 20 * SECOND, 0, 0, maintenance=True)))
    core.handle(0, Booked(Booking("b", {"robot/b": {}}, 0, 9 * SECOND, 5 * SECOND, SECOND, 0)))
    core.handle(0, Booked(Booking("late", {"robot/c": {}}, 0, 0, 20 * SECOND, 7 * SECOND, 0)))
    core.handle(0, Requested(request("afterwards", "robot/a", priority=-1, seconds=3)))
    core.handle(0, Requested(request("behind", "robot/b", seconds=10)))
    core.handle(0, Requested(request("lapsed", "robot/c", seconds=30)))
    foretold = forecast(core, SECOND)
    assert foretold.starts["afterwards"] == 25 * SECOND
    assert foretold.starts["behind"] == 14 * SECOND
    assert foretold.starts["lapsed"] == 7 * SECOND
    # And so it comes; of whom nobody takes up nothing is in the way once it has lapsed.
    starts = {
        effect.arc: at
        for at in range(2 * SECOND, 26 * SECOND, SECOND)
        for effect in core.handle(at, Tick())
        if isinstance(effect, Granted)
    }
    assert starts == {"afterwards": 25 * SECOND, "behind": 10 * SECOND, "lapsed": 7 * SECOND}


@pytest.mark.parametrize("seeds", in_parts(range(times(100)), quick=2, size=50))
def test_dates_that_the_copy_gets_as_they_come_near_change_nothing(
    seeds: Sequence[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of RCs by name without votes: what a vote or a pattern adds is an estimate in both."""
    asked = foretold = 0
    for seed in seeds:
        draw, core = random.Random(f"near {seed}"), Core(Adaptive(), POLICY)  # noqa: S311
        dates = [
            structs.replace(
                made := make(draw, number, 0),
                start=draw.randint(1, 600),
                needs={need: {} for need in made.needs if need in ROBOTS} or {"robot/a": {}},
            )
            for number, make in enumerate([booking] * 40 + [maintenance] * 2)
        ]
        joined = [RcJoined(rc, sharable=False) for rc in ROBOTS]
        chain_of(core, 0, *joined, Dates(tuple(dates)), LeadTaken(Term(1, "x")))
        for now in range(1, 61):
            chain_of(core, now, Tick())
            if draw.random() < 0.8:
                continue
            wanted: dict[str, Params] = {rc: {} for rc in draw.sample(ROBOTS, draw.randint(1, 2))}
            new = ArcRequest(f"a{now}", "h/c", wanted, draw.randint(0, 2), draw.randint(1, 20), draw.random() < 0.2)
            found = forecast(core, now, new)
            with monkeypatch.context() as patched:
                patched.setattr(forecasts, "LOOKAHEAD", 10**6)
                assert forecast(core, now, new) == found, (seed, now)
            chain_of(core, now, Requested(new))
            asked, foretold = asked + 1, foretold + len(found.starts)
    assert foretold > asked


def chain_of(core: Core, now: Ns, *events: Event) -> None:
    for _ in play_instant(core, now, events, vote):
        pass


@pytest.mark.parametrize(
    ("seconds", "entered", "begun"),
    [
        pytest.param(60, 4, 0, id="a request that starts at once"),
        pytest.param(4_000_000, 500, 250, id="one that fits between no two dates"),
    ],
)
def test_a_forecast_beside_many_dates_is_short(
    seconds: int, entered: int, begun: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Counted: dates that the copy gets, and dates that begin in it; 2,000 were copied for each forecast."""
    done = Counter[str]()
    for name in ("book", "take_up"):
        monkeypatch.setattr(calendar.Calendar, name, counting(name, done))
    core, hour = Core(Adaptive()), 3600 * SECOND
    dates = [Booking(f"d{n}", {"robot/a": {}}, 0, (24 + 2 * n) * hour, hour, hour, 0) for n in range(500)]
    core.handle(0, RcJoined("robot/a", sharable=False), Dates(tuple(dates)), LeadTaken(Term(1, "x")))
    done.clear()
    forecast(core, SECOND, request("new", "robot/a", seconds=seconds))
    assert done["book"] <= entered
    assert done["take_up"] <= begun

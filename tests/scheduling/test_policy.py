"""What a fleet may choose: who takes from whom, and how much of it one host may have."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable

import pytest
from msgspec import structs

from tests.scheduling.invariants import Ledger
from tests.scheduling.test_waiting import changed, workload
from tests.scheduling.validate import validate
from tests.scheduling.workloads import voter
from tests.thorough import times
from zscout.config.scheduling_policy import RcQuota, SchedulingPolicy, StrategyName
from zscout.scheduling.booking import Booking, Dates
from zscout.scheduling.core import Core
from zscout.scheduling.forecast import play_instant
from zscout.scheduling.model import (
    ArcRequest,
    Effect,
    Event,
    Granted,
    HandedOver,
    HoldEnded,
    LeadTaken,
    Outcome,
    RcJoined,
    RecoveredHold,
    Released,
    Requested,
    Tick,
    WakeAt,
)
from zscout.scheduling.strategies import STRATEGIES
from zscout.simulation.replay import replay
from zscout.simulation.workload import Arrival, Workload, WorkloadRc
from zscout.types import SECOND, Grant, Ns, Place, Term

ALL: tuple[StrategyName, ...] = ("priority", "optimal", "adaptive")
PATIENCE = 6 * SECOND


def request(arc: str, *rcs: str, priority: int = 1, seconds: int = 10, host: str = "h") -> ArcRequest:
    return ArcRequest(arc, f"{host}/c", {rc: {} for rc in rcs}, priority, seconds * SECOND)


def core_of(strategy: StrategyName, policy: SchedulingPolicy, *rcs: str) -> Core:
    core = Core(STRATEGIES[strategy](), policy)
    core.handle(0, *(RcJoined(rc, sharable=False) for rc in rcs))
    return core


def running(core: Core) -> set[str]:
    return set(core._state.running)


@pytest.mark.parametrize("strategy", ALL)
def test_a_protected_hold_ends_for_an_operator_only(strategy: StrategyName) -> None:
    core = core_of(strategy, SchedulingPolicy(preempt="after_min_runtime"), "robot/a")
    core.handle(0, Requested(request("low", "robot/a")))
    core.handle(SECOND, Requested(request("high", "robot/a", priority=9)))
    assert running(core) == {"low"}
    core.handle(2 * SECOND, Requested(request("operator", "robot/a", priority=10, seconds=3)))
    assert running(core) == {"operator"}
    core.handle(5 * SECOND, Tick())
    assert running(core) == {"high"}
    core.handle(15 * SECOND, Tick())
    assert running(core) == {"low"}


@pytest.mark.parametrize("strategy", ALL)
def test_a_protected_hold_that_is_kept_yields_after_its_time(strategy: StrategyName) -> None:
    core = core_of(strategy, SchedulingPolicy(preempt="after_min_runtime"), "robot/a")
    core.handle(0, Requested(ArcRequest("kept", "h/c", {"robot/a": {}}, 1, 10 * SECOND, keep=True)))
    core.handle(
        SECOND, Requested(request("high", "robot/a", priority=5)), Requested(request("low", "robot/a", priority=0))
    )
    assert running(core) == {"kept"}
    core.handle(10 * SECOND, Tick())
    assert running(core) == {"high"}


@pytest.mark.parametrize("strategy", ["optimal", "adaptive"])
def test_what_an_operator_leaves_is_not_taken_for_another(strategy: StrategyName) -> None:
    """The protected hold of two RCs ends for an operator only if it must: beside an operator on another RC
    it stays, though the one of priority 9 would be worth more."""
    core = core_of(strategy, SchedulingPolicy(preempt="after_min_runtime"), "robot/a", "robot/b", "robot/c")
    core.handle(0, Requested(request("held", "robot/a", "robot/b")))
    effects = core.handle(
        SECOND,
        Requested(request("nine", "robot/b", "robot/c", priority=9)),
        Requested(request("operator", "robot/c", priority=10)),
    )
    assert running(core) == {"held", "operator"}
    assert not any(isinstance(effect, HoldEnded) for effect in effects)


def test_protection_outlives_the_rcm() -> None:
    core, _ = inherited(SchedulingPolicy(preempt="after_min_runtime"), SECOND, request("low", "robot/a"))
    core.handle(2 * SECOND, Requested(request("high", "robot/a", priority=5)))
    assert running(core) == {"low"}


@pytest.mark.parametrize("strategy", ALL)
def test_nobody_is_ever_preempted_in_a_protected_fleet(strategy: StrategyName) -> None:
    policy = SchedulingPolicy(preempt="after_min_runtime", patience=PATIENCE)
    for seed in range(times(20)):
        work = _with_priorities(workload(seed), random.Random(seed), highest=9)  # noqa: S311
        ledger = Ledger(work.rcs, [one.request for one in work.arrivals])
        played = replay(work, ledger.take, strategy=STRATEGIES[strategy](), policy=policy)
        assert not played.unserved, seed
        assert {hold.outcome for hold in played.holds} == {Outcome.COMPLETED}, seed


def test_a_low_priority_starves_unless_the_fleet_promises_all() -> None:
    """A stream of priority 2, each over when the next but one comes, never leaves both robots free."""
    arrivals = [Arrival(SECOND, request("low", "robot/a", "robot/b", priority=1, seconds=4))]
    for number in range(40):
        rc = f"robot/{'ab'[number % 2]}"
        arrivals.append(Arrival(2 * number * SECOND, request(f"n{number:02}", rc, priority=2, seconds=4)))
    arrivals.sort(key=lambda one: one.at)
    work = Workload((WorkloadRc("robot/a"), WorkloadRc("robot/b")), tuple(arrivals))

    def start(policy: SchedulingPolicy) -> Ns:
        played = replay(work, strategy=STRATEGIES["adaptive"](), policy=policy)
        return next(hold.start for hold in played.holds if hold.arc == "low" and hold.outcome is Outcome.COMPLETED)

    assert start(SchedulingPolicy(patience=PATIENCE)) >= 80 * SECOND
    # Due at 7 s: from 4 s on nobody starts who would still run by then, and nobody takes it back.
    assert start(SchedulingPolicy(patience=PATIENCE, promise="all")) == 6 * SECOND


def test_promise_all_keeps_the_other_promises() -> None:
    for seed in range(times(50)):
        draw = random.Random(seed)  # noqa: S311
        work = _with_priorities(workload(seed), draw, highest=12)
        ledger = Ledger(work.rcs, [one.request for one in work.arrivals])
        policy = SchedulingPolicy(patience=PATIENCE, promise="all", max_running_per_host=draw.choice([None, 1, 2]))
        assert not replay(work, ledger.take, strategy=STRATEGIES["adaptive"](), policy=policy).unserved, seed


@pytest.mark.parametrize("strategy", ALL)
def test_a_host_has_its_quota(strategy: StrategyName) -> None:
    core = core_of(strategy, SchedulingPolicy(max_running_per_host=1), "robot/a", "robot/b", "robot/c")
    core.handle(0, *(Requested(request(f"mine{rc}", f"robot/{rc}", host="greedy")) for rc in "ab"))
    core.handle(0, Requested(request("theirs", "robot/c", host="modest")))
    assert running(core) == {"minea", "theirs"}
    assert str(core._state.queued["mineb"].reason) == "host greedy has reached its quota of running requests: 1"
    core.handle(SECOND, Requested(request("operator", "robot/b", priority=10, host="greedy")))
    assert running(core) == {"minea", "theirs", "operator"}
    core.handle(2 * SECOND, Released("operator"))
    assert running(core) == {"minea", "theirs"}
    core.handle(3 * SECOND, Released("minea"))
    assert running(core) == {"mineb", "theirs"}


def _shared_quota(rcs: int, *owners: str) -> dict[str, tuple[RcQuota, ...]]:
    quota = RcQuota("arms", frozenset(owners), rcs)
    return dict.fromkeys(owners, (quota,))


@pytest.mark.parametrize("strategy", ALL)
def test_a_group_has_its_quota_of_rcs(strategy: StrategyName) -> None:
    policy = SchedulingPolicy(rc_quotas=_shared_quota(2, "ada", "bob"))
    core = core_of(strategy, policy, "robot/a", "robot/b", "robot/c", "robot/d")
    core.handle(0, Requested(request("one", "robot/a", host="ada")), Requested(request("two", "robot/b", host="bob")))
    core.handle(0, Requested(request("third", "robot/c", host="ada")))
    core.handle(0, Requested(request("theirs", "robot/d", host="eve")))
    assert running(core) == {"one", "two", "theirs"}
    assert str(core._state.queued["third"].reason) == "arms may hold 2 devices at one time"
    core.handle(SECOND, Requested(request("operator", "robot/c", priority=10, host="bob")))
    assert running(core) == {"one", "two", "theirs"}
    core.handle(2 * SECOND, Released("two"))
    assert running(core) == {"one", "operator", "theirs"}
    core.handle(3 * SECOND, Released("operator"))
    assert running(core) == {"one", "third", "theirs"}


@pytest.mark.parametrize("strategy", ALL)
@pytest.mark.parametrize(
    "policy",
    [SchedulingPolicy(max_running_per_host=2), SchedulingPolicy(rc_quotas=_shared_quota(4, "h"))],
    ids=["arcs", "rcs"],
)
def test_what_ends_for_the_one_that_continues_it_is_not_in_its_way_by_a_quota(
    strategy: StrategyName, policy: SchedulingPolicy
) -> None:
    """Nobody else would end it."""
    core = core_of(strategy, policy, "robot/a", "robot/b", "robot/c", "robot/d", "fg")
    kept = {
        "watching": request("watching", "robot/a", "fg"),
        "warm": request("warm", "robot/b", priority=0, seconds=1),
        "turn": structs.replace(request("turn", "robot/b", "fg"), continues="warm"),
        # It says the same, and would run beside it.
        "aside": structs.replace(request("aside", "robot/c", "robot/d", priority=0), continues="warm"),
    }
    core.handle(0, *(Requested(structs.replace(one, keep=True)) for one in kept.values()))
    assert running(core) == {"watching", "warm"}
    core.handle(10 * SECOND, Tick())
    assert running(core) == {"turn", "aside"}


def held_by(core: Core, arc: str) -> set[str]:
    known = core.arc(arc)
    return set() if known is None else {*known.needs}


@pytest.mark.parametrize("strategy", ALL)
def test_a_pattern_is_met_by_no_rc_that_its_owner_may_not_hold(strategy: StrategyName) -> None:
    policy = SchedulingPolicy(barred={"bob": ("robot/arm$*",)})
    core = core_of(strategy, policy, "robot/arm1", "robot/scout1")
    core.handle(
        0, Requested(request("theirs", "robot/*", host="bob")), Requested(request("more", "robot/*", host="bob"))
    )
    assert running(core) == {"theirs"}
    assert held_by(core, "theirs") == {"robot/scout1"}
    core.handle(SECOND, Requested(request("mine", "robot/*", host="ada")))
    assert held_by(core, "mine") == {"robot/arm1"}


@pytest.mark.parametrize("strategy", ALL)
@pytest.mark.parametrize("of", ["rcs of two hosts", "arcs of each host"])
def test_nobody_ever_has_more_than_the_quota(strategy: StrategyName, of: str) -> None:
    for seed in range(times(20)):
        check_quota(strategy, seed, rcs=of == "rcs of two hosts")


def check_quota(strategy: StrategyName, seed: int, *, rcs: bool) -> None:
    draw = random.Random(seed)  # noqa: S311
    work = changed(workload(seed), lambda one: structs.replace(one, client=f"h{draw.randint(1, 3)}/c"))
    owners = {one.request.arc: one.request.client.partition("/")[0] for one in work.arrivals}
    most = max(len(one.request.needs) for one in work.arrivals) + 1
    held: Counter[str] = Counter()

    def watch(now: Ns, core: Core, effects: list[Effect]) -> None:
        validate(core)
        for effect in effects:
            if isinstance(effect, Granted):
                held[owners[effect.arc]] += len(effect.rcs) if rcs else 1
                assert held["h1"] + held["h2"] <= most if rcs else max(held.values()) <= 2, seed
            elif isinstance(effect, HoldEnded):
                held[owners[effect.arc]] -= len(effect.rcs) if rcs else 1

    policy = SchedulingPolicy(max_running_per_host=2, patience=PATIENCE)
    if rcs:
        policy = SchedulingPolicy(rc_quotas=_shared_quota(most, "h1", "h2"), patience=PATIENCE)
    assert not replay(work, watch, strategy=STRATEGIES[strategy](), policy=policy).unserved, seed


def limited(strategy: StrategyName, *rcs: str, seconds: int = 20) -> Core:
    return core_of(strategy, SchedulingPolicy(max_runtime=seconds * SECOND), *rcs)


def ended(effects: list[Effect]) -> list[tuple[str, Outcome, str, bool]]:
    found = [effect for effect in effects if isinstance(effect, HoldEnded)]
    return [(one.arc, one.outcome, one.reason.code, one.requeued) for one in found]


@pytest.mark.parametrize("strategy", ALL)
def test_the_longest_time_ends_what_is_kept_though_nobody_waits(strategy: StrategyName) -> None:
    core = limited(strategy, "robot/a")
    core.handle(SECOND, Requested(structs.replace(request("kept", "robot/a", priority=11), keep=True)))
    assert not ended(core.handle(11 * SECOND, Tick()))
    wakes = [effect.at for effect in core.handle(12 * SECOND, Tick()) if isinstance(effect, WakeAt)]
    assert not wakes, "it was told already when to wake"
    assert core._wake == 21 * SECOND
    assert not ended(core.handle(21 * SECOND - 1, Tick()))
    assert ended(core.handle(21 * SECOND, Tick())) == [("kept", Outcome.COMPLETED, "limit", False)]
    assert running(core) == set()


@pytest.mark.parametrize("strategy", ALL)
def test_nobody_is_given_more_than_the_longest_time(strategy: StrategyName) -> None:
    core = limited(strategy, "robot/a")
    core.handle(0, Requested(request("long", "robot/a", seconds=60)), Requested(request("next", "robot/a", seconds=30)))
    effects = core.handle(20 * SECOND, Tick())
    assert ended(effects) == [("long", Outcome.COMPLETED, "limit", False)]
    assert running(core) == {"next"}


def booked(name: str, start: int, seconds: int, rc: str = "robot/a") -> Booking:
    """`start`: seconds after the beginning of the story."""
    return Booking(name, {rc: {}}, 1, start * SECOND, seconds * SECOND, SECOND, 0, owner="h")


def inherited(
    policy: SchedulingPolicy, now: Ns, wanted: ArcRequest, start: Ns = 0, *known: Event
) -> tuple[Core, list[Effect]]:
    """A core that takes the lead now, where this holds since `start`; and what comes of that."""
    core, old = Core(policy=policy), Term(1, "rcm/a")
    stands = RecoveredHold(wanted, Place(old, 1), Grant(old, 1), start, start + wanted.min_runtime)
    return core, core.handle(now, RcJoined("robot/a", sharable=False), *known, LeadTaken(Term(2, "rcm/b"), (stands,)))


def test_the_longest_time_is_counted_from_the_beginning_of_the_hold_whoever_leads_and_has_it() -> None:
    kept = structs.replace(request("kept", "robot/a"), keep=True)
    core, _ = inherited(SchedulingPolicy(max_runtime=20 * SECOND), 16 * SECOND, kept, 5 * SECOND)
    core.handle(17 * SECOND, HandedOver("kept", "h/other", "moved"))
    assert not ended(core.handle(25 * SECOND - 1, Tick()))
    assert ended(core.handle(25 * SECOND, Tick())) == [("moved", Outcome.COMPLETED, "limit", False)]


def test_a_hold_that_is_too_long_already_ends_with_the_first_who_says_so() -> None:
    policy = SchedulingPolicy(max_runtime=20 * SECOND)
    _, effects = inherited(policy, 30 * SECOND, request("long", "robot/a", seconds=60))
    assert ended(effects) == [("long", Outcome.COMPLETED, "limit", False)]


def test_a_booked_hold_lasts_until_its_booking_ends_whoever_leads() -> None:
    policy = SchedulingPolicy(max_runtime=20 * SECOND, max_booking=60 * SECOND)
    core, booking = core_of("adaptive", policy, "robot/a"), booked("b", 10, 60)
    mine = structs.replace(request("mine", "robot/a", seconds=60), booking="b")
    core.handle(0, Dates((booking,)), Requested(mine))
    core.handle(10 * SECOND, Tick())
    assert not ended(core.handle(70 * SECOND - 1, Tick(), Requested(request("rival", "robot/a"))))
    core, _ = inherited(policy, 40 * SECOND, mine, 10 * SECOND, Dates((booking,)))
    assert not ended(core.handle(70 * SECOND - 1, Tick()))
    # The next leader may not know of the booking yet: what the RCs say stands.
    core, _ = inherited(policy, 40 * SECOND, mine, 10 * SECOND)
    assert not ended(core.handle(70 * SECOND - 1, Tick()))
    assert [outcome for _, outcome, _, _ in ended(core.handle(70 * SECOND, Tick()))] == [Outcome.COMPLETED]


def test_a_kept_hold_that_outlasts_its_booking_ends_after_the_longest_time() -> None:
    core = limited("adaptive", "robot/a")
    mine = structs.replace(request("mine", "robot/a"), booking="b", keep=True)
    core.handle(0, Dates((booked("b", 0, 10),)), Requested(mine))
    assert not ended(core.handle(20 * SECOND - 1, Tick()))
    assert ended(core.handle(20 * SECOND, Tick())) == [("mine", Outcome.COMPLETED, "limit", False)]


@pytest.mark.parametrize("strategy", ALL)
def test_no_hold_is_ever_longer_than_the_longest_time(strategy: StrategyName) -> None:
    for seed in range(times(20)):
        check_longest(strategy, seed, longest=2 * SECOND)


def check_longest(strategy: StrategyName, seed: int, longest: Ns) -> None:
    work = changed(
        workload(seed, kept=0.5), lambda one: structs.replace(one, min_runtime=min(one.min_runtime, longest))
    )
    ledger = Ledger(work.rcs, [one.request for one in work.arrivals])
    since: dict[str, Ns] = {}
    reached = 0

    def watch(now: Ns, core: Core, effects: list[Effect]) -> None:
        nonlocal reached
        ledger.take(now, core, effects)
        for effect in effects:
            if isinstance(effect, Granted):
                since[effect.arc] = now
            elif isinstance(effect, HoldEnded):
                assert now - since.pop(effect.arc) <= longest, seed
                reached += effect.reason.code == "limit"
        assert all(now - start < longest for start in since.values()), seed

    # As the RCM does, it looks again when the core says so.
    core = Core(STRATEGIES[strategy](), SchedulingPolicy(patience=PATIENCE, max_runtime=longest))
    play(core, work, watch)
    assert reached, seed
    assert not core._state.queued, seed


def play(core: Core, work: Workload, watch: Callable[[Ns, Core, list[Effect]], None]) -> None:
    """A workload to its end, by the wakes of the core alone."""
    events: list[Event] = [RcJoined(rc.name, rc.sharable) for rc in work.rcs]
    left, at = sorted(work.arrivals, key=lambda one: one.at), 0
    while events:
        for effects in play_instant(core, at, events, voter(work)):
            watch(at, core, effects)
        at = min([*(one.at for one in left[:1]), *([core._wake] if core._wake is not None else [])], default=at)
        events = [Requested(one.request) for one in left if one.at == at]
        left = [one for one in left if one.at > at]
        if not events and core._state.running:
            events = [Tick()]


def _with_priorities(work: Workload, draw: random.Random, highest: int) -> Workload:
    return changed(work, lambda one: structs.replace(one, priority=draw.randint(highest - 3, highest)))

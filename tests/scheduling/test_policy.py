"""What a fleet may choose: who takes from whom, and how much of it one host may have."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

import pytest
from msgspec import structs

from tests.scheduling.invariants import Ledger
from tests.scheduling.test_waiting import workload
from tests.scheduling.validate import validate
from tests.thorough import times
from zscout.config.scheduling_policy import RcQuota, SchedulingPolicy, StrategyName
from zscout.scheduling.capacity import excess
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
    Propose,
    RcJoined,
    RecoveredHold,
    Released,
    Requested,
    Tick,
    Vote,
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
    core = Core(policy=SchedulingPolicy(preempt="after_min_runtime"))
    term, old = Term(2, "rcm/b"), Term(1, "rcm/a")
    stands = RecoveredHold(request("low", "robot/a"), Place(old, 1), Grant(old, 1), 0, 10 * SECOND)
    core.handle(SECOND, RcJoined("robot/a", sharable=False), LeadTaken(term, (stands,)))
    core.handle(2 * SECOND, Requested(request("high", "robot/a", priority=5)))
    assert running(core) == {"low"}


@pytest.mark.parametrize("strategy", ALL)
@pytest.mark.parametrize("seed", range(times(20)))
def test_nobody_is_ever_preempted_in_a_protected_fleet(strategy: StrategyName, seed: int) -> None:
    draw = random.Random(seed)  # noqa: S311
    work = _with_priorities(workload(seed), draw, highest=9)
    ledger = Ledger(work.rcs, [one.request for one in work.arrivals])

    def watch(now: Ns, core: Core, effects: list[Effect]) -> None:
        ledger.take(now, core, effects)

    played = replay(
        work,
        watch,
        strategy=STRATEGIES[strategy](),
        policy=SchedulingPolicy(preempt="after_min_runtime", patience=PATIENCE),
    )
    assert not played.unserved
    assert {hold.outcome for hold in played.holds} == {Outcome.COMPLETED}


def test_a_low_priority_starves_unless_the_fleet_promises_all() -> None:
    """A stream of priority 2, each over when the next but one comes, never leaves both robots free."""
    arrivals = [Arrival(SECOND, request("low", "robot/a", "robot/b", priority=1, seconds=4))]
    for number in range(40):
        rc = f"robot/{'ab'[number % 2]}"
        arrivals.append(Arrival(2 * number * SECOND, request(f"n{number:02}", rc, priority=2, seconds=4)))
    arrivals.sort(key=lambda one: one.at)
    work = Workload(replay_rcs("robot/a", "robot/b"), tuple(arrivals))

    def start(policy: SchedulingPolicy) -> Ns:
        played = replay(work, strategy=STRATEGIES["adaptive"](), policy=policy)
        return next(hold.start for hold in played.holds if hold.arc == "low" and hold.outcome is Outcome.COMPLETED)

    assert start(SchedulingPolicy(patience=PATIENCE)) >= 80 * SECOND
    # Due at 7 s: from 4 s on nobody starts who would still run by then, and nobody takes it back.
    assert start(SchedulingPolicy(patience=PATIENCE, promise="all")) == 6 * SECOND


@pytest.mark.parametrize("seed", range(times(50)))
def test_promise_all_keeps_the_other_promises(seed: int) -> None:
    draw = random.Random(seed)  # noqa: S311
    work = _with_priorities(workload(seed), draw, highest=12)
    ledger = Ledger(work.rcs, [one.request for one in work.arrivals])

    def watch(now: Ns, core: Core, effects: list[Effect]) -> None:
        ledger.take(now, core, effects)

    policy = SchedulingPolicy(patience=PATIENCE, promise="all", max_running_per_host=draw.choice([None, 1, 2]))
    assert not replay(work, watch, strategy=STRATEGIES["adaptive"](), policy=policy).unserved


@pytest.mark.parametrize("strategy", ALL)
def test_a_host_has_its_quota(strategy: StrategyName) -> None:
    core = core_of(strategy, SchedulingPolicy(max_running_per_host=1), "robot/a", "robot/b", "robot/c")
    core.handle(0, *(Requested(request(f"mine{rc}", f"robot/{rc}", host="greedy")) for rc in "ab"))
    core.handle(0, Requested(request("theirs", "robot/c", host="modest")))
    assert running(core) == {"minea", "theirs"}
    assert str(core._state.queued["mineb"].reason) == "host greedy has 1 requests running, its quota"
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
@pytest.mark.parametrize("seed", range(times(20)))
def test_no_group_ever_holds_more_rcs_than_its_quota(strategy: StrategyName, seed: int) -> None:
    draw = random.Random(seed)  # noqa: S311
    arrivals = tuple(
        Arrival(one.at, _of_host(one.request, f"h{draw.randint(1, 3)}")) for one in workload(seed).arrivals
    )
    work = Workload(workload(seed).rcs, arrivals)
    owners = {one.request.arc: one.request.client.partition("/")[0] for one in arrivals}
    most = max(len(one.request.needs) for one in arrivals) + 1
    held: Counter[str] = Counter()

    def watch(now: Ns, core: Core, effects: list[Effect]) -> None:
        validate(core)
        for effect in effects:
            if isinstance(effect, Granted):
                held[owners[effect.arc]] += len(effect.rcs)
                assert held["h1"] + held["h2"] <= most
            elif isinstance(effect, HoldEnded):
                held[owners[effect.arc]] -= len(effect.rcs)

    policy = SchedulingPolicy(rc_quotas=_shared_quota(most, "h1", "h2"), patience=PATIENCE)
    assert not replay(work, watch, strategy=STRATEGIES[strategy](), policy=policy).unserved


@pytest.mark.parametrize("strategy", ALL)
@pytest.mark.parametrize("seed", range(times(20)))
def test_no_host_ever_has_more_than_its_quota(strategy: StrategyName, seed: int) -> None:
    draw = random.Random(seed)  # noqa: S311
    arrivals = tuple(
        Arrival(one.at, _of_host(one.request, f"h{draw.randint(1, 3)}")) for one in workload(seed).arrivals
    )
    work = Workload(workload(seed).rcs, arrivals)
    owners = {one.request.arc: one.request.client.partition("/")[0] for one in arrivals}
    counts: Counter[str] = Counter()

    def watch(now: Ns, core: Core, effects: list[Effect]) -> None:
        validate(core)
        for effect in effects:
            if isinstance(effect, Granted):
                counts[owners[effect.arc]] += 1
                assert counts[owners[effect.arc]] <= 2
            elif isinstance(effect, HoldEnded):
                counts[owners[effect.arc]] -= 1

    policy = SchedulingPolicy(max_running_per_host=2, patience=PATIENCE)
    assert not replay(work, watch, strategy=STRATEGIES[strategy](), policy=policy).unserved


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


def test_the_longest_time_is_counted_from_the_beginning_of_the_hold_whoever_leads_and_has_it() -> None:
    core = Core(policy=SchedulingPolicy(max_runtime=20 * SECOND))
    term, old = Term(2, "rcm/b"), Term(1, "rcm/a")
    kept = structs.replace(request("kept", "robot/a"), keep=True)
    stands = RecoveredHold(kept, Place(old, 1), Grant(old, 1), 5 * SECOND, 15 * SECOND)
    core.handle(16 * SECOND, RcJoined("robot/a", sharable=False), LeadTaken(term, (stands,)))
    core.handle(17 * SECOND, HandedOver("kept", "h/other", "moved"))
    assert not ended(core.handle(25 * SECOND - 1, Tick()))
    assert ended(core.handle(25 * SECOND, Tick())) == [("moved", Outcome.COMPLETED, "limit", False)]


def test_a_hold_that_is_too_long_already_ends_with_the_first_who_says_so() -> None:
    core = Core(policy=SchedulingPolicy(max_runtime=20 * SECOND))
    term, old = Term(2, "rcm/b"), Term(1, "rcm/a")
    stands = RecoveredHold(request("long", "robot/a", seconds=60), Place(old, 1), Grant(old, 1), 0, 60 * SECOND)
    effects = core.handle(30 * SECOND, RcJoined("robot/a", sharable=False), LeadTaken(term, (stands,)))
    assert ended(effects) == [("long", Outcome.COMPLETED, "limit", False)]


@pytest.mark.parametrize("strategy", ALL)
@pytest.mark.parametrize("seed", range(times(20)))
def test_no_hold_is_ever_longer_than_the_longest_time(strategy: StrategyName, seed: int) -> None:
    work = workload(seed, kept=0.5)
    longest = 2 * SECOND
    arrivals = tuple(replace(one, request=_shorter(one.request, longest)) for one in work.arrivals)
    ledger = Ledger(work.rcs, [one.request for one in arrivals])
    since: dict[str, Ns] = {}
    reached = 0

    def watch(now: Ns, core: Core, effects: list[Effect]) -> None:
        nonlocal reached
        ledger.take(now, core, effects)
        for effect in effects:
            if isinstance(effect, Granted):
                since[effect.arc] = now
            elif isinstance(effect, HoldEnded):
                assert now - since.pop(effect.arc) <= longest
                reached += effect.reason.code == "limit"
        assert all(now - start < longest for start in since.values())

    # As the RCM does, it looks again when the core says so.
    core = Core(STRATEGIES[strategy](), SchedulingPolicy(patience=PATIENCE, max_runtime=longest))
    play(core, Workload(work.rcs, arrivals), watch)
    assert reached
    assert not core._state.queued


def _shorter(one: ArcRequest, longest: Ns) -> ArcRequest:
    return structs.replace(one, min_runtime=min(one.min_runtime, longest))


def play(core: Core, work: Workload, watch: Callable[[Ns, Core, list[Effect]], None]) -> None:
    """A workload to its end, by the wakes of the core alone."""
    capacity = {rc.name: rc.capacity for rc in work.rcs if rc.sharable}

    def vote(asked: Propose) -> Vote:
        return Vote(asked.proposal, accept=not excess(capacity[asked.rc], asked.holders.items()))

    def step(now: Ns, events: list[Event]) -> None:
        for effects in play_instant(core, now, events, vote):
            watch(now, core, effects)

    step(0, [RcJoined(rc.name, rc.sharable) for rc in work.rcs])
    left = sorted(work.arrivals, key=lambda one: one.at)
    while left or core._state.running:
        at = min([*(one.at for one in left[:1]), *([core._wake] if core._wake is not None else [])])
        events: list[Event] = [Requested(one.request) for one in left if one.at == at]
        left = [one for one in left if one.at > at]
        step(at, events or [Tick()])


def replay_rcs(*names: str) -> tuple[WorkloadRc, ...]:
    return tuple(map(WorkloadRc, names))


def _of_host(one: ArcRequest, host: str) -> ArcRequest:
    return ArcRequest(one.arc, f"{host}/c", one.needs, one.priority, one.min_runtime)


def _with_priorities(work: Workload, draw: random.Random, highest: int) -> Workload:
    arrivals = (
        Arrival(
            at.at,
            ArcRequest(
                at.request.arc,
                at.request.client,
                at.request.needs,
                draw.randint(highest - 3, highest),
                at.request.min_runtime,
            ),
        )
        for at in work.arrivals
    )
    return Workload(work.rcs, tuple(arrivals))

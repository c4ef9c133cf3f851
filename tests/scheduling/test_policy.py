"""What a fleet may choose: who takes from whom, and how much of it one host may have."""

from __future__ import annotations

import random
from collections import Counter

import pytest

from tests.scheduling.invariants import Ledger
from tests.scheduling.test_waiting import workload
from tests.scheduling.validate import validate
from tests.thorough import times
from zscout.config.scheduling_policy import SchedulingPolicy, StrategyName
from zscout.lab.replay import replay
from zscout.lab.workload import Arrival, Workload, WorkloadRc
from zscout.scheduling.core import Core
from zscout.scheduling.model import (
    ArcRequest,
    Effect,
    Granted,
    HoldEnded,
    LeadTaken,
    Outcome,
    RcJoined,
    RecoveredHold,
    Released,
    Requested,
    Tick,
)
from zscout.scheduling.strategies import STRATEGIES
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
    assert str(core._state.queued["mineb"].reason) == "host greedy has 1 ARCs running, its quota"
    core.handle(SECOND, Requested(request("operator", "robot/b", priority=10, host="greedy")))
    assert running(core) == {"minea", "theirs", "operator"}
    core.handle(2 * SECOND, Released("operator"))
    assert running(core) == {"minea", "theirs"}
    core.handle(3 * SECOND, Released("minea"))
    assert running(core) == {"mineb", "theirs"}


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

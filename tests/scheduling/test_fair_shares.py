"""Fair shares: accounts against a slow second reckoning, the order that follows, and the promise to those who wait."""

from __future__ import annotations

from collections.abc import Sequence
from random import Random

import pytest
from hypothesis import given, settings
from msgspec import structs

from tests.scheduling import oracle
from tests.scheduling.oracle import SlowShares
from tests.scheduling.seeds import in_parts
from tests.scheduling.test_waiting import changed, check_bound, workload
from tests.scheduling.validate import validate
from tests.scheduling.workloads import workloads
from tests.thorough import times
from zscout.config.scheduling_policy import FairShares, SchedulingPolicy
from zscout.scheduling import fair_shares
from zscout.scheduling.adaptive import Adaptive
from zscout.scheduling.core import Core
from zscout.scheduling.model import (
    ArcRequest,
    Cancelled,
    ClientLost,
    Event,
    HandedOver,
    LeadTaken,
    RcJoined,
    RcLost,
    Released,
    Requested,
    Tick,
)
from zscout.simulation.replay import replay
from zscout.simulation.workload import Arrival, Workload, WorkloadRc
from zscout.types import SECOND, Ns, Params, Term

HOUR: Ns = 3_600 * SECOND
FAIR = FairShares(HOUR, weights={"arms": 2.0}, groups={"bob": "arms", "eve": "arms"})
NEEDS = ("robot/a", "robot/b", "robot/c", "robot/*", "arm/x", "arm/*")
OWNERS = ("bob", "eve", "ada", "ws1")


def core_of(fair: FairShares | None = FAIR, rcs: str = "abc") -> Core:
    core = Core(Adaptive(), SchedulingPolicy(patience=None, fair_shares=fair))
    core.handle(0, *(RcJoined(f"robot/{one}", sharable=False) for one in rcs))
    return core


def ask(arc: str, owner: str, needs: str = "a", runtime: Ns = 100 * SECOND, *, priority: int = 0) -> Requested:
    wanted: dict[str, Params] = {f"robot/{one}": {} for one in needs}
    return Requested(ArcRequest(arc, f"{owner}/c", wanted, priority, runtime))


def running(core: Core) -> set[str]:
    return {*core._state.running}


# Who is charged


def test_only_what_another_group_waits_for_is_charged() -> None:
    core = core_of()
    core.handle(0, ask("one", "bob", "ab"))
    core.handle(10 * SECOND, Tick())
    assert core.charged() == {}, "nobody waits"
    core.handle(10 * SECOND, ask("own", "eve", "a"))
    core.handle(20 * SECOND, Tick())
    assert core.charged() == {}, "its own group waits"
    core.handle(20 * SECOND, ask("other", "ada", "ac"), ask("lower", "ada", "b", priority=-1))
    core.handle(50 * SECOND, Tick())
    assert core.charged() == {"arms": pytest.approx(30, rel=1e-2)}, "robot/a for 30 s, not robot/b for a lower priority"


def test_who_waits_for_what_is_absent_charges_nobody() -> None:
    core = core_of()
    core.handle(0, ask("one", "bob", "a"))
    core.handle(0, ask("other", "ada", "az"))
    core.handle(10 * SECOND, RcJoined("robot/z", sharable=False))
    assert core.charged() == {}
    core.handle(30 * SECOND, RcLost("robot/z"))
    assert core.charged() == {"arms": pytest.approx(20, rel=1e-2)}
    core.handle(60 * SECOND, Tick())
    assert core.charged() == {"arms": pytest.approx(20, rel=1e-1)}


def test_operators_are_not_charged() -> None:
    core = core_of()
    core.handle(0, ask("one", "bob", "a", priority=10))
    core.handle(0, ask("other", "ada", "a", priority=10))
    core.handle(90 * SECOND, Tick())
    assert core.charged() == {}


class Pair:
    """A core and the slow reckoning beside it, in a random run."""

    def __init__(self, seed: int) -> None:
        self.draw, self.now, self.number = Random(seed), 0, 0  # noqa: S311
        self.core, self.slow = core_of(rcs="ab"), SlowShares(FAIR)
        self.rcs = ["robot/a", "robot/b", "robot/c", "arm/x"]

    def step(self) -> None:
        draw, state = self.draw, self.core._state
        self.now += draw.choice((0, SECOND, 40 * SECOND, 600 * SECOND))
        holds = [(arc.request, [rc.name for rc in arc.rcs]) for arc in state.running.values()]
        waiting = [arc.request for arc in state.queued.values()]
        self.slow.pass_time(self.now, holds, waiting, {rc.name for rc in state.rcs.values() if rc.present})
        self.core.handle(self.now, *(self.event() for _ in range(draw.choice((1, 1, 3)))))
        validate(self.core)
        wanted = {
            group: had for group, had in self.slow.charged.items() if had > 1.01 * fair_shares.FORGOTTEN_RC_SECONDS
        }
        told = self.core.charged()
        for group in wanted.keys() | told.keys():
            assert told.get(group, 0) == pytest.approx(wanted.get(group, 0), rel=1e-6, abs=1.1)
        assert state.shares is not None
        positions = {(state.shares.group(arc), arc.position) for arc in state.queued.values()}
        assert len(positions) == len({group for group, _ in positions}), "a group is at two positions"

    def event(self) -> Event:
        draw = self.draw
        arcs = sorted(self.core.arcs())
        what = draw.random()
        if what < 0.5 or not arcs:
            self.number += 1
            wanted: dict[str, Params] = {need: {} for need in draw.sample(NEEDS, draw.randint(1, 3))}
            client = f"{draw.choice(OWNERS)}/{draw.randrange(2)}"
            runtime = draw.randint(1, 900) * SECOND
            keep = draw.random() < 0.3
            return Requested(ArcRequest(f"a{self.number}", client, wanted, draw.randrange(2), runtime, keep))
        if what < 0.7:
            return Released(draw.choice(arcs))
        if what < 0.75:
            return Cancelled(draw.choice(arcs))
        if what < 0.85:
            self.number += 1
            return HandedOver(draw.choice(arcs), f"{draw.choice(OWNERS)}/{draw.randrange(2)}", f"a{self.number}")
        if what < 0.88:
            return ClientLost(f"{draw.choice(OWNERS)}/{draw.randrange(2)}")
        if what < 0.94:
            return RcLost(draw.choice(self.rcs))
        return RcJoined(draw.choice(self.rcs), sharable=False)


@pytest.mark.parametrize("seeds", in_parts(range(times(20)), quick=5, size=15))
def test_accounts_are_those_of_a_slow_reckoning(seeds: Sequence[int]) -> None:
    for seed in seeds:
        pair = Pair(seed)
        for _ in range(150):
            pair.step()
        shares = pair.core._state.shares
        assert shares is not None
        assert sum(shares.totals().values()) > 1_000, "hardly anything was charged"


# The order


@settings(max_examples=times(50))
@given(workloads())
def test_priority_with_fair_shares_is_as_the_slow_one(workload: Workload) -> None:
    """Exclusive RCs, a hundred times as long, each owner a group."""
    fair = FairShares(300 * SECOND)
    arrivals = []
    for number, one in enumerate(workload.arrivals):
        needs: dict[str, Params] = {need: {} for need in one.request.needs}
        runtime, client = 100 * one.request.min_runtime, f"host{number % 3}/c"
        request = structs.replace(one.request, needs=needs, min_runtime=runtime, client=client)
        arrivals.append(Arrival(one.at * 50, request))
    work = Workload(tuple(WorkloadRc(rc.name) for rc in workload.rcs), tuple(arrivals))
    played = replay(work, policy=SchedulingPolicy(fair_shares=fair))
    assert played == oracle.play(work, fair=fair)


@pytest.mark.parametrize(
    ("fair", "first", "reason"),
    [
        (FAIR, "theirs", "waits for theirs: robot/a; by fair shares ada goes first"),
        (None, "short", "waits for short: robot/a"),
    ],
)
def test_the_group_that_had_less_goes_first_and_else_the_shorter(
    fair: FairShares | None, first: str, reason: str
) -> None:
    core = core_of(fair, rcs="a")
    core.handle(0, ask("long", "bob", runtime=200 * SECOND))
    core.handle(0, ask("short", "eve", runtime=10 * SECOND), ask("theirs", "ada", runtime=300 * SECOND))
    core.handle(200 * SECOND, Tick())
    assert running(core) == {first}
    assert [str(one.reason) for one in core.status().queued] == [reason]
    assert bool(core.charged()) is (fair is not None)


def test_the_larger_set_of_another_group_does_not_pass_the_one_that_had_less() -> None:
    core = core_of(rcs="ab")
    core.handle(0, ask("busy", "bob", "ab", 200 * SECOND))
    core.handle(0, ask("theirs", "ada", "a"), ask("wide", "eve", "ab", 10 * SECOND))
    core.handle(200 * SECOND, Tick())
    assert running(core) == {"theirs"}


def test_equal_priority_is_never_preempted_for_its_share() -> None:
    core = core_of(rcs="a")
    core.handle(0, ask("busy", "bob", runtime=HOUR))
    core.handle(0, ask("theirs", "ada", runtime=SECOND))
    core.handle(HOUR - 1, Tick())
    assert running(core) == {"busy"}


def test_weights_say_whose_part_is_larger() -> None:
    for had, first in ((1500.0, "arms"), (2500.0, "ada")):
        core = core_of(rcs="a")
        core.handle(0, LeadTaken(Term(1, "rcm/a"), charged={"arms": 2 * had, "ada": 2000.0}))
        core.handle(0, ask("now", "ws1", runtime=SECOND))
        core.handle(0, ask("one", "bob", runtime=9 * SECOND), ask("two", "ada", runtime=9 * SECOND))
        core.handle(SECOND, Tick())
        assert running(core) == {"one" if first == "arms" else "two"}


def test_another_core_takes_the_accounts_over() -> None:
    core = core_of(rcs="a")
    core.handle(0, ask("busy", "bob", runtime=200 * SECOND))
    core.handle(0, ask("theirs", "ada"))
    core.handle(100 * SECOND, Tick())
    joined, lead = core.as_events(Term(2, "rcm/b"))
    other = Core(Adaptive(), core.policy)
    other.handle(100 * SECOND, *joined, lead)
    for now in (100 * SECOND, 150 * SECOND):
        other.handle(now, Tick())
        core.handle(now, Tick())
        assert other.charged() == pytest.approx(core.charged())


def test_groups_may_change_while_all_goes_on() -> None:
    core = core_of(rcs="a")
    core.handle(0, ask("busy", "bob", runtime=200 * SECOND))
    core.handle(0, ask("theirs", "ada"), ask("own", "eve"))
    core.handle(100 * SECOND, Tick())
    core.policy = SchedulingPolicy(patience=None, fair_shares=FairShares(HOUR, groups={"ada": "arms"}))
    validate(core)
    had = core.charged()
    core.handle(150 * SECOND, Tick())
    assert core.charged()["bob"] == pytest.approx(50, rel=2e-2)
    assert core.charged()["arms"] == pytest.approx(had["arms"], rel=2e-2)
    core.policy = SchedulingPolicy()
    validate(core)
    core.handle(200 * SECOND, Tick())
    assert core.charged() == {}


def test_no_more_accounts_are_kept_than_that(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fair_shares, "MAX_GROUPS", 3)
    core = core_of(rcs="a")
    core.handle(0, LeadTaken(Term(1, "rcm/a"), charged={f"ws{number}": 100.0 + number for number in range(9)}))
    core.handle(HOUR // 4, ask("busy", "bob"))
    core.handle(HOUR // 4, ask("theirs", "ada"))
    assert core.charged().keys() == {"ws8"}, "bob and ada are in use"


# The promise to those who wait


@pytest.mark.parametrize("seeds", in_parts(range(times(1_000)), quick=50, size=475))
def test_nobody_waits_longer_than_promised_whoever_goes_first(
    seeds: Sequence[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fair_shares, "NEAR_RC_SECONDS", 0.1)
    patience, tried, others = 6 * SECOND, 0, 0
    policy = SchedulingPolicy(patience=patience)
    fair = SchedulingPolicy(patience=patience, fair_shares=FairShares(20 * SECOND, patience=3 * patience))
    for seed in seeds:
        draw = Random(seed)  # noqa: S311
        work = workload(seed, kept=(0.0, 0.5)[seed % 2])
        work = changed(work, lambda one: structs.replace(one, client=f"{draw.choice('xyz')}/c"))  # noqa: B023
        played = replay(work, strategy=Adaptive(), policy=fair)
        assert not played.unserved, seed
        tried += check_bound(work, played, patience, 2 * patience)
        others += played.holds != replay(work, strategy=Adaptive(), policy=policy).holds
    assert tried > len(seeds), "hardly anybody had to wait for his patience: these runs prove nothing"
    assert others > len(seeds) / 2, "fair shares hardly changed anything"

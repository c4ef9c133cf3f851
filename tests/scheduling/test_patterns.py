"""Needs by pattern: any one RC that matches will do, under every strategy."""

from __future__ import annotations

import random
from fractions import Fraction
from itertools import chain

import pytest
from msgspec import structs

from tests.scheduling.invariants import Ledger, protection
from tests.scheduling.oracle import Contender, Oracle, bindings
from tests.scheduling.validate import validate
from tests.thorough import times
from zscout.config.scheduling_policy import SchedulingPolicy, StrategyName
from zscout.scheduling.core import Core
from zscout.scheduling.forecast import play_instant
from zscout.scheduling.model import (
    Arc,
    ArcRequest,
    Effect,
    Event,
    Granted,
    HoldEnded,
    LeadTaken,
    Propose,
    RcJoined,
    RcLost,
    RecoveredHold,
    Released,
    Requested,
    Tick,
    Vote,
    VoteOverdue,
)
from zscout.scheduling.needs import check_patterns
from zscout.scheduling.strategies import STRATEGIES
from zscout.simulation.replay import replay
from zscout.simulation.workload import Arrival, Workload, WorkloadRc
from zscout.types import SECOND, Grant, Ns, Params, Place, Term

ALL: tuple[StrategyName, ...] = ("priority", "optimal", "adaptive")
TERM, NEXT = Term(1, "rcm/a"), Term(2, "rcm/b")


def request(arc: str, *needs: str, priority: int = 1, seconds: int = 10, rate: int = 0) -> ArcRequest:
    wanted: dict[str, Params] = {need: {"rate": Fraction(rate)} if need.startswith("radio") else {} for need in needs}
    return ArcRequest(arc, "h/c", wanted, priority, seconds * SECOND)


def core_of(strategy: StrategyName, *rcs: str) -> Core:
    core = Core(STRATEGIES[strategy]())
    core.handle(0, *(RcJoined(rc, sharable=rc.startswith("radio")) for rc in rcs))
    return core


def held(core: Core) -> dict[str, set[str]]:
    return {arc.id: set(arc.needs) for arc in core._state.running.values()}


@pytest.mark.parametrize("strategy", ALL)
def test_any_free_one_will_do(strategy: StrategyName) -> None:
    core = core_of(strategy, "fg/a", "fg/b", "robot/x")
    core.handle(0, Requested(request("first", "fg/a")))
    effects = core.handle(0, Requested(request("any", "fg/*", "robot/x")))
    assert held(core) == {"first": {"fg/a"}, "any": {"fg/b", "robot/x"}}
    assert [effect.rcs for effect in effects if isinstance(effect, Granted)] == [("fg/b", "robot/x")]
    core.handle(0, Requested(request("third", "fg/*")))
    assert str(core._state.queued["third"].reason) == "waits for one of fg/a (held by first), b (held by any)"
    core.handle(SECOND, Released("first"))
    assert held(core)["third"] == {"fg/a"}
    validate(core)


@pytest.mark.parametrize("strategy", ALL)
def test_the_reason_counts_the_devices_that_are_missing(strategy: StrategyName) -> None:
    core = core_of(strategy, "fg/a", "fg/b", "fg/c", "fg/d")
    for name in "bcd":
        core.handle(0, Requested(request(f"has_{name}", f"fg/{name}")))
    core.handle(0, Requested(request("three", "fg/*", "fg/*#2", "fg/*#3")))
    core.handle(0, Requested(request("two", "fg/*", "fg/*#2")))
    held_ones = "fg/b (held by has_b), c (held by has_c), d (held by has_d)"
    assert str(core._state.queued["three"].reason) == f"waits for two of {held_ones}"
    assert str(core._state.queued["two"].reason) == f"waits for one of {held_ones}"


@pytest.mark.parametrize("strategy", ALL)
def test_several_are_counted_by_naming(strategy: StrategyName) -> None:
    core = core_of(strategy, "fg/a", "fg/b", "fg/c")
    core.handle(0, Requested(request("two", "fg/*", "fg/*#2")), Requested(request("also", "fg/*", "fg/*#2")))
    assert len(held(core)) == 1
    assert len(held(core)["two"]) == 2
    core.handle(0, Requested(request("four", *(f"fg/*#{n}" for n in range(1, 5)))))
    assert str(core._state.queued["four"].reason) == (
        "no device on the mesh is left for fg/*#1, fg/*#2, fg/*#3 and 1 more"
    )
    core.handle(0, RcJoined("fg/d", sharable=False))
    assert sorted(held(core)) == ["also", "two"]


@pytest.mark.parametrize("strategy", ALL)
def test_the_narrower_pattern_gets_what_only_it_can_use(strategy: StrategyName) -> None:
    core = core_of(strategy, "fg/a1", "fg/b1")
    core.handle(0, Requested(request("both", "fg/*", "fg/a$*")))
    assert held(core) == {"both": {"fg/a1", "fg/b1"}}
    assert core._state.running["both"].bound == {"fg/*": "fg/b1", "fg/a$*": "fg/a1"}


@pytest.mark.parametrize("strategy", ALL)
def test_what_others_name_is_left_to_them(strategy: StrategyName) -> None:
    core = core_of(strategy, "fg/a", "fg/b", "robot/x")
    core.handle(0, Requested(request("holds", "robot/x")))
    core.handle(0, Requested(request("names", "fg/a", "robot/x")))
    core.handle(0, Requested(request("any", "fg/*")))
    assert held(core)["any"] == {"fg/b"}


@pytest.mark.parametrize("strategy", ALL)
def test_of_those_that_yield_the_lowest_is_displaced(strategy: StrategyName) -> None:
    core = core_of(strategy, "fg/a", "fg/b", "fg/c")
    core.handle(
        0,
        Requested(request("two", "fg/a", priority=2)),
        Requested(request("one", "fg/b", priority=1)),
        Requested(request("three", "fg/c", priority=3)),
    )
    core.handle(SECOND, Requested(request("any", "fg/*", priority=3)))
    assert held(core) == {"two": {"fg/a"}, "any": {"fg/b"}, "three": {"fg/c"}}


@pytest.mark.parametrize("strategy", ALL)
def test_a_radio_that_refuses_sends_it_to_the_next(strategy: StrategyName) -> None:
    core = core_of(strategy, "radio/a", "radio/b", "radio/c")
    _answered(core, 0, {"radio/a": 10, "radio/b": 10}, Requested(request("loud", "radio/a", rate=8)))
    _answered(core, 0, {"radio/a": 10, "radio/b": 10}, Requested(request("any", "radio/*", rate=5)))
    assert held(core)["any"] in ({"radio/b"}, {"radio/c"})


@pytest.mark.parametrize("strategy", ALL)
@pytest.mark.parametrize(("said", "given"), [("warm", "radio/b"), ("", "radio/a")])
def test_what_continues_another_goes_on_with_what_that_has(strategy: StrategyName, said: str, given: str) -> None:
    core = core_of(strategy, "robot/x", "radio/a", "radio/b", "radio/c")
    warm = structs.replace(request("w", "robot/x", "radio/b", priority=0, rate=1), label="warm", keep=True)
    turn = structs.replace(request("turn", "robot/x", "radio/*", rate=1), continues=said)
    for wanted in (warm, turn):
        _answered(core, 0, {}, Requested(wanted))
    assert held(core) == {"turn": {"robot/x", given}}


@pytest.mark.parametrize("strategy", ALL)
def test_a_silent_radio_keeps_nobody_who_could_do_with_another(strategy: StrategyName) -> None:
    core = core_of(strategy, "radio/a", "radio/b")
    events: list[Event] = [Requested(request("any", "radio/*", rate=5))]
    asked = []
    while events:
        effects = core.handle(0, *events)
        out = [effect for effect in effects if isinstance(effect, Propose)]
        asked += [one.rc for one in out]
        # The first that is asked never answers.
        events = [VoteOverdue(one.proposal) if one.rc == asked[0] else Vote(one.proposal, accept=True) for one in out]
    assert len(held(core)["any"]) == 1
    assert asked[0] not in held(core)["any"]


@pytest.mark.parametrize("strategy", ALL)
def test_a_hold_keeps_its_rc_over_a_change_of_rcm_and_may_have_another_after_a_loss(strategy: StrategyName) -> None:
    core = Core(STRATEGIES[strategy]())
    wanted = request("any", "fg/*")
    stands = RecoveredHold(wanted, Place(TERM, 1), Grant(TERM, 1), 0, 10 * SECOND, {"fg/*": "fg/b"})
    joined = [RcJoined(rc, sharable=False) for rc in ("fg/a", "fg/b")]
    core.handle(SECOND, *joined, LeadTaken(NEXT, (stands,)))
    assert held(core) == {"any": {"fg/b"}}
    core.handle(2 * SECOND, RcLost("fg/b"))
    assert held(core) == {"any": {"fg/a"}}


def test_a_recovered_hold_must_name_an_rc_for_each_pattern() -> None:
    for bound in ({}, {"fg/*": "robot/a"}, {"fg/*": "fg/a", "fg/*#2": "fg/b"}):
        with pytest.raises(ValueError, match="recovered hold of ARC any: `bound`"):
            RecoveredHold(request("any", "fg/*"), Place(TERM, 1), Grant(TERM, 1), 0, SECOND, bound)


@pytest.mark.parametrize(
    ("needs", "message"),
    [
        ({"fg/**": {}}, "not valid"),
        ({"radio/*": {"rate": Fraction(1)}, "radio/*#2": {"rate": Fraction(2)}}, "different parameters"),
        ({"radio/*": {"rate": Fraction(1)}, "*/rf0": {}}, "name a kind"),
        ({"*/*": {"rate": Fraction(1)}}, "name a kind"),
    ],
)
def test_what_no_request_may_ask(needs: dict[str, Params], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_patterns(needs)


def test_the_owed_are_kept_one_that_matches() -> None:
    policy = SchedulingPolicy(patience=6 * SECOND)
    core = Core(STRATEGIES["adaptive"](), policy)
    core.handle(0, *(RcJoined(rc, sharable=False) for rc in ("fg/a", "fg/b", "robot/x")))
    core.handle(0, Requested(request("holds", "robot/x", seconds=20)))
    core.handle(0, Requested(request("owed", "fg/*", "robot/x")))
    core.handle(
        15 * SECOND, Requested(request("one", "fg/*", seconds=30)), Requested(request("two", "fg/*", seconds=30))
    )
    assert sorted(core._state.running) == ["holds", "one"]
    core.handle(20 * SECOND, Tick())
    assert sorted(core._state.running) == ["one", "owed"]


# At random


def workload(seed: int) -> Workload:
    draw = random.Random(seed)  # noqa: S311
    grabbers = [f"fg/{letter}{number}" for letter in "ab" for number in range(draw.randint(1, 2))]
    robots = [f"robot/r{number}" for number in range(draw.randint(1, 3))]
    radios = [WorkloadRc(f"radio/rf{number}", sharable=True, capacity={"rate": Fraction(10)}) for number in range(2)]
    arrivals, at = [], 0
    for number in range(draw.randint(5, 16)):
        needs = draw.sample(grabbers, draw.randint(0, 1)) + draw.sample(robots, draw.randint(0, 1))
        needs += draw.sample(["fg/*", "fg/*#2", "fg/a$*", "robot/*", "radio/*", "radio/rf0"], draw.randint(0, 3))
        needs = [need for need in needs if need != "fg/*#2" or "fg/*" in needs] or ["robot/*"]
        wanted = request(
            f"a{number}", *needs, priority=draw.randint(1, 3), seconds=draw.randint(1, 9), rate=draw.randint(1, 6)
        )
        arrivals.append(Arrival(at, wanted))
        at += draw.randint(0, 3) * SECOND
    return Workload((*map(WorkloadRc, grabbers + robots), *radios), tuple(arrivals))


def could_start(core: Core, arc: Arc, work: Workload) -> bool:
    """Whether some choice of RCs is free as it stands: nobody has to give way, and every radio has room."""
    capacity = {rc.name: rc.capacity["rate"] for rc in work.rcs if rc.sharable}
    for chosen in bindings(arc.request, [rc.name for rc in work.rcs]):
        free = True
        for name in chosen:
            holders = core._state.rc(name).holders.values()
            if name in capacity:
                used = sum((holder.needs[name]["rate"] for holder in holders), Fraction(0))
                rate = next(params["rate"] for need, params in arc.request.needs.items() if need.startswith("radio"))
                free &= used + rate <= capacity[name]
            else:
                free &= not holders
        if free:
            return True
    return False


@pytest.mark.parametrize("strategy", ALL)
def test_nobody_waits_while_some_choice_is_free(strategy: StrategyName) -> None:
    for seed in range(times(40)):
        check_choices(strategy, workload(seed))


def check_choices(strategy: StrategyName, work: Workload) -> None:
    ledger = Ledger(work.rcs, [one.request for one in work.arrivals])

    def watch(now: Ns, core: Core, effects: list[Effect]) -> None:
        ledger.take(now, core, effects)
        if not core._votes.proposals:
            for arc in core._state.queued.values():
                assert not could_start(core, arc, work), f"{arc.id} waits: {arc.reason}"

    played = replay(work, watch, strategy=STRATEGIES[strategy](), policy=SchedulingPolicy(patience=None))
    assert set(played.unserved) == {
        one.request.arc for one in work.arrivals if not any(bindings(one.request, [rc.name for rc in work.rcs]))
    }


@pytest.mark.parametrize("strategy", ALL)
def test_the_fewest_and_lowest_ranked_end_of_all_choices(strategy: StrategyName) -> None:
    for seed in range(times(340)):
        draw = random.Random(seed)  # noqa: S311
        rcs = ["fg/a1", "fg/a2", "fg/b1", "video/1", "video/2", "robot/x", "robot/y"]
        # Which of those who share a radio end the others decide by what is in use then.
        capacity = {"radio/a": 10, "radio/b": 10} if strategy == "priority" else {}
        core = core_of(strategy, *rcs, *capacity)
        for number in range(draw.randint(2, 8)):
            needs = draw.sample([*rcs, *capacity], draw.randint(1, 3))
            how = {"priority": draw.randint(1, 3), "seconds": draw.randint(1, 9), "rate": draw.randint(1, 6)}
            wanted = structs.replace(request(f"a{number}", *needs, **how), keep=draw.random() < 0.7)
            _answered(core, number, capacity, Requested(wanted))
        named = draw.sample(rcs, draw.randint(0, 2)) + draw.sample(
            sorted(capacity), draw.randint(0, min(1, len(capacity)))
        )
        patterns = draw.sample(["fg/*", "fg/*#2", "fg/a$*", "video/*", "robot/*"], draw.randint(1, 3))
        patterns += ["radio/*"] if capacity and draw.random() < 0.3 else []
        wanted = request("last", *named, *patterns, priority=draw.randint(2, 4), rate=draw.randint(1, 6))
        now = 5 * SECOND
        _answered(core, now, capacity, Tick())
        oracle = Oracle([*map(WorkloadRc, rcs), *(WorkloadRc(rc, True, {"rate": Fraction(10)}) for rc in capacity)])
        for arc in core._state.running.values():
            assert arc.hold is not None
            known = arc.request, arc.place.arrival, arc.hold.start, 0, arc.needs, protection(arc.hold)
            oracle.contenders.append(Contender(*known))
        best = oracle.choose(Contender(wanted, 1000), now)
        effects = _answered(core, now, capacity, Requested(wanted))
        assert ("last" in core._state.running) is (best is not None), seed
        if best is not None:
            by_last = {effect.arc for effect in effects if isinstance(effect, HoldEnded) and effect.by == "last"}
            ended = [one for one in oracle.running() if one.request.arc in by_last]
            assert oracle.worth(ended, now) == oracle.worth(best[0], now), seed


def _answered(core: Core, now: Ns, capacity: dict[str, int], *events: Event) -> list[Effect]:
    """A batch with every vote that it takes, and its effects: a radio of unknown capacity accepts all."""

    def vote(asked: Propose) -> Vote:
        rate = sum(params["rate"] for params in asked.holders.values())
        return Vote(asked.proposal, accept=rate <= capacity.get(asked.rc, 1000))

    return list(chain.from_iterable(play_instant(core, now, events, vote)))

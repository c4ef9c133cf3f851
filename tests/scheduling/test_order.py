"""Patterns never turn the order round: cases that once did, and random situations against `priority` and a matcher."""

from __future__ import annotations

import random
from fractions import Fraction

import pytest
from msgspec import structs

from tests.scheduling.oracle import best_by_rank
from tests.scheduling.situations import Situation, decide, less, random_situation, random_stream
from tests.thorough import times
from zscout.config.scheduling_policy import SchedulingPolicy, StrategyName
from zscout.scheduling.adaptive import Adaptive
from zscout.scheduling.model import ArcRequest
from zscout.scheduling.strategies import STRATEGIES
from zscout.simulation.replay import replay
from zscout.simulation.workload import Arrival, Workload, WorkloadRc
from zscout.types import SECOND, Params, RcName

ALL: tuple[StrategyName, ...] = ("priority", "optimal", "adaptive")
SEARCHING: tuple[StrategyName, ...] = ("optimal", "adaptive")


def request(arc: str, *needs: str, priority: int = 1, seconds: int = 10) -> ArcRequest:
    return ArcRequest(arc, "h/c", {need: {} for need in needs}, priority, seconds * SECOND)


def held(situation: Situation, strategy: StrategyName) -> dict[str, set[RcName]]:
    decided = decide(situation, strategy)
    assert not decided.flickered
    return decided.held


# Cases


@pytest.mark.parametrize("strategy", ALL)
def test_a_pattern_leaves_a_better_rank_what_it_names(strategy: StrategyName) -> None:
    """Two of three cameras do for `pair`; `routine`, of lower priority, waits, and not `named`."""
    pair = request("pair", "cam/*", "cam/*#2", priority=2, seconds=60)
    routine = request("routine", "cam/1", seconds=300)
    named = request("named", "cam/0", priority=2, seconds=30)
    asked = Situation(["cam/0", "cam/1", "cam/2"], asked=[pair, routine, named])
    assert held(asked, strategy) == {"named": {"cam/0"}, "pair": {"cam/1", "cam/2"}}


@pytest.mark.parametrize("strategy", ALL)
def test_of_two_cameras_the_lower_priority_gets_none(strategy: StrategyName) -> None:
    boss, low = request("boss", "dev/1", priority=2, seconds=50), request("low", "dev/2", priority=0, seconds=100)
    any_ = request("any", "dev/*", priority=2, seconds=60)
    for policy in (SchedulingPolicy(), SchedulingPolicy(preempt="after_min_runtime")):
        asked = Situation(["dev/1", "dev/2"], asked=[boss, any_, low, request("low2", "dev/2", priority=0)])
        asked.policy = policy
        assert held(asked, strategy) == {"boss": {"dev/1"}, "any": {"dev/2"}}


@pytest.mark.parametrize("strategy", ALL)
def test_a_set_by_pattern_is_worth_what_priority_starts(strategy: StrategyName) -> None:
    """The radio has room for `n2`, which could do with the devices that `n0` does not name."""
    radio: dict[str, Params] = {"radio/2": {}, "dev/*": {}, "dev/*#2": {}}
    asked = Situation(["dev/1", "dev/2", "dev/3"], {"radio/2": {}})
    asked.asked = [
        request("n0", "dev/1", priority=2, seconds=1),
        request("n1", "dev/*", "dev/2", "dev/*#2", priority=2, seconds=11),
        ArcRequest("n2", "h/c", radio, 2, 5 * SECOND),
    ]
    assert held(asked, strategy) == {"n0": {"dev/1"}, "n2": {"radio/2", "dev/2", "dev/3"}}


@pytest.mark.parametrize("strategy", ALL)
def test_nobody_is_granted_what_a_better_rank_takes_in_the_same_instant(strategy: StrategyName) -> None:
    asked = Situation(["dev/0", "dev/1"])
    asked.running = [(request("s0", "dev/0", "dev/*", seconds=18), {"dev/*": "dev/1"}, 49)]
    asked.asked = [
        request("n1", "dev/1", priority=0, seconds=16),
        request("n3", "dev/0", priority=2, seconds=18),
        request("n4", "dev/*", priority=2, seconds=20),
    ]
    assert held(asked, strategy) == {"n3": {"dev/0"}, "n4": {"dev/1"}}


@pytest.mark.parametrize("strategy", ALL)
def test_a_veto_counts_for_the_choice_on_which_it_was_given(strategy: StrategyName) -> None:
    """node/1 refuses e1 beside `in`; on node/2, where that goes, nothing speaks against e1."""
    nodes = {"node/1": 3, "node/2": 4, "queue/1": 6}
    rcs = [WorkloadRc(rc, sharable=True, capacity={"cpu": Fraction(cpu)}) for rc, cpu in nodes.items()]

    def asks(at: int, name: str, node: str, cpu: int, priority: int) -> Arrival:
        share = {"cpu": Fraction(cpu)}
        return Arrival(at * SECOND, ArcRequest(name, "h/c", {node: share, "queue/1": share}, priority, 100 * SECOND))

    asked = (asks(0, "e1", "node/1", 1, 0), asks(0, "e2", "node/2", 4, 0), asks(20, "in", "node/*", 3, 9))
    work = Workload(tuple(rcs), asked)
    holds = replay(work, strategy=STRATEGIES[strategy]()).holds
    assert [(hold.start // SECOND, hold.end // SECOND) for hold in holds if hold.arc == "e1"] == [(0, 100)]
    assert [(hold.start // SECOND, hold.end // SECOND) for hold in holds if hold.arc == "in"] == [(20, 120)]


@pytest.mark.parametrize("strategy", ALL)
def test_of_free_devices_the_lowest_wanted_is_taken(strategy: StrategyName) -> None:
    """dev/1 is wanted by a better rank, which waits for the robot, and dev/2 by two of lower priority."""
    asked = Situation(["robot/x", "dev/1", "dev/2"])
    asked.running = [(request("holds", "robot/x", priority=3, seconds=99), {}, 40)]
    asked.asked = [
        request("high", "robot/x", "dev/1", priority=2),
        request("any", "dev/*", priority=1),
        request("low", "robot/x", "dev/2", priority=0),
        request("low2", "robot/x", "dev/2", priority=0),
    ]
    assert held(asked, strategy) == {"holds": {"robot/x"}, "any": {"dev/2"}}


@pytest.mark.parametrize("strategy", ALL)
def test_an_arc_that_starts_makes_room_for_a_lower_rank_and_one_that_runs_does_not(strategy: StrategyName) -> None:
    any_, named = request("any", "dev/*", priority=2), request("named", "dev/1", priority=1)
    asked = Situation(["dev/1", "dev/2"], asked=[any_, named])
    assert held(asked, strategy) == {"any": {"dev/2"}, "named": {"dev/1"}}
    asked = Situation(["dev/1", "dev/2"], running=[(any_, {"dev/*": "dev/1"}, 45)], asked=[named])
    assert held(asked, strategy) == {"any": {"dev/1"}}


@pytest.mark.parametrize("strategy", ALL)
def test_no_hold_ends_to_make_room(strategy: StrategyName) -> None:
    """`any` could make room only by ending `runs`, which `named` does not need."""
    asked = Situation(["dev/a", "dev/b"], running=[(request("runs", "dev/b", priority=0, seconds=99), {}, 40)])
    asked.asked = [request("any", "dev/*", priority=2), request("named", "dev/a", priority=1)]
    assert held(asked, strategy) == {"runs": {"dev/b"}, "any": {"dev/a"}}


@pytest.mark.parametrize("strategy", ALL)
def test_an_arc_that_moves_to_what_a_victim_gives_up_has_it_for_itself(strategy: StrategyName) -> None:
    """`any` moves to dev/a1, which `runs` gives up for `named`: `other` can't move there for `late`."""
    asked = Situation(["robot/x", "dev/a1", "dev/a2", "dev/b"])
    asked.running = [(request("runs", "robot/x", "dev/a1", priority=0, seconds=99), {}, 40)]
    asked.asked = [
        request("any", "dev/a$*", priority=2, seconds=1),
        request("named", "robot/x", "dev/a2", priority=2, seconds=5),
        request("other", "dev/*", seconds=7),
        request("late", "dev/b", seconds=9),
        request("low", "dev/*", priority=0),
    ]
    assert held(asked, strategy) == {"any": {"dev/a1"}, "named": {"robot/x", "dev/a2"}, "other": {"dev/b"}}


def asked_at(at: int, *needs: str, arc: str, priority: int = 1, seconds: int, rate: int = 0) -> Arrival:
    found = request(arc, *needs, priority=priority, seconds=seconds)
    shares: dict[str, Params] = {need: {"rate": Fraction(rate)} if need == "radio" else {} for need in needs}
    return Arrival(at * SECOND, structs.replace(found, needs=shares))


def starts(rcs: list[WorkloadRc], *asked: Arrival) -> list[tuple[str, int]]:
    """The holds under `adaptive`, each with its start in seconds."""
    played = replay(Workload(tuple(rcs), asked), strategy=Adaptive(), policy=SchedulingPolicy(patience=40 * SECOND))
    return [(hold.arc, hold.start // SECOND) for hold in played.holds]


def test_a_vote_on_what_is_reserved_keeps_lower_ranks_waiting() -> None:
    """`high` may pass `starves`, if the radio accepts both; `low` has to wait for that vote."""
    radio = WorkloadRc("radio", sharable=True, capacity={"rate": Fraction(6)})
    found = starts(
        [WorkloadRc("robot"), WorkloadRc("dev"), radio],
        asked_at(0, "robot", arc="holds", priority=2, seconds=100),
        asked_at(1, "robot", "radio", arc="starves", priority=2, seconds=10, rate=5),
        asked_at(50, "dev", "radio", arc="high", priority=2, seconds=60, rate=1),
        asked_at(50, "dev", arc="low", seconds=5),
    )
    assert found == [("holds", 0), ("high", 50), ("starves", 100), ("low", 110)]


def test_a_vote_on_what_is_reserved_keeps_larger_sets_waiting() -> None:
    """`left` and `right` are a larger set than `narrow`, but `high` may get dev/a."""
    radio = WorkloadRc("radio", sharable=True, capacity={"rate": Fraction(6)})
    found = starts(
        [*map(WorkloadRc, ("robot", "dev/a", "dev/b", "dev/c", "dev/d")), radio],
        asked_at(0, "robot", arc="holds", priority=2, seconds=100),
        asked_at(1, "robot", "radio", arc="starves", priority=2, seconds=10, rate=5),
        asked_at(50, "dev/a", "radio", arc="high", priority=2, seconds=60, rate=1),
        asked_at(50, "dev/b", "dev/c", arc="narrow", seconds=9),
        asked_at(50, "dev/a", "dev/b", arc="left", seconds=10),
        asked_at(50, "dev/c", "dev/d", arc="right", seconds=10),
    )
    assert found == [("holds", 0), ("high", 50), ("narrow", 50), ("right", 59), ("starves", 100), ("left", 110)]


def test_what_a_start_makes_free_of_a_reservation_goes_to_the_best_rank() -> None:
    """dev/1 is reserved for `starves`, which gets dev/2: then it is for `high`, though `low` would be over in time."""
    found = starts(
        [WorkloadRc("dev/1"), WorkloadRc("dev/2")],
        asked_at(0, "dev/1", "dev/2", arc="holds", priority=2, seconds=25),
        asked_at(1, "dev/*", arc="starves", priority=2, seconds=10),
        asked_at(2, "dev/1", arc="high", seconds=60),
        asked_at(3, "dev/1", arc="low", priority=0, seconds=5),
    )
    assert found == [("holds", 0), ("high", 25), ("starves", 25), ("low", 85)]


# At random


@pytest.mark.parametrize("seeds", [range(120), pytest.param(range(120, times(2000)), marks=pytest.mark.slow)])
def test_no_instant_is_worth_less_than_priority_makes_it(seeds: range) -> None:
    for seed in seeds:
        check_worth(seed)


@pytest.mark.parametrize(
    "seed",
    [
        pytest.param(7770, id="a veto after a device was chosen for the ARC that is vetoed"),
        pytest.param(13699, id="a veto after a set was taken that it would have spared"),
        pytest.param(19674, id="a set that frees an ARC to preempt what another group was granted"),
    ],
)
def test_no_instant_that_once_was_is_worth_less(seed: int) -> None:
    check_worth(seed)


def check_worth(seed: int) -> None:
    situation = random_situation(seed)
    least = decide(situation, "priority")
    assert not least.flickered, seed
    for strategy in SEARCHING:
        found = decide(situation, strategy)
        assert not found.flickered, (seed, strategy)
        assert not less(found.worth(strategy), least.worth(strategy)), (seed, strategy)


@pytest.mark.parametrize("seeds", [range(368, 373), pytest.param(range(times(300)), marks=pytest.mark.slow)])
def test_nobody_is_granted_and_ended_in_one_instant_of_a_stream(seeds: range) -> None:
    for seed in seeds:
        for strategy in ALL:
            work, policy = random_stream(seed)
            holds = replay(work, strategy=STRATEGIES[strategy](), policy=policy).holds
            assert not [hold.arc for hold in holds if hold.start == hold.end], (seed, strategy)


TAGS = "abcd"


def one_place_each(seed: int) -> Situation:
    """ARCs that want one device each, by name or by tags, beside others that run."""
    draw = random.Random(seed)  # noqa: S311
    found = Situation(
        [f"dev/{number}{''.join(draw.sample(TAGS, draw.randint(1, 3)))}" for number in range(draw.randint(2, 7))]
    )
    for number, rc in enumerate(draw.sample(found.exclusive, draw.randint(0, 2))):
        found.running.append((request(f"runs{number}", rc, priority=3, seconds=99), {}, 40))
    for number in range(draw.randint(2, 9)):
        need = draw.choice([*found.exclusive, *(f"dev/$*{tag}$*" for tag in TAGS * 2), "dev/*"])
        found.asked.append(request(f"asks{number}", need, priority=draw.randint(0, 2), seconds=draw.randint(1, 9)))
    return found


@pytest.mark.parametrize("seeds", [range(100), pytest.param(range(100, times(2000)), marks=pytest.mark.slow)])
def test_one_place_each_is_shared_out_to_the_best_ranks(seeds: range) -> None:
    for seed in seeds:
        situation = one_place_each(seed)
        for strategy in ALL:
            assert decide(situation, strategy).held.keys() == expected(situation), (seed, strategy)


def gangs(seed: int) -> Situation:
    """ARCs that want up to three devices each, by name and by tags."""
    draw = random.Random(seed)  # noqa: S311
    found = one_place_each(seed)
    for number, asked in enumerate(found.asked):
        others = draw.sample(["dev/*#2", "dev/*#3", "dev/$*a$*#4", *found.exclusive], draw.choice((0, 0, 1, 2)))
        found.asked[number] = structs.replace(asked, needs={need: {} for need in (*asked.needs, *others)})
    return found


@pytest.mark.parametrize("seeds", [range(100), pytest.param(range(100, times(2000)), marks=pytest.mark.slow)])
def test_gangs_start_in_rank_order_wherever_all_can_have_places(seeds: range) -> None:
    for seed in seeds:
        assert decide(gangs(seed), "priority").held.keys() == expected(gangs(seed)), seed


def expected(situation: Situation) -> set[str]:
    running = [asked for asked, _, _ in situation.running]
    free = {rc for rc in situation.exclusive if all(rc not in asked.needs for asked in running)}
    return {asked.arc for asked in (*running, *best_by_rank(situation.asked, free))}

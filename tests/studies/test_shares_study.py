"""`python -m studies shares`: programs under virtual time, a week, and the cases in which one group asks otherwise."""

from __future__ import annotations

from itertools import islice

import pytest

from studies.scheduling.programs import ProgramJob, play
from studies.scheduling.shares import (
    BURSTY,
    RISE,
    STEADY,
    WAYS,
    CaseTrial,
    SharesCase,
    Week,
    draw_case,
    play_case,
    play_week,
    report,
)
from zscout.config.scheduling_policy import FairShares, SchedulingPolicy
from zscout.types import SECOND, Ns

POLICY = SchedulingPolicy(fair_shares=FairShares(3_600 * SECOND))


def job(asked: int, used: int, *rcs: str, pause: int = 0) -> ProgramJob:
    return ProgramJob(pause * SECOND, rcs, asked * SECOND, used * SECOND)


def test_programs_ask_for_one_arc_after_the_other() -> None:
    steady = iter([job(10, 10, "robot/a", "robot/b"), job(20, 5, "robot/a", pause=10)])
    other = iter([job(10, 10, "robot/a", pause=1)])
    uses = play(["robot/a", "robot/b"], {"one": [steady], "two": [other]}, POLICY, 60 * SECOND)
    one, two = uses["one"], uses["two"]
    assert (one.useful, one.done) == (25.0, 2), "10 s of two, and 5 s of the 20 that were asked for"
    assert (two.useful, two.done, two.longest) == (10.0, 1, 9.0)
    assert one.charged == 9.0, "robot/a from 1 to 10 s, not robot/b"
    assert two.charged == 0.0, "the second began at the instant at which the first asked again"


def test_what_is_cut_short_by_the_end_counts_as_far_as_it_came() -> None:
    uses = play(["robot/a"], {"one": [iter([job(100, 100, "robot/a")])]}, POLICY, 30 * SECOND)
    assert uses["one"].useful == 30.0


@pytest.mark.slow
def test_with_fair_shares_a_burst_and_a_stream_come_out_equal() -> None:
    without, fair = (play_week(Week(0, on)) for on in (False, True))
    assert without.apart > 0.1
    assert fair.apart < 0.05
    assert fair.uses[BURSTY].useful == pytest.approx(without.uses[BURSTY].useful, rel=0.01), "it is served either way"
    assert fair.uses[STEADY].charged > without.uses[STEADY].charged


def test_a_burst_is_served_alike_every_time() -> None:
    def played() -> list[float]:
        # Who began to starve at one instant is in the order of their names.
        burst = [iter([job(10 + number % 7, 10 + number % 7, f"robot/{number % 3}")]) for number in range(60)]
        uses = play([f"robot/{number}" for number in range(3)], {"one": burst}, POLICY, 400 * SECOND)
        return [uses["one"].waited, uses["one"].longest]

    assert len({tuple(played()) for _ in range(4)}) == 1


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(len(WAYS)))
def test_a_case_is_the_same_every_time(seed: int) -> None:
    one, two = play_case(seed), play_case(seed)
    assert one == two
    assert 0 < one.honest < 1
    assert one.case.way == list(WAYS)[seed]


def test_each_way_asks_for_the_same_work() -> None:
    """But for what is of no use: the pieces come to what was to be done."""
    case = draw_case(0)
    work = [job(60, 60, "robot/r0", "robot/r1"), job(40, 40, "robot/r1")]

    def total(way: str) -> Ns:
        programs = WAYS[way]([0], lambda _: iter(work), case)
        first = list(islice(programs, len(programs) - (way == "asks for everything besides")))
        return sum(one.used * len(one.rcs) for program in first for one in program)

    assert {total(way) for way in WAYS} == {160 * SECOND}


def trial(case: SharesCase, honest: float, gamed: float) -> CaseTrial:
    return CaseTrial(case, honest, gamed, honest, honest)


def test_the_report_counts_who_rose() -> None:
    case = draw_case(1)
    far = (1 + 2 * RISE) / len(case.groups)
    found = report([], [trial(case, 0.2, 0.2), trial(case, 0.2, 0.22), trial(case, 0.2, 0.1), trial(case, 0.2, far)])
    (way,) = found.ways
    assert (way.cases, way.on.rose, way.on.beyond, way.on.fell) == (4, 0.5, 0.25, 0.25)
    assert way.on.greatest == pytest.approx(far / 0.2 - 1)
    assert (way.off.rose, way.off.fell, way.off.mean) == (0, 0, 0)
    assert found.risen == {case.way: [1, 1]}

"""How long holds last is learned from those that are over, and serves estimates alone."""

from __future__ import annotations

from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from studies.scheduling.forecasts import overestimated
from tests.scheduling.workloads import workloads
from tests.thorough import times
from zscout.messages import Who
from zscout.scheduling.adaptive import Adaptive
from zscout.scheduling.booking import Booking
from zscout.scheduling.core import Core
from zscout.scheduling.forecast import forecast
from zscout.scheduling.model import ArcRequest, Effect, Granted, HoldEnded, RcJoined, Released, Requested, Tick
from zscout.scheduling.runtimes import MAX_KEPT, RequestTraits, RuntimeEstimator
from zscout.simulation.replay import SERVED, replay
from zscout.simulation.workload import Workload
from zscout.types import SECOND, ArcId, Ns

MINUTE = 60 * SECOND
HOUR = 60 * MINUTE


def request(arc: str, *rcs: str, runtime: Ns = HOUR, name: str = "survey", keep: bool = False) -> ArcRequest:
    who = Who("alice", "h", "survey.py")
    return ArcRequest(arc, "h/c", {rc: {} for rc in rcs or ("robot/a",)}, 0, runtime, keep, name, who=who)


def traits(runtime: Ns = HOUR, name: str = "survey", *rcs: str) -> RequestTraits:
    return RequestTraits.of(request("one", *rcs, runtime=runtime, name=name))


def taught(*lasted: Ns, runtime: Ns = HOUR) -> RuntimeEstimator:
    estimator = RuntimeEstimator()
    for one in lasted:
        estimator.observe(traits(runtime), one, whole=True)
    return estimator


def test_who_asks_for_an_hour_and_always_takes_ten_minutes_is_expected_to_take_ten() -> None:
    estimator = taught(10 * MINUTE, 10 * MINUTE)
    assert estimator.runtime(traits()) is None  # too few
    estimator.observe(traits(), 10 * MINUTE, whole=True)
    assert estimator.runtime(traits()) == 10 * MINUTE


@pytest.mark.parametrize(("times_too_much", "expected"), [(6, 5 * MINUTE), (1, None)])
def test_who_asks_for_so_many_times_too_much_is_expected_to_take_that_part(
    times_too_much: int, expected: Ns | None
) -> None:
    estimator = RuntimeEstimator()
    for minutes in (1, 7, 20, 3):
        estimator.observe(traits(times_too_much * minutes * MINUTE), minutes * MINUTE, whole=True)
    assert estimator.runtime(traits(30 * MINUTE)) == expected


def test_one_who_is_not_to_be_foretold_is_expected_to_take_what_was_asked_for() -> None:
    """Learning is off where it does not pay."""
    random = Random(1)  # noqa: S311 - a test's
    estimator = RuntimeEstimator()
    for _ in range(100):
        estimator.observe(traits(), random.choice((HOUR, HOUR, HOUR, SECOND)), whole=True)
    assert estimator.runtime(traits()) is None


def test_what_is_known_of_a_name_serves_for_other_rcs_until_more_is_known() -> None:
    estimator = taught(*[10 * MINUTE] * 3)
    assert estimator.runtime(traits(HOUR, "survey", "robot/b")) == 10 * MINUTE
    for _ in range(3):
        estimator.observe(traits(HOUR, "survey", "robot/b"), 20 * MINUTE, whole=True)
    assert estimator.runtime(traits(HOUR, "survey", "robot/b")) == 20 * MINUTE
    assert estimator.runtime(traits()) == 10 * MINUTE


def test_nothing_is_known_of_another_program() -> None:
    assert taught(*[10 * MINUTE] * 3).runtime(traits(HOUR, "another")) is None
    assert taught(*[10 * MINUTE] * 3).runtime(traits()._replace(command="another")) is None


def test_a_hold_that_was_taken_away_would_have_lasted_longer() -> None:
    estimator = taught(10 * MINUTE, 10 * MINUTE, 30 * MINUTE, 30 * MINUTE, 30 * MINUTE)
    for _ in range(5):
        estimator.observe(traits(), 5 * MINUTE, whole=False)
    # Not 5, nor the 10 that half of all of them reached.
    assert estimator.runtime(traits()) == 30 * MINUTE
    for _ in range(MAX_KEPT):
        estimator.observe(traits(), 5 * MINUTE, whole=False)
    assert estimator.runtime(traits()) is None


def test_what_lasts_already_is_expected_to_last_as_those_that_lasted_so_long() -> None:
    estimator = taught(*[10 * MINUTE] * 5, *[30 * MINUTE] * 3)
    assert estimator.runtime(traits()) == 10 * MINUTE
    assert estimator.runtime(traits(), 10 * MINUTE) == 30 * MINUTE
    outlasts = estimator.runtime(traits(), 40 * MINUTE)
    assert outlasts is not None
    assert 40 * MINUTE < outlasts < 50 * MINUTE


def test_a_forecast_goes_by_what_was_learned_and_a_kept_hold_by_when_it_is_given_back() -> None:
    for keep in (False, True):
        core = Core()
        core.handle(0, RcJoined("robot/a", sharable=False))
        core.handle(0, Requested(request("one", keep=keep)))
        core.handle(0, Requested(request("next", "robot/a", name="other", runtime=HOUR)))
        lower = ArcRequest("low", "z/c", {"robot/a": {}}, -1, HOUR)
        core.handle(0, Requested(lower))
        told = forecast(core, 0, runtimes=taught(*[10 * MINUTE] * 3)).starts
        assert told == {"next": 10 * MINUTE, "low": 70 * MINUTE}
        # In its eleventh minute nothing but a little more is expected.
        told = forecast(core, 11 * MINUTE, runtimes=taught(*[10 * MINUTE] * 3)).starts
        assert 11 * MINUTE < told["next"] < 13 * MINUTE


def test_who_waits_behind_a_kept_hold_of_higher_priority_is_told_when_it_is_usually_given_back() -> None:
    core = Core()
    core.handle(0, RcJoined("robot/a", sharable=False))
    core.handle(0, Requested(request("kept", keep=True, runtime=MINUTE)))
    core.handle(0, Requested(ArcRequest("low", "z/c", {"robot/a": {}}, -1, HOUR)))
    assert forecast(core, 0).starts == {}
    assert forecast(core, 0, runtimes=taught(*[10 * MINUTE] * 3, runtime=MINUTE)).starts == {"low": 10 * MINUTE}


spans = st.tuples(st.integers(1, 10**15), st.integers(1, 10**15), st.booleans())


@settings(max_examples=times(200))
@given(st.lists(spans, max_size=60), st.integers(1, 10**15), st.integers(0, 10**16))
def test_an_estimate_is_longer_than_what_has_passed(
    seen: list[tuple[int, int, bool]], asked: int, elapsed: int
) -> None:
    estimator = RuntimeEstimator()
    for runtime, lasted, whole in seen:
        estimator.observe(traits(runtime), lasted, whole=whole)
    expected = estimator.runtime(traits(asked), elapsed)
    assert expected is None or expected > elapsed


def test_memory_is_bounded() -> None:
    estimator = RuntimeEstimator(most=30)
    for number in range(1_000):
        for _ in range(2):
            estimator.observe(traits(HOUR, f"n{number}" * 1_000), MINUTE, whole=True)
    histories = estimator._histories
    assert len(histories) == 30
    assert all(len(one.spans) <= MAX_KEPT for one in histories.values())
    assert len(repr(histories.keys())) < 30 * 1_000
    # What is used stays.
    for number in range(100):
        estimator.observe(traits(HOUR, "used"), MINUTE, whole=True)
        estimator.observe(traits(HOUR, f"m{number}"), HOUR, whole=True)
    assert estimator.runtime(traits(HOUR, "used")) == MINUTE


@settings(max_examples=times(25))
@given(workloads(keep=False), st.integers(0, 99))
def test_a_forecast_by_one_who_knows_nothing_is_that_of_what_was_asked_for(workload: Workload, seed: int) -> None:
    workload, lasting = overestimated(workload, Random(seed))  # noqa: S311 - a test's

    def watch(now: Ns, core: Core, _: list[Effect]) -> None:
        assert forecast(core, now, runtimes=RuntimeEstimator()) == forecast(core, now)

    replay(workload, watch, lasting=lasting)


@settings(max_examples=times(25))
@given(workloads(), st.integers(0, 99))
def test_what_was_learned_ends_no_hold_and_touches_no_decision(workload: Workload, seed: int) -> None:
    """The same run, with and without forecasts by what was learned; and who is told to start early is not started."""
    workload, lasting = overestimated(workload, Random(seed))  # noqa: S311 - a test's
    requests = {arrival.request.arc: arrival.request for arrival in workload.arrivals}
    estimator, since = RuntimeEstimator(), dict[ArcId, Ns]()

    def watch(now: Ns, core: Core, effects: list[Effect]) -> None:
        for effect in effects:
            if isinstance(effect, Granted):
                since[effect.arc] = effect.start
            elif isinstance(effect, HoldEnded):
                lasted = now - since[effect.arc]
                estimator.observe(RequestTraits.of(requests[effect.arc]), lasted, whole=effect.outcome in SERVED)
        told = forecast(core, now, runtimes=estimator)
        assert all(start >= now for start in told.starts.values())

    assert replay(workload, watch, lasting=lasting) == replay(workload, lasting=lasting)


@pytest.mark.parametrize("keep", [False, True])
def test_a_hold_lasts_as_asked_for_whatever_was_expected(keep: bool) -> None:
    core, estimator = Core(), taught(*[MINUTE] * 5)
    core.handle(0, RcJoined("robot/a", sharable=False))
    core.handle(0, Requested(request("one", keep=keep)))
    core.handle(0, Requested(request("next", name="other")))
    for at in range(1, 60):
        core.handle(at * MINUTE, Tick())
        assert forecast(core, at * MINUTE, runtimes=estimator).starts["next"] > at * MINUTE
        assert core.is_running("one")
    core.handle(HOUR, Tick())
    assert core.is_running("next")


def test_what_is_given_back_at_its_end_is_given_back_once() -> None:
    core, estimator = Core(), taught(*[MINUTE] * 5)
    core.handle(0, RcJoined("robot/a", sharable=False))
    core.handle(0, *(Requested(request(f"a{number}")) for number in range(4)))
    assert forecast(core, 0, runtimes=estimator).starts == {f"a{number}": number * MINUTE for number in (1, 2, 3)}
    core.handle(MINUTE, Released("a0"))
    assert core.waiting == 2


def test_a_slot_is_where_what_was_asked_for_is_over_and_likely_earlier() -> None:
    core, estimator = Core(Adaptive()), taught(*[10 * MINUTE] * 5)
    core.handle(0, RcJoined("robot/a", sharable=False))
    core.handle(0, Requested(request("one")))
    wanted = Booking("b", {"robot/a": {}}, 0, 0, MINUTE, MINUTE, 0)
    assert core.slots(wanted, 2 * HOUR, 1).found[0].start == HOUR
    assert core.likely_slot(wanted, 2 * HOUR, estimator) == 10 * MINUTE
    assert core.likely_slot(wanted, 2 * HOUR, RuntimeEstimator()) == HOUR
    assert core.likely_slot(wanted, MINUTE, estimator) is None

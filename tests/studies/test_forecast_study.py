"""The study of forecasts: what requests were told, and what came."""

from __future__ import annotations

from random import Random
from statistics import median

import pytest

from studies.scheduling.families import FAMILIES
from studies.scheduling.forecasts import FACTORS, NOISE, WAYS, ForecastJob, accuracy, overestimated, report, run
from zscout.types import SECOND

ASKED, LEARNED, TRUE = WAYS


def test_each_program_asks_for_about_the_same_number_of_times_too_much() -> None:
    workload, lasting = overestimated(FAMILIES["calm"].workload(0), Random(0))  # noqa: S311 - a test's
    factors: dict[str, list[float]] = {}
    for one in workload.arrivals:
        factors.setdefault(one.request.label, []).append(one.request.min_runtime / lasting[one.request.arc])
    assert len(factors) == 12
    for found in factors.values():
        assert FACTORS[0] * (1 - NOISE) - 0.01 < min(found)
        assert max(found) < FACTORS[1] * (1 + NOISE) + 0.01
        assert max(found) < 1.6 * min(found)
    assert max(map(median, factors.values())) > 1.6 * min(map(median, factors.values()))


def test_near_is_within_a_fifth_of_what_was_told() -> None:
    found = accuracy([(10 * SECOND, 12 * SECOND), (10 * SECOND, 13 * SECOND), (None, SECOND), (0, 0)])
    assert (found.near, found.error) == (0.5, 2.0)
    assert accuracy([]).near == 0.0


@pytest.mark.slow
def test_who_learns_foretells_better_and_nobody_better_than_who_knows() -> None:
    trial = run(ForecastJob("calm", 0, "adaptive"))
    assert trial == run(ForecastJob("calm", 0, "adaptive"))
    (found,) = report([trial])
    assert found.queued > 100
    assert found.ways[ASKED].near < 0.1 < 0.3 < found.ways[LEARNED].near < found.ways[TRUE].near
    assert found.ways[ASKED].error > 5 * found.ways[LEARNED].error > found.ways[TRUE].error


@pytest.mark.parametrize("strategy", ["adaptive", "priority"])
def test_who_learns_keeps_to_what_was_asked_for_where_that_is_exact(strategy: str) -> None:
    (found,) = report([run(ForecastJob("calm", 1, strategy, exact=True))])
    assert found.ways[LEARNED] == found.ways[ASKED] == found.ways[TRUE]

"""`python -m studies clairvoyant`: no strategy beats a plan that knows what comes."""

from __future__ import annotations

import pytest

from studies.scheduling.clairvoyant import case, run

pytest.importorskip("ortools")


@pytest.mark.parametrize("levels", [1, 3])
def test_nobody_waits_less_than_who_knows_what_comes(levels: int) -> None:
    trial = next(trial for seed in range(20) if (trial := run(seed, levels, 5.0)).proven)
    assert min(trial.waits.values()) >= trial.least
    assert len({arrival.request.priority for arrival in case(trial.seed, levels).arrivals}) == levels

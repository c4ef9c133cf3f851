"""The crowd of `make bench`: its programs are served by a real fleet and by its empty queryable."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import latency, programs
from benchmarks.crowd import crowd

pytestmark = [pytest.mark.live, pytest.mark.slow]


async def test_the_crowd_counts_grants_and_the_answers_of_the_empty_queryable(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    async with latency.fleet_of(tmp_path) as lab:
        programs.start(lab)
        client = await lab.client("first")
        await lab.ready(client, *programs.EXCLUSIVE, *programs.SHARABLE)
        answers, grants = await crowd(lab, tmp_path / "empty", 1, 1.0, lambda _: None, programs=2)
    assert answers.value > 0
    assert grants.value > 0
    assert grants.ratio == grants.value / answers.value

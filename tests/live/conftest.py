"""Fleets of real processes as fixtures."""

from __future__ import annotations

import typing
from pathlib import Path

import pytest

from tests.live.bench import Stand
from tests.live.lab import Lab


@pytest.fixture
def lab(request: pytest.FixtureRequest, tmp_path: Path) -> Lab:
    """Of the kind that the test says it takes: a `Lab`, or one derived from it."""
    made: Lab = typing.get_type_hints(request.function)["lab"](tmp_path)
    return made


@pytest.fixture
def stand(lab: Lab) -> Stand:
    return Stand(lab)

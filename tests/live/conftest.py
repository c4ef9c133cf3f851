"""Fleets of real processes as fixtures."""

from __future__ import annotations

import typing
from pathlib import Path

import pytest

from tests.live.bench import Stand
from tests.live.closed import SecuredLab
from tests.live.lab import Lab


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """A test of a module with `ON_BOTH_FLEETS` that takes a `Lab` runs on a plain fleet, and on a secured one."""
    takes = typing.get_type_hints(metafunc.function).get("lab")
    if "lab" in metafunc.fixturenames and takes is Lab and getattr(metafunc.module, "ON_BOTH_FLEETS", False):
        fleets = ["plain", pytest.param("secured", marks=pytest.mark.slow)]
        metafunc.parametrize("lab", fleets, indirect=True)


@pytest.fixture
def lab(request: pytest.FixtureRequest, tmp_path: Path) -> Lab:
    """Of the kind that the test says it takes: a `Lab`, or one derived from it."""
    kind = SecuredLab if getattr(request, "param", "") == "secured" else typing.get_type_hints(request.function)["lab"]
    made: Lab = kind(tmp_path)
    return made


@pytest.fixture
def stand(lab: Lab) -> Stand:
    return Stand(lab)

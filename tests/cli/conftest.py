"""Tests that share a fleet leave nothing of theirs in it, also where they fail."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.cli.cli_fleet import CliFleet


@pytest.fixture(autouse=True)
def _ended(request: pytest.FixtureRequest) -> Iterator[None]:
    yield
    fleet = request.node.funcargs.get("fleet")
    if isinstance(fleet, CliFleet):
        fleet.end_started()

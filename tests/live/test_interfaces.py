"""A host whose network comes late: its programs find the node beside them, and the fleet is whole once it is there."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import pytest

from studies.chaos.net import NoNamespaces, check
from studies.interfaces import Fleet, Way, cycle

pytestmark = [pytest.mark.live, pytest.mark.slow]
WITHIN: Final = 10.0
"""Seconds until what appeared is used."""


@pytest.fixture(autouse=True)
def _namespaces() -> None:
    try:
        check()
    except NoNamespaces as why:
        pytest.skip(str(why))


@pytest.mark.parametrize("secured", [False, True], ids=["plain", "secured"])
@pytest.mark.parametrize("way", ["multicast", "connect"])
async def test_a_host_that_begins_before_its_network_works_alone_and_joins_by_itself(
    tmp_path: Path, way: Way, secured: bool
) -> None:
    async with Fleet(tmp_path, way, secured=secured) as fleet:
        found = await cycle(fleet, "cable")
        assert found.took < WITHIN, found
        assert not found.needless, found

"""Interfaces and addresses come and go, or come late: the fleet is whole again by itself, and programs beside the
leader keep their holds."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import pytest

from studies.chaos.net import NoNamespaces, check
from studies.interfaces import CHANGES, Fleet, Way, cycle

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
async def test_a_fleet_follows_the_network_of_its_leader(tmp_path: Path, way: Way, secured: bool) -> None:
    async with Fleet(tmp_path, way, secured=secured) as fleet:
        await fleet.whole({"cam/a", "cam/b"})
        for change in CHANGES:
            found = await cycle(fleet, change)
            assert found.took < WITHIN, found
            assert not found.needless, found

"""Hosts whose network comes late, changes or goes: the fleet is whole again, and no hold beside its leader is lost."""

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
async def test_a_fleet_follows_the_interfaces_of_a_host(tmp_path: Path, way: Way, secured: bool) -> None:
    """A program also begins, and holds a device, where its host has no network yet."""
    async with Fleet(tmp_path, way, secured=secured) as fleet:
        for change in CHANGES:
            found = await cycle(fleet, change)
            assert found.took < WITHIN, found
            assert not found.needless, found

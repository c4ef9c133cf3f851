"""What commands print on a mesh has the fields that were recorded."""

from __future__ import annotations

import json

import pytest

from tests.surface.live import RECORDED, differences, play

pytestmark = [pytest.mark.live, pytest.mark.slow]


def test_what_is_printed_on_a_mesh_is_what_was_recorded() -> None:
    found = differences(json.loads(RECORDED.read_text()), play())
    told = "\n".join(map(str, found))
    assert not found, f"mend it, or if it is meant run `python -m tests.surface.live --record`:\n{told}"

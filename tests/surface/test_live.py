"""What commands print on a mesh has the fields, and says the words, that it had before the rebuild."""

from __future__ import annotations

import json

import pytest

from tests.surface.compare import idle
from tests.surface.live import RECORDED, SECTION, differences, play

pytestmark = pytest.mark.live


def test_what_is_printed_on_a_mesh_is_as_it_was() -> None:
    found = differences(json.loads(RECORDED.read_text()), play())
    lost = [str(one) for one in found if not one.allowed]
    assert not lost, "mend it, or if it is meant list it in tests/surface/changes.py:\n" + "\n".join(lost)
    assert not idle(found, within=(SECTION,))

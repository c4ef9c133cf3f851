"""What all tests of the recorder share."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import rerun as rr


@pytest.fixture(autouse=True)
def _strict() -> Iterator[None]:
    """Rerun raises where it would only warn."""
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(False)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Of a recording."""
    return tmp_path / "run.rrd"

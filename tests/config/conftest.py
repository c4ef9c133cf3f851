"""Every test of this folder has a folder of its own as working directory, and no fleet from outside."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import pytest
from msgspec import inspect

from zscout.config.fleet import FLEET_VARIABLE

TYPE_INFO = cache(inspect.type_info)
"""That of a file takes 10 ms, and a process reads few files, but a test of this folder hundreds."""


@pytest.fixture(autouse=True)
def _in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(inspect, "type_info", TYPE_INFO)
    monkeypatch.delenv(FLEET_VARIABLE, raising=False)

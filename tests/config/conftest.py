"""Every test of this folder has a folder of its own as working directory, and no fleet from outside."""

from __future__ import annotations

from pathlib import Path

import pytest

from zscout.config.fleet import FLEET_VARIABLE


@pytest.fixture(autouse=True)
def _in_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv(FLEET_VARIABLE, raising=False)

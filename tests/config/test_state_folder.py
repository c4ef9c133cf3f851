"""Where a host keeps what must outlive its processes."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from zscout.config.state_folder import state_folder, write_durably


def test_the_folder_is_the_first_that_is_named(tmp_path: Path) -> None:
    env = {"STATE_DIRECTORY": f"{tmp_path}/unit:{tmp_path}/more", "XDG_STATE_HOME": f"{tmp_path}/home"}
    assert state_folder("lab", "anvil", tmp_path / "own", env) == tmp_path / "own" / "lab" / "anvil"
    assert state_folder("lab", "anvil", env=env) == tmp_path / "unit" / "lab" / "anvil"
    del env["STATE_DIRECTORY"]
    found = state_folder("lab", "anvil", env=env)
    assert found == tmp_path / "home" / "zscout" / "lab" / "anvil"
    assert found.is_dir()
    assert list(found.iterdir()) == []


def test_one_that_can_not_be_written_is_named_once_and_none(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "file").write_text("no folder")
    with caplog.at_level(logging.WARNING):
        assert state_folder("lab", "anvil", tmp_path / "file") is None
    assert "set `state` under [node]" in caplog.text


def test_a_file_is_written_whole_and_replaced_whole(tmp_path: Path) -> None:
    path = tmp_path / "robot" / "x"
    write_durably(path, b"one")
    write_durably(path, b"another")
    assert path.read_bytes() == b"another"
    assert [one.name for one in path.parent.iterdir()] == ["x"]

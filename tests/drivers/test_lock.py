"""One RC, one process: which locks keep two of one machine apart, and what other users of it can do to that."""

from __future__ import annotations

import hashlib
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from zscout.config.local_users import user_name
from zscout.drivers import lock
from zscout.drivers.lock import only_here
from zscout.mesh import MeshError

FLEET = f"locks-{os.getpid()}"
NOBODY = 65_534
LISTENS = """
import os, socket, sys
if sys.argv[3] != "None":
    os.setuid(int(sys.argv[3]))
with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as taken:
    taken.bind(sys.argv[1].replace("@", chr(0), 1))
    if sys.argv[2] == "listens":
        taken.listen()
    print("here", flush=True)
    sys.stdin.read()
"""


def name(rc: str = "robot/a") -> str:
    return f"@zscout-rc-{hashlib.sha256(f'{FLEET} anvil {rc}'.encode()).hexdigest()}"


@contextmanager
def taken(how: str = "listens", user: int | None = None) -> Iterator[int]:
    """Another process has the name; its process id."""
    pipe = subprocess.PIPE
    command = [sys.executable, "-c", LISTENS, name(), how, str(user)]
    with subprocess.Popen(command, stdin=pipe, stdout=pipe) as other:
        try:
            assert other.stdout is not None
            assert other.stdout.readline() == b"here\n"
            yield other.pid
        finally:
            other.kill()


def test_processes_of_one_state_folder_are_kept_apart(tmp_path: Path) -> None:
    with only_here(FLEET, "anvil", "robot/a", tmp_path):
        with (
            pytest.raises(MeshError, match="robot/a: another process on anvil serves it already; end that"),
            only_here("another", "anvil", "robot/a", tmp_path),
        ):
            pass
        with only_here(FLEET, "anvil", "robot/b", tmp_path), only_here(FLEET, "bellows", "robot/a"):
            pass
    with only_here(FLEET, "anvil", "robot/a", tmp_path):
        pass
    assert (tmp_path / "served" / "robot" / "a").stat().st_mode & 0o777 == 0o600


@pytest.mark.live
def test_processes_of_two_state_folders_are_kept_apart_by_the_name(tmp_path: Path) -> None:
    with taken() as pid, pytest.raises(MeshError, match=rf"serves it already \(process {pid} of user "):  # noqa: SIM117
        with only_here(FLEET, "anvil", "robot/a", tmp_path):
            pass
    with only_here(FLEET, "anvil", "robot/a", tmp_path):
        pass


@pytest.mark.live
@pytest.mark.skipif(os.geteuid() != 0, reason="only root can start a process of another user")
def test_another_user_is_named_and_stops_nobody(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with taken(user=NOBODY) as pid, only_here(FLEET, "anvil", "robot/a", tmp_path):
        # The file keeps processes of this user apart all the same.
        with pytest.raises(MeshError), only_here(FLEET, "anvil", "robot/a", tmp_path):
            pass
        (line,) = {record.message for record in caplog.records}
        user = user_name(NOBODY)
        assert line.startswith(f"robot/a: its lock is held by process {pid} of user {user}, which is not trusted")


@pytest.mark.live
def test_a_name_without_a_listener_stops_nobody(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with taken("binds"), only_here(FLEET, "anvil", "robot/a", tmp_path):
        assert "its lock is held by an unknown process" in caplog.text


def test_root_is_believed_by_everybody(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as held:
        held.bind(name().replace("@", "\0", 1))
        held.listen()
        for uid, believed in ((0, True), (os.geteuid(), True), (4711, False)):
            monkeypatch.setattr(lock, "_holder", lambda _, uid=uid: lock.LockHolder(1, uid))
            if believed:
                with pytest.raises(MeshError), only_here(FLEET, "anvil", "robot/a", tmp_path):
                    pass
            else:
                with only_here(FLEET, "anvil", "robot/a", tmp_path):
                    pass


def test_a_link_in_place_of_the_file_is_not_followed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "served" / "robot").mkdir(parents=True)
    (tmp_path / "served" / "robot" / "a").symlink_to(tmp_path / "precious")
    with only_here(FLEET, "anvil", "robot/a", tmp_path):
        assert "no lock in the state folder" in caplog.text
    assert not (tmp_path / "precious").exists()

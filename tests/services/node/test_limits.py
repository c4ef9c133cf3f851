"""Limits by control groups, where the kernel has them; files of one that has not are made by hand."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.hang import HANG
from zscout.services.node.limits import LEAF, PREFIX, ControlGroups

MEGABYTE = 1_000_000
V1 = Path("/sys/fs/cgroup/memory/tasks").exists() and Path("/sys/fs/cgroup/cpu/tasks").exists()
real = pytest.mark.skipif(not (V1 and os.geteuid() == 0), reason="this host lets us make no groups of v1")


@pytest.fixture
def waiting() -> Iterator[subprocess.Popen[bytes]]:
    """A process that computes and then uses memory, once it is told to."""
    code = "import sys; sys.stdin.readline(); x = b'x' * int(sys.argv[1]); print(len(x))"
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(200 * MEGABYTE)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    yield process
    process.kill()
    process.communicate()


@pytest.mark.live
@real
def test_who_uses_more_than_the_limit_is_killed_and_it_is_known_why(waiting: subprocess.Popen[bytes]) -> None:
    group = ControlGroups().group("test.1", memory=100 * MEGABYTE, cpu=0)
    try:
        assert (group.memory_set, group.missing, group.each) == (True, "", 0)
        group.enter(waiting.pid)
        assert not group.overdrawn()
        waiting.communicate(b"\n", timeout=HANG)
        assert waiting.returncode == -9
        assert group.overdrawn()
    finally:
        folders = list(group.folders)
        group.close()
    assert [folder for folder in folders if folder.exists()] == []


@pytest.mark.live
@real
def test_who_stays_below_it_is_left_alone_and_a_group_closes_on_who_is_in_it(waiting: subprocess.Popen[bytes]) -> None:
    group = ControlGroups().group("test.2", memory=400 * MEGABYTE, cpu=1.5)
    try:
        group.enter(waiting.pid)
        assert waiting.stdin is not None
        assert waiting.stdout is not None
        waiting.stdin.write(b"\n")
        waiting.stdin.flush()
        assert waiting.stdout.readline() == b"200000000\n"
        assert not group.overdrawn()
    finally:
        folders = list(group.folders)
        group.close()
    assert folders
    assert [folder for folder in folders if folder.exists()] == []


@pytest.mark.live
@real
def test_a_process_gets_the_share_of_a_core_that_it_may_have() -> None:
    group = ControlGroups().group("test.3", memory=0, cpu=0.25)
    code = "import time\nend = time.monotonic() + 1.5\nwhile time.monotonic() < end: pass\nprint(time.process_time())"
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
    try:
        group.enter(process.pid)
        group.settle()
        used, _ = process.communicate(timeout=HANG)
    finally:
        process.kill()
        group.close()
    assert 0.1 < float(used) < 0.75


@pytest.mark.live
@real
def test_what_a_killed_node_left_is_swept_away_and_what_lives_stays() -> None:
    dead = subprocess.Popen(["true"])
    dead.wait()
    top = Path("/sys/fs/cgroup/cpu")
    ours, left = top / f"{PREFIX}{os.getpid()}.a.1", top / f"{PREFIX}{dead.pid}.a.1"
    try:
        for folder in (ours, left):
            folder.mkdir()
        ControlGroups().sweep()
        assert ours.exists()
        assert not left.exists()
    finally:
        ours.rmdir()


def test_a_host_without_groups_says_which_limits_it_can_not_set(tmp_path: Path) -> None:
    limits = ControlGroups(tmp_path, tmp_path / "none")
    group = limits.group("a.1", memory=MEGABYTE, cpu=0.5)
    assert (group.memory_set, group.cpu_set, group.folders) == (False, False, [])
    assert group.each == MEGABYTE
    assert "memory_limit holds for each of its processes" in group.missing
    assert "cpu_limit can't be set" in group.missing
    group.enter(os.getpid())
    group.close()
    limits.sweep()
    free = limits.group("a.1", memory=0, cpu=0)
    assert (free.missing, free.each) == ("", 0)


def unified(root: Path, *, enabled: str, residents: str = "") -> Path:
    """The files of a delegated group of v2, and of the group that is made below it: no kernel makes them."""
    base = root / "system.slice" / "zscout.service"
    for folder in (base, base / LEAF, base / f"{PREFIX}{os.getpid()}.a.1"):
        folder.mkdir(parents=True)
        for name in ("cgroup.procs", "memory.max", "memory.swap.max", "memory.oom.group", "cpu.max"):
            (folder / name).write_text("")
    (base / "cgroup.controllers").write_text("cpu memory pids\n")
    (base / "cgroup.subtree_control").write_text(enabled)
    (base / "cgroup.procs").write_text(residents)
    (root / "own").write_text("0::/system.slice/zscout.service\n")
    return base


def test_limits_of_v2_are_written_as_the_kernel_takes_them(tmp_path: Path) -> None:
    base = unified(tmp_path, enabled="cpu memory\n")
    group = ControlGroups(tmp_path, tmp_path / "own").group("a.1", memory=5 * MEGABYTE, cpu=0.5)
    assert group.missing == ""
    (folder,) = group.folders
    assert folder.parent == base
    files = ("memory.max", "memory.swap.max", "memory.oom.group", "cpu.max")
    assert [(folder / name).read_text() for name in files] == ["5000000", "0", "1", "100000 100000"]
    group.settle()
    assert (folder / "cpu.max").read_text() == "50000 100000"
    (folder / "memory.events").write_text("low 0\noom 2\noom_kill 1\n")
    assert group.overdrawn()
    group.enter(4711)
    assert (folder / "cgroup.procs").read_text() == "4711"
    (folder / "cgroup.procs").write_text("")


def test_controllers_of_v2_are_given_on(tmp_path: Path) -> None:
    base = unified(tmp_path, enabled="")
    group = ControlGroups(tmp_path, tmp_path / "own").group("a.1", memory=MEGABYTE, cpu=0)
    assert group.memory_set
    assert (base / "cgroup.subtree_control").read_text() == "+memory"


def test_a_group_of_v2_without_a_controller_sets_no_limit(tmp_path: Path) -> None:
    base = unified(tmp_path, enabled="")
    (base / "cgroup.controllers").write_text("pids\n")
    group = ControlGroups(tmp_path, tmp_path / "own").group("a.1", memory=MEGABYTE, cpu=1)
    assert (group.memory_set, group.cpu_set) == (False, False)


@pytest.mark.live
def test_memory_is_limited_by_the_process_itself_where_no_group_does_it() -> None:
    code = (
        "from zscout.behaviors.components.processes import limit_allocations\n"
        "limit_allocations(200_000_000)\n"
        "x = bytearray(100_000_000)\n"
        "try:\n    bytearray(200_000_000)\n"
        "except MemoryError:\n    print('refused')\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=HANG)
    assert done.stdout == "refused\n"


@pytest.mark.live
def test_a_family_is_killed_whatever_groups_it_is_in() -> None:
    tag = f"t-{os.getpid()}-1"  # no other suite's on this machine
    code = (
        "import os; from zscout.behaviors.components.processes import kill_family\n"
        f"print(kill_family('{tag}', spare=os.getpid()), kill_family('{tag}', spare=os.getpid()))"
    )
    env = os.environ | {"ZSCOUT_COMPONENT": tag}
    family = [subprocess.Popen(["sleep", "60"], env=env, start_new_session=apart) for apart in (True, False)]
    other = subprocess.Popen(["sleep", "60"], env=os.environ | {"ZSCOUT_COMPONENT": f"{tag}1"})
    try:
        done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, timeout=HANG)
        assert done.stdout == "2 0\n"
        assert [process.wait(10) for process in family] == [-9, -9]
        assert other.poll() is None
    finally:
        for process in (*family, other):
            process.kill()
            process.wait()

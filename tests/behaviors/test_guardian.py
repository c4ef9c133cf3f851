"""The guardian of a command, with real processes: whose end it waits for, when it ends them, and that none is left."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import IO

import pytest

from tests.cli.tools import gone
from tests.hang import HANG
from zscout.behaviors.guardian import CGROUP_ROOTS, GUARD, ControlGroup, Ending, now

SECOND = 1_000_000_000
OWN_SESSION = "setsid sh -c 'trap \"\" TERM; echo $$ > $0/grandchild; sleep 1000; sleep 1000' $0 &"
"""Of a shell whose $0 is a folder: a grandchild in a session of its own that ignores SIGTERM. Its parent may go."""


class Guarded:
    """A command under its guardian, and what that has said to its client: this test."""

    def __init__(self, ours: socket.socket, guardian: subprocess.Popen[str]) -> None:
        self._ours, self.guardian = ours, guardian
        ours.settimeout(HANG)
        self._lines: IO[str] = ours.makefile("r")

    def say(self, words: str) -> None:
        self._ours.send(f"{words}\n".encode())

    def hears(self) -> str:
        """What it says next; empty at its end."""
        return self._lines.readline().strip()

    def hears_rest(self) -> list[str]:
        return self._lines.read().splitlines()

    def leave(self) -> None:
        """The client is gone."""
        self._ours.shutdown(socket.SHUT_RDWR)

    @property
    def out(self) -> IO[str]:
        assert self.guardian.stdout is not None
        return self.guardian.stdout


@contextmanager
def guarded(
    *command: str, grace: float = 0.2, until: int | None = None, before: Sequence[str] = ()
) -> Iterator[Guarded]:
    ours, theirs = socket.socketpair()
    with closing(theirs):
        if until is not None:
            ours.send(f"until {until}\n".encode())
        start = [*before, *GUARD, str(theirs.fileno()), "-1", str(round(grace * SECOND)), *command]
        guardian = subprocess.Popen(
            start, pass_fds=[theirs.fileno()], stdout=subprocess.PIPE, text=True, process_group=0
        )
        theirs.close()
        with guardian, closing(ours):
            yield Guarded(ours, guardian)


def lives(pid: int) -> bool:
    return Path(f"/proc/{pid}").exists()


def pid_in(file: Path) -> int:
    return int(file.read_text())


def shell(folder: Path, script: str) -> tuple[str, ...]:
    return "sh", "-c", script, str(folder)


# When: pure


def test_a_deadline_that_is_renewed_is_not_due() -> None:
    ending = Ending(grace=3)
    ending.renew(10)
    assert not ending.due(9)
    ending.renew(20)
    assert not ending.due(19)
    assert ending.due(20)
    ending.begin(20)
    ending.renew(90)  # too late: it was told to end
    assert (ending.next(), [ending.kills(at) for at in (22, 23)]) == (23, [False, True])


def test_the_grace_begins_at_the_deadline_though_nobody_was_awake_then() -> None:
    ending = Ending(grace=3)
    ending.renew(10)
    ending.begin(600)
    assert ending.kills(600)


def test_the_grace_begins_at_the_order_where_the_deadline_is_later() -> None:
    ending = Ending(grace=3)
    ending.renew(10)
    ending.begin(4)
    ending.begin(6)
    assert [ending.kills(at) for at in (6, 7)] == [False, True]
    ending = Ending(grace=3)
    ending.hurry(4)
    assert ending.kills(4)


# With processes


@pytest.mark.live
def test_the_end_is_told_when_the_last_process_is_gone(tmp_path: Path) -> None:
    script = f"{OWN_SESSION} while [ ! -s $0/grandchild ]; do sleep 0.01; done; exit 3"
    with guarded(*shell(tmp_path, script), grace=HANG) as command:
        assert command.hears().startswith("started ")
        assert command.hears() == "exited 3"
        assert lives(pid_in(tmp_path / "grandchild"))
        command.say("kill")
        assert command.hears() == "gone"
        assert not lives(pid_in(tmp_path / "grandchild"))
        assert command.guardian.wait(HANG) == 0


@pytest.mark.live
def test_all_of_it_is_killed_when_the_client_is_gone(tmp_path: Path) -> None:
    script = f"trap '' TERM; {OWN_SESSION} while [ ! -s $0/grandchild ]; do sleep 0.01; done; echo ready; wait"
    with guarded(*shell(tmp_path, script), grace=0.2) as command:
        pid = int(command.hears().split()[1])
        assert command.out.readline() == "ready\n"
        command.leave()
        assert command.guardian.wait(HANG) == 0
        assert not lives(pid)
        assert not lives(pid_in(tmp_path / "grandchild"))


@pytest.mark.live
@pytest.mark.slow
def test_a_stubborn_one_is_told_first_and_killed_after_the_grace(tmp_path: Path) -> None:
    script = "trap 'echo told' TERM; echo ready; while :; do sleep 0.02; done"
    # Within the grace the shell has to come to its trap, though it stands still.
    with guarded(*shell(tmp_path, script), grace=4) as command:
        command.out.readline()
        before = now()
        command.say(f"end {now()}")
        assert command.out.readline() == "told\n"
        assert command.hears_rest()[1:] == ["ending client", "exited -9", "gone"]
        assert now() - before >= 4 * SECOND


@pytest.mark.live
def test_who_may_not_wait_kills_at_once(tmp_path: Path) -> None:
    with guarded(*shell(tmp_path, "trap '' TERM; echo ready; while :; do sleep 0.02; done"), grace=HANG) as command:
        command.out.readline()
        command.say(f"end {now()}")
        command.say("kill")
        assert command.hears_rest()[1:] == ["ending client", "exited -9", "gone"]


@pytest.mark.live
def test_it_is_ended_at_the_deadline_that_was_given_last_though_the_client_says_nothing(tmp_path: Path) -> None:
    script, begin = "trap '' TERM; echo ready; while :; do sleep 0.02; done", now()
    with guarded(*shell(tmp_path, script), grace=0.2, until=begin + round(HANG * SECOND)) as command:
        command.out.readline()
        begin = now()
        command.say(f"until {begin + SECOND // 2}")
        assert command.hears_rest()[1:] == ["ending deadline", "exited -9", "gone"]
        assert now() - begin >= 0.7 * SECOND


@pytest.mark.live
def test_nothing_is_started_after_the_deadline(tmp_path: Path) -> None:
    with guarded("touch", str(tmp_path / "ran"), until=now() - 1) as command:
        assert command.hears_rest() == ["ending deadline", "gone"]
    assert not (tmp_path / "ran").exists()


@pytest.mark.live
def test_a_stopped_one_hears_of_its_end(tmp_path: Path) -> None:
    script = (
        f"{OWN_SESSION.replace(' TERM', ' HUP')} while [ ! -s $0/grandchild ]; do sleep 0.01; done; echo ready; wait"
    )
    with guarded(*shell(tmp_path, script), grace=HANG) as command:
        pid = int(command.hears().split()[1])
        command.out.readline()
        for one in (pid, pid_in(tmp_path / "grandchild")):
            os.kill(one, signal.SIGSTOP)
        assert command.hears() == f"stopped {signal.SIGSTOP.value}"
        command.say(f"end {now()}")
        assert command.hears_rest() == ["ending client", "exited -15", "gone"]


@pytest.mark.live
def test_the_command_dies_with_its_guardian() -> None:
    with guarded("sleep", "1000") as command:
        pid = int(command.hears().split()[1])
        command.guardian.kill()
        assert gone(pid)
        for left in Path(CGROUP_ROOTS[0]).rglob(f"zscout.{command.guardian.pid}.request"):
            left.rmdir()


@pytest.mark.live
def test_all_in_a_control_group_are_killed_as_one() -> None:
    group = ControlGroup()
    if not group:
        pytest.skip("no control group (v2) may be made here")
    with subprocess.Popen(["sleep", "1000"], preexec_fn=group.enter) as inside:
        group.kill()
        assert inside.wait(HANG) == -signal.SIGKILL
    folder = Path(group.folder or "")
    assert folder.exists()
    group.close()
    assert not folder.exists()


@pytest.mark.live
def test_a_command_is_in_the_group_that_its_guardian_kills() -> None:
    if not (group := ControlGroup()):
        pytest.skip("no control group (v2) may be made here")
    group.close()
    with guarded("cat", "/proc/self/cgroup") as command:
        assert command.out.read().endswith(f"/zscout.{command.guardian.pid}.request\n")


@pytest.mark.live
def test_what_can_not_be_executed_is_said_with_its_code(tmp_path: Path) -> None:
    with guarded(str(tmp_path / "missing")) as command:
        assert command.hears_rest()[1:] == ["exited 127", "gone"]
    with guarded(str(tmp_path)) as command:
        assert command.hears_rest()[1:] == ["exited 126", "gone"]


HIDDEN = ("unshare", "--mount", "sh", "-c", 'mount -t tmpfs none /proc && exec "$@"', "sh")
"""Runs the arguments behind it with an empty /proc."""


@pytest.mark.live
@pytest.mark.parametrize("own_session", [False, True])
def test_where_proc_is_hidden_its_group_is_ended_and_what_left_it_is_named(own_session: bool, tmp_path: Path) -> None:
    if subprocess.run([*HIDDEN, "true"], check=False, capture_output=True).returncode:
        pytest.skip("only root may hide /proc")
    start = f"trap '' TERM; {'setsid ' * own_session}sleep 1000 & echo $! > $0/child"
    with guarded(*shell(tmp_path, start), before=HIDDEN) as run:
        assert run.hears().startswith("started ")
        assert run.hears() == "exited 0"
        if own_session:
            assert run.hears() == "stuck 0"
            os.kill(pid_in(tmp_path / "child"), signal.SIGKILL)
        assert run.hears_rest() == ["gone"]
        assert not lives(pid_in(tmp_path / "child"))


@pytest.mark.live
def test_a_signal_waits_until_the_command_catches_it(tmp_path: Path) -> None:
    script = "echo begun; read go < $0/go; trap 'echo caught; exit 3' USR1; while :; do sleep 0.01; done"
    os.mkfifo(tmp_path / "go")
    with guarded(*shell(tmp_path, script), until=now() + round(HANG * SECOND)) as command:
        assert command.hears().startswith("started ")
        assert command.out.readline() == "begun\n"
        command.say(f"signal {int(signal.SIGUSR1)}")
        with (tmp_path / "go").open("w") as go:
            go.write("go\n")
        assert command.out.readline() == "caught\n"
        assert command.hears_rest() == ["exited 3", "gone"]

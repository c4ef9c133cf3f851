"""A machine whose PID 1 is systemd, to run the units of `deploy/` as they are: in namespaces of this machine, on a copy
of its file system. It shares the network, so that a client here finds the node there."""

from __future__ import annotations

import os
import shutil
import signal
import site
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import psutil

from tests.hang import HANG

HERE: Final = Path(__file__).parent
PROJECT: Final = HERE.parents[1]
SYSTEMD: Final = Path("/lib/systemd/systemd")
GROUPS: Final = Path("/sys/fs/cgroup")
PAUSE: Final = 0.05


def missing() -> str:
    """Why there can be no such machine here; empty if there can be."""
    if os.geteuid() != 0:
        return "systemd in namespaces needs root"
    if not SYSTEMD.exists() or shutil.which("systemd-sysusers") is None:
        return "systemd is missing: install the package systemd"
    if not _unified().is_dir():
        return "there are no control groups of version 2 here"
    probe = "mount -t tmpfs t /tmp && cd /tmp && mkdir u w r && mount -t overlay -o lowerdir=/,upperdir=u,workdir=w o r"
    words = ("unshare", "--mount", "--cgroup", "--pid", "--fork", "sh", "-c", probe)
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=HANG)
    return f"no namespaces or overlays here: {done.stderr.strip()}" if done.returncode else ""


def _unified() -> Path:
    return GROUPS if (GROUPS / "cgroup.controllers").exists() else GROUPS / "unified"


class Machine:
    """`folder` is its own. `installed`: with the units of this tree, which run zscout from its source; else there are
    only a Python in /opt/zscout/python and this tree in /opt/zscout/project. All that runs there ends with it."""

    def __init__(self, folder: Path, *, installed: bool = True) -> None:
        self._folder = folder
        self._group = _unified() / f"zscout-machine-{os.getpid()}"
        self._group.mkdir()
        program = [str(HERE / "machine.sh"), str(folder), str(PROJECT), site.getsitepackages()[0], sys.base_prefix]
        program.append("yes" if installed else "no")
        enter = f'echo $$ >{self._group}/cgroup.procs && exec unshare --mount --uts --ipc --cgroup bash "$@"'
        with (folder / "systemd.log").open("wb") as log:
            self._process = subprocess.Popen(["sh", "-c", enter, "sh", *program], stdout=log, stderr=log)
        try:
            self._pid = self._begin()
        except BaseException:
            self.close()
            raise

    def _begin(self) -> int:
        end = time.monotonic() + HANG
        while time.monotonic() < end and self._process.poll() is None:
            for child in psutil.Process(self._process.pid).children(recursive=True):
                with suppress(psutil.Error):
                    if child.name() == "systemd":
                        self._pid = child.pid
                        if self._run("systemctl", "is-active", "machine.target").stdout == "active\n":
                            return child.pid
            time.sleep(PAUSE)
        raise AssertionError(f"systemd does not run:\n{(self._folder / 'systemd.log').read_text()}")

    def _run(self, *command: str, timeout: float = HANG) -> subprocess.CompletedProcess[str]:
        words = ["nsenter", f"--target={self._pid}", "--mount", "--pid", "--cgroup", "--root", "--wd", *command]
        return subprocess.run(words, capture_output=True, text=True, check=False, timeout=timeout)

    def run(self, *command: str, timeout: float = HANG) -> str:
        """Runs a program there, as root; returns what it writes."""
        done = self._run(*command, timeout=timeout)
        assert done.returncode == 0, f"{command}: {done.stdout}{done.stderr}\n{self.log()}"
        return done.stdout

    def until_says(self, text: str, *command: str) -> None:
        """Runs a program there until it ends with 0 and writes that: what it asks may not have begun."""
        end = time.monotonic() + HANG
        while (done := self._run(*command)).returncode or text not in done.stdout:
            assert time.monotonic() < end, f"{command}: {done.stdout}{done.stderr}\n{self.log()}"

    def fails(self, *command: str, timeout: float = HANG) -> str:
        """Runs a program that has to fail; returns what it says of it."""
        done = self._run(*command, timeout=timeout)
        assert done.returncode != 0
        return done.stderr

    def path(self, path: str) -> Path:
        """A file there, as it is called here."""
        return Path(f"/proc/{self._pid}/root", path.removeprefix("/"))

    def write(self, path: str, text: str) -> None:
        self.path(path).parent.mkdir(exist_ok=True, parents=True)
        self.path(path).write_text(text)

    def show(self, unit: str, *names: str) -> dict[str, str]:
        """Properties of a unit, as systemd has them."""
        lines = self.run("systemctl", "show", unit, f"--property={','.join(names)}").splitlines()
        return dict(line.split("=", 1) for line in lines)

    def until(self, unit: str, **wanted: str) -> dict[str, str]:
        """Waits until a unit has these properties."""
        end = time.monotonic() + HANG
        while (found := self.show(unit, *wanted)) != wanted:
            assert time.monotonic() < end, f"{found}\n{self.log()}"
            time.sleep(PAUSE)
        return found

    def until_logged(self, text: str) -> None:
        """Waits until the services have written it."""
        end = time.monotonic() + HANG
        while text not in self.log():
            assert time.monotonic() < end, self.log()
            time.sleep(PAUSE)

    def process(self, unit: str) -> psutil.Process:
        """The main process of a unit, as this machine sees it."""
        inside = int(self.show(unit, "MainPID")["MainPID"])
        for child in psutil.Process(self._pid).children(recursive=True):
            with suppress(psutil.Error, OSError):
                lines = Path(f"/proc/{child.pid}/status").read_text().splitlines()
                if next(line for line in lines if line.startswith("NSpid:")).split()[-1] == str(inside):
                    return child
        raise AssertionError(f"{unit} has no process {inside}")

    def log(self) -> str:
        """What the services wrote."""
        file = self.path("/var/log/zscout.log")
        return file.read_text() if file.exists() else ""

    def close(self) -> None:
        with suppress(ProcessLookupError):
            for pid in (self._group / "cgroup.procs").read_text().split():
                os.kill(int(pid), signal.SIGKILL)
        self._process.kill()
        self._process.wait()
        end = time.monotonic() + HANG
        while self._group.exists() and time.monotonic() < end:
            for group in sorted(self._group.rglob("*"), reverse=True):
                if group.is_dir():
                    with suppress(OSError):
                        group.rmdir()
            with suppress(OSError):
                self._group.rmdir()
            time.sleep(PAUSE)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

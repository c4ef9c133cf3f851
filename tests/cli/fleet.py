"""A real fleet for tests of the `zscout` command, driven from plain functions."""

from __future__ import annotations

import asyncio
import json
import os
import pty
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any

from tests.live.lab import START, Lab
from zscout.behaviors.blocking import connect
from zscout.messages import RcmState

# Makes the terminal that it has as stdin its controlling one: what a terminal window does for its shell.
OWN_TERMINAL = (
    "import fcntl, os, sys, termios; os.setsid(); fcntl.ioctl(0, termios.TIOCSCTTY, 0); "
    "os.execvp(sys.argv[1], sys.argv[1:])"
)
ZSCOUT = [sys.executable, "-m", "zscout.cli.main"]


class CliFleet:
    """One node with RCs, and `zscout` processes that use it."""

    def __init__(self, folder: Path) -> None:
        self.lab = Lab(folder)
        self.folder = folder
        self._started: list[subprocess.Popen[str]] = []
        self._eye = connect("eye", fleet=self.lab.fleet, host="test")

    def zscout(self, *args: str, stdin: str | None = None) -> subprocess.CompletedProcess[str]:
        """Runs a command to its end, away from any terminal."""
        return subprocess.run(
            [*ZSCOUT, *args],
            env=self.lab.env,
            input=stdin or "",
            capture_output=True,
            text=True,
            timeout=START,
        )

    def start(self, *args: str) -> subprocess.Popen[str]:
        """Starts a command; stdout and stderr come out of `.stdout`."""
        process = subprocess.Popen(
            [*ZSCOUT, *args],
            env=self.lab.env,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            bufsize=1,
        )
        self._started.append(process)
        return process

    def holder(self, name: str, *args: str) -> subprocess.Popen[str]:
        """A request that holds already when this returns."""
        process = self.start("request", "--name", name, *args)
        read_until(process, f"{name} holds")
        return process

    def state(self, until: Callable[[RcmState], bool]) -> RcmState:
        """The RCM's state as soon as `until` holds of it."""
        return self._eye.run(self.lab.state(self._eye.client, until))

    def idle(self, *rcs: str) -> bool:
        """Returns when nobody holds or waits for these RCs."""

        def nobody(state: RcmState) -> bool:
            needed = [view.needs for view in state.holds] + [view.needs for view in state.queue]
            return not any(rc in needs for rc in rcs for needs in needed)

        self.state(nobody)
        return True

    @contextmanager
    def terminal(self, *args: str) -> Iterator[Terminal]:
        """Runs a command at a terminal of its own."""
        ours, theirs = pty.openpty()
        process = subprocess.Popen(
            [sys.executable, "-c", OWN_TERMINAL, *ZSCOUT, *args],
            env=self.lab.env | {"TERM": "xterm", "COLUMNS": "120"},
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            text=True,
        )
        os.close(theirs)
        self._started.append(process)
        try:
            yield Terminal(process, ours)
        finally:
            end(process)
            os.close(ours)

    def close(self) -> None:
        for process in self._started:
            end(process)
        self._eye.close()
        asyncio.run(self.lab.__aexit__(None, None, None))


class Terminal:
    """The person at a terminal: reads the screen's bytes, types."""

    def __init__(self, process: subprocess.Popen[str], fd: int) -> None:
        self.process, self._fd = process, fd
        self.seen = ""

    def until(self, text: str) -> str:
        """All that was shown, as soon as `text` is among it; what came before is forgotten."""
        before = time.monotonic()
        while text not in self.seen:
            left = START - (time.monotonic() - before)
            ready, _, _ = select.select([self._fd], [], [], max(0.0, left))
            assert ready, f"waited in vain for {text!r} in {self.seen!r}"
            try:
                data = os.read(self._fd, 65_536)
            except OSError:  # EIO: the last program at the terminal has gone
                data = b""
            assert data, f"the terminal was left without {text!r} in {self.seen!r}"
            self.seen += data.decode(errors="replace")
        at = self.seen.index(text) + len(text)
        shown, self.seen = self.seen[:at], self.seen[at:]
        return shown

    def type(self, text: str) -> None:
        os.write(self._fd, text.encode())

    def code(self) -> int:
        """The exit code, as soon as there is one."""
        return self.process.wait(START)


@contextmanager
def fleet_of(folder: Path, *rcs: str) -> Iterator[CliFleet]:
    """A fleet of one node with these RCs, ready."""
    fleet = CliFleet(folder)
    try:
        fleet.lab.node("anvil", *rcs)
        wanted = {rc.partition(":")[0] for rc in rcs}
        fleet.state(lambda state: wanted <= {view.rc for view in state.rcs if view.present})
        yield fleet
    finally:
        fleet.close()


def end(process: subprocess.Popen[str]) -> None:
    if process.poll() is None:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(START)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    if process.stdout is not None:
        process.stdout.close()


def read_until(process: subprocess.Popen[str], text: str) -> list[str]:
    """The lines up to the one that has `text`; the process's own end is the limit."""
    lines: list[str] = []
    for line in out_of(process):
        lines.append(line.rstrip("\n"))
        if text in line:
            return lines
    raise AssertionError(f"waited in vain for {text!r} in {lines}")


def out_of(process: subprocess.Popen[str]) -> IO[str]:
    assert process.stdout is not None
    return process.stdout


def events(text: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in text.splitlines()]


def gone(pid: int) -> bool:
    """True as soon as a process is dead (a zombie is), False if it is not within START."""
    before = time.monotonic()
    while time.monotonic() - before < START:
        try:
            if "\nState:\tZ" in Path(f"/proc/{pid}/status").read_text():
                return True
        except (FileNotFoundError, ProcessLookupError):
            return True
        time.sleep(0.02)
    return False

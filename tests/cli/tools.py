"""The `zscout` command as people and programs run it: in a pipe, and at a terminal."""

from __future__ import annotations

import asyncio
import fcntl
import getpass
import json
import os
import re
import select
import socket
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Self

from tests.hang import HANG
from zscout.behaviors.client.identity import this_program
from zscout.cli.main import main
from zscout.keyexpr import valid_name

COMMAND = (sys.executable, "-m", "zscout.cli.main")
# Makes the terminal that it has as stdin its controlling one: what a terminal window does for its shell.
OWN_TERMINAL = (
    "import fcntl, os, sys, termios; os.setsid(); fcntl.ioctl(0, termios.TIOCSCTTY, 0); "
    "os.execvp(sys.argv[1], sys.argv[1:])"
)
CLOCK = r"(?:[A-Z][a-z]{2} \d\d? |\d{4}-\d\d-\d\d )?\d\d:\d\d(:\d\d)?"
"""A time of day, with its date where that is another: a test may run before midnight."""
_ESCAPE = re.compile(r"\x1b(\[[0-9;?]*[A-Za-z]|[=>])")


def zscout(*args: object, env: Mapping[str, str] | None = None, stdin: str = "") -> subprocess.CompletedProcess[str]:
    """Runs it in a pipe, to its end."""
    command = [*COMMAND, *map(str, args)]
    return subprocess.run(command, env=env, input=stdin, capture_output=True, text=True, timeout=HANG)


def zscout_until(
    condition: Callable[[subprocess.CompletedProcess[str]], object],
    *args: object,
    env: Mapping[str, str] | None = None,
    stdin: str = "",
) -> subprocess.CompletedProcess[str]:
    """Runs it again until what came of it is so, as people do: a session that was just opened sees one host after the
    other, and each has a second or two for its answer."""
    began = time.monotonic()
    while not condition(done := zscout(*args, env=env, stdin=stdin)):
        assert time.monotonic() - began < HANG, done
    return done


def program_until_in_time(
    *command: str, env: Mapping[str, str], cwd: Path | None = None
) -> subprocess.CompletedProcess[str]:
    """Runs a program that holds and commands to its end, again where it says that a node which stood still was too
    late: to confirm its grant within a second, or to do as it is told within one."""
    began = time.monotonic()
    while True:
        done = subprocess.run(command, env=env, cwd=cwd, capture_output=True, text=True, timeout=HANG)
        late = any(word in done.stderr for word in ("CommandRefused: ", "Revoked: ", "NoRcm: "))
        if done.returncode == 0 or not late or time.monotonic() - began > HANG:
            return done


def by(command: str) -> str:
    """Whose a request of such a command, started here, is said to be."""
    host = os.environ.get("ZSCOUT_HOST") or valid_name(socket.gethostname())
    return f"{getpass.getuser()}@{host} ({command})"


def held_by(name: str) -> str:
    """The request of `zscout request --name NAME`, and its person."""
    return f"{name} ({by('').partition(' ')[0]})"


def own(name: str) -> str:
    """The same, as another one of the same person names it that waits for it."""
    return f"your own request {name}"


def mine(name: str) -> str:
    """A request of a client in this process, and its person."""
    return f"{name} ({ours().partition(' ')[0]})"


def ours() -> str:
    """Whose those of clients in this process are."""
    who = this_program("test")
    return f"{who.user}@{who.host} ({who.command})"


def zscout_here(*args: object) -> int:
    """Runs it in this process, which is quick; returns the exit code. Read what it says with capsys."""
    code = main.main([str(arg) for arg in args], standalone_mode=False)
    return code if isinstance(code, int) else 0


async def zscout_soon(*args: object, env: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
    """The same, while this process's own clients go on."""
    return await asyncio.to_thread(zscout, *args, env=env)


async def zscout_soon_until(
    condition: Callable[[subprocess.CompletedProcess[str]], object], *args: object, env: Mapping[str, str]
) -> subprocess.CompletedProcess[str]:
    """`zscout_until`, while this process's own clients go on."""
    return await asyncio.to_thread(zscout_until, condition, *args, env=env)


class Terminal:
    """The person at a terminal of this size, which is the command's own: Ctrl-C reaches it."""

    def __init__(
        self,
        *args: object,
        command: Sequence[str] = COMMAND,
        env: Mapping[str, str] | None = None,
        columns: int = 120,
        lines: int = 40,
    ) -> None:
        self._ours, self._theirs = os.openpty()
        fcntl.ioctl(self._theirs, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))
        clean = {key: value for key, value in (env or os.environ).items() if key not in ("COLUMNS", "LINES")}
        self.process = subprocess.Popen(
            [sys.executable, "-c", OWN_TERMINAL, *command, *map(str, args)],
            stdin=self._theirs,
            stdout=self._theirs,
            stderr=self._theirs,
            env=clean | {"TERM": "xterm-256color"},
            text=True,
        )
        self.raw = ""
        self._looked = 0

    @property
    def text(self) -> str:
        """All that was drawn, without escape sequences."""
        return _ESCAPE.sub("", self.raw).replace("\r", "")

    @property
    def modes(self) -> Sequence[object]:
        """The terminal's settings, as termios has them."""
        return termios.tcgetattr(self._theirs)

    def until(self, words: str) -> str:
        """What was drawn since the last look, as soon as these words are among it."""
        deadline = time.monotonic() + HANG
        while (at := self.text.find(words, self._looked)) < 0:
            assert time.monotonic() < deadline, f"waited in vain for {words!r}: {self.text}"
            ended = self.process.poll() is not None
            assert self._read(0.1) or not ended, f"ended without {words!r}: {self.text}"
        begin, self._looked = self._looked, at + len(words)
        return self.text[begin : self._looked]

    def press(self, keys: str) -> None:
        os.write(self._ours, keys.encode())

    def code(self) -> int:
        """Waits for its end; the exit code."""
        deadline = time.monotonic() + HANG
        while self.process.poll() is None:
            assert time.monotonic() < deadline, f"never ended: {self.text}"
            self._read(0.1)
        while self._read(0.0):
            pass
        return self.process.returncode

    def _read(self, seconds: float) -> bool:
        ready, _, _ = select.select([self._ours], [], [], seconds)
        if ready:
            self.raw += os.read(self._ours, 65_536).decode(errors="replace")
        return bool(ready)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        end(self.process)
        os.close(self._ours)
        os.close(self._theirs)


def end(process: subprocess.Popen[str]) -> None:
    """Ends a command in order; what does not obey is killed."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(HANG)
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
    """What `--json` printed, line by line."""
    return [json.loads(line) for line in text.splitlines()]


def course(text: str) -> list[dict[str, Any]]:
    """The same without how it waited: an RC that stood still confirms a grant too late, which is asked for again."""
    return [event for event in events(text) if event["event"] not in ("waits", "settling")]


def gone(pid: int) -> bool:
    """True as soon as a process is dead (a zombie is), False if it is not within HANG."""
    before = time.monotonic()
    while time.monotonic() - before < HANG:
        try:
            if "\nState:\tZ" in Path(f"/proc/{pid}/status").read_text():
                return True
        except (FileNotFoundError, ProcessLookupError):
            return True
        time.sleep(0.02)
    return False

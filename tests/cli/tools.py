"""The `zscout` command as people and programs run it: in a pipe, and at a terminal."""

from __future__ import annotations

import asyncio
import fcntl
import os
import re
import select
import signal
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Mapping, Sequence
from types import TracebackType
from typing import Self

from zscout.cli.main import main

COMMAND = (sys.executable, "-m", "zscout.cli.main")
PATIENCE = 30.0
"""Seconds within which anything that is waited for must have come true, on a busy machine."""
_ESCAPE = re.compile(r"\x1b(\[[0-9;?]*[A-Za-z]|[=>])")


def zscout(*args: object, env: Mapping[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    """Runs it in a pipe, to its end."""
    command = [*COMMAND, *map(str, args)]
    return subprocess.run(command, env=env, capture_output=True, text=True, timeout=PATIENCE, check=False)


def zscout_here(*args: object) -> int:
    """Runs it in this process, which is quick; returns the exit code. Read what it says with capsys."""
    code = main.main([str(arg) for arg in args], standalone_mode=False)
    return code if isinstance(code, int) else 0


async def zscout_soon(*args: object, env: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
    """The same, while this process's own clients go on."""
    return await asyncio.to_thread(zscout, *args, env=env)


class Terminal:
    """A command at a terminal of this size. What it draws is kept in `text`, without escape sequences."""

    def __init__(
        self, *args: object, env: Mapping[str, str] | None = None, columns: int = 120, lines: int = 40
    ) -> None:
        self._ours, theirs = os.openpty()
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", lines, columns, 0, 0))
        clean = {key: value for key, value in (env or os.environ).items() if key not in ("COLUMNS", "LINES")}
        self.process = subprocess.Popen(
            [*COMMAND, *map(str, args)],
            stdin=theirs,
            stdout=theirs,
            stderr=theirs,
            env=clean | {"TERM": "xterm-256color"},
            start_new_session=True,
        )
        self._theirs = theirs
        self.raw = ""

    @property
    def text(self) -> str:
        return _ESCAPE.sub("", self.raw).replace("\r", "")

    @property
    def modes(self) -> Sequence[object]:
        """The terminal's settings, as termios has them."""
        return termios.tcgetattr(self._theirs)

    def until(self, words: str) -> str:
        """All text so far, once these words were drawn."""
        deadline = time.monotonic() + PATIENCE
        while words not in self.text:
            assert time.monotonic() < deadline, f"never said {words!r}: {self.text}"
            self._read(0.1)
        return self.text

    def press(self, keys: str) -> None:
        os.write(self._ours, keys.encode())

    def end(self) -> int:
        """Waits for its end; returns the exit code."""
        deadline = time.monotonic() + PATIENCE
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
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGKILL)
            self.process.wait()
        os.close(self._ours)
        os.close(self._theirs)

"""`zscout drive` at a terminal of its own, which the test has in its hands."""

from __future__ import annotations

import asyncio
import fcntl
import json
import os
import subprocess
import sys
import termios
from pathlib import Path
from typing import Any, Self

from tests.live.robots.lab import comes_true

ZSCOUT = str(Path(sys.executable).with_name("zscout"))


class Terminal:
    """A command in the foreground of a pseudo terminal. What it writes is kept apart; with `shown` only its
    errors are, and the rest goes to the terminal."""

    def __init__(self, *command: str, env: dict[str, str], shown: bool = False) -> None:
        self._master, slave = os.openpty()
        self._slave: int | None = slave
        self.modes = termios.tcgetattr(slave)
        """Before the command began."""

        def own_the_terminal() -> None:
            fcntl.ioctl(0, termios.TIOCSCTTY, 0)

        source, kept = os.pipe()
        os.set_blocking(source, False)
        self._output = os.fdopen(source, "rb", buffering=0)
        self.process = subprocess.Popen(
            [ZSCOUT, *command],
            stdin=slave,
            stdout=slave if shown else kept,
            stderr=kept,
            env=env,
            start_new_session=True,
            preexec_fn=own_the_terminal,
        )
        os.close(kept)
        self._text = b""
        asyncio.get_running_loop().add_reader(self._master, self._look)

    def _look(self) -> None:
        """Somebody looks at the terminal: nobody who writes to it has to wait."""
        os.read(self._master, 65_536)

    def type(self, keys: bytes) -> None:
        os.write(self._master, keys)

    @property
    def text(self) -> str:
        """All that it has written."""
        while more := self._output.read(65_536):
            self._text += more
        return self._text.decode()

    @property
    def events(self) -> list[dict[str, Any]]:
        """The JSON lines of it."""
        return [json.loads(line) for line in self.text.splitlines() if line.startswith("{")]

    async def says(self, event: str, *, since: int = 0) -> dict[str, Any]:
        """Waits for a JSON line of this event, after the first `since` lines."""

        def found() -> list[dict[str, Any]]:
            return [one for one in self.events[since:] if one["event"] == event]

        await comes_true(lambda: bool(found()) or self.process.poll() is not None, event)
        assert found(), self.text
        return found()[0]

    async def reads_keys(self) -> None:
        """Waits until keys come to it one by one, without echo."""
        assert self._slave is not None
        slave, cooked = self._slave, termios.ICANON | termios.ECHO
        await comes_true(lambda: not termios.tcgetattr(slave)[3] & cooked, "it to read keys")

    def as_before(self) -> bool:
        """Whether the terminal is as it was."""
        assert self._slave is not None
        return termios.tcgetattr(self._slave) == self.modes

    async def ended(self) -> int:
        """Waits until it has ended; returns its exit code."""
        await comes_true(lambda: self.process.poll() is not None, "it to end")
        assert self.process.returncode is not None
        return self.process.returncode

    def kill(self) -> None:
        """The terminal is killed with -9: the kernel closes its ends, and hangs up."""
        if self._slave is not None:
            asyncio.get_running_loop().remove_reader(self._master)
            os.close(self._slave)
            self._slave = None
            os.close(self._master)

    def kill_all(self) -> None:
        """Both at once."""
        self.process.kill()
        self.kill()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self._output.close()
        self.kill()


async def all_read_keys(*terminals: Terminal) -> None:
    await asyncio.gather(*(terminal.reads_keys() for terminal in terminals))

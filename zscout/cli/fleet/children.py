"""Processes that a command starts beside itself, viewer and recorder: they end with it, however it ends."""

from __future__ import annotations

import asyncio
import os
import re
import sys
from collections import deque
from collections.abc import AsyncIterator, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, asynccontextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import msgspec

from zscout import terminal
from zscout.behaviors import launch
from zscout.cli import common
from zscout.config.strict import BadInput
from zscout.services.recorder.process import BAD_SETTINGS, Recording

START: Final = 20.0
"""Seconds within which a recorder or a viewer has come up, on a busy machine."""
GRACE: Final = 15.0
"""Seconds for a child to end by itself: the recorder finishes its file."""
MAX_LINE: Final = 65_536
KEPT: Final = 20
"""Last lines of a child's log that are kept, to say why it failed."""
WINDOW: Final = ("--bind", "127.0.0.1", "--port", "auto", "--hide-welcome-screen")
"""What a viewer with a window of its own is given."""
_COLOURS: Final = re.compile(r"\x1b\[[0-9;]*m")


class Child:
    """A process that was started here, and what it logs."""

    def __init__(self, what: str, process: asyncio.subprocess.Process) -> None:
        self.what, self.process = what, process
        self.lines: deque[str] = deque(maxlen=KEPT)
        self._news = asyncio.Event()
        self._log = asyncio.create_task(self._read_log())

    async def says(self, words: str) -> None:
        """Returns once these words stand in its log. Raises Failed if it ends first, or takes too long."""
        async with self._starting():
            while not any(words in line for line in self.lines):
                if self._log.done():
                    raise await self.failed()
                self._news.clear()
                await self._news.wait()

    async def recording(self) -> Recording:
        """What a recorder says when it records. Raises BadInput and Failed where it can't."""
        assert self.process.stdout is not None  # noqa: S101
        async with self._starting():
            try:
                return msgspec.json.decode(await self.process.stdout.readline(), type=Recording)
            except ValueError:  # it ended before that
                raise await self.failed() from None

    @asynccontextmanager
    async def _starting(self) -> AsyncIterator[None]:
        try:
            async with asyncio.timeout(START):
                yield
        except TimeoutError:
            raise common.Failed(
                f"{self.what} did not start within {START:g} s; is this host overloaded?"
            ) from None

    async def failed(self) -> Exception:
        """Why it ended, in its own last words."""
        code = await self.process.wait()
        await self._log
        words = self.lines[-1] if self.lines else "without a word"
        if self.process.stdout is not None and code == BAD_SETTINGS:
            return BadInput(words.partition(" ERROR ")[2] or words)
        return common.Failed(f"{self.what} ended (code {code}): {words}")

    async def _read_log(self) -> None:
        stderr = self.process.stderr
        assert stderr is not None  # noqa: S101
        while True:
            try:
                line = await stderr.readline()
            except ValueError:  # longer than MAX_LINE: it is skipped
                continue
            if not line:
                self._news.set()
                return
            text = terminal.clean(_COLOURS.sub("", line.decode(errors="replace"))).strip()
            if text:
                self.lines.append(text)
                self._news.set()

    async def end(self) -> None:
        """Ends it, at first by asking; returns when it is gone."""
        process = self.process
        if process.returncode is None:
            # A recorder ends with its input, a viewer by its signal.
            if process.stdin is not None:
                process.stdin.close()
            else:
                with suppress(ProcessLookupError):
                    process.terminate()
        try:
            async with asyncio.timeout(GRACE):
                await process.wait()
        except (TimeoutError, asyncio.CancelledError) as error:
            with suppress(ProcessLookupError):
                process.kill()
            await process.wait()
            if isinstance(error, asyncio.CancelledError):  # a second Ctrl-C
                raise
        finally:
            self._log.cancel()


@asynccontextmanager
async def child(
    what: str, command: Sequence[str], env: Mapping[str, str], *, job: bytes | None = None
) -> AsyncIterator[Child]:
    """Starts a child that ends with this context, and with this process however that ends.

    It leads a session of its own: Ctrl-C reaches only us, and we end it in order."""
    assert launch.__file__ is not None  # noqa: S101
    pipe = asyncio.subprocess.PIPE
    process = await asyncio.create_subprocess_exec(
        *(sys.executable, "-I", "-S", launch.__file__, str(os.getpid()), "-1"),
        *command,
        stdin=pipe if job is not None else asyncio.subprocess.DEVNULL,
        stdout=pipe if job is not None else asyncio.subprocess.DEVNULL,
        stderr=pipe,
        env=os.environ | env,
        limit=MAX_LINE,
        start_new_session=True,
    )
    started = Child(what, process)
    try:
        if job is not None and process.stdin is not None:
            process.stdin.write(job)
        yield started
    finally:
        await started.end()


def viewer(*arguments: str, log: str = "error") -> AbstractAsyncContextManager[Child]:
    """Starts the Rerun viewer; `log` is its level. Raises Failed where it is not installed."""
    # The viewer itself: the `rerun` script only wraps it, and killing the script would orphan it.
    spec = find_spec("rerun_cli")
    binary = Path(spec.origin).with_name("rerun") if spec is not None and spec.origin is not None else None
    if binary is None or not os.access(binary, os.X_OK):
        raise common.Failed(
            "the Rerun viewer is not installed; install the package rerun-sdk for this platform"
        )
    return child("the viewer", [str(binary), *arguments], {"RUST_LOG": log})


def has_display() -> bool:
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))

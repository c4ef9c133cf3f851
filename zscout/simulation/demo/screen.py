"""Shared by the demos: a run on the screen, and its recording."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol, TypeVar

from zscout import terminal
from zscout.simulation.demo.runner import RECORDINGS, DemoRunner

if TYPE_CHECKING:
    from rich.console import Group
    from rich.live import Live
    from rich.text import Text

FOLDER: Final = Path("runs")
FRAMES: Final = 4  # drawings per second at a terminal

D = TypeVar("D", bound="DemoRunner")


class LiveView(Protocol):
    """Shows a running demo, and its recording afterwards."""

    async def open(self, url: str) -> str:
        """Show the live view at `url`; returns where people see it, in words."""

    async def finished(self, recording: Path) -> None:
        """Show the recording instead; returns when the last viewer leaves."""


class DemoScreen:
    def __init__(self, name: str, *, as_json: bool, decimals: int, live: LiveView | None = None) -> None:
        self._name, self._live, self._where = name, live, ""
        self._as_json, self._decimals = as_json, decimals
        self._plain = not as_json and not terminal.at_terminal()
        self._drawn = not as_json and not self._plain
        self._events: list[str] = []

    def begin(self, title: str) -> None:
        if self._live is None and not self._as_json:
            terminal.print_line(f"To see it live in a browser: zscout demo {self._name} --web")
        self.print_line(title)

    def print_line(self, text: str) -> None:
        if self._plain:
            terminal.print_line(text)

    def show(self, at: float, text: str) -> None:
        self._events.append(f"{at:6.{self._decimals}f} s  {terminal.clean(text)}")
        self.print_line(self._events[-1])

    def latest(self, count: int) -> list[Text]:
        from rich.text import Text

        lines = [Text(line, overflow="ellipsis", no_wrap=True) for line in self._events[-count:]]
        # Fold the address: cut off, it is useless.
        return [*([Text(self._where, overflow="fold")] if self._where else []), *lines]

    async def play(self, make: Callable[[Path], D], draw: Callable[[D], Group], out: Path | None) -> tuple[D, Path]:
        """Run `make`'s demo in a temporary folder. Returns it and its recording, which is kept even if the demo
        fails."""
        with _recording(out) as path, tempfile.TemporaryDirectory(prefix="zscout-demo-") as folder:
            demo = make(Path(folder))
            try:
                # The picture stays until all processes have ended, some seconds later.
                with picture(lambda: draw(demo)) if self._drawn else nullcontext():
                    async with demo:
                        await demo.run()
            except BaseException:
                if keep_recording(Path(folder), path):
                    terminal.print_line(f"the recording until then: {path}", sys.stderr)
                raise
            keep_recording(Path(folder), path)
        return demo, path

    @property
    def on_live(self) -> Callable[[str], Awaitable[None]] | None:
        """What opens the live view at its address, if one is wanted."""
        return self._open if self._live is not None else None

    async def _open(self, url: str) -> None:
        assert self._live is not None  # noqa: S101
        self._where = await self._live.open(url)
        if self._as_json:
            terminal.print_line(self._where, sys.stderr)
        self.print_line(self._where)

    async def linger(self, path: Path) -> None:
        """Show the recording in the live view, if any, until the last viewer leaves."""
        if self._live is not None:
            await self._live.finished(path)


def picture(draw: Callable[[], Group]) -> Live:
    from rich.live import Live

    return Live(get_renderable=draw, console=terminal.console(), refresh_per_second=FRAMES, transient=True)


@contextmanager
def _recording(out: Path | None) -> Iterator[Path]:
    """The recording's file, created first so that a bad path fails at once; removed if it stays empty."""
    from zscout.services.recorder.process import new_recording, prune

    path = out or new_recording(FOLDER, "demo")
    if out is None:
        prune(FOLDER, "demo")
    try:
        yield path
    finally:
        if path.is_file() and path.stat().st_size == 0:
            path.unlink()


def keep_recording(folder: Path, path: Path) -> bool:
    """Return False if there is none."""
    recorded = next((folder / RECORDINGS).glob("*.rrd"), None)
    if recorded is not None:
        shutil.move(recorded, path)
    return recorded is not None


def how_to_view(path: Path) -> list[str]:
    # Without an activated .venv the shell does not find zscout.
    me = "zscout" if shutil.which("zscout") else os.path.relpath(sys.argv[0])
    return [f"Recording: {path}", f"Look at it: {me} view {path}, or in a browser: {me} view --web {path}"]

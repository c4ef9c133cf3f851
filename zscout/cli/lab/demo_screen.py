"""What the commands of `zscout demo` share: a run on the screen, and the recording that it leaves."""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeVar

import click

from zscout.cli import common
from zscout.config.strict import BadInput

if TYPE_CHECKING:
    from rich.console import Group
    from rich.text import Text

    from zscout.lab.demo.runner import DemoRunner

FOLDER: Final = Path("runs")
FRAMES: Final = 4
"""Drawings a second at a terminal."""

F = TypeVar("F", bound=Callable[..., Any])
D = TypeVar("D", bound="DemoRunner")


def recording_option(command: F) -> F:
    """`--out FILE`, checked."""
    return click.option(
        "--out",
        metavar="FILE",
        type=click.Path(path_type=Path),
        callback=_checked,
        help="The recording. Default: runs/demo-….rrd",
    )(command)


def _checked(_context: click.Context, _option: click.Parameter, out: Path | None) -> Path | None:
    if out is not None and out.suffix != ".rrd":
        raise BadInput(f"--out {out}: viewers know a recording by its name; let it end in .rrd")
    return out


class DemoScreen:
    """Events as lines in a pipe; at a terminal a picture with the latest of them; nothing with `--json`."""

    def __init__(self, *, as_json: bool, decimals: int) -> None:
        """`decimals` of the events' seconds."""
        self.plain = not as_json and not common.at_terminal()
        self._drawn = not as_json and common.at_terminal()
        self._decimals = decimals
        self._events: list[str] = []

    def print_line(self, text: str) -> None:
        """A line of a pipe."""
        if self.plain:
            common.print_line(text)

    def show(self, at: float, text: str) -> None:
        """An event, `at` in seconds."""
        self._events.append(f"{at:6.{self._decimals}f} s  {common.clean(text)}")
        self.print_line(self._events[-1])

    def latest(self, count: int) -> list[Text]:
        """The latest events, for a picture."""
        from rich.text import Text

        return [Text(line, overflow="ellipsis", no_wrap=True) for line in self._events[-count:]]

    async def play(
        self, make: Callable[[Path], D], draw: Callable[[D], Group], out: Path | None
    ) -> tuple[D, Path]:
        """Runs the demo that `make` makes for a temporary folder, and returns it and its recording, which
        stays even where the demo failed. `draw` gives the picture at any moment."""
        with _recording(out) as path, tempfile.TemporaryDirectory(prefix="zscout-demo-") as folder:
            demo = make(Path(folder))
            try:
                # The picture stays until all processes have ended: that takes some seconds.
                with self._picture(lambda: draw(demo)) if self._drawn else nullcontext():
                    async with demo:
                        await demo.run()
            except BaseException:
                if keep_recording(Path(folder), path):
                    click.echo(f"the recording until then: {path}", err=True)
                raise
            keep_recording(Path(folder), path)
        return demo, path

    @contextmanager
    def _picture(self, draw: Callable[[], Group]) -> Iterator[None]:
        from rich.live import Live

        with Live(get_renderable=draw, console=common.console(), refresh_per_second=FRAMES, transient=True):
            yield


@contextmanager
def _recording(out: Path | None) -> Iterator[Path]:
    """The recording's file, made beforehand: a bad place is known at once. It goes if it stays empty."""
    from zscout.services.recorder.files import new_recording, prune

    if out is None:
        path = new_recording(FOLDER, "demo")
        prune(FOLDER, "demo")
    else:
        path = out
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.open("ab").close()
        except OSError as error:
            why = "its folder is a file" if isinstance(error, FileExistsError) else error.strerror
            raise BadInput(f"--out {path}: can't be written ({why}); give another file") from None
    try:
        yield path
    finally:
        if path.is_file() and path.stat().st_size == 0:
            path.unlink()


def keep_recording(folder: Path, path: Path) -> bool:
    """Moves the recording out of the demo's folder; False if there is none."""
    from zscout.lab.demo.runner import RECORDINGS

    recorded = next((folder / RECORDINGS).glob("*.rrd"), None)
    if recorded is not None:
        shutil.move(recorded, path)
    return recorded is not None


def how_to_view(path: Path) -> list[str]:
    """Where the recording is, and how to look at it."""
    # A newcomer's shell does not find it yet: it lies in .venv/bin.
    me = "zscout" if shutil.which("zscout") else os.path.relpath(sys.argv[0])
    return [
        f"Recording: {path}",
        f"Look at it: {me} view {path}, or in a browser: {me} view --web {path}",
    ]

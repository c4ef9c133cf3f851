"""The recording that a demo leaves."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import click

from zscout.strict import BadInput

FOLDER: Final = Path("runs")


def recording_option(command: Any) -> Any:
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


@contextmanager
def recording(out: Path | None) -> Iterator[Path]:
    """The recording's file, made beforehand: a bad place is known at once. It goes if it stays empty."""
    from zscout.services.recorder_files import new_recording, prune

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


def keep(folder: Path, path: Path) -> bool:
    """Moves the recording out of the demo's folder; False if there is none."""
    from zscout.cli.demo.processes import RECORDINGS

    recorded = next((folder / RECORDINGS).glob("*.rrd"), None)
    if recorded is not None:
        shutil.move(recorded, path)
    return recorded is not None


def look_at(path: Path) -> list[str]:
    """Where the recording is, and how to look at it."""
    # A newcomer's shell does not find it yet: it lies in .venv/bin.
    me = "zscout" if shutil.which("zscout") else os.path.relpath(sys.argv[0])
    return [
        f"Recording: {path}",
        f"Look at it: {me} view {path}, or in a browser: {me} view --web {path}",
    ]

"""What the commands of `zscout study` share: their options, and trials on all processors."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import aclosing, contextmanager
from pathlib import Path
from typing import Any, Final, TypeVar

import click

from zscout.cli import common
from zscout.config.strict import BadInput, quoted

MAX_SEED: Final = 1_000_000
MAX_PROCESSES: Final = 256

J = TypeVar("J")
A = TypeVar("A")
F = TypeVar("F", bound=Callable[..., Any])


def seeds_option(default: str, help: str) -> Callable[[F], F]:  # noqa: A002 - click's word
    """`--seeds N|A-B`; `parse_seeds` reads it."""
    return click.option("--seeds", metavar="N|A-B", default=default, show_default=True, help=help)


def rrd_option(*names: str, what: str = "with plots") -> Callable[[F], F]:
    """`--rrd FILE`; `check_recording` checks it."""
    return click.option(
        "--rrd",
        *names,
        "rrd",
        type=click.Path(path_type=Path),
        metavar="FILE",
        help=f"Write a Rerun recording {what} besides; look at it with `zscout view FILE`.",
    )


def jobs_option(command: F) -> F:
    """`--jobs N`; the parameter is `processes`."""
    return click.option(
        "--jobs",
        "processes",
        type=click.IntRange(1, MAX_PROCESSES),
        help="Processes to run on. Default: one for each processor.",
    )(command)


def parse_seeds(text: str) -> range:
    """`20` is 0 to 19, `5-9` is 5 to 9. Raises BadInput."""
    found = re.fullmatch(r"(?:(\d{1,7})-)?(\d{1,7})", text)
    if found is None:
        raise BadInput(f"--seeds {quoted(text)}: write how many, as in 20, or from which to which, as in 5-9")
    first, last = int(found[1] or 0), int(found[2])
    seeds = range(first, last + 1) if found[1] else range(last)
    if not seeds:
        raise BadInput(
            f"--seeds {quoted(text)} is no seed at all; write at least 1, or the smaller one first"
        )
    if seeds[-1] > MAX_SEED:
        raise BadInput(f"--seeds {quoted(text)}: a seed is at most {MAX_SEED}")
    return seeds


def check_recording(rrd: Path | None) -> None:
    """Before the work, not after it. Raises BadInput."""
    if rrd is None:
        return
    if rrd.suffix != ".rrd":
        raise BadInput(f"--rrd {rrd}: the viewer knows a recording by its name; end it in .rrd")
    try:
        with rrd.open("ab"):
            pass
    except OSError as error:
        raise BadInput(
            f"--rrd {rrd}: it can't be written ({error.strerror}); give a file in a folder that is there"
        ) from None


def print_recording(rrd: Path | None) -> None:
    """Where the recording is, and how to look at it."""
    if rrd is not None:
        common.print_line(f"\nRecording: {rrd} (zscout view {rrd})")


async def run_trials(
    work: Callable[[J], A], jobs: Sequence[J], processes: int | None, take: Callable[[A], None]
) -> None:
    """Hands the answers of `work` to `take`, in the order of the jobs, with a bar at a terminal. Raises
    LabError, BadInput."""
    from zscout.lab.study.process_pool import answers

    processes = processes or min(MAX_PROCESSES, len(os.sched_getaffinity(0)))
    with progress(len(jobs)) as advance:
        async with aclosing(answers(work, jobs, processes)) as found:
            async for answer in found:
                take(answer)
                advance()


@contextmanager
def progress(total: int) -> Iterator[Callable[[], None]]:
    """A bar at a terminal, on stderr; call what it yields once for each of `total` trials."""
    if not common.at_terminal(sys.stderr):
        yield lambda: None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns: list[Any] = [TextColumn("trials"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()]
    with Progress(*columns, console=common.console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=total)
        yield lambda: bar.advance(task)

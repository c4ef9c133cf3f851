"""`zscout study`: experiments with random workloads, in virtual time and on all processors."""

from __future__ import annotations

import dataclasses
import os
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import aclosing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

import click

from zscout.cli import common
from zscout.cli.groups import DefaultGroup
from zscout.cli.study_placement import placement
from zscout.cli.study_robots import robots
from zscout.scheduling.study.families import FAMILIES
from zscout.scheduling.study.trial import STRATEGIES, Job
from zscout.strict import BadInput, quoted

if TYPE_CHECKING:
    from zscout.scheduling.study.summary import Study

SEEDS: Final = "5"
MAX_SEED: Final = 1_000_000
MAX_TRIALS: Final = 5_000
"""More would fill the memory with their waits."""
MAX_PROCESSES: Final = 256
DEFAULT: Final = "schedule"


class _Advance(Protocol):
    def __call__(self) -> None: ...


@click.group(cls=DefaultGroup, default=DEFAULT)
def study() -> None:
    """Runs experiments with random workloads in virtual time; `schedule` unless another one is named.

    \b
    Examples:
      zscout study
      zscout study schedule --family paper --seeds 100
      zscout study placement --seeds 20
      zscout study robots --starts 40
      zscout study schedule --help
    """


study.add_command(placement)
study.add_command(robots)


@study.command()
@click.option(
    "--family",
    "families",
    multiple=True,
    type=click.Choice(list(FAMILIES)),
    help="A family of workloads; repeat it for several. Default: all.",
)
@click.option(
    "--strategy",
    "strategies",
    multiple=True,
    type=click.Choice(list(STRATEGIES)),
    help="A strategy; repeat it for several. Default: all.",
)
@click.option(
    "--seeds",
    metavar="N|A-B",
    default=SEEDS,
    show_default=True,
    help="Workloads of each family: so many, or those of seeds A to B.",
)
@click.option(
    "--jobs",
    type=click.IntRange(1, MAX_PROCESSES),
    help="Processes to run on. Default: one for each processor.",
)
@common.json_option("Print one JSON object instead of tables.")
@click.option(
    "--rrd",
    type=click.Path(path_type=Path),
    metavar="FILE",
    help="Write a Rerun recording with plots besides; look at it with `zscout view FILE`.",
)
def schedule(
    families: tuple[str, ...],
    strategies: tuple[str, ...],
    seeds: str,
    jobs: int | None,
    as_json: bool,
    rrd: Path | None,
) -> None:
    """Compares scheduling strategies on families of random workloads.

    For each: RCs in use, waiting, preemptions, work that they throw away, time per pass; and how often the
    paper's heuristic uses fewer RCs than the best set in the same situation, and what foretells it. A seed is
    the same workload on every machine, and all but the times of passes comes out the same. docs/study.md says
    what was found.

    \b
    Examples:
      zscout study schedule --family paper --seeds 100
      zscout study schedule --family load65 --strategy priority --strategy optimal --json
      zscout study schedule --seeds 2 --rrd study.rrd && zscout view study.rrd
    """
    chosen = list(dict.fromkeys(families)) or list(FAMILIES)
    compared = list(dict.fromkeys(strategies)) or list(STRATEGIES)
    numbers = parse_seeds(seeds)
    trials = len(chosen) * len(compared) * len(numbers)
    if trials > MAX_TRIALS:
        raise BadInput(
            f"--seeds: {trials} trials are more than {MAX_TRIALS}; ask for fewer seeds or families"
        )
    if rrd is not None:
        check_recording(rrd)
    # numpy is wanted from here on.
    from zscout.scheduling.study.summary import Study

    result = Study(chosen, compared, numbers)
    planned = [
        Job(family, seed, strategy, drawn=rrd is not None and seed == numbers[0])
        for family in chosen
        for seed in numbers
        for strategy in compared
    ]
    common.run(_carry_out(planned, jobs or _processors(), result))
    report = result.report()
    if rrd is not None:
        from zscout.services.study_plots import record

        record(rrd, report, result.curves)
    if as_json:
        common.print_json(dataclasses.asdict(report))
        return
    from zscout.cli.study_tables import print_report

    print_report(report)
    if rrd is not None:
        common.print_line(f"\nRecording: {rrd} (zscout view {rrd})")


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


async def _carry_out(jobs: Sequence[Job], processes: int, result: Study) -> None:
    from zscout.cli.study_pool import spread

    with progress(len(jobs)) as advance:
        async with aclosing(spread(jobs, min(processes, len(jobs)))) as trials:
            async for trial in trials:
                result.add(trial)
                advance()


def _processors() -> int:
    """Those that this process may use."""
    return min(MAX_PROCESSES, len(os.sched_getaffinity(0)))


def check_recording(rrd: Path) -> None:
    """Before the work, not after it. Raises BadInput."""
    if rrd.suffix != ".rrd":
        raise BadInput(f"--rrd {rrd}: the viewer knows a recording by its name; end it in .rrd")
    try:
        with rrd.open("ab"):
            pass
    except OSError as error:
        raise BadInput(
            f"--rrd {rrd}: it can't be written ({error.strerror}); give a file in a folder that is there"
        ) from None


@contextmanager
def progress(total: int) -> Iterator[_Advance]:
    """A bar at a terminal, on stderr; call what it yields once for each of `total` trials."""
    if not common.at_terminal(sys.stderr):
        yield lambda: None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns: list[Any] = [TextColumn("trials"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()]
    with Progress(*columns, console=common.console(stderr=True), transient=True) as progress:
        task = progress.add_task("", total=total)
        yield lambda: progress.advance(task)

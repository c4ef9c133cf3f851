"""Options of several studies, their checks, and the output of a report."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar

import click

from zscout import terminal
from zscout.cli.common import Parsed
from zscout.config.strict import BadInput, quoted

MAX_SEED: Final = 1_000_000
MAX_SEEDS: Final = 1_000
"""Most seeds of a run: more take hours."""
MAX_PROCESSES: Final = 256
MAX_LISTED: Final = 64

F = TypeVar("F", bound=Callable[..., Any])


def seed_option(default: str, help: str, most: int | None = None) -> Callable[[F], F]:  # noqa: A002
    """`--seed A|A-B`: a seed, or a range of seeds."""
    seeds = Parsed("text", lambda text, _option: parse_seeds(text if "-" in text else f"{text}-{text}", most, "--seed"))
    return click.option("--seed", "seeds", metavar="A|A-B", type=seeds, default=default, help=help)


def seeds_option(default: str, help: str, most: int | None = None) -> Callable[[F], F]:  # noqa: A002 - click's word
    """`--seeds N|A-B`, no more than `most`."""
    seeds = Parsed("text", lambda text, _option: parse_seeds(text, most))
    return click.option("--seeds", metavar="N|A-B", type=seeds, default=default, help=help)


def numbers_option(option: str, low: int, high: int, help: str) -> Callable[[F], F]:  # noqa: A002
    """`1-4,8`: numbers within `low` to `high`."""
    numbers = Parsed("text", lambda text, option: parse_numbers(text, option, low, high))
    return click.option(option, metavar="LIST", type=numbers, help=help)


def jobs_option(command: F) -> F:
    """`--jobs N`; the parameter is `processes`."""
    return click.option(
        "--jobs",
        "processes",
        type=click.IntRange(1, MAX_PROCESSES),
        help="Processes to run on. Default: one for each processor.",
    )(command)


def parse_seeds(text: str, most: int | None = None, option: str = "--seeds") -> range:
    """`20` is 0 to 19, `5-9` is 5 to 9; no more than `most`. Raises BadInput."""
    found = re.fullmatch(r"(?:(\d{1,7})-)?(\d{1,7})", text)
    if found is None:
        raise BadInput(f"{option} {quoted(text)}: write a number, as in 20, or a range, as in 5-9")
    first, last = int(found[1] or 0), int(found[2])
    seeds = range(first, last + 1) if found[1] else range(last)
    if not seeds:
        raise BadInput(
            f"{option}: {quoted(text)} is an empty range of seeds; write a number from 1, or the smaller seed first"
        )
    if seeds[-1] > MAX_SEED:
        raise BadInput(f"{option} {quoted(text)}: a seed is at most {MAX_SEED}")
    if most is not None and len(seeds) > most:
        raise BadInput(f"{option}: {len(seeds)} are more than {most}; ask for fewer")
    return seeds


def parse_numbers(text: str, option: str, low: int, high: int) -> list[int]:
    """`1-4,8` is 1, 2, 3, 4 and 8. Raises BadInput."""
    listed: list[int] = []
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        ends = [first, last] if dash else [first, first]
        if not all(end.isascii() and end.isdigit() and len(end) <= 7 for end in ends):
            raise BadInput(f"{option} {quoted(text)}: write numbers and ranges of them, as in 1-4,8")
        begin, end = int(ends[0]), int(ends[1])
        if not low <= begin <= end <= high:
            raise BadInput(f"{option} {quoted(text)}: {quoted(part)} is not within {low} to {high}, or backwards")
        if len(listed) + end - begin >= MAX_LISTED:
            raise BadInput(f"{option} {quoted(text)}: these are more than {MAX_LISTED} numbers; give fewer")
        listed += range(begin, end + 1)
    return list(dict.fromkeys(listed))


def show(report: Any, rrd: Path | None, print_report: Callable[[], None], *, as_json: bool) -> None:
    """Print a report as one JSON object, or as tables and how to open its recording."""
    if as_json:
        terminal.print_json(report)
        return
    print_report()
    if rrd is not None:
        terminal.print_line(f"\nRecording: {rrd} (zscout view {rrd})")

"""What the commands of the lab share: a group with a default, options, and their checks."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, TypeVar

import click

from zscout.cli.common import Parsed
from zscout.config.strict import BadInput, quoted

MAX_SEED: Final = 1_000_000
MAX_PROCESSES: Final = 256
MAX_LISTED: Final = 64

F = TypeVar("F", bound=Callable[..., Any])


class DefaultGroup(click.Group):
    """A group that takes options without a subcommand to be meant for `default`."""

    def __init__(self, *args: Any, default: str, **more: Any) -> None:
        super().__init__(*args, **more)
        self.default = default

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        named = args and (not args[0].startswith("-") or args[0] in self.get_help_option_names(ctx))
        return super().parse_args(ctx, args if named else [self.default, *args])


def seed_option(default: str, help: str, most: int | None = None) -> Callable[[F], F]:  # noqa: A002
    """`--seed A|A-B`: one, or those from A to B."""
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


def rrd_option(*names: str, what: str = " with plots") -> Callable[[F], F]:
    """`--rrd FILE`; `check_rrd` checks it."""
    return click.option(
        "--rrd",
        *names,
        "rrd",
        type=click.Path(path_type=Path),
        metavar="FILE",
        help=f"Write a Rerun recording{what} besides; look at it with `zscout view FILE`.",
    )


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
        raise BadInput(f"{option} {quoted(text)}: write how many, as in 20, or from which to which, as in 5-9")
    first, last = int(found[1] or 0), int(found[2])
    seeds = range(first, last + 1) if found[1] else range(last)
    if not seeds:
        raise BadInput(f"{option} {quoted(text)} is no seed at all; write at least 1, or the smaller one first")
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


def check_rrd(rrd: Path | None, *, writable: bool = True) -> None:
    """Before the work, not after it; with `writable` also that it can be written. Raises BadInput."""
    if rrd is None:
        return
    if rrd.suffix != ".rrd":
        raise BadInput(f"--rrd {rrd}: the viewer knows a recording by its name; end it in .rrd")
    try:
        if writable:
            rrd.open("ab").close()
    except OSError as error:
        raise BadInput(
            f"--rrd {rrd}: it can't be written ({error.strerror}); give a file in a folder that is there"
        ) from None

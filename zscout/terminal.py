"""Output for people and programs: lines, JSON, tables, a bar, pictures in place; and keys that are typed.

Rich is imported by the functions that need it: most of a short command's time is imports.
"""

from __future__ import annotations

import asyncio
import os
import re
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime, timedelta
from itertools import zip_longest
from typing import IO, TYPE_CHECKING, Any, Final, Self

import msgspec

from zscout.types import clean as clean
from zscout.types import span as span

if TYPE_CHECKING:
    from rich.console import Console, RenderableType
    from rich.live import Live

NARROW: Final = 110
"""Columns of a terminal below which tables leave out what matters least."""
CUT: Final = 0.3
"""Of a terminal's width: what a column has at most whose texts are cut short."""
NEAR: Final = 120.0
"""Seconds from now within which a time of day is told with its seconds."""
MAX_CLOCK: Final = 1e9
"""Seconds from now that a time of day may be, either way."""
MAX_TYPED: Final = 1_024
KEYS: Final = re.compile(rb"\x1b[\[O].|.", re.DOTALL)
"""The single keys of what was typed; an escape sequence is one key."""

_JSON: Final = msgspec.json.Encoder(decimal_format="number")


def print_json(value: Any, stream: IO[str] | None = None) -> None:
    """One JSON value (structs and Decimals included) on one line, at once."""
    print_line(_JSON.encode(value).decode(), stream)


def print_line(text: str, stream: IO[str] | None = None) -> None:
    """One plain line, at once, so that a reader of the pipe sees it."""
    stream = stream or sys.stdout
    stream.write(text + "\n")
    stream.flush()


def at_terminal(stream: IO[str] | None = None) -> bool:
    """Whether people look at the stream (default stdout) and it can be drawn on."""
    return (stream or sys.stdout).isatty() and os.environ.get("TERM") != "dumb"


def console(*, stderr: bool = False) -> Console:
    """A Rich console without guesses: no markup, no highlighting; texts come from other hosts."""
    from rich.console import Console

    return Console(stderr=stderr, markup=False, highlight=False, emoji=False)


def clock(seconds: float, *, at_latest: bool = False) -> str:
    """The time of day `seconds` from now, by this host's clock and zone: `14:32`, `14:32:05` within two minutes of now,
    with the date on another day. What is cut off is rounded down, with `at_latest` up; negative: that long ago."""
    now = datetime.now().astimezone()
    at = (now + timedelta(seconds=max(-MAX_CLOCK, min(seconds, MAX_CLOCK)))).astimezone()
    near = abs(seconds) < NEAR
    unit = timedelta(seconds=1) if near else timedelta(minutes=1)
    if at_latest and (rest := (at - datetime.min.replace(tzinfo=at.tzinfo)) % unit):
        at += unit - rest
    time = f"{at:%H:%M:%S}" if near else f"{at:%H:%M}"
    if at.date() == now.date():
        return time
    return f"{at:%Y-%m-%d} {time}" if at.year != now.year else f"{at:%b} {at.day} {time}"


def many(count: int, what: str) -> str:
    """`1 link`, `2 links`."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of texts, made safe to print where they are. `styles` has Rich's style for each row, `spare` the
    columns that a narrow terminal omits, `cut` those whose texts are cut short at a terminal."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    styles: Sequence[str] = ()
    spare: Collection[str] = ()
    cut: Collection[str] = ()

    def lines(self) -> list[str]:
        """Without colours: two spaces between columns."""
        table = [self.columns, *([clean(cell) for cell in row] for row in self.rows)]
        widths = [max(map(len, column)) for column in zip(*table, strict=True)]
        lines = [
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in table
        ]
        return [self.title, *lines] if self.title else lines

    def picture(self, most: int | None = None) -> RenderableType:
        """For a terminal, no more than `most` rows."""
        from rich.table import Table
        from rich.text import Text

        table = Table(
            title=self.title or None,
            title_justify="left",
            title_style="bold cyan",
            header_style="bold",
            box=None,
            padding=(0, 2, 0, 0),
        )
        narrow = console().width < NARROW
        kept = [at for at, name in enumerate(self.columns) if not (narrow and name in self.spare)]
        for at in kept:
            name = self.columns[at]
            # A name or key that is cut short can't be copied.
            if name in self.cut:
                table.add_column(name, overflow="ellipsis", no_wrap=True, max_width=round(CUT * console().width))
            else:
                table.add_column(name, overflow="fold")
        for row, style in zip_longest(self.rows[:most], self.styles[:most], fillvalue=""):
            table.add_row(*(Text(clean(row[at])) for at in kept), style=style)
        return table

    def print(self) -> None:
        """Coloured at a terminal, aligned plain lines elsewhere."""
        if at_terminal():
            console().print(self.picture())
        else:
            for line in self.lines():
                print_line(line)


def print_table(columns: Sequence[str], rows: Sequence[Sequence[str]], *, title: str = "") -> None:
    Table(title, columns, rows).print()


class LiveLine:
    """Drawn in place at a terminal, while lines that stay are printed above it; nothing is drawn elsewhere,
    or if not `shown`. A context manager: it is gone afterwards, but for one that `stays`."""

    def __init__(self, stream: IO[str] | None = None, *, shown: bool = True, stays: bool = False) -> None:
        self._stream = stream or sys.stdout
        self._stays = stays
        self._live: Live | None = None
        self.watched = shown and at_terminal(self._stream)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.hide()

    def draw(self, picture: str | RenderableType) -> None:
        """Draws it anew. A text is cut at the terminal's edge."""
        if not self.watched:
            return
        from rich.live import Live
        from rich.text import Text

        if isinstance(picture, str):
            text = "\n".join(map(clean, picture.split("\n")))
            picture = Text(text, overflow="ellipsis", no_wrap=True)
        # Where the terminal is gone, its keys' end or a signal ends the command.
        with suppress(OSError):
            if self._live is None:
                self._live = Live(
                    picture,
                    console=console(stderr=self._stream is sys.stderr),
                    transient=not self._stays,
                    auto_refresh=False,
                    redirect_stdout=False,
                    redirect_stderr=False,
                )
                self._live.start()
            self._live.update(picture, refresh=True)

    def print(self, text: str, style: str = "") -> None:
        """A line that stays."""
        if self._live is None:
            print_line(clean(text), self._stream)
        else:
            with suppress(OSError):
                self._live.console.print(clean(text), style=style, soft_wrap=True)

    def hide(self) -> None:
        """Takes it away: the terminal is another's now."""
        if self._live is not None:
            with suppress(OSError):
                self._live.stop()
            self._live = None


@contextmanager
def progress(total: int) -> Iterator[Callable[[], None]]:
    """A bar at a terminal, on stderr; call what it yields once for each of `total` trials."""
    if not at_terminal(sys.stderr):
        yield lambda: None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns: list[Any] = [TextColumn("trials"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()]
    with Progress(*columns, console=console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=total)
        yield lambda: bar.advance(task)


@contextmanager
def typed_keys(pressed: Callable[[bytes], None], ended: Callable[[], None]) -> Iterator[None]:
    """Calls `pressed` with each key typed at the terminal, and `ended` when that is gone. Keys come one by
    one and are not echoed; the terminal is as before afterwards."""
    import termios
    import tty

    loop, terminal = asyncio.get_running_loop(), sys.stdin.fileno()
    before = termios.tcgetattr(terminal)

    def readable() -> None:
        typed = b""
        with suppress(OSError):
            typed = os.read(terminal, MAX_TYPED)
        if not typed:
            loop.remove_reader(terminal)
            ended()
        for key in KEYS.findall(typed):
            pressed(key)

    tty.setcbreak(terminal)
    loop.add_reader(terminal, readable)
    try:
        yield
    finally:
        loop.remove_reader(terminal)
        # A terminal that is gone has no modes to be set back.
        with suppress(termios.error):
            termios.tcsetattr(terminal, termios.TCSADRAIN, before)

"""Terminal output (lines, JSON, tables, a progress bar, live pictures), and input of single keys.

Rich is imported where it is needed: imports take most of a short command's time."""

from __future__ import annotations

import asyncio
import json
import os
import re
import sys
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from decimal import Decimal
from itertools import zip_longest
from operator import gt
from typing import IO, TYPE_CHECKING, Any, Final, Self

import msgspec

from zscout.streams import escaped, writable
from zscout.types import clean as clean
from zscout.types import span as span
from zscout.types import whole_second

if TYPE_CHECKING:
    from rich.console import Console, Group, RenderableType
    from rich.live import Live

GAP: Final = 2
"""Spaces between two columns."""
INDENT: Final = 3
"""Spaces before a line below a row."""
CUT_SHARE: Final = 0.3
"""Share of the terminal's width for a column of shortened texts."""
LIST_SHARE: Final = 0.4
"""Least share of the terminal's width for a column of lists or sentences; other columns are removed to provide it."""
WHOLE, ITEMS, WORDS = "(?!)", "\n", r"\n| (?!\()(?![^()]*\))"
"""Places where a cell may be broken: none, between its items, between words outside parentheses."""
NEAR_S: Final = 120.0
"""A time of day closer to now is shown with seconds."""
MAX_CLOCK_S: Final = 1e9
"""Greatest distance of a time of day from now."""
MAX_TYPED: Final = 1_024
KEYS: Final = re.compile(rb"\x1b[\[O].|.", re.DOTALL)
"""A single typed key; an escape sequence is a key."""

_JSON: Final = msgspec.json.Encoder(decimal_format="number")


def print_json(value: Any, stream: IO[str] | None = None) -> None:
    """Print a JSON value (also structs and Decimals) on one line and flush; control characters are escaped."""
    text = json_text(value)
    # JSON must be UTF-8; a stream of another encoding gets ASCII.
    if not text.isascii() and (getattr(stream or sys.stdout, "encoding", None) or "utf-8").lower() != "utf-8":
        text = "".join(char if char.isascii() else escaped(char) for char in text)
    print_line(text, stream)


def json_text(value: Any) -> str:
    try:
        text = _JSON.encode(value).decode()
    except UnicodeEncodeError:  # a file name that is not UTF-8
        text = json.dumps(msgspec.to_builtins(value, builtin_types=(Decimal,)), default=float)
    return text if text.isprintable() else "".join(c if c.isprintable() else escaped(c) for c in text)


def print_line(text: str, stream: IO[str] | None = None) -> None:
    """Print a plain line without control characters and flush, so that a reader of the pipe sees it at once."""
    stream = stream or sys.stdout
    stream.write(clean(text) + "\n")
    stream.flush()


def at_terminal(stream: IO[str] | None = None) -> bool:
    """Return True if the stream (default stdout) is a terminal that can draw."""
    return (stream or sys.stdout).isatty() and os.environ.get("TERM") != "dumb"


def console(*, stderr: bool = False) -> Console:
    """A Rich console without markup and highlighting, since texts come from other hosts."""
    from rich.console import Console

    return Console(stderr=stderr, markup=False, highlight=False, emoji=False)


def clock(seconds: float) -> str:
    """The time of day `seconds` from now (negative: ago), as this host's clock shows it then: `14:32`, `14:32:05`
    within two minutes of now, with the date on another day. Rounded by `whole_second`, then down to the minute: an
    instant has one time, before and after it."""
    now = datetime.now().astimezone()
    away = max(-MAX_CLOCK_S, min(seconds, MAX_CLOCK_S))
    at = datetime.fromtimestamp(whole_second(now.timestamp() + away)).astimezone()
    time = f"{at:%H:%M:%S}" if abs(seconds) < NEAR_S else f"{at:%H:%M}"
    if at.date() == now.date():
        return time
    return f"{at:%Y-%m-%d} {time}" if at.year != now.year else f"{at:%b} {at.day} {time}"


def many(count: int, what: str) -> str:
    """`1 link`, `2 links`."""
    return f"{count} {what}" if count == 1 else f"{count} {what}s"


Line = tuple[str, str]
"""A line at a terminal, and its Rich style."""


@dataclass(frozen=True, slots=True)
class Table:
    """Rows of texts, with control characters removed on printing. A cell with newlines is broken over lines only there,
    any other at spaces; a newline is printed as a space. `styles`: the Rich style of each row. `spare`: columns to
    remove on a narrow terminal, in this order; those also in `beneath` move to lines below each row. Texts in the
    columns `cut` are shortened before others are broken. Long words in the columns `fold` are broken, not shortened, so
    that people can copy them."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[str]]
    styles: Sequence[str] = ()
    spare: Sequence[str] = ()
    cut: Collection[str] = ()
    beneath: Collection[str] = ()
    fold: Collection[str] = ()

    def lines(self) -> list[str]:
        """Plain lines, as wide as their texts, with two spaces between columns."""
        table = [self.columns, *([writable(clean(cell)) for cell in row] for row in self.rows)]
        widths = [max(map(len, column)) for column in zip(*table, strict=True)]
        lines = [
            "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in table
        ]
        return [self.title, *lines] if self.title else lines

    def fitted(self, width: int, most: int | None = None) -> list[Line]:
        """Lines for a terminal of this width, of at most `most` rows."""
        safe = [
            ["\n".join(writable(clean(line)) for line in cell.split("\n")) for cell in row] for row in self.rows[:most]
        ]
        texts = [list(column) for column in zip(self.columns, *safe, strict=True)]
        kept, below, widths = self._layout(texts, width)
        lines = [(self.title, "bold cyan")] if self.title else []
        styles = ["bold" if self.title else "bold cyan", *self.styles[: len(safe)]]
        for number, style in enumerate([*styles, *[""] * (1 + len(safe) - len(styles))]):
            cells = [
                wrapped(texts[at][number], wide, fold=self.columns[at] in self.fold)
                if self.columns[at] not in self.cut
                else [shortened(clean(texts[at][number]), wide)]
                for at, wide in zip(kept, widths, strict=True)
            ]
            for parts in zip_longest(*cells, fillvalue=""):
                padded = (part + " " * (wide - _wide(part)) for part, wide in zip(parts, widths, strict=True))
                lines.append((shortened((" " * GAP).join(padded).rstrip(), width), style))
            for text in (texts[at][number] for at in below if number and texts[at][number]):
                lines += [(" " * INDENT + line, f"{style} dim") for line in wrapped(text, max(1, width - INDENT))]
        return lines

    def _layout(self, texts: list[list[str]], width: int) -> tuple[list[int], list[int], list[int]]:
        """The columns to print side by side, the columns to print below them, and the widths of the former."""
        names, share = self.columns, round(LIST_SHARE * width)
        whole = [_longest(column, WHOLE) for column in texts]
        least = [
            _longest(column, ITEMS if name in self.beneath else WORDS)
            for name, column in zip(names, texts, strict=True)
        ]
        limits = [round(CUT_SHARE * width) if name in self.cut else width for name in names]

        def fits(kept: Sequence[int], listed: int) -> bool:
            """`listed`: least width of columns that may move below."""
            shares = (max(least[at], listed if names[at] in self.beneath else share) for at in kept)
            return (
                sum(min(whole[at], limits[at], wide) + GAP for at, wide in zip(kept, shares, strict=True)) - GAP
                <= width
            )

        kept = [at for at, name in enumerate(names) if name not in self.beneath or any(texts[at][1:])]
        left_out: list[int] = []
        below: list[int] = []
        for name in self.spare:
            at = names.index(name)
            if at in kept and not fits(kept, 0 if name in self.beneath else share):
                kept.remove(at)
                (below if name in self.beneath else left_out).append(at)
        # Columns that moved below may have made room.
        while left_out and fits([*kept, left_out[-1]], share):
            kept = sorted([*kept, left_out.pop()])
        widths = [whole[at] for at in kept]
        for floors in (whole, least, [1] * len(names)):
            floor = [min(limits[at], floors[at]) for at in kept]
            while sum(widths) + GAP * (len(kept) - 1) > width and any(map(gt, widths, floor)):
                # Narrow the widest column that is still above its floor.
                widths[max(range(len(kept)), key=lambda at: (widths[at] > floor[at], widths[at]))] -= 1
        return kept, below, widths

    def print(self) -> None:
        """Print in colour at a terminal, otherwise as aligned plain lines."""
        if at_terminal():
            console().print(picture(self.fitted(console().width)))
        else:
            for line in self.lines():
                print_line(line)


def _wide(text: str) -> int:
    from rich.cells import cell_len

    return cell_len(text)


def _longest(texts: Sequence[str], breaks: str) -> int:
    return max(_wide(part.replace("\n", " ")) for text in texts for part in re.split(breaks, text))


def shortened(text: str, width: int) -> str:
    from rich.cells import set_cell_size

    more = "…" if writable("…") == "…" else "~"
    return text if _wide(text) <= width else set_cell_size(text, width - 1).rstrip() + more


def wrapped(text: str, width: int, *, fold: bool = False) -> list[str]:
    """Break a text into lines of this width: at newlines if it has any, otherwise at spaces, within parentheses only as
    a last resort. Words that are too long are broken with `fold`, else shortened."""
    lines = [""]
    for part in re.split(ITEMS if "\n" in text else WORDS, text):
        words = [part] if _wide(part) <= width else part.split(" ")
        if fold:
            words = [word[at : at + width] for word in words for at in range(0, max(1, len(word)), width)]
        for word in words:
            joined = f"{lines[-1]} {word}" if lines[-1] else shortened(word, width)
            if _wide(joined) <= width:
                lines[-1] = joined
            else:
                lines.append(shortened(word, width))
    return lines


def picture(lines: Sequence[Line]) -> Group:
    """A Rich renderable of lines that fit the terminal."""
    from rich.console import Group
    from rich.text import Text

    return Group(*(Text(text, style=style, no_wrap=True, overflow="crop") for text, style in lines))


def print_table(columns: Sequence[str], rows: Sequence[Sequence[str]], *, title: str = "") -> None:
    Table(title, columns, rows).print()


class LiveLine:
    """A picture redrawn in place at a terminal, if `shown`, with permanent lines printed above it. A context manager,
    which removes the picture at the end unless it `stays`."""

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
        """Redraw. A text is cut at the terminal's edge."""
        if not self.watched:
            return
        from rich.live import Live
        from rich.text import Text

        if isinstance(picture, str):
            text = "\n".join(map(clean, picture.split("\n")))
            picture = Text(text, overflow="ellipsis", no_wrap=True)
        # If the terminal is gone, a signal or the end of its input ends the command.
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
        """Above the picture."""
        if self._live is None:
            print_line(clean(text), self._stream)
        else:
            with suppress(OSError):
                self._live.console.print(clean(text), style=style, soft_wrap=True)

    def hide(self) -> None:
        """Remove the picture, to release the terminal."""
        if self._live is not None:
            with suppress(OSError):
                self._live.stop()
            self._live = None


@contextmanager
def progress(total: int) -> Iterator[Callable[[], None]]:
    """A progress bar on stderr at a terminal. Yields a function to call after each of `total` trials."""
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
    """Call `pressed` with each key typed, singly and without echo, and `ended` when the terminal is gone. The
    terminal's mode is restored at the end."""
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
        # A terminal that is gone has no mode to restore.
        with suppress(termios.error):
            termios.tcsetattr(terminal, termios.TCSADRAIN, before)

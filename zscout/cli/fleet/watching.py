"""A headline and tables, printed once, or updated with `--watch`."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Awaitable, Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol

import msgspec

from zscout import terminal
from zscout.mesh.supervision import done_within
from zscout.terminal import Line, Table

if TYPE_CHECKING:
    from rich.console import Group

REFRESH_INTERVAL_S: Final = 1.0
MIN_REFRESH_INTERVAL_S: Final = 0.1
"""Interval while changes arrive."""
MAX_ROWS: Final = 500
"""Rows of one table at a terminal."""
USUAL_HEIGHT: Final = 24
"""Lines of the usual terminal."""
VOLATILE_FIELDS: Final = frozenset(
    {
        "held",
        "remaining",
        "waits",
        "waited",
        "starts_in",
        "yields_in",
        "ends_in",
        "seq",
        "links",
        "load",
        "age",
        "gone",
        "clocks",
    }
    | {"uptime", "cpu", "memory", "figures", "charged", "part"}
)
"""Fields that change without an event."""


STEPS: Final = {b"\x1b[A": -1, b"\x1b[B": 1, b"\x1bOA": -1, b"\x1bOB": 1, b"k": -1, b"j": 1}
"""Lines to scroll by key: arrows, and as in `less`."""
PAGES: Final = {b"\x1b[5": -1, b"\x1b[6": 1, b"b": -1, b" ": 1}
"""Pages to scroll by key; the rest of an escape sequence is ignored."""
ENDS: Final = {b"\x1b[H": 0, b"g": 0, b"\x1b[F": 1_000_000, b"G": 1_000_000}


@dataclass(frozen=True, slots=True)
class Overview:
    """A headline, and tables below it. `alarm`: the headline reports a fault."""

    headline: str
    tables: Sequence[Table]
    alarm: bool = False

    def print(self) -> None:
        if terminal.at_terminal():
            console = terminal.console()
            console.print(terminal.picture(self.lines(console.width)))
            return
        terminal.print_line(terminal.clean(self.headline))
        for table in self.tables:
            if table.rows:
                terminal.print_line("")
                table.print()

    def lines(self, width: int) -> list[Line]:
        """The headline first. Blank lines divide the tables if the whole then fits a terminal of the usual height."""
        style = "bold red" if self.alarm else "bold"
        lines = [(line, style) for line in terminal.wrapped(terminal.clean(self.headline), width)]
        tables = [table for table in self.tables if table.rows]
        blocks = [table.fitted(width, MAX_ROWS) for table in tables]
        divided = len(lines) + sum(len(block) + 1 for block in blocks) <= USUAL_HEIGHT
        for table, block in zip(tables, blocks, strict=True):
            lines += [("", ""), *block] if divided else block
            if (more := len(table.rows) - MAX_ROWS) > 0:
                lines.append((f"... {more} more rows: --json has all", "dim"))
        return lines


class Scrolled:
    """The part of an overview that fits a terminal: headline, lines of tables from the chosen one, and a hint."""

    def __init__(self) -> None:
        self._first = self._last = 0
        self._room = 1

    def key(self, key: bytes) -> bool:
        """Scroll, and return True if this key does so."""
        if key in ENDS:
            first = ENDS[key]
        elif key in STEPS or key in PAGES:
            first = self._first + STEPS.get(key, 0) + PAGES.get(key, 0) * max(1, self._room - 1)
        else:
            return False
        self._first = max(0, min(first, self._last))
        return True

    def picture(self, overview: Overview) -> Group:
        console = terminal.console()
        head, *lines = overview.lines(console.width)
        # The cursor needs the last line of a terminal.
        self._room = max(1, console.height - 3)
        self._last = max(0, len(lines) - self._room)
        self._first = min(self._first, self._last)
        seen = lines[self._first : self._first + self._room]
        hint = "q or Ctrl-C ends"
        if self._last:
            where = f"lines {self._first + 1} to {self._first + len(seen)} of {len(lines)}"
            hint += f"; {where}: arrows, Page Up and Down scroll"
        return terminal.picture([head, *seen, (terminal.shortened(hint, console.width), "dim")])


class Displayed(Protocol):
    def overview(self) -> Overview:
        """For people."""

    def as_object(self) -> dict[str, Any]:
        """For `--json`."""


async def show(
    shown: Displayed, news: asyncio.Event, refresh: Callable[[], Awaitable[None]], *, watch: bool, as_json: bool
) -> None:
    """Show `shown` once. With `watch`, also after news and each second, until the user presses q: in place at a
    terminal, in a pipe as another block if not only volatile fields changed."""
    stop = asyncio.Event()
    printed: Any = None
    scrolled = Scrolled()
    drawn: Overview | None = None

    def end() -> None:
        stop.set()
        news.set()

    def typed(key: bytes) -> None:
        if key in (b"q", b"Q"):
            end()
        elif scrolled.key(key) and drawn is not None:
            live.draw(scrolled.picture(drawn))

    with ExitStack() as stack:
        live = terminal.LiveLine(shown=watch and not as_json, stays=True)
        if live.watched and sys.stdin.isatty():
            stack.enter_context(terminal.typed_keys(typed, end))
        stack.enter_context(live)
        while not stop.is_set():
            if as_json:
                terminal.print_json(shown.as_object())
            elif live.watched:
                drawn = shown.overview()
                live.draw(scrolled.picture(drawn))
            elif (now := without_volatile(shown.as_object())) != printed:
                if printed is not None:
                    terminal.print_line("")
                shown.overview().print()
                printed = now
            if not watch:
                return
            await done_within(REFRESH_INTERVAL_S, news.wait())
            await done_within(MIN_REFRESH_INTERVAL_S, stop.wait())
            news.clear()
            await refresh()


def without_volatile(value: Any) -> Any:
    """Return a JSON value without the fields that change all the time."""
    if isinstance(value, msgspec.Struct):
        value = msgspec.structs.asdict(value)
    if isinstance(value, dict):
        known = {key: item for key, item in value.items() if key not in VOLATILE_FIELDS}
        # `unseen` maps hosts to durations.
        return {key: sorted(item) if key == "unseen" else without_volatile(item) for key, item in known.items()}
    return [without_volatile(item) for item in value] if isinstance(value, list) else value

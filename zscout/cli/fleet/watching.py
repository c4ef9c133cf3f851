"""A line and tables as they stand now, shown once; or with `--watch` again and again."""

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
from zscout.terminal import Table

if TYPE_CHECKING:
    from rich.console import Group
    from rich.text import Text

EVERY: Final = 1.0
"""Seconds between two refreshes."""
HASTE: Final = 0.1
"""The same where something has changed."""
MAX_ROWS: Final = 500
"""Of one table at a terminal."""
PASSING: Final = frozenset(
    {
        "held",
        "remaining",
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
    | {"clocks", "uptime", "cpu", "memory", "figures", "charged", "part"}
)
"""Fields that change without anything having happened."""


STEPS: Final = {b"\x1b[A": -1, b"\x1b[B": 1, b"\x1bOA": -1, b"\x1bOB": 1, b"k": -1, b"j": 1}
"""Lines by which these keys scroll: arrows, and as in `less`."""
PAGES: Final = {b"\x1b[5": -1, b"\x1b[6": 1, b"b": -1, b" ": 1}
"""The same in pages; the rest of an escape sequence is nothing."""
ENDS: Final = {b"\x1b[H": 0, b"g": 0, b"\x1b[F": 1_000_000, b"G": 1_000_000}


@dataclass(frozen=True, slots=True)
class Overview:
    """A line, and tables below it. `alarm`: the line is about something that is wrong."""

    headline: str
    tables: Sequence[Table]
    alarm: bool = False

    def print(self) -> None:
        if terminal.at_terminal():
            terminal.console().print(self.picture())
            return
        terminal.print_line(terminal.clean(self.headline))
        for table in self.tables:
            if table.rows:
                terminal.print_line("")
                table.print()

    def head(self) -> Text:
        from rich.text import Text

        return Text(terminal.clean(self.headline), style="bold red" if self.alarm else "bold")

    def picture(self, *, headed: bool = True) -> Group:
        """For a terminal."""
        from rich.console import Group
        from rich.text import Text

        parts: list[Any] = [self.head()] if headed else []
        for table in self.tables:
            if table.rows:
                parts += [Text(""), table.picture(MAX_ROWS)]
            if len(table.rows) > MAX_ROWS:
                parts.append(Text(f"... {len(table.rows) - MAX_ROWS} more rows: --json has all", style="dim"))
        return Group(*parts)


class Scrolled:
    """What fits a terminal of an overview: its line above, a hint below, and between them as much of its tables as
    there is room for, from the line on that keys have chosen."""

    def __init__(self) -> None:
        self._first = self._last = 0
        self._room = 1

    def key(self, key: bytes) -> bool:
        """Whether this key scrolls."""
        if key in ENDS:
            first = ENDS[key]
        elif key in STEPS or key in PAGES:
            first = self._first + STEPS.get(key, 0) + PAGES.get(key, 0) * max(1, self._room - 1)
        else:
            return False
        self._first = max(0, min(first, self._last))
        return True

    def picture(self, overview: Overview) -> Group:
        from rich.console import Group
        from rich.segment import Segment, Segments
        from rich.text import Text

        console = terminal.console()
        # The last line of a terminal is left to the cursor.
        lines = console.render_lines(overview.picture(headed=False), pad=False)
        self._room = max(1, console.height - 3)
        self._last = max(0, len(lines) - self._room)
        self._first = min(self._first, self._last)
        seen = lines[self._first : self._first + self._room]
        hint = "q or Ctrl-C ends"
        if self._last:
            where = f"lines {self._first + 1} to {self._first + len(seen)} of {len(lines)}"
            hint += f"; {where}: arrows, Page Up and Down scroll"
        head = overview.head()
        for text in (head, last := Text(hint, style="dim")):
            text.no_wrap, text.overflow = True, "ellipsis"
        return Group(head, Segments([one for line in seen for one in (*line, Segment.line())]), last)


class Displayed(Protocol):
    """Something as it stands now."""

    def overview(self) -> Overview:
        """For people."""

    def as_object(self) -> dict[str, Any]:
        """For `--json`."""


async def show(
    shown: Displayed, news: asyncio.Event, refresh: Callable[[], Awaitable[None]], *, watch: bool, as_json: bool
) -> None:
    """Shows it once; with `watch` again as there is news and each second, after a `refresh`, until somebody presses q:
    in place at a terminal, in a pipe as a block where something has changed that is not a load or a span of time."""
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
            elif (now := lasting(shown.as_object())) != printed:
                if printed is not None:
                    terminal.print_line("")
                shown.overview().print()
                printed = now
            if not watch:
                return
            await done_within(EVERY, news.wait())
            await done_within(HASTE, stop.wait())
            news.clear()
            await refresh()


def lasting(value: Any) -> Any:
    """A JSON value without what changes all the time."""
    if isinstance(value, msgspec.Struct):
        value = msgspec.structs.asdict(value)
    if isinstance(value, dict):
        known = {key: item for key, item in value.items() if key not in PASSING}
        # By host, for how long.
        return {key: sorted(item) if key == "unseen" else lasting(item) for key, item in known.items()}
    return [lasting(item) for item in value] if isinstance(value, list) else value

"""A line and tables as they stand now, shown once; or with `--watch` again and again: in place at a terminal,
a block for each change in a pipe, or JSON lines."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Protocol

from zscout import terminal
from zscout.cli import common
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
    {"held", "remaining", "waited", "starts_in", "seq", "links", "load", "age", "gone"}
    | {"uptime", "cpu", "memory", "figures"}
)
"""Fields that change without anything having happened."""


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

    def picture(self, *after: Text) -> Group:
        """For a terminal."""
        from rich.console import Group
        from rich.text import Text

        headline = terminal.clean(self.headline)
        parts: list[Any] = [Text(headline, style="bold red" if self.alarm else "bold")]
        for table in self.tables:
            if table.rows:
                parts += [Text(""), table.picture(MAX_ROWS)]
            if len(table.rows) > MAX_ROWS:
                more = f"... {len(table.rows) - MAX_ROWS} more rows: --json has all"
                parts.append(Text(more, style="dim"))
        return Group(*parts, *after)


class Displayed(Protocol):
    """Something as it stands now."""

    def overview(self) -> Overview:
        """For people."""

    def as_object(self) -> dict[str, Any]:
        """For `--json`."""


async def show(
    shown: Displayed, news: asyncio.Event, refresh: Callable[[], Awaitable[None]], *, watch: bool, as_json: bool
) -> None:
    """Shows it once; with `watch` again as there is news and each second, after a `refresh`, until somebody
    presses q."""
    if not watch:
        if as_json:
            terminal.print_json(shown.as_object())
        else:
            shown.overview().print()
        return
    stop = asyncio.Event()

    def end() -> None:
        stop.set()
        news.set()

    with _display(as_json=as_json, end=end) as draw:
        while not stop.is_set():
            draw(shown)
            await common.within(EVERY, news)
            await common.within(HASTE, stop)
            news.clear()
            await refresh()


@contextmanager
def _display(*, as_json: bool, end: Callable[[], None]) -> Iterator[Callable[[Displayed], None]]:
    """Gives what shows it each time; calls `end` when somebody presses q."""
    if as_json:
        yield lambda shown: terminal.print_json(shown.as_object())
    elif not terminal.at_terminal():
        yield _blocks()
    else:
        from rich.text import Text

        hint = Text("q or Ctrl-C ends", style="dim")
        with ExitStack() as stack:
            if sys.stdin.isatty():
                ends = (b"q", b"Q")
                stack.enter_context(terminal.typed_keys(lambda key: end() if key in ends else None, end))
            live = stack.enter_context(terminal.LiveLine(stays=True))
            yield lambda shown: live.draw(shown.overview().picture(hint))


def _blocks() -> Callable[[Displayed], None]:
    """Prints a block where something has changed that is not a load or a span of time."""
    last: Any = None

    def draw(shown: Displayed) -> None:
        nonlocal last
        before, last = last, lasting(shown.as_object())
        if before is not None and last != before:
            terminal.print_line("")
        if last != before:
            shown.overview().print()

    return draw


def lasting(value: Any) -> Any:
    """A JSON value without what changes all the time."""
    if isinstance(value, dict):
        return {key: lasting(item) for key, item in value.items() if key not in PASSING}
    return [lasting(item) for item in value] if isinstance(value, list) else value

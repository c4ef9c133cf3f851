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

EVERY: Final = 1.0
"""Seconds between two refreshes."""
HASTE: Final = 0.1
"""The same where something has changed."""
MAX_ROWS: Final = 500
"""Of one table at a terminal."""
PASSING: Final = frozenset(
    {"held", "remaining", "waited", "starts_in", "yields_in", "seq", "links", "load", "age", "gone"}
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

    def picture(self, hint: str = "") -> Group:
        """For a terminal."""
        from rich.console import Group
        from rich.text import Text

        parts: list[Any] = [Text(terminal.clean(self.headline), style="bold red" if self.alarm else "bold")]
        for table in self.tables:
            if table.rows:
                parts += [Text(""), table.picture(MAX_ROWS)]
            if len(table.rows) > MAX_ROWS:
                parts.append(Text(f"... {len(table.rows) - MAX_ROWS} more rows: --json has all", style="dim"))
        if hint:
            parts.append(Text(hint, style="dim"))
        return Group(*parts)


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

    def end() -> None:
        stop.set()
        news.set()

    with ExitStack() as stack:
        live = terminal.LiveLine(shown=watch and not as_json, stays=True)
        if live.watched and sys.stdin.isatty():
            stack.enter_context(terminal.typed_keys(lambda key: end() if key in (b"q", b"Q") else None, end))
        stack.enter_context(live)
        while not stop.is_set():
            if as_json:
                terminal.print_json(shown.as_object())
            elif live.watched:
                live.draw(shown.overview().picture("q or Ctrl-C ends"))
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
        return {key: lasting(item) for key, item in value.items() if key not in PASSING}
    return [lasting(item) for item in value] if isinstance(value, list) else value

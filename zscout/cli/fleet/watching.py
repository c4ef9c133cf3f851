"""`--watch`: the same shown again and again: in place at a terminal, a block for each change in a pipe, or
JSON lines."""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import AsyncExitStack, contextmanager, suppress
from typing import Any, Final, Protocol, TypeAlias

from zscout import terminal
from zscout.cli.fleet.overview import Overview, print_overview, rich_overview

EVERY: Final = 1.0
"""Seconds between two refreshes."""
HASTE: Final = 0.1
"""The same where something has changed."""
PASSING: Final = frozenset(
    {"held", "remaining", "waited", "starts_in", "seq", "links", "load", "age", "gone"}
    | {"uptime", "cpu", "memory", "figures"}
)
"""Fields that change without anything having happened."""


class Displayed(Protocol):
    """Something as it stands now."""

    def overview(self) -> Overview:
        """For people."""

    def as_object(self) -> dict[str, Any]:
        """For `--json`."""


Show: TypeAlias = Callable[[Displayed], None]


def show_once(shown: Displayed, *, as_json: bool) -> None:
    if as_json:
        terminal.print_json(shown.as_object())
    else:
        print_overview(shown.overview())


def display_for(stack: AsyncExitStack, *, as_json: bool, end: Callable[[], None]) -> Show:
    """What shows it each time; calls `end` when somebody presses q. `stack` clears the terminal up."""
    if as_json:
        return lambda shown: terminal.print_json(shown.as_object())
    if terminal.at_terminal():
        stack.enter_context(_q_ends(end))
        return _in_place(stack)
    return _blocks()


async def pause(news: asyncio.Event, stop: asyncio.Event) -> None:
    """Until the next refresh is due."""
    await _within(EVERY, news)
    await _within(HASTE, stop)
    news.clear()


async def _within(seconds: float, event: asyncio.Event) -> None:
    with suppress(TimeoutError):
        async with asyncio.timeout(seconds):
            await event.wait()


def _blocks() -> Show:
    """Prints a block where something has changed that is not a load or a span of time."""
    last: list[Any] = [None]

    def show(shown: Displayed) -> None:
        lasting = _lasting(shown.as_object())
        if lasting != last[0]:
            if last[0] is not None:
                terminal.print_line("")
            last[0] = lasting
            print_overview(shown.overview())

    return show


def _lasting(value: Any) -> Any:
    """A JSON value without what changes all the time."""
    if isinstance(value, dict):
        return {key: _lasting(item) for key, item in value.items() if key not in PASSING}
    return [_lasting(item) for item in value] if isinstance(value, list) else value


def _in_place(stack: AsyncExitStack) -> Show:
    from rich.live import Live
    from rich.text import Text

    live = stack.enter_context(Live(console=terminal.console(), auto_refresh=False))

    def show(shown: Displayed) -> None:
        hint = Text("q or Ctrl-C ends", style="dim")
        live.update(rich_overview(shown.overview(), hint), refresh=True)

    return show


@contextmanager
def _q_ends(end: Callable[[], None]) -> Iterator[None]:
    """Calls `end` when q is pressed, for as long as the context lasts."""
    if not sys.stdin.isatty():
        yield
        return
    import termios
    import tty

    loop, terminal = asyncio.get_running_loop(), sys.stdin.fileno()
    before = termios.tcgetattr(terminal)

    def pressed() -> None:
        typed = os.read(terminal, 1024)
        if not typed or b"q" in typed.lower():
            end()

    tty.setcbreak(terminal)
    loop.add_reader(terminal, pressed)
    try:
        yield
    finally:
        loop.remove_reader(terminal)
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)

"""What the commands about components share: the placer's client, progress on stdout, words."""

from __future__ import annotations

import asyncio
import difflib
import sys
from collections.abc import AsyncIterator, Callable, Collection, Iterable
from contextlib import asynccontextmanager
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self

from msgspec import structs

from zscout import terminal
from zscout.behaviors.client.placer_client import PlacerClient
from zscout.cli import common
from zscout.config.strict import BadInput, quoted
from zscout.keyexpr import check_name
from zscout.messages import Placement

if TYPE_CHECKING:
    from rich.live import Live

    from zscout.behaviors.client.client import Client

PATIENCE: Final = 15.0
"""Seconds within which a placer answers, though the lead changes meanwhile."""
MAX_NAMED: Final = 8
OVER: Final = frozenset({"ended", "given_up"})
"""States of a component that will not run again by itself."""


def placer_of(client: Client, only: Collection[str] | None = None) -> PlacerClient:
    return PlacerClient(client.mesh, only, patience=PATIENCE)


class Progress:
    """How something goes, on stdout: one live line at a terminal, a line for each change in a pipe, nothing
    where it is `quiet`. Use as a context manager: the live line is gone afterwards."""

    def __init__(self, *, quiet: bool) -> None:
        self._quiet = quiet
        self._watched = not quiet and terminal.at_terminal()
        self._live: Live | None = None
        self._said = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.hide()

    def update(self, text: str) -> None:
        """How it stands now."""
        text = terminal.clean(text)
        if self._watched:
            self._draw(text)
        elif text != self._said and not self._quiet:
            terminal.print_line(text)
        self._said = text

    def say(self, text: str) -> None:
        """What has come of it, to stay on the screen."""
        self.hide()
        if not self._quiet:
            terminal.print_line(terminal.clean(text))

    def hide(self) -> None:
        """Takes the live line away."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    @asynccontextmanager
    async def within(
        self, seconds: float | None, late: Callable[[], str], interrupted: str
    ) -> AsyncIterator[None]:
        """Bounds what is awaited inside. Raises Failed with `late()` when the time is over; by Ctrl-C says on
        stderr what stays as it is."""
        try:
            async with asyncio.timeout(seconds):
                yield
        except TimeoutError:
            raise common.Failed(terminal.clean(late())) from None
        except asyncio.CancelledError:
            self.hide()
            terminal.print_line(interrupted, sys.stderr)
            raise

    def _draw(self, text: str) -> None:
        from rich.live import Live
        from rich.text import Text

        picture = Text(text, overflow="ellipsis", no_wrap=True)
        if self._live is None:
            self._live = Live(picture, console=terminal.console(), transient=True, auto_refresh=False)
            self._live.start()
        self._live.update(picture, refresh=True)


# Words


def standing(placement: Placement) -> str:
    """How a component stands, in words that follow its name."""
    why = f": {placement.reason}" if placement.reason else ""
    where = placement.host or "no host"
    match placement.state:
        case "running":
            return f"runs on {where}"
        case "starting":
            return f"is starting on {where}"
        case "waiting":
            return f"waits for a host{why}"
        case "moving":
            return f"is moving from {where} to {placement.to or 'another host'}"
        case "backing_off":
            return f"failed, and will be started again{why}"
        case "stopping":
            return f"is being stopped on {where}"
        case "ended":
            return f"has ended{why}"
        case "given_up":
            return f"is given up{why}"


def unknown(name: str, known: Iterable[str]) -> common.Failed:
    """What to raise where nobody knows a component of this name."""
    names = sorted(known)
    near = difflib.get_close_matches(name, names, n=3)
    if near:
        return common.Failed(f"no component {quoted(name)} is known; did you mean {' or '.join(near)}?")
    if not names:
        return common.Failed(f"no component {quoted(name)} is known, nor any other; start one: zscout start")
    rest = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
    return common.Failed(f"no component {quoted(name)} is known; known: {', '.join(names[:MAX_NAMED])}{rest}")


def tail_of(placement: Placement) -> list[str]:
    """The last lines that a component wrote, unable to draw on the terminal."""
    return [terminal.clean(line.expandtabs()) for line in placement.tail.splitlines()]


def placement_object(placement: Placement) -> dict[str, Any]:
    """A placement for programs: every field, defaults as well."""
    return structs.asdict(placement) | {"spec": structs.asdict(placement.spec)}


def component_named(text: str) -> str:
    """The name of a component as somebody wrote it. Raises BadInput."""
    try:
        return check_name(text, "component")
    except ValueError as error:
        raise BadInput(f"{error}; zscout components lists them") from None

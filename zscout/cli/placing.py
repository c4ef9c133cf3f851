"""What the commands about components share: asking the placer until it answers, following what it does."""

from __future__ import annotations

import asyncio
import difflib
import sys
from collections.abc import AsyncIterator, Callable, Collection, Iterable
from contextlib import asynccontextmanager
from types import TracebackType
from typing import TYPE_CHECKING, Any, Final, Self, TypeAlias, TypeVar

from msgspec import structs

from zscout import clock
from zscout.behaviors.client import TRY_AGAIN, Client
from zscout.cli import common
from zscout.keyexpr import check_name
from zscout.messages import (
    EndComponent,
    ListPlacements,
    MigrateComponent,
    PlaceComponent,
    Placement,
    Placements,
    PlacerOperation,
    absurd,
)
from zscout.scheduling.model import NO_TERM, SECOND, Term
from zscout.strict import BadInput, quoted

if TYPE_CHECKING:
    from rich.live import Live

PATIENCE: Final = 15.0
"""Seconds within which a placer answers, though the lead changes meanwhile."""
TIMEOUT: Final = 5.0
"""Of one asking: a placer that has just begun first hears from all nodes."""
AGAIN: Final = 0.2
LOOK_EVERY: Final = 1.0
MAX_NAMED: Final = 8
OVER: Final = frozenset({"ended", "given_up"})
"""States of a component that will not run again by itself."""

R = TypeVar("R")
Lasting: TypeAlias = PlaceComponent | EndComponent | MigrateComponent


class PlacerRefused(common.Failed):
    """The placer will not do what was asked; `code` is the protocol's."""

    def __init__(self, code: str, message: str) -> None:
        super().__init__(message)
        self.code = code


async def ask_once(client: Client, operation: PlacerOperation, kind: type[R]) -> R | None:
    """One asking of the placer; None: no answer, so that it may be done or not. Raises PlacerRefused."""
    replies = await client.mesh.ask(
        client.mesh.keys.placer,
        operation,
        kind,
        timeout=TIMEOUT,
        enough=lambda reply: reply.message is not None,
    )
    for reply in replies:
        if reply.message is not None:
            return reply.message
    problem = next((reply.problem for reply in replies if reply.problem is not None), None)
    if problem is not None and problem.code not in TRY_AGAIN:
        raise PlacerRefused(problem.code, common.clean(problem.message))
    return None


async def ask_placer(client: Client, operation: PlacerOperation, kind: type[R]) -> R:
    """Asks until the placer answers: only what may be done twice. Raises PlacerRefused, NobodyThere."""
    deadline = clock.now() + round(PATIENCE * SECOND)
    while True:
        answer = await ask_once(client, operation, kind)
        if answer is not None:
            return answer
        if clock.now() > deadline:
            raise common.NobodyThere(
                f"the component placer of fleet {client.fleet.name} did not answer for {PATIENCE:.0f} s; "
                "see zscout status, and the log of zscout-node where it leads"
            )
        await asyncio.sleep(AGAIN)


class Placed:
    """The placer's records as this client knows them from now on: from what is published, and by asking.

    Use as a context manager. `only` leaves all other components out."""

    def __init__(self, client: Client, only: Collection[str] | None = None) -> None:
        self.client, self.only = client, only
        self.records: dict[str, Placement] = {}
        self.cordoned: frozenset[str] = frozenset()
        self.term: Term = NO_TERM
        self.changed = asyncio.Event()

    def __enter__(self) -> Self:
        keys = self.client.mesh.keys
        self._heard = self.client.mesh.subscribe(keys.placements, Placements, self._on_told)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._heard.close()

    def take(self, *placements: Placement) -> None:
        """An answer of the placer about these."""
        for placement in placements:
            if self.only is None or placement.component in self.only:
                self.records[placement.component] = placement
        self.changed.set()

    async def look(self) -> None:
        """Asks for all of them. Raises NobodyThere."""
        self._answered(await ask_placer(self.client, self._question(), Placements))

    async def glance(self) -> bool:
        """The same, once; tells whether there was an answer."""
        told = await ask_once(self.client, self._question(), Placements)
        if told is not None:
            self._answered(told)
        return told is not None

    async def news(self, seconds: float = LOOK_EVERY) -> None:
        """Waits until something was published, at most so long: then it asks. Raises NobodyThere."""
        try:
            async with asyncio.timeout(seconds):
                await self.changed.wait()
        except TimeoutError:
            await self.look()
        self.changed.clear()

    async def once(self, operation: Lasting, done: Callable[[Placement], bool]) -> Placement:
        """Has the placer do something to a component, and not twice: where its answer is missing, its record
        says by `done` whether it was done. Raises PlacerRefused, NobodyThere."""
        deadline = clock.now() + round(PATIENCE * SECOND)
        while True:
            answer = await ask_once(self.client, operation, Placement)
            if answer is not None:
                self.take(answer)
                return answer
            await self.look()
            record = self.records.get(operation.component)
            if record is not None and done(record):
                return record
            if clock.now() > deadline:
                raise common.NobodyThere(
                    "the component placer did not answer: it may be done or not; see zscout components"
                )
            await asyncio.sleep(AGAIN)

    def _question(self) -> ListPlacements:
        one = next(iter(self.only)) if self.only is not None and len(self.only) == 1 else None
        return ListPlacements(one)

    def _answered(self, told: Placements) -> None:
        self.records = {}
        self.term, self.cordoned = told.term, frozenset(told.cordoned)
        self.take(*told.components)

    def _on_told(self, _key: str, told: Placements) -> None:
        if told.term < self.term or absurd(told.term, self.term):
            return
        self.term, self.cordoned = told.term, frozenset(told.cordoned)
        self.take(*told.components)
        for name in told.forgotten:
            self.records.pop(name, None)


class Progress:
    """How something goes, on stdout: one live line at a terminal, a line for each change in a pipe, nothing
    where it is `quiet`. Use as a context manager: the live line is gone afterwards."""

    def __init__(self, *, quiet: bool) -> None:
        self._quiet = quiet
        self._watched = not quiet and common.at_terminal()
        self._live: Live | None = None
        self._said = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.hide()

    def tell(self, text: str) -> None:
        """How it stands now."""
        text = common.clean(text)
        if self._watched:
            self._draw(text)
        elif text != self._said and not self._quiet:
            common.print_line(text)
        self._said = text

    def say(self, text: str) -> None:
        """What has come of it, to stay on the screen."""
        self.hide()
        if not self._quiet:
            common.print_line(common.clean(text))

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
            raise common.Failed(common.clean(late())) from None
        except asyncio.CancelledError:
            self.hide()
            common.print_line(interrupted, sys.stderr)
            raise

    def _draw(self, text: str) -> None:
        from rich.live import Live
        from rich.text import Text

        picture = Text(text, overflow="ellipsis", no_wrap=True)
        if self._live is None:
            self._live = Live(picture, console=common.console(), transient=True, auto_refresh=False)
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
    return [common.clean(line.expandtabs()) for line in placement.tail.splitlines()]


def placement_object(placement: Placement) -> dict[str, Any]:
    """A placement for programs: every field, defaults as well."""
    return structs.asdict(placement) | {"spec": structs.asdict(placement.spec)}


def component_named(text: str) -> str:
    """The name of a component as somebody wrote it. Raises BadInput."""
    try:
        return check_name(text, "component")
    except ValueError as error:
        raise BadInput(f"{error}; zscout components lists them") from None

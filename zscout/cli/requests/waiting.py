"""The progress of a request: a live line at a terminal, plain lines in a pipe, or JSON lines."""

from __future__ import annotations

import asyncio
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import TracebackType
from typing import IO, TYPE_CHECKING, Any, Self

from msgspec.structs import replace

from zscout.behaviors.client.client import Client
from zscout.behaviors.client.request import OpenArc
from zscout.cli.requests.contention import contention_of, held_text
from zscout.mesh import clock
from zscout.messages import RcmState
from zscout.terminal import at_terminal, clean, console, print_json, print_line, span
from zscout.types import SECOND, Ns

if TYPE_CHECKING:
    from rich.live import Live

REFRESH = 1.0
"""Seconds between two looks at who holds what, at least; and where somebody watches, between two pictures."""


@dataclass(frozen=True, slots=True)
class Ending:
    """How the last hold came to its end, in the protocol's word and in words."""

    outcome: str = "lost"
    reason: str = ""
    by: str | None = None


class Report:
    """Tells of one request on `stream`. Use as a context manager: the live line is gone afterwards."""

    def __init__(self, name: str, client: str, *, as_json: bool, stream: IO[str]) -> None:
        self._name, self._client, self._as_json, self._stream = name, client, as_json, stream
        self._watched = not as_json and at_terminal(stream)
        self._live: Live | None = None
        self._said: object = None
        self._state: RcmState | None = None
        """As it was `_looked` at, when `_seen` was the newest notice."""
        self._looked: Ns | None = None
        self._seen: object = None
        self._changed = asyncio.Event()
        self._arc: OpenArc | None = None
        self.ending = Ending()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.hide()

    # What happened

    def event(self, kind: str, text: str, details: Mapping[str, Any] | None = None) -> None:
        """Reports one event: `text` for people (empty: nothing), the rest for programs."""
        if self._as_json:
            who = {"event": kind, "arc": self._name, "client": self._client}
            print_json(who | dict(details or {}), self._stream)
        elif not text:
            pass
        elif self._live is not None:
            self._live.console.print(clean(text), soft_wrap=True)
        else:
            print_line(clean(text), self._stream)

    def show(self, *lines: str) -> None:
        """Draws the live lines anew; nothing where nobody watches."""
        if not self._watched:
            return
        from rich.live import Live
        from rich.text import Text

        picture = Text("\n".join(clean(line) for line in lines), overflow="ellipsis", no_wrap=True)
        if self._live is None:
            self._live = Live(
                picture,
                console=console(stderr=self._stream is sys.stderr),
                transient=True,
                auto_refresh=False,
            )
            self._live.start()
        self._live.update(picture, refresh=True)

    def hide(self) -> None:
        """Takes the live lines away: the terminal is another's now."""
        if self._live is not None:
            self._live.stop()
            self._live = None

    # Following

    def news(self, arc: OpenArc) -> None:
        """A watcher for the client."""
        self._arc = arc
        # The next word, that it waits again, may be here before anybody has looked at this one.
        if arc.outcome is not None and arc.state != "running":
            self.ending = Ending(arc.outcome, arc.reason, arc.by)
        self._changed.set()

    async def follow_wait(self, client: Client) -> None:
        """Tells how the request waits, until cancelled."""
        while True:
            await self._look_is_due()
            self._changed.clear()
            arc = self._arc
            if arc is None:
                self.show(f"{self._name}: asking the RCM")
            elif arc.state in ("asking", "queued") and arc.reason:
                if arc.state == "queued" and self._is_news(arc):
                    self._looked, self._seen = clock.now(), arc.last
                    self._state = await client.state()
                if arc.state in ("asking", "queued"):
                    self._tell_wait(arc)
            await self._news_or_a_second()

    async def _look_is_due(self) -> None:
        """One look per REFRESH: news may come in a crowd."""
        while self._looked is not None and self._arc is not None and self._arc.state == "queued":
            left = REFRESH - (clock.now() - self._looked) / SECOND
            if left <= 0:
                return
            await asyncio.sleep(left)

    def _is_news(self, arc: OpenArc) -> bool:
        """Whether who holds what may have changed since the last look, for somebody who sees it."""
        return arc.last != self._seen if self._watched else _how(arc) != self._said

    def _tell_wait(self, arc: OpenArc) -> None:
        state = self._state if arc.state == "queued" else None
        own = f"{self._client}/{arc.id}"
        since = (clock.now() - self._looked) / SECOND if self._looked is not None else 0.0
        needs = contention_of(_aged(state, since), arc.needs, own) if state is not None else []
        starts_in = start = None
        if arc.start is not None:
            starts_in = round(max(0, arc.start - clock.now()) / SECOND, 3)
        if arc.state == "queued":
            start = "no start can be foretold" if starts_in is None else f"starts in {span(starts_in)}"
        # A sharable RC has holders who are in nobody's way, unless the reason names it. Two patterns may be
        # met by one RC: it is listed once.
        met = {rc.rc: rc for need in needs if need.rc or not need.met for rc in need.rcs if rc.holds}
        in_way = [rc for rc in met.values() if not rc.sharable or (arc.why and rc.rc in arc.why.rcs)]
        ahead = f", {arc.ahead} ahead" if arc.ahead else ""
        self.show(
            f"{arc.name} waits {span(_since(arc))}{ahead}{start and f', {start}'}: {arc.reason}",
            *(f"  {rc.text()}" for rc in in_way),
        )
        # Without the estimate: it changes all the time.
        if self._watched or self._said == _how(arc):
            return
        self._said = _how(arc)
        more = "".join(f"; {text}" for text in (start, *(rc.text() for rc in in_way)) if text)
        details = {
            "id": arc.id,
            "reason": arc.reason,
            "ahead": arc.ahead,
            "starts_in": starts_in,
            "needs": [need.as_json() for need in needs],
        }
        self.event("waits", f"{arc.name} waits{ahead}: {arc.reason}{more}", details)

    async def follow_hold(self, arc: OpenArc) -> None:
        """Shows how long a hold without a command goes on, until cancelled."""
        while True:
            self._changed.clear()
            left = (arc.end - clock.now()) / SECOND
            rest = f"held for {span(_since(arc))}, kept" if arc.keep else f"{span(left)} left"
            self.show(f"{arc.name} holds {held_text(arc.rcs, arc.bound)}: {rest}; Ctrl-C gives back")
            await self._news_or_a_second()

    async def within(self, seconds: float, true: Callable[[], bool]) -> None:
        """Waits for news until `true`, at most so long."""
        try:
            async with asyncio.timeout(seconds):
                while not true():
                    self._changed.clear()
                    await self._changed.wait()
        except TimeoutError:
            pass

    async def _news_or_a_second(self) -> None:
        try:
            async with asyncio.timeout(REFRESH if self._watched else None):
                await self._changed.wait()
        except TimeoutError:
            pass


def _how(arc: OpenArc) -> object:
    return arc.state, arc.reason, arc.ahead


def _aged(state: RcmState, seconds: float) -> RcmState:
    """The state as it is so much later, if nothing has happened."""
    holds = [
        replace(hold, held=hold.held + seconds, remaining=hold.remaining - seconds) for hold in state.holds
    ]
    return replace(state, holds=holds)


def _since(arc: OpenArc) -> float:
    return (clock.now() - arc.since) / SECOND

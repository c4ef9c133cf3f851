"""The progress of a request: a live line at a terminal, plain lines in a pipe, or JSON lines."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine, Mapping
from contextlib import asynccontextmanager
from typing import IO, Any, Final

from msgspec.structs import replace

from zscout.behaviors.client.client import Client
from zscout.behaviors.client.request import OpenArc
from zscout.cli import common
from zscout.cli.requests.contention import contention_of, held_text
from zscout.messages import RcmState
from zscout.terminal import LiveLine, print_json, span
from zscout.types import SECOND, Ns

REFRESH: Final = 1.0
"""Seconds between two looks at who holds what, at least; and where somebody watches, between two pictures."""


class Report(LiveLine):
    """Tells of one request of a client on `stream`. Use as a context manager: the live line is gone
    afterwards."""

    def __init__(self, name: str, client: Client, *, as_json: bool, stream: IO[str]) -> None:
        super().__init__(stream, shown=not as_json)
        self._name, self._client, self._as_json = name, client, as_json
        self._mesh = client.mesh
        self._said: object = None
        self._state: RcmState | None = None
        """As it was `_looked` at, when `_seen` was the newest notice."""
        self._looked: Ns | None = None
        self._seen: object = None
        self._changed = asyncio.Event()
        self._arc: OpenArc | None = None

    def event(self, kind: str, text: str, details: Mapping[str, Any] | None = None) -> None:
        """Reports one event: `text` for people (empty: nothing), the rest for programs."""
        if self._as_json:
            who = {"event": kind, "arc": self._name, "client": str(self._mesh.me)}
            print_json(who | dict(details or {}), self._stream)
        elif text:
            self.print(text)

    def news(self, arc: OpenArc) -> None:
        """A watcher for the client."""
        self._arc = arc
        self._changed.set()

    @asynccontextmanager
    async def telling(self, follow: Coroutine[Any, Any, None]) -> AsyncIterator[None]:
        """Runs `follow_wait` or `follow_hold` for as long as the context lasts."""
        try:
            async with common.beside(follow):
                yield
        finally:
            self.hide()

    async def follow_wait(self) -> None:
        """Tells how the request waits, until cancelled."""
        while True:
            await self._look_is_due()
            self._changed.clear()
            arc = self._arc
            if arc is None:
                self.draw(f"{self._name}: asking the RCM")
            elif arc.state in ("asking", "queued") and arc.reason:
                if arc.state == "queued" and self._is_news(arc):
                    self._looked, self._seen = self._mesh.now(), arc.last
                    self._state = await self._client.state()
                if arc.state in ("asking", "queued"):
                    self._tell_wait(arc)
            await self._news_or_a_second()

    async def follow_hold(self, arc: OpenArc) -> None:
        """Shows how long a hold without a command goes on, until cancelled."""
        while True:
            self._changed.clear()
            left = (arc.end - self._mesh.now()) / SECOND
            rest = f"held for {span(self._since(arc))}, kept" if arc.keep else f"{span(left)} left"
            self.draw(f"{arc.name} holds {held_text(arc.rcs, arc.bound)}: {rest}; Ctrl-C gives back")
            await self._news_or_a_second()

    async def within(self, seconds: float, true: Callable[[], bool]) -> None:
        """Waits for news until `true`, at most so long."""
        deadline = self._mesh.now() + round(seconds * SECOND)
        while not true() and (left := deadline - self._mesh.now()) > 0:
            self._changed.clear()
            await common.within(left / SECOND, self._changed)

    async def _look_is_due(self) -> None:
        """One look per REFRESH: news may come in a crowd."""
        while self._looked is not None and self._arc is not None and self._arc.state == "queued":
            left = REFRESH - (self._mesh.now() - self._looked) / SECOND
            if left <= 0:
                return
            await asyncio.sleep(left)

    def _is_news(self, arc: OpenArc) -> bool:
        """Whether who holds what may have changed since the last look, for somebody who sees it."""
        return arc.last != self._seen if self.watched else _how(arc) != self._said

    def _tell_wait(self, arc: OpenArc) -> None:
        state = self._state if arc.state == "queued" else None
        own = f"{self._mesh.me}/{arc.id}"
        since = (self._mesh.now() - self._looked) / SECOND if self._looked is not None else 0.0
        needs = contention_of(_aged(state, since), arc.needs, own) if state is not None else []
        starts_in = start = None
        if arc.start is not None:
            starts_in = round(max(0, arc.start - self._mesh.now()) / SECOND, 3)
        if arc.state == "queued":
            start = "no start can be foretold" if starts_in is None else f"starts in {span(starts_in)}"
        # A sharable RC has holders who are in nobody's way, unless the reason names it. Two patterns may be
        # met by one RC: it is listed once.
        met = {rc.rc: rc for need in needs if need.rc or not need.met for rc in need.rcs if rc.holds}
        in_way = [rc for rc in met.values() if not rc.sharable or (arc.why and rc.rc in arc.why.rcs)]
        ahead = f", {arc.ahead} ahead" if arc.ahead else ""
        lines = [
            f"{arc.name} waits {span(self._since(arc))}{ahead}{f', {start}' if start else ''}: {arc.reason}",
            *(f"  {rc.text()}" for rc in in_way),
        ]
        self.draw("\n".join(lines))
        # Without the estimate: it changes all the time.
        if self.watched or self._said == _how(arc):
            return
        self._said = _how(arc)
        more = "".join(f"; {text}" for text in (start, *(rc.text() for rc in in_way)) if text)
        details: dict[str, Any] = {"id": arc.id, "reason": arc.reason, "ahead": arc.ahead}
        details |= {"starts_in": starts_in, "needs": [need.as_json() for need in needs]}
        self.event("waits", f"{arc.name} waits{ahead}: {arc.reason}{more}", details)

    def _since(self, arc: OpenArc) -> float:
        return (self._mesh.now() - arc.since) / SECOND

    async def _news_or_a_second(self) -> None:
        await common.within(REFRESH if self.watched else None, self._changed)


def _how(arc: OpenArc) -> object:
    return arc.state, arc.reason, arc.ahead


def _aged(state: RcmState, seconds: float) -> RcmState:
    """The state as it is so much later, if nothing has happened."""
    holds = [
        replace(hold, held=hold.held + seconds, remaining=hold.remaining - seconds) for hold in state.holds
    ]
    return replace(state, holds=holds)

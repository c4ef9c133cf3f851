"""What a request waits for: each need, the RCs that would meet it, and who holds them, as the RCM sees it.

And the report of its progress: a live line at a terminal, plain lines in a pipe, or JSON lines."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Collection, Coroutine, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import IO, Any, Final

from msgspec.structs import replace

from zscout.behaviors.client.client import Client
from zscout.behaviors.client.request import OpenArc
from zscout.cli import common
from zscout.keyexpr import is_pattern, matcher
from zscout.messages import HoldView, RcmState
from zscout.terminal import LiveLine, clean, print_json, span
from zscout.types import SECOND, Ns

REFRESH: Final = 1.0
"""Seconds between two looks at who holds what, at least; and where somebody watches, between two pictures."""


# Who is in the way


@dataclass(frozen=True, slots=True)
class RcContention:
    """One RC, and the holds of others on it."""

    rc: str
    present: bool
    sharable: bool
    holds: list[HoldView]

    @property
    def free(self) -> bool:
        return self.present and not self.holds

    def text(self) -> str:
        """Who has it and since when, in words."""
        return f"{self.rc}: " + "; ".join(hold_text(hold) for hold in self.holds)


@dataclass(slots=True)
class NeedContention:
    """One need, and the RCs that would meet it: the one that it names, or those that match."""

    need: str
    rcs: list[RcContention]
    rivals: int = field(default=0, init=False)
    """How many of the request's other patterns some of these RCs would meet as well."""

    @property
    def rc(self) -> str | None:
        """The RC that it names."""
        return None if is_pattern(self.need) else self.need

    @property
    def present(self) -> bool:
        """Whether there is anything on the mesh that would meet it."""
        return any(rc.present for rc in self.rcs)

    @property
    def sharable(self) -> bool:
        return bool(self.rcs) and all(rc.sharable for rc in self.rcs)

    @property
    def free(self) -> list[str]:
        """The RCs that nobody else holds."""
        return [rc.rc for rc in self.rcs if rc.free]

    @property
    def met(self) -> bool:
        """Whether there is a free one for it, whatever the other needs are met by."""
        return len(self.free) > self.rivals

    def as_json(self) -> dict[str, Any]:
        """For programs; `rc` is null for a pattern."""
        return {
            "need": self.need,
            "rc": self.rc,
            "present": self.present,
            "sharable": self.sharable,
            "free": self.free,
            "holders": [hold_json(hold) | {"rc": rc.rc} for rc in self.rcs for hold in rc.holds],
        }


def contention_of(state: RcmState, needs: Collection[str], own: str = "") -> list[NeedContention]:
    """How each need stands, holds of the ARC `own` (`<host>/<client>/<id>`) left out. What one need names
    does not meet another."""
    holds = [hold for hold in state.holds if f"{hold.client}/{hold.id}" != own]
    views = {view.rc: view for view in state.rcs}

    def seen(rc: str) -> RcContention:
        view = views.get(rc)
        theirs = [hold for hold in holds if rc in hold.needs]
        return RcContention(rc, view is not None and view.present, view is not None and view.sharable, theirs)

    found = []
    for need in sorted(needs):
        meets = matcher(need)
        matching = sorted(rc for rc in views if rc not in needs and meets(rc)) if is_pattern(need) else [need]
        # What matches and has gone says nothing: another will do.
        rcs = [seen(rc) for rc in matching if not is_pattern(need) or views[rc].present]
        found.append(NeedContention(need, rcs))
    for one in found:
        own_rcs = {rc.rc for rc in one.rcs}
        one.rivals = sum(1 for other in found if other is not one and own_rcs & {rc.rc for rc in other.rcs})
    return found


def hold_text(hold: HoldView) -> str:
    """Whose hold it is and since when, in words."""
    left = "kept" if hold.keep else f"{span(hold.remaining)} left"
    return clean(f"{hold.arc} (priority {hold.priority}, {hold.client}) for {span(hold.held)}, {left}")


def hold_json(hold: HoldView) -> dict[str, Any]:
    """The same for programs."""
    said = {name: getattr(hold, name) for name in ("arc", "id", "client", "priority", "keep")}
    return said | {"held": round(hold.held, 3), "remaining": round(hold.remaining, 3)}


def held_text(rcs: Collection[str], bound: dict[str, str]) -> str:
    """What is held, and for which pattern: `framegrabber/fgrab1 for framegrabber/*, robot/a`."""
    met = {rc: need for need, rc in bound.items()}
    return ", ".join(f"{rc} for {met[rc]}" if rc in met else rc for rc in sorted(rcs))


# The report


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

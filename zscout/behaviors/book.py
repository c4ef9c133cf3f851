"""A client's requests: how each stands, who waits for news of it, and whether the client is paused. Pure."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import msgspec

from zscout import clock
from zscout.behaviors.request import OpenArc
from zscout.keyexpr import new_instance
from zscout.messages import Notice, OpenRequest


class Book:
    """All that a client has asked for and that is not over, by request id."""

    def __init__(self) -> None:
        self.arcs: dict[str, OpenArc] = {}
        self.moved: dict[str, OpenArc] = {}
        """What was handed over while this client was paused, and may be taken back."""
        self.expected: dict[str, OpenArc] = {}
        """What is to be handed to this client, and of which it has heard nothing yet."""
        self.undecided: set[str] = set()
        """Ids of what was to be handed over, where nobody could tell whether it was."""
        self.reclaimed: set[str] = set()
        """Those of them that are this client's in any case: under a new id if they were handed over."""
        self.resumed = asyncio.Event()
        """Not set while the client is paused."""
        self.resumed.set()
        self._news: dict[str, asyncio.Event] = {}
        self._watchers: list[Callable[[OpenArc], None]] = []

    @property
    def open(self) -> list[OpenArc]:
        return [arc for arc in self.arcs.values() if arc.open]

    @property
    def standing(self) -> list[OpenArc]:
        """Those that the RCM has answered: queued or running."""
        return [arc for arc in self.open if arc.state != "asking"]

    def enter(self, arc: OpenArc) -> None:
        self.arcs[arc.id] = arc
        self.listen(arc)

    def listen(self, arc: OpenArc) -> None:
        """From now on somebody may wait for news of `arc`."""
        self._news.setdefault(arc.id, asyncio.Event())

    def forget(self, arc: OpenArc) -> None:
        self.arcs.pop(arc.id, None)
        self.moved.pop(arc.id, None)
        self.expected.pop(arc.id, None)
        self._news.pop(arc.id, None)

    def watch(self, watcher: Callable[[OpenArc], None]) -> None:
        self._watchers.append(watcher)

    def wake(self, arc: OpenArc) -> None:
        """Tells all that there is news of `arc`."""
        event = self._news.get(arc.id)
        if event is not None:
            event.set()
        for watcher in self._watchers:
            watcher(arc)

    async def changed(self, arc: OpenArc) -> None:
        """Waits for the next news; not at all where none is to come."""
        event = self._news.get(arc.id)
        if event is not None:
            event.clear()
            await event.wait()

    def take(self, arc: OpenArc, notice: Notice) -> None:
        """Takes a word of the RCM about one of `arcs`."""
        if notice.id != arc.id:
            # An answer that was on its way when the ARC was taken back under another id.
            return
        if notice.outcome == "handed_over" and not self.resumed.is_set():
            # Not before the hand-over is answered: an RCM that dies first may not have told the new client.
            return
        if notice.outcome == "handed_over" and arc.id in self.reclaimed:
            self.move(arc, notice)
            self.reclaim(arc)
        elif arc.take(notice, clock.now()):
            self.reclaimed.discard(arc.id)
            self.wake(arc)
            if not arc.open:
                self.forget(arc)

    def told(self) -> list[OpenRequest]:
        """As an RCM that takes the lead is told of all. What is expected has no place: it is this client's if
        the RCs say so, and nothing is queued for it otherwise."""
        now = clock.now()
        expected = [msgspec.structs.replace(arc.told(now), place=None) for arc in self.expected.values()]
        return [*(arc.told(now) for arc in self.open), *expected]

    def move(self, arc: OpenArc, notice: Notice) -> None:
        """`arc` goes on in another client, as `notice` says; words from before that are old."""
        arc.move(clock.now())
        arc.last = max(arc.last, (notice.term, notice.step))
        self.arcs.pop(arc.id, None)
        self.moved[arc.id] = arc
        self.wake(arc)

    def reclaim(self, arc: OpenArc) -> None:
        """A moved one is this client's again, under a new id; it is to be asked for."""
        del self.moved[arc.id]
        self.reclaimed.discard(arc.id)
        news = self._news.pop(arc.id, None)
        arc.take_back(new_instance(), "it was handed over, and its new client is gone", clock.now())
        self.arcs[arc.id] = arc
        # Who waits for news goes on waiting for those of the same ARC.
        self._news[arc.id] = news or asyncio.Event()
        self.wake(arc)

"""Components, as the placer publishes them, as lanes, marks and events."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Collection
from contextlib import suppress
from dataclasses import dataclass
from typing import Final

from zscout.keyexpr import NAME
from zscout.mesh import Declaration, Mesh, Supervisor
from zscout.messages import MAX_PLACED, ListPlacements, Placement, Placements, absurd
from zscout.services.recorder.hosts import Running
from zscout.services.recorder.timeline import Timeline
from zscout.types import NO_TERM, Term

log = logging.getLogger(__name__)

READ_TIMEOUT: Final = 2.0
AGAIN: Final = 2.0
"""Seconds until a placer that did not answer is asked again."""
TRIES: Final = 5
"""Past it, it is asked when an RCM comes or something was missed."""
DEPTH: Final = 8_192
"""Publications that may wait here."""
MAX_FOLLOWED: Final = 2 * MAX_PLACED


@dataclass(slots=True)
class _Component:
    """A component that is followed: its newest placement, and which start of it ran last, where."""

    placement: Placement
    ran: int = 0
    where: str | None = None


class PlacementTracker:
    """Writes to `timeline` what a placer publishes, in its order. Times are the timeline's."""

    def __init__(self, timeline: Timeline) -> None:
        self.timeline = timeline
        self.term: Term = NO_TERM
        self._components: dict[str, _Component] = {}
        self._hosts: dict[str, dict[str, Running]] = {}
        self._cordoned: frozenset[str] | None = None

    def published(self, at: float, news: Placements) -> None:
        """What has changed."""
        if self._is_old(news):
            return
        touched: set[str] = set()
        for placement in news.components:
            touched |= self._take(at, placement, news=True)
        for name in news.forgotten:
            touched |= self._forget(name)
        self._show(at, touched)
        self._cordon(at, news)

    def listed(self, at: float, news: Placements, fresher: Collection[str]) -> None:
        """All there is. `fresher` names what was published since the question, and is known better.

        What was not known before is shown, but did not happen now."""
        if self._is_old(news):
            return
        touched: set[str] = set()
        for placement in news.components:
            if placement.component not in fresher:
                known = placement.component in self._components
                touched |= self._take(at, placement, news=known)
        there = {placement.component for placement in news.components}
        for name in self._components.keys() - there - set(fresher):
            touched |= self._forget(name)
        self._show(at, touched)
        self._cordon(at, news)

    def _is_old(self, news: Placements) -> bool:
        if news.term < self.term or absurd(news.term, self.term):
            return True
        self.term = news.term
        return False

    def _take(self, at: float, now: Placement, *, news: bool) -> set[str]:
        """Takes a component in; returns the hosts whose lanes are another."""
        names = (now.component, *(host for host in (now.host, now.to) if host is not None))
        if not all(NAME.fullmatch(name) for name in names):
            log.warning("the placer published a component or host with a bad name: %.200r", names)
            return set()
        known = self._components.get(now.component)
        touched = self._unseat(now.component)
        if known is None:
            if len(self._components) >= MAX_FOLLOWED:
                return touched
            known = self._components[now.component] = _Component(now)
            before = None
        else:
            before, known.placement = known.placement, now
        self._log_change(at, known, before, news=news)
        if now.state in ("running", "moving") and now.host is not None:
            known.ran, known.where = max(known.ran, now.incarnation), now.host
        for host, running in _seats(now).items():
            self._hosts.setdefault(host, {})[now.component] = running
            touched.add(host)
        return touched

    def _log_change(self, at: float, known: _Component, before: Placement | None, *, news: bool) -> None:
        """The event, and the marks, if any."""
        now, name, timeline = known.placement, known.placement.component, self.timeline
        why = f": {now.reason}" if now.reason else ""
        if now.state == "running" and now.host is not None and now.incarnation > known.ran:
            if not news:
                timeline.event(at, f"{name} ({now.spec.kind}) runs on {now.host} already")
            elif not known.ran or known.where is None:
                timeline.hosts.mark(at, now.host, "placed", name)
                timeline.event(at, f"{name} ({now.spec.kind}) is placed on {now.host}{why}")
            elif before is not None and now.moves > before.moves:
                dead = "" if now.dead is None else f", dead {_duration(now.dead)}"
                timeline.hosts.mark(at, known.where, "left", name)
                timeline.hosts.mark(at, now.host, "came", name)
                timeline.event(at, f"{name} moved {known.where} -> {now.host}{dead}")
            else:
                was = "" if now.host == known.where else f", it was on {known.where}"
                timeline.hosts.mark(at, now.host, "restarted", name)
                timeline.event(at, f"{name} is restarted on {now.host}{was}{why}", "WARN")
            return
        if before is not None and (before.state, before.reason) == (now.state, now.reason):
            return
        match now.state:
            case "waiting":
                timeline.event(at, f"{name} waits for a host{why}", "WARN")
            case "moving":
                timeline.event(at, f"{name} moves from {now.host} to {now.to}{why}")
            case "running" if before is not None and before.state == "moving":
                timeline.event(at, f"{name} stays on {now.host}{why}", "WARN")
            case "backing_off":
                where = f" on {known.where}" if known.where else ""
                timeline.event(at, f"{name} failed{where}, and is tried again{why}", "WARN")
            case "ended":
                timeline.event(at, f"{name} ended{why}")
            case "given_up":
                host = known.where or now.host
                if host is not None and news:
                    timeline.hosts.mark(at, host, "given_up", name)
                timeline.event(at, f"{name} is given up{why}", "ERROR")
            case _:
                pass

    def _forget(self, name: str) -> set[str]:
        touched = self._unseat(name)
        self._components.pop(name, None)
        return touched

    def _unseat(self, name: str) -> set[str]:
        known = self._components.get(name)
        seats = _seats(known.placement) if known is not None else {}
        for host in seats:
            self._hosts[host].pop(name, None)
        return set(seats)

    def _show(self, at: float, hosts: set[str]) -> None:
        for host in sorted(hosts):
            self.timeline.hosts.runs(at, host, list(self._hosts[host].values()))

    def _cordon(self, at: float, news: Placements) -> None:
        cordoned, before = frozenset(news.cordoned), self._cordoned or frozenset()
        self._cordoned = cordoned
        for host in sorted(cordoned - before):
            self.timeline.event(at, f"{host} is being emptied: nothing is placed there any more", "WARN")
        for host in sorted(before - cordoned):
            self.timeline.event(at, f"{host} is used again")


def _seats(placement: Placement) -> dict[str, Running]:
    """In which hosts' lanes a component stands, and how."""
    name, host = placement.component, placement.host
    if host is None:
        return {}
    match placement.state:
        case "running":
            return {host: Running(name)}
        case "moving" if placement.to is not None and placement.to != host:
            return {
                host: Running(name, f"moves to {placement.to}"),
                placement.to: Running(name, "gets ready", ready=False),
            }
        case "moving":
            return {host: Running(name, "moves")}
        case "starting" | "stopping":
            return {host: Running(name, placement.state, ready=placement.state == "stopping")}
        case _:
            return {}


def _duration(seconds: float) -> str:
    return f"{seconds * 1000:.0f} ms" if seconds < 1 else f"{seconds:.1f} s"


class PlacementFollower:
    """Subscribes to the placer of a mesh, and asks it for what was published before. `now` is the timeline's
    time."""

    def __init__(
        self, mesh: Mesh, timeline: Timeline, now: Callable[[], float], supervisor: Supervisor
    ) -> None:
        self.mesh, self._now, self._supervisor = mesh, now, supervisor
        self.tracker = PlacementTracker(timeline)
        self._fresher: set[str] | None = None
        """Components published since a query that is not answered yet."""
        self._wanted = asyncio.Event()
        self._wanted.set()

    def subscribe(self) -> Declaration:
        handler = self._supervisor.guard(self._on_placements)
        return self.mesh.subscribe(self.mesh.keys.placements, Placements, handler, depth=DEPTH)

    def read_again(self) -> None:
        """Something may have been missed."""
        self._wanted.set()

    async def keep_reading(self) -> None:
        """Asks the placer at the start, and whenever something may have been missed. Does not return."""
        failed = 0
        while True:
            with suppress(TimeoutError):
                async with asyncio.timeout(AGAIN if 0 < failed < TRIES else None):
                    await self._wanted.wait()
                    failed = 0
            self._wanted.clear()
            failed = 0 if await self._read() else failed + 1

    async def _read(self) -> bool:
        self._fresher = fresher = set[str]()
        reply = await self.mesh.ask_one(
            self.mesh.keys.placer, ListPlacements(), Placements, timeout=READ_TIMEOUT
        )
        self._fresher = None
        if reply is None or reply.message is None:
            return False
        self.tracker.listed(self._now(), reply.message, fresher)
        return True

    def _on_placements(self, _key: str, news: Placements) -> None:
        if self._fresher is not None and len(self._fresher) < MAX_FOLLOWED:
            self._fresher.update(one.component for one in news.components)
            self._fresher.update(news.forgotten)
        self.tracker.published(self._now(), news)

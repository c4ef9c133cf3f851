"""Components, as the placer publishes them, as lanes, marks and events: pure; times are the timeline's."""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import dataclass
from typing import Final

from zscout.keyexpr import NAME
from zscout.messages import MAX_PLACED, Placement, Placements, absurd
from zscout.services.recorder.hosts import Running
from zscout.services.recorder.timeline import Timeline
from zscout.types import NO_TERM, Term

log = logging.getLogger(__name__)

MAX_FOLLOWED: Final = 2 * MAX_PLACED


@dataclass(slots=True)
class _Component:
    """A component that is followed: its newest placement, and which start of it ran last, where."""

    placement: Placement
    ran: int = 0
    where: str | None = None


class PlacementTracker:
    """Writes to `timeline` what a placer publishes, in its order."""

    def __init__(self, timeline: Timeline) -> None:
        self.timeline = timeline
        self.term: Term = NO_TERM
        self._components: dict[str, _Component] = {}
        """The one that changed longest ago first."""
        self._cordoned: frozenset[str] = frozenset()

    def published(self, at: float, news: Placements) -> None:
        """What has changed."""
        self._take_in(at, news, forgotten=news.forgotten, fresher=(), seen=True)

    def listed(self, at: float, news: Placements, fresher: Collection[str]) -> None:
        """All there is. `fresher` names what was published since the question, and is known better.

        What was not known before is shown, but did not happen now."""
        there = {placement.component for placement in news.components}
        self._take_in(
            at, news, forgotten=self._components.keys() - there - set(fresher), fresher=fresher, seen=False
        )

    def _take_in(
        self, at: float, news: Placements, *, forgotten: Collection[str], fresher: Collection[str], seen: bool
    ) -> None:
        """`seen`: whether a component that is new here was placed just now."""
        if news.term < self.term or absurd(news.term, self.term):
            return
        self.term = news.term
        touched: set[str] = set()
        for placement in news.components:
            if placement.component not in fresher:
                touched |= self._take(at, placement, news=seen or placement.component in self._components)
        for name in forgotten:
            known = self._components.pop(name, None)
            touched |= _seats(known.placement).keys() if known is not None else set()
        for host in sorted(touched):
            seats = (_seats(known.placement).get(host) for known in self._components.values())
            self.timeline.hosts.runs(at, host, filter(None, seats))
        cordoned, before = frozenset(news.cordoned), self._cordoned
        self._cordoned = cordoned
        for host in sorted(cordoned - before):
            self.timeline.event(at, f"{host} is being emptied: nothing is placed there any more", "WARN")
        for host in sorted(before - cordoned):
            self.timeline.event(at, f"{host} is used again")

    def _take(self, at: float, now: Placement, *, news: bool) -> set[str]:
        """Takes a component in; returns the hosts whose lanes are another."""
        names = (now.component, *(host for host in (now.host, now.to) if host is not None))
        if not all(NAME.fullmatch(name) for name in names):
            log.warning("the placer published a component or host with a bad name: %.200r", names)
            return set()
        known = self._components.pop(now.component, None)
        if known is None and len(self._components) >= MAX_FOLLOWED:
            return set()
        before = known.placement if known is not None else None
        known = known or _Component(now)
        known.placement = now
        self._components[now.component] = known
        self._log_change(at, known, before, news=news)
        if now.state in ("running", "moving") and now.host is not None:
            known.ran, known.where = max(known.ran, now.incarnation), now.host
        return {*_seats(now), *(_seats(before) if before is not None else ())}

    def _log_change(self, at: float, known: _Component, before: Placement | None, *, news: bool) -> None:
        """The event, and the marks, if any."""
        now, name = known.placement, known.placement.component
        event, mark = self.timeline.event, self.timeline.hosts.mark
        why = f": {now.reason}" if now.reason else ""
        if now.state == "running" and now.host is not None and now.incarnation > known.ran:
            if not news:
                event(at, f"{name} ({now.spec.kind}) runs on {now.host} already")
            elif not known.ran or known.where is None:
                mark(at, now.host, "placed", name)
                event(at, f"{name} ({now.spec.kind}) is placed on {now.host}{why}")
            elif before is not None and now.moves > before.moves:
                dead = "" if now.dead is None else f", dead {_duration(now.dead)}"
                mark(at, known.where, "left", name)
                mark(at, now.host, "came", name)
                event(at, f"{name} moved {known.where} -> {now.host}{dead}")
            else:
                was = "" if now.host == known.where else f", it was on {known.where}"
                mark(at, now.host, "restarted", name)
                event(at, f"{name} is restarted on {now.host}{was}{why}", "WARN")
            return
        if before is not None and (before.state, before.reason) == (now.state, now.reason):
            return
        match now.state:
            case "waiting":
                event(at, f"{name} waits for a host{why}", "WARN")
            case "moving":
                event(at, f"{name} moves from {now.host} to {now.to}{why}")
            case "running" if before is not None and before.state == "moving":
                event(at, f"{name} stays on {now.host}{why}", "WARN")
            case "backing_off":
                where = f" on {known.where}" if known.where else ""
                event(at, f"{name} failed{where}, and is tried again{why}", "WARN")
            case "ended":
                event(at, f"{name} ended{why}")
            case "given_up":
                host = known.where or now.host
                if host is not None and news:
                    mark(at, host, "given_up", name)
                event(at, f"{name} is given up{why}", "ERROR")
            case _:
                pass


def _seats(placement: Placement) -> dict[str, Running]:
    """In which hosts' lanes a component stands, and how."""
    name, host, to = placement.component, placement.host, placement.to
    if host is None:
        return {}
    match placement.state:
        case "running":
            return {host: Running(name)}
        case "moving" if to is not None and to != host:
            return {host: Running(name, f"moves to {to}"), to: Running(name, "gets ready", ready=False)}
        case "moving":
            return {host: Running(name, "moves")}
        case "starting" | "stopping":
            return {host: Running(name, placement.state, ready=placement.state == "stopping")}
        case _:
            return {}


def _duration(seconds: float) -> str:
    return f"{seconds * 1000:.0f} ms" if seconds < 1 else f"{seconds:.1f} s"

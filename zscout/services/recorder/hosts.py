"""The hosts' part of the timeline: loads with marks, placements of components, and their use. Times are passed in."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

import rerun as rr

from zscout.keyexpr import NAME
from zscout.messages import MAX_PLACED, ComponentUse, Placement, Placements, absurd
from zscout.services.recorder.colours import LINES, MARKS, STATES
from zscout.services.recorder.drawing import Drawing, Lanes, clean_path, clean_text, with_detail
from zscout.types import NO_TERM, Term

log = logging.getLogger(__name__)

MAX_FOLLOWED: Final = 2 * MAX_PLACED
"""Components followed at one time."""
MAX_HOSTS: Final = 256
MAX_CURVES: Final = 32
"""Components whose use is drawn at one time, the heaviest."""
MAX_DRAWN: Final = 256
"""Components with curves at any time of one recording."""
HEAVIER: Final = 1.5
"""Factor by which a component must be heavier than the lightest with curves to replace it."""
GIGABYTE: Final = 1e9
"""Bytes that count as much as one core."""
SMOOTHING: Final = 0.1
"""Share of the last report in a component's weight."""
SAME_MOMENT: Final = 1.0
"""Marks of one host within so many seconds are stacked."""
MAX_STACK: Final = 10
SEATED: Final = {"starting": "starting", "running": "", "moving": "moves", "stopping": "stopping"}
"""States of a component with a host, and their texts."""
GETS_READY: Final = "gets ready"
"""Text of a component on the host to which it moves."""
SILENCE: Final = 10.0
"""Seconds without a report after which a load curve is interrupted."""

Mark: TypeAlias = Literal["placed", "restarted", "left", "came", "given_up"]


@dataclass(slots=True)
class _Component:
    """A component: its newest placement, with the incarnation and the host that ran last."""

    placement: Placement
    ran: int = 0
    where: str | None = None


@dataclass(slots=True)
class _Host:
    reported: float
    """Time of the last load report."""
    load: float = 0.0


@dataclass(slots=True)
class _Marked:
    at: float
    count: int
    height: float


class HostTracker:
    """Draws hosts and components; `colour` returns the RGBA of a component."""

    def __init__(self, drawing: Drawing, colour: Callable[[str], int]) -> None:
        self._drawing, self._colour = drawing, colour
        self.lanes = Lanes(drawing, "host", MAX_HOSTS, "hosts: components of the others are not shown")
        self.placing = False
        """True once there were components: without any, their panes are left out."""
        self._hosts: dict[str, _Host] = {}
        self._peak = 1.0
        self._marked: dict[str, _Marked] = {}
        self._looks: set[Mark] = set()
        self._curves: dict[tuple[str, str], float] = {}
        """Weight of each component with curves, by host and component."""
        self._drawn: set[tuple[str, str]] = set()
        self._term: Term = NO_TERM
        self._components: dict[str, _Component] = {}
        """Components, the least recently changed first."""
        self._cordoned: frozenset[str] = frozenset()

    def load(self, at: float, host: str, load1: float, cpu: float | None = None) -> None:
        """Load average over 1 minute and, under `/cpu`, CPU use (0 to 1); infinite or NaN values leave a gap."""
        entities = clean_path("load", host), clean_path("cpu", host)
        known = self._hosts.get(host)
        if known is None:
            if not self._drawing.room(at, self._hosts, MAX_HOSTS, "hosts: the load of the others is not drawn"):
                return
            for entity in entities:
                self._drawing.curve(entity, host, LINES[len(self._hosts) % len(LINES)], 2.0)
            known = self._hosts[host] = _Host(at)
        if at - known.reported > SILENCE:
            # The load in between is unknown: interrupt the line.
            for entity in entities:
                self._drawing.erase(known.reported + SILENCE, entity)
        known.reported = at
        for entity, value in zip(entities, (load1, cpu), strict=True):
            if value is not None and math.isfinite(value):
                self._drawing.point(at, entity, value)
        if math.isfinite(load1):
            known.load, self._peak = load1, max(self._peak, load1)

    def mark(self, at: float, host: str, mark: Mark, component: str) -> None:
        entity = f"/mark/{mark}"
        if mark not in self._looks:
            self._looks.add(mark)
            colour, marker = MARKS[mark]
            # Marks with the same name share a line of the legend.
            look = rr.SeriesPoints(names=["components"], colors=[colour], markers=[marker], marker_sizes=[7.0])
            self._drawing.log(None, entity, look)
        stack = self._marked.get(host)
        if stack is None or at - stack.at > SAME_MOMENT:
            if stack is None and len(self._marked) >= MAX_HOSTS:
                return
            known = self._hosts.get(host)
            stack = self._marked[host] = _Marked(at, 0, known.load if known is not None else 0.0)
        height = stack.height + 0.06 * self._peak * min(stack.count, MAX_STACK)
        stack.count += 1
        words = rr.AnyValues(component=clean_text(component), host=clean_text(host))
        self._drawing.log(at, entity, rr.Scalars(height), words)

    def uses(self, at: float, host: str, uses: Iterable[ComponentUse]) -> None:
        """Draw the use of all components of a host; end the curves of others."""
        known = {use.component: use for use in uses}
        for key in [key for key in self._curves if key[0] == host and key[1] not in known]:
            self._end_curve(at, key)
        for use in sorted(known.values(), key=_weight, reverse=True):
            key = host, use.component
            now = _weight(use)
            if key not in self._curves and not self._make_room(at, key, now):
                continue
            weight = self._curves.get(key, now)
            self._curves[key] = weight + SMOOTHING * (now - weight)
            for entity, value in zip(_entities(key), (use.cpu, use.memory / 1e6), strict=True):
                self._drawing.point(at, entity, value)

    def _make_room(self, at: float, key: tuple[str, str], weight: float) -> bool:
        """Return True if a component may have curves from now on."""
        others = "components had curves: the use of the others is not drawn"
        if key not in self._drawn and not self._drawing.room(at, self._drawn, MAX_DRAWN, others):
            return False
        if len(self._curves) >= MAX_CURVES:
            lightest = min(self._curves, key=self._curves.__getitem__)
            if weight < HEAVIER * self._curves[lightest]:
                return False
            self._end_curve(at, lightest)
        if key not in self._drawn:
            self._drawn.add(key)
            host, component = key
            for entity in _entities(key):
                self._drawing.curve(entity, f"{component}, {host}", self._colour(component), 1.5)
        return True

    def _end_curve(self, at: float, key: tuple[str, str]) -> None:
        del self._curves[key]
        for entity in _entities(key):
            self._drawing.erase(at, entity)

    def placements(self, at: float, news: Placements, fresher: set[str] | None = None) -> None:
        """Take changed placements; with `fresher`, the answer to a query for all, except the components published
        since, which `fresher` names. New ones in an answer are shown, but did not happen now."""
        if news.term < self._term or absurd(news.term, self._term):
            return
        self._term = news.term
        forgotten: Collection[str] = news.forgotten
        if fresher is not None:
            forgotten = self._components.keys() - {placement.component for placement in news.components} - fresher
        touched: set[str] = set()
        for placement in news.components:
            if placement.component not in (fresher or ()):
                happened = fresher is None or placement.component in self._components
                touched |= self._take(at, placement, news=happened)
        for name in forgotten:
            known = self._components.pop(name, None)
            touched |= _seats(known.placement).keys() if known is not None else set()
        for host in sorted(touched):
            self._show_lane(at, host)
        before, self._cordoned = self._cordoned, frozenset(news.cordoned)
        for host in sorted(self._cordoned - before):
            self._drawing.warn(at, f"{host} is being emptied: nothing is placed there any more")
        for host in sorted(before - self._cordoned):
            self._drawing.event(at, f"{host} is used again")

    def _show_lane(self, at: float, host: str) -> None:
        self.placing = True
        self._drawing.arrange()
        shown = dict[str, tuple[str, int]]()
        for name, known in self._components.items():
            words = _seats(known.placement).get(host)
            if words is not None:
                ready = words not in ("starting", GETS_READY)
                shown[name] = with_detail(name, words), self._colour(name) if ready else STATES["waiting"]
        self.lanes.show(at, host, shown)

    def _take(self, at: float, now: Placement, *, news: bool) -> set[str]:
        """Return the hosts whose lanes change."""
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
        now, name = known.placement, known.placement.component
        event, warn, mark = self._drawing.event, self._drawing.warn, self.mark
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
                warn(at, f"{name} is restarted on {now.host}{was}{why}")
            return
        if before is not None and (before.state, before.reason) == (now.state, now.reason):
            return
        match now.state:
            case "waiting":
                warn(at, f"{name} waits for a host{why}")
            case "moving":
                event(at, f"{name} moves from {now.host} to {now.to}{why}")
            case "running" if before is not None and before.state == "moving":
                warn(at, f"{name} stays on {now.host}{why}")
            case "backing_off":
                where = f" on {known.where}" if known.where else ""
                warn(at, f"{name} failed{where}, and is tried again{why}")
            case "ended":
                event(at, f"{name} ended{why}")
            case "given_up":
                host = known.where or now.host
                if host is not None and news:
                    mark(at, host, "given_up", name)
                event(at, f"{name} is given up{why}", "ERROR")


def _seats(placement: Placement) -> dict[str, str]:
    """By host: the text of a component in the host's lane, empty while it simply runs."""
    host, to = placement.host, placement.to
    if host is None or placement.state not in SEATED:
        return {}
    if placement.state == "moving" and to is not None and to != host:
        return {host: f"moves to {to}", to: GETS_READY}
    return {host: SEATED[placement.state]}


def _duration(seconds: float) -> str:
    return f"{seconds * 1000:.0f} ms" if seconds < 1 else f"{seconds:.1f} s"


def _weight(use: ComponentUse) -> float:
    return use.cpu + use.memory / GIGABYTE


def _entities(key: tuple[str, str]) -> tuple[str, str]:
    name = "/".join(part.replace("/", "_") for part in key)
    return clean_path("use/cpu", name), clean_path("use/memory", name)

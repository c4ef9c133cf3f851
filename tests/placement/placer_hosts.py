"""Simulated hosts for the placer: they start, stop and move components as real ones do, and fail, are cut
off, freeze, die and come back.
"""

from __future__ import annotations

import heapq
import itertools
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random
from typing import Literal

from zscout.messages import (
    ComponentSpec,
    ComponentView,
    HowEnded,
    Incarnation,
    MoveComponent,
    StartComponent,
    StopComponent,
)
from zscout.placement.events import (
    ComponentsListed,
    HostLost,
    MoveAnswered,
    PlacerEvent,
    StartAnswered,
    StopAnswered,
    TokenAppeared,
    TokenVanished,
)
from zscout.types import SECOND, ComponentId, HostName, Ns

LEASE: Ns = 3 * SECOND
"""Until the mesh sees that a host is gone, at most."""
STANDS_BY: Ns = 10 * SECOND
Phase = Literal["starting", "standby", "running", "ended"]

Say = Callable[[PlacerEvent], None]
"""How a host answers."""


@dataclass
class Proc:
    """One incarnation on its host."""

    component: ComponentId
    incarnation: Incarnation
    spec: ComponentSpec
    phase: Phase = "starting"
    ended: HowEnded | None = None
    token: bool = False
    waiting: list[Callable[[Proc], None]] = field(default_factory=list)
    """Who hears when it is ready or has ended."""

    @property
    def lives(self) -> bool:
        return self.phase != "ended"


@dataclass
class Host:
    name: HostName
    up: bool = True
    cut_off: bool = False
    frozen: bool = False
    """Its node does not move, and what it started does."""
    procs: dict[tuple[ComponentId, Incarnation], Proc] = field(default_factory=dict)
    heard_at: dict[str, Ns] = field(default_factory=dict)
    """When the last news of each of its tokens arrives: they do not overtake each other."""

    @property
    def linked(self) -> bool:
        return self.up and not self.cut_off

    @property
    def there(self) -> bool:
        return self.linked and not self.frozen

    def of(self, component: ComponentId) -> list[Proc]:
        return [one for (name, _), one in self.procs.items() if name == component]


class Hosts(ABC):
    """Virtual time, and what hosts do in it. `loss`: the share of messages that get lost; `failing`: of
    starts that fail; `slow`: how long a message takes at most."""

    def __init__(self, seed: int, hosts: int) -> None:
        self.rng = Random(seed)  # noqa: S311
        self.now: Ns = 0
        self.loss, self.failing, self.slow = 0.1, 0.15, SECOND
        self.hosts = {f"h{number}": Host(f"h{number}") for number in range(hosts)}
        self.queue: list[tuple[Ns, int, Callable[[], None]]] = []
        self._order = itertools.count()

    @abstractmethod
    def send(self, *events: PlacerEvent) -> None:
        """To whoever leads."""

    @abstractmethod
    def seen(self, host: Host) -> None:
        """The mesh sees that its node is there."""

    def later(self, delay: Ns, what: Callable[[], None]) -> None:
        heapq.heappush(self.queue, (self.now + delay, next(self._order), what))

    def delay(self) -> Ns:
        """Mostly short, at times long."""
        return int(self.rng.random() ** 4 * self.slow) + 1

    def lost(self) -> bool:
        return self.rng.random() < self.loss

    # A host: what it does when it is asked

    def on_start(self, host: Host, start: StartComponent, say: Say) -> None:
        component, incarnation = start.component, start.incarnation

        def tell(proc: Proc) -> None:
            if proc.phase == "ended":
                say(StartAnswered(component, incarnation, host.name, "failed", str(proc.ended)))
            else:
                say(StartAnswered(component, incarnation, host.name, "ok", movable=True))

        proc = host.procs.get((component, incarnation))
        if proc is not None and proc.phase != "starting":
            tell(proc)
            return
        if proc is None:
            others = host.of(component)
            if any(one.incarnation > incarnation for one in others):
                say(StartAnswered(component, incarnation, host.name, "refused", "old_incarnation"))
                return
            if any(one.lives for one in others):
                say(StartAnswered(component, incarnation, host.name, "refused", "runs_already"))
                return
            if self.rng.random() < self.failing / 2:
                say(StartAnswered(component, incarnation, host.name, "refused", "too_many"))
                return
            proc = host.procs[component, incarnation] = Proc(component, incarnation, start.spec)
            life = host.procs
            ready, well = self.delay() + SECOND // 5, self.rng.random() >= self.failing
            new = proc
            self.later(ready, lambda: self._ready(host, life, new, standby=start.standby, well=well))
        proc.waiting.append(tell)

    def _ready(
        self, host: Host, life: dict[tuple[ComponentId, Incarnation], Proc], proc: Proc, *, standby: bool, well: bool
    ) -> None:
        if host.procs is not life or proc.phase != "starting":
            return
        if not well:
            self.end(host, proc, "failed")
        elif standby:
            proc.phase = "standby"
            self.later(STANDS_BY, lambda: self.end(host, proc, "stopped") if proc.phase == "standby" else None)
        else:
            self.activate(host, proc)
        for tell in proc.waiting:
            tell(proc)

    def activate(self, host: Host, proc: Proc) -> None:
        """It runs, and says so; what is lower and sees that, ends itself."""
        proc.phase, proc.token = "running", True
        if host.linked:
            self._appear(host, proc)
        self.supersede(proc.component)

    def supersede(self, component: ComponentId) -> None:
        self.later(self.delay(), lambda: self._supersede(component))

    def _supersede(self, component: ComponentId) -> None:
        running = [(host, one) for host in self.hosts.values() for one in host.of(component) if one.token]
        for host, one in running:
            if any(
                other.incarnation > one.incarnation and (there is host or (there.linked and host.linked))
                for there, other in running
            ):
                self.end(host, one, "superseded")

    def on_stop(self, host: Host, stop: StopComponent, say: Say) -> None:
        proc = host.procs.get((stop.component, stop.incarnation or 0))
        done = StopAnswered(stop.component, stop.incarnation or 0, host.name, done=True)
        if proc is None or proc.phase == "ended":
            say(done)
            return
        life, doomed = host.procs, proc

        def over() -> None:
            if host.procs is life:
                self.end(host, doomed, "stopped")
                say(done)

        self.later(self.delay(), over)

    def on_move(self, host: Host, move: MoveComponent, say: Say) -> None:
        """The source comes to a safe point, or not; hands over; and goes, or takes back."""
        source = host.procs.get((move.component, move.incarnation))
        there, life = self.hosts[move.to], host.procs

        def refuse(why: str) -> None:
            say(MoveAnswered(move.component, move.incarnation, host.name, "refused", why))

        if source is None or source.phase != "running":
            refuse("unknown_component")
            return
        old = source

        def safe_point() -> None:
            if host.procs is not life or old.phase != "running":
                return
            target = there.procs.get((move.component, move.to_incarnation))
            if self.rng.random() < self.failing:
                refuse("not_safe")
            elif target is None or target.phase != "standby" or not (there.there and host.there):
                refuse("move_failed")
            else:
                # The commit: from now on the target begins by itself.
                new, new_life = target, there.procs
                self.later(self.delay(), lambda: begin(new, new_life))

        def begin(new: Proc, new_life: dict[tuple[ComponentId, Incarnation], Proc]) -> None:
            begun = there.procs is new_life and new.phase == "standby" and there.there
            if begun:
                self.activate(there, new)
            if host.procs is not life or old.phase != "running":
                return
            if begun and host.there:
                self.end(host, old, "moved")
                say(MoveAnswered(move.component, move.incarnation, host.name, "moved", "", 1e-9))
            else:
                refuse("taken back")

        self.later(self.delay(), safe_point)

    def end(self, host: Host, proc: Proc, how: HowEnded) -> None:
        if proc.phase == "ended":
            return
        proc.phase, proc.ended = "ended", how
        if proc.token:
            proc.token = False
            if host.linked:
                self._vanish(host, proc)

    # Tokens

    def token(self, host: Host, name: str, news: Callable[[], None], delay: Ns | None = None) -> None:
        """News of one token arrive in their order, at whoever leads then."""
        at = max(self.now + (self.delay() if delay is None else delay), host.heard_at.get(name, 0) + 1)
        host.heard_at[name] = at
        self.later(at - self.now, news)

    def _appear(self, host: Host, proc: Proc) -> None:
        event = TokenAppeared(proc.component, proc.incarnation, host.name)
        self.token(host, f"{proc.component} {proc.incarnation}", lambda: self.send(event))

    def _vanish(self, host: Host, proc: Proc, delay: Ns | None = None) -> None:
        event = TokenVanished(proc.component, proc.incarnation, host.name)
        self.token(host, f"{proc.component} {proc.incarnation}", lambda: self.send(event), delay)

    # What befalls hosts

    def go(self, host: Host, how: Literal["dies", "is cut off", "freezes"]) -> None:
        """It dies with all that it has, is cut off from the mesh, or its node moves no more."""
        if not host.there:
            return
        if how != "freezes":
            for proc in host.procs.values():
                if proc.token:
                    self._vanish(host, proc, self.rng.randrange(LEASE))
        self.token(host, "node", lambda: self.send(HostLost(host.name)), self.rng.randrange(LEASE))
        if how == "dies":
            host.up, host.procs = False, {}
        elif how == "freezes":
            host.frozen = True
        else:
            host.cut_off = True

    def come(self, host: Host) -> None:
        if host.there:
            return
        unheard = not host.linked
        host.up, host.cut_off, host.frozen = True, False, False
        self.token(host, "node", lambda: self.seen(host))
        for proc in host.procs.values():
            if proc.token and unheard:
                self._appear(host, proc)
                self.supersede(proc.component)

    def live(self, component: ComponentId) -> list[tuple[Host, Proc]]:
        return [(host, one) for host in self.hosts.values() for one in host.of(component) if one.lives]


def told_of(host: Host, component: ComponentId) -> ComponentsListed:
    return ComponentsListed(host.name, tuple(seen_of(host, one) for one in host.of(component)), component)


def seen_of(host: Host, proc: Proc) -> ComponentView:
    return ComponentView(
        proc.component, proc.incarnation, host.name, proc.spec, proc.phase, movable=True, ended=proc.ended
    )

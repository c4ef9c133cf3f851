"""A small honest world around the placer's core: hosts that start components, fail, are cut off, die and come
back; messages that are late, overtake each other or are lost; tokens that come late; leaders that change.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from random import Random
from typing import Literal

from zscout.balancing.balancer import Balancer
from zscout.balancing.model import SECOND, ComponentId, HostName, Ns, Report
from zscout.balancing.placer import Placer
from zscout.balancing.placing import (
    Appeared,
    Changed,
    Effect,
    Event,
    Forgotten,
    HostLost,
    HostSeen,
    HostTold,
    HowEnded,
    Incarnation,
    Inherited,
    Look,
    Move,
    MoveAnswered,
    Record,
    Refused,
    Seen,
    Spec,
    Start,
    StartAnswered,
    Stop,
    StopAnswered,
    Tick,
    Vanished,
    WakeAt,
)
from zscout.balancing.rules import Rules

RULES = Rules(start_timeout=3 * SECOND, longest_back_off=4 * SECOND, settled=5 * SECOND)
QUERY: Ns = 4 * SECOND
"""A question without an answer by then is `unknown`."""
LEASE: Ns = 3 * SECOND
"""Until the mesh sees that a host is gone, at most."""
STANDS_BY: Ns = 10 * SECOND
REPORT: Ns = 3 * SECOND
Phase = Literal["starting", "standby", "running", "ended"]


@dataclass
class Proc:
    """One incarnation on its host."""

    component: ComponentId
    incarnation: Incarnation
    spec: Spec
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


class World:
    """Virtual time. `loss`: the share of messages that get lost; `failing`: of starts that fail."""

    def __init__(self, seed: int, hosts: int, rules: Rules = RULES) -> None:
        self.rng = Random(seed)  # noqa: S311
        self.rules = rules
        self.now: Ns = 0
        self.loss, self.failing, self.slow = 0.1, 0.15, SECOND
        self.hosts = {f"h{number}": Host(f"h{number}") for number in range(hosts)}
        self.starts: dict[tuple[ComponentId, Incarnation], Start] = {}
        self.published: dict[ComponentId, Record] = {}
        self.refusals: list[Refused] = []
        self.alive: set[HostName] = set()
        """As the leading placer was told."""
        self.counter = 0
        self._queue: list[tuple[Ns, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._reports = itertools.count(1)
        self._wake: Ns | None = None
        self.new_leader()
        self._report()

    # Time

    def later(self, delay: Ns, what: Callable[[], None]) -> None:
        heapq.heappush(self._queue, (self.now + delay, next(self._order), what))

    def delay(self) -> Ns:
        """Mostly short, at times long."""
        return int(self.rng.random() ** 4 * self.slow) + 1

    def run(self, until: Ns) -> None:
        while True:
            at = self._queue[0][0]
            if self._wake is not None and self._wake <= min(at, until):
                self.now, self._wake = max(self.now, self._wake), None
                self.send(Tick())
            elif at <= until:
                self.now, _, what = heapq.heappop(self._queue)
                what()
            else:
                self.now = until
                return

    def _report(self) -> None:
        for host in self.hosts.values():
            if host.there:
                self._report_now(host)
        self.later(REPORT, self._report)

    def _report_now(self, host: Host) -> None:
        load = float(sum(one.lives for one in host.procs.values()))
        self.balancer.reported(
            self.now,
            Report(
                host=host.name,
                number=next(self._reports),
                cores=4.0,
                load_average=(load, load, load),
                cpu=0.5,
                memory_available=10**10,
                memory_total=10**11,
            ),
        )

    # The placer

    def new_leader(self) -> None:
        """Another placer, which knows what was published; what was sent before is still on its way."""
        cordoned = frozenset(self.balancer.cordoned) if self.counter else frozenset()
        self.counter += 1
        self.balancer = Balancer(Random(self.counter))  # noqa: S311
        self.placer = Placer(self.balancer, self.counter, self.rules)
        self.alive, self._wake = set(), None
        self.send(Inherited(tuple(self.published.values()), cordoned))
        for host in self.hosts.values():
            if host.there:
                self._report_now(host)
                self.token(host, "node", partial(self._seen, host))
            if host.linked:
                for proc in host.procs.values():
                    if proc.token:
                        self._appear(host, proc)

    def _seen(self, host: Host) -> None:
        self.send(HostSeen(host.name))
        leader = self.counter
        if host.there and not self.lost():
            told = HostTold(host.name, tuple(_seen(one) for one in host.procs.values()))
            self.later(self.delay(), lambda: self.answer(leader, told))

    def send(self, *events: Event) -> None:
        for event in events:
            if isinstance(event, HostSeen):
                self.alive.add(event.host)
            elif isinstance(event, HostLost):
                self.alive.discard(event.host)
        effects = self.placer.handle(self.now, *events)
        for effect in effects:
            self.carry_out(effect)

    def answer(self, leader: int, event: Event) -> None:
        """Of a question of this leader: nobody hears it if another leads."""
        if leader == self.counter:
            self.send(event)

    def lost(self) -> bool:
        return self.rng.random() < self.loss

    def carry_out(self, effect: Effect) -> None:
        match effect:
            case Changed(component):
                self.published[component] = self.placer.records[component]
            case Forgotten(component):
                del self.published[component]
            case Refused():
                self.refusals.append(effect)
            case WakeAt(at):
                assert at is None or at > self.now, "it would wake at once, for ever"
                self._wake = at
            case Start(component, incarnation, host):
                before = self.starts.setdefault((component, incarnation), effect)
                assert before == effect, f"one incarnation, two starts: {before} and {effect}"
                known = self.published[component].incarnation
                assert effect.standby or known == incarnation, "started before it was published"
                start, unknown = effect, StartAnswered(component, incarnation, host, "unknown")
                self.ask(host, lambda there, say: self._on_start(there, start, say), unknown)
            case Stop(component, incarnation, host):
                stop, silent = effect, StopAnswered(component, incarnation, host, done=False)
                self.ask(host, lambda there, say: self._on_stop(there, stop, say), silent)
            case Move(component, incarnation, host):
                move, open_end = effect, MoveAnswered(component, incarnation, host, "unknown")
                self.ask(host, lambda there, say: self._on_move(there, move, say), open_end)
            case Look(host, component):
                self.ask(host, lambda there, say: say(_told(there, component)), None)

    def ask(self, name: HostName, on_host: Callable[[Host, Say], None], unknown: Event | None) -> None:
        """A query: its answer comes late or not at all, and then its outcome is unknown."""
        assert name in self.alive, f"asked {name}, which is gone"
        host, leader = self.hosts[name], self.counter
        done: list[bool] = []

        def come_back(event: Event) -> None:
            if not done:
                done.append(True)
                self.answer(leader, event)

        def say(event: Event) -> None:
            if host.there and not self.lost():
                self.later(self.delay(), lambda: come_back(event))

        if not self.lost():
            self.later(self.delay(), lambda: on_host(host, say) if host.there else None)
        if unknown is not None:
            self.later(QUERY, lambda: come_back(unknown))

    # A host: what it does when it is asked

    def _on_start(self, host: Host, start: Start, say: Say) -> None:
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
            proc = host.procs[component, incarnation] = Proc(component, incarnation, start.spec)
            life = host.procs
            ready, well = self.delay() + SECOND // 5, self.rng.random() >= self.failing
            new = proc
            self.later(ready, lambda: self._ready(host, life, new, standby=start.standby, well=well))
        proc.waiting.append(tell)

    def _ready(
        self,
        host: Host,
        life: dict[tuple[ComponentId, Incarnation], Proc],
        proc: Proc,
        *,
        standby: bool,
        well: bool,
    ) -> None:
        if host.procs is not life or proc.phase != "starting":
            return
        if not well:
            self.end(host, proc, "failed")
        elif standby:
            proc.phase = "standby"
            self.later(
                STANDS_BY, lambda: self.end(host, proc, "stopped") if proc.phase == "standby" else None
            )
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

    def _on_stop(self, host: Host, stop: Stop, say: Say) -> None:
        proc = host.procs.get((stop.component, stop.incarnation))
        done = StopAnswered(stop.component, stop.incarnation, host.name, done=True)
        if proc is None or proc.phase == "ended":
            say(done)
            return
        life, doomed = host.procs, proc

        def over() -> None:
            if host.procs is life:
                self.end(host, doomed, "stopped")
                say(done)

        self.later(self.delay(), over)

    def _on_move(self, host: Host, move: Move, say: Say) -> None:
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
                say(MoveAnswered(move.component, move.incarnation, host.name, "moved", "", 1))
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
        event = Appeared(proc.component, proc.incarnation, host.name)
        self.token(host, f"{proc.component} {proc.incarnation}", lambda: self.send(event))

    def _vanish(self, host: Host, proc: Proc, delay: Ns | None = None) -> None:
        event = Vanished(proc.component, proc.incarnation, host.name)
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
        self.token(host, "node", lambda: self._seen(host))
        for proc in host.procs.values():
            if proc.token and unheard:
                self._appear(host, proc)
                self.supersede(proc.component)

    def live(self, component: ComponentId) -> list[tuple[Host, Proc]]:
        return [(host, one) for host in self.hosts.values() for one in host.of(component) if one.lives]


Say = Callable[[Event], None]


def _told(host: Host, component: ComponentId) -> HostTold:
    return HostTold(host.name, tuple(_seen(one) for one in host.of(component)), component)


def _seen(proc: Proc) -> Seen:
    return Seen(
        component=proc.component,
        incarnation=proc.incarnation,
        spec=proc.spec,
        running=proc.phase == "running",
        standby=proc.phase == "standby",
        movable=True,
        ended=proc.ended,
    )

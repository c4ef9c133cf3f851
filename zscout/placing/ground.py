"""What the placer knows, and the few ways in which it acts. Decisions are made elsewhere."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Final

from zscout.balancing.balancer import LOAD_TIME, Balancer
from zscout.balancing.model import SECOND, ComponentId, HostName, Kind, Ns, Question, Ranked
from zscout.placing.entry import Entry, Moving
from zscout.placing.events import (
    Changed,
    Effect,
    Forgotten,
    Incarnation,
    Look,
    Move,
    Record,
    Refused,
    Spec,
    Start,
    Stop,
)
from zscout.placing.ranks import Ranks
from zscout.placing.rules import Rules
from zscout.placing.timers import Key, Timers

PER_TERM: Final = 1_000
"""Incarnations of a component begin, in each term, at its counter times this."""
FAR_AHEAD: Final = 1_000_000
"""An incarnation that is so far above what this term gives is nobody's: it would leave no room above it."""
ANSWER: Final[Ns] = 2 * SECOND
"""A host that is asked to look has as long."""
START_SLACK: Final[Ns] = 2 * ANSWER
"""A start that nobody has told of by then, beyond its time, is asked for again."""
STOP_ANSWER: Final[Ns] = 15 * SECOND
"""A host that is told to stop something has as long: more than it may take to end."""
MAX_COMPONENTS: Final = 10_000
MAX_ENDED: Final = 1_000
"""Ended and given-up components that are remembered."""
REMEMBERED: Final[Ns] = 3_600 * SECOND
"""For how long."""
NAMED: Final = 3
"""Hosts that a reason names."""
_Act = Start | Stop | Move | Look | Refused
DRAIN: Final[Key] = ("drain", "")


@dataclass(frozen=True, slots=True)
class Fit:
    """Hosts that will do, best first, and of the others why not."""

    hosts: tuple[Ranked, ...]
    left_out: Mapping[HostName, str]
    other: bool = False
    """Asked for was one beside the host where it is."""

    def why_none(self) -> str:
        """In words, and bounded: why there is no host."""
        named = [f"{host}: {reason}" for host, reason in islice(sorted(self.left_out.items()), NAMED)]
        more = len(self.left_out) - len(named)
        return "; ".join(named) + (f"; and {more} more" if more else "") or self._none

    @property
    def _none(self) -> str:
        return "there is no other that it may use" if self.other else "there is no host"


class Ground:
    """State that all parts of the placer share. `now` is the instant that is handled."""

    def __init__(self, balancer: Balancer, counter: int, rules: Rules) -> None:
        self.balancer, self.rules = balancer, rules
        self.now: Ns = 0
        self.entries: dict[ComponentId, Entry] = {}
        self.alive: set[HostName] = set()
        self.timers = Timers()
        self.records: dict[ComponentId, Record] = {}
        self.to_place: dict[ComponentId, None] = {}
        self.rested: dict[HostName, Ns] = {}
        """Since when nothing came to a host or left it by the placer's doing."""
        self.departed: dict[HostName, deque[tuple[Ns, float]]] = {}
        """What left a host, and how many cores of it the load average showed then."""
        self._floor: Incarnation = counter * PER_TERM
        self._highest = self._floor + FAR_AHEAD
        self._known: dict[ComponentId, Incarnation] = {}
        self._ended: dict[ComponentId, None] = {}
        self._touched: dict[ComponentId, bool] = {}
        self._effects: list[_Act] = []
        self.ranks = Ranks(balancer)

    # One instant

    def begin(self, now: Ns) -> None:
        """Raises ValueError if time goes backwards."""
        if now < self.now:
            raise ValueError(f"time went backwards: {now} after {self.now}")
        self.now = now
        self._touched, self._effects = {}, []
        self.ranks.begin(now)

    def finish(self) -> list[Effect]:
        """What is to be done. What has changed comes first: it is published before it is acted upon, so that
        a placer after this one knows of every start."""
        told: list[Effect] = []
        for component, asked in self._touched.items():
            entry = self.entries.get(component)
            if entry is None:
                if self.records.pop(component, None) is not None:
                    told.append(Forgotten(component))
                continue
            record = entry.record()
            if asked or self.records.get(component) != record:
                self.records[component] = record
                told.append(Changed(component))
        # A host may have been lost in this very instant, after something was to be asked of it.
        return told + [
            effect for effect in self._effects if isinstance(effect, Refused) or effect.host in self.alive
        ]

    def touch(self, component: ComponentId, *, asked: bool = False) -> None:
        """Its record may have changed; `asked`: somebody waits to hear of it in any case."""
        self._touched[component] = asked or self._touched.get(component, False)

    def entry(self, component: ComponentId) -> Entry | None:
        """For a change."""
        found = self.entries.get(component)
        if found is not None:
            self.touch(component)
        return found

    def new_entry(self, component: ComponentId, spec: Spec) -> Entry | None:
        """None: there is no room for it."""
        if len(self.entries) >= MAX_COMPONENTS:
            if not self._ended:
                return None
            self.forget(next(iter(self._ended)))
        self.entries[component] = entry = Entry(component, spec)
        self.touch(component)
        return entry

    def wake(self, entry: Entry, at: Ns | None) -> None:
        self.timers.set(("entry", entry.component), at)

    def pause(self, times: int) -> Ns:
        """Back-off after as many failures before."""
        return min(self.rules.back_off << min(times, 20), self.rules.longest_back_off)

    def refuse(self, about: str, code: str, message: str) -> None:
        self._effects.append(Refused(about, code, message))

    # Incarnations

    def believes(self, incarnation: Incarnation) -> bool:
        return incarnation <= self._highest

    def heard(self, component: ComponentId, incarnation: Incarnation) -> None:
        """An incarnation exists or existed: a new one must be higher."""
        if incarnation > self._known.get(component, self._floor):
            if component not in self._known and len(self._known) >= 2 * MAX_COMPONENTS:
                self._floor = incarnation
            else:
                self._known[component] = incarnation

    def fresh(self, component: ComponentId) -> Incarnation:
        incarnation = max(self._known.get(component, 0), self._floor) + 1
        self.heard(component, incarnation)
        return incarnation

    # Hosts

    def fit(self, spec: Spec, *, but: HostName | None = None, only: HostName | None = None) -> Fit:
        """Where it can run; `but`: somewhere else; `only`: there or nowhere."""
        hosts = spec.hosts if only is None else frozenset({only})
        question = Question(spec.kind, spec.metric, spec.policy, spec.requirements, hosts)
        ranking = self.ranks.of(question)
        found = tuple(one for one in ranking.hosts if one.host in self.alive and one.host != but)
        left_out = dict(ranking.left_out)
        if only is not None and spec.hosts is not None and only not in spec.hosts:
            found, left_out = (), {only: "it is not among the hosts that the component asks for"}
        elif not found:
            left_out |= {one.host: "its node is not there" for one in ranking.hosts if one.host != but}
            asked = self.alive if hosts is None else self.alive & hosts
            left_out |= dict.fromkeys(asked - self.balancer.reports.keys(), "no report of it")
            if but is not None:
                left_out.pop(but, None)
        return Fit(found, left_out, but is not None)

    def came(self, component: ComponentId, kind: Kind, host: HostName) -> None:
        """A component is on its way to a host."""
        self.balancer.placed(self.now, component, kind, host)
        self.ranks.changed(host)
        self.rested[host] = self.now

    def left(self, entry: Entry) -> None:
        """A component is not on its host any more."""
        self.balancer.gone(entry.component)
        self.ranks.changed(entry.host)
        if entry.host is not None and entry.host in self.alive:
            self.rested[entry.host] = self.now
            if entry.since is not None and self.rules.rebalance:
                self._departed(entry, entry.host, entry.since)
        entry.host, entry.since, entry.token, entry.looked = None, None, False, False

    def _departed(self, entry: Entry, host: HostName, since: Ns) -> None:
        last = self.balancer.reports.get(host)
        if last is not None:
            wants = self.balancer.profile(entry.spec.kind).wants(last[1].speed)
            shown = 1 - math.exp(-(self.now - since) / LOAD_TIME)
            self.departed.setdefault(host, deque(maxlen=100)).append((self.now, wants * shown))

    def drain_soon(self, host: HostName | None) -> None:
        """There is something to do on a host, if it is drained."""
        if host in self.balancer.cordoned:
            self.timers.set(DRAIN, self.now)

    # What is done

    def start(self, entry: Entry) -> None:
        """Has the entry's incarnation started, for the first time or again."""
        if entry.host is not None and entry.host in self.alive:
            entry.start_until = self.now + self.rules.start_timeout + START_SLACK
            self.wake(entry, entry.start_until)
            self._effects.append(Start(entry.component, entry.incarnation, entry.host, entry.spec))

    def start_standby(self, entry: Entry, move: Moving) -> None:
        if move.to in self.alive:
            move.start_until = self.now + self.rules.start_timeout + START_SLACK
            self.wake_move(entry, move.start_until)
            self._effects.append(Start(entry.component, move.incarnation, move.to, entry.spec, standby=True))

    def wake_move(self, entry: Entry, at: Ns | None) -> None:
        self.timers.set(("move", entry.component), at)

    def move(self, entry: Entry, move: Moving) -> None:
        if entry.host is not None:
            self._effects.append(
                Move(entry.component, entry.incarnation, entry.host, move.to, move.incarnation)
            )

    def look(self, component: ComponentId, host: HostName | None) -> None:
        if host is not None:
            self._effects.append(Look(host, component))

    def stop(self, component: ComponentId, incarnation: Incarnation, host: HostName) -> None:
        self._effects.append(Stop(component, incarnation, host))

    # Ends

    def ended(self, entry: Entry) -> None:
        """From now on the entry is only remembered."""
        self._ended[entry.component] = None
        self.wake(entry, self.now + REMEMBERED)
        if len(self._ended) > MAX_ENDED:
            self.forget(next(iter(self._ended)))

    def revived(self, entry: Entry) -> None:
        self._ended.pop(entry.component, None)

    def forget(self, component: ComponentId) -> None:
        """Of its incarnations the highest is kept, for all: none is ever used twice."""
        self._ended.pop(component, None)
        if self.entries.pop(component, None) is not None:
            self.touch(component)
        self._floor = max(self._floor, self._known.pop(component, 0))
        self.timers.set(("entry", component), None)

"""Rebalancing: moving the one component that gains most, if that has paid for a while.

What a component would gain is foretold as `composite` does: how fast it runs where it is, and how fast it
would run there. Others count as well: what they lose on the target, less what they gain on the host that it
leaves. The load average forgets what left a host as slowly as it came to see it; that is taken off.

Against going back and forth: a move must make it run better by `gain`, for `steady` at a stretch; component
and hosts have been left alone for `rest`; and one moves at a time. Two equal hosts never swap.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import Final

from zscout.balancing.balancer import LOAD_TIME
from zscout.balancing.metrics import Outlook, rate
from zscout.balancing.model import SECOND, STALE, ComponentId, HostName, Kind, Ns, Profile, Question
from zscout.placing.entry import Entry
from zscout.placing.ground import Ground
from zscout.placing.moving import Mover
from zscout.placing.timers import Key

EVERY: Final[Ns] = SECOND
TARGETS: Final = 8
"""Hosts that are looked at for each kind: the best."""
FORGOTTEN: Final[Ns] = 8 * LOAD_TIME
"""What left so long ago is out of the load average but for a thousandth."""
REBALANCE: Final[Key] = ("rebalance", "")


@dataclass(frozen=True, slots=True)
class _Change:
    """A move that would pay: the component runs better by `gain`, as a share of how it runs now."""

    gain: float
    entry: Entry
    to: HostName


class Rebalance:
    def __init__(self, ground: Ground, mover: Mover) -> None:
        self.ground, self.mover = ground, mover
        self._paying: dict[tuple[ComponentId, HostName], Ns] = {}
        """Since when each move has paid."""

    def run(self) -> None:
        """Looks, and moves one at most."""
        ground = self.ground
        ground.timers.set(REBALANCE, ground.now + EVERY)
        if any(entry.move is not None for entry in ground.entries.values()):
            self._paying.clear()
            return
        found = self._changes()
        before, self._paying = self._paying, {}
        for one in found:
            pair = (one.entry.component, one.to)
            self._paying[pair] = before.get(pair, ground.now)
        ripe = [
            one
            for one in found
            if ground.now - self._paying[one.entry.component, one.to] >= ground.rules.steady
        ]
        if ripe:
            best = max(ripe, key=lambda one: (one.gain, one.entry.component, one.to))
            self._paying.clear()
            ground.touch(best.entry.component)
            self.mover.begin(best.entry, best.to, f"where it runs {best.gain:.0%} better")

    def _changes(self) -> list[_Change]:
        """All moves that would pay now. Of equal components on one host the first by name stands for all."""
        ground = self.ground
        groups: dict[tuple[HostName, Question], Entry] = {}
        running: dict[HostName, list[Kind]] = {}
        for name in sorted(ground.entries):
            entry = ground.entries[name]
            host = entry.host
            if host is None or entry.state != "running":
                continue
            running.setdefault(host, []).append(entry.spec.kind)
            if self._may_leave(entry, host):
                spec = entry.spec
                question = Question(spec.kind, "composite", "pending", spec.requirements, spec.hosts)
                groups.setdefault((host, question), entry)
        outlooks: dict[HostName, Outlook] = {}
        targets: dict[Question, list[HostName]] = {}
        found = []
        for (host, question), entry in groups.items():
            if question not in targets:
                targets[question] = self._targets(question)
            for target in targets[question]:
                if target == host:
                    continue
                for one in (host, target):
                    if one not in outlooks:
                        outlooks[one] = self._outlook(one)
                profile = ground.balancer.profile(entry.spec.kind)
                here, there = _without(outlooks[host], profile), outlooks[target]
                gain = rate(there, profile) / rate(here, profile) - 1
                if gain < ground.rules.gain:
                    continue
                others = len(running[host]) - 1, len(running.get(target, ()))
                if _pays(here, there, profile, others):
                    found.append(_Change(gain, entry, target))
        return found

    def _may_leave(self, entry: Entry, host: HostName) -> bool:
        # That it came lately its host tells: it is not at rest then.
        ground = self.ground
        return (
            entry.movable
            and entry.wanted
            and entry.token
            and entry.retry_at <= ground.now
            and host not in ground.balancer.cordoned
            and self._at_rest(host)
        )

    def _at_rest(self, host: HostName) -> bool:
        ground = self.ground
        last = ground.balancer.reports.get(host)
        if host not in ground.alive or last is None or ground.now - last[0] > STALE:
            return False
        return ground.now - ground.rested.get(host, ground.now) >= ground.rules.rest

    def _targets(self, question: Question) -> list[HostName]:
        ranking = self.ground.ranks.of(question)
        return [one.host for one in ranking.hosts if self._at_rest(one.host)][:TARGETS]

    def _outlook(self, host: HostName) -> Outlook:
        """A host as the balancer sees it, less what left it and shows in its load average still."""
        ground = self.ground
        outlook = ground.balancer.outlook(ground.now, host, pending=True)
        departed = ground.departed.get(host, deque())
        while departed and ground.now - departed[0][0] > FORGOTTEN:
            departed.popleft()
        gone = sum(cores * math.exp(-(ground.now - at) / LOAD_TIME) for at, cores in departed)
        return replace(outlook, load=max(0.0, outlook.load - gone))


def _without(outlook: Outlook, profile: Profile) -> Outlook:
    """The host if the component were not there."""
    load = max(0.0, outlook.load - profile.wants(outlook.report.speed))
    return replace(outlook, load=load, memory=outlook.memory + profile.memory)


def _share(outlook: Outlook, more: float = 0.0) -> float:
    """How fast what runs there runs, and what it would be with so many more cores wanted."""
    report = outlook.report
    return report.speed * min(1.0, report.cores / max(outlook.load + more, 0.01))


def _pays(here: Outlook, there: Outlook, profile: Profile, others: tuple[int, int]) -> bool:
    """Whether all components of both hosts together run better for the move. `here` is without it."""
    wants_here, wants_there = profile.wants(here.report.speed), profile.wants(there.report.speed)
    own = rate(there, profile) - rate(here, profile)
    stay = others[0] * (_share(here) - _share(here, wants_here))
    meet = others[1] * (_share(there, wants_there) - _share(there))
    return own + stay + meet > 0

"""Rebalancing: moves the component with the greatest gain, once it has paid for a while.

The gain is the change in speed predicted by metric `composite`. Losses of others on the target and gains on the old
host count too. The load average forgets a component as slowly as it learned of it; that is subtracted.

Against oscillation: a move must gain `gain` for `steady` at a stretch, component and hosts must have been at rest
for `rest`, and one moves at a time. Two equal hosts never swap."""

from __future__ import annotations

import math
from collections import Counter, deque
from dataclasses import replace
from functools import cache
from typing import Final, TypeAlias

from zscout.placement.balancer import LOAD_TIME
from zscout.placement.migration import Migrations
from zscout.placement.model import STALE, Outlook, Profile, RankQuery, rate
from zscout.placement.state import ComponentRecord, PlacementState, TimerKind
from zscout.types import SECOND, ComponentId, HostName, Ns

EVERY: Final[Ns] = SECOND
TARGETS: Final = 8
FORGOTTEN: Final[Ns] = 8 * LOAD_TIME
"""After this a thousandth of a departed load is still in a host's load average."""


_Move: TypeAlias = tuple[ComponentId, HostName]


class Rebalancer:
    def __init__(self, state: PlacementState, migrations: Migrations) -> None:
        self.state, self.migrations = state, migrations
        self._paying: dict[_Move, Ns] = {}  # since when each move has paid

    def timer(self) -> None:
        state = self.state
        state.timers.set(TimerKind.REBALANCE, "", state.now + EVERY)
        if any(record.migration is not None for record in state.components.values()):
            self._paying.clear()
            return
        found = self._changes()
        self._paying = {move: self._paying.get(move, state.now) for move in found}
        ripe = [(gain, move) for move, gain in found.items() if state.now - self._paying[move] >= state.rules.steady]
        if ripe:
            gain, (component, to) = max(ripe)
            self._paying.clear()
            state.mark_changed(component)
            self.migrations.begin(state.components[component], to, f"where it runs {gain:.0%} better")

    def _changes(self) -> dict[_Move, float]:
        """Moves that pay now, with their relative gains in speed; of equal components on a host the first."""
        state = self.state
        groups: dict[tuple[HostName, RankQuery], ComponentRecord] = {}
        running: Counter[HostName] = Counter()
        for _, record in sorted(state.components.items()):
            host, spec = record.host, record.spec
            if host is None or record.state != "running":
                continue
            running[host] += 1
            if self._may_leave(record, host):
                query = replace(RankQuery.of(spec), metric="composite", policy="pending")
                groups.setdefault((host, query), record)
        outlook, targets = cache(self._outlook), cache(self._targets)
        found = {}
        for (host, query), record in groups.items():
            profile = state.balancer.profile(record.spec.kind)
            for target in targets(query):
                if target == host:
                    continue
                here, there = _without(outlook(host), profile), outlook(target)
                gain = rate(there, profile) / rate(here, profile) - 1
                others = running[host] - 1, running[target]
                if gain >= state.rules.gain and _pays(here, there, profile, others):
                    found[record.component, target] = gain
        return found

    def _may_leave(self, record: ComponentRecord, host: HostName) -> bool:
        # The host of a recent arrival is not at rest.
        state = self.state
        free = record.movable and record.wanted and record.token and record.not_before <= state.now
        return free and host not in state.balancer.cordoned and self._at_rest(host)

    def _at_rest(self, host: HostName) -> bool:
        state = self.state
        last = state.balancer.reports.get(host)
        if host not in state.alive or last is None or state.now - last[0] > STALE:
            return False
        return state.now - state.last_change.get(host, state.now) >= state.rules.rest

    def _targets(self, query: RankQuery) -> list[HostName]:
        return [ranked.host for ranked in self.state.rankings.rank(query).hosts if self._at_rest(ranked.host)][:TARGETS]

    def _outlook(self, host: HostName) -> Outlook:
        """The balancer's view of a host, less departed load that its average still shows."""
        state = self.state
        outlook = state.balancer.outlook(state.now, host, pending=True)
        departed = state.departed.get(host, deque())
        while departed and state.now - departed[0][0] > FORGOTTEN:
            departed.popleft()
        gone = sum(cores * math.exp(-(state.now - at) / LOAD_TIME) for at, cores in departed)
        return replace(outlook, load=max(0.0, outlook.load - gone))


def _without(outlook: Outlook, profile: Profile) -> Outlook:
    load = max(0.0, outlook.load - profile.wants(outlook.report.speed))
    return replace(outlook, load=load, memory=outlook.memory + profile.memory)


def _share(outlook: Outlook, more: float = 0.0) -> float:
    """Speed of the components there, if `more` cores were wanted."""
    report = outlook.report
    return report.speed * min(1.0, report.cores / max(outlook.load + more, 0.01))


def _pays(here: Outlook, there: Outlook, profile: Profile, others: tuple[int, int]) -> bool:
    """Return True if all components of both hosts together gain. `here` is without the component."""
    wants_here, wants_there = profile.wants(here.report.speed), profile.wants(there.report.speed)
    own = rate(there, profile) - rate(here, profile)
    stay = others[0] * (_share(here) - _share(here, wants_here))
    meet = others[1] * (_share(there, wants_there) - _share(there))
    return own + stay + meet > 0

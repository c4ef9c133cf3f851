"""The pure core of the load balancer: reports and placements in, rankings out.

A host is eligible if its report is recent, it is not cordoned, and it meets the requirements. Placements missing from
the reports are *pending*: policies `pending` and `two_choices` add them to the host's load, so that components that
start together spread; the other policies use the reports only.

- `least_loaded`: the best score (the paper; simultaneous starts all pick one host: its Figure 3a).
- `randomized`: the best after noise on each load (the paper's cure). It affects `load_average` and `composite`.
- `two_choices`: the better of two random hosts first (Mitzenmacher, IEEE TPDS 12(10), 2001). Of two equal hosts, the
  one chosen longer ago.
- `pending`: the best score."""

from __future__ import annotations

import heapq
import math
from bisect import insort
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from itertools import takewhile
from random import Random
from typing import Final, TypeAlias

from zscout.messages import ComponentUse, LoadReport, RankedHost
from zscout.placement.model import (
    NO_REPORT,
    SCORES,
    STALE,
    WORDS,
    MetricLearner,
    Outlook,
    Profile,
    Ranking,
    RankQuery,
    Unfit,
)
from zscout.types import SECOND, ComponentId, HostName, Kind, Metric, Ns

LOAD_TIME: Final = 60 * SECOND
"""Time constant of the one-minute load average, in ns."""
NOISE: Final = 0.25
"""Greatest noise of policy `randomized`, in load per core."""
COUNTING: Final = frozenset({"two_choices", "pending"})
"""Policies that count pending placements."""
CLOSE: Final = 0.05
"""Absolute or relative difference of scores that are equal to policy `two_choices`."""
SETTLED: Final = 3 * SECOND
"""Run time in ns before a component's figures count."""
SHOWN: Final = 8 * LOAD_TIME
"""After this run time the load average shows a component to a thousandth."""
MAX_HOSTS: Final = 10_000
MAX_KINDS: Final = 10_000
MAX_PLACED: Final = 100_000
LARGEST: Final = 2**63
"""Limit of load and bytes of memory in a report."""
SMALLEST: Final = 0.001
"""Least cores in a report."""

_Found: TypeAlias = tuple[float, HostName]
"""A host's negated score: best first, equals by name."""


@dataclass(slots=True)
class _Placed:
    """A component placed here, or found in a report: then without scores."""

    kind: Kind
    host: HostName
    at: Ns
    scores: Mapping[Metric, float]
    seen: bool = False
    learnt: bool = False


class Balancer:
    """Everything known of hosts, kinds and placements. `rng` is for noise and lots."""

    def __init__(self, rng: Random) -> None:
        self._rng = rng
        self.reports: dict[HostName, tuple[Ns, LoadReport]] = {}
        self._outlooks: dict[HostName, Outlook] = {}  # from the reports alone
        self.profiles: dict[Kind, Profile] = {}
        self.cordoned: set[HostName] = set()
        self.learner = MetricLearner()
        self._placed: dict[ComponentId, _Placed] = {}
        self._there: dict[HostName, set[ComponentId]] = {}  # the same by host: a lost host takes many
        self._pending: dict[HostName, dict[ComponentId, _Placed]] = {}
        self._chosen: dict[HostName, int] = {}
        self._choices = 0

    def reported(self, now: Ns, report: LoadReport) -> None:
        """Record a load report unless it is out of order. Raises ValueError for impossible figures."""
        load, memory = report.load_average[0], report.memory_available
        if not (0 <= load <= LARGEST and 0 <= memory <= LARGEST and report.cores >= SMALLEST):
            figures = f"load_average {load}, memory_available {memory} and cores {report.cores}"
            raise ValueError(f"{figures} are impossible")
        last = self.reports.get(report.host)
        if last is not None and report.number <= last[1].number and now - last[0] < STALE:
            return
        if last is None and not self._room(now):
            return
        self.reports.pop(report.host, None)
        self.reports[report.host] = (now, report)
        self._outlooks[report.host] = Outlook(report, load, memory)
        for use in report.components:
            self._add_sample(now, report, use)

    def lost(self, host: HostName) -> None:
        self.reports.pop(host, None)
        self._outlooks.pop(host, None)
        self._pending.pop(host, None)
        self._chosen.pop(host, None)
        for component in self._there.pop(host, ()):
            del self._placed[component]

    def placed(self, now: Ns, component: ComponentId, kind: Kind, host: HostName) -> None:
        """Count a component that starts on a host; it leaves its earlier host."""
        self.gone(component)
        if len(self._placed) >= MAX_PLACED:
            return
        scores: dict[Metric, float] = {}
        if host in self.reports:
            outlook = self.outlook(now, host, pending=True)
            scores = {metric: score([outlook], self.profile(kind))[0] for metric, score in SCORES.items()}
            self._choices += 1
            self._chosen[host] = self._choices
        self._placed[component] = placement = _Placed(kind, host, now, scores)
        self._there.setdefault(host, set()).add(component)
        self._pending.setdefault(host, {})[component] = placement

    def gone(self, component: ComponentId) -> None:
        placement = self._placed.pop(component, None)
        if placement is not None:
            there = self._there[placement.host]
            there.discard(component)
            if not there:
                del self._there[placement.host]
            self._remove_pending(component, placement.host)

    def _remove_pending(self, component: ComponentId, host: HostName) -> None:
        waiting = self._pending.get(host, {})
        waiting.pop(component, None)
        if not waiting:
            self._pending.pop(host, None)

    def _room(self, now: Ns) -> bool:
        if len(self.reports) >= MAX_HOSTS:
            for host in [host for host, (at, _) in self.reports.items() if now - at > STALE]:
                self.lost(host)
        return len(self.reports) < MAX_HOSTS

    def _add_sample(self, now: Ns, report: LoadReport, use: ComponentUse) -> None:
        placement = self._placed.get(use.component)
        if placement is None and len(self._placed) < MAX_PLACED:
            # From an earlier balancer: learn its profile; the load average includes it.
            placement = _Placed(use.kind, report.host, now, {})
            self._placed[use.component] = placement
            self._there.setdefault(report.host, set()).add(use.component)
        if placement is None or placement.host != report.host:
            return
        placement.seen = True
        if now - placement.at >= SHOWN:
            self._remove_pending(use.component, placement.host)
        if now - placement.at < SETTLED:
            return
        if len(self.profiles) < MAX_KINDS or placement.kind in self.profiles:
            self.profiles[placement.kind] = self.profile(placement.kind).learn(use, report.speed)
        if not placement.learnt and use.served is not None and placement.scores:
            placement.learnt = True
            self.learner.seen.append((placement.scores, use.served * report.speed))

    def profile(self, kind: Kind) -> Profile:
        return self.profiles.get(kind) or Profile()

    def heaviest_first(self, components: Iterable[tuple[ComponentId, Kind]]) -> list[ComponentId]:
        """The order in which to place components together: the heavy ones while there is most room."""
        profiles = ((self.profile(kind), component) for component, kind in components)
        return [name for _, _, name in sorted((-profile.cpu, -profile.memory, name) for profile, name in profiles)]

    def outlook(self, now: Ns, host: HostName, *, pending: bool) -> Outlook:
        """A host as reported, with pending components if `pending`. Raises KeyError."""
        outlook = self._outlooks[host]
        if pending and host in self._pending:
            report, load, memory = outlook.report, outlook.load, outlook.memory
            for placement in self._pending[host].values():
                profile = self.profile(placement.kind)
                # The load average includes a component gradually.
                load += profile.wants(report.speed) * math.exp(-(now - placement.at) / LOAD_TIME)
                memory -= 0 if placement.seen else profile.memory
            return Outlook(report, load, memory)
        return outlook

    def rank(self, now: Ns, query: RankQuery, at_most: int | None = None) -> Ranking:
        """Hosts best first; the first `at_most` are listed."""
        metric, why = query.metric, "as asked"
        if metric == "auto":
            metric, why = self.learner.choose(self._rng)
        fit, left_out = self._fit(now, query)
        if query.policy == "randomized":
            fit = {
                host: replace(outlook, load=outlook.load + self._rng.random() * NOISE * outlook.report.cores)
                for host, outlook in sorted(fit.items())
            }
        profile = self.profile(query.kind)
        found = [(-score, host) for score, host in zip(SCORES[metric](list(fit.values()), profile), fit, strict=True)]
        named = len(found) if at_most is None else at_most
        if query.policy == "two_choices":
            best_first = self._two_choices(found)[:named]
        else:
            best_first = heapq.nsmallest(named, found)
        hosts = tuple(RankedHost(host, -value, WORDS[metric](fit[host], profile)) for value, host in best_first)
        return Ranking(hosts, metric, why, left_out, more=len(found) - len(best_first))

    def _two_choices(self, found: list[_Found]) -> list[_Found]:
        """The better of two drawn hosts, then the other, then the rest."""
        best_first = sorted(found)
        if len(best_first) > 1:
            drawn = self._rng.sample(best_first, 2)
            first = self._better(*drawn)
            best_first.sort(key=lambda candidate: (candidate is not first, candidate not in drawn))
        return best_first

    def _better(self, first: _Found, other: _Found) -> _Found:
        if math.isclose(first[0], other[0], rel_tol=CLOSE, abs_tol=CLOSE):
            return min(first, other, key=lambda found: self._chosen.get(found[1], 0))
        return min(first, other)

    def _fit(self, now: Ns, query: RankQuery) -> tuple[dict[HostName, Outlook], dict[HostName, Unfit]]:
        pending = query.policy in COUNTING
        doubtful: Iterable[HostName]
        if query.hosts is not None or self.cordoned or query.labels or query.memory:
            fit: dict[HostName, Outlook] = {}
            doubtful = self.reports if query.hosts is None else query.hosts
        else:
            # Examine only hosts that may differ from their reports.
            fit = self._outlooks.copy()
            overdue = takewhile(lambda host: now - self.reports[host][0] > STALE, self.reports)
            doubtful = {*overdue, *(self._pending.keys() & fit.keys() if pending else ())}
        left_out: dict[HostName, Unfit] = {}
        for host in sorted(doubtful):
            reason = self._unfit(now, host, query)
            if reason is None:
                fit[host] = self.outlook(now, host, pending=pending)
            else:
                left_out[host] = reason
                fit.pop(host, None)
        return fit, left_out

    def _unfit(self, now: Ns, host: HostName, query: RankQuery) -> Unfit | None:
        if host not in self.reports:
            return NO_REPORT
        at, report = self.reports[host]
        if now - at > STALE:
            return Unfit(f"its last report is {(now - at) / SECOND:.1f} s old", "stale")
        if host in self.cordoned:
            return Unfit("it is cordoned")
        missing = sorted(query.labels.difference(report.labels))
        if missing:
            return Unfit(f"it has no label {', '.join(missing)}")
        if query.memory:
            available = max(0, self.outlook(now, host, pending=query.policy in COUNTING).memory)
            if available < query.memory:
                return Unfit(f"{available:,} bytes available, {query.memory:,} required", "memory")
        return None


class RankingCache:
    """Rankings of one instant. A thousand hosts take milliseconds; only hosts changed since are ranked again."""

    def __init__(self, balancer: Balancer) -> None:
        self._balancer = balancer
        self._now: Ns = 0
        self._cached: dict[RankQuery, tuple[Ranking, set[HostName]]] = {}  # with the hosts changed since

    def begin(self, now: Ns) -> None:
        self._now, self._cached = now, {}

    def invalidate(self, host: HostName) -> None:
        for _, changed in self._cached.values():
            changed.add(host)

    def rank(self, query: RankQuery) -> Ranking:
        if query.metric == "auto" or query.policy in ("randomized", "two_choices"):
            # These draw lots on every call.
            return self._balancer.rank(self._now, query)
        ranking, changed = self._cached.get(query, (None, set[HostName]()))
        if ranking is None:
            ranking = self._balancer.rank(self._now, query)
        elif changed:
            ranking = self._updated(query, ranking, changed)
        else:
            return ranking
        self._cached[query] = ranking, set()
        return ranking

    def _updated(self, query: RankQuery, old: Ranking, changed: set[HostName]) -> Ranking:
        some = frozenset(changed if query.hosts is None else changed & query.hosts)
        new = self._balancer.rank(self._now, replace(query, hosts=some))
        hosts = [ranked for ranked in old.hosts if ranked.host not in some]
        for ranked in new.hosts:
            insort(hosts, ranked, key=lambda entry: (-entry.score, entry.host))
        left_out = {host: why for host, why in old.left_out.items() if host not in some}
        return replace(old, hosts=tuple(hosts), left_out=left_out | dict(new.left_out))

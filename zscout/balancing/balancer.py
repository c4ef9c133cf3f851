"""The pure core of the load balancer: reports and placements in, rankings out.

A host is named only if it has reported lately, is not cordoned, and meets the requirements. What was placed
and is not in the reports yet is *pending*: policies `pending` and `two_choices` add it to the host's load, so
that components that start at the same moment spread; the other policies see the reports only.

- `least_loaded`: the best score (the paper; all on one host when all start at once: its Figure 3a).
- `randomized`: the best after a little noise on each load (the cure that the paper proposes).
  It moves the metrics that look at the load: `load_average` and `composite`.
- `two_choices`: the better of two hosts drawn at random (Mitzenmacher, IEEE TPDS 12(10), 2001), first. Of two
  that can't be told apart, the one that was chosen longer ago.
- `pending`: the best score.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from random import Random
from typing import Final

from zscout.balancing.learning import Learner, Observation
from zscout.balancing.metrics import SCORES, Outlook
from zscout.balancing.model import (
    DEFAULT_PROFILE,
    SECOND,
    STALE,
    ComponentId,
    HostName,
    Kind,
    Metric,
    Ns,
    Profile,
    Question,
    Ranked,
    Ranking,
    Report,
    Use,
)

LOAD_TIME: Final = 60 * SECOND
"""Time constant of the one-minute load average, in ns."""
NOISE: Final = 0.25
"""Greatest noise of policy `randomized`, in load a core."""
COUNTING: Final = frozenset({"two_choices", "pending"})
"""Policies that count what was placed and is not in the reports yet."""
CLOSE: Final = 0.05
"""Scores that differ by less, or by less of the greater, are equal to policy `two_choices`."""
SETTLED: Final = 3 * SECOND
"""A component's figures count for its kind's profile and for `auto` once it has run as long, in ns."""
LEAST_SERVED: Final = 0.05
"""A smaller share tells nothing of what a component wants."""
LEARN: Final = 0.2
"""Weight of the latest figure in a profile."""
SHOWN: Final = 8 * LOAD_TIME
"""A component that has run as long is in the load average but for a thousandth of it."""
MAX_HOSTS: Final = 10_000
MAX_KINDS: Final = 10_000
MAX_PLACED: Final = 100_000


@dataclass(slots=True)
class _Placed:
    """A component that this balancer's placer started, or that a report told of (`adopted`)."""

    kind: Kind
    host: HostName
    at: Ns
    scores: Mapping[Metric, float]
    seen: bool = False
    learnt: bool = False
    adopted: bool = False


class Balancer:
    """Everything that is known of hosts, kinds and placements. `rng` serves noise and lots."""

    def __init__(self, rng: Random) -> None:
        self._rng = rng
        self.reports: dict[HostName, tuple[Ns, Report]] = {}
        self.profiles: dict[Kind, Profile] = {}
        self.cordoned: set[HostName] = set()
        self.learner = Learner()
        self._placed: dict[ComponentId, _Placed] = {}
        self._pending: dict[HostName, dict[ComponentId, _Placed]] = {}
        self._chosen: dict[HostName, int] = {}
        self._choices = 0

    # What happens

    def reported(self, now: Ns, report: Report) -> None:
        """A load report came. One with an older number than the last is dropped."""
        last = self.reports.get(report.host)
        if last is not None and report.number <= last[1].number and now - last[0] < STALE:
            return
        if last is None and not self._room(now):
            return
        self.reports[report.host] = (now, report)
        for use in report.uses:
            self._saw(now, report, use)

    def lost(self, host: HostName) -> None:
        """A host is gone, and what ran there."""
        self.reports.pop(host, None)
        self._pending.pop(host, None)
        self._chosen.pop(host, None)
        for component in [name for name, one in self._placed.items() if one.host == host]:
            del self._placed[component]

    def placed(self, now: Ns, component: ComponentId, kind: Kind, host: HostName) -> None:
        """A component was told to start on a host; it leaves the host that it was on."""
        self.gone(component)
        if len(self._placed) >= MAX_PLACED:
            return
        scores: dict[Metric, float] = {}
        if host in self.reports:
            outlook = self.outlook(now, host, pending=True)
            scores = {metric: score(outlook, self.profile(kind))[0] for metric, score in SCORES.items()}
            self._choices += 1
            self._chosen[host] = self._choices
        self._placed[component] = one = _Placed(kind, host, now, scores)
        self._pending.setdefault(host, {})[component] = one

    def gone(self, component: ComponentId) -> None:
        """A component ended, or did not start."""
        one = self._placed.pop(component, None)
        if one is not None:
            self._let_go(component, one.host)

    def _let_go(self, component: ComponentId, host: HostName) -> None:
        waiting = self._pending.get(host, {})
        waiting.pop(component, None)
        if not waiting:
            self._pending.pop(host, None)

    def _room(self, now: Ns) -> bool:
        """Room for a host more: where there is none, silent ones make it."""
        if len(self.reports) >= MAX_HOSTS:
            for host in [host for host in self.reports if self._silent(now, host)]:
                self.lost(host)
        return len(self.reports) < MAX_HOSTS

    def _saw(self, now: Ns, report: Report, use: Use) -> None:
        one = self._placed.get(use.component)
        if one is None and len(self._placed) < MAX_PLACED:
            # Of a balancer before this one: its profile is learnt, and the load average shows it already.
            one = _Placed(use.kind, report.host, now, {}, adopted=True)
            self._placed[use.component] = one
        if one is None or one.host != report.host:
            return
        one.seen = True
        if now - one.at >= SHOWN:
            self._let_go(use.component, one.host)
        if now - one.at < SETTLED:
            return
        if len(self.profiles) < MAX_KINDS or one.kind in self.profiles:
            self.profiles[one.kind] = _learnt(self.profiles.get(one.kind), use, report.speed)
        if not one.learnt and use.served is not None and one.scores:
            one.learnt = True
            self.learner.saw(Observation(one.scores, use.served * report.speed))

    # What is asked

    def profile(self, kind: Kind) -> Profile:
        return self.profiles.get(kind, DEFAULT_PROFILE)

    def heaviest_first(self, asked: Iterable[tuple[ComponentId, Kind]]) -> list[ComponentId]:
        """The order in which to place what is asked for at once: what is heavy while there is most room."""

        def weight(one: tuple[ComponentId, Kind]) -> tuple[float, int, ComponentId]:
            profile = self.profile(one[1])
            return -profile.cpu, -profile.memory, one[0]

        return [component for component, _ in sorted(asked, key=weight)]

    def outlook(self, now: Ns, host: HostName, *, pending: bool) -> Outlook:
        """A host as its report tells, with what is pending there if that counts. Raises KeyError."""
        _, report = self.reports[host]
        load, memory = report.load_average[0], report.memory_available
        if pending:
            for one in self._pending.get(host, {}).values():
                profile = self.profile(one.kind)
                # The load average shows a component the better the longer it runs.
                load += profile.wants(report.speed) * math.exp(-(now - one.at) / LOAD_TIME)
                memory -= 0 if one.seen else profile.memory
        return Outlook(report, load, memory)

    def rank(self, now: Ns, question: Question) -> Ranking:
        """Hosts best first, by the metric and under the policy that were asked for."""
        fit, left_out = self._fit(now, question)
        metric, why = question.metric, "as asked"
        if metric == "auto":
            metric, why = self.learner.choose(self._rng)
        profile, score = self.profile(question.kind), SCORES[metric]
        found: list[Ranked] = []
        for host in fit:
            outlook = self.outlook(now, host, pending=question.policy in COUNTING)
            if question.policy == "randomized":
                noise = self._rng.random() * NOISE * outlook.report.cores
                outlook = replace(outlook, load=outlook.load + noise)
            value, words = score(outlook, profile)
            found.append(Ranked(host, value, words))
        best_first = sorted(found, key=lambda one: (-one.score, one.host))
        if question.policy == "two_choices" and len(best_first) > 1:
            drawn = self._rng.sample(best_first, 2)
            first = self._better(*drawn)
            best_first.sort(key=lambda one: (one is not first, one not in drawn))
        return Ranking(tuple(best_first), metric, why, left_out)

    def _better(self, one: Ranked, other: Ranked) -> Ranked:
        if math.isclose(one.score, other.score, rel_tol=CLOSE, abs_tol=CLOSE):
            return min(one, other, key=lambda host: self._chosen.get(host.host, 0))
        return max(one, other, key=lambda host: host.score)

    def _fit(self, now: Ns, question: Question) -> tuple[list[HostName], dict[HostName, str]]:
        asked = question.hosts if question.hosts is not None else self.reports.keys()
        checks: list[Callable[[HostName], str]] = [
            lambda host: self._silent(now, host),
            lambda host: "it is cordoned" if host in self.cordoned else "",
            lambda host: self._lacks(now, host, question),
        ]
        left_out: dict[HostName, str] = {}
        fit = []
        for host in sorted(asked):
            reason = next(filter(None, (check(host) for check in checks)), "")
            if reason:
                left_out[host] = reason
            else:
                fit.append(host)
        return fit, left_out

    def _silent(self, now: Ns, host: HostName) -> str:
        last = self.reports.get(host)
        if last is None:
            return "no report of it"
        age = now - last[0]
        return f"its last report is {age / SECOND:.1f} s old" if age > STALE else ""

    def _lacks(self, now: Ns, host: HostName, question: Question) -> str:
        _, report = self.reports[host]
        missing = sorted(question.requirements.labels - report.labels)
        if missing:
            return f"it has no label {', '.join(missing)}"
        required = question.requirements.memory
        if required:
            available = max(0, self.outlook(now, host, pending=question.policy in COUNTING).memory)
            if available < required:
                return f"{available:,} bytes available, {required:,} required"
        return ""


def _learnt(known: Profile | None, use: Use, speed: float) -> Profile:
    """A profile with one figure more; memory is the most that was seen, forgotten slowly."""
    # What it wanted, not what a busy host gave it.
    wanted = use.cpu / max(use.served, LEAST_SERVED) if use.served is not None else use.cpu
    threads = max(1, math.ceil(round(wanted, 1)))
    if known is None:
        return Profile(wanted * speed, use.memory, 1, threads)
    return Profile(
        cpu=known.cpu + LEARN * (wanted * speed - known.cpu),
        memory=max(use.memory, round(known.memory + LEARN / 10 * (use.memory - known.memory))),
        samples=known.samples + 1,
        threads=max(known.threads, threads),
    )

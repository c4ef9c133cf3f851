"""The figures of one node, and their meaning: plain numbers, counted at events and read on request.

`exposition.py` writes them in Prometheus' format; a test compares docs/reference/metrics.md. Labels have a bounded
number of values: further ones count as `other`."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping, Sequence
from itertools import accumulate
from typing import Final, Literal, NamedTuple, TypeAlias

from zscout.config.access import AccessPolicy
from zscout.mesh.exchange import OTHER
from zscout.scheduling.model import ArcRequest, Outcome
from zscout.services.rcm.digest import Began, Over
from zscout.types import SECOND, ArcId, Ns, RcName

MAX_WAITERS: Final = 100  # pairs of a priority and a group
MAX_RCS: Final = 1_000
MAX_WAIT: Final[Ns] = 90 * 86_400 * SECOND
"""Limit of a counted wait: a wait under an earlier RCM is only reported by its client."""
WAITS: Final = (0.01, 0.1, 1.0, 5.0, 15.0, 60.0, 300.0, 900.0, 3_600.0, 14_400.0, 86_400.0)
"""Bounds of the buckets, in seconds."""
ERRORS: Final = (-3_600.0, -900.0, -300.0, -60.0, -15.0, -1.0, 0.0, 1.0, 15.0, 60.0, 300.0, 900.0, 3_600.0)


class MetricFamily(NamedTuple):
    """A node shows only the metrics that apply to it."""

    kind: Literal["gauge", "counter", "histogram"]
    labels: tuple[str, ...]
    help: str


FAMILIES: Final[Mapping[str, MetricFamily]] = {
    "zscout_info": MetricFamily("gauge", ("fleet", "host", "version"), "Always 1; its labels say which node this is."),
    "zscout_links": MetricFamily("gauge", (), "Peers that this node is linked to."),
    "zscout_leading": MetricFamily("gauge", (), "1 while this node leads, else 0."),
    "zscout_term": MetricFamily("gauge", (), "Number of the highest term that this node has seen."),
    "zscout_terms_led_total": MetricFamily("counter", (), "Times that this node took the lead."),
    "zscout_queue_length": MetricFamily("gauge", (), "ARCs that wait."),
    "zscout_wait_seconds": MetricFamily(
        "histogram", ("priority", "group"), "From queueing of an ARC to its grant, without holds that continued."
    ),
    "zscout_forecast_error_seconds": MetricFamily(
        "histogram", (), "Start of a hold minus the first forecast sent to its client."
    ),
    "zscout_preemptions_total": MetricFamily(
        "counter", ("priority", "group"), "Holds preempted for another ARC, by the preempted ARC."
    ),
    "zscout_holds": MetricFamily("gauge", ("rc",), "Holders that the RC has."),
    "zscout_held_seconds_total": MetricFamily(
        "counter", ("rc",), "Time for which the RC was held, summed over its holders."
    ),
    "zscout_refusals_total": MetricFamily("counter", ("code",), "Requests and releases that the RCM refused, by code."),
    "zscout_unwell_seconds": MetricFamily(
        "gauge", ("rc",), "For how long the RC has been unwell; 0 while it is well, and once it is lost."
    ),
    "zscout_lost": MetricFamily("gauge", ("rc",), "1 while the RC counts as lost, else 0."),
    "zscout_commands_total": MetricFamily("counter", ("rc",), "Commands that the RC has answered."),
    "zscout_commands_refused_total": MetricFamily("counter", ("rc", "code"), "Commands that the RC refused, by code."),
}


class Distribution(NamedTuple):
    bounds: tuple[float, ...]
    counts: tuple[int, ...]  # up to each bound, and in all
    sum: float


Value: TypeAlias = float | Distribution
Samples: TypeAlias = dict[str, dict[tuple[str, ...], Value]]  # by metric and values of its labels


class Histogram:
    def __init__(self, bounds: tuple[float, ...]) -> None:
        self._bounds, self._sum = bounds, 0.0
        self._counts = [0] * (len(bounds) + 1)

    def add(self, value: float) -> None:
        self._counts[bisect_left(self._bounds, value)] += 1
        self._sum += value

    def read(self) -> Distribution:
        return Distribution(self._bounds, tuple(accumulate(self._counts)), self._sum)


class Labels:
    def __init__(self, most: int) -> None:
        self._most = most
        self._known: set[tuple[str, ...]] = set()

    def of(self, *values: str) -> tuple[str, ...]:
        if values not in self._known:
            if len(self._known) >= self._most:
                return (OTHER,) * len(values)
            self._known.add(values)
        return values


class HoldFigures:
    """Waits and holds counted by this node's RCMs. A HoldListener."""

    def __init__(self, access: AccessPolicy) -> None:
        self.take(access)
        self._waiters, self._rcs = Labels(MAX_WAITERS), Labels(MAX_RCS)
        self._waits: dict[tuple[str, ...], Histogram] = {}
        self._errors = Histogram(ERRORS)
        self._preemptions: dict[tuple[str, ...], int] = {}
        self._held: dict[tuple[str, ...], Ns] = {}  # of ended holds
        self._holds: dict[ArcId, Began] = {}

    def take(self, access: AccessPolicy) -> None:
        """Replace the groups. A name in several groups counts for the first."""
        self._groups: dict[str, str] = {}
        for group, members in access.groups.items():
            for member in members:
                self._groups.setdefault(member, group)

    def on_began(self, began: Began) -> None:
        self._holds[began.request.arc] = began
        if began.waited is not None:
            who = self._who(began)
            if who not in self._waits:
                self._waits[who] = Histogram(WAITS)
            self._waits[who].add(min(began.waited, MAX_WAIT) / SECOND)
        if began.late is not None:
            self._errors.add(began.late / SECOND)

    def on_over(self, over: Over) -> None:
        self._holds.pop(over.began.request.arc, None)
        self._add(over.began.rcs, over.at - over.began.at, self._held)
        if over.outcome is Outcome.PREEMPTED:
            who = self._who(over.began)
            self._preemptions[who] = self._preemptions.get(who, 0) + 1

    def on_unwell(self, rc: RcName, why: str, holders: Sequence[ArcRequest]) -> None:
        """Ignored: the RC's own node shows it."""

    def _who(self, began: Began) -> tuple[str, ...]:
        owner = began.request.client.partition("/")[0]
        return self._waiters.of(str(began.request.priority), self._groups.get(owner, ""))

    def _add(self, rcs: Sequence[RcName], amount: int, to: dict[tuple[str, ...], int]) -> None:
        for rc in rcs:
            label = self._rcs.of(rc)
            to[label] = to.get(label, 0) + amount

    def samples(self, now: Ns, *, leading: bool) -> Samples:
        held, holds = dict(self._held), dict.fromkeys(self._held, 0)
        for began in self._holds.values():
            self._add(began.rcs, now - began.at, held)
            self._add(began.rcs, 1, holds)
        found: Samples = {
            "zscout_wait_seconds": {who: histogram.read() for who, histogram in self._waits.items()},
            "zscout_forecast_error_seconds": {(): self._errors.read()},
            "zscout_preemptions_total": dict(self._preemptions),
            "zscout_held_seconds_total": {rc: amount / SECOND for rc, amount in held.items()},
        }
        if leading:
            found["zscout_holds"] = dict(holds)
        return found

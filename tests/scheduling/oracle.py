"""Strategy `priority` a second time: slow, obvious, and written from the design's text alone.

Votes are answered at once, nothing is remembered between visits, and every set is built anew. Whatever the
real core does faster has to come out as this does.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import product

from zscout.config.scheduling_policy import FairShares
from zscout.keyexpr import is_pattern, matcher
from zscout.scheduling.capacity import excess
from zscout.scheduling.fair_shares import NEAR_RATIO, NEAR_RC_SECONDS
from zscout.scheduling.model import QUANTUM, ArcRequest, Outcome
from zscout.simulation.replay import HoldRecord, Replay
from zscout.simulation.workload import Arrival, Workload, WorkloadRc
from zscout.types import SECOND, Ns, Params, RcName

OPERATOR = 10


@dataclass
class SlowShares:
    """Fair shares a second time: who holds and who waits is gone through whole, and so is time."""

    policy: FairShares
    operator_priority: int = 10
    now: Ns = 0

    def __post_init__(self) -> None:
        self.charged: dict[str, float] = {}

    def group(self, request: ArcRequest) -> str:
        owner = request.client.partition("/")[0]
        return self.policy.groups.get(owner, owner)

    def pass_time(
        self,
        now: Ns,
        holds: Iterable[tuple[ArcRequest, Iterable[RcName]]],
        waiting: Iterable[ArcRequest],
        present: set[RcName],
    ) -> None:
        """From the last time on until now these were held, and these waited."""
        half_life, passed, waiting = self.policy.half_life / SECOND, (now - self.now) / SECOND, list(waiting)
        left = 0.5 ** (passed / half_life)
        self.charged = {group: had * left for group, had in self.charged.items()}
        for request, rcs in holds:
            group = self.group(request)
            count = 0
            for rc in rcs if request.priority < self.operator_priority else ():
                count += any(
                    self.group(other) != group
                    and other.priority >= request.priority
                    and all(need in present for need in other.needs if not is_pattern(need))
                    and any(matcher(need)(rc) if is_pattern(need) else need == rc for need in other.needs)
                    for other in waiting
                )
            # Of a constant stream into what halves in each half-life.
            self.charged[group] = self.charged.get(group, 0.0) + count * (1 - left) * half_life / 0.6931471805599453
        self.now = now

    def positions(self, groups: Iterable[str]) -> dict[str, int]:
        """The order of these groups."""
        shares = sorted((self.charged.get(one, 0.0) / self.policy.weights.get(one, 1.0), one) for one in groups)
        found: dict[str, int] = {}
        position, first = 0, shares[0][0] if shares else 0.0
        for share, group in shares:
            if share - first > NEAR_RC_SECONDS and share - first > NEAR_RATIO * share:
                position, first = position + 1, share
            found[group] = position
        return found


@dataclass(eq=False)
class Contender:
    """An ARC that was asked for; `start` is None while it waits."""

    request: ArcRequest
    place: int
    start: Ns | None = None
    position: int = 0
    """Of its group, when it last waited."""
    needs: Mapping[str, Params] = field(default_factory=dict)
    """What it holds; while it waits, what was tried last."""
    protected_from: Ns | None = None
    """From then on only operators end it before its minimum runtime is over; None: no such rule."""

    def __post_init__(self) -> None:
        self.needs = self.needs or self.request.needs

    @property
    def rank(self) -> tuple[int, int, Ns, int]:
        return (-self.request.priority, self.position, self.request.min_runtime, self.place)

    def end(self) -> Ns:
        """When its minimum runtime is over; only of a running one."""
        assert self.start is not None
        return self.start + self.request.min_runtime

    def past_min_runtime(self, now: Ns) -> bool:
        return self.request.keep and now >= self.end()


class Oracle:
    """All contenders, and the holds that are over."""

    def __init__(self, rcs: Iterable[WorkloadRc], fair: FairShares | None = None) -> None:
        self.shares = None if fair is None else SlowShares(fair)
        self.groups: dict[str, int] = {}
        """Those that wait, and their positions."""
        self.next_look: Ns = 0
        self.rcs: dict[RcName, WorkloadRc] = {rc.name: rc for rc in rcs}
        self.contenders: list[Contender] = []
        self.holds: list[HoldRecord] = []
        self.arrivals = 0

    def instant(self, now: Ns, asked: list[ArcRequest]) -> None:
        """First what ends, then what was asked, then one pass."""
        if self.shares is not None:
            holds = [(one.request, one.needs) for one in self.running()]
            waiting = [one.request for one in self.contenders if one.start is None]
            self.shares.pass_time(now, holds, waiting, {*self.rcs})
        for one in self.running():
            if not one.request.keep and one.end() <= now:
                self.finish(one, now)
        for request in asked:
            self.arrivals += 1
            self.contenders.append(Contender(request, self.arrivals))
            if self.shares is not None and len(asked) == 1 and self.is_free(request):
                self.contenders[-1].start = now  # it never waits
                return
            self.note_waiting(now)
        self.look(now)
        self.run_pass(now)

    def is_free(self, request: ArcRequest) -> bool:
        """Whether nobody else waits, and all that it needs, which is exclusive, is free."""
        free = self.rcs.keys() - {rc for one in self.running() for rc in one.request.needs}
        return len(self.contenders) == len(self.running()) + 1 and request.needs.keys() <= free

    def note_waiting(self, now: Ns) -> None:
        """A group that begins to wait is the first until the next look, which is due."""
        if self.shares is not None:
            waiting = {self.shares.group(one.request) for one in self.contenders if one.start is None}
            if waiting - self.groups.keys():
                self.next_look = now
            self.groups = {group: self.groups.get(group, 0) for group in waiting}
            self.put()

    def look(self, now: Ns) -> None:
        """Puts the groups in order, once a quantum."""
        if self.shares is not None and self.groups and now >= self.next_look:
            self.next_look = now + QUANTUM
            self.groups = self.shares.positions(self.groups)
            self.put()

    def put(self) -> None:
        for one in self.contenders:
            if self.shares is not None and one.start is None:
                operator = one.request.priority >= self.shares.operator_priority
                one.position = 0 if operator else self.groups[self.shares.group(one.request)]

    def running(self) -> list[Contender]:
        return [one for one in self.contenders if one.start is not None]

    def finish(self, one: Contender, now: Ns) -> None:
        self.close(one, now, Outcome.COMPLETED)
        self.contenders.remove(one)

    def close(self, one: Contender, now: Ns, outcome: Outcome) -> None:
        assert one.start is not None
        rcs = tuple(sorted(one.needs))
        self.holds.append(HoldRecord(one.request.arc, one.start, now, outcome, rcs))
        one.start = None

    def run_pass(self, now: Ns) -> None:
        visited: list[Contender] = []
        while True:
            queued = [one for one in self.contenders if one.start is None and one not in visited]
            if not queued:
                return
            first = min(queued, key=lambda one: one.rank)
            visited.append(first)
            self.visit(first, now)

    def visit(self, a: Contender, now: Ns) -> None:
        choice = self.choose(a, now)
        if choice is None:
            return
        victims, a.needs = choice
        for victim in victims:
            if victim.past_min_runtime(now):
                self.finish(victim, now)
            else:
                self.close(victim, now, Outcome.PREEMPTED)
                self.note_waiting(now)
        a.start = now
        self.note_waiting(now)

    def choose(self, a: Contender, now: Ns) -> tuple[list[Contender], Mapping[str, Params]] | None:
        """Whom it would preempt, and what it would hold, by the best of all choices; None when it has to wait."""
        choices = []
        for needs in bindings(a.request, self.rcs):
            a.needs = needs
            if (victims := self.victims(a, now)) is not None:
                choices.append((victims, needs))
        return max(choices, key=lambda choice: self.worth(choice[0], now), default=None)

    def worth(self, victims: list[Contender], now: Ns) -> tuple[int, int, list[tuple[int, int, Ns, int]]]:
        """Of two choices the one with fewer preemptions, then with fewer that end, then with lower ranks among them."""
        preempted = sum(not one.past_min_runtime(now) for one in victims)
        return -preempted, -len(victims), sorted(one.rank for one in victims)

    def victims(self, a: Contender, now: Ns) -> list[Contender] | None:
        """Whom `a` would preempt; None when it has to wait (steps 1 to 3)."""
        if any(name not in self.rcs for name in a.needs):
            return None
        exclusive = {name for name in a.needs if not self.rcs[name].sharable}
        sharable = {name for name in a.needs if self.rcs[name].sharable}
        running = self.running()

        def may_displace(other: Contender) -> bool:
            if other.past_min_runtime(now):
                return a.request.priority >= other.request.priority
            if other.protected_from is not None and other.protected_from <= now and a.request.priority < OPERATOR:
                return False
            return a.request.priority > other.request.priority

        blockers = [one for one in running if exclusive & set(one.needs)]
        if not all(may_displace(one) for one in blockers):
            return None
        candidates = [one for one in running if one not in blockers and sharable & set(one.needs) and may_displace(one)]
        stay = [one for one in running if one not in blockers and one not in candidates]
        if not self.accepted(sharable, [*stay, a]):
            return None
        kept: list[Contender] = []
        for candidate in sorted(candidates, key=lambda one: one.rank):
            if self.accepted(sharable, [*stay, a, *kept, candidate]):
                kept.append(candidate)
        return blockers + [one for one in candidates if one not in kept]

    def accepted(self, sharable: set[RcName], together: list[Contender]) -> bool:
        """Whether each of these RCs would carry those of `together` that need it."""
        return all(
            not excess(
                self.rcs[name].capacity, [(one.request.arc, one.needs[name]) for one in together if name in one.needs]
            )
            for name in sharable
        )


def bindings(request: ArcRequest, rcs: Iterable[RcName]) -> Iterator[dict[str, Params]]:
    """All ways to meet the needs of a request, by trying."""
    names = list(rcs)
    choices = [[rc for rc in names if matcher(need)(rc)] if is_pattern(need) else [need] for need in request.needs]
    for chosen in product(*choices):
        if len(set(chosen)) == len(chosen):
            yield dict(zip(chosen, request.needs.values(), strict=True))


def best_by_rank(asked: Iterable[ArcRequest], free: Iterable[RcName]) -> list[ArcRequest]:
    """Those of one instant who start on exclusive RCs: in rank order, everyone with whom all before can have places of
    their own, by trying all. None of those who run can be made to end."""
    order = sorted(enumerate(asked), key=lambda item: (-item[1].priority, item[1].min_runtime, item[0]))
    found: list[ArcRequest] = []
    for _, request in order:
        if have_places([need for one in (*found, request) for need in one.needs], list(free)):
            found.append(request)
    return found


def have_places(needs: list[str], free: list[RcName]) -> bool:
    """Whether each need can have an RC of its own; named ones first, as nothing else will do for these."""
    named = [need for need in needs if not is_pattern(need)]
    if len(set(named)) < len(named) or not set(named) <= set(free):
        return False
    left = [rc for rc in free if rc not in named]
    return _fit([need for need in needs if is_pattern(need)], left)


def _fit(patterns: list[str], free: list[RcName]) -> bool:
    if not patterns:
        return True
    fits = matcher(patterns[0])
    return any(fits(rc) and _fit(patterns[1:], [other for other in free if other != rc]) for rc in free)


def play(workload: Workload, *, one_by_one: bool = False, fair: FairShares | None = None) -> Replay:
    """Plays a workload to its end.

    `one_by_one` runs a pass after each single arrival, where otherwise all of one instant share one. A kept
    hold ends when nothing else is left to come, but not before its minimum runtime is over."""
    oracle = Oracle(workload.rcs, fair)
    # `sorted` is stable: what asks at one instant asks in the order of the workload.
    arrivals: list[Arrival] = sorted(workload.arrivals, key=lambda arrival: arrival.at)
    now: Ns = 0
    while arrivals or oracle.running():
        running = oracle.running()
        # A kept hold's minimum runtime is an event too: from then on equal priority may displace it.
        times = [one.end() for one in running if not one.past_min_runtime(now)]
        times += [arrival.at for arrival in arrivals[:1]]
        if times and oracle.shares is not None and oracle.groups:
            times.append(oracle.next_look if oracle.next_look > now else now + QUANTUM)
        if times:
            now = min(times)
        else:
            for one in running:
                oracle.finish(one, now)
        asked = [arrival.request for arrival in arrivals if arrival.at == now]
        arrivals = arrivals[len(asked) :]
        if one_by_one and asked:
            for request in asked:
                oracle.instant(now, [request])
        else:
            oracle.instant(now, asked)
    served = {hold.arc for hold in oracle.holds if hold.outcome is Outcome.COMPLETED}
    unserved = {arrival.request.arc for arrival in workload.arrivals} - served
    holds = sorted(oracle.holds, key=lambda hold: (hold.start, hold.arc, hold.end))
    return Replay(tuple(holds), tuple(sorted(unserved)))

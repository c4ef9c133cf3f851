"""The placer's state and the operations on it; `lifecycle`, `migration`, `rebalancing` and `reconciler` decide."""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Final, Literal, TypeAlias

from zscout import messages
from zscout.config.fleet import PlacementPolicy
from zscout.messages import LAST_TERMS, ComponentSpec, ComponentState, HowEnded, Incarnation, Placement, RankedHost
from zscout.placement.balancer import LOAD_TIME, MAX_HOSTS, Balancer, RankingCache
from zscout.placement.events import ComponentChanged, HostCommand, PlacementRefused, PlacerEffect
from zscout.placement.model import NO_REPORT, RankQuery, Unfit
from zscout.types import SECOND, ComponentId, HostName, Kind, Ns

PER_TERM: Final = 1_000
"""The first incarnation of a term is its counter times this."""
FAR_AHEAD: Final = 1_000_000
"""An incarnation this far above the term's is believed, unless of one of the last terms (`LAST_TERMS`): its host
refuses lower ones for good, so the next must exceed it, and the last terms may leave no room."""
PROBE_TIMEOUT: Final[Ns] = 2 * SECOND
START_SLACK: Final[Ns] = 2 * PROBE_TIMEOUT
"""Beyond the start timeout: then the start is repeated."""
STOP_TIMEOUT: Final[Ns] = 15 * SECOND
"""More than a component may take to end."""
MAX_COMPONENTS: Final = 10_000
MAX_ENDED: Final = 1_000
"""Each is kept for RETENTION."""
RETENTION: Final[Ns] = 3_600 * SECOND
MAX_ENDED_INCARNATIONS: Final = 16
HOSTS_NAMED: Final = 3

TRANSITIONS: Final[Mapping[ComponentState, frozenset[ComponentState]]] = {
    "waiting": frozenset({"starting", "running", "backing_off", "stopping", "ended", "given_up"}),
    "starting": frozenset({"waiting", "running", "backing_off", "stopping", "ended", "given_up"}),
    "running": frozenset({"waiting", "moving", "backing_off", "stopping", "ended", "given_up"}),
    "moving": frozenset({"running"}),
    "backing_off": frozenset({"waiting", "starting", "running", "stopping", "ended", "given_up"}),
    "stopping": frozenset({"waiting", "ended"}),
    "ended": frozenset({"waiting"}),
    "given_up": frozenset({"waiting", "ended"}),
}
OVER: Final[frozenset[ComponentState]] = frozenset({"ended", "given_up"})

GONE: Final = Unfit("its node is not there")
NOT_NAMED: Final = Unfit("it is not among the hosts that the component asks for")


@dataclass(frozen=True, slots=True)
class NoHost:
    """Why no host is eligible, in one bounded line; equal where only figures differ."""

    text: str = field(default="", compare=False)
    causes: tuple[tuple[HostName, str], ...] = ()
    count: int = 0

    def __str__(self) -> str:
        return self.text


SideState: TypeAlias = Literal["unknown", "running", "standby", "ended"]


@dataclass(frozen=True, slots=True)
class Termination:
    """`lost`: cause unknown. `with_host`: its host ended; not its failure. `bad_params`: it would fail again."""

    cause: HowEnded | Literal["lost"]
    reason: str
    tail: str = ""
    with_host: bool = False
    bad_params: bool = False


def host_gone(host: HostName | None) -> Termination:
    return Termination("lost", f"the node of {host} is gone", with_host=True)


@dataclass(slots=True)
class Migration:
    """The target starts (`starting`), the source hands over (`handing_over`), or both are asked (`probing`)."""

    to: HostName
    incarnation: Incarnation
    why: str
    stage: Literal["starting", "handing_over", "probing"] = "starting"
    start_until: Ns | None = None
    tries: int = 0
    source: SideState = "running"
    target: SideState = "unknown"
    token: bool = False  # the target has its token: it has taken over
    termination: Termination | None = None  # of the source, if it ended while the outcome was unknown


@dataclass(slots=True)
class ComponentRecord:
    """`host` is where its incarnation is or starts; None: nowhere."""

    component: ComponentId
    spec: ComponentSpec
    state: ComponentState = "waiting"  # changed by `enter` alone
    incarnation: Incarnation = 0
    asked_at: Ns = 0
    asked_as: Incarnation = 0  # its incarnation at `asked_at`: while unchanged, it was never started
    superseded: bool = False  # the incarnation is of an earlier component of this name, and must not live
    host: HostName | None = None
    wanted: bool = True
    reason: str = ""
    host_reason: str = ""  # the reason while it runs
    drain_reason: str = ""  # why it is still on a drained host; shown in place of `reason`
    restart_cause: str = ""
    tail: str = ""
    movable: bool = False
    restarts: int = 0
    failed_rounds: int = 0  # rounds in which all hosts failed
    moves: int = 0
    dead: float | None = None  # dead time of its last move, in seconds
    running_since: Ns | None = None
    start_until: Ns | None = None  # while a start is unanswered; then it counts as lost
    unanswered: int = 0  # unanswered attempts in a row of the present command or probe
    token: bool = False
    confirmed: bool = False  # its host reported that it runs, and whether it is movable
    probed: bool = False
    no_host: tuple[NoHost, str] | None = None
    """Why it has no host, and the reason given for that: changed figures alone are not published."""
    tried: dict[HostName, str] = field(default_factory=dict)
    """Hosts that did not start it in this round, with the reason if another try there would not help."""
    whereabouts_unknown: bool = False  # it reported a move, and no host has reported it yet
    migration: Migration | None = None  # present exactly while `moving`
    not_before: Ns = 0  # until then it is neither moved off a drained host nor, if inherited, placed
    ended_incarnations: deque[Incarnation] = field(default_factory=lambda: deque(maxlen=MAX_ENDED_INCARNATIONS))

    def enter(self, state: ComponentState) -> None:
        if state not in TRANSITIONS[self.state] and state != self.state:
            raise ValueError(f"{self.component} can't go from {self.state} to {state}")
        self.state = state

    def status(self) -> Placement:
        return Placement(
            component=self.component,
            spec=self.spec,
            state=self.state,
            incarnation=self.incarnation,
            host=self.host,
            to=self.migration.to if self.migration is not None else None,
            reason=self.drain_reason or self.reason,
            movable=self.movable,
            wanted=self.wanted,
            restarts=self.restarts,
            moves=self.moves,
            dead=self.dead,
            tail=self.tail,
        )


class TimerKind(IntEnum):
    """In the order of handling within an instant."""

    DRAIN = 0
    LIFECYCLE = 1
    PROBES = 2
    MIGRATION = 3
    REBALANCE = 4
    SURPLUS = 5


TimerKey: TypeAlias = tuple[TimerKind, str]
"""With the name of a component or host; empty for a single timer."""


class Timers:
    SLACK: Final = 64
    """Outdated heap entries allowed beyond the number of valid ones."""

    def __init__(self) -> None:
        self._at: dict[TimerKey, Ns] = {}
        self._heap: list[tuple[Ns, TimerKey]] = []

    def set(self, kind: TimerKind, name: str, at: Ns | None) -> None:
        """None removes it."""
        key = kind, name
        if at is None:
            self._at.pop(key, None)
        elif self._at.get(key) != at:
            self._at[key] = at
            heapq.heappush(self._heap, (at, key))
            if len(self._heap) > 2 * len(self._at) + self.SLACK:
                self._heap = [(when, timer) for timer, when in self._at.items()]
                heapq.heapify(self._heap)

    def pop_due(self, now: Ns) -> list[TimerKey]:
        found = []
        while self._heap and self._heap[0][0] <= now:
            at, key = heapq.heappop(self._heap)
            if self._at.get(key) == at:
                del self._at[key]
                found.append(key)
        return found

    def next(self) -> Ns | None:
        while self._heap and self._at.get(self._heap[0][1]) != self._heap[0][0]:
            heapq.heappop(self._heap)
        return self._heap[0][0] if self._heap else None


class PlacementState:
    """`now` is the instant that is handled."""

    def __init__(self, balancer: Balancer, counter: int, rules: PlacementPolicy) -> None:
        self.balancer, self.rules = balancer, rules
        self.rankings = RankingCache(balancer)
        self.now: Ns = 0
        self.components: dict[ComponentId, ComponentRecord] = {}
        self.published: dict[ComponentId, Placement] = {}
        self.to_place: dict[ComponentId, None] = {}  # placed at the end of this instant
        self.alive: set[HostName] = set()  # hosts whose node has its token
        self.kinds: dict[HostName, tuple[Ns, frozenset[Kind]]] = {}
        """Kinds that hosts can start, and when they listed them; kept for lost hosts, which may return."""
        self.last_change: dict[HostName, Ns] = {}  # when the placer last added or removed a component
        self.departed: dict[HostName, deque[tuple[Ns, float]]] = {}
        """Departures from a host: when, and the cores that the load average showed then."""
        self.timers = Timers()
        self._lowest: Incarnation = counter * PER_TERM
        self._highest = max(LAST_TERMS * PER_TERM, self._lowest + FAR_AHEAD)
        self._incarnations: dict[ComponentId, Incarnation] = {}  # the highest of each component
        self._ended: dict[ComponentId, None] = {}  # oldest first
        self._changed: dict[ComponentId, bool] = {}
        self._commands: list[HostCommand | PlacementRefused] = []

    def begin(self, now: Ns) -> None:
        if now < self.now:
            raise ValueError(f"time went backwards: {now} after {self.now}")
        self.now = now
        self._changed, self._commands = {}, []
        self.rankings.begin(now)

    def finish(self) -> list[PlacerEffect]:
        """The effects of this instant, changes first: so the next placer knows of every start."""
        effects: list[PlacerEffect] = []
        for component, always in self._changed.items():
            record = self.components.get(component)
            if record is None:
                if self.published.pop(component, None) is not None:
                    effects.append(ComponentChanged(component, None))
                continue
            status = record.status()
            if always or self.published.get(component) != status:
                self.published[component] = status
                effects.append(ComponentChanged(component, status))
        # A host may be lost in this instant, after a command to it.
        return effects + [
            command for command in self._commands if isinstance(command, PlacementRefused) or command.host in self.alive
        ]

    def mark_changed(self, component: ComponentId, *, always: bool = False) -> None:
        """Publish its status if it differs, or `always`: a request waits for it."""
        self._changed[component] = always or self._changed.get(component, False)

    def get(self, component: ComponentId) -> ComponentRecord | None:
        record = self.components.get(component)
        if record is not None:
            self.mark_changed(component)
        return record

    def known(self, component: ComponentId) -> ComponentRecord | None:
        """Like `get`, but refuse the request if it does not exist."""
        if component not in self.components:
            self.refuse(component, "unknown_component", f"unknown component {component}; see zscout component list")
        return self.get(component)

    def add(self, record: ComponentRecord) -> bool:
        """False: no room."""
        if len(self.components) >= MAX_COMPONENTS:
            if not self._ended:
                return False
            self.forget(next(iter(self._ended)))
        self.components[record.component] = record
        self.mark_changed(record.component)
        return True

    def retire(self, record: ComponentRecord) -> None:
        self._ended[record.component] = None
        self.wake(record, self.now + RETENTION)
        if len(self._ended) > MAX_ENDED:
            self.forget(next(iter(self._ended)))

    def revive(self, record: ComponentRecord) -> None:
        self._ended.pop(record.component, None)

    def forget(self, component: ComponentId) -> None:
        """Its highest incarnation becomes the minimum for all, so none is used twice."""
        self._ended.pop(component, None)
        if self.components.pop(component, None) is not None:
            self.mark_changed(component)
        self._lowest = max(self._lowest, self._incarnations.pop(component, 0))
        self.timers.set(TimerKind.LIFECYCLE, component, None)

    def note_incarnation(self, component: ComponentId, incarnation: Incarnation) -> bool:
        """Remember this incarnation, so that the next is higher. Return False, and ignore it, if it is impossible."""
        if incarnation > self._highest:
            return False
        if incarnation > self._incarnations.get(component, self._lowest):
            if component not in self._incarnations and len(self._incarnations) >= 2 * MAX_COMPONENTS:
                self._lowest = incarnation
            else:
                self._incarnations[component] = incarnation
        return True

    def next_incarnation(self, component: ComponentId) -> Incarnation:
        incarnation = max(self._incarnations.get(component, 0), self._lowest) + 1
        self.note_incarnation(component, incarnation)
        return incarnation

    def eligible_hosts(
        self, spec: ComponentSpec, *, other_than: HostName | None = None, only: HostName | None = None
    ) -> tuple[Sequence[RankedHost], NoHost]:
        """Eligible hosts, best first; if none, why."""
        query = RankQuery.of(spec)
        if only is not None:
            query = replace(query, hosts=frozenset({only}))
        ranking = self.rankings.rank(query)
        lacking = {host for host in self.alive if self.lacks(host, spec.kind)} if self.kinds else set()
        usable = self.alive - lacking if lacking else self.alive
        found = tuple(ranked for ranked in ranking.hosts if ranked.host in usable and ranked.host != other_than)
        left_out = dict(ranking.left_out)
        if only is not None and spec.hosts is not None and only not in spec.hosts:
            left_out = {only: NOT_NAMED}
        elif found:
            return found, NoHost()
        else:
            left_out |= {ranked.host: GONE for ranked in ranking.hosts if ranked.host not in (other_than, *lacking)}
            known = self.alive if query.hosts is None else self.alive & query.hosts
            left_out |= dict.fromkeys(known - self.balancer.reports.keys(), NO_REPORT)
            left_out |= dict.fromkeys(known & lacking, Unfit(f"it has no kind {spec.kind}"))
            if other_than is not None:
                left_out.pop(other_than, None)
        first = heapq.nsmallest(HOSTS_NAMED, left_out.items())
        named = [f"{host}: {why}" for host, why in first]
        if len(left_out) > HOSTS_NAMED:
            named.append(f"and {len(left_out) - HOSTS_NAMED} more")
        none = "there is no host" if other_than is None else "there is no other that it may use"
        causes = tuple((host, why.cause) for host, why in first)
        return (), NoHost("; ".join(named) or none, causes, len(left_out))

    def set_kinds(self, host: HostName, kinds: frozenset[Kind]) -> None:
        self.kinds.pop(host, None)
        self.kinds[host] = self.now, kinds
        if len(self.kinds) > MAX_HOSTS:
            del self.kinds[next(iter(self.kinds))]

    def lacks(self, host: HostName, kind: Kind) -> bool:
        """Return True if a host has listed its kinds without `kind`."""
        listed = self.kinds.get(host)
        return listed is not None and kind not in listed[1]

    def lacking_everywhere(self, spec: ComponentSpec) -> set[HostName]:
        """The live hosts that lack only its kind, if no known host has it."""
        known = self.alive | self.kinds.keys() if spec.hosts is None else set(spec.hosts)
        return known & self.alive if all(self.lacks(host, spec.kind) for host in known) else set()

    def component_arrives(self, component: ComponentId, kind: Kind, host: HostName) -> None:
        self.balancer.placed(self.now, component, kind, host)
        self.rankings.invalidate(host)
        self.last_change[host] = self.now

    def component_left(self, record: ComponentRecord) -> None:
        host = record.host
        self.balancer.gone(record.component)
        if host is not None:
            self.rankings.invalidate(host)
        if host is not None and host in self.alive:
            self.last_change[host] = self.now
            last = self.balancer.reports.get(host)
            if record.running_since is not None and self.rules.rebalance and last is not None:
                wants = self.balancer.profile(record.spec.kind).wants(last[1].speed)
                shown = 1 - math.exp(-(self.now - record.running_since) / LOAD_TIME)
                self.departed.setdefault(host, deque(maxlen=100)).append((self.now, wants * shown))
        record.host, record.running_since, record.token, record.probed = None, None, False, False

    def wake(self, record: ComponentRecord, at: Ns | None) -> None:
        self.timers.set(TimerKind.LIFECYCLE, record.component, at)

    def wake_migration(self, record: ComponentRecord, at: Ns | None) -> None:
        self.timers.set(TimerKind.MIGRATION, record.component, at)

    def drain_soon(self, host: HostName | None) -> None:
        if host in self.balancer.cordoned:
            self.timers.set(TimerKind.DRAIN, "", self.now)

    def back_off_time(self, failures: int) -> Ns:
        return min(self.rules.back_off << min(failures, 20), self.rules.longest_back_off)

    def start(self, record: ComponentRecord, move: Migration | None = None) -> None:
        """Command the start of the record's incarnation or of a move's standby, the first time or again."""
        side, host, timer = (record, record.host, self.wake) if move is None else (move, move.to, self.wake_migration)
        if host is not None and host in self.alive:
            side.start_until = self.now + self.rules.start_timeout + START_SLACK
            timer(record, side.start_until)
            start = messages.StartComponent(record.component, side.incarnation, record.spec, standby=move is not None)
            self._commands.append(HostCommand(host, start))

    def hand_over(self, record: ComponentRecord, move: Migration) -> None:
        if record.host is not None:
            order = messages.MoveComponent(record.component, record.incarnation, move.to, move.incarnation)
            self._commands.append(HostCommand(record.host, order))

    def stop(self, component: ComponentId, incarnation: Incarnation, host: HostName) -> None:
        self._commands.append(HostCommand(host, messages.StopComponent(component, incarnation)))

    def probe(self, component: ComponentId, host: HostName | None) -> None:
        if host is not None:
            self._commands.append(HostCommand(host, messages.ListComponents(component)))

    def refuse(self, subject: str, code: str, message: str) -> None:
        self._commands.append(PlacementRefused(subject, code, message))

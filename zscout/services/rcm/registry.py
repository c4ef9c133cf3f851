"""The state of each request of one term: its name and history, and the notices that its client gets.

Every change that is not the answer to an operation is published on the client's key; requests that ended are remembered
for a while. What happened to each ARC is kept as text, for `zscout why`, and written to the log."""

from __future__ import annotations

import logging
from collections import OrderedDict, deque
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any

from msgspec.structs import replace

from zscout import trace
from zscout.keyexpr import BadName, client_of, is_pattern
from zscout.mesh import Mesh
from zscout.mesh.supervision import Supervisor
from zscout.messages import Notice, Problem, ReasonInfo, ReasonParty, State, StoryLine
from zscout.rcm.places import Places, client_id, request_id
from zscout.scheduling.core import Core
from zscout.scheduling.forecast import forecast
from zscout.scheduling.model import ArcStatus, Dropped, Effect, Granted, HoldEnded, Outcome, Queued
from zscout.scheduling.reason import Party, Reason, ended, waits
from zscout.scheduling.runtimes import RuntimeEstimator
from zscout.types import SECOND, ArcId, Grant, HostName, Ns, RcName, Term

log = logging.getLogger(__name__)

REMEMBER: Ns = 60 * SECOND
"""How long ended requests are known: longer than any query's timeout and a lease together."""
MAX_REMEMBERED = 20_000
FINAL = (Outcome.RELEASED, Outcome.CANCELLED, Outcome.COMPLETED)
"""What has ended so is never granted again."""
REASONS_EVERY = 0.1
"""Seconds at most until a changed reason to wait is published: in a busy queue every grant changes many
reasons, and only the last is of use."""
RECENT: Ns = SECOND
"""Notices make do with a forecast of this age: each costs the RCM as much as many passes."""
MAX_LINES = 20_000
MAX_ANSWERED = 200
"""Lines of history in one answer: the latest."""
LOG_EVERY = 0.1
"""Seconds that lines for the log are gathered: an entry of its own for each would cost as much as a grant."""
MAX_LOGGED = 50
"""Lines in one entry of the log; the history has them all."""


def reason_info(reason: Reason | None, now: Ns) -> ReasonInfo | None:
    if reason is None:
        return None
    by = [party_info(one, now) for one in reason.by]
    rcs, patterns = list(reason.rcs), list(reason.patterns)
    return ReasonInfo(reason.code, rcs, by, reason.detail, reason.number, reason.pattern, patterns)


def party_info(party: Party, now: Ns) -> ReasonParty:
    yields_in = None if party.until is None else max(0, party.until - now) / SECOND
    return ReasonParty(request_id(party.arc), party.name, client_id(party.arc), party.priority, party.who, yields_in)


class RequestRegistry:
    """The requests of one term, those that ended lately included."""

    def __init__(self, mesh: Mesh, core: Core, term: Term, supervisor: Supervisor, places: Places) -> None:
        self._mesh, self._core, self._term, self._supervisor = mesh, core, term, supervisor
        self._places = places
        self._step = 0
        """The number of the last notice."""
        self._names: dict[ArcId, str] = {}
        self._ended: OrderedDict[ArcId, tuple[Ns, Notice]] = OrderedDict()
        self._interrupted: dict[ArcId, Notice] = {}
        """How the last hold of each queued ARC ended here."""
        self._estimated: set[ArcId] = set()
        """ARCs whose notices say when they will start."""
        self.may_be_held: Callable[[ArcId], bool] = lambda _: False
        """Whether a queued ARC's client believes in a hold that RCs may yet report: it is not told to wait before."""
        self.hosts_of: Callable[[Iterable[RcName]], dict[RcName, HostName]] = lambda _: {}
        """Where RCs are that are granted."""
        self.on_foretold: Callable[[ArcId, Ns], None] = lambda _arc, _start: None
        """Called with what a notice says of when an ARC will start."""
        self._telling = False
        """Whether reasons are told before long."""
        self._changed: dict[ArcId, None] = {}
        """Queued ARCs whose reason to wait has changed and has not been published yet."""
        self.runtimes: RuntimeEstimator | None = None
        """What is known of how long holds last, for forecasts."""
        self._starts: Mapping[ArcId, Ns] = {}
        """The last forecast."""
        self._foreseen: tuple[int, Ns] | None = None
        """After which batch of events, and when, it was made."""
        self._lines: deque[tuple[Ns, ArcId, str, str]] = deque(maxlen=MAX_LINES)
        """The history: when, ARC, its name, what happened."""
        self._unlogged: list[str] = []

    def enter(self, arc: ArcId, name: str, *, estimate: bool = False) -> None:
        """From now on `arc` is called `name`; with `estimate` its notices say when it will start."""
        self._names[arc] = name
        if estimate:
            self._estimated.add(arc)

    def name(self, arc: ArcId) -> str:
        return self._names.get(arc) or request_id(arc)

    def ended(self, arc: ArcId) -> bool:
        return arc in self._ended

    def reopens(self, arc: ArcId, unserved: Grant | None = None) -> bool:
        """Whether `arc` ended only because its client seemed gone, or had its time under the grant `unserved` while RCs
        of it settled, and may be asked for again: from now on it has not ended."""
        if arc not in self._ended:
            return False
        _, notice = self._ended[arc]
        completed = notice.outcome == Outcome.COMPLETED and notice.grant is not None and notice.grant == unserved
        if not completed and notice.outcome != Outcome.CLIENT_LOST:
            return False
        if completed and trace.enabled():
            trace.write(self._mesh.now(), "reopened", term=self._term, arc=arc)
        del self._ended[arc]
        return True

    def give_up(self, arc: ArcId, outcome: Outcome) -> None:
        """Its client wants no more of `arc`, which has ended or is unknown: it is not reopened."""
        known = self._ended.get(arc)
        notice = known[1] if known is not None else self._notice(arc, "ended", reason="given up by its client")
        if known is None or notice.outcome == Outcome.CLIENT_LOST:
            self._remember(arc, replace(notice, outcome=outcome))
        elif notice.outcome == Outcome.COMPLETED:
            # Nor as one whose time went by while its RCs settled.
            self._ended[arc] = known[0], replace(notice, grant=None)

    # Notices

    def notice(self, arc_id: ArcId) -> Notice:
        """The present state of a request, or how it ended."""
        arc = self._core.arc(arc_id)
        if arc is None:
            if arc_id in self._ended:
                return self._ended[arc_id][1]
            return self._notice(arc_id, "ended", reason="no such request is open")
        request, hold = arc.request, arc.hold
        known = {
            "priority": request.priority,
            "who": request.who,
            "booking": request.booking,
            "place": arc.place,
            "seal": self._places.seal(arc.place, arc_id),
        }
        if hold is not None:
            remaining = (hold.end - self._mesh.now()) / SECOND
            rcs, hosts, bound = sorted(arc.needs), self.hosts_of(arc.needs), dict(arc.bound)
            return self._notice(
                arc_id, "running", grant=hold.grant, rcs=rcs, bound=bound, remaining=remaining, hosts=hosts, **known
            )
        return self._notice(
            arc_id,
            "queued",
            reason=str(arc.reason or ""),
            why=reason_info(arc.reason, self._mesh.now()),
            ahead=arc.ahead,
            # What it is bound to is only what it was last checked with.
            rcs=sorted(need for need in request.needs if not is_pattern(need)),
            starts_in=self._starts_in(arc),
            **known,
        )

    def interrupted(self, arc: ArcId, believed: Grant) -> Notice:
        """The present state of a queued request whose client believes in a hold: with how that ended, or as lost where
        no RC, or not all of them, had it."""
        notice, ending = self.notice(arc), self._interrupted.get(arc)
        if ending is None or ending.grant != believed:
            return replace(notice, outcome=Outcome.LOST)
        return replace(notice, outcome=ending.outcome, by=ending.by, reason=ending.reason, why=ending.why)

    def handed_over(self, arc: ArcId, name: str) -> Notice:
        """That a request goes on in another client, where no more than that is known."""
        reason = "handed over to another client"
        return replace(self._notice(arc, "ended", reason=reason, outcome=Outcome.HANDED_OVER), arc=name)

    def _notice(self, arc: ArcId, state: State, **details: Any) -> Notice:
        self._step += 1
        return Notice(
            id=request_id(arc),
            arc=self.name(arc),
            client=client_id(arc),
            state=state,
            term=self._term,
            step=self._step,
            **details,
        )

    def tell_grants(self, effects: Collection[Effect], answered: Collection[ArcId]) -> set[ArcId]:
        """Publishes the notices of an instant's grants before the RCs hear of them, but to who is `answered` so, or had
        another hold until now. Returns whom it told."""
        over = {effect.arc for effect in effects if isinstance(effect, (HoldEnded, Dropped))}
        granted = [effect.arc for effect in effects if isinstance(effect, Granted)]
        told = {arc for arc in granted if arc not in over and arc not in answered and self._core.is_running(arc)}
        for arc in granted:
            if arc in told:
                self._put(self.notice(arc))
        return told

    def report(self, effects: Iterable[Effect], answered: Collection[ArcId], given_up: Collection[ArcId]) -> None:
        """Publishes the notices of an instant's effects, but where the answer to an operation says the same: the grant
        of an `answered` ARC, the end of the hold of a `given_up` one."""
        for effect in effects:
            match effect:
                case Granted(arc=arc, rcs=rcs):
                    self.record(arc, f"granted {', '.join(rcs)}")
                    self._interrupted.pop(arc, None)
                    # One that ended in the same instant is told of that alone: see below.
                    if arc not in answered and self._core.arc(arc) is not None:
                        self._put(self.notice(arc))
                case HoldEnded(arc=arc) | Dropped(arc=arc):
                    notice = self._close(effect)
                    if isinstance(effect, Dropped) or arc not in given_up:
                        self._put(notice)
                case Queued(arc=arc, settled=True) if self._core.is_queued(arc):
                    self._change(arc)
        if self._core.reasons_changed:
            self._tell_soon()

    def publish(self, arcs: Iterable[ArcId]) -> None:
        """Publishes the present state of these ARCs, as far as they are open."""
        for arc in arcs:
            if self._core.arc(arc) is not None:
                self._changed.pop(arc, None)
                self._put(self.notice(arc))

    def _change(self, arc: ArcId) -> None:
        self._tell_soon()
        self._changed[arc] = None

    def _tell_soon(self) -> None:
        if not self._telling:
            self._telling = True
            self._supervisor.call_later(REASONS_EVERY, self._publish_reasons)

    def _publish_reasons(self) -> None:
        self._telling = False
        self._changed |= {effect.arc: None for effect in self._core.tell_reasons() if isinstance(effect, Queued)}
        undecided = [arc for arc in self._changed if self.may_be_held(arc)]
        changed = [arc for arc in self._changed if arc not in undecided and self._core.is_queued(arc)]
        self._changed = dict.fromkeys(changed)
        self._record_reasons()
        self.publish(changed)
        for arc in undecided:
            self._change(arc)

    def refuse(self, arc: ArcId, name: str, problem: Problem) -> None:
        """Publish to its client that a listed request is refused."""
        reason = f"the leader refuses it: {problem.message}"
        self.record(arc, reason)
        notice = self._notice(arc, "ended", reason=reason, outcome=Outcome.LOST, problem=problem)
        self._put(replace(notice, arc=name))

    def _put(self, notice: Notice) -> None:
        try:
            self._mesh.put(self._mesh.keys.notice(client_of(notice.client)), notice)
        except BadName:
            log.exception("a notice could not be addressed")

    def _close(self, effect: HoldEnded | Dropped) -> Notice:
        """Records how a hold, or the wait for one, ended. A request that is not queued again has ended with it."""
        why = reason_info(effect.reason, self._mesh.now())
        details: dict[str, Any] = {"reason": str(effect.reason), "outcome": effect.outcome, "why": why}
        requeued = isinstance(effect, HoldEnded) and effect.requeued
        self.record(effect.arc, f"{ended(effect.outcome, str(effect.reason))}{'; queued again' if requeued else ''}")
        arc = self._core.arc(effect.arc)
        if isinstance(effect, HoldEnded):
            details |= {"by": effect.by, "grant": effect.grant, "rcs": list(effect.rcs)}
        if requeued and arc is not None:
            details["starts_in"] = self._starts_in(arc)
        notice = self._notice(effect.arc, "queued" if requeued else "ended", **details)
        if arc is None:
            self._remember(effect.arc, notice)
        elif requeued:
            self._interrupted[effect.arc] = notice
        return notice

    def _remember(self, arc: ArcId, notice: Notice) -> None:
        now = self._mesh.now()
        if trace.enabled() and notice.outcome in FINAL:
            trace.write(now, "over", term=self._term, arc=arc)
        self._names.pop(arc, None)
        self._interrupted.pop(arc, None)
        self._estimated.discard(arc)
        self._ended[arc] = (now + REMEMBER, notice)
        self._ended.move_to_end(arc)
        while self._ended and (len(self._ended) > MAX_REMEMBERED or next(iter(self._ended.values()))[0] < now):
            self._ended.popitem(last=False)

    # Forecasts: one serves all that are wanted in the same instant

    def starts(self) -> Mapping[ArcId, Ns]:
        """When each queued ARC will start, forecast from the present state; absent: never, or too late."""
        if self._foreseen is None or self._foreseen[0] != self._core.batches:
            now = self._mesh.now()
            self._starts = forecast(self._core, now, None, self.runtimes).starts
            self._foreseen = self._core.batches, now
        return self._starts

    def _starts_in(self, arc: ArcStatus) -> float | None:
        """Seconds until a queued ARC starts, by a forecast since it was queued and not older than RECENT."""
        if arc.hold is not None or arc.id not in self._estimated:
            return None
        now = self._mesh.now()
        made = self._foreseen[1] if self._foreseen is not None else None
        recent = made is not None and arc.since < made and now - made < RECENT
        start = (self._starts if recent else self.starts()).get(arc.id)
        if start is None:
            return None
        self.on_foretold(arc.id, start)
        return max(0, start - now) / SECOND

    # History

    def record(self, arc: ArcId, text: str) -> None:
        name = self.name(arc)
        self._lines.append((self._mesh.now(), arc, name, text))
        if not self._unlogged:
            self._supervisor.call_later(LOG_EVERY, self._write_log)
        self._unlogged.append(f"{name} {text}")

    def story(self, arc: str) -> list[StoryLine]:
        """The latest lines about an ARC (its name, id, or `<host>/<client>/<id>`), oldest first."""
        now = self._mesh.now()
        lines = [
            StoryLine(ago=(now - at) / SECOND, text=text)
            for at, full, name, text in self._lines
            if arc in (name, full, request_id(full))
        ]
        return lines[-MAX_ANSWERED:]

    def close(self) -> None:
        """Writes to the log what was gathered: nothing is published any more."""
        self._record_reasons()
        self._write_log()

    def _record_reasons(self) -> None:
        changed, self._changed = self._changed, {}
        for arc in filter(None, map(self._core.arc, changed)):
            if arc.hold is None:
                self.record(arc.id, waits(str(arc.reported)))

    def _write_log(self) -> None:
        lines, self._unlogged = self._unlogged, []
        if len(lines) > MAX_LOGGED:
            lines[MAX_LOGGED:] = [f"and {len(lines) - MAX_LOGGED} lines more; ask `zscout why`"]
        if lines:
            log.info("%s", "\n  ".join(lines))

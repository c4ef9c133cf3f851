"""The facts about requests that the core does not have: names, notices to clients, recent endings, history. Pure.

Each change that no answer to an operation reports becomes a notice on the client's key. Ended requests are kept for a
while. The history of each ARC is kept as text, for `zscout why` and the log."""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any, Final, TypeAlias

from msgspec.structs import replace

from zscout import messages
from zscout.keyexpr import is_pattern
from zscout.messages import Notice, Problem, ReasonInfo, ReasonParty, State, StoryLine
from zscout.rcm.places import Places, client_id, request_id
from zscout.rcm.roster import Roster
from zscout.rcm.steps import Outbox
from zscout.scheduling.core import Core
from zscout.scheduling.forecast import forecast
from zscout.scheduling.model import ArcStatus, Dropped, Effect, Granted, HoldEnded, HoldTimed, Outcome, Queued
from zscout.scheduling.reason import ITS_CLIENT, Party, Reason, ended, starting, waits
from zscout.scheduling.runtimes import RuntimeEstimator
from zscout.scheduling.upcoming import UpcomingEnd
from zscout.types import SECOND, ArcId, Grant, Ns, RcName

REMEMBERED: Final[Ns] = 60 * SECOND
"""The time for which ended requests are known: longer than any query's timeout and a lease together."""
MAX_REMEMBERED: Final = 20_000
FINAL: Final = (Outcome.RELEASED, Outcome.CANCELLED, Outcome.COMPLETED)
"""Outcomes of requests that are never granted again."""
REASONS_DELAY: Final[Ns] = SECOND // 10
"""Until a changed reason to wait is published: each grant in a busy queue changes many, and only the last counts."""
FORECAST_AGE: Final[Ns] = SECOND
"""Age at most of a forecast in notices: each costs the leader as much as many passes."""
MAX_LINES: Final = 20_000
MAX_ANSWERED: Final = 200
"""Lines of history in one answer: the latest."""
LOG_DELAY: Final[Ns] = SECOND // 10
"""Lines for the log are gathered: an entry of its own for each would cost as much as a grant."""
MAX_LOGGED: Final = 50
"""Lines in one entry of the log; the history has them all."""


def reason_info(reason: Reason | None, now: Ns) -> ReasonInfo | None:
    if reason is None:
        return None
    by = [party_info(party, now) for party in reason.by]
    rcs, patterns, detail = list(reason.rcs), list(reason.patterns), ITS_CLIENT if reason.own else reason.detail
    return ReasonInfo(reason.code, rcs, by, detail, reason.number, reason.pattern, patterns, reason.own)


def party_info(party: Party, now: Ns) -> ReasonParty:
    yields_in = None if party.until is None else max(0, party.until - now) / SECOND
    return ReasonParty(request_id(party.arc), party.name, client_id(party.arc), party.priority, party.who, yields_in)


def upcoming_info(end: UpcomingEnd, now: Ns) -> messages.Upcoming:
    safe, begins_in = max(0, end.until - now) / SECOND, None if end.begins is None else (end.begins - now) / SECOND
    return messages.Upcoming(end.code, party_info(end.by, now), list(end.rcs), safe, begins_in)


_Line: TypeAlias = tuple[Ns, ArcId, str, str]
"""A line of the history: time, ARC, its name, text."""


@dataclass(slots=True)
class _Request:
    name: str
    estimated: bool = False
    """Its notices include when it will start."""
    ending: Notice | None = None
    """The end of its last hold here, while it is queued; else its own end."""
    until: Ns | None = None
    """If it has ended: the time until which it is kept."""
    believed: Collection[RcName] = ()
    """RCs that its client believes to hold since an earlier term: they may yet report that."""
    believed_grant: Grant | None = None
    """The grant of that hold."""
    first_estimate: Ns | None = None
    """The first estimated start that its client was notified of."""


class RequestLog:
    def __init__(self, core: Core, roster: Roster, places: Places, runtimes: RuntimeEstimator | None) -> None:
        self._core, self._roster, self._places = core, roster, places
        self._runtimes = runtimes
        self._step = 0
        self._requests: dict[ArcId, _Request] = {}
        self._ended: OrderedDict[ArcId, None] = OrderedDict()  # ended ARCs, in the order of their ends
        self._changed: dict[ArcId, None] = {}
        """Queued ARCs whose reason to wait changed since it was published."""
        self._report_at: Ns | None = None
        self._starts: Mapping[ArcId, Ns] = {}  # the last forecast
        self._forecast: tuple[int, Ns] | None = None  # the batch of events and the time at which it was made
        self._lines: deque[_Line] = deque(maxlen=MAX_LINES)
        self.traced: list[tuple[str, ArcId]] = []
        """ARCs that are over for good, or were reopened, since the caller took this list."""
        self._upcoming: dict[ArcId, tuple[UpcomingEnd, ...]] = {}
        """By hold: the upcoming ends in the last notice to its client."""
        self.first_estimates: dict[ArcId, Ns] = {}
        """ARCs granted in the last instant, with the first estimated start that their clients were notified of."""
        self._unlogged: list[str] = []
        self._log_at: Ns | None = None

    def enter(self, arc: ArcId, name: str, *, estimate: bool = False) -> None:
        """With `estimate` its notices include the estimated start."""
        known = self._requests.get(arc)
        if known is None or known.until is not None:
            known = self._requests[arc] = _Request(name)
            self._ended.pop(arc, None)
        known.name = name
        known.estimated |= estimate

    def rename(self, arc: ArcId, renamed: ArcId) -> None:
        known = self._requests.get(arc)
        self.enter(renamed, self.name(arc))
        if known is not None and self._core.is_queued(arc):
            self._requests[renamed].first_estimate = known.first_estimate

    def believe(self, arc: ArcId, grant: Grant, rcs: Collection[RcName]) -> None:
        """The client of a waiting ARC believes that it holds these RCs by this grant."""
        known = self._requests[arc]
        known.believed_grant, known.believed = grant, rcs

    def name(self, arc: ArcId) -> str:
        known = self._requests.get(arc)
        return request_id(arc) if known is None or known.until is not None else known.name

    def ended(self, arc: ArcId) -> bool:
        return self._ending(arc) is not None

    def _ending(self, arc: ArcId) -> Notice | None:
        known = self._requests.get(arc)
        return None if known is None or known.until is None else known.ending

    def may_be_held(self, now: Ns, arc: ArcId) -> bool:
        """Return True if a queued ARC's client believes in a hold that RCs may yet report: its notice waits."""
        known, status = self._requests.get(arc), self._core.arc(arc)
        if known is None or status is None or status.hold is not None:
            return False
        return self._roster.awaits(now, arc, known.believed)

    def _is_vouched(self, arc: ArcId) -> bool:
        """Return True if `arc` is open by its client's word: without it, what an RC reported may be another's."""
        status = self._core.arc(arc)
        return status is not None and status.vouched

    def _is_of_another(self, now: Ns, ended: HoldEnded) -> bool:
        """Return True if the ARC's client believes in another hold than the ended one, and RCs may yet report it."""
        known = self._requests.get(ended.arc)
        believed = None if known is None else known.believed_grant
        return believed not in (None, ended.grant) and self.may_be_held(now, ended.arc)

    def reopens(self, arc: ArcId, unserved: Grant | None = None) -> bool:
        """Return True if `arc` may be requested again, and forget its end: its client seemed lost, or it was completed
        under the grant `unserved` while RCs of it settled."""
        if (notice := self._ending(arc)) is None:
            return False
        completed = notice.outcome == Outcome.COMPLETED and notice.grant is not None and notice.grant == unserved
        if not completed and notice.outcome != Outcome.CLIENT_LOST:
            return False
        if completed:
            self.traced.append(("reopened", arc))
        del self._requests[arc], self._ended[arc]
        return True

    def give_up(self, now: Ns, arc: ArcId, outcome: Outcome) -> None:
        """The client of `arc`, which has ended or is unknown, no longer wants it: it is not reopened."""
        known = self._ending(arc)
        notice = known or self._notice(arc, "ended", reason="given up by its client")
        if known is None or notice.outcome == Outcome.CLIENT_LOST:
            self._remember(now, arc, replace(notice, outcome=outcome))
        elif notice.outcome == Outcome.COMPLETED:
            # Without its grant it is not reopened as `unserved` either.
            self._requests[arc].ending = replace(notice, grant=None)

    def notice(self, now: Ns, arc_id: ArcId) -> Notice:
        arc = self._core.arc(arc_id)
        if arc is None:
            return self._ending(arc_id) or self._notice(arc_id, "ended", reason="no such request is open")
        request, hold = arc.request, arc.hold
        known: dict[str, Any] = {
            "priority": request.priority,
            "who": request.who,
            "booking": request.booking,
            "place": arc.place,
            "seal": self._places.seal(arc.place, arc_id),
        }
        if hold is not None:
            remaining, left = (hold.end - now) / SECOND, hold.starting(now)
            rcs, bound = sorted(arc.needs), dict(arc.bound)
            hosts = {rc: host for rc, (_, host) in self._roster.named(arc.needs).items()}
            known |= {"bound": bound, "hosts": hosts, "waits": None if left is None else left / SECOND}
            known["upcoming"] = self._note_upcoming(now, arc_id)
            return self._notice(arc_id, "running", grant=hold.grant, rcs=rcs, remaining=remaining, **known)
        return self._notice(
            arc_id,
            "queued",
            reason=str(arc.reason or ""),
            why=reason_info(arc.reason, now),
            ahead=arc.ahead,
            # Its patterns are bound only to the RCs of the last check, so they are left out.
            rcs=sorted(need for need in request.needs if not is_pattern(need)),
            starts_in=self._starts_in(now, arc),
            **known,
        )

    def _note_upcoming(self, now: Ns, arc: ArcId) -> list[messages.Upcoming]:
        ends = self._core.upcoming(arc)
        if ends:
            self._upcoming[arc] = ends
        else:
            self._upcoming.pop(arc, None)
        return [upcoming_info(end, now) for end in ends]

    def interrupted(self, now: Ns, arc: ArcId, believed: Grant) -> Notice:
        """The state of a queued request whose client believes in a hold: with its end, `lost` if unknown here."""
        known = self._requests.get(arc)
        notice, ending = self.notice(now, arc), None if known is None else known.ending
        if ending is None or ending.grant != believed:
            return replace(notice, outcome=Outcome.LOST)
        return replace(notice, outcome=ending.outcome, by=ending.by, reason=ending.reason, why=ending.why)

    def handed_over(self, arc: ArcId, name: str) -> Notice:
        """The notice that another client has the request now, if nothing else is known of it."""
        reason = "handed over to another client"
        return replace(self._notice(arc, "ended", reason=reason, outcome=Outcome.HANDED_OVER), arc=name)

    def _notice(self, arc: ArcId, state: State, **details: Any) -> Notice:
        self._step += 1
        return Notice(
            id=request_id(arc),
            arc=self.name(arc),
            client=client_id(arc),
            state=state,
            term=self._core.term,
            step=self._step,
            **details,
        )

    def refuse(self, now: Ns, arc: ArcId, name: str, problem: Problem) -> Notice:
        reason = f"the leader refuses it: {problem.message}"
        self.record(now, arc, reason)
        return replace(self._notice(arc, "ended", reason=reason, outcome=Outcome.LOST, problem=problem), arc=name)

    def report(
        self, now: Ns, effects: Iterable[Effect], answered: Collection[ArcId], given_up: Collection[ArcId]
    ) -> list[Notice]:
        """Return the notices for the effects of an instant, without those that an answer to an operation carries:
        grants of `answered` ARCs, and ends of `given_up` ARCs."""
        notices = []
        self.first_estimates.clear()
        for effect in effects:
            match effect:
                case Granted(arc=arc, rcs=rcs):
                    self.record(now, arc, f"granted {', '.join(rcs)}")
                    if (known := self._requests.get(arc)) is not None and known.until is None:
                        if known.first_estimate is not None:
                            self.first_estimates[arc] = known.first_estimate
                        known.ending = known.first_estimate = None
                    # If the ARC ended in the same instant, only its end is notified.
                    if arc not in answered and self._is_vouched(arc):
                        notices.append(self.notice(now, arc))
                case HoldTimed(arc=arc, waits=waits) if self._core.is_running(arc):
                    about = "is ready: its devices have begun" if waits is None else starting((waits - now) / SECOND)
                    self.record(now, arc, about)
                    if self._is_vouched(arc):
                        notices.append(self.notice(now, arc))
                case HoldEnded(arc=arc) | Dropped(arc=arc):
                    notice = self._close(now, effect)
                    if isinstance(effect, HoldEnded) and self._is_of_another(now, effect):
                        self._changed[arc] = None
                    elif isinstance(effect, Dropped) or arc not in given_up:
                        notices.append(notice)
                case Queued(arc=arc, settled=True) if self._core.is_queued(arc):
                    self._changed[arc] = None
        core = self._core
        if self._report_at is None and (
            self._changed or core.reasons_changed or core.upcoming_changed(reported=bool(self._upcoming))
        ):
            self._report_at = now + REASONS_DELAY
        return notices

    def present(self, now: Ns, arcs: Iterable[ArcId]) -> list[Notice]:
        """The notices with the present state of these ARCs, without those that are closed."""
        opened = [arc for arc in arcs if self._core.is_open(arc)]
        self._record_reasons(now, opened)
        return [self.notice(now, arc) for arc in opened]

    @property
    def next(self) -> Ns | None:
        return min((at for at in (self._report_at, self._log_at) if at is not None), default=None)

    def tick(self, now: Ns) -> Outbox:
        """The notices of changed reasons, and lines for the log, as far as they are due."""
        out = Outbox()
        if self._report_at is not None and self._report_at <= now:
            self._changed |= {effect.arc: None for effect in self._core.report_reasons() if isinstance(effect, Queued)}
            undecided = [arc for arc in self._changed if self.may_be_held(now, arc)]
            changed = [arc for arc in self._changed if arc not in undecided and self._core.is_queued(arc)]
            out.notices = [*self.present(now, changed), *self._upcoming_notices(now)]
            self._changed = dict.fromkeys(undecided)
            self._report_at = now + REASONS_DELAY if undecided else None
        if self._log_at is not None and self._log_at <= now:
            out.log.append(self._log_text())
        return out

    def _upcoming_notices(self, now: Ns) -> list[Notice]:
        holds = (arc for arc in self._core.contended_holds() if self._is_vouched(arc))
        changed = [arc for arc in holds if self._core.upcoming(arc) != self._upcoming.get(arc, ())]
        return [self.notice(now, arc) for arc in changed]

    def _close(self, now: Ns, effect: HoldEnded | Dropped) -> Notice:
        """Unless it is queued again, the request has ended with the hold."""
        why = reason_info(effect.reason, now)
        details: dict[str, Any] = {"reason": str(effect.reason), "outcome": effect.outcome, "why": why}
        self._upcoming.pop(effect.arc, None)
        requeued = isinstance(effect, HoldEnded) and effect.requeued
        again = "; queued again" if requeued else ""
        self.record(now, effect.arc, f"{ended(effect.outcome, str(effect.reason), effect.reason)}{again}")
        arc = self._core.arc(effect.arc)
        if isinstance(effect, HoldEnded):
            details |= {"by": effect.by, "grant": effect.grant, "rcs": list(effect.rcs)}
        if requeued and arc is not None:
            details["starts_in"] = self._starts_in(now, arc)
        notice = self._notice(effect.arc, "queued" if requeued else "ended", **details)
        if arc is None:
            self._remember(now, effect.arc, notice)
        elif requeued and (known := self._requests.get(effect.arc)) is not None:
            known.ending = notice
        return notice

    def _remember(self, now: Ns, arc: ArcId, notice: Notice) -> None:
        if notice.outcome in FINAL:
            self.traced.append(("over", arc))
        self._requests[arc] = _Request("", ending=notice, until=now + REMEMBERED)
        self._ended[arc] = None
        self._ended.move_to_end(arc)
        while self._ended and (len(self._ended) > MAX_REMEMBERED or self._is_old(next(iter(self._ended)), now)):
            del self._requests[self._ended.popitem(last=False)[0]]

    def _is_old(self, arc: ArcId, now: Ns) -> bool:
        until = self._requests[arc].until
        return until is not None and until < now

    def starts(self, now: Ns) -> Mapping[ArcId, Ns]:
        """The starts of queued ARCs, forecast once for the whole instant; absent: not within the forecast."""
        if self._forecast is None or self._forecast[0] != self._core.batches:
            self._starts = forecast(self._core, now, None, self._runtimes).starts
            self._forecast = self._core.batches, now
        return self._starts

    def _starts_in(self, now: Ns, arc: ArcStatus) -> float | None:
        """Seconds until a queued ARC starts, by a forecast made since it was queued and within FORECAST_AGE."""
        known = self._requests.get(arc.id)
        if arc.hold is not None or known is None or not known.estimated:
            return None
        made = self._forecast[1] if self._forecast is not None else None
        recent = made is not None and arc.since < made and now - made < FORECAST_AGE
        start = (self._starts if recent else self.starts(now)).get(arc.id)
        if start is None:
            return None
        if known.first_estimate is None and self._core.is_queued(arc.id):
            known.first_estimate = start
        return max(0, start - now) / SECOND

    def record(self, now: Ns, arc: ArcId, text: str) -> None:
        name = self.name(arc)
        self._lines.append((now, arc, name, text))
        if self._log_at is None:
            self._log_at = now + LOG_DELAY
        self._unlogged.append(f"{name} {text}")

    def story(self, now: Ns, arc: str) -> list[StoryLine]:
        """The latest lines about an ARC (its name, id, or `<host>/<client>/<id>`), oldest first."""
        lines = [
            StoryLine(ago=(now - at) / SECOND, text=text)
            for at, full, name, text in chain(self._lines, self._reasons(now, self._changed))
            if arc in (name, full, request_id(full))
        ]
        return lines[-MAX_ANSWERED:]

    def close(self, now: Ns) -> str:
        self._record_reasons(now, list(self._changed))
        return self._log_text()

    def _record_reasons(self, now: Ns, arcs: Iterable[ArcId]) -> None:
        """Record the changed reasons of these ARCs, before they are notified."""
        changed = [arc for arc in dict.fromkeys(arcs) if arc in self._changed]
        for _, arc, _, text in self._reasons(now, changed):
            self.record(now, arc, text)
        for arc in changed:
            del self._changed[arc]

    def _reasons(self, now: Ns, arcs: Iterable[ArcId]) -> Iterator[_Line]:
        for arc in filter(None, map(self._core.arc, arcs)):
            if arc.hold is None:
                yield now, arc.id, self.name(arc.id), waits(str(arc.reported), arc.reported)

    def _log_text(self) -> str:
        lines, self._unlogged, self._log_at = self._unlogged, [], None
        if len(lines) > MAX_LOGGED:
            lines[MAX_LOGGED:] = [f"and {len(lines) - MAX_LOGGED} lines more; ask `zscout why`"]
        return "\n  ".join(lines)

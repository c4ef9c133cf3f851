"""Turns messages that a candidate receives into changes of its journal. Pure; times are passed in.

Publications report starts and ends of holds. After a gap the RCM's state is read: unknown holds in it began unnoticed,
known ones not in it ended unnoticed. RCs report the use of a hold, possibly out of order."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Iterator, Sequence
from decimal import Decimal
from typing import Any, Final, NamedTuple, TypeAlias, TypeVar

from zscout import messages
from zscout.types import NO_TERM, Grant, RcName, clean

N = TypeVar("N", int, Decimal)

MAX_OPEN: Final = 20_000  # holds followed at one time; further ones may be written repeatedly
MAX_EARLY: Final = 2_000  # reports of use kept for holds not known yet
MAX_TEXT: Final = 200  # characters kept of a name or a reason
MAX_RCS: Final = 1_000  # RCs kept per hold: no fleet allows more
MAX_NUMBER: Final = 10**9  # limit of a priority or a duration
MAX_SEQ: Final = 2**63 - 1


class PublicationReceived(NamedTuple):
    """A publication, `silence` seconds after the previous one or heartbeat."""

    at: float  # seconds since 1970, UTC
    silence: float
    grants: messages.Grants


class StateRead(NamedTuple):
    at: float
    state: messages.RcmState


class UseReported(NamedTuple):
    """Use reported by RCs: (RC, grant, seconds), with the RC of the report's key."""

    reports: Sequence[tuple[RcName, Grant, float]]


class ClockSet(NamedTuple):
    """This host's clock was set forward `by` seconds: earlier times are off by as much."""

    by: float


class HoldSeen(NamedTuple):
    hold: messages.PastHold


class HoldOver(NamedTuple):
    """A hold ended; `hold` is its whole record, in case it is unknown."""

    hold: messages.PastHold


class EndMissed(NamedTuple):
    """A hold ended at `at` or later."""

    grant: Grant
    at: float


class GapSeen(NamedTuple):
    gap: messages.JournalGap


class HoldUsed(NamedTuple):
    """An RC was used under a hold for at least `seconds`, if both are known."""

    grant: Grant
    rc: RcName
    seconds: float


Observation: TypeAlias = PublicationReceived | StateRead | UseReported | ClockSet
Change: TypeAlias = HoldSeen | HoldOver | EndMissed | HoldUsed | GapSeen | ClockSet


class Follower:
    """Follows one fleet. `silent`: seconds without a heartbeat that mean a lost RCM."""

    def __init__(self, silent: float, open_holds: Iterable[Grant] = (), heard: float | None = None) -> None:
        """`open_holds` and the last publication's time `heard` are from the closing of the journal."""
        self._silent = silent
        self._open: dict[Grant, None] = dict.fromkeys(open_holds)
        self._term, self._seq = NO_TERM, 0
        self._left = heard  # time of that close, until the next publication
        self._doubt: float | None = None  # since then ends may have been missed
        self._early: OrderedDict[tuple[Grant, RcName], float] = OrderedDict()
        """Use under grants that are not followed, ended or not known yet; at most MAX_EARLY, the latest."""
        self.must_read = False  # true while the RCM's state must be read, and passed as a `StateRead`

    def take(self, event: Observation) -> Iterator[Change]:
        """Yield the resulting changes; none for an earlier term."""
        match event:
            case PublicationReceived():
                return self._heard(event)
            case StateRead():
                return self._read(event)
            case UseReported():
                return self._used(event)
            case ClockSet():
                return self._set_clock(event)

    def _set_clock(self, event: ClockSet) -> Iterator[Change]:
        if self._doubt is not None:
            self._doubt += event.by
        yield event

    def _heard(self, event: PublicationReceived) -> Iterator[Change]:
        at, grants = event.at, event.grants
        if grants.term < self._term or not _is_sane(Grant(grants.term, grants.seq)):
            return
        if (gap := self._gap_before(event)) is not None:
            self._doubt = gap.began if self._doubt is None else min(self._doubt, gap.began)
            yield GapSeen(gap)
        # A new term may begin with unpublished ends.
        self.must_read |= gap is not None or grants.term != self._term
        self._seq = max(self._seq, grants.seq) if grants.term == self._term else grants.seq
        self._term, self._left = grants.term, None
        waited = dict(grants.begun)
        for holders in grants.rcs.values():
            for holder in holders:
                if holder.grant not in self._open and _is_sane(holder.grant):
                    ours = holder.grant.term == grants.term
                    yield from self._in_force(_held(holder, at, waited.get(holder.grant.seq) if ours else None, grants))
        for revoked in grants.revoked:
            if _is_sane(revoked.grant):
                self._open.pop(revoked.grant, None)
                yield HoldOver(hold := _over(revoked, at))
                yield from self._used_early(hold)

    def _gap_before(self, event: PublicationReceived) -> messages.JournalGap | None:
        at, grants = event.at, event.grants
        if self._left is not None:
            return messages.JournalGap(min(self._left, at), at, "off")
        if self._term == NO_TERM:
            return None
        before = self._seq if grants.term == self._term else 0
        if event.silence > self._silent:
            return messages.JournalGap(at - event.silence, at, "silent")
        if grants.prev > before:
            return messages.JournalGap(at - event.silence, at, "missed", _number(grants.prev - before))
        return None

    def _read(self, event: StateRead) -> Iterator[Change]:
        at, state = event.at, event.state
        # Only a publication introduces a term; older states are read again.
        if state.term != self._term or not self._seq <= state.seq <= MAX_SEQ:
            return
        self._seq = state.seq
        since, self._doubt, self.must_read = self._doubt, None, False
        current = {hold.grant for hold in state.holds}
        for grant in [grant for grant in self._open if grant not in current]:
            del self._open[grant]
            yield EndMissed(grant, at if since is None else since)
        for hold in state.holds:
            if hold.grant not in self._open and _is_sane(hold.grant):
                yield from self._in_force(_viewed(hold, at))

    def lost(self, gap: messages.JournalGap) -> Iterator[Change]:
        """The journal could not store changes, possibly ends of holds: mark the gap, and read the journal again."""
        self._doubt, self.must_read = gap.began if self._doubt is None else min(self._doubt, gap.began), True
        yield GapSeen(gap)

    def _in_force(self, hold: messages.PastHold) -> Iterator[Change]:
        if len(self._open) < MAX_OPEN:
            self._open[hold.grant] = None
        yield HoldSeen(hold)
        yield from self._used_early(hold)

    def _used(self, event: UseReported) -> Iterator[Change]:
        for rc, grant, seconds in event.reports:
            if _is_sane(grant) and 0 <= seconds <= MAX_NUMBER:
                yield HoldUsed(grant, rc, seconds)
                if grant not in self._open:
                    self._early[grant, rc] = seconds
                    if len(self._early) > MAX_EARLY:
                        self._early.popitem(last=False)

    def _used_early(self, hold: messages.PastHold) -> Iterator[Change]:
        if self._early:
            for rc in hold.rcs:
                if (seconds := self._early.pop((hold.grant, rc), None)) is not None:
                    yield HoldUsed(hold.grant, rc, seconds)


def _is_sane(grant: Grant) -> bool:
    """Return True if a grant fits the file: numbers on the mesh have any size."""
    (counter, rcm), seq = grant
    return 0 <= seq <= MAX_SEQ and 0 <= counter <= messages.MAX_COUNTER and _text(rcm) == rcm


def _held(holder: messages.Holder, at: float, waited: float | None, grants: messages.Grants) -> messages.PastHold:
    known = waited is not None or (holder.grant.term == grants.term and grants.prev < holder.grant.seq <= grants.seq)
    return messages.PastHold(
        **_names(holder.id, holder.arc, holder.client, holder.grant, holder.rcs),
        began=at,
        late=not known,
        priority=_number(holder.priority),
        min_runtime=float(_number(holder.min_runtime)),
        waited=waited,
        who=_user(holder.who),
    )


def _viewed(hold: messages.HoldView, at: float) -> messages.PastHold:
    return messages.PastHold(
        **_names(hold.id, hold.arc, hold.client, hold.grant, sorted(hold.needs)),
        began=max(0.0, at - max(0.0, hold.held)),
        priority=_number(hold.priority),
        min_runtime=float(_number(hold.min_runtime)),
        who=_user(hold.who),
    )


def _over(revoked: messages.Revocation, at: float) -> messages.PastHold:
    why = revoked.why
    by = why.by[0] if revoked.by is not None and why is not None and why.by else None
    if by is not None:
        by = messages.ReasonParty(_text(by.id), _text(by.arc), _text(by.client), _number(by.priority), _user(by.who))
    return messages.PastHold(
        **_names(revoked.id, revoked.arc, revoked.client, revoked.grant, revoked.rcs),
        began=at,
        late=True,
        ended=at,
        outcome=_text(revoked.outcome),
        reason=_text(revoked.reason),
        by=by,
        code="" if why is None else _text(why.code),
        own=why is not None and why.own,
    )


def _names(number: str, arc: str, client: str, grant: Grant, rcs: list[str]) -> dict[str, Any]:
    kept = [_text(rc) for rc in rcs[:MAX_RCS]]
    return {"grant": grant, "id": _text(number), "arc": _text(arc), "client": _text(client), "rcs": kept}


def _user(who: messages.Who | None) -> messages.Who | None:
    """The requester without the comment."""
    if who is None or not (who.user or who.host or who.command):
        return None
    return messages.Who(
        clean(who.user)[: messages.MAX_WHO], clean(who.host)[: messages.MAX_WHO], clean(who.command)[: messages.MAX_WHO]
    )


def _text(text: str) -> str:
    return clean(text[:MAX_TEXT])


def _number(number: N) -> N:
    """Clamp a number to the range that readers of an answer accept."""
    return max(min(number, type(number)(MAX_NUMBER)), type(number)(-MAX_NUMBER))

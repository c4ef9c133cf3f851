"""Requests and holders from the leader's publications, for the timeline. Pure; times are passed in."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

from zscout.messages import (
    Grants,
    Holder,
    HoldView,
    Notice,
    RcmState,
    ReasonInfo,
    ReasonParty,
    Revocation,
    WaitView,
    absurd,
)
from zscout.scheduling.reason import ReasonCode, ended, reason_of, short_names, starting, waits_for_others
from zscout.services.recorder.drawing import HolderRow, with_person
from zscout.services.recorder.timeline import Timeline
from zscout.types import NO_TERM, Grant, Term, clean

MAX_OPEN: Final = 20_000
"""Requests followed at one time."""
MAX_RCS: Final = 10_000
MAX_HOLDERS: Final = 1_024

Key = tuple[str, str]
"""Client and id of a request."""


@dataclass(slots=True)
class _Request:
    label: str
    """Name and person: `survey (alice)`; numbered if several open requests have the same."""
    who: str = ""
    """`alice@ws1`, if its client gives a user."""
    command: str = ""
    """The user's command, if given."""
    preempted: bool = False
    """True while it waits after a preemption."""
    state: str = ""
    detail: str = ""
    grant: Grant | None = None
    starts: bool = False
    """True while its devices have not begun."""
    last: tuple[Term, int] = field(default=(NO_TERM, 0))
    """Term and step of the newest notice."""

    def take_owner(self, view: Holder | HoldView | WaitView | Notice) -> None:
        if view.who is not None and view.who.user:
            host = view.who.host or view.client.partition("/")[0]
            self.who, self.command = clean(f"{view.who.user}@{host}"), view.who.command


class RequestTracker:
    def __init__(self, timeline: Timeline, operator_priority: int) -> None:
        self.timeline, self.operator_priority = timeline, operator_priority
        self.term: Term = NO_TERM
        self.seq = 0
        """Number of the newest publication; older publications are ignored."""
        self._requests: dict[Key, _Request] = {}
        self._labels: set[str] = set()
        self._rcs = timeline.robots.holds
        self._absent: dict[str, str] = {}
        """Texts for devices that are absent, after they were present."""
        self.offered: dict[str, set[str]] = {}
        """By device the hosts that offer it, according to tokens."""

    def grants(self, at: float, grants: Grants) -> bool:
        """Take a publication of the RCM; return True if earlier publications were missed."""
        if (grants.term, grants.seq) < (self.term, self.seq) or absurd(grants.term, self.term):
            return False
        missed = grants.term != self.term or grants.prev > self.seq
        self.term, self.seq = grants.term, grants.seq
        for revoked in grants.revoked:
            self._revoked(at, revoked, grants)
        for rc, holders in grants.rcs.items():
            for holder in holders[:MAX_HOLDERS]:
                self._runs(at, holder)
            self._show(at, rc, holders[:MAX_HOLDERS])
        return missed

    def notice(self, at: float, notice: Notice) -> None:
        if notice.term < self.term:
            return
        key = (notice.client, notice.id)
        if notice.state == "ended":
            self._ended(at, key, notice.outcome or "ended", notice.reason, notice.why)
            return
        request = self._track(key, notice)
        if request is None or (notice.term, notice.step) <= request.last:
            return
        request.last = (notice.term, notice.step)
        # Publications show when it begins and ends to run.
        if notice.state == "queued" and request.state != "running":
            self._waits(at, request, notice.reason, notice.why)

    def state(self, at: float, state: RcmState) -> bool:
        """Take the RCM's whole state; return False if publications are newer."""
        if (state.term, state.seq) < (self.term, self.seq):
            return False
        self.term, self.seq = state.term, state.seq
        # Offered devices, too: a new leader may not list them yet, and does not publish when it accepts them.
        holders: dict[str, list[HoldView]] = {
            rc: [] for rc in (*(view.rc for view in state.rcs if view.present), *self._rcs, *self.offered)
        }
        open_now = {(hold.client, hold.id) for hold in state.holds}
        open_now |= {(wait.client, wait.id) for wait in state.queue}
        for hold in state.holds:
            self._runs(at, hold)
            for rc in hold.needs:
                holders.setdefault(rc, []).append(hold)
        for wait in state.queue:
            request = self._track((wait.client, wait.id), wait)
            if request is None:
                continue
            request.grant, request.preempted = None, wait.preemptions > 0
            self._waits(at, request, wait.reason, wait.why)
        for key in [key for key in self._requests if key not in open_now]:
            # Queued requests may be missing in the answer.
            if not state.more or self._requests[key].grant is not None:
                self._ended(at, key, "ended", "while not recorded")
        # An RC that is only named by a request is not marked as absent: it was never present.
        for view in state.rcs:
            if view.present:
                self._absent.pop(view.rc, None)
            elif view.rc in holders:
                self._absent.setdefault(view.rc, "not there")
        for rc, held in holders.items():
            self._show(at, rc, held)
        return True

    @property
    def in_doubt(self) -> bool:
        """True if the leader's last state and the tokens seen here differ on which devices are there."""
        return any((rc in self._absent) == (rc in self.offered) for rc in self._rcs)

    def offer(self, rc: str, host: str, alive: bool) -> bool:
        """A host starts or stops offering a device; return True if the device appeared or disappeared with that."""
        before = rc in self.offered
        (self.offered.setdefault(rc, set()).add if alive else self.offered.get(rc, set()).discard)(host)
        if not self.offered.get(rc):
            self.offered.pop(rc, None)
        return before != (rc in self.offered)

    def rc(self, at: float, rc: str, alive: bool) -> None:
        """A device appeared or disappeared. A new device is free."""
        was = self._absent.pop(rc, None)
        if not alive and rc in self._rcs:
            self._absent[rc] = "not there"
        if not alive or rc not in self._rcs:
            self._show(at, rc, [])
        elif was is not None:
            self._draw(at, rc)

    def dropped(self, at: float, rc: str, grants: set[Grant]) -> None:
        """These holds of an RC ended, according to the RCM or the RC."""
        held = self._rcs.get(rc, {})
        if grants & held.keys():
            self._rcs[rc] = {grant: holder for grant, holder in held.items() if grant not in grants}
            self._draw(at, rc)

    def _revoked(self, at: float, revoked: Revocation, grants: Grants) -> None:
        for rc in revoked.rcs:
            if rc not in grants.rcs:
                self.dropped(at, rc, {revoked.grant})
        request = self._requests.get((revoked.client, revoked.id))
        if request is None or request.grant not in (None, revoked.grant):
            return
        request.grant = None
        match revoked.outcome:
            case "preempted":
                how = ended("preempted", self._named(revoked.reason, revoked.why), revoked.why)
                request.preempted = True
                self._set(at, request, "waiting again", f"({how})")
                by = revoked.why.by if revoked.why is not None else []
                operator = any(party.priority >= self.operator_priority for party in by)
                self.timeline.warn(at, f"{request.label} is {how}, and waits again", operator=operator)
                self.timeline.contended(at, revoked.rcs)
            case "lost":
                self._set(at, request, "waiting", revoked.reason)
                self.timeline.warn(at, f"{request.label} lost its hold: {revoked.reason}")
            case "handed_over":
                self._move(at, revoked, grants)
            case outcome:
                self._ended(at, (revoked.client, revoked.id), outcome, revoked.reason, revoked.why)

    def _move(self, at: float, revoked: Revocation, grants: Grants) -> None:
        """Continue the request at another client, in the same lane."""
        request = self._requests.pop((revoked.client, revoked.id))
        self.timeline.event(at, f"{request.label} continues in another client: {revoked.reason}")
        for holder in (holder for rc in revoked.rcs for holder in grants.rcs.get(rc, [])):
            if holder.id == revoked.id and holder.client != revoked.client and holder.arc == revoked.arc:
                self._requests[holder.client, holder.id] = request
                return
        self._labels.discard(request.label)

    def _runs(self, at: float, hold: Holder | HoldView) -> None:
        request = self._track((hold.client, hold.id), hold)
        if request is None or (request.grant == hold.grant and request.starts is (hold.waits is not None)):
            return
        begins = request.grant == hold.grant
        request.grant, request.preempted, request.starts = hold.grant, False, hold.waits is not None
        operator = hold.priority >= self.operator_priority
        who = f"{request.who} ({request.command})" if request.who and request.command else request.who
        details = [f"priority {hold.priority}", f"min {float(hold.min_runtime):g} s", *filter(None, [who])]
        if hold.waits is not None:
            details.insert(0, starting(hold.waits))
        self._set(at, request, "running", " · ".join(details), operator)
        runs = f"{request.label} runs on {', '.join(sorted(_rcs_of(hold)))}"
        if begins:
            runs = f"{request.label} is {'ready' if hold.waits is None else starting(hold.waits)}"
        self.timeline.event(at, runs, operator=operator)

    def _waits(self, at: float, request: _Request, reason: str, why: ReasonInfo | None) -> None:
        if why is not None and why.by:
            self.timeline.contended(at, why.rcs)
        detail = self._blocked(reason, why)
        state = "waiting again" if request.preempted else "waiting"
        if (request.state, request.detail) != (state, detail):
            self._set(at, request, state, detail)
            self.timeline.event(at, f"{request.label} waits{'' if waits_for_others(why) else ':'} {detail}")

    def _ended(self, at: float, key: Key, outcome: str, reason: str, why: ReasonInfo | None = None) -> None:
        request = self._requests.pop(key, None)
        if request is None:
            return
        self._labels.discard(request.label)
        self.timeline.arc(at, request.label, "done", "" if outcome == "completed" else outcome)
        level = "WARN" if outcome == "client_lost" else "INFO"
        self.timeline.event(at, f"{request.label} {ended(outcome, reason, why)}", level)

    def _track(self, key: Key, view: Holder | HoldView | WaitView | Notice) -> _Request | None:
        """Follow a request; return None if too many are open."""
        request = self._requests.get(key)
        if request is None and len(self._requests) < MAX_OPEN:
            label, number = with_person(view.arc, view.who), 1
            while label in self._labels:
                number += 1
                label = with_person(f"{view.arc}.{number}", view.who)
            self._labels.add(label)
            request = self._requests[key] = _Request(label)
        if request is not None:
            request.take_owner(view)
        return request

    def _set(self, at: float, request: _Request, state: str, detail: str, operator: bool = False) -> None:
        request.state, request.detail = state, detail
        self.timeline.arc(at, request.label, state, detail, operator=operator)

    def _blocked(self, reason: str, why: ReasonInfo | None) -> str:
        """The requests that block it, first, by the names of their lanes: a short bar shows only the beginning."""
        if why is None or why.code != ReasonCode.HELD or not why.by:
            words = self._named(reason, why)
            return words.removeprefix("waits ") if waits_for_others(why) else words
        others = dict.fromkeys(self._label(party) for party in why.by)
        patterns = why.patterns or [""] * len(why.rcs)
        wanted = [", ".join(short_names(rc for rc, pattern in zip(why.rcs, patterns, strict=False) if not pattern))]
        for need in dict.fromkeys(filter(None, patterns)):
            choices = [rc for rc, pattern in zip(why.rcs, patterns, strict=False) if pattern == need]
            wanted.append(f"one of {', '.join(short_names(choices))}" if len(choices) > 1 else choices[0])
        more = f" and {why.count - len(why.rcs)} more" if why.count > len(why.rcs) else ""
        return f"for {', '.join(others)}: {'; '.join(filter(None, wanted))}{more}"

    def _named(self, reason: str, why: ReasonInfo | None) -> str:
        return str(reason_of(why, self._label) or reason)

    def _label(self, view: Holder | HoldView | ReasonParty) -> str:
        request = self._requests.get((view.client, view.id))
        return request.label if request is not None else with_person(view.arc, view.who)

    def _show(self, at: float, rc: str, holders: Sequence[Holder | HoldView]) -> None:
        if rc not in self._rcs and len(self._rcs) >= MAX_RCS:
            return
        rows: dict[Grant, HolderRow] = {}
        for hold in holders:
            label = self._label(hold)
            robots = tuple(sorted(name for name in _rcs_of(hold) if name.startswith("robot/")))
            rows[hold.grant] = HolderRow(label, hold.priority >= self.operator_priority, robots)
        self._rcs[rc] = rows
        self._draw(at, rc)

    def _draw(self, at: float, rc: str) -> None:
        self.timeline.holders(at, rc, list(self._rcs[rc].values()), self._absent.get(rc, ""))


def _rcs_of(hold: Holder | HoldView) -> Iterable[str]:
    return hold.rcs if isinstance(hold, Holder) else hold.needs

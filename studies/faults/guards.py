"""The guards of the protocol. Each can be removed from a simulated fleet; without it, some promise must break.

Removing a guard changes a single decision, usually in one function, and leaves the rest of the fleet as it is."""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from msgspec.structs import replace

from zscout.behaviors.client import rcm_link
from zscout.behaviors.client.confirmation import Confirmations
from zscout.behaviors.client.direct import DirectHold
from zscout.behaviors.client.handover import MovableClient
from zscout.behaviors.client.rcm_link import RcmLink
from zscout.behaviors.client.request import OpenArc, RequestStore
from zscout.drivers import holds
from zscout.drivers.holds import HoldChange, HoldEntry, HoldTable
from zscout.drivers.instances import Instances
from zscout.drivers.repeated import CommandMemory
from zscout.drivers.resource_controller import ResourceController
from zscout.drivers.tolerance import Tolerance
from zscout.keyexpr import Sender
from zscout.mesh.renewal import Suspicions
from zscout.messages import BookingRecord, Holder, OpenRequest, Problem, Who
from zscout.rcm import leader, recovery, roster, terms
from zscout.rcm.admission import Admission
from zscout.rcm.authority import Authority
from zscout.rcm.leader import Leader
from zscout.rcm.operations import Operations
from zscout.rcm.places import Places
from zscout.rcm.request_log import RequestLog
from zscout.rcm.roster import Roster
from zscout.rcm.steps import Outbox
from zscout.rcm.terms import BELIEVED, Terms, Verdict
from zscout.scheduling.calendar import Calendar
from zscout.scheduling.model import Arc, ArcRequest
from zscout.scheduling.state import SchedulerState
from zscout.services.bookings import fleet_clock, records
from zscout.services.bookings.fleet_clock import FleetClock, agreed, wall_ns
from zscout.services.bookings.keeper import BookingKeeper
from zscout.services.rcm import bookings, candidate
from zscout.services.rcm.booked_dates import BookedDates
from zscout.services.rcm.booking_sharing import BookingSharing
from zscout.services.rcm.bookings import Bookings
from zscout.services.rcm.candidate import Candidate
from zscout.services.rcm.election import Election
from zscout.services.rcm.rcm import Rcm
from zscout.services.rcm.term_file import KeptTerm
from zscout.types import NO_TERM, SECOND, Grant, Ns, Term

ABSENT: Final = object()


class Guard(NamedTuple):
    what: str
    """The rule that it enforces."""
    without: Mapping[tuple[Any, str], Any]
    """Replacements by class or module and name. (`all` of a module hides Python's.)"""


def _nothing(*_: object, **__: object) -> None:
    return None


def _no_change(*_: object) -> Outbox:
    return Outbox()


def _no(*_: object, **__: object) -> bool:
    return False


def _as_listed(_self: Admission, request: ArcRequest) -> ArcRequest:
    return request


def _as_claimed(_self: Authority, _sender: Sender, who: Who | None) -> Who | None:
    return who


def _never_ns(*_: object, **__: object) -> Ns:
    return 0


def _yes(*_: object, **__: object) -> bool:
    return True


def _believe(*_: object) -> Verdict:
    return BELIEVED


def _promise(self: HoldTable, term: Term, _now: Ns, **_: object) -> bool:
    return term >= self.term


def _accept(self: HoldTable, update: Any, _change: HoldChange, now: Ns) -> bool:
    self.term, self.seq, self.last_contact = update.term, update.seq, now
    return True


_check = HoldTable.check
_remove = HoldTable._remove
_expire = HoldTable.expire
_apply_grants = HoldTable.apply_grants
_as_asked = OpenArc._as_asked
_take = OpenArc._take


def _check_any(self: HoldTable, grant: Grant, client: str, now: Ns) -> Problem | None:
    problem = _check(self, grant, client, now)
    if problem is not None and self.held and grant not in self.held:
        held = next(iter(self.held.values()))
        self.held[grant] = HoldEntry(replace(held.holder, grant=grant), held.end)
        return None
    return problem


def _forget_ended(self: HoldTable, *args: Any, **how: Any) -> None:
    _remove(self, *args, **how)
    self._ended.clear()


def _expire_by_time(self: HoldTable, now: Ns, *, lease: bool = True) -> HoldChange:
    return _expire(self, now, lease=False)


def _miss_nothing(self: HoldTable, *args: Any, **how: Any) -> HoldChange:
    change = _apply_grants(self, *args, **how)
    change.reread = False
    return change


async def _begin_first(self: ResourceController, change: HoldChange) -> None:
    for holder in change.began:
        await self._guard(self.driver.begin(holder))
    for holder in change.over:
        await self._guard(self.driver.end(holder))
    if change.removed and change.interrupts:
        await self._guard(self.driver.safe())


async def _never(*_: object) -> None:
    await asyncio.Event().wait()


async def _do_nothing(*_: object) -> None:
    pass


async def _none_async(*_: object) -> set[str]:
    return set()


def _without_place(self: OpenArc, now: Ns, grant: Grant | None) -> OpenRequest:
    return replace(_as_asked(self, now, grant), place=None)


def _take_any(self: OpenArc, *args: Any) -> bool:
    self._last = (NO_TERM, 0)
    return _take(self, *args)


def _accept_any(self: RcmLink, term: Term, **_: object) -> bool:
    self.term = max(self.term, term)
    return True


def _no_names(*_: object) -> dict[str, Any]:
    return {}


def _alone(rc: str, _states: object) -> set[str]:
    return {rc}


_confirmed = HoldTable.confirmed
_no_deadline: Final = property(lambda self: self._now() + 3600 * SECOND)


def _confirmed_once(self: HoldTable, grant: Grant, now: Ns) -> None:
    if self.held[grant].gone_by is None:
        _confirmed(self, grant, now)


_merged = records.merged


def _undated(_self: BookedDates, request: ArcRequest) -> ArcRequest:
    return request


def _newer(mine: BookingRecord, other: BookingRecord) -> BookingRecord:
    return max(mine, other, key=lambda record: record.changed)


def _unbooked_by_newer(mine: BookingRecord, other: BookingRecord) -> BookingRecord:
    return replace(_merged(mine, other), unbooked=_newer(mine, other).unbooked)


def _dates_of_newer(mine: BookingRecord, other: BookingRecord) -> BookingRecord:
    newer = _newer(mine, other)
    return replace(_merged(mine, other), dropped=newer.dropped, over=newer.over)


def _believed(mine: BookingRecord, _other: BookingRecord) -> BookingRecord:
    return mine


def _hear_any(self: BookingKeeper, grants: Any) -> None:
    if grants.time is not None:
        self._offset = wall_ns(grants.time) - self.mesh.now()


NEVER: Final = property(lambda _: False, _nothing)


async def _keep_later(self: BookingSharing, record: BookingRecord) -> str:
    self.share_soon([record])
    return ""


def _own_wall(keeper: BookingKeeper, _kept: Any) -> tuple[Ns, float]:
    return wall_ns(keeper.wall()), 0.0


def _follow(self: FleetClock, walls: Mapping[str, Ns], now: Ns, _kept: Collection[str] = ()) -> Ns:
    before = self.at(now)
    self.step(agreed(walls.values()), now)
    return self.at(now) - before


def _fastest(times: Iterable[Ns], _current: Ns | None = None, _kept: Collection[Ns] = ()) -> Ns:
    return max(times)


def _no_obstacle(*_: object) -> tuple[None, list[Any]]:
    return None, []


def _none_recovered(*_: object) -> list[Any]:
    return []


def _all_present(self: SchedulerState, _priority: int) -> int:
    return self.present


_lost_at_once: Final = property(lambda self: self.since if self.why else None)


def _at_its_end(held: Mapping[str, Holder], now: Ns) -> Ns:
    return now + max(round(holder.remaining * SECOND) for holder in held.values())


GUARDS: Final[Mapping[str, Guard]] = MappingProxyType(
    {
        "promise": Guard("an RC that answered a new leader obeys no older leader", {(HoldTable, "promise"): _promise}),
        "order": Guard("an RC obeys nothing older than it has received", {(HoldTable, "_accept"): _accept}),
        "grant": Guard("a command is obeyed under exactly the grant that is held", {(HoldTable, "check"): _check_any}),
        "ended": Guard(
            "a grant that ended at an RC does not begin again there", {(HoldTable, "_remove"): _forget_ended}
        ),
        "safe first": Guard(
            "the device is safe before its next holder begins",
            {(ResourceController, "_carry_out_change"): _begin_first},
        ),
        "missed": Guard(
            "an RC that missed a publication reads the state, and a leader corrects a report that differs",
            {(HoldTable, "apply_grants"): _miss_nothing, (Leader, "_compare"): _nothing},
        ),
        "hold lease": Guard(
            "without an RCM for the hold lease a hold ends",
            {(HoldTable, "expire"): _expire_by_time, (RcmLink, "watch_lease"): _never},
        ),
        "snapshots": Guard("additions of a snapshot pass the RC's own vote", {(ResourceController, "_carries"): _yes}),
        "once": Guard("a command that arrives again is not carried out again", {(CommandMemory, "is_new"): _yes}),
        "denied": Guard(
            "of two reported holds of an ARC, the one that its client lists counts",
            {
                (Operations, "_denied"): _nothing,
                (RequestLog, "_is_of_another"): _nothing,
                (Roster, "_is_disputed"): _nothing,
            },
        ),
        "door": Guard(
            "requests that clients list pass the same admission as new requests", {(Admission, "check"): _nothing}
        ),
        "clamped": Guard("a reported hold is clamped to its client's rights", {(Admission, "clamped"): _as_listed}),
        "certified": Guard("a sender has the name of its certificate", {(Authority, "certified_who"): _as_claimed}),
        "managers": Guard("records of bookings come from managers only", {(Authority, "may_lead"): _yes}),
        "sealed": Guard("only the client that was given a place has it", {(Places, "may_claim"): _yes}),
        "instances": Guard(
            "of two instances of an RC one serves", {(Instances, "begin"): _nothing, (Roster, "named"): _no_names}
        ),
        "whole": Guard("a new leader carries on whole gangs only", {(recovery, "all"): _yes}),
        "pending": Guard(
            "holds wait for the rest of their gang to answer",
            {(recovery, "gangs_of"): _alone, (roster, "gangs_of"): _alone},
        ),
        "majority": Guard("a candidate that RCs contradict waits", {(Election, "must_wait"): _no}),
        "deposed": Guard("a deposed candidate waits longer each time", {(Election, "deposed"): _nothing}),
        "step down": Guard("a leader that sees a higher term steps down", {(Candidate, "_weigh"): _believe}),
        "away": Guard("a leader that was away itself drops no client for it", {(Roster, "_was_away"): _no}),
        "reopen": Guard("a dropped client that lives resumes at its place", {(RequestLog, "reopens"): _no}),
        "places": Guard("a client shows the place that it had", {(OpenArc, "_as_asked"): _without_place}),
        "claims": Guard("of the ARCs that claim one place one runs", {(SchedulerState, "_is_first"): _yes}),
        "unheard": Guard(
            "a hold that had its time before its client knew is requested again",
            {(RequestStore, "_submit_under_new_id"): _nothing},
        ),
        "notices": Guard("of two notices the newer counts", {(OpenArc, "_take"): _take_any}),
        "terms": Guard(
            "a client believes nothing of an older term, except where it may go back",
            {(RcmLink, "accept"): _accept_any},
        ),
        "absurd": Guard(
            "no process believes a term far above the fleet's",
            {(holds, "absurd"): _no, (rcm_link, "absurd"): _no, (candidate, "absurd"): _no, (terms, "absurd"): _no},
        ),
        "words": Guard("with `[security]` a client's word moves no term", {(Terms, "counts"): _yes}),
        "doubted": Guard(
            "a host whose RCs alone show a term without a leader is believed once", {(Terms, "_doubted"): _never_ns}
        ),
        "sealed terms": Guard("a leader goes above the term of a sealed place", {(Places, "proves"): _no}),
        "back": Guard(
            "a client goes back to the leader that it sees",
            {(RcmLink, "_follow_lower"): _do_nothing, (RcmLink, "_only_promised"): _no},
        ),
        "kept": Guard("managers keep their highest term on disk", {(KeptTerm, "keep"): _do_nothing}),
        "handed": Guard(
            "a handed-over hold stays the old client's until the new client knows of it",
            {(MovableClient, "_awaited_by"): _none_async},
        ),
        "ids": Guard("a request that has ended is not entered again", {(RequestLog, "ended"): _no}),
        "links": Guard("a session in contradiction is reopened", {(Suspicions, "suspect"): _nothing}),
        "believed": Guard(
            "a client that believes in a hold is not sent back to the queue before its RCs could answer",
            {(RequestLog, "may_be_held"): _no},
        ),
        "beside": Guard("a hold that its RCs do not confirm ends the body", {(Confirmations, "_give_back"): _nothing}),
        "settling": Guard("an RC settles before the next holder begins", {(HoldTable, "settles"): _nothing}),
        "confirmed": Guard("an RC settles from the last confirmation on", {(HoldTable, "confirmed"): _confirmed_once}),
        "deadline": Guard("a program is gone by its deadline", {(DirectHold, "gone_by"): _no_deadline}),
        "remembered": Guard(
            "an RC that restarts settles where its last holder may be direct",
            {(HoldTable, "settle_at_start"): _nothing},
        ),
        "unbooked": Guard("a booking that was given up stays so", {(records, "merged"): _unbooked_by_newer}),
        "dates": Guard("a date that was given up, or is over, stays so", {(records, "merged"): _dates_of_newer}),
        "merged": Guard("a host's copy is one source among all", {(records, "merged"): _believed}),
        "copied": Guard("a booking is acknowledged when another host has it", {(BookingSharing, "keep"): _keep_later}),
        "caught up": Guard(
            "a host that comes later receives all facts",
            {(BookingSharing, "_on_token"): _nothing, (BookingSharing, "_behind"): NEVER},
        ),
        "late": Guard("a late publication turns no clock back", {(BookingKeeper, "observe"): _hear_any}),
        "fleet time": Guard("a leader continues the fleet's time", {(bookings, "_time"): _own_wall}),
        "steady": Guard(
            "fleet time moves only where most clocks differ from it by more than 2 s",
            {(FleetClock, "correct"): _follow},
        ),
        "most clocks": Guard("fleet time moves to the time of most clocks", {(fleet_clock, "agreed"): _fastest}),
        "dates first": Guard(
            "a leader knows of all dates before it grants",
            {(Bookings, "recovered"): _none_recovered, (Rcm, "enter"): _do_nothing},
        ),
        "one stands": Guard(
            "of two bookings that exclude each other only one counts", {(Calendar, "_obstacle"): _no_obstacle}
        ),
        "awaited": Guard(
            "an ARC that has taken up a date does not begin before it", {(BookedDates, "dated"): _undated}
        ),
        "had again": Guard(
            "an ARC that has taken up a date gets it back once possible", {(Calendar, "_offer"): _nothing}
        ),
        "budget": Guard(
            "an ARC that has spent its budget is preempted by operators only", {(Arc, "protected_below"): _nothing}
        ),
        "protected": Guard(
            "a protected hold stays protected under the next leader", {(recovery, "_protected_from"): _at_its_end}
        ),
        "begun": Guard("a hold's time begins when its devices have begun", {(leader, "beginnings"): _none_recovered}),
        "begun heard": Guard(
            "an RC ends no hold by time that waits for another device", {(HoldTable, "_retime"): _nothing}
        ),
        "tolerated": Guard("a device that is unwell keeps its holder", {(Tolerance, "lost_at"): _lost_at_once}),
        "unwell": Guard("operators alone are granted an unwell device", {(SchedulerState, "open_to"): _all_present}),
        "withdrawn": Guard(
            "a hold that no client asks for is given back",
            {(RcmLink, "give_back"): _do_nothing, (Roster, "ask_requests"): _no_change},
        ),
    }
)


@contextmanager
def without(name: str | None) -> Iterator[None]:
    """Remove a guard in this process."""
    put_back: list[tuple[Any, str, Any]] = []
    try:
        for (owner, attribute), instead in GUARDS[name].without.items() if name is not None else ():
            put_back.append((owner, attribute, vars(owner).get(attribute, ABSENT)))
            setattr(owner, attribute, instead)
        yield
    finally:
        for owner, attribute, before in put_back:
            if before is ABSENT:
                delattr(owner, attribute)
            else:
                setattr(owner, attribute, before)

"""Recovers holds and requests when a new RCM takes the lead, from the answers of RCs and clients; and adopts the holds
of RCs that join later. Pure.

RCs know the holds, clients their requests and places. A hold is recovered if all RCs of its gang report it under the
same grant; if one of them reports that it does not hold it, the gang is broken, and its request queued again with its
place. While an RC of the gang has not answered, the others are pending (`roster.py`). A hold that its client no longer
lists is not recovered: the client released it while there was no leader.

With certificates an RC is trusted for the grant, its RCs and the remaining time; its client for the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from itertools import islice
from operator import attrgetter
from typing import Final, NamedTuple, TypeAlias

from msgspec.structs import replace

from zscout.keyexpr import NAME, BadName, check_name, check_need, check_rc, client_of, is_pattern, matcher
from zscout.messages import (
    MAX_ERROR,
    BookingRecord,
    ClientRequests,
    Holder,
    OpenRequest,
    Problem,
    RcState,
    Refused,
    duration,
    exact_amounts,
)
from zscout.rcm.admission import Admission, Admitted, binding
from zscout.rcm.authority import Authority
from zscout.rcm.places import arc_id, request_id
from zscout.scheduling.model import Adopted, ArcRequest, ArcStatus, RecoveredHold, Released, Requested, Vouched
from zscout.types import NO_TERM, SECOND, ArcId, ClientId, Grant, HostName, Need, Ns, Params, Place, RcName

LONGEST_LEASE: Final[Ns] = 60 * SECOND
"""The hold lease that bounds the time to begin which an RC reports."""
REMOVED: Final = "the fleet file, which names its owner under no role"


class RefusedRequest(NamedTuple):
    """A listed request that is refused, as an Ask would be."""

    arc: ArcId
    name: str
    problem: Problem


@dataclass(slots=True)
class RecoveredState:
    """The results of a takeover: the RCs that promised, holds, queue."""

    rcs: dict[str, RcState] = field(default_factory=dict)
    pending: list[RcState] = field(default_factory=list)
    """RCs that hold ARCs together with RCs which have not answered, and which may answer a little later."""
    patient: bool = False
    """True if links may be returning, so that those others have a lease to answer, with or without tokens."""
    given_up: set[ArcId] = field(default_factory=set)
    """ARCs of pending RCs that their clients no longer list."""
    holds: list[RecoveredHold] = field(default_factory=list)
    waiting: list[Requested] = field(default_factory=list)
    expected: dict[str, set[ClientId]] = field(default_factory=dict)
    """By request id: the clients that expect it to be handed over to them."""
    believed: dict[ArcId, tuple[Grant, Sequence[RcName]]] = field(default_factory=dict)
    """By waiting ARC: the grant in which its client believes, and its RCs. They may not have answered yet."""
    answered: set[ClientId] = field(default_factory=set)
    """The clients that have listed their requests."""
    charged: Mapping[str, float] = field(default_factory=dict)
    """Recent usage per group, as the previous leader published it (`fair_shares.py`)."""
    patience: Ns | None = None
    """As the previous leader published it."""
    refused: list[RefusedRequest] = field(default_factory=list)
    booked: set[str] = field(default_factory=set)
    """Dates of bookings that only RCs report as taken up: they do not lapse meanwhile."""
    remarks: list[str] = field(default_factory=list)
    """For the log."""


def aged(state: RcState, by: Ns) -> RcState:
    """The answer that an RC gave `by` ago, with its times as of now."""
    return replace(state, holders=[_aged(holder, by / SECOND) for holder in state.holders])


def _aged(holder: Holder, by: float) -> Holder:
    if holder.waits is None:
        return replace(holder, remaining=holder.remaining - by)
    protected = None if holder.protected_from is None else holder.protected_from + by
    return replace(holder, waits=max(0.0, holder.waits - by), protected_from=protected)


def begin_within(state: RcState) -> Ns | None:
    """The longest time from a grant until an RC has begun, without settling; None: the RC does not report it."""
    return None if state.begin_within is None else round(state.begin_within * SECOND)


def longest_begin(state: RcState, hold_lease: Ns) -> Ns:
    return (begin_within(state) or 0) + hold_lease + round((state.settle or 0) * SECOND)


def take_over(
    states: Iterable[RcState],
    clients: Collection[ClientRequests],
    now: Ns,
    admission: Admission,
    home_of: Callable[[RcName], HostName | None] = lambda _: None,
    record_of: Callable[[str], BookingRecord | None] = lambda _: None,
) -> RecoveredState:
    """Recover the state for a new leader. RCs whose gangs have not all answered are `pending`: their holds are not
    decided. `home_of`: an RC's host by the fleet file; an RC free elsewhere joins later: its device may be in use."""
    states = [state for state in states if state.holders or home_of(state.rc) in (None, state.host)]
    # Of two instances of an RC, name the instance with the newest hold, else the one at home.
    by_host = sorted(states, key=attrgetter("host", "instance"), reverse=True)
    by_host.sort(key=lambda state: state.host == home_of(state.rc))
    answered = {state.rc: state for state in sorted(by_host, key=_newest_grant)}
    pending = {rc for rc in answered if not gangs_of(rc, answered) <= answered.keys()}
    admitted = [state for rc, state in answered.items() if rc not in pending]
    held = [holder for rc in sorted(pending) for holder in answered[rc].holders]
    undecided = {(arc_id(holder.client, holder.id), holder.grant) for holder in held}
    result = recover(admitted, clients, now, admission, record_of, undecided=undecided)
    result.pending = [answered[rc] for rc in sorted(pending)]
    listed = {answer.client: {request.id for request in answer.requests} for answer in clients}
    result.given_up = {
        arc_id(holder.client, holder.id) for holder in held if holder.id not in listed.get(holder.client, {holder.id})
    }
    return result


def _newest_grant(state: RcState) -> Grant:
    return max((holder.grant for holder in state.holders), default=Grant(NO_TERM, 0))


def gangs_of(rc: RcName, states: Mapping[RcName, RcState]) -> set[RcName]:
    """The RCs that hold ARCs together with it, directly or through others, and itself."""
    found, left = set[RcName](), {rc}
    while left:
        member = left.pop()
        found.add(member)
        if member in states:
            left |= {other for holder in states[member].holders for other in holder.rcs} - found
    return found


class Listed(NamedTuple):
    """A valid request in its client's words, with a place and a booking only if they are its own."""

    request: ArcRequest
    place: Place | None
    expects: bool = False
    """True if it has no place yet: its Ask was not answered, or another client hands it over."""
    waited: float = 0.0
    grant: Grant | None = None
    """The grant in which its client believes."""
    rcs: Sequence[RcName] = ()
    """The RCs of that grant."""
    problem: Problem | None = None
    """The reason that it may not have its place or booking."""


def _listed(
    result: RecoveredState,
    clients: Iterable[ClientRequests],
    admission: Admission,
    record_of: Callable[[str], BookingRecord | None],
) -> dict[ArcId, Listed]:
    """The valid requests, at most as many per client as it may have open. Notes the others in `result`."""
    found, most = dict[ArcId, Listed](), admission.limits.max_requests_per_client
    for answer in clients:
        if len(answer.requests) > most:
            result.remarks.append(f"{answer.client} lists {len(answer.requests)} requests: only {most} are read")
        for request in islice(answer.requests, most):
            try:
                client_of(answer.client)
                check_name(request.id, "id")
                listed = listed_by(answer.client, request, admission, record_of)
                found[listed.request.arc] = listed
            except Refused as refused:
                name = request.arc if NAME.fullmatch(request.arc) else request.id
                result.refused.append(RefusedRequest(arc_id(answer.client, request.id), name, refused.problem))
            except BadName as error:
                result.remarks.append(f"ignored a listed request: {error}")
    return found


def listed_by(
    client: ClientId, asked: OpenRequest, admission: Admission, record_of: Callable[[str], BookingRecord | None]
) -> Listed:
    """The listed request with the place and booking that its client may have. Raises Refused."""
    sender = client_of(client)
    request, place, problem = admission.form(asked, sender), None, None
    try:
        place = admission.listed_place(asked, client)
        if asked.booking:
            record = record_of(asked.booking.partition("@")[0])
            request = replace(request, booking=admission.listed_booking(asked, sender, record))
    except Refused as refused:
        problem = refused.problem
    return Listed(request, place, asked.place is None, asked.waited, asked.grant, asked.rcs, problem)


def _admit_waiting(
    result: RecoveredState,
    listed: Mapping[ArcId, Listed],
    held_places: Collection[tuple[Place, str]],
    undecided: Collection[tuple[ArcId, Grant | None]],
    now: Ns,
    admission: Admission,
) -> None:
    """Admit the waiting requests as Asks, the earliest places first. `held_places`: places and ids of recovered holds.
    `undecided`: holds of pending RCs, which may continue; their requests are clamped instead."""
    admitted, running = Admitted(), {held.request.arc for held in result.holds}
    for held in result.holds:
        admitted.add(held.request, waits=False)
    waiting = [known for arc, known in listed.items() if arc not in running]
    for known in sorted(waiting, key=lambda known: (known.place is None, known.place or ())):
        request = known.request
        if known.expects:
            result.expected.setdefault(request_id(request.arc), set()).add(request.client)
        elif (known.place, request_id(request.arc)) not in held_places:
            # Otherwise it was handed over, and this client missed the answer: the hold that RCs report counts.
            try:
                if known.problem is not None:
                    raise Refused.by(known.problem)
                if (request.arc, known.grant) in undecided:
                    request = admission.clamped(request)
                else:
                    admission.check(request, admitted)
            except Refused as refused:
                result.refused.append(RefusedRequest(request.arc, request.label, refused.problem))
                continue
            admitted.add(request, waits=True)
            result.waiting.append(Requested(request, known.place, now - round(known.waited * SECOND)))
            if known.grant is not None:
                result.believed[request.arc] = known.grant, known.rcs


_Reported: TypeAlias = tuple[ArcId, Grant, tuple[RcName, ...]]


def recover(
    states: Iterable[RcState],
    clients: Collection[ClientRequests],
    now: Ns,
    admission: Admission,
    record_of: Callable[[str], BookingRecord | None] = lambda _: None,
    known: Callable[[ArcId], ArcStatus | None] = lambda _: None,
    undecided: Collection[tuple[ArcId, Grant | None]] = (),
) -> RecoveredState:
    """Combine the answers, without malformed parts. `known`: open ARCs; `undecided`: holds of pending RCs."""
    result = RecoveredState(rcs={state.rc: state for state in states})
    result.answered = {answer.client for answer in clients}
    listed = _listed(result, clients, admission, record_of)
    parts: dict[_Reported, dict[RcName, Holder]] = {}
    for state in result.rcs.values():
        for holder in state.holders:
            # With certificates, an RC is believed for exactly the gang that it reports, if it is part of it.
            gang = tuple(sorted({*holder.rcs})) if admission.closed else ()
            if not admission.closed or state.rc in gang:
                parts.setdefault((arc_id(holder.client, holder.id), holder.grant, gang), {})[state.rc] = holder

    def believed(reported: _Reported) -> tuple[bool, Grant]:
        """The sort key: the hold that the client lists comes first, as any node may report another; else the newest."""
        arc, grant, gang = reported
        own = listed.get(arc)
        return bool(gang) and own is not None and own.grant == grant and {*own.rcs} in ({*gang}, set()), grant

    seen, places = set[ArcId](), set[tuple[Place, str]]()
    for reported, held in sorted(parts.items(), key=lambda item: believed(item[0]), reverse=True):
        arc, grant, _ = reported
        if arc in seen:
            continue
        if grant.term >= admission.places.term:
            result.remarks.append(f"the hold of {arc} is not recovered: its grant is of no earlier term")
            continue
        seen.add(arc)
        # An RC of an old version reports no patterns.
        some, own = max(held.values(), key=lambda holder: len(holder.bound)), listed.get(arc)
        if own is None and some.client in result.answered:
            result.remarks.append(f"{arc} is given up by its client")
            continue
        if own is None and (status := known(arc)) is not None and status.vouched:
            own = Listed(status.request, status.place)
        try:
            hold = _hold(arc, held, some, own, now, admission, _waits(held, result.rcs, now))
        except (BadName, ValueError) as error:
            result.remarks.append(f"the hold of {arc} is not recovered: {str(error)[:MAX_ERROR]}")
            continue
        # An absent RC does not break the gang here: the core ends such a hold, and names the RC that was lost.
        whole = all(name in held or name not in result.rcs for name in some.rcs)
        if whole and hold is not None:
            result.holds.append(hold)
            if hold.vouched:
                places.add((some.place, some.id))
            elif some.booking:
                result.booked.add(some.booking)
        elif hold is not None and not admission.closed and (own is None or own.expects):
            result.waiting.append(Requested(hold.request, some.place))
            listed.pop(arc, None)
    _admit_waiting(result, listed, places, undecided, now, admission)
    result.waiting.sort(key=lambda asked: (asked.place is None, asked.place))
    return result


def _hold(
    arc: ArcId,
    held: Mapping[RcName, Holder],
    some: Holder,
    own: Listed | None,
    now: Ns,
    admission: Admission,
    waits: Mapping[RcName, Ns | None],
) -> RecoveredHold | None:
    """The hold that these RCs report, with its client's request (`own`), if listed; `some`: the fullest report. None:
    the client requests something else. Raises BadName, ValueError."""
    left = round(min(holder.remaining for holder in held.values()) * SECOND)
    end = max([now, *filter(None, waits.values())]) + left
    direct = any(holder.direct for holder in held.values()) or (own is not None and own.request.direct)
    bound: Mapping[Need, RcName] = some.bound
    place: Place | None = some.place
    if not admission.closed:
        needs = _needs(held, some, own, _patterns(some))
        request = _reported_request(arc, some, needs, admission.authority, direct=direct)
    elif own is None:
        for rc in some.rcs:
            check_rc(rc)
        some = replace(some, continues="", booking="", who=None)
        needs, bound, place = _needs(held, some, None, {}), {}, None
        request = _reported_request(arc, some, needs, admission.authority, direct=direct)
    else:
        found = binding(own.request.needs, some.rcs, bound)
        if found is None or not _agree(own.request.needs, found, held):
            return None
        request, bound = replace(own.request, direct=direct), found
        place = some.place if own.expects else own.place
    request = admission.clamped(request)
    vouched = not admission.closed or own is not None
    runtime = _runtime(held, request)
    start, protected = min(now, end - (runtime or request.min_runtime)), _protected_from(held, now)
    return RecoveredHold(request, place, some.grant, start, end, bound, vouched, protected, waits, runtime)


def _runtime(held: Mapping[RcName, Holder], request: ArcRequest) -> Ns | None:
    """The minimum runtime of a hold, if it is longer than its request's."""
    reported = max((holder.runtime for holder in held.values() if holder.runtime is not None), default=0.0)
    runtime = min(round(reported * SECOND), request.until_done)
    return runtime if runtime > request.min_runtime else None


def _waits(held: Mapping[RcName, Holder], states: Mapping[RcName, RcState], now: Ns) -> dict[RcName, Ns | None]:
    """The RCs that have not begun, with the latest time of their begin; empty if an RC's version does not report it."""
    if any(states[rc].begin_within is None for rc in held):
        return {}
    most = {rc: longest_begin(states[rc], LONGEST_LEASE) for rc in held}
    waits = {rc: holder.waits for rc, holder in held.items() if holder.waits is not None}
    return {rc: now + min(round(left * SECOND), most[rc]) for rc, left in waits.items()}


def _protected_from(held: Mapping[RcName, Holder], now: Ns) -> Ns | None:
    protected = [
        round((holder.remaining - holder.protected_from) * SECOND)
        for holder in held.values()
        if holder.protected_from is not None
    ]
    return now + max(protected) if protected else None


def _agree(needs: Mapping[Need, Params], bound: Mapping[Need, RcName], held: Mapping[RcName, Holder]) -> bool:
    by_rc = _by_rc(needs, bound)
    return all(exact_amounts(holder.params) == by_rc[rc] for rc, holder in held.items())


def _by_rc(needs: Mapping[Need, Params], bound: Mapping[Need, RcName]) -> dict[RcName, Params]:
    return {bound.get(need, need): params for need, params in needs.items()}


def _needs(
    held: Mapping[RcName, Holder], some: Holder, own: Listed | None, patterns: Mapping[RcName, Need]
) -> dict[Need, Params]:
    needs: dict[Need, Params] = {patterns.get(name, name): {} for name in some.rcs}
    """The needs of a hold, from the client's list and the RCs' reports."""
    reported = {rc: exact_amounts(holder.params) for rc, holder in held.items()}
    # Only the client knows an absent RC's parameters, unless another RC meets a pattern of the same kind: patterns of
    # one kind have equal parameters.
    kinds = {_kind(patterns[rc]): params for rc, params in reported.items() if rc in patterns}
    needs |= {need: kinds[_kind(need)] for need in patterns.values() if _kind(need) in kinds}
    if own is not None:
        needs |= {need: params for need, params in own.request.needs.items() if need in needs}
    return needs | {patterns.get(rc, rc): params for rc, params in reported.items()}


def _patterns(holder: Holder) -> dict[RcName, Need]:
    """By RC: the pattern that it meets. Raises BadName, ValueError."""
    for rc in holder.rcs:
        check_rc(rc)
    for need, rc in holder.bound.items():
        if not is_pattern(check_need(need)) or rc not in holder.rcs or not matcher(need)(rc):
            raise ValueError(f"it does not hold {rc[:130]!r} for {need[:130]!r}")
    patterns = {rc: need for need, rc in holder.bound.items()}
    if len(patterns) < len(holder.bound):
        raise ValueError("one RC is reported to meet two of its patterns")
    return patterns


def _reported_request(
    arc: ArcId, holder: Holder, needs: Mapping[Need, Params], authority: Authority, *, direct: bool
) -> ArcRequest:
    """The request as an RC reports it. Raises BadName, ValueError."""
    host = client_of(holder.client).host
    min_runtime = duration(Decimal(holder.min_runtime), "min_runtime")
    check_name(holder.id, "id")
    check_name(holder.arc, "arc")
    for need in needs:
        check_need(need)
    return ArcRequest(
        arc=arc,
        client=holder.client,
        needs=needs,
        priority=holder.priority,
        min_runtime=min_runtime,
        keep=holder.keep,
        label=holder.arc,
        direct=direct,
        continues=holder.continues,
        booking=holder.booking,
        who=holder.who,
        until_done=0 if holder.runtime is None else authority.until_done(host, min_runtime),
    )


def _kind(need: str) -> str:
    return need.partition("/")[0]


def adopted(
    states: Iterable[RcState],
    joined: Collection[RcName],
    now: Ns,
    admission: Admission,
    known: Callable[[ArcId], ArcStatus | None],
) -> tuple[list[Adopted | Released], list[str]]:
    """The holds of late joiners that continue, and remarks for the log. `joined`: the RCs that count as present."""
    well = [state for state in states if state.health == "ok"]
    held = {(state.rc, holder.grant) for state in well for holder in state.holders}
    found = recover(well, [], now, admission, known=known)
    holds = [hold for hold in found.holds if all((rc, hold.grant) in held or rc not in joined for rc in hold.rcs)]
    return [*map(Adopted, holds), *removed((hold.request for hold in holds), admission)], found.remarks


def removed(requests: Iterable[ArcRequest], admission: Admission) -> list[Released]:
    gone = [request.arc for request in requests if admission.authority.is_removed(request.client)]
    return [Released(arc, REMOVED) for arc in gone]


def vouched(status: ArcStatus, own: Listed, admission: Admission) -> Vouched:
    """The event for an ARC that only RCs reported. Raises Refused if it waits, and its client may not request it."""
    if status.hold is None:
        admission.authority.check_ask(client_of(own.request.client).host, own.request, lambda _: 0)
    bound = binding(own.request.needs, status.needs, {})
    if (
        bound is not None
        and {bound.get(need, need): params for need, params in own.request.needs.items()} != status.needs
    ):
        bound = None
    return Vouched(admission.clamped(own.request), own.place, bound)

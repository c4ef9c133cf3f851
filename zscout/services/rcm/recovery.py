"""What is in force when a new RCM takes the lead, from the answers of RCs and clients. Pure.

RCs know the holds, clients their requests and places. A hold is recovered if every RC of its gang is there and holds it
under the same grant; one that an RC of the gang does not hold is broken, and queued again with its place. While an RC
of the gang has not answered, the others are pending (`roster.py`). What a client that answers does not ask for any
more is not carried on: it gave it up while nobody led."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass, field
from decimal import Decimal
from operator import attrgetter

from msgspec.structs import replace

from zscout.keyexpr import BadName, check_name, check_need, check_rc, client_of, is_pattern, matcher
from zscout.messages import Amounts, ClientRequests, Holder, OpenRequest, RcState, duration, exact_amounts
from zscout.rcm.places import arc_id, request_id
from zscout.scheduling.model import ArcRequest, RecoveredHold, Requested
from zscout.types import NO_TERM, SECOND, ArcId, ClientId, Grant, HostName, Need, Ns, Place, RcName

log = logging.getLogger(__name__)


@dataclass(slots=True)
class RecoveredState:
    """What was in force when the lead was taken: the RCs that promised, holds, queue."""

    rcs: dict[str, RcState] = field(default_factory=dict)
    pending: list[RcState] = field(default_factory=list)
    """What those RCs hold they hold together with others that have not answered, which may come a little later."""
    patient: bool = False
    """Whether links may be coming back, so that those others have a lease to answer, seen or not."""
    given_up: set[ArcId] = field(default_factory=set)
    """Of that, what its client does not ask for any more."""
    holds: list[RecoveredHold] = field(default_factory=list)
    waiting: list[Requested] = field(default_factory=list)
    expected: dict[str, set[ClientId]] = field(default_factory=dict)
    """By request id: the clients to which it is to be handed over, as they say."""
    believed: dict[ArcId, list[RcName]] = field(default_factory=dict)
    """Of what waits: the RCs that its client believes to hold. They may not have answered yet."""
    answered: set[ClientId] = field(default_factory=set)
    """The clients that have said what they ask for."""
    charged: Mapping[str, float] = field(default_factory=dict)
    """By group: what it lately had, as the leader before told (`fair_shares.py`)."""


def aged(state: RcState, by: Ns) -> RcState:
    """What an RC answered that long ago, as it would answer now."""
    return replace(state, holders=[replace(one, remaining=one.remaining - by / SECOND) for one in state.holders])


def take_over(
    states: Iterable[RcState],
    clients: Collection[ClientRequests],
    now: Ns,
    home_of: Callable[[RcName], HostName | None] = lambda _: None,
    is_own: Callable[[ClientId, OpenRequest, Place], bool] = lambda *_: True,
) -> RecoveredState:
    """What a new leader recovers. RCs whose gangs have not all answered are `pending`: their holds are not decided.
    `home_of`: the host at which the fleet file has an RC; one that is free elsewhere is taken in later, as its device
    may still be used at home. `is_own`: whether that place is this client's."""
    states = [state for state in states if state.holders or home_of(state.rc) in (None, state.host)]
    # Of two instances of one RC the one with the newest hold is meant, else the one at home.
    by_host = sorted(states, key=attrgetter("host", "instance"), reverse=True)
    by_host.sort(key=lambda state: state.host == home_of(state.rc))
    answered = {state.rc: state for state in sorted(by_host, key=_newest_grant)}
    pending = {rc for rc in answered if not gangs_of(rc, answered) <= answered.keys()}
    result = recover([state for rc, state in answered.items() if rc not in pending], clients, now, is_own)
    result.answered = {one.client for one in clients}
    result.pending = [answered[rc] for rc in sorted(pending)]
    asked = {one.client: {request.id for request in one.requests} for one in clients}
    held = [holder for state in result.pending for holder in state.holders]
    result.given_up = {arc_id(one.client, one.id) for one in held if one.id not in asked.get(one.client, {one.id})}
    return result


def _newest_grant(state: RcState) -> Grant:
    return max((holder.grant for holder in state.holders), default=Grant(NO_TERM, 0))


def gangs_of(rc: RcName, states: Mapping[RcName, RcState]) -> set[RcName]:
    """`rc`, all RCs of its gangs by `states`, and all of theirs."""
    found, left = set[RcName](), {rc}
    while left:
        one = left.pop()
        found.add(one)
        if one in states:
            left |= {other for holder in states[one].holders for other in holder.rcs} - found
    return found


def recover(
    states: Iterable[RcState],
    clients: Collection[ClientRequests],
    now: Ns,
    is_own: Callable[[ClientId, OpenRequest, Place], bool] = lambda *_: True,
) -> RecoveredState:
    """Combines the answers. What is malformed is left out and logged, and all else is recovered."""
    result = RecoveredState(rcs={state.rc: state for state in states})
    parts: dict[tuple[str, Grant], dict[RcName, Holder]] = {}
    for state in result.rcs.values():
        for holder in state.holders:
            arc = arc_id(holder.client, holder.id)
            parts.setdefault((arc, holder.grant), {})[state.rc] = holder
    asked = {arc_id(one.client, request.id): (one.client, request) for one in clients for request in one.requests}
    answered = {one.client for one in clients}
    seen: set[str] = set()
    for (arc, grant), held in sorted(parts.items(), key=lambda item: item[0][1], reverse=True):
        if arc in seen:
            continue
        seen.add(arc)
        if arc not in asked and next(iter(held.values())).client in answered:
            log.info("%s is given up by its client", arc)
            continue
        try:
            _recover_hold(result, arc, grant, held, asked.get(arc), now)
        except (BadName, ValueError) as error:
            log.warning("the hold of %s is not carried on: %s", arc, error)
    for arc, (client, request) in asked.items():
        if arc in seen:
            continue
        try:
            # A request without a place was never answered: its client will ask again.
            if request.place is None:
                result.expected.setdefault(request.id, set()).add(client)
            else:
                wanted = _request(arc, client, request.needs, request)
                since = now - round(request.waited * SECOND)
                place = request.place if is_own(client, request, request.place) else None
                result.waiting.append(Requested(wanted, place, since))
                if request.grant is not None:
                    result.believed[arc] = request.rcs
        except (BadName, ValueError) as error:
            log.warning("the request %s is not carried on: %s", arc, error)
    # A client that handed over a hold, and missed the answer, lists it as well: what the RCs hold counts.
    held_requests = {(held.place, request_id(held.request.arc)) for held in result.holds}
    result.waiting = sorted(
        (one for one in result.waiting if (one.place, request_id(one.request.arc)) not in held_requests),
        key=lambda one: (one.place is None, one.place),
    )
    left = {one.request.arc for one in result.waiting}
    result.believed = {arc: rcs for arc, rcs in result.believed.items() if arc in left}
    return result


def _recover_hold(
    result: RecoveredState,
    arc: str,
    grant: Grant,
    held: dict[RcName, Holder],
    asked: tuple[str, OpenRequest] | None,
    now: Ns,
) -> None:
    # An RC from before there were patterns passes on nothing about them.
    some = max(held.values(), key=lambda holder: len(holder.bound))
    patterns = _patterns(some)
    needs: dict[str, Amounts] = {patterns.get(name, name): {} for name in some.rcs}
    # An absent RC's parameters are known to the client only, unless another RC meets a like pattern: those
    # of one kind have all the same.
    kinds = {_kind(patterns[name]): holder.params for name, holder in held.items() if name in patterns}
    needs |= {need: kinds[_kind(need)] for need in patterns.values() if _kind(need) in kinds}
    if asked is not None:
        needs |= {need: params for need, params in asked[1].needs.items() if need in needs}
    needs |= {patterns.get(name, name): holder.params for name, holder in held.items()}
    direct = any(holder.direct for holder in held.values()) or (asked is not None and asked[1].direct)
    request = _request(arc, some.client, needs, replace(some, direct=direct))
    # The core ends a gang with an absent RC, and names what was lost; a present RC without it breaks it.
    if all(name in held or name not in result.rcs for name in some.rcs):
        end = now + round(min(holder.remaining for holder in held.values()) * SECOND)
        result.holds.append(RecoveredHold(request, some.place, grant, end - request.min_runtime, end, some.bound))
    else:
        result.waiting.append(Requested(request, some.place))


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


def _request(arc: str, client: str, needs: dict[str, Amounts], source: OpenRequest | Holder) -> ArcRequest:
    client_of(client)
    check_name(source.id, "id")
    check_name(source.arc, "arc")
    for need in needs:
        check_need(need)
    return ArcRequest(
        arc=arc,
        client=client,
        needs={need: exact_amounts(params) for need, params in needs.items()},
        priority=source.priority,
        min_runtime=duration(Decimal(source.min_runtime), "min_runtime"),
        keep=source.keep,
        label=source.arc,
        direct=source.direct,
        continues=source.continues,
        booking=source.booking,
        who=source.who,
    )


def _kind(need: str) -> str:
    return need.partition("/")[0]

"""What stands when a new RCM takes the lead, from what RCs and clients say. Pure.

RCs know the holds, clients their requests and places. A hold stands if every RC of its gang is there and
holds it under the same grant; a gang with an absent RC is broken, and queued again with its place. What a
client that answers does not ask for any more is not carried on: it gave it up while nobody led.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable
from dataclasses import dataclass, field
from decimal import Decimal

from zscout.amounts import duration, exact_amounts
from zscout.keyexpr import BadName, check_name, check_rc, client_of
from zscout.messages import Amounts, ClientRequests, Holder, OpenRequest, RcState
from zscout.scheduling.events import Standing, Waiting
from zscout.scheduling.model import SECOND, Grant, Ns, RcName, Request
from zscout.services import views

log = logging.getLogger(__name__)


@dataclass(slots=True)
class Inheritance:
    """What stood when the lead was taken: the RCs that promised, holds, queue."""

    rcs: dict[str, RcState] = field(default_factory=dict)
    standing: list[Standing] = field(default_factory=list)
    waiting: list[Waiting] = field(default_factory=list)


def rebuild(states: Iterable[RcState], clients: Iterable[ClientRequests], now: Ns) -> Inheritance:
    """Puts the answers together. What is malformed is left out and logged: nothing else suffers for it."""
    result = Inheritance(rcs={state.rc: state for state in states})
    parts: dict[tuple[str, Grant], dict[RcName, Holder]] = {}
    for state in result.rcs.values():
        for holder in state.holders:
            arc = views.arc_id(holder.client, holder.id)
            parts.setdefault((arc, holder.grant), {})[state.rc] = holder
    asked: dict[str, tuple[str, OpenRequest]] = {}
    answered: set[str] = set()
    for answer in clients:
        answered.add(answer.client)
        for request in answer.requests:
            asked[views.arc_id(answer.client, request.id)] = (answer.client, request)

    seen: set[str] = set()
    for (arc, grant), held in sorted(parts.items(), key=lambda item: item[0][1], reverse=True):
        if arc in seen:
            continue
        seen.add(arc)
        if arc not in asked and next(iter(held.values())).client in answered:
            log.info("%s is given up by its client", arc)
            continue
        try:
            _inherit_hold(result, arc, grant, held, asked.get(arc), now)
        except (BadName, ValueError) as error:
            log.warning("the hold of %s is not carried on: %s", arc, error)
    for arc, (client, request) in asked.items():
        if arc in seen:
            continue
        try:
            # A request without a place was never answered: its client will ask again.
            if request.place is not None:
                wanted = _request(arc, client, request.needs, request)
                since = now - round(request.waited * SECOND)
                result.waiting.append(Waiting(wanted, request.place, since))
        except (BadName, ValueError) as error:
            log.warning("the request %s is not carried on: %s", arc, error)
    result.waiting.sort(key=lambda one: one.place)
    return result


def _inherit_hold(
    result: Inheritance,
    arc: str,
    grant: Grant,
    held: dict[RcName, Holder],
    asked: tuple[str, OpenRequest] | None,
    now: Ns,
) -> None:
    some = next(iter(held.values()))
    # An absent RC's parameters are known to the client only.
    needs: dict[str, Amounts] = {name: {} for name in some.rcs}
    if asked is not None:
        needs |= {name: params for name, params in asked[1].needs.items() if name in needs}
    needs |= {name: holder.params for name, holder in held.items()}
    request = _request(arc, some.client, needs, some)
    # Of a gang with an absent RC the core says by name what was lost; half a gang that is all there is none.
    if all(name in held or name not in result.rcs for name in some.rcs):
        remaining = min(holder.remaining for holder in held.values())
        end = now + round(remaining * SECOND)
        result.standing.append(Standing(request, some.place, grant, end - request.min_runtime, end))
    else:
        result.waiting.append(Waiting(request, some.place))


def _request(arc: str, client: str, needs: dict[str, Amounts], said: OpenRequest | Holder) -> Request:
    client_of(client)
    check_name(said.id, "id")
    check_name(said.arc, "arc")
    for name in needs:
        check_rc(name)
    return Request(
        arc=arc,
        client=client,
        needs={name: exact_amounts(params) for name, params in needs.items()},
        priority=said.priority,
        min_runtime=duration(Decimal(said.min_runtime), "min_runtime"),
        keep=said.keep,
        label=said.arc,
    )

"""The core's model as messages: conversions, and nothing else."""

from __future__ import annotations

from collections.abc import Iterable
from decimal import Decimal
from fractions import Fraction

from zscout.messages import (
    Amounts,
    Holder,
    HoldView,
    ProposedHolder,
    RcView,
    ReasonInfo,
    ReasonParty,
    Revocation,
    WaitView,
)
from zscout.scheduling.model import ArcStatus, Hold, HoldEnded, RcStatus
from zscout.scheduling.reason import Reason
from zscout.types import SECOND, ArcId, ClientId, Ns, Params


def arc_id(client: str, request_id: str) -> ArcId:
    """The core's name of a request: unique on the mesh, as a client's own id is not."""
    return f"{client}/{request_id}"


def request_id(arc: ArcId) -> str:
    """The client's own id in an ArcId."""
    return arc.rpartition("/")[2]


def client_id(arc: ArcId) -> ClientId:
    """The client whose request it is."""
    return arc.rpartition("/")[0]


def seconds(duration: Ns) -> Decimal:
    return Decimal(duration).scaleb(-9)


def amounts(params: Params) -> Amounts:
    return {name: _decimal(value) for name, value in params.items()}


def asked(arc: ArcStatus) -> dict[str, Amounts]:
    """Its needs as they were asked for, patterns among them."""
    return {need: amounts(params) for need, params in sorted(arc.request.needs.items())}


def held(arc: ArcStatus) -> dict[str, Amounts]:
    """Its needs by the RCs that it holds."""
    return {rc: amounts(params) for rc, params in sorted(arc.needs.items())}


def holder(arc: ArcStatus, hold: Hold, rc: str, now: Ns) -> Holder:
    return Holder(
        id=request_id(arc.id),
        arc=arc.name,
        client=arc.request.client,
        grant=hold.grant,
        place=arc.place,
        rcs=sorted(arc.needs),
        min_runtime=seconds(arc.request.min_runtime),
        remaining=(hold.end - now) / SECOND,
        priority=arc.request.priority,
        keep=arc.request.keep,
        params=amounts(arc.needs[rc]),
        bound=dict(arc.bound),
    )


def holders(arcs: Iterable[ArcStatus], rc: str, now: Ns) -> list[Holder]:
    """All holders of an RC."""
    return [holder(arc, arc.hold, rc, now) for arc in arcs if arc.hold is not None]


def proposed(arc: ArcStatus, params: Params) -> ProposedHolder:
    return ProposedHolder(
        id=request_id(arc.id), arc=arc.name, client=arc.request.client, params=amounts(params)
    )


def revocation(effect: HoldEnded, name: str) -> Revocation:
    return Revocation(
        id=request_id(effect.arc),
        arc=name,
        client=effect.client,
        grant=effect.grant,
        rcs=list(effect.rcs),
        outcome=effect.outcome,
        reason=str(effect.reason),
        by=effect.by,
        why=reason_info(effect.reason),
    )


def hold_view(arc: ArcStatus, hold: Hold, now: Ns) -> HoldView:
    return HoldView(
        id=request_id(arc.id),
        arc=arc.name,
        client=arc.request.client,
        priority=arc.request.priority,
        grant=hold.grant,
        place=arc.place,
        needs=held(arc),
        min_runtime=seconds(arc.request.min_runtime),
        held=(now - hold.start) / SECOND,
        remaining=(hold.end - now) / SECOND,
        keep=arc.request.keep,
        bound=dict(arc.bound),
    )


def wait_view(arc: ArcStatus, now: Ns, start: Ns | None = None) -> WaitView:
    return WaitView(
        id=request_id(arc.id),
        arc=arc.name,
        client=arc.request.client,
        priority=arc.request.priority,
        place=arc.place,
        needs=asked(arc),
        min_runtime=seconds(arc.request.min_runtime),
        waited=(now - arc.since) / SECOND,
        reason=str(arc.reason or ""),
        preemptions=arc.preemptions,
        starts_in=None if start is None else (start - now) / SECOND,
        why=reason_info(arc.reason),
    )


def reason_info(reason: Reason | None) -> ReasonInfo | None:
    if reason is None:
        return None
    by = [ReasonParty(request_id(one.arc), one.name, client_id(one.arc), one.priority) for one in reason.by]
    return ReasonInfo(reason.code, list(reason.rcs), by, reason.detail, reason.number, reason.pattern)


def rc_views(rcs: Iterable[RcStatus]) -> list[RcView]:
    return [
        RcView(
            rc=rc.name,
            present=rc.present,
            sharable=rc.sharable,
            holders=[request_id(arc) for arc in rc.holders],
        )
        for rc in rcs
    ]


def _decimal(value: Fraction) -> Decimal:
    return Decimal(value.numerator) / Decimal(value.denominator)

"""What a request may ask for at all: the only judgement that is not the core's. Pure."""

from __future__ import annotations

from zscout.config.fleet import RcmLimits
from zscout.keyexpr import BadName, Sender, check_name, check_need
from zscout.mesh import Refused
from zscout.messages import MAX_PARAMS, Ask, Foresee
from zscout.scheduling.core import Core
from zscout.scheduling.model import ArcRequest
from zscout.scheduling.patterns import check_patterns
from zscout.types import ArcId, duration, exact_amounts

MAX_PRIORITY = 1_000_000


def admit(ask: Ask | Foresee, sender: Sender, arc: ArcId, core: Core, limits: RcmLimits) -> ArcRequest:
    """The request, if it may be made. Raises Refused with what is wrong and how to mend it."""
    if not ask.needs:
        raise Refused("bad_request", "needs is empty; name at least one RC")
    if len(ask.needs) > limits.max_needs:
        raise Refused("bad_request", f"{len(ask.needs)} needs; at most {limits.max_needs} are allowed")
    if not -MAX_PRIORITY <= ask.priority <= MAX_PRIORITY:
        raise Refused("bad_request", f"priority must lie between -{MAX_PRIORITY} and {MAX_PRIORITY}")
    place = ask.place if isinstance(ask, Ask) else None
    if place is not None and place.term > core.term:
        raise Refused("bad_request", "place is of a term that has not been; leave it out")
    if place is not None and (place.arrival < 1 or not core.given(place)):
        raise Refused("bad_request", "place was never given; leave it out")
    try:
        check_name(ask.arc, "arc")
        for name, params in ask.needs.items():
            check_need(name)
            if len(params) > MAX_PARAMS:
                raise ValueError(f"{name} has more than {MAX_PARAMS} parameters")
            for parameter in params:
                check_name(parameter, f"parameter of {name}")
        needs = {name: exact_amounts(params) for name, params in ask.needs.items()}
        check_patterns(needs)
        return ArcRequest(
            arc=arc,
            client=str(sender),
            needs=needs,
            priority=ask.priority,
            min_runtime=duration(ask.min_runtime, "min_runtime"),
            keep=ask.keep,
            label=ask.arc,
        )
    except (BadName, ValueError) as error:
        raise Refused("bad_request", str(error)) from None

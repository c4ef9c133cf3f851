"""Refuses requests whose devices are unknown, or can never do what is asked of them. Pure.

Only requests with `Ask.check` are checked: others are queued whatever they need."""

from __future__ import annotations

import difflib
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from decimal import Decimal

from zscout.keyexpr import is_pattern, matcher
from zscout.messages import Amounts, Parameters, Refused
from zscout.rcm.devices import ExpectedDevices
from zscout.rcm.roster import Roster
from zscout.types import Need, Ns, RcName

MAX_NAMED = 8
"""Parameters, or devices, in one refusal."""


class DeviceCheck:
    """Before `settles_at` an unseen RC may still show up."""

    def __init__(self, devices: ExpectedDevices, roster: Roster, settles_at: Ns) -> None:
        self._devices, self._roster, self.settles_at = devices, roster, settles_at

    def check(self, now: Ns, needs: Mapping[Need, Amounts], *, waits: bool = False, may_wait: bool = True) -> None:
        """Raises Refused for parameters that no matching RC accepts; and, unless the request `waits`, for unknown
        devices and for more RCs than match a pattern. `may_wait`: the remedy is to wait."""
        waits, expected, is_there = waits or now < self.settles_at, self._devices.names, self._roster.is_known
        wanted = Counter(need.partition("#")[0] for need in needs if is_pattern(need))
        for need, params in needs.items():
            if not params and (is_there(need) or need in expected):
                continue
            if is_pattern(need):
                matching = sorted(filter(matcher(need), expected))
            else:
                matching = [need] if need in expected or is_there(need) else []
            if not matching and not waits:
                raise _unknown(need, expected, may_wait=may_wait)
            left = [rc for rc in matching if rc not in needs]
            if is_pattern(need) and not waits and len(left) < wanted[need.partition("#")[0]]:
                raise _too_few(need.partition("#")[0], left, wanted, may_wait=may_wait)
            refusals = [_objection(rc, params, self._parameters(rc)) for rc in matching]
            # One RC that accepts the parameters is enough.
            if refusals and all(refusals):
                raise next(filter(None, refusals))

    def _parameters(self, rc: RcName) -> Parameters | None:
        state = self._roster.reported(rc)
        return state.parameters if state is not None else self._devices.parameters(rc)


def _too_few(pattern: str, left: Sequence[RcName], wanted: Mapping[str, int], *, may_wait: bool) -> Refused:
    what = (
        f"{wanted[pattern]} devices that match {pattern} are requested"
        if wanted[pattern] > 1
        else f"{pattern} is requested"
    )
    there = f"only {', '.join(left[:MAX_NAMED])}" if left else "none but those you named"
    remedy = "wait_for_device" if may_wait else ""
    return Refused("unknown_device", f"{what}, but {there} can be used; request fewer", remedy=remedy)


def _unknown(need: Need, known: Collection[RcName], *, may_wait: bool) -> Refused:
    near = difflib.get_close_matches(need, known, n=3)
    hint = f"; did you mean {' or '.join(near)}?" if near else ""
    what = f"no device matches {need}" if is_pattern(need) else f"unknown device {need}"
    if may_wait:
        return Refused("unknown_device", f"{what}{hint}", remedy="wait_for_device")
    return Refused("unknown_device", f"{what}{hint or '; zscout status lists all devices'}")


def _objection(rc: RcName, params: Amounts, parameters: Parameters | None) -> Refused | None:
    """The refusal if this RC can never accept these parameters."""
    if parameters is None:
        return None
    bounds = {parameter.name: parameter for parameter in parameters}
    for name, value in params.items():
        if name not in bounds:
            names = sorted(bounds)
            near = difflib.get_close_matches(name, names, n=1)
            more = f" and {len(names) - MAX_NAMED} more" if len(names) > MAX_NAMED else ""
            takes = f"it has {', '.join(names[:MAX_NAMED])}{more}" if names else "it has none"
            hint = f"did you mean {near[0]}?" if near else takes
            return Refused("unknown_parameter", f"{rc} has no parameter {name}; {hint}")
        limit = bounds[name]
        if limit.bound is not None and value > limit.bound and not any(other in params for other in limit.unless):
            unit = f" {limit.unit}" if limit.unit else ""
            asked = f"{name} {_text(value)} of {_text(limit.bound)}{unit} at {rc}"
            return Refused("too_much", f"can never start: {asked}; request less")
    return None


def _text(value: Decimal) -> str:
    return f"{float(value):.12g}"

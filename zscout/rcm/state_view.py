"""Answers about the state of a leader: holds, queue, devices. Pure."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final, NamedTuple

from msgspec.structs import replace

from zscout import messages
from zscout.rcm.devices import ExpectedDevices
from zscout.rcm.places import request_id
from zscout.rcm.request_log import RequestLog, reason_info
from zscout.rcm.roster import Roster
from zscout.scheduling.core import Core
from zscout.scheduling.model import ArcStatus, Hold, Status
from zscout.scheduling.runtimes import RuntimeEstimator
from zscout.types import SECOND, VERSION, HostName, Ns

MAX_LISTED: Final = 1_000
"""Queued ARCs in one answer."""
MAX_REASON: Final = 500
"""Characters of a veto's reason, and of a device's."""


STATE_AGE: Final[Ns] = SECOND // 20
"""The age at most of a cached answer (rule 20): building an answer costs as much as many grants."""
MAX_BUILT: Final = 4
"""Answers of one kind that are built within STATE_AGE while the state changes."""


class _Built(NamedTuple):
    """A cached answer. `batches`: the core's batches of events when it was built."""

    state: messages.RcmState
    encoded: bytes
    batches: int
    built: int
    """Answers of this kind built within STATE_AGE."""


class StateView:
    """Reads, and changes nothing."""

    def __init__(
        self,
        me: HostName,
        core: Core,
        roster: Roster,
        registry: RequestLog,
        devices: ExpectedDevices,
        runtimes: RuntimeEstimator | None,
    ) -> None:
        self._me, self._core, self._roster, self._registry = me, core, roster, registry
        self._devices_known, self._runtimes = devices, runtimes
        self._states: dict[messages.StateAsk, _Built] = {}
        self._since: Ns = 0

    def answer(self, asked: messages.StateAsk, seq: int, now: Ns) -> tuple[messages.RcmState, bytes | None]:
        """The answer, and its encoded form if that is cached."""
        if asked.holds_only:
            return self.state(asked, seq, now), None  # RCs compute ends of holds from this answer: never a cached one
        alike, batches = replace(asked, arc=None), self._core.batches
        if now - self._since > STATE_AGE:
            self._since = now
            self._states.clear()
        known = self._states.get(alike)
        if known is None or (known.built < MAX_BUILT and known.batches != batches):
            state = self.state(alike, seq, now)
            built = 1 if known is None else known.built + 1
            known = self._states[alike] = _Built(state, messages.encode(state), batches, built)
        if asked.arc is None:
            return known.state, known.encoded
        return replace(known.state, story=self._registry.story(now, asked.arc)), None

    def state(self, asked: messages.StateAsk, seq: int, now: Ns) -> messages.RcmState:
        term = self._roster.term
        if asked.devices_only:
            rcs = self._devices(self._core.status(0), now)
            return messages.RcmState(term, seq, self._me, rcs=rcs, version=VERSION)
        status = self._core.status(0 if asked.holds_only else MAX_LISTED)
        holds = [_hold_view(arc, arc.hold, now, self._runtimes) for arc in status.running if arc.hold is not None]
        instances = self._roster.named(sorted({rc for hold in holds for rc in hold.needs}))
        state = messages.RcmState(term, seq, self._me, holds, instances=instances, version=VERSION)
        if not asked.holds_only:
            starts = self._registry.starts(now) if asked.forecast else {}
            state = replace(
                state,
                queue=[_wait_view(arc, now, starts.get(arc.id)) for arc in status.queued],
                rcs=self._devices(status, now),
                more=status.waiting - len(status.queued),
                charged=self._core.charged(),
                patience=self._core.patience / SECOND or None,
            )
        return state

    def _devices(self, status: Status, now: Ns) -> list[messages.RcView]:
        """All RCs that are present or expected; not RCs that were requested and never offered."""
        known = {rc.name: rc for rc in status.rcs}
        devices = self._devices_known
        devices.forget_old(now)
        named = self._roster.named(known)
        there = {rc.name for rc in status.rcs if rc.present}
        views = []
        for name in sorted(there | devices.names):
            rc, state = known.get(name), self._roster.reported(name)
            view = messages.RcView(name, present=False, sharable=False)
            if rc is not None:
                view = messages.RcView(name, rc.present, rc.sharable, [*map(request_id, rc.holders)])
            if state is not None:
                reason = "" if state.health == "ok" else state.health[:MAX_REASON]
                view = replace(view, sharable=state.sharable, reason=reason, parameters=state.parameters)
            views.append(devices.view(view, now, named[name][1] if name in named else None))
        return views


def _of(arc: ArcStatus) -> dict[str, Any]:
    return {
        "id": request_id(arc.id),
        "arc": arc.name,
        "client": arc.request.client,
        "priority": arc.request.priority,
        "place": arc.place,
        "min_runtime": messages.decimal_seconds(arc.request.min_runtime),
        "who": arc.request.who,
        "booking": arc.request.booking,
    }


def _held(arc: ArcStatus, hold: Hold, now: Ns) -> dict[str, Any]:
    return {
        **_of(arc),
        "grant": hold.grant,
        "remaining": hold.remaining(now) / SECOND,
        "waits": waits_in(hold, now),
        "keep": arc.request.keep,
        "bound": dict(arc.bound),
        "direct": arc.request.direct,
        "continues": arc.request.continues,
        "protected_from": _protected_from(hold, now),
        "runtime": None if hold.runtime is None else hold.runtime / SECOND,
    }


def holders_of(arcs: Iterable[ArcStatus], rc: str, now: Ns) -> list[messages.Holder]:
    return [
        messages.Holder(**_held(arc, arc.hold, now), rcs=sorted(arc.needs), params=messages.decimals(arc.needs[rc]))
        for arc in arcs
        if arc.hold is not None
    ]


def waits_in(hold: Hold, now: Ns) -> float | None:
    """Seconds at most until all devices of a hold have begun; None: they have."""
    return None if (left := hold.starting(now)) is None else left / SECOND


def _protected_from(hold: Hold, now: Ns) -> float | None:
    # The hold's devices may begin at once, and then its minimum runtime ends first.
    end = now + hold.remaining(now)
    is_protected = hold.protected_below is not None and hold.protected_from < end
    return (end - hold.protected_from) / SECOND if is_protected else None


def _hold_view(arc: ArcStatus, hold: Hold, now: Ns, runtimes: RuntimeEstimator | None) -> messages.HoldView:
    end = None if runtimes is None else runtimes.end(arc.request, hold, now)
    return messages.HoldView(
        **_held(arc, hold, now),
        needs={rc: messages.decimals(params) for rc, params in sorted(arc.needs.items())},
        held=(now - hold.start) / SECOND,
        ends_in=None if end is None else (end - now) / SECOND,
    )


def _wait_view(arc: ArcStatus, now: Ns, start: Ns | None) -> messages.WaitView:
    return messages.WaitView(
        **_of(arc),
        needs={need: messages.decimals(params) for need, params in sorted(arc.request.needs.items())},
        waited=(now - arc.since) / SECOND,
        reason=str(arc.reason or ""),
        preemptions=arc.preemptions,
        starts_in=None if start is None else (start - now) / SECOND,
        why=reason_info(arc.reason, now),
    )

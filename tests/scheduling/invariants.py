"""What must be true whatever happens, checked from the core's effects alone, as the mesh would see them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from copy import copy
from fractions import Fraction

from msgspec.structs import replace

from tests.scheduling.oracle import Contender, Oracle
from tests.scheduling.validate import validate
from zscout.keyexpr import is_pattern, matcher
from zscout.scheduling.capacity import excess
from zscout.scheduling.core import Core
from zscout.scheduling.model import Arc, ArcRequest, Effect, Granted, Hold, HoldEnded, Outcome, Queued
from zscout.simulation.workload import WorkloadRc
from zscout.types import NO_TERM, ArcId, ClientId, Grant, Ns, Params, RcName


class Ledger:
    """Follows grants and revocations and raises `AssertionError` at the first that breaks a promise."""

    def __init__(self, rcs: Iterable[WorkloadRc], requests: Iterable[ArcRequest] = ()) -> None:
        self.capacity: dict[RcName, Mapping[str, Fraction]] = {rc.name: rc.capacity for rc in rcs if rc.sharable}
        self.requests: dict[ArcId, ArcRequest] = {request.arc: request for request in requests}
        self.open: dict[ArcId, Granted] = {}
        self.newest = Grant(NO_TERM, 0)
        self.handed_over: dict[ArcId, Granted] = {}
        """By the new names of ARCs that run: what they held under the old ones, until it is granted anew."""
        self._moves: dict[ArcId, Arc] = {}
        """What the next batch hands over: by the new name, the ARC as it was."""
        self._renamed: dict[ArcId, ArcId] = {}

    def will_move(self, core: Core, arc: ArcId, to: ClientId, renamed: ArcId) -> None:
        """The next batch will hand over `arc`."""
        self.requests[renamed] = replace(self.requests[arc], arc=renamed, client=to)
        moving = core._state.arc(arc)
        assert moving is not None
        self._moves[renamed] = copy(moving)
        self._renamed[arc] = renamed

    def take(self, now: Ns, core: Core, effects: list[Effect]) -> None:
        """Takes the effects of one batch, and compares the outcome with what the core believes."""
        validate(core)
        for number, effect in enumerate(effects):
            match effect:
                case Granted():
                    self._granted(effect)
                case HoldEnded():
                    self._revoked(now, effect, effects[number + 1 :])
                case Queued(arc=arc):
                    assert arc not in self.open, f"{arc} is told to wait while it holds"
                case _:
                    pass
        held = {arc: (hold.grant, hold.client) for arc, hold in self.open.items()}
        believed = {
            arc.id: (arc.hold.grant, arc.request.client) for arc in core._state.running.values() if arc.hold is not None
        }
        assert not self.handed_over, "handed over to nobody"
        self._check_moves(core, effects)
        assert held == believed, "the effects told do not add up to what the core holds"

    def _check_moves(self, core: Core, effects: list[Effect]) -> None:
        """Who was handed over is there under the new name, at the old place; its wait goes on."""
        granted = {effect.arc for effect in effects if isinstance(effect, Granted)}
        for renamed, before in self._moves.items():
            assert core._state.arc(before.id) is None, f"{before.id} is there under its old name"
            after = core._state.arc(renamed)
            if after is None:
                assert before.hold is not None, f"{before.id} got lost while it was handed over"
                continue
            assert (after.id, after.place) == (renamed, before.place)
            if before.hold is None and renamed not in granted:
                assert after.since == before.since
        self._moves.clear()
        self._renamed.clear()

    def holders(self, rc: RcName) -> list[ArcId]:
        return [arc for arc, hold in self.open.items() if rc in hold.rcs]

    def _granted(self, effect: Granted) -> None:
        request = self.requests[effect.arc]
        assert effect.arc not in self.open, f"{effect.arc} is granted twice"
        assert len(effect.rcs) == len(request.needs), f"{effect.arc} is granted a part of its needs"
        for need in request.needs:
            meets = matcher(need) if is_pattern(need) else need.__eq__
            assert any(map(meets, effect.rcs)), f"{effect.arc} is granted nothing for {need}"
        assert effect.grant > self.newest, "grants do not grow"
        assert (effect.end is None) == request.keep
        assert effect.end is None or effect.end == effect.start + request.min_runtime
        self.newest = effect.grant
        self.open[effect.arc] = effect
        assert not self.handed_over or effect.arc in self.handed_over, "granted amid a hand-over"
        if effect.arc in self.handed_over:
            # The same hold goes on; rules that changed meanwhile do not touch it.
            before = self.handed_over.pop(effect.arc)
            assert (effect.rcs, effect.start, effect.end) == (before.rcs, before.start, before.end)
            return
        for rc in effect.rcs:
            holders = self.holders(rc)
            if rc in self.capacity:
                shares = [(arc, _asked_of(self.requests[arc], rc)) for arc in holders]
                assert not excess(self.capacity[rc], shares), f"{rc} can't carry {holders}"
            else:
                assert holders == [effect.arc], f"{rc} has the holders {holders}"

    def _revoked(self, now: Ns, effect: HoldEnded, later: list[Effect]) -> None:
        hold = self.open.pop(effect.arc)
        assert hold.grant == effect.grant, "a hold is revoked under another grant than it was given"
        assert hold.rcs == effect.rcs, "a part of a gang is revoked"
        if effect.outcome is Outcome.HANDED_OVER:
            self.handed_over[self._renamed[effect.arc]] = hold
        request = self.requests[effect.arc]
        over = now >= hold.start + request.min_runtime
        if effect.outcome is Outcome.COMPLETED:
            assert over, f"{effect.arc} is called completed before its time"
        if effect.outcome in {Outcome.PREEMPTED, Outcome.COMPLETED, Outcome.LOST}:
            assert effect.requeued == (effect.outcome is not Outcome.COMPLETED and not over)
        if effect.by is None:
            assert effect.outcome is not Outcome.PREEMPTED, "preempted by nobody"
            return
        assert any(isinstance(one, Granted) and one.arc == effect.by for one in later), "preempted in vain"
        taker = self.requests[effect.by]
        if effect.outcome is Outcome.PREEMPTED:
            assert taker.priority > request.priority, "equal or lower priority preempts"
        else:
            assert request.keep
            assert taker.priority >= request.priority, "lower priority displaces a kept hold"


def _asked_of(request: ArcRequest, rc: RcName) -> Params:
    found = request.needs.get(rc)
    if found is not None:
        return found
    return next(params for need, params in request.needs.items() if is_pattern(need) and matcher(need)(rc))


def protection(hold: Hold) -> Ns | None:
    """As the oracle knows it."""
    return None if hold.protected_below is None else hold.protected_from


def check_settled(now: Ns, core: Core, rcs: Iterable[WorkloadRc]) -> None:
    """After a pass with no vote out: by the letter of steps 1 to 3, nobody who waits could start."""
    if core._votes.proposals:
        return
    oracle = Oracle(rcs)
    for arc in (*core._state.running.values(), *core._state.queued.values()):
        start, protected = None, None
        if arc.hold is not None:
            start, protected = arc.hold.start, protection(arc.hold)
        oracle.contenders.append(Contender(arc.request, arc.place.arrival, start, protected_from=protected))
    for one in oracle.contenders:
        if one.start is None:
            assert oracle.victims(one, now) is None, f"{one.request.arc} waits with nothing in its way"

"""The core when everything that can go wrong does: only promises hold then, and in the end all is served."""

from __future__ import annotations

from collections.abc import Mapping
from fractions import Fraction

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.scheduling.invariants import Ledger
from tests.scheduling.workloads import capacity, rcs, requests
from tests.thorough import times
from zscout.config.scheduling_policy import StrategyName
from zscout.scheduling.capacity import excess
from zscout.scheduling.core import Core
from zscout.scheduling.model import (
    Arc,
    Cancelled,
    ClientLost,
    Event,
    HandedOver,
    Propose,
    RcJoined,
    RcLost,
    RcReported,
    Reachable,
    Released,
    Requested,
    Tick,
    Unconfirmed,
    Vote,
    VoteOverdue,
    WakeAt,
)
from zscout.scheduling.strategies import STRATEGIES
from zscout.simulation.workload import WorkloadRc
from zscout.types import NO_TERM, SECOND, ArcId, ClientId, Ns, RcName, Term

OPS = (
    # The first, asked most often, make the core busy; the others disturb it.
    *["ask", "answer", "overdue", "time"] * 3,
    *["release", "cancel", "rc lost", "rc back", "rules", "rc ends", "unconfirmed", "reachable"],
    *["client lost", "hand over", "hand over all", "takeover"],
)
MAX_SETTLING_STEPS = 400
"""Far more than twelve ARCs of at most five seconds ever need; who is not served by then hangs."""


class Chaos:
    """A fleet whose votes are late or lost, and whose parts come and go."""

    def __init__(self, draw: st.DataObject, strategy: StrategyName) -> None:
        self.strategy = strategy
        self.fleet = draw.draw(rcs())
        names = [rc.name for rc in self.fleet]
        self.to_ask = [draw.draw(requests(f"a{number}", names)) for number in range(draw.draw(st.integers(1, 12)))]
        self.capacities = draw.draw(st.lists(capacity, min_size=1, max_size=4))
        self.sharable = {rc.name: rc.sharable for rc in self.fleet}
        self.present: list[RcName] = []
        self.now: Ns = 0
        self.core = self.new_core()
        self.ledger = Ledger(self.fleet, self.to_ask)
        self.waiting: list[Propose] = []
        """Proposals that may yet be answered or called overdue."""
        self.late: list[Propose] = []
        """Overdue ones; their answers may still come, or never."""
        self.wake: Ns | None = None
        self.moves = 0
        self.send(*[self.join(rc) for rc in self.fleet])

    def new_core(self) -> Core:
        return Core(STRATEGIES[self.strategy]())

    def join(self, rc: WorkloadRc) -> Event:
        self.present.append(rc.name)
        return RcJoined(rc.name, rc.sharable)

    def send(self, *events: Event) -> None:
        effects = self.core.handle(self.now, *events)
        self.ledger.take(self.now, self.core, effects)
        for effect in effects:
            if isinstance(effect, Propose):
                self.waiting.append(effect)
            elif isinstance(effect, WakeAt):
                self.wake = effect.at

    def vote(self, question: Propose) -> Vote:
        reason = excess(self.ledger.capacity[question.rc], question.holders.items())
        return Vote(question.proposal, accept=not reason, reason=reason)

    def change_rules(self, rc: RcName, rules: Mapping[str, Fraction]) -> None:
        """From now on the RC votes otherwise; questions from before are void, and never answered."""
        self.ledger.capacity[rc] = rules
        self.waiting = [one for one in self.waiting if one.rc != rc]
        self.late = [one for one in self.late if one.rc != rc]
        self.send(RcReported(rc, rules_changed=True))

    def do(self, op: str, pick: int) -> None:
        """One operation of `OPS`, on the `pick`-th of what it applies to; nothing if there is none."""
        running = sorted(self.core._state.running)
        arcs = sorted([*running, *self.core._state.queued, *self.core._state.held_back])
        absent = [rc for rc in self.fleet if rc.name not in self.present]
        voters = [name for name in self.present if self.sharable[name]]
        answerable = self.waiting + self.late
        if op == "ask" and self.to_ask:
            self.send(Requested(self.to_ask.pop()))
        elif op == "answer" and answerable:
            question = answerable[pick % len(answerable)]
            (self.waiting if question in self.waiting else self.late).remove(question)
            self.send(self.vote(question))
        elif op == "overdue" and self.waiting:
            question = self.waiting.pop(pick % len(self.waiting))
            self.late.append(question)
            self.send(VoteOverdue(question.proposal))
        elif op == "time":
            self.now += (pick % 4 + 1) * SECOND // 2
            self.send(Tick())
        elif op == "release" and running:
            self.send(Released(running[pick % len(running)]))
        elif op == "cancel" and arcs:
            self.send(Cancelled(arcs[pick % len(arcs)]))
        elif op == "rc lost" and self.present:
            self.send(RcLost(self.present.pop(pick % len(self.present))))
        elif op == "rc back" and absent:
            self.send(self.join(absent[pick % len(absent)]))
        elif op == "rules" and voters:
            self.change_rules(voters[pick % len(voters)], self.capacities[pick % len(self.capacities)])
        elif op == "rc ends" and running:
            arc = running[pick % len(running)]
            self.send(RcReported(min(self.ledger.requests[arc].needs), ended=(arc,)))
        elif op == "unconfirmed" and running:
            held = self.core._state.running[running[pick % len(running)]]
            assert held.hold is not None
            self.send(Unconfirmed(held.id, held.hold.grant, (min(held.needs),)))
        elif op == "reachable" and arcs:
            self.send(Reachable(arcs[pick % len(arcs)]))
        elif op == "client lost":
            self.send(ClientLost(f"host/{pick % 3}"))
        elif op == "hand over" and arcs:
            self.send(self.hand_over(arcs[pick % len(arcs)], f"host/{(pick + 1) % 3}"))
        elif op == "hand over all":
            theirs = self.core.arcs_of(f"host/{pick % 3}")
            self.send(*[self.hand_over(arc, f"host/{(pick + 1) % 3}") for arc in theirs])
        elif op == "takeover":
            self.take_over()

    def hand_over(self, arc: ArcId, to: ClientId) -> Event:
        self.moves += 1
        renamed = f"{arc.partition('.')[0]}.{self.moves}"
        self.ledger.will_move(self.core, arc, to, renamed)
        return HandedOver(arc, to, renamed)

    def take_over(self) -> None:
        """The RCM dies with all it knew of votes; the next one hears of every hold and request."""
        old, before = self.core, dict(self.ledger.open)
        term = Term(old.term.counter + 1, "rcm/b") if old.term != NO_TERM else Term(1, "rcm/a")
        self.core, self.waiting, self.late = self.new_core(), [], []
        _, lead = old.as_events(term)
        joins = [RcJoined(name, self.sharable[name]) for name in self.present]
        self.send(*joins, lead)
        # The next RCM does not know whose RCs did not confirm: they may start now, and preempt by their rank.
        starts = old._state.held_back.keys() & self.ledger.open.keys()
        if not starts:
            assert self.ledger.open == before, "a change of RCM disturbed somebody"
        taken = {need for arc in starts for need in self.ledger.requests[arc].needs}
        for arc, grant in before.items():
            undisturbed = self.ledger.open.get(arc) == grant or taken & self.ledger.requests[arc].needs.keys()
            assert undisturbed, "a change of RCM disturbed somebody"

    def settle(self) -> None:
        """All is well again: RCs are back, questions are answered (those overdue never), time goes on."""
        self.send(*[self.join(rc) for rc in self.fleet if rc.name not in self.present])
        self.late = []
        while self.to_ask:
            self.send(Requested(self.to_ask.pop()))
        state = self.core._state
        for _ in range(MAX_SETTLING_STEPS):
            waiting = [*state.queued.values(), *state.held_back.values()]
            if self.waiting:
                self.send(self.vote(self.waiting.pop()))
            elif not waiting:
                return
            elif any(arc.request.keep and arc.past_min_runtime(self.now) for arc in state.running.values()):
                kept = [arc for arc in state.running.values() if arc.past_min_runtime(self.now)]
                self.send(*[Released(arc.id) for arc in kept])
            elif all(self.unservable(arc) for arc in waiting):
                return
            else:
                assert self.wake is not None, "somebody waits, and nothing is to happen"
                self.now = max(self.now, self.wake)
                self.send(Tick())
        left = {arc.id: arc.reason for arc in waiting if not self.unservable(arc)}
        raise AssertionError(f"never served: {left}")

    def unservable(self, arc: Arc) -> bool:
        """Whether it needs an RC that is not there, or more than an RC can give to it alone."""
        for rc, share in arc.request.needs.items():
            if rc not in self.present:
                return True
            if self.sharable[rc] and excess(self.ledger.capacity[rc], [(arc.id, share)]):
                return True
        return False


@pytest.mark.parametrize("strategy", STRATEGIES)
@settings(max_examples=times(40))
@given(st.data(), st.lists(st.tuples(st.sampled_from(OPS), st.integers(0, 11)), max_size=60))
def test_promises_hold_in_any_chaos_and_in_the_end_all_are_served(
    strategy: StrategyName, draw: st.DataObject, ops: list[tuple[str, int]]
) -> None:
    chaos = Chaos(draw, strategy)
    for op, pick in ops:
        chaos.do(op, pick)
    chaos.settle()

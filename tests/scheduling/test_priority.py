"""Strategy `priority` against the oracle: the same holds to the nanosecond, whenever the votes come."""

from __future__ import annotations

from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.scheduling import oracle
from tests.scheduling.invariants import Ledger, check_settled
from tests.scheduling.workloads import voter, workloads
from tests.services.recorder.paper_run import TABLE2, table1
from tests.thorough import times
from zscout.scheduling.core import Core
from zscout.scheduling.model import Effect, Event, Granted, HoldEnded, Propose, RcJoined, Released, Requested, Tick
from zscout.simulation.replay import HoldRecord, Replay, replay
from zscout.simulation.workload import Workload
from zscout.types import SECOND, ArcId, Ns


class SlowPlayer:
    """Plays a workload with each event a batch of its own, and each vote too, in an order drawn at random.

    With `linger`, votes may come after later events of their instant; without, before any other event."""

    def __init__(self, workload: Workload, order: Random, *, linger: bool) -> None:
        self.workload, self.order, self.linger = workload, order, linger
        self.core = Core()
        self.ledger = Ledger(workload.rcs, [arrival.request for arrival in workload.arrivals])
        self.out: list[Propose] = []
        self.holds: list[HoldRecord] = []
        self.open: dict[ArcId, Granted] = {}

    def play(self) -> Replay:
        for rc in self.workload.rcs:
            self.send(0, RcJoined(rc.name, rc.sharable))
        runtimes = {arrival.request.arc: arrival.request.min_runtime for arrival in self.workload.arrivals}
        arrivals = sorted(self.workload.arrivals, key=lambda arrival: arrival.at)
        now: Ns = 0
        while arrivals or self.open:
            times = [hold.start + runtimes[hold.arc] for hold in self.open.values()]
            times = [at for at in times if at > now] + [arrival.at for arrival in arrivals[:1]]
            if times:
                now = min(times)
                asked = [arrival for arrival in arrivals if arrival.at == now]
                arrivals = arrivals[len(asked) :]
                events: list[Event] = [Requested(arrival.request) for arrival in asked]
                for event in events or [Tick()]:
                    self.send(now, event)
                    self.deliver(now, everything=not self.linger)
            else:
                self.send(now, *[Released(arc) for arc in sorted(self.open)])
            self.deliver(now, everything=True)
            check_settled(now, self.core, self.workload.rcs)
        asked_for = {arrival.request.arc for arrival in self.workload.arrivals}
        served = {hold.arc for hold in self.holds if hold.outcome.value == "completed"}
        holds = sorted(self.holds, key=lambda hold: (hold.start, hold.arc, hold.end))
        return Replay(tuple(holds), tuple(sorted(asked_for - served)))

    def deliver(self, now: Ns, *, everything: bool) -> None:
        while self.out and (everything or self.order.random() < 0.5):
            self.send(now, voter(self.workload)(self.out.pop(self.order.randrange(len(self.out)))))

    def send(self, now: Ns, *events: Event) -> None:
        effects = self.core.handle(now, *events)
        self.ledger.take(now, self.core, effects)
        for effect in effects:
            if isinstance(effect, Propose):
                self.out.append(effect)
            elif isinstance(effect, Granted):
                self.open[effect.arc] = effect
            elif isinstance(effect, HoldEnded):
                start = self.open.pop(effect.arc).start
                self.holds.append(HoldRecord(effect.arc, start, now, effect.outcome, effect.rcs))


@pytest.mark.essential
def test_table_1_of_the_paper_gives_its_table_2() -> None:
    holds = replay(table1()).holds
    shown = {
        rc: " ".join(
            "".join(hold.arc[3:] for hold in holds if rc in hold.rcs and hold.start <= at * SECOND < hold.end) or "-"
            for at in range(18)
        )
        for rc in TABLE2
    }
    assert shown == TABLE2


@settings(max_examples=times(50))
@given(workloads())
def test_replay_is_the_oracle_exactly(workload: Workload) -> None:
    ledger = Ledger(workload.rcs, [arrival.request for arrival in workload.arrivals])

    def watch(now: Ns, core: Core, effects: list[Effect]) -> None:
        ledger.take(now, core, effects)
        check_settled(now, core, workload.rcs)

    assert replay(workload, watch) == oracle.play(workload)
    assert not ledger.open


@settings(max_examples=times(50))
@given(workloads(), st.randoms(use_true_random=False))
def test_votes_one_by_one_in_any_order_give_the_oracles_outcome(workload: Workload, order: Random) -> None:
    assert SlowPlayer(workload, order, linger=False).play() == oracle.play(workload, one_by_one=True)


@settings(max_examples=times(60))
@given(workloads(), st.randoms(use_true_random=False))
def test_votes_that_outlast_later_events_of_their_instant(workload: Workload, order: Random) -> None:
    """Ranks may then overtake, so only promises and the settled state are compared, and who is served."""
    played = SlowPlayer(workload, order, linger=True).play()
    assert played.unserved == oracle.play(workload).unserved

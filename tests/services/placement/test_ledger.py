"""What a candidate keeps of the placer's publications, from one candidacy to the next."""

from __future__ import annotations

import asyncio

from tests.mesh.kit import until
from tests.services.placement.kit import JOB, PlacerFleet
from zscout.keyexpr import Role, Token
from zscout.mesh.supervision import Supervisor
from zscout.messages import DrainHost, PlaceComponent, Placement, Placements
from zscout.services.placement.ledger import PlacementLedger


async def test_a_ledger_that_comes_late_catches_up_and_keeps_what_it_has_when_its_candidate_stands_again() -> None:
    fleet = PlacerFleet("a", "b")
    await fleet.lead()
    leads = fleet.leader.alive(Token("leader", Role.RCM, "rcm", "i1"))
    await fleet.ask(PlaceComponent("first", JOB), Placement)
    await fleet.ask(DrainHost("b"), Placements)
    ledger = PlacementLedger(fleet.mesh("heir"))
    supervisor = Supervisor("the candidate", fleet.failures.append)
    ledger.start(supervisor)
    await until(lambda: ledger.inherited().components)
    await fleet.ask(PlaceComponent("second", JOB), Placement)
    await until(lambda: len(ledger.inherited().components) == 2)
    assert {one.state for one in ledger.inherited().components} == {"running"}
    assert ledger.inherited().cordoned == {"b"}
    # While it does not stand, one fails; then its candidate stands again.
    ledger.stop()
    supervisor.cancel()
    fleet.nodes["a"].end("first", 1001, "failed")
    await until(lambda: fleet.published[-1].restarts == 1)
    await asyncio.sleep(1)
    assert {one.restarts for one in ledger.inherited().components} == {0}
    ledger.start(Supervisor("the candidate", fleet.failures.append))
    await until(lambda: sorted(one.restarts for one in ledger.inherited().components) == [0, 1])
    ledger.stop()
    leads.close()
    assert fleet.failures == []


async def test_the_next_placer_carries_on_what_was_published() -> None:
    fleet = PlacerFleet("a", "b")
    placer = await fleet.lead()
    ledger = PlacementLedger(fleet.mesh("heir"))
    ledger.start(Supervisor("the candidate", fleet.failures.append))
    placed = await fleet.ask(PlaceComponent("counter", JOB), Placement)
    await until(lambda: ledger.inherited().components)
    placer.stop()
    # Its host dies with the leader: nobody but the ledger knows of it.
    fleet.network.kill(fleet.nodes.pop(placed.host or "").mesh)
    await until(lambda: len(fleet.balancer.core.reports) == 1)
    [survivor] = fleet.nodes.values()
    survivor.report()
    fleet.place(ledger.inherited())
    await until(lambda: fleet.published[-1].state == "running" and fleet.published[-1].host != placed.host)
    assert fleet.published[-1].component == "counter"
    assert fleet.failures == []

"""The load balancer as a service: which reports it believes, and its failures."""

from __future__ import annotations

import asyncio

import pytest

from tests.mesh.kit import until
from tests.services.kit import Refusal
from tests.services.placement.kit import PlacerFleet, fail
from tests.services.rcm.kit import FakeFleet
from zscout.keyexpr import Role, Token
from zscout.messages import HostRanking, RankAsk
from zscout.placement.balancer import Balancer
from zscout.services.placement.load_balancer import READ_EVERY, LoadBalancer


async def balancing() -> tuple[PlacerFleet, LoadBalancer]:
    fleet = PlacerFleet("a", "b")
    (await fleet.lead()).stop()
    return fleet, fleet.balancer


async def test_hosts_are_ranked_by_their_reports() -> None:
    fleet, _ = await balancing()
    fleet.nodes["a"].report(3.0)
    fleet.nodes["b"].report(1.0, labels=("gpu",))
    await asyncio.sleep(2 * READ_EVERY)
    ranking = await fleet.ask(RankAsk(metric="load_average"), HostRanking)
    assert [one.host for one in ranking.hosts] == ["b", "a"]
    ranking = await fleet.ask(RankAsk(labels=["gpu"]), HostRanking)
    assert [one.host for one in ranking.hosts] == ["b"]
    assert ranking.left_out == {"a": "it has no label gpu"}
    with pytest.raises(Refusal, match="bad_name"):
        await fleet.ask(RankAsk(hosts=["no host"]), HostRanking)
    assert fleet.failures == []


async def test_the_reports_are_told_with_their_age_where_they_are_asked_for() -> None:
    fleet, _ = await balancing()
    fleet.nodes["a"].report(3.0)
    await asyncio.sleep(2 * READ_EVERY)
    assert (await fleet.ask(RankAsk(), HostRanking)).reports is None
    told = (await fleet.ask(RankAsk(labels=["gpu"], reports=True), HostRanking)).reports
    assert told is not None
    loads = {known.report.host: known.report.load_average[0] for known in told}
    assert loads == {"a": 3.0, "b": 0.0}, "of hosts that are left out as well"
    await asyncio.sleep(1.0)
    some = (await fleet.ask(RankAsk(hosts=["a", "z"], reports=True), HostRanking)).reports
    assert some is not None
    (known,) = some
    assert known.report.host == "a"
    assert 1.0 <= known.age <= 1.0 + 3 * READ_EVERY


async def test_a_report_is_believed_of_the_host_in_whose_key_it_stands() -> None:
    fleet, balancer = await balancing()
    number = balancer.core.reports["a"][1].number
    fleet.nodes["a"].report(of="b")
    fleet.nodes["a"].report(-1.0)
    await asyncio.sleep(2 * READ_EVERY)
    assert balancer.core.reports["a"][1].number == number
    assert balancer.core.reports["b"][1].host == "b"
    assert fleet.failures == []


async def test_a_report_from_before_its_host_was_lost_does_not_bring_it_back() -> None:
    fleet, balancer = await balancing()
    fleet.nodes["a"].report()
    fleet.network.kill(fleet.nodes["a"].mesh)
    await until(lambda: "a" not in balancer.core.reports)
    await asyncio.sleep(2 * READ_EVERY)
    assert list(balancer.core.reports) == ["b"]


@pytest.mark.parametrize("method", ["reported", "rank", "lost"])
async def test_a_core_that_raises_fails_the_balancer_once(method: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fleet, _ = await balancing()
    monkeypatch.setattr(Balancer, method, fail)
    if method == "rank":
        with pytest.raises(Refusal, match="internal"):
            await fleet.ask(RankAsk(), HostRanking)
    fleet.network.kill(fleet.nodes["a"].mesh)
    for _ in range(3):
        fleet.nodes["b"].report()
        await asyncio.sleep(2 * READ_EVERY)
    assert [str(error) for error in fleet.failures] == ["a fault of the core"]


@pytest.mark.parametrize("method", ["zscout.placement.balancer.Balancer.rank", "zscout.placement.placer.Placer.handle"])
async def test_a_candidate_whose_balancer_or_placer_fails_steps_down_and_leads_again(
    method: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    fleet = FakeFleet("x")
    candidate = fleet.candidate("x")
    await until(lambda: candidate.rcm)
    assert candidate.rcm is not None
    term = candidate.rcm.term
    with monkeypatch.context() as patched:
        patched.setattr(method, fail)
        keys = fleet.watcher.keys
        await fleet.watcher.ask(keys.rank, RankAsk(), HostRanking, timeout=1)
        token = fleet.watcher.alive(Token("a", Role.NODE, "node", "n1"))
        await until(lambda: candidate.rcm is None)
        token.close()
    await until(lambda: candidate.rcm)
    assert candidate.rcm is not None
    assert candidate.rcm.term > term

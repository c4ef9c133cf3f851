"""When a waiting request will start: told in its notices, by few forecasts."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from tests.mesh.kit import until
from tests.services.rcm.kit import FakeFleet, fleet_of
from zscout.messages import Release
from zscout.rcm import request_log
from zscout.scheduling.forecast import forecast


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The times at which forecasts were made."""
    times: list[float] = []
    real = forecast

    def counted(*args: Any) -> Any:
        times.append(asyncio.get_running_loop().time())
        return real(*args)

    monkeypatch.setattr(request_log, "forecast", counted)
    return times


async def test_notices_say_when_it_will_start_to_who_wants_to_know(made: list[float]) -> None:
    fleet, _ = await fleet_of("robot/a")
    holder, client, silent = fleet.client("holder"), fleet.client("client"), fleet.client("silent")
    await holder.ask("first", "robot/a", seconds=100)
    assert (await silent.ask("silent", "robot/a", seconds=20)).starts_in is None
    assert made == []
    answer = await client.ask("next", "robot/a", seconds=30, estimate=True)
    assert answer.starts_in == pytest.approx(120, abs=0.1)
    await asyncio.sleep(20)
    answer = await silent.ask("silent", "robot/a", seconds=20, estimate=True)
    assert answer.starts_in == pytest.approx(80, abs=0.1)
    # What changes its reason tells it as well; preempted, it is told at once when it goes on.
    await silent.do(Release("silent"))
    await holder.do(Release("first"))
    await until(lambda: client.notices[-1].state == "running")
    assert client.notices[-1].starts_in is None
    await holder.ask("boss", "robot/a", priority=5, seconds=50)
    assert client.notices[-1].outcome == "preempted"
    assert client.notices[-1].starts_in == pytest.approx(50, abs=0.1)
    await until(lambda: "boss" in client.notices[-1].reason and client.notices[-1].place)
    assert client.notices[-1].starts_in == pytest.approx(50, abs=0.2)


async def test_many_who_wait_and_who_ask_for_the_state_share_forecasts(made: list[float]) -> None:
    fleet, _ = await fleet_of("robot/a")
    clients = [fleet.client(f"c{number}") for number in range(20)]
    await clients[0].ask("a0", "robot/a", seconds=1000)
    await asyncio.gather(*(client.ask("next", "robot/a", seconds=10, estimate=True) for client in clients[1:]))
    assert len(made) == 1
    for _ in range(100):
        await asyncio.gather(*(client.ask("next", "robot/a", estimate=True) for client in clients[1:]))
        await asyncio.sleep(0.1)
    assert len(made) <= 12
    # Those who ask in the same instant get the same one, without a batch of events in between.
    count = len(made)
    states = await asyncio.gather(*(fleet.state(forecast=True) for _ in range(5)))
    assert len(made) - count <= 1
    assert all(state.queue[0].starts_in == pytest.approx(990, abs=1) for state in states)


async def test_without_anybody_who_wants_estimates_there_are_none(made: list[float]) -> None:
    fleet = FakeFleet()
    fleet.rcm()
    client = fleet.client("one")
    answer = await client.ask("never", "robot/nowhere")
    await client.ask("never", "robot/nowhere")
    await asyncio.sleep(10)
    await fleet.state()
    assert made == []
    answer = await client.ask("never", "robot/nowhere", estimate=True)
    assert (answer.state, answer.starts_in) == ("queued", None)

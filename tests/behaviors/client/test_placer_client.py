"""The placer's client: what it repeats, what it does not, and when it gives up."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

import pytest

from tests.mesh.kit import until
from zscout.behaviors.client.placer_client import PlacerClient, PlacerSilent
from zscout.behaviors.client.request import RequestRefused
from zscout.keyexpr import Sender
from zscout.mesh import IncomingQuery, Refused
from zscout.messages import ComponentSpec, ListPlacements, PlaceComponent, Placement, Placements, PlacerOperation
from zscout.testing.memory import MemoryNetwork
from zscout.types import Term

JOB = ComponentSpec("job")
RUNNING = Placement("counter", JOB, "running", 1, "a")


class FakePlacer:
    """Answers as `answer` does."""

    def __init__(self, answer: Callable[[IncomingQuery[PlacerOperation]], object]) -> None:
        network = MemoryNetwork()
        self.mesh, self.client = (network.open("test", Sender(host, "x")) for host in "ab")
        self.operations: list[PlacerOperation] = []
        self._answer = answer
        self._served = self.mesh.serve(self.mesh.keys.placer(self.mesh.me), PlacerOperation, self._on_query)
        self.publisher = self.mesh.publisher(self.mesh.keys.placements, Placements)

    def _on_query(self, query: IncomingQuery[PlacerOperation]) -> None:
        self.operations.append(query.message)
        self._answer(query)


async def test_a_request_is_repeated_while_the_placer_can_not_answer_and_not_when_it_refuses() -> None:
    codes = ["busy", "not_leading", "", "exists"]

    def answer(query: IncomingQuery[PlacerOperation]) -> None:
        code = codes.pop(0)
        if code:
            raise Refused(code, "no")
        query.answer(RUNNING)

    placer = FakePlacer(answer)
    client = PlacerClient(placer.client)
    assert (await client.place("counter", JOB), len(placer.operations)) == (RUNNING, 3)
    with pytest.raises(RequestRefused, match="no") as refused:
        await client.place("counter", JOB)
    assert (refused.value.code, len(placer.operations)) == ("exists", 4)


async def test_an_answer_is_waited_for_as_long_as_the_operation_may_wait() -> None:
    loop = asyncio.get_running_loop()
    placer = FakePlacer(lambda query: loop.call_later(query.message.wait, query.answer, RUNNING))  # type: ignore[union-attr]
    assert await PlacerClient(placer.client).place("counter", JOB, wait=20.0) == RUNNING
    assert len(placer.operations) == 1


async def test_a_placer_that_never_answers_is_given_up_after_the_patience() -> None:
    placer, loop = FakePlacer(lambda _: None), asyncio.get_running_loop()
    before = loop.time()
    with pytest.raises(PlacerSilent, match="of fleet test did not answer for 15 s; see zscout status"):
        await PlacerClient(placer.client, timeout=15.0).request(ListPlacements(), Placements)
    assert 15 <= loop.time() - before <= 21


async def test_an_operation_that_was_done_though_its_answer_is_missing_is_not_repeated() -> None:
    done: list[Placement] = []

    def answer(query: IncomingQuery[PlacerOperation]) -> None:
        if isinstance(query.message, ListPlacements):
            query.answer(Placements(Term(1, "rcm"), done))
        else:
            done.append(RUNNING)

    placer = FakePlacer(answer)
    client = PlacerClient(placer.client, {"counter"})
    operation = PlaceComponent("counter", JOB, wait=0.0)
    assert await client.request_once(operation, lambda one: one.spec == JOB) == RUNNING
    assert placer.operations == [operation, ListPlacements("counter")]


async def test_it_follows_what_is_published_and_nothing_of_an_earlier_term() -> None:
    placer = FakePlacer(lambda query: query.answer(Placements(Term(2, "rcm"), [RUNNING], ["b"])))
    with PlacerClient(placer.client) as client:
        await client.refresh()
        assert (client.placements, client.cordoned) == ({"counter": RUNNING}, frozenset("b"))
        other = Placement("other", JOB, "waiting")
        placer.publisher.put(Placements(Term(1, "rcm"), [], [], ["counter"]))
        placer.publisher.put(Placements(Term(2, "rcm"), [other]))
        await until(lambda: "other" in client.placements)
        assert client.placements == {"counter": RUNNING, "other": other}
        placer.publisher.put(Placements(Term(2, "rcm"), [], [], ["other"]))
        await until(lambda: list(client.placements) == ["counter"])

"""Beginnings and ends of holds, as they come out of the real core and the real RCM."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType

import pytest

from tests.mesh.kit import until
from tests.services.rcm.kit import FakeFleet
from zscout.messages import HandOver, Release
from zscout.scheduling.core import Core
from zscout.scheduling.model import (
    Adopted,
    ArcRequest,
    Cancelled,
    Event,
    HandedOver,
    LeadTaken,
    Outcome,
    RcJoined,
    RcLost,
    RcUnwell,
    RecoveredHold,
    Released,
    Requested,
)
from zscout.services.rcm.digest import Began, HoldDigest, Over
from zscout.types import SECOND, Grant, Place, Term

OLD = Term(1, "old")


@dataclass
class Heard:
    """A listener that keeps what it is told."""

    began: list[Began] = field(default_factory=list)
    over: list[Over] = field(default_factory=list)
    unwell: list[tuple[str, str, list[str]]] = field(default_factory=list)

    def on_began(self, began: Began) -> None:
        self.began.append(began)

    def on_over(self, over: Over) -> None:
        self.over.append(over)

    def on_unwell(self, rc: str, why: str, holders: Sequence[ArcRequest]) -> None:
        self.unwell.append((rc, why, [request.name for request in holders]))

    @property
    def waits(self) -> list[tuple[str, float | None]]:
        """Of each beginning: the ARC, and the seconds that it waited."""
        return [(one.request.name, None if one.waited is None else one.waited / SECOND) for one in self.began]

    @property
    def ends(self) -> list[tuple[str, Outcome | None, float]]:
        """Of each end: the ARC, how, and the seconds that it was held."""
        return [(one.began.request.name, one.outcome, (one.at - one.began.at) / SECOND) for one in self.over]


def asked(arc: str, *needs: str, priority: int = 0, client: str = "h/c") -> ArcRequest:
    return ArcRequest(f"{client}/{arc}", client, {need: {} for need in needs}, priority, 60 * SECOND, label=arc)


def held(request: ArcRequest, seq: int, *, bound: dict[str, str] | None = None) -> RecoveredHold:
    return RecoveredHold(request, Place(OLD, seq), Grant(OLD, seq), 0, 60 * SECOND, bound or {})


class Term2:
    """A core in term 2 of two robots, whose instants a digest follows."""

    def __init__(self, *holds: RecoveredHold, waiting: tuple[Requested, ...] = ()) -> None:
        self.core, self.heard = Core(), Heard()
        self.digest = HoldDigest(self.core, [self.heard])
        joined = [RcJoined(rc, sharable=False) for rc in ("robot/a", "robot/b")]
        self.at(10, *joined, LeadTaken(Term(2, "new"), holds, waiting))

    def at(self, second: float, *events: Event, estimates: Mapping[str, int] = MappingProxyType({})) -> None:
        now = round(second * SECOND)
        self.digest.take(now, events, self.core.handle(now, *events), estimates)


def test_a_wait_is_from_the_queue_to_the_grant_and_begins_anew_when_it_is_preempted() -> None:
    fleet = Term2()
    fleet.at(20, Requested(asked("one", "robot/a")))
    fleet.at(25, Requested(asked("two", "robot/a", priority=5)))
    fleet.at(32, Released("h/c/two"))
    fleet.at(40, Cancelled("h/c/one"))
    assert fleet.heard.waits == [("one", 0), ("two", 0), ("one", 7)]
    assert fleet.heard.ends == [("one", "preempted", 5), ("two", "released", 7), ("one", "cancelled", 8)]
    assert fleet.heard.over[0].requeued
    assert str(fleet.heard.over[0].reason) == "preempted by two (h/c), priority 5"


def test_who_waited_under_an_earlier_rcm_and_asks_again_alone_has_waited_since_then() -> None:
    fleet = Term2()
    fleet.at(20, Requested(asked("late", "robot/a"), Place(OLD, 9), 4 * SECOND))
    assert fleet.heard.waits == [("late", 16)]


def test_what_is_recovered_goes_on_and_is_no_wait() -> None:
    waits = Requested(asked("late", "robot/a"), Place(OLD, 9), 4 * SECOND)
    fleet = Term2(held(asked("one", "robot/*"), 3, bound={"robot/*": "robot/a"}), waiting=(waits,))
    assert fleet.heard.waits == [("one", None)]
    assert fleet.heard.began[0].rcs == ("robot/a",)
    assert fleet.heard.began[0].at == 10 * SECOND
    # One that only RCs know of comes later.
    fleet.at(11, Adopted(held(asked("two", "robot/b"), 4)))
    fleet.at(16, Released("h/c/one"))
    assert fleet.heard.waits == [("one", None), ("two", None), ("late", 12)]
    fleet.digest.close(20 * SECOND)
    assert fleet.heard.ends == [("one", "released", 6), ("two", None, 9), ("late", None, 4)]


def test_half_a_gang_is_no_beginning_and_waits_from_then_on() -> None:
    fleet = Term2(held(asked("one", "robot/a", "robot/gone"), 3))
    assert fleet.heard.waits == []
    fleet.at(14, RcJoined("robot/gone", sharable=False))
    assert fleet.heard.waits == [("one", 4)]


def test_a_hold_that_is_handed_over_ends_at_one_client_and_goes_on_at_the_other() -> None:
    fleet = Term2()
    fleet.at(20, Requested(asked("one", "robot/a")))
    fleet.at(21, Requested(asked("two", "robot/a")))
    fleet.at(25, HandedOver("h/c/one", "h/d", "h/d/one"), HandedOver("h/c/two", "h/d", "h/d/two"))
    fleet.at(30, Released("h/d/one"))
    assert fleet.heard.waits == [("one", 0), ("one", None), ("two", 9)]
    assert [one.request.client for one in fleet.heard.began] == ["h/c", "h/d", "h/d"]
    assert fleet.heard.ends == [("one", "handed_over", 5), ("one", "released", 5)]


def test_the_first_estimate_is_compared_with_the_start() -> None:
    fleet = Term2()
    fleet.at(20, Requested(asked("one", "robot/a")))
    fleet.at(21, Requested(asked("two", "robot/a")))
    fleet.at(30, Released("h/c/one"), estimates={"h/c/two": 80 * SECOND})
    assert [one.late for one in fleet.heard.began] == [None, -50 * SECOND]


def test_a_device_that_is_unwell_is_reported_once_with_its_holders_and_once_it_is_well() -> None:
    fleet = Term2()
    fleet.at(20, Requested(asked("one", "robot/a")))
    for second, why in enumerate(("it reboots", "it still reboots", "", ""), 21):
        fleet.at(second, RcUnwell("robot/a", why))
    assert fleet.heard.unwell == [("robot/a", "it reboots", ["one"]), ("robot/a", "", ["one"])]
    fleet.at(30, RcUnwell("robot/b", "it reboots"))
    fleet.at(31, RcLost("robot/b"))
    fleet.at(32, RcJoined("robot/b", sharable=False), RcUnwell("robot/a"))
    fleet.at(33, RcUnwell("robot/b", "once more"))
    assert fleet.heard.unwell[2:] == [("robot/b", "it reboots", []), ("robot/b", "once more", [])]


def test_nothing_is_kept_of_what_has_ended() -> None:
    fleet = Term2(held(asked("zero", "robot/b"), 3))
    for number in range(50):
        fleet.at(20 + number, Requested(asked(f"a{number}", "robot/a")), Requested(asked(f"b{number}", "robot/a")))
        fleet.at(20 + number, Released(f"h/c/a{number}"), HandedOver(f"h/c/b{number}", "h/d", f"h/d/b{number}"))
        fleet.at(20 + number, Cancelled(f"h/d/b{number}"), Released(f"h/c/b{number}"))
    fleet.at(71, Released("h/c/zero"), Adopted(held(asked("zero", "robot/b"), 3)))
    assert fleet.digest._held == {}


def test_a_listener_that_fails_ends_the_telling_and_nothing_else(caplog: pytest.LogCaptureFixture) -> None:
    class Broken(Heard):
        def on_began(self, began: Began) -> None:
            raise KeyError(began.request.name)

    heard = Broken()
    core = Core()
    digest = HoldDigest(core, [heard])
    events: list[Event] = [RcJoined("robot/a", sharable=False), LeadTaken(Term(2, "new"))]
    for second, event in enumerate([*events, Requested(asked("one", "robot/a")), Released("h/c/one")]):
        digest.take(second * SECOND, [event], core.handle(second * SECOND, event))
    assert heard.over == []
    assert [one.message for one in caplog.records] == ["figures and notices of holds failed: disabled for this term"]


async def test_an_rcm_tells_its_listeners_once_all_others_have_their_answers() -> None:
    fleet, heard = FakeFleet(), Heard()
    candidate = fleet.candidate("anvil", listeners=[heard])
    await until(lambda: candidate.rcm is not None)
    robot = fleet.rc("robot/a")
    await fleet.joined(robot)
    one, two = fleet.client("one"), fleet.client("two")
    await one.ask("first", "robot/a")
    queued = await two.ask("second", "robot/a", estimate=True)
    assert queued.starts_in is not None
    await asyncio.sleep(3)
    await one.do(HandOver("first", "desk/two"))
    await two.do(Release("first"))
    await until(lambda: len(heard.began) == 3)
    assert [name for name, _ in heard.waits] == ["first", "first", "second"]
    late = heard.began[-1].late
    assert late is not None
    assert queued.starts_in + late / SECOND == pytest.approx(3, abs=0.1)
    await candidate.stop()
    assert heard.ends[-1][:2] == ("second", None)
    assert (candidate.terms_led, candidate.tally.refused()) == (1, {})


async def test_refusals_are_counted_by_code() -> None:
    fleet = FakeFleet()
    candidate = fleet.candidate("anvil")
    await until(lambda: candidate.rcm is not None)
    client = fleet.client("one")
    for number in range(3):
        with pytest.raises(Exception, match="needs is empty"):
            await client.ask(f"arc{number}")
    await client.ask("first", "robot/a", wait_for_device=True)
    with pytest.raises(Exception, match="unknown_client"):
        await client.do(HandOver("first", "desk/nobody"))
    assert candidate.tally.refused() == {"bad_request": 3, "unknown_client": 1}

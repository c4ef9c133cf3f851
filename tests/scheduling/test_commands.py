"""Commands that give no minimum runtime: their holds are protected for long, but rank, patience and reservations go by
the fleet's minimum runtime."""

from __future__ import annotations

import pytest
from msgspec import structs

from zscout.config.scheduling_policy import SchedulingPolicy, StrategyName
from zscout.scheduling.booking import Booked, Booking
from zscout.scheduling.core import Core
from zscout.scheduling.forecast import forecast
from zscout.scheduling.model import ArcRequest, LeadTaken, RcBegins, RcJoined, Requested, Tick
from zscout.scheduling.strategies import STRATEGIES
from zscout.types import SECOND, ArcId, Ns, Term

MINUTE, HOUR = 60 * SECOND, 3600 * SECOND
ROBOT = "robot/a"


def fleet(strategy: StrategyName = "adaptive", policy: SchedulingPolicy | None = None) -> Core:
    core = Core(STRATEGIES[strategy](), policy or SchedulingPolicy())
    core.handle(0, RcJoined(ROBOT, sharable=False), RcJoined("robot/b", sharable=False))
    return core


def plain(name: str, seconds: int = 60, priority: int = 0, rc: str = ROBOT) -> ArcRequest:
    return ArcRequest(name, f"{name}/c", {rc: {}}, priority, seconds * SECOND, keep=True)


def command(name: str, priority: int = 0, *, until_done: Ns = HOUR, rc: str = ROBOT) -> ArcRequest:
    return structs.replace(plain(name, 60, priority, rc), until_done=until_done)


def at(core: Core, second: float, *requests: ArcRequest) -> set[ArcId]:
    core.handle(round(second * SECOND), *(map(Requested, requests) if requests else (Tick(),)))
    return {arc for arc in core.arcs() if core.is_running(arc)}


def protected(core: Core, arc: ArcId) -> float:
    """Seconds from its grant."""
    status = core.arc(arc)
    assert status is not None
    assert status.hold is not None
    return (status.hold.end - status.hold.start) / SECOND


@pytest.mark.parametrize("strategy", ["adaptive", "priority", "optimal"])
def test_an_equal_waits_until_the_hour_is_over(strategy: StrategyName) -> None:
    core = fleet(strategy)
    at(core, 0, command("job"))
    assert at(core, 3599, plain("other")) == {"job"}
    assert at(core, 3600) == {"other"}


def test_a_command_ranks_by_the_minimum_runtime_of_the_fleet() -> None:
    core = fleet()
    at(core, 0, plain("first"))
    at(core, 1, plain("long", 90))
    at(core, 2, command("job"))
    assert at(core, 60) == {"job"}
    assert core.patience == 28 * MINUTE, "an hour for commands makes nobody more patient"


def test_it_starts_before_a_booking_and_ends_for_it() -> None:
    core = fleet()
    core.handle(0, Booked(Booking("b", {ROBOT: {}}, 0, 600 * SECOND, HOUR, HOUR, 0, owner="h")))
    assert at(core, 1, command("job")) == {"job"}
    assert protected(core, "job") == 599
    assert at(core, 2, plain("other")) == {"job"}
    taker = structs.replace(plain("taker", 3600), booking="b")
    assert at(core, 600, taker) == {"taker"}


def test_too_late_before_a_booking_it_waits_as_any_request_of_a_minute() -> None:
    core = fleet()
    core.handle(0, Booked(Booking("b", {ROBOT: {}}, 0, 50 * SECOND, HOUR, HOUR, 0, owner="h")))
    assert at(core, 1, command("job")) == set()


def test_maintenance_finds_the_device_free() -> None:
    core = fleet()
    upkeep = Booking("m", {ROBOT: {}}, 1, 300 * SECOND, HOUR, 0, 0, maintenance=True)
    core.handle(0, Booked(upkeep))
    at(core, 0, command("job"))
    assert protected(core, "job") == 300
    assert at(core, 300) == set()


def test_it_is_cut_to_the_time_that_is_reserved_for_who_starves() -> None:
    core = fleet(policy=SchedulingPolicy(patience=600 * SECOND))
    at(core, 0, plain("a", 500), plain("b", 700, rc="robot/b"))
    both = structs.replace(plain("both", 400), needs={ROBOT: {}, "robot/b": {}})
    at(core, 1, both)
    assert at(core, 500, command("job")) == {"job", "b"}
    assert protected(core, "job") == 200, "both robots are reserved from 700 s on"
    assert at(core, 700) == {"both"}


def test_the_budget_is_a_quarter_of_what_is_protected() -> None:
    core = fleet()
    at(core, 0, command("job"))
    assert at(core, 899, plain("high", 1, 1)) == {"high"}
    core = fleet()
    at(core, 0, command("job"))
    assert at(core, 900, plain("high", 1, 1)) == {"job"}
    assert at(core, 3599) == {"job"}
    assert at(core, 3600) == {"high"}


def test_less_than_the_minimum_runtime_changes_nothing() -> None:
    core = fleet()
    at(core, 0, command("job", until_done=30 * SECOND))
    assert protected(core, "job") == 60


def test_max_runtime_bounds_it() -> None:
    core = fleet(policy=SchedulingPolicy(max_runtime=300 * SECOND))
    at(core, 0, command("job"))
    assert protected(core, "job") == 300
    assert at(core, 300) == set()


def test_its_time_counts_from_when_its_devices_have_begun() -> None:
    core = fleet()
    core.handle(0, RcBegins(ROBOT, 65 * SECOND))
    at(core, 0, command("job"))
    status = core.arc("job")
    assert status is not None
    assert status.hold is not None
    grant = status.hold.grant
    core.handle(SECOND, RcBegins(ROBOT, 65 * SECOND, {grant: 65 * SECOND}))
    core.handle(40 * SECOND, RcBegins(ROBOT, 65 * SECOND, {grant: None}))
    assert protected(core, "job") == 3640


def test_it_lasts_through_a_change_of_leader() -> None:
    core = fleet()
    core.handle(0, Booked(Booking("b", {ROBOT: {}}, 0, 600 * SECOND, HOUR, HOUR, 0, owner="h")))
    at(core, 1, command("job"))
    joined, lead = core.as_events(Term(2, "next"))
    later = Core(STRATEGIES["adaptive"]())
    later.handle(100 * SECOND, *joined, lead)
    assert protected(later, "job") == 599
    assert at(later, 599, plain("other", 1)) == {"job"}
    held = lead.recovered_holds[0]
    assert held.runtime == 599 * SECOND
    adopted = Core(STRATEGIES["adaptive"]())
    adopted.handle(100 * SECOND, RcJoined(ROBOT, sharable=False), LeadTaken(Term(2, "next"), (held,)))
    assert at(adopted, 152, plain("high", 1, 1)) == {"job"}, "its budget, a quarter of 599 s, was used up"


def test_estimates_count_what_is_protected() -> None:
    core = fleet()
    at(core, 0, command("job"))
    found = forecast(core, 10 * SECOND, plain("next"))
    assert found.starts["next"] == HOUR
    assert found.begin_within == 0
    found = forecast(core, 10 * SECOND, command("next", rc="robot/b"))
    assert found.starts["next"] == 10 * SECOND
    assert found.begin_within == 0

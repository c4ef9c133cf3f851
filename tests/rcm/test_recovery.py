"""What a new RCM finds: tables of what RCs and clients answer, and what stands after that."""

from __future__ import annotations

from collections.abc import Callable
from decimal import Decimal
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest
from msgspec import structs

from zscout.config.access import AccessPolicy, Roles
from zscout.config.fleet import default_fleet
from zscout.drivers.holds import HoldTable
from zscout.messages import ClientRequests, Holder, HoldView, OpenRequest, RcmState, RcState
from zscout.rcm.admission import Admission
from zscout.rcm.authority import Authority
from zscout.rcm.places import Places
from zscout.rcm.recovery import RecoveredState, recover
from zscout.scheduling import model
from zscout.scheduling.core import Core
from zscout.scheduling.model import ArcRequest, ArcStatus, LeadTaken, RcJoined
from zscout.scheduling.strategies import STRATEGIES
from zscout.types import SECOND, Grant, Ns, Place, Term

NOW: Ns = 1000 * SECOND
OLD, TERM, LATER = Term(2, "aa"), Term(3, "bb"), Term(4, "cc")
PLACE = Place(OLD, 7)
GANG = ("robot/a", "radio/b")


def hold(
    rcs: tuple[str, ...] = GANG, seq: int = 5, term: Term = TERM, name: str = "gang", remaining: float = 10, **more: Any
) -> Holder:
    fields: dict[str, Any] = {"client": "h/one", "min_runtime": Decimal(60), "priority": 3, "keep": True} | more
    return Holder(f"{name}-id", name, grant=Grant(term, seq), place=PLACE, rcs=list(rcs), remaining=remaining, **fields)


def rc(name: str, *holders: Holder, health: str = "ok") -> RcState:
    sharable = name.startswith("radio")
    return RcState(rc=name, host="c", instance="i", sharable=sharable, holders=list(holders), health=health)


def asked(
    name: str = "gang", needs: tuple[str, ...] = GANG, rate: str = "2.5", runtime: str = "60", **more: Any
) -> OpenRequest:
    wanted = {rc: {"rate": Decimal(rate)} if rc.startswith("radio") else {} for rc in needs}
    return OpenRequest(f"{name}-id", name, wanted, 3, Decimal(runtime), keep=True, **({"place": PLACE} | more))


def client(*requests: OpenRequest, name: str = "h/one") -> ClientRequests:
    return ClientRequests(client=name, requests=list(requests))


BOTH = [rc("robot/a", hold()), rc("radio/b", hold(params={"rate": Decimal("2.5")}))]
RUNS = client(asked(grant=Grant(TERM, 5)))


def plain() -> Admission:
    fleet = default_fleet()
    return Admission(Authority(fleet), Places("test", None, LATER))


def secured() -> Admission:
    access = AccessPolicy(Roles(client=("h",), manager=("m",)))
    fleet = structs.replace(default_fleet(), security=Path("keys"), access=access)
    return Admission(Authority(fleet), Places("test", None, LATER))


def recover_plain(states: list[RcState], clients: list[ClientRequests], now: Ns) -> RecoveredState:
    return recover(states, clients, now, plain())


ALONE = ("robot/a",)
TWO_GRANTS = [rc("robot/a", hold(seq=1)), rc("radio/b", hold(seq=1), hold(term=OLD, seq=9))]
WAITING = [
    client(asked("third", place=Place(TERM, 1)), asked("second", place=Place(OLD, 9)), name="h/z"),
    client(asked("first", place=Place(OLD, 8)), name="h/y"),
]
NONSENSE = [client(asked(runtime="0"), asked("good"), asked("bad name")), client(name="no client")]
HALF_NONSENSE = rc("robot/a", hold(ALONE, client="nobody"), hold(ALONE, name="good"))


def summary(found: RecoveredState) -> tuple[list[str], list[str]]:
    """The names of what stands and what waits."""
    return [held.request.name for held in found.holds], [one.request.name for one in found.waiting]


@pytest.mark.parametrize(
    ("states", "clients", "holds", "waiting"),
    [
        pytest.param([], [], [], [], id="nothing"),
        pytest.param(BOTH, [RUNS], ["gang"], [], id="a gang that is all there"),
        pytest.param(BOTH, [], ["gang"], [], id="its client is late: the RCs' word is enough"),
        pytest.param(BOTH[:1], [RUNS], ["gang"], [], id="an RC is absent: the core ends it by name"),
        pytest.param([BOTH[0], rc("radio/b")], [RUNS], [], ["gang"], id="an RC is there and does not hold it"),
        pytest.param([BOTH[0], rc("radio/b")], [], [], ["gang"], id="the same, and its client is late"),
        pytest.param([BOTH[0], rc("radio/b", hold(seq=4))], [RUNS], [], ["gang"], id="half under an older grant"),
        pytest.param(TWO_GRANTS, [RUNS], ["gang"], [], id="of two grants of one ARC the newer counts, if it is whole"),
        pytest.param([rc("robot/a"), rc("radio/b")], [RUNS], [], ["gang"], id="no RC holds what its client tells of"),
        pytest.param([], [RUNS], [], ["gang"], id="no RC answers at all"),
        pytest.param(BOTH, [client()], [], [], id="its client has given it up: nobody wants it"),
        pytest.param(BOTH, [client(asked("other", place=None))], [], [], id="its client gave it up and wants another"),
        pytest.param(BOTH, [client(name="h/two")], ["gang"], [], id="another client has nothing to say about it"),
        pytest.param([], [client(asked(place=None))], [], [], id="never answered: it will be asked again"),
        pytest.param(BOTH, [RUNS, *WAITING], ["gang"], ["first", "second", "third"], id="those who wait, by place"),
        pytest.param([], [client(asked(runtime="-1"))], [], [], id="nonsense from a client"),
        pytest.param([], NONSENSE, [], ["good"], id="nonsense from a client spoils nothing else"),
        pytest.param([rc("robot/a", hold(ALONE, min_runtime=Decimal("NaN")))], [], [], [], id="nonsense from an RC"),
        pytest.param([HALF_NONSENSE], [], ["good"], [], id="nonsense from an RC spoils nothing else"),
    ],
)
def test_recover(states: list[RcState], clients: list[ClientRequests], holds: list[str], waiting: list[str]) -> None:
    found = recover_plain(states, clients, NOW)
    assert summary(found) == (holds, waiting)
    assert found.rcs == {state.rc: state for state in states}


def test_a_standing_hold_is_carried_on_as_it_is() -> None:
    (held,) = recover_plain(BOTH, [RUNS], NOW).holds
    assert (held.grant, held.place) == (Grant(TERM, 5), PLACE)
    assert (held.start, held.end) == (NOW - 50 * SECOND, NOW + 10 * SECOND)
    request = held.request
    assert (request.arc, request.client, request.name) == ("h/one/gang-id", "h/one", "gang")
    assert (request.priority, request.keep, request.min_runtime) == (3, True, 60 * SECOND)
    assert request.needs == {"robot/a": {}, "radio/b": {"rate": Fraction(5, 2)}}


@pytest.mark.parametrize("clients", [[], [client(structs.replace(RUNS.requests[0], until_done=True))]])
@pytest.mark.parametrize("admission", [plain, secured])
@pytest.mark.parametrize(("reported", "runtime"), [(600, 600), (1e9, 3600), (30, None)])
def test_a_command_keeps_its_longer_runtime_within_what_the_fleet_gives(
    clients: list[ClientRequests], admission: Callable[[], Admission], reported: float, runtime: float | None
) -> None:
    states = [structs.replace(state, holders=[_command(one, reported) for one in state.holders]) for state in BOTH]
    (held,) = recover(states, clients, NOW, admission()).holds
    assert held.runtime == (None if runtime is None else runtime * SECOND)
    assert held.start == min(NOW, NOW + 500 * SECOND - (held.runtime or 60 * SECOND))


def _command(holder: Holder, runtime: float) -> Holder:
    return structs.replace(holder, keep=True, runtime=runtime, remaining=500.0)


def test_clocks_differ_a_little_and_the_earliest_end_counts() -> None:
    states = [rc("robot/a", hold(remaining=10)), rc("radio/b", hold(remaining=9.5))]
    (held,) = recover_plain(states, [], NOW).holds
    assert held.end == NOW + 9_500_000_000


@pytest.mark.parametrize(
    ("told", "protected"),
    [((45, 45), 45), ((45, 44), 44), ((None, 45), 45), ((None, None), None)],
    ids=["both alike", "the latest counts", "an older RC says nothing", "no such rule"],
)
def test_from_when_a_hold_is_protected_is_the_word_of_its_rcs(
    told: tuple[float | None, ...], protected: float | None
) -> None:
    held = {name: hold(remaining=50, protected_from=left) for name, left in zip(GANG, told, strict=True)}
    states = [rc("robot/a", held["robot/a"]), rc("radio/b", held["radio/b"])]
    (found,) = recover_plain(states, [], NOW).holds
    assert found.protected_from == (None if protected is None else NOW + round((50 - protected) * SECOND))


def test_the_parameters_at_an_absent_rc_are_what_the_client_says() -> None:
    (held,) = recover_plain(BOTH[:1], [RUNS], NOW).holds
    assert held.request.needs["radio/b"] == {"rate": Fraction(5, 2)}


# Needs by pattern

RATE = {"rate": Decimal("2.5")}
THREE = ("robot/a", "radio/b", "radio/c")
BOUND = {"robot/*": "robot/a", "radio/*": "radio/c", "radio/*#2": "radio/b"}


def bound_hold(bound: dict[str, str] = BOUND, params: dict[str, Decimal] | None = None) -> Holder:
    return hold(THREE, params=params, bound=bound)


BY_PATTERN = [rc(name, bound_hold(params=RATE if name.startswith("radio") else {})) for name in THREE]
ASKED = client(asked(grant=Grant(TERM, 5), needs=tuple(BOUND)))


@pytest.mark.parametrize("clients", [[], [ASKED]], ids=["its client is late", "its client answers"])
@pytest.mark.parametrize(
    "states",
    [
        pytest.param(BY_PATTERN, id="all there"),
        pytest.param(BY_PATTERN[1:], id="without the robot"),
        pytest.param(BY_PATTERN[:2], id="without one radio: the other tells what is asked of it"),
        pytest.param([rc("robot/a", hold(THREE)), *BY_PATTERN[1:]], id="one RC knows nothing of patterns"),
    ],
)
def test_patterns_and_what_meets_them_are_restored(states: list[RcState], clients: list[ClientRequests]) -> None:
    found = recover_plain(states, clients, NOW)
    (held,) = found.holds
    rate = {"rate": Fraction(5, 2)}
    assert held.request.needs == {"robot/*": {}, "radio/*": rate, "radio/*#2": rate}
    assert held.bound == BOUND
    core = Core(STRATEGIES["priority"]())
    joined = [RcJoined(state.rc, state.sharable) for state in states]
    core.handle(NOW, *joined, LeadTaken(Term(4, "cc"), tuple(found.holds)))
    arc = core.arc("h/one/gang-id")
    assert arc is not None
    if len(states) == len(THREE):
        assert (arc.hold is not None, set(arc.needs), arc.bound) == (True, set(THREE), BOUND)
    else:
        assert (arc.hold, arc.place) == (None, PLACE)


def test_an_rc_that_read_of_its_hold_in_a_snapshot_passes_on_its_binding() -> None:
    grant, needs, bound = Grant(TERM, 5), {"robot/a": dict[str, Decimal]()}, {"robot/*": "robot/a"}
    view = HoldView("gang-id", "gang", "h/one", 3, grant, PLACE, needs, Decimal(60), 50, 10, bound=bound)
    holding = HoldTable("robot/a", hold_lease=3 * SECOND)
    holding.apply_snapshot(RcmState(TERM, 5, "h", [view]), NOW)
    (held,) = recover_plain([rc("robot/a", *holding.holders(NOW))], [], NOW).holds
    assert (held.request.needs, held.bound) == ({"robot/*": {}}, {"robot/*": "robot/a"})


def test_half_a_gang_waits_for_its_patterns() -> None:
    found = recover_plain([*BY_PATTERN[:2], rc("radio/c")], [], NOW)
    assert summary(found) == ([], ["gang"])
    assert found.waiting[0].request.needs.keys() == BOUND.keys()


def test_what_waits_by_pattern_waits_on_and_nonsense_does_not() -> None:
    good = asked("good", needs=("radio/*", "radio/*#2"), place=Place(OLD, 8))
    bad = [asked(f"bad-{at}", needs=(need,)) for at, need in enumerate(("radio/**", "radio/*#0", "*/*/*"))]
    cross = asked("cross", needs=("radio/*", "*/rf0"))
    found = recover_plain([], [client(good, *bad, cross)], NOW)
    assert summary(found) == ([], ["good"])
    assert found.waiting[0].request.needs.keys() == {"radio/*", "radio/*#2"}


@pytest.mark.parametrize("missing", [None, "radio/c"], ids=["all there", "half a gang"])
@pytest.mark.parametrize(
    "bound",
    [
        pytest.param({"robot/*": "robot/b"}, id="an RC that it does not hold"),
        pytest.param({"robot/*": "radio/b"}, id="an RC that does not match"),
        pytest.param({"radio/*": "radio/b", "radio/*#2": "radio/b"}, id="one RC for two patterns"),
        pytest.param({"robot/b": "robot/a"}, id="a name for a pattern"),
        pytest.param({"robot/a": "robot/a"}, id="an RC for itself"),
        pytest.param({"robot/**": "robot/a"}, id="no pattern"),
        pytest.param({"robot/* ": "robot/a"}, id="nearly a pattern"),
        pytest.param({"*/a": "robot/a", "radio/*": "radio/b"}, id="patterns that may not stand together"),
    ],
)
def test_a_hold_with_a_wrong_binding_is_left_out(bound: dict[str, str], missing: str | None) -> None:
    wrong = [
        rc(name, *([] if name == missing else [bound_hold(bound, RATE if name.startswith("radio") else {})]))
        for name in THREE
    ]
    other = rc("robot/x", hold(("robot/x",), name="good"))
    found = recover_plain([*wrong, other], [], NOW)
    assert summary(found) == (["good"], [])
    assert found.remarks[0].startswith("the hold of h/one/gang-id is not recovered: ")


def test_what_waits_keeps_place_and_parameters() -> None:
    place = Place(OLD, 9)
    (waits,) = recover_plain([], [client(asked(place=place, rate="0.1", waited=2.5))], NOW).waiting
    assert (waits.place, waits.since) == (place, NOW - 2_500_000_000)
    assert waits.request.needs == {"robot/a": {}, "radio/b": {"rate": Fraction(1, 10)}}


def test_requests_of_two_clients_may_share_an_id() -> None:
    clients = [client(asked(), name="h/one"), client(asked(), name="h/two")]
    found = recover_plain([], clients, NOW)
    assert [one.request.arc for one in found.waiting] == ["h/one/gang-id", "h/two/gang-id"]


@pytest.mark.parametrize("vouched", [True, False])
def test_a_hold_known_from_rcs_only_is_not_vouched_for_by_another_report(vouched: bool) -> None:
    """With certificates. A run of the fault simulator (seed 1466) found it."""
    request = ArcRequest("h/one/gang-id", "h/one", {"robot/a": {}}, 3, 60 * SECOND)
    known = ArcStatus(request, PLACE, None, request.needs, {}, NOW, 0, 0, None, None, vouched)
    found = recover([rc("robot/a", hold(ALONE))], [], NOW, secured(), known=lambda _: known)
    assert [(held.vouched, held.place) for held in found.holds] == [(vouched, PLACE if vouched else None)]


LIES = {
    "the same": hold(("video/lie",)),
    "the same, of a wider gang": hold((*GANG, "video/lie")),
    "the same, without itself": hold(GANG),
    "the same, with patterns": hold(("video/lie",), bound={"video/*": "video/lie", "*/lie": "video/lie"}),
    "newer": hold(("video/lie",), seq=6),
    "newer, of a wider gang": hold((*GANG, "video/lie"), seq=6),
    "newer, of a gang that is not there": hold(("video/lie", "robot/z"), seq=6),
    "shorter": hold((*GANG, "video/lie"), remaining=0),
}


@pytest.mark.parametrize("lie", LIES.values(), ids=LIES.keys())
@pytest.mark.parametrize("first", [True, False])
def test_a_node_ends_no_hold_of_others_by_claiming_it(lie: Holder, first: bool) -> None:
    """With certificates: an RC's word counts for the gangs that it is in, and the grant that a client lists first."""
    liar, listed = rc("video/lie", lie), client(asked(grant=Grant(TERM, 5), rcs=list(GANG)))
    found = recover([liar, *BOTH] if first else [*BOTH, liar], [listed], NOW, secured())
    assert [({*held.request.needs}, held.end - NOW) for held in found.holds] == [({*GANG}, 10 * SECOND)]


def test_what_goes_on_at_another_client_is_believed_of_no_request_that_waits() -> None:
    """Its old client handed it over, missed the answer, and still believes in its grant."""
    found = recover(BOTH, [RUNS, client(asked(grant=Grant(TERM, 5)), name="h/old")], NOW, plain())
    assert summary(found) == (["gang"], [])
    assert found.believed == {}


def test_a_reported_hold_is_checked_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """An RC may report thousands, and all of one answer are looked at in one step."""
    checked = list[str]()
    monkeypatch.setattr(model, "check_request", lambda name, *_: checked.append(name))
    held = [hold(("radio/b",), seq=number, name=f"n{number}") for number in range(50)]
    found = recover_plain([rc("radio/b", *held)], [], NOW)
    assert len(found.holds) == 50
    assert len(checked) == 50

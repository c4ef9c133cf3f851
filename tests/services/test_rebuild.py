"""What a new RCM finds: tables of what RCs and clients answer, and what stands after that."""

from __future__ import annotations

from decimal import Decimal
from fractions import Fraction

import pytest

from zscout.messages import ClientRequests, Holder, OpenRequest, RcState
from zscout.scheduling.model import SECOND, Grant, Ns, Place, Term
from zscout.services.rebuild import Inheritance, rebuild

NOW: Ns = 1000 * SECOND
OLD, TERM = Term(2, "aa"), Term(3, "bb")
PLACE = Place(OLD, 7)
GANG = ("robot/a", "radio/b")


def hold(
    rcs: tuple[str, ...] = GANG,
    *,
    seq: int = 5,
    term: Term = TERM,
    client: str = "h/one",
    name: str = "gang",
    remaining: float = 10,
    params: dict[str, Decimal] | None = None,
    runtime: str = "60",
) -> Holder:
    return Holder(
        id=f"{name}-id",
        arc=name,
        client=client,
        grant=Grant(term, seq),
        place=PLACE,
        rcs=list(rcs),
        min_runtime=Decimal(runtime),
        remaining=remaining,
        priority=3,
        keep=True,
        params=params or {},
    )


def rc(name: str, *holders: Holder, health: str = "ok") -> RcState:
    sharable = name.startswith("radio")
    return RcState(rc=name, host="c", instance="i", sharable=sharable, holders=list(holders), health=health)


def asked(
    name: str = "gang",
    *,
    place: Place | None = PLACE,
    grant: Grant | None = None,
    needs: tuple[str, ...] = GANG,
    rate: str = "2.5",
    runtime: str = "60",
    waited: float = 0.0,
) -> OpenRequest:
    return OpenRequest(
        id=f"{name}-id",
        arc=name,
        needs={rc: {"rate": Decimal(rate)} if rc.startswith("radio") else {} for rc in needs},
        priority=3,
        min_runtime=Decimal(runtime),
        keep=True,
        place=place,
        waited=waited,
        grant=grant,
    )


def client(*requests: OpenRequest, name: str = "h/one") -> ClientRequests:
    return ClientRequests(client=name, requests=list(requests))


BOTH = [rc("robot/a", hold()), rc("radio/b", hold(params={"rate": Decimal("2.5")}))]
RUNS = client(asked(grant=Grant(TERM, 5)))


def summary(found: Inheritance) -> tuple[list[str], list[str]]:
    """The names of what stands and what waits."""
    return [held.request.name for held in found.standing], [one.request.name for one in found.waiting]


@pytest.mark.parametrize(
    ("states", "clients", "standing", "waiting"),
    [
        pytest.param([], [], [], [], id="nothing"),
        pytest.param(BOTH, [RUNS], ["gang"], [], id="a gang that is all there"),
        pytest.param(BOTH, [], ["gang"], [], id="its client is late: the RCs' word is enough"),
        pytest.param(BOTH[:1], [RUNS], ["gang"], [], id="an RC is absent: the core ends it by name"),
        pytest.param(
            [BOTH[0], rc("radio/b")], [RUNS], [], ["gang"], id="an RC is there and does not hold it"
        ),
        pytest.param([BOTH[0], rc("radio/b")], [], [], ["gang"], id="the same, and its client is late"),
        pytest.param(
            [BOTH[0], rc("radio/b", hold(seq=4))], [RUNS], [], ["gang"], id="half under an older grant"
        ),
        pytest.param(
            [rc("robot/a", hold(seq=1)), rc("radio/b", hold(seq=1), hold(term=OLD, seq=9))],
            [RUNS],
            ["gang"],
            [],
            id="of two grants of one ARC the newer counts, if it is whole",
        ),
        pytest.param(
            [rc("robot/a"), rc("radio/b")], [RUNS], [], ["gang"], id="no RC holds what its client believes in"
        ),
        pytest.param([], [RUNS], [], ["gang"], id="no RC answers at all"),
        pytest.param(BOTH, [client()], [], [], id="its client has given it up: nobody wants it"),
        pytest.param(
            BOTH,
            [client(asked("other", place=None), name="h/one")],
            [],
            [],
            id="its client has given it up and wants something else, which it asks for",
        ),
        pytest.param(
            BOTH, [client(name="h/two")], ["gang"], [], id="another client has nothing to say about it"
        ),
        pytest.param([], [client(asked(place=None))], [], [], id="never answered: it will be asked again"),
        pytest.param(
            BOTH,
            [
                RUNS,
                client(
                    asked("third", place=Place(TERM, 1)), asked("second", place=Place(OLD, 9)), name="h/z"
                ),
                client(asked("first", place=Place(OLD, 8)), name="h/y"),
            ],
            ["gang"],
            ["first", "second", "third"],
            id="those who wait, by place",
        ),
        pytest.param([], [client(asked(runtime="-1"))], [], [], id="nonsense from a client"),
        pytest.param(
            [],
            [client(asked(runtime="0"), asked("good"), asked("bad name")), client(name="no client")],
            [],
            ["good"],
            id="nonsense from a client spoils nothing else",
        ),
        pytest.param(
            [rc("robot/a", hold(("robot/a",), runtime="NaN"))], [], [], [], id="nonsense from an RC"
        ),
        pytest.param(
            [rc("robot/a", hold(("robot/a",), client="nobody"), hold(("robot/a",), name="good"))],
            [],
            ["good"],
            [],
            id="nonsense from an RC spoils nothing else",
        ),
    ],
)
def test_rebuild(
    states: list[RcState], clients: list[ClientRequests], standing: list[str], waiting: list[str]
) -> None:
    found = rebuild(states, clients, NOW)
    assert summary(found) == (standing, waiting)
    assert found.rcs == {state.rc: state for state in states}


def test_a_standing_hold_is_carried_on_as_it_is() -> None:
    (held,) = rebuild(BOTH, [RUNS], NOW).standing
    assert (held.grant, held.place) == (Grant(TERM, 5), PLACE)
    assert (held.start, held.end) == (NOW - 50 * SECOND, NOW + 10 * SECOND)
    request = held.request
    assert (request.arc, request.client, request.name) == ("h/one/gang-id", "h/one", "gang")
    assert (request.priority, request.keep, request.min_runtime) == (3, True, 60 * SECOND)
    assert request.needs == {"robot/a": {}, "radio/b": {"rate": Fraction(5, 2)}}


def test_clocks_differ_a_little_and_the_earliest_end_counts() -> None:
    states = [rc("robot/a", hold(remaining=10)), rc("radio/b", hold(remaining=9.5))]
    (held,) = rebuild(states, [], NOW).standing
    assert held.end == NOW + 9_500_000_000


def test_the_parameters_at_an_absent_rc_are_what_the_client_says() -> None:
    (held,) = rebuild(BOTH[:1], [RUNS], NOW).standing
    assert held.request.needs["radio/b"] == {"rate": Fraction(5, 2)}


def test_what_waits_keeps_place_and_parameters() -> None:
    place = Place(OLD, 9)
    ((request, at, since),) = rebuild([], [client(asked(place=place, rate="0.1", waited=2.5))], NOW).waiting
    assert (at, since) == (place, NOW - 2_500_000_000)
    assert request.needs == {"robot/a": {}, "radio/b": {"rate": Fraction(1, 10)}}


def test_requests_of_two_clients_may_share_an_id() -> None:
    clients = [client(asked(), name="h/one"), client(asked(), name="h/two")]
    found = rebuild([], clients, NOW)
    assert [one.request.arc for one in found.waiting] == ["h/one/gang-id", "h/two/gang-id"]

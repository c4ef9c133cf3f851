"""Whose a place is, at a leader that gave it, at the next, and where managers share a key. Virtual time."""

from __future__ import annotations

from decimal import Decimal

import pytest

from tests.mesh.kit import until
from tests.services.kit import answer
from tests.services.rcm.kit import FakeFleet, Refusal, request
from zscout.behaviors.client.request import OpenArc
from zscout.keyexpr import client_of
from zscout.messages import Notice, OpenRequest
from zscout.rcm.places import MAX_KEPT, Places
from zscout.services.rcm.candidate import Candidate
from zscout.types import SECOND, Place, Term

OLD, NEW = Term(3, "old"), Term(4, "new")
KEY = bytes(range(32))
MINUTE = 60 * SECOND


def places(key: bytes | None = None, term: Term = NEW) -> Places:
    return Places("lab", key, term)


def test_a_place_that_this_leader_gave_is_its_clients_alone() -> None:
    of = places()
    place = Place(NEW, 1)
    of.bind(place, "desk/one/q1", 0)
    assert of.may_claim(place, "desk/one", "q1", None, seen=True)
    assert not of.may_claim(place, "desk/two", "q1", None, seen=True)
    assert not of.may_claim(Place(NEW, 2), "desk/one", "q1", None, seen=True)


def test_who_handed_it_over_and_who_has_it_may_both_claim_it() -> None:
    of = places()
    place = Place(NEW, 1)
    of.bind(place, "desk/one/q1", 0)
    of.bind(place, "cart/two/q1", 0)
    of.end("desk/one/q1", 0, MINUTE)
    claims = [of.may_claim(place, client, "x", None, seen=True) for client in ("desk/one", "cart/two", "h/c")]
    assert claims == [True, True, False]


def test_a_place_goes_with_its_arc_and_may_be_kept_for_a_while() -> None:
    of = places()
    for arrival, keep in ((1, 0), (2, MINUTE), (3, MINUTE)):
        of.bind(Place(NEW, arrival), f"desk/one/q{arrival}", 0)
        of.end(f"desk/one/q{arrival}", 0, keep)
    of.bind(Place(NEW, 3), "desk/one/q4", SECOND)  # asked for again
    mine = [of.may_claim(Place(NEW, arrival), "desk/one", "q", None, seen=True) for arrival in (1, 2, 3)]
    assert mine == [False, True, True]
    of.bind(Place(NEW, 9), "desk/one/q9", 2 * MINUTE)
    of.end("desk/one/q9", 2 * MINUTE)
    mine = [of.may_claim(Place(NEW, arrival), "desk/one", "q", None, seen=True) for arrival in (1, 2, 3)]
    assert mine == [False, False, True]


def test_a_place_that_ended_twice_is_kept_until_the_later_date() -> None:
    for first, second in ((MINUTE, 3 * MINUTE), (3 * MINUTE, MINUTE)):
        of, place = places(), Place(NEW, 1)
        for keep in (first, second):
            of.bind(place, "desk/one/q", 0)
            of.end("desk/one/q", 0, keep)
        for now, is_its_own in ((2 * MINUTE, True), (4 * MINUTE, False)):
            of.bind(Place(NEW, 9), "desk/two/q", now)
            of.end("desk/two/q", now)
            assert of.may_claim(place, "desk/one", "q", None, seen=True) == is_its_own
        assert not of._owners
        assert not of._until


def test_places_that_are_kept_have_a_limit() -> None:
    of = places()
    for arrival in range(MAX_KEPT + 10):
        of.bind(Place(NEW, arrival), f"desk/one/q{arrival}", 0)
        of.end(f"desk/one/q{arrival}", 0, MINUTE + arrival)
    assert len(of._owners) == len(of._expiries) == MAX_KEPT


def test_an_unknown_place_of_an_earlier_term_is_taken_once_by_who_is_seen() -> None:
    of = places()
    place = Place(OLD, 7)
    assert not of.may_claim(place, "desk/one", "q1", None, seen=False)
    assert of.may_claim(place, "desk/one", "q1", None, seen=True)
    assert of.is_unproven(place)
    assert not places(KEY).is_unproven(place)
    of.bind(place, "desk/one/q1", 0)
    assert not of.is_unproven(place)
    assert not of.may_claim(place, "desk/two", "q2", None, seen=True)


def test_who_expects_an_arc_may_claim_its_place_where_there_is_no_key() -> None:
    for key in (None, KEY):
        of = places(key)
        of.bind(Place(OLD, 7), "desk/one/q1", 0)
        of.allow_claims("desk/one/q1", {"cart/two"})
        assert of.may_claim(Place(OLD, 7), "cart/two", "q1", None, seen=True) == (key is None)


def test_a_seal_proves_a_place_to_every_leader() -> None:
    place, before, of = Place(OLD, 7), places(KEY, OLD), places(KEY)
    seal = before.seal(place, "desk/one/q1")
    assert of.may_claim(place, "desk/one", "q1", seal, seen=False)
    for claim in (
        (place, "desk/two", "q1", seal),
        (place, "desk/one", "q2", seal),
        (Place(OLD, 6), "desk/one", "q1", seal),
        (place, "desk/one", "q1", None),
        (place, "desk/one", "q1", "ä" * 32),
        (place, "desk/one", "q1", places(b"other", OLD).seal(place, "desk/one/q1")),
        (place, "desk/one", "q1", Places("other", KEY, OLD).seal(place, "desk/one/q1")),
    ):
        assert not of.may_claim(*claim, seen=True), claim
    assert places(None).seal(place, "desk/one/q1") is None


# At a leader


async def waiting(key: bytes | None = None) -> tuple[FakeFleet, Candidate, Notice]:
    """A fleet with one robot that somebody has; desk/one waits at the first place behind, of which it is told, and
    desk/two at the second."""
    fleet = FakeFleet("h1")
    fleet.rc("robot/a")
    candidate = fleet.candidate("h1", places_key=key)
    await until(lambda: candidate.rcm and candidate.rcm.core.status().rcs)
    await fleet.client("holder").ask("first", "robot/a")
    first = await fleet.client("one").ask("q1", "robot/a")
    await fleet.client("two").ask("q2", "robot/a")
    return fleet, candidate, first


def places_of(candidate: Candidate, client: str) -> list[Place | None]:
    assert candidate.rcm is not None
    core = candidate.rcm.core
    return [core.place_of(arc) for arc in core.arcs_of(client)]


async def test_a_stranger_that_shows_anothers_place_has_none_for_that() -> None:
    fleet, candidate, first = await waiting()
    thief = fleet.client("thief")
    stolen = await thief.ask("q9", "robot/a", place=first.place)
    assert (stolen.state, stolen.ahead) == ("queued", 2)
    assert (await thief.ask("q9", "robot/a", place=first.place)).place == stolen.place
    assert places_of(candidate, "desk/one") == [first.place] != [stolen.place]


async def test_who_asks_under_a_new_id_has_its_place_and_no_second_arc() -> None:
    _, candidate, first = await waiting()
    assert candidate.rcm is not None
    key = candidate.mesh.keys.schedule(client_of("desk/one"))
    asked = request("anew", "robot/a", place=first.place, was=first.id)
    told = await answer(candidate.mesh, key, asked, Notice)
    assert (told.place, told.ahead) == (first.place, 0)
    assert candidate.rcm.core.arcs_of("desk/one") == ["desk/one/anew"]


@pytest.mark.parametrize("sealed", [True, False])
async def test_at_the_next_leader_a_seal_tells_whose_a_place_is(sealed: bool) -> None:
    """Without one, who lists it is believed."""

    fleet, candidate, first = await waiting(KEY if sealed else None)
    assert candidate.rcm is not None
    assert (first.seal is not None) == sealed
    thief, before = fleet.client("thief"), candidate.rcm.term
    listed = OpenRequest("x", "arc", {"robot/a": {}}, 0, Decimal(60), place=first.place, seal=first.seal)
    thief.open = [listed]
    with pytest.raises(Refusal, match="old_term"):
        await thief.ask("y", "robot/a", term=Term(before.counter + 5, "mad"))
    await until(lambda: candidate.rcm and candidate.rcm.term > before)
    assert (places_of(candidate, "desk/thief") == [first.place]) != sealed


def test_a_client_shows_its_place_and_seal_and_the_id_it_had_them_under() -> None:
    arc = OpenArc("q1", "arc", {"robot/a": {}}, 0, Decimal(60))
    place = Place(OLD, 7)
    said = {"id": "q1", "arc": "arc", "client": "desk/one", "state": "queued", "term": OLD}
    assert arc._take(Notice(**said, step=1, place=place, seal="s"), 0)  # type: ignore[arg-type]
    arc._take_back("q2", "its new client is gone", 0)
    arc._take_back("q3", "and again", 0)
    asked, listed = arc._ask(0), arc._open_request(0)
    assert (asked.id, asked.place, asked.seal, asked.was) == ("q3", place, "s", "q1")
    assert (listed.id, listed.place, listed.seal, listed.was) == ("q3", place, "s", "q1")
    said |= {"id": "q3", "term": NEW}
    assert arc._take(Notice(**said, step=1, place=place, seal="t"), 0)  # type: ignore[arg-type]
    asked = arc._ask(0)
    assert (asked.place, asked.seal, asked.was) == (place, "t", None)

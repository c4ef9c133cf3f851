"""Which booking is meant by a name, and how bookings are told."""

from __future__ import annotations

import time
from decimal import Decimal
from zoneinfo import ZoneInfo

import pytest

from tests.mesh.kit import run
from zscout.behaviors.client.client import Client
from zscout.cli.booked import (
    ask_bookings,
    booking_json,
    choose,
    free_name,
    in_words,
    is_own,
    look,
    rcs_words,
    soon,
    state_words,
    whose,
)
from zscout.cli.common import Failed
from zscout.cli.ownership import User
from zscout.config.fleet import default_fleet
from zscout.keyexpr import Sender
from zscout.messages import BookedDate, BookingsAsk, BookingsTold, BookingView, Who
from zscout.testing.memory import MemoryNetwork

FLEET = default_fleet()
ALICE = User("alice", "ws1")
ZONE = ZoneInfo("Europe/Berlin")
START = 1_796_130_000
"""2026-12-01 14:00 in Berlin."""


def booking(id_: str, name: str = "survey", user: str = "alice", owner: str = "ws1", **more: object) -> BookingView:
    needs = {"robot/a": {}, "framegrabber/*": {}, "radio/rf0": {"command_rate": Decimal("5.0")}}
    date = BookedDate(START, START + 7200, "open", {"framegrabber/*": "framegrabber/fg1"})
    fields = {"dates": [date], "owner": owner, "who": Who(user, owner) if user else None} | more
    return BookingView(id_, name, needs, 0, START, Decimal(7200), Decimal(900), "Europe/Berlin", **fields)  # type: ignore[arg-type]


A, B, C = booking("aa11"), booking("ab22", user="bob"), booking("ac33", "demo", user="bob", owner="ws2")


def test_ones_own_is_of_the_same_user_wherever_it_was_made() -> None:
    assert is_own(A, ALICE)
    assert is_own(booking("x", owner="ws9"), ALICE)
    assert not is_own(B, ALICE), "of another user of the same host"
    assert is_own(booking("x", user=""), ALICE), "whose user is unknown"
    assert not is_own(booking("x", user="", owner="ws2"), ALICE)


def test_with_certificates_ones_own_is_of_the_same_certificate() -> None:
    ada = User("pi", "ada", proved=True)
    assert is_own(booking("x", user="alice", owner="ada"), ada), "from another account"
    assert not is_own(booking("x", user="pi", owner="bob"), ada), "an account proves nothing"


def test_a_name_is_ones_own_first_then_an_id_then_anybodys() -> None:
    assert choose([A, B, C], "survey", ALICE) == A
    assert choose([B, C], "survey", ALICE) == B
    assert choose([A, B, C], "demo", ALICE) == C
    assert choose([A, booking("survey", user="bob")], "survey", ALICE) == A, "whoever makes an id chooses it"
    assert choose([B, booking("survey")], "survey", ALICE).id == "survey"
    assert choose([booking("x", unbooked=True), A], "survey", ALICE) == A


def test_an_id_is_named_by_four_characters_that_are_nobodys_name() -> None:
    long, other = booking("abcd11", "1"), booking("abcd22", "abcd", user="bob")
    assert choose([long, A], "abcd", ALICE) == long
    assert choose([long, other], "abcd", ALICE) == other, "a name"
    for short in ("a", "abc"):
        with pytest.raises(Failed, match=f'unknown booking "{short}"'):
            choose([long], short, ALICE)
    assert choose([long], "1", ALICE) == long, "a default name of earlier versions"


def test_a_name_of_several_is_refused_with_all_of_them() -> None:
    with pytest.raises(
        Failed, match=r'2 bookings are called "survey": aa11 .* of alice@ws1; ad44 .*name one by its id'
    ):
        choose([A, B, booking("ad44")], "survey", ALICE)
    with pytest.raises(Failed, match='2 bookings are called "abcd"'):
        choose([booking("abcd1"), booking("abcd2")], "abcd", ALICE)


def test_what_nobody_booked_is_told_with_what_may_be_meant() -> None:
    with pytest.raises(Failed, match='unknown booking "survy"; did you mean survey'):
        choose([A], "survy", ALICE)
    with pytest.raises(Failed, match='unknown booking "x", and there are none'):
        choose([], "x", ALICE)


def test_a_name_is_numbered_where_one_has_it_already() -> None:
    assert free_name("arm1", []) == "arm1"
    assert free_name("survey", [A]) == "survey-2"
    assert free_name("survey", [A, booking("z", "survey-2")]) == "survey-3"


@pytest.mark.parametrize(("differs", "words"), [(185.0, "behind"), (-185.0, "ahead of"), (1.0, "")])
def test_who_is_by_another_clock_than_the_fleet_is_told(
    differs: float, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    async def story() -> None:
        network = MemoryNetwork()
        leader = network.open(FLEET.name, Sender("a", "x"))
        client = Client(network.open(FLEET.name, Sender("b", "c")), FLEET)
        told = BookingsTold(time.time() + differs, [A])
        served = leader.serve(leader.keys.rcm_bookings, BookingsAsk, lambda query: query.answer(told))
        assert (await ask_bookings(client)).bookings == [A]
        assert await look(client) == told
        served.close()

    run(story())
    told = capsys.readouterr().err
    assert told == (f"this host's clock is 3 min 5 s {words} the fleet's; dates are by the fleet's\n" if words else "")


def test_how_many_begin_within_a_day() -> None:
    dates = [BookedDate(START + 3600 * hours, START + 3600 * hours + 1, "open") for hours in (-1, 1, 23, 25)]
    gone = [BookedDate(START + 3600, START + 3601, "conflict")]
    told = BookingsTold(START, [booking("x", dates=dates), booking("y", dates=gone)])
    assert (soon(told), soon(None)) == (2, 0)


def test_words() -> None:
    assert [in_words(0.4), in_words(-5), in_words(7200)] == ["now", "now", "in 2 h"]
    assert whose(A) == "alice@ws1"
    assert whose(booking("x", user="", owner="ada")) == "ada"
    assert whose(booking("x", user="eve\x1b[31m")) == "eve [31m@ws1"
    assert rcs_words(A, A.dates[0]) == "framegrabber/fg1 for framegrabber/*, radio/rf0 (command_rate=5), robot/a"
    assert rcs_words(A) == "framegrabber/*, radio/rf0 (command_rate=5), robot/a"
    drain = booking("x", maintenance=True)
    assert state_words(drain, drain.dates[0]) == "maintenance"
    lost = BookedDate(START, START + 1, "open", danger="robot/a is lost")
    assert state_words(A, lost) == "open: robot/a is lost"


def test_programs_have_instants_in_utc() -> None:
    told = booking_json(booking("x", every=7, until=START + 86_400), ALICE)
    assert (told["start"], told["until"], told["own"]) == ("2026-12-01T13:00:00Z", "2026-12-02T13:00:00Z", True)
    assert told["dates"][0]["end"] == "2026-12-01T15:00:00Z"

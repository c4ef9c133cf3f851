"""When a candidate may try to lead: tables of what it sees, and what follows."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from zscout.services.rcm.election import CALM, JOIN_TIME, LEADER_WAIT, RETRY, TURN, Election, views
from zscout.types import SECOND, Ns, Term

SILENCE = 2 * SECOND
START: Ns = 100 * SECOND
LATER: Ns = START + 60 * SECOND

Sight = Callable[[Election], None]


def election(host: str = "b", ranking: tuple[str, ...] = ("a", "b", "c")) -> Election:
    found = Election(host, ranking, silence=SILENCE, now=START)
    found.led_by = "a"
    return found


def came(instance: str, now: Ns = LATER) -> Sight:
    return lambda seen: seen.leader(instance, "a", alive=True, now=now)


def went(instance: str, now: Ns = LATER) -> Sight:
    return lambda seen: seen.leader(instance, "a", alive=False, now=now)


def heard(instance: str, now: Ns) -> Sight:
    return lambda seen: seen.published(Term(7, instance), now)


def candidate(host: str, *, alive: bool = True) -> Sight:
    return lambda seen: seen.candidate(host, alive=alive, now=START)


def failed(now: Ns) -> Sight:
    return lambda seen: seen.failed(now)


@pytest.mark.parametrize(
    ("sights", "now", "due"),
    [
        pytest.param([], START, START + JOIN_TIME, id="nothing seen: after it has settled"),
        pytest.param([candidate("b")], START, START + JOIN_TIME, id="itself is no better candidate"),
        pytest.param([candidate("a")], START, START + JOIN_TIME + TURN, id="a better one goes first"),
        pytest.param([candidate("c")], START, START + JOIN_TIME, id="a worse one is not waited for"),
        pytest.param([candidate("a"), candidate("a", alive=False)], START, START + JOIN_TIME, id="a better one left"),
        pytest.param(
            [candidate("a"), candidate("a"), candidate("a", alive=False)],
            START,
            START + JOIN_TIME + TURN,
            id="one of two lives of a better one is left",
        ),
        pytest.param([candidate("z", alive=False)], START, START + JOIN_TIME, id="somebody unknown left: no matter"),
        pytest.param([came("x")], LATER, LATER + SILENCE, id="a leader: until it is silent for too long"),
        pytest.param([came("x"), heard("x", LATER + SECOND)], LATER, LATER + SECOND + SILENCE, id="it still speaks"),
        pytest.param([heard("x", LATER)], LATER, START + JOIN_TIME, id="words of one without a token count not"),
        pytest.param([came("x"), went("x", LATER + 5)], LATER + 5, LATER + 5, id="it died: at once"),
        pytest.param(
            [came("x", START + 2), went("x", START + 5)],
            START + 5,
            START + 5,
            id="it died before this one had settled: who saw a leader is on the mesh",
        ),
        pytest.param([candidate("a"), came("x"), went("x", LATER)], LATER, LATER + TURN, id="it died: a better first"),
        pytest.param([went("x", LATER)], LATER, START + JOIN_TIME, id="a death of one never seen"),
        pytest.param(
            [came("x"), came("y", LATER + SECOND), went("x", LATER + 2 * SECOND)],
            LATER + 2 * SECOND,
            LATER + SECOND + SILENCE,
            id="one of two died",
        ),
        pytest.param([failed(LATER)], LATER, LATER + RETRY, id="an attempt failed: not again at once"),
        pytest.param(
            [came("x"), heard("x", LATER)],
            LATER + SILENCE,
            START + JOIN_TIME,
            id="it keeps its token and says nothing: as if it were gone",
        ),
        pytest.param(
            [came("hung"), came("x", LATER + 5 * SECOND), heard("x", LATER + 9 * SECOND)],
            LATER + 9 * SECOND,
            LATER + 9 * SECOND + SILENCE,
            id="one of two hangs: no reason to try while the other speaks",
        ),
        pytest.param(
            [came("x"), failed(LATER + SILENCE - 1)],
            LATER + SILENCE - 1,
            LATER + SILENCE - 1 + RETRY,
            id="a leader about to fall silent, and an attempt that failed",
        ),
    ],
)
def test_when_to_try(sights: list[Sight], now: Ns, due: Ns) -> None:
    seen = election()
    for sight in sights:
        sight(seen)
    assert seen.next_try(now) == due


@pytest.mark.parametrize("sights", [[], [came("x"), went("x")], [failed(START)]])
def test_who_is_not_named_never_tries(sights: list[Sight]) -> None:
    seen = election(host="d")
    for sight in sights:
        sight(seen)
    assert seen.next_try(LATER) is None


def test_without_a_ranking_hosts_take_turns_by_name() -> None:
    turns = {}
    for host in ("a", "b", "c"):
        seen = election(host, ranking=())
        for other in ("a", "b", "c"):
            seen.candidate(other, alive=True, now=START)
        turns[host] = seen.next_try(START)
    settled = START + JOIN_TIME
    assert turns == {"a": settled, "b": settled + TURN, "c": settled + 2 * TURN}


def test_a_leader_counts_while_it_has_a_token_and_speaks() -> None:
    seen = election()
    assert not seen.sees_leader(LATER)
    seen.leader("x", "a", alive=True, now=LATER)
    assert seen.sees_leader(LATER + SILENCE - 1)
    assert not seen.sees_leader(LATER + SILENCE)
    seen.published(Term(7, "x"), LATER + SILENCE)
    assert seen.sees_leader(LATER + SILENCE)
    seen.leader("x", "a", alive=False, now=LATER + SILENCE)
    assert not seen.sees_leader(LATER + SILENCE)


JITTER = 0.7


def hosts(*sights: bool) -> dict[str, bool]:
    return {f"h{number}": sees for number, sees in enumerate(sights)}


def test_who_is_deposed_waits_twice_as_long_each_time_until_all_is_calm() -> None:
    """While it hears of the other: it goes on speaking."""
    seen, waits, at = election(), [], LATER
    for _ in range(3):
        seen.deposed(at, JITTER)
        waited = at
        while True:
            seen.published(Term(7, "x"), waited)
            if not seen.must_wait(hosts(False, False), False, waited):
                break
            waited += SECOND // 10
        waits.append((waited - at) / SILENCE)
        at = waited
    assert waits == pytest.approx([JITTER, 2 * JITTER, 4 * JITTER], abs=0.06)
    at += CALM + 1
    seen.deposed(at, JITTER)
    seen.published(Term(7, "x"), at + SILENCE)
    assert not seen.must_wait(hosts(False), False, at + SILENCE)


@pytest.mark.parametrize(
    ("others", "waits"),
    [
        pytest.param([False, False], False, id="and its leader is gone: at once"),
        pytest.param([False, True, False], True, id="and an RC elsewhere still sees one"),
    ],
)
def test_who_was_deposed_waits_only_for_a_leader_that_is_there(others: list[bool], waits: bool) -> None:
    seen = election()
    seen.deposed(LATER, JITTER)
    assert seen.must_wait(hosts(*others), False, LATER + SILENCE // 2) == waits


def test_who_was_deposed_and_sees_nobody_else_waits_as_well() -> None:
    """A client may have told it of the higher term, which it would tell the other leader of the next one in turn."""
    seen = election()
    seen.deposed(LATER, JITTER)
    assert seen.must_wait({}, False, LATER + SILENCE // 2)
    assert not seen.must_wait({}, False, LATER + SILENCE)


def test_who_has_stalled_waits_where_nobody_tells_of_a_leader() -> None:
    """It lost the leader's token first: the others' follow."""
    seen = election()
    seen.stalled(LATER)
    assert not seen.must_wait(hosts(False), False, LATER)
    assert seen.must_wait({}, False, LATER)
    assert not seen.must_wait({}, False, LATER + SILENCE)


@pytest.mark.parametrize(
    ("others", "own", "lost", "waits"),
    [
        pytest.param([True, True, False], False, [], True, id="most of them see a leader"),
        pytest.param([True, False], True, [], False, id="half of them do not, and its own do not count"),
        pytest.param([], True, [], True, id="only its own answer, and see one: once more a silence"),
        pytest.param([], False, [], False, id="only its own answer, and see none; or there are none"),
        pytest.param([], False, ["a"], False, id="the leader's host has gone"),
        pytest.param([], False, ["a", "c"], True, id="others have gone with the leader's: it may be this host"),
    ],
)
def test_who_may_be_cut_off_waits(others: list[bool], own: bool, lost: list[str], waits: bool) -> None:
    seen = election()
    for host in ("a", "c"):
        seen.candidate(host, alive=True, now=START)
    for host in lost:
        seen.candidate(host, alive=False, now=LATER)
    assert seen.must_wait(hosts(*others), own, LATER) == waits
    if not others:
        # Nobody else will tell: it is as long as a leader may be silent.
        assert not seen.must_wait(hosts(*others), own, LATER + SILENCE)


def test_while_links_return_one_host_that_sees_a_leader_is_enough() -> None:
    seen = election()
    seen.candidate("c", alive=True, now=START)
    seen.candidate("c", alive=False, now=START)
    assert not seen.must_wait(hosts(True, False), False, LATER)
    seen.candidate("c", alive=True, now=LATER)
    assert seen.must_wait(hosts(True, False), False, LATER)
    assert not seen.must_wait(hosts(False, False), False, LATER)
    assert not seen.must_wait(hosts(True, False), False, LATER + SILENCE + 1)


def test_who_waited_alone_once_does_so_anew_after_a_leader_was_seen() -> None:
    seen = election()
    seen.candidate("c", alive=True, now=START)
    seen.candidate("c", alive=False, now=LATER)
    assert seen.must_wait({}, False, LATER)
    seen.leader("i", "a", alive=True, now=LATER + SECOND)
    seen.stalled(LATER + 3 * SILENCE)
    assert seen.must_wait({}, False, LATER + 3 * SILENCE)


@pytest.mark.parametrize(
    ("happens", "returning"),
    [
        pytest.param([], False, id="nothing"),
        pytest.param([lambda seen: seen.stalled(LATER)], True, id="it stood still"),
        pytest.param([lambda seen: seen.candidate("c", alive=False, now=LATER)], True, id="it lost another host"),
        pytest.param([lambda seen: seen.candidate("a", alive=False, now=LATER)], False, id="the leader's host went"),
        pytest.param(
            [
                lambda seen: seen.candidate("c", alive=False, now=START),
                lambda seen: seen.candidate("c", alive=True, now=LATER),
            ],
            True,
            id="another host is back",
        ),
    ],
)
def test_links_come_back_for_a_silence(happens: list[Sight], returning: bool) -> None:
    seen = election()
    for one in happens:
        one(seen)
    assert seen.links_return(LATER + SILENCE) == returning
    assert not seen.links_return(LATER + SILENCE + 1)


@pytest.mark.parametrize(
    ("sights", "others", "own"),
    [
        pytest.param([("c", True)] * 50 + [("d", False), ("e", False)], (1, 3), False, id="50 RCs are one host"),
        pytest.param([("c", True), ("c", True), ("c", False)], (1, 1), False, id="most RCs of a host decide"),
        pytest.param([("c", True), ("c", False)], (0, 1), False, id="half of them do not"),
        pytest.param([("b", True), ("c", False)], (0, 1), True, id="this host's count apart"),
        pytest.param([("", True)] * 9 + [("c", False)], (0, 1), False, id="unknown hosts beside a known one"),
        pytest.param([("", True), ("", True), ("b", False)], (1, 1), False, id="unknown hosts alone are one"),
        pytest.param([], (0, 0), False, id="nobody answers"),
    ],
)
def test_each_host_has_one_view(sights: list[tuple[str, bool]], others: tuple[int, int], own: bool) -> None:
    found, of_this_host = views(sights, "b")
    assert ((sum(found.values()), len(found)), of_this_host) == (others, own)


BOUND = LEADER_WAIT + SILENCE
NOBODY: Sight = lambda _: None  # noqa: E731
LAST = LATER + BOUND - 1


@pytest.mark.parametrize(
    ("meanwhile", "in_vain"),
    [
        pytest.param(NOBODY, True, id="nothing"),
        pytest.param(heard("x", LATER), True, id="the leader was heard last before that"),
        pytest.param(heard("x", LAST), False, id="this candidate hears a leader"),
        pytest.param(came("x", LAST), False, id="this candidate sees a leader"),
        pytest.param(lambda seen: seen.waited_in_vain({}, LAST), True, id="it does not answer for a while"),
        pytest.param(lambda seen: seen.waited_in_vain(hosts(False), LAST), False, id="it sees none for a while"),
        pytest.param(lambda seen: seen.waited_in_vain(hosts(True, True), LAST), False, id="another one sees one too"),
        pytest.param(lambda seen: seen.waited_in_vain({"z": True}, LAST), False, id="another one is alone"),
    ],
)
def test_one_host_that_alone_shows_a_leader_is_believed_for_a_while(meanwhile: Sight, in_vain: bool) -> None:
    seen = election()
    for at in (LATER, LAST):
        assert not seen.waited_in_vain(hosts(True), at)
    meanwhile(seen)
    assert seen.waited_in_vain(hosts(True), LATER + BOUND) == in_vain
    assert not seen.waited_in_vain(hosts(True, True), LATER + 9 * BOUND)

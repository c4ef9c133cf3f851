"""Which terms a manager believes: of leaders, seals, RCs and clients."""

from __future__ import annotations

import pytest

from zscout.messages import MAX_COUNTER, MAX_JUMP
from zscout.rcm.terms import DOUBT, FORGIVEN_AFTER, Source, Terms, Verdict, Word
from zscout.types import Term

NOW = 10**15


def known(counter: int = 5, *, secured: bool = True) -> Terms:
    return Terms(secured=secured, highest=Term(counter, "led"))


def rc(counter: int, host: str = "cart") -> Word:
    return Word(Term(counter, "lie"), Source.RC, "radio/r", host)


def hear(terms: Terms, word: Word, now: int = NOW) -> Verdict:
    return terms.weigh(word, now, heard=True)


@pytest.mark.parametrize(
    ("source", "host", "secured", "believed"),
    [
        pytest.param(Source.LEADER, "", True, True, id="a leader's"),
        pytest.param(Source.SEAL, "desk", True, True, id="a sealed place's"),
        pytest.param(Source.RC, "cart", True, True, id="an RC's that is seen"),
        pytest.param(Source.RC, "", True, False, id="an RC's that nobody sees"),
        pytest.param(Source.CLIENT, "desk", True, False, id="a client's"),
        pytest.param(Source.CLIENT, "desk", False, True, id="a client's without certificates"),
        pytest.param(Source.RC, "", False, True, id="an RC's that nobody sees, without certificates"),
    ],
)
def test_what_moves_a_term(source: Source, host: str, secured: bool, believed: bool) -> None:
    terms = known(secured=secured)
    assert hear(terms, Word(Term(6, "x"), source, "it", host)).believed is believed
    assert terms.highest.counter == 5 + believed


def test_a_host_is_believed_alone_once_and_ever_more_seldom() -> None:
    terms, now, counter = known(), NOW, 10
    for wait in (DOUBT, 2 * DOUBT, 4 * DOUBT):
        assert hear(terms, rc(counter), now).believed
        terms.led(Term(counter + 1, "own"), now)
        terms.highest = Term(counter + 1, "own")
        for at in (now + 1, now + wait - 1):
            assert hear(terms, rc(counter + 5), at)[:2] == (False, now + wait)
        assert hear(terms, Word(Term(counter + 2, "x"), Source.LEADER), now + 1).believed
        now, counter = now + wait, counter + 10
    now += 4 * DOUBT + FORGIVEN_AFTER
    assert hear(terms, rc(counter), now).believed
    assert terms.doubted_until("cart", now) == now + DOUBT


def test_a_host_that_alone_showed_a_leader_in_vain_is_doubted_once_the_leader_had_a_silence_to_appear() -> None:
    terms, silence = known(), 10
    terms.doubt("cart", terms.highest, NOW)
    doubted = [at for at in (0, silence - 1, silence, DOUBT - 1, DOUBT) if terms.is_doubted("cart", NOW + at, silence)]
    assert doubted == [silence, DOUBT - 1]
    assert not terms.is_doubted("anvil", NOW + silence, silence)


@pytest.mark.parametrize("by", ["a leader", "another host"])
def test_a_host_that_was_right_is_believed_again(by: str) -> None:
    terms = known()
    hear(terms, rc(9))
    assert terms.doubted_until("cart", NOW)
    hear(terms, rc(9)._replace(source=Source.LEADER) if by == "a leader" else rc(9, "anvil"))
    assert not terms.doubted_until("cart", NOW)
    assert hear(terms, rc(12), NOW + 1).believed


def test_two_hosts_are_believed_whatever_each_showed_before() -> None:
    terms = known()
    hear(terms, rc(9))
    assert not hear(terms, rc(12), NOW + 1).believed
    assert hear(terms, rc(12, "anvil"), NOW + 1).believed
    assert hear(terms, rc(12), NOW + 1).believed


def test_what_rcs_promised_to_this_manager_is_no_claim() -> None:
    terms = known()
    terms.tries(Term(6, "lie"))
    assert hear(terms, rc(6)).believed
    assert not terms.doubted_until("cart", NOW)


def test_a_jump_is_believed_of_an_rc_that_is_seen_and_the_last_terms_of_nobody_alone() -> None:
    terms = known()
    leader = Word(Term(6 + MAX_JUMP, "x"), Source.LEADER)
    assert (hear(terms, leader).believed, terms.goes_above) == (False, False)
    assert (hear(terms, rc(6 + MAX_JUMP)).believed, terms.goes_above) == (True, True)
    assert hear(terms, rc(MAX_COUNTER)) == Verdict(believed=False, absent_until=NOW + DOUBT, last=True)

"""The roster by itself: tokens and reports in, what follows out."""

from __future__ import annotations

import pytest
from msgspec import structs

from zscout.config.fleet import default_fleet
from zscout.keyexpr import Keys, Role, Token
from zscout.messages import Problem, RcState
from zscout.rcm import roster
from zscout.rcm.admission import Admission
from zscout.rcm.authority import Authority
from zscout.rcm.devices import ExpectedDevices
from zscout.rcm.places import Places
from zscout.rcm.roster import Roster
from zscout.rcm.sight import MAX_TOKENS
from zscout.rcm.steps import Outbox, Purpose
from zscout.scheduling.model import ClientLost
from zscout.types import SECOND, Term

OWN = Term(1, "rcm")


def a_roster(lease: float = 1.0, term: Term = OWN) -> Roster:
    fleet = default_fleet()
    fleet = structs.replace(fleet, mesh=structs.replace(fleet.mesh, lease=lease))
    admission = Admission(Authority(fleet), Places("lab", None, term))
    return Roster(Keys("lab"), "leader", fleet, term, ExpectedDevices({}), admission, lambda _: None, 0)


def token(number: int, host: str = "greedy") -> Token:
    return Token(host, Role.CLIENT, f"c{number}", f"i{number}")


def test_tokens_of_one_host_are_bounded_and_the_earliest_stay() -> None:
    members = a_roster()
    changes = [members.client_token(0, token(number), alive=True) for number in range(MAX_TOKENS + 50)]
    assert {host for change in changes for host, _ in change.strange} == {"greedy"}
    assert len(members.clients) == MAX_TOKENS
    assert "greedy/c0" in members.clients
    members.client_token(0, token(MAX_TOKENS + 1), alive=False)  # it never counted
    members.client_token(0, token(0), alive=False)
    members.client_token(0, token(MAX_TOKENS + 60), alive=True)
    members.client_token(0, token(1, "desk"), alive=True)
    assert len(members.clients) == MAX_TOKENS + 1


def test_a_host_s_tokens_disappear_in_one_go() -> None:
    """Judged together, at a cost that grows with their number alone."""
    members = a_roster()
    members.client_token(0, token(1, "desk"), alive=True)
    for number in range(MAX_TOKENS):
        members.client_token(0, token(number), alive=True)
    for number in range(MAX_TOKENS):
        assert not members.client_token(SECOND, token(number), alive=False).events
    judged = members.tick(SECOND + roster.TOKEN_SPREAD)
    # A leader that is not away is answered by another host: then all are lost, in one instant.
    assert [question.purpose for question in judged.questions] == [Purpose.WITNESS]
    assert not judged.events
    lost = members.answered(2 * SECOND, judged.questions[0], object(), None)
    assert len(lost.events) == MAX_TOKENS
    assert all(isinstance(event, ClientLost) for event in lost.events)


@pytest.mark.parametrize(("lease", "within"), [(1.0, 0.05), (10.0, 0.5)])
def test_how_quickly_others_have_to_answer_follows_the_lease(lease: float, within: float) -> None:
    """Hosts of a fleet with a long lease may be busy for a moment: the next in the queue does not wait a lease then."""
    members = a_roster(lease)
    for number, host in enumerate(("desk", "other")):
        members.client_token(0, token(number, host), alive=True)
    members.client_token(SECOND, token(0, "desk"), alive=False)
    assert [question.timeout for question in members.tick(2 * SECOND).questions] == [within]


def test_an_rc_speaks_for_itself_alone() -> None:
    """An answer under another name, or of another instance, changes nothing: no name enters here unchecked."""
    members = a_roster()
    shown = Token("desk", Role.RC, "robot/a", "desk-1")
    [question] = members.rc_token(0, shown, alive=True).questions
    state = RcState("robot/a", "desk", "desk-1", sharable=False, term=Term(1, "rcm"))
    members.answered(0, question, state, None)
    back = question._replace(purpose=Purpose.RETURN)
    for other in (structs.replace(state, rc="no name"), structs.replace(state, instance="desk-2")):
        assert members.answered(1, back, structs.replace(other, health="broken"), None) == Outbox()
        assert not members.is_known("no name")
    assert members.answered(1, back, structs.replace(state, health="broken"), None).events


@pytest.mark.parametrize(("known", "above"), [(1, "leader"), (10**9 - 5, None)])
def test_a_term_refused_as_absurd_is_asked_for_again_above_the_other(known: int, above: str | None) -> None:
    """An RC or client that comes late may have heard a leader of a much lower term a moment ago."""
    members = a_roster(term=Term(10**9, "rcm"))
    refused = Problem("old_term", "obeys another", Term(known, "before"))
    [promise] = members.rc_token(0, Token("desk", Role.RC, "robot/a", "desk-1"), alive=True).questions
    members.client_token(0, token(1, "desk"), alive=True)
    [listing] = members.ask_requests(0, "desk/c1").questions
    assert [asked.message.above for asked in (promise, listing)] == [None, None]
    for asked in (promise, listing):
        members.answered(0, asked, None, refused)
    again = members.tick(SECOND).questions
    assert [(asked.message.promise, asked.message.above) for asked in again] == [(members.term, above)] * 2

"""Who holds an RC, by every rule of `HoldTable`: tables of what is heard, and what follows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from decimal import Decimal
from typing import Any

import pytest
from msgspec.structs import replace

from zscout.drivers.holds import REMEMBERED, HoldChange, HoldTable
from zscout.messages import MAX_JUMP, Grants, Holder, HoldView, RcmState, Revocation
from zscout.types import NO_TERM, SECOND, Grant, Ns, Place, Term

RC = "robot/x"
LEASE: Ns = 3 * SECOND
NOW: Ns = 1000 * SECOND
OLD, TERM, NEW = Term(4, "zz"), Term(5, "m"), Term(6, "aa")
SAME_COUNTER = Term(5, "n")
"""Above TERM: terms of one counter compare by the RCM's instance."""


def holder(
    seq: int, client: str = "h/one", *, term: Term = TERM, remaining: float = 60, keep: bool = False, place: int = 0
) -> Holder:
    at, time = Place(TERM, place or seq), Decimal(60)
    return Holder(f"id{seq}", f"arc{seq}", client, Grant(term, seq), at, [RC], time, remaining, keep=keep)


def view(seq: int, client: str = "h/one", *, rc: str = RC, term: Term = TERM, remaining: float = 60) -> HoldView:
    at, needs = Place(TERM, seq), {rc: {"rate": Decimal(2)}}
    return HoldView(f"id{seq}", f"arc{seq}", client, 0, Grant(term, seq), at, needs, Decimal(60), 0, remaining)


def said(
    seq: int,
    *holders: Holder,
    prev: int | None = None,
    term: Term = TERM,
    touches: bool = True,
    revoked: Sequence[Holder] = (),
) -> Grants:
    words = [Revocation(r.id, r.arc, r.client, r.grant, [RC], "preempted", "by an operator") for r in revoked]
    rcs = {RC: list(holders)} if touches else {"robot/other": []}
    return Grants(term=term, seq=seq, prev=seq - 1 if prev is None else prev, every=0.5, rcs=rcs, revoked=words)


def state(seq: int, *holds: HoldView, term: Term = TERM) -> RcmState:
    return RcmState(term=term, seq=seq, host="h", holds=list(holds))


def holding(*before: Grants) -> HoldTable:
    """An RC that has heard these, beginning with number 1 of TERM."""
    rc = HoldTable(RC, hold_lease=LEASE)
    for words in (said(1, touches=False), *before):
        rc.apply_grants(words, NOW)
    return rc


def grants(rc: HoldTable) -> list[int]:
    return [grant.seq for grant in rc.held]


ONE, TWO = holder(2), holder(3, "h/two")
HELD = said(2, ONE)


@pytest.mark.parametrize(
    ("heard", "now_holds", "announce", "reread"),
    [
        pytest.param(said(3, TWO), [3], False, False, id="another holder from now on"),
        pytest.param(said(3, ONE, TWO), [2, 3], False, False, id="one more holder"),
        pytest.param(said(3), [], False, False, id="nobody from now on"),
        pytest.param(said(3, touches=False), [2], False, False, id="others are touched"),
        pytest.param(said(2, ONE), [2], False, False, id="the same once more"),
        pytest.param(said(2, touches=False, prev=2), [2], False, False, id="a heartbeat"),
        pytest.param(said(9, touches=False), [2], False, True, id="a gap"),
        pytest.param(said(4, touches=False), [2], False, True, id="a gap of one publication"),
        pytest.param(said(9, TWO), [3], False, True, id="a gap, and full lists all the same"),
        pytest.param(said(9, touches=False, prev=9), [2], False, True, id="a heartbeat tells of a gap"),
        pytest.param(said(1, TWO), [2], False, False, id="an older number of this term"),
        pytest.param(said(99, TWO, term=OLD), [2], True, False, id="an older term"),
        pytest.param(said(1, ONE, term=NEW), [2], False, True, id="a new term that carries the hold on"),
        pytest.param(said(1, term=NEW), [], False, True, id="a new term that ends it"),
        pytest.param(said(1, touches=False, term=NEW), [2], False, True, id="a new term that does not say"),
        pytest.param(said(1, TWO, term=SAME_COUNTER), [3], False, True, id="of one counter the instance decides"),
        pytest.param(said(1, TWO, term=Term(TERM.counter + MAX_JUMP + 1, "x")), [2], False, False, id="an absurd term"),
        pytest.param(
            said(1, TWO, term=Term(TERM.counter + MAX_JUMP, "x")), [3], False, True, id="the highest believed"
        ),
    ],
)
def test_hear(heard: Grants, now_holds: list[int], announce: bool, reread: bool) -> None:
    rc = holding(HELD)
    change = rc.apply_grants(heard, NOW)
    assert (grants(rc), change.announce, change.reread) == (now_holds, announce, reread)
    began = {held.grant.seq for held in change.began}
    stopped = {held.grant.seq for held in change.removed}
    assert ({2} - stopped | began, bool(change)) == (set(now_holds), bool(began or stopped))
    assert change.stayed == (2 in now_holds and bool(change))


@pytest.mark.parametrize(
    ("heard", "refreshed"),
    [
        (said(2, touches=False, prev=2), True),
        (said(1, touches=False), False),
        (said(9, touches=False, term=OLD), False),
        (said(1, touches=False, term=Term(10**9, "x")), False),
        (said(1, touches=False, term=NEW), True),
    ],
)
def test_only_an_rcm_that_is_obeyed_keeps_holds_alive(heard: Grants, refreshed: bool) -> None:
    rc = holding(HELD)
    rc.apply_grants(heard, NOW + 2 * SECOND)
    assert rc.next_expiry() == NOW + LEASE + (2 * SECOND if refreshed else 0)


def test_what_is_old_counts_after_a_silence_but_not_where_this_process_stood_still() -> None:
    """A late publication, read first after a stall, is no sign that a newer one was forged."""
    late = said(1, touches=False)
    rc, stalled = holding(HELD), holding(HELD)
    assert not stalled.apply_grants(late, NOW + LEASE, stalled=True)
    assert stalled.seq == holding(HELD).seq
    assert rc.apply_grants(late, NOW + LEASE).reread
    assert rc.seq == late.seq


@pytest.mark.parametrize(
    ("read", "carries", "now_holds", "presents"),
    [
        pytest.param(state(2, view(2)), False, [2], False, id="what is known"),
        pytest.param(state(2), False, [2], True, id="a snapshot alone ends nothing"),
        pytest.param(state(5, view(4)), False, [2], True, id="another holder: it is presented, not believed"),
        pytest.param(state(5, view(4)), True, [2, 4], True, id="one more, and the device carries both"),
        pytest.param(state(5, view(2), view(4)), False, [2], True, id="one more than the device carries: presented"),
        pytest.param(state(5, view(2), view(4)), True, [2, 4], False, id="one that was missed"),
        pytest.param(state(5, view(2), view(4, rc="robot/y")), True, [2], False, id="a hold elsewhere"),
        pytest.param(state(1, view(1)), True, [2], False, id="an older snapshot"),
        pytest.param(state(9, view(4), term=OLD), True, [2], True, id="of an older term: it is told of the newer"),
        pytest.param(state(1, view(2), term=NEW), False, [2], False, id="of a new term"),
        pytest.param(state(1, term=NEW), False, [2], True, id="of a new term that knows nothing of it"),
        pytest.param(state(1, view(9), term=Term(10**9, "x")), True, [2], False, id="of a term that is absurd"),
    ],
)
def test_read(read: RcmState, carries: bool, now_holds: list[int], presents: bool) -> None:
    rc = holding(HELD)
    change = rc.apply_snapshot(read, NOW, lambda holders: carries)
    assert (grants(rc), change.announce) == (now_holds, presents)
    assert not change.removed


@pytest.mark.parametrize(("known_as", "held", "over"), [("id2", [4], [2]), ("id4", [2, 4], [])])
def test_what_is_read_under_a_newer_grant_is_not_held_twice(known_as: str, held: list[int], over: list[int]) -> None:
    """Another ARC at its place is one that was taken back, and both clients live."""
    rc = holding(HELD)
    newer = state(5, replace(view(4), id=known_as, place=Place(TERM, 2)))
    change = rc.apply_snapshot(newer, NOW, lambda holders: len(holders) == len(held))
    assert (grants(rc), [one.grant for one in change.removed]) == (held, [Grant(TERM, seq) for seq in over])


def test_what_is_read_of_a_free_rc_is_held_whole() -> None:
    rc = holding()
    change = rc.apply_snapshot(state(4, view(4, remaining=7)), NOW)
    (told,) = rc.holders(NOW + SECOND)
    assert (told.client, told.params, told.remaining) == ("h/one", {"rate": Decimal(2)}, 6.0)
    assert [held.grant for held in change.began] == [told.grant]
    # What ended here is not taken up again, whoever believes in it.
    rc.apply_grants(said(5), NOW)
    assert not rc.apply_snapshot(state(5, view(4)), NOW).began
    assert not rc.apply_grants(said(6, holder(4)), NOW).began
    assert grants(rc) == []


@pytest.mark.parametrize(
    ("term", "kept"),
    [
        (TERM, True),
        (NEW, True),
        (SAME_COUNTER, True),
        (OLD, False),
        (Term(TERM.counter + MAX_JUMP, "x"), True),
        (Term(TERM.counter + MAX_JUMP + 1, "x"), False),
    ],
)
def test_promises(term: Term, kept: bool) -> None:
    rc = holding(HELD)
    assert rc.promise(term, NOW) is kept
    assert rc.term == (term if kept else TERM)
    assert grants(rc) == [2], "a promise ends nothing"
    # A lower term than the one promised is not obeyed again; the promised one begins with any number.
    change = rc.apply_grants(said(3, TWO), NOW)
    assert grants(rc) == ([2] if kept and term > TERM else [3])
    assert change.announce is (kept and term > TERM)
    if kept and term > TERM:
        assert not rc.apply_grants(said(1, TWO, term=term, prev=0), NOW).reread
        assert grants(rc) == [3]


def test_who_has_heard_of_nobody_promises_much_but_not_everything() -> None:
    assert HoldTable(RC, hold_lease=LEASE).promise(Term(10**9, "x"), NOW)
    assert not HoldTable(RC, hold_lease=LEASE).promise(Term(2**52, "x"), NOW)
    assert HoldTable(RC, hold_lease=LEASE).term == NO_TERM


def test_who_heard_no_rcm_for_the_hold_lease_or_must_follow_the_fleet_believes_a_far_jump() -> None:
    far, rc = Term(10**9, "x"), holding(HELD)
    assert not rc.promise(far, NOW + LEASE - 1)
    assert rc.promise(far, NOW + LEASE)
    rc = holding(HELD)
    assert rc.promise(far, NOW, above=True)
    assert not rc.promise(Term(2**52, "x"), NOW, above=True)
    rc = holding(HELD)
    rc.apply_grants(said(1, TWO, term=far), NOW + LEASE)
    assert rc.term == far


@pytest.mark.parametrize(
    ("after", "lease", "ended"),
    [
        pytest.param(0, True, [], id="at once"),
        pytest.param(SECOND - 1, True, [], id="just before the first is over"),
        pytest.param(SECOND, True, [(2, "time")], id="the first is over"),
        pytest.param(2 * SECOND, True, [(2, "time"), (3, "time")], id="a kept one goes on"),
        pytest.param(LEASE - 1, True, [(2, "time"), (3, "time")], id="just within the lease"),
        pytest.param(LEASE, True, [(2, "lease"), (3, "lease"), (4, "lease")], id="the lease ends all"),
        pytest.param(LEASE, False, [(2, "time"), (3, "time")], id="not after a stall of its own"),
    ],
)
def test_expire(after: Ns, lease: bool, ended: list[tuple[int, str]]) -> None:
    rc = holding(said(2, holder(2, remaining=1), holder(3, remaining=2), holder(4, remaining=1, keep=True)))
    change = rc.expire(NOW + after, lease=lease)
    assert [(hold.grant.seq, hold.why) for hold in change.expired_locally] == ended
    assert [held.grant.seq for held in change.removed] == [seq for seq, _ in ended]
    assert grants(rc) == [seq for seq in (2, 3, 4) if seq not in dict(ended)]
    assert not rc.expire(NOW + after, lease=lease)


@pytest.mark.parametrize(
    ("holders", "due"),
    [
        ([], None),
        ([holder(2, remaining=1), holder(3, remaining=2)], NOW + SECOND),
        ([holder(2, remaining=1, keep=True)], NOW + LEASE),
        ([holder(2, remaining=60)], NOW + LEASE),
        ([holder(2, remaining=-1)], NOW - SECOND),
    ],
)
def test_next_expiry(holders: list[Holder], due: Ns | None) -> None:
    assert holding(said(2, *holders)).next_expiry() == due


Prepare = Callable[[HoldTable], HoldChange]


def heard(grants: Grants) -> Prepare:
    return lambda rc: rc.apply_grants(grants, NOW)


@pytest.mark.parametrize(
    ("prepare", "grant", "client", "code"),
    [
        pytest.param(None, Grant(TERM, 2), "h/one", None, id="its own grant"),
        pytest.param(None, Grant(TERM, 2), "h/two", "wrong_client", id="another's grant"),
        pytest.param(None, Grant(TERM, 1), "h/one", "not_holder", id="a grant that never was"),
        pytest.param(None, Grant(OLD, 2), "h/one", "not_holder", id="its number in an old term"),
        pytest.param(None, Grant(OLD, 99), "h/one", "not_holder", id="a high number of an old term"),
        pytest.param(None, Grant(TERM, 3), "h/one", "not_yet", id="newer than what was heard"),
        pytest.param(None, Grant(NEW, 1), "h/one", "not_yet", id="of a term yet unheard"),
        pytest.param(None, Grant(Term(10**9, "x"), 1), "h/one", "not_holder", id="of an absurd term"),
        pytest.param(heard(said(3, TWO)), Grant(TERM, 2), "h/one", "ended", id="replaced"),
        pytest.param(heard(said(3)), Grant(TERM, 2), "h/one", "ended", id="revoked"),
        pytest.param(heard(said(3)), Grant(TERM, 1), "h/one", "free", id="nobody holds it"),
        pytest.param(lambda rc: rc.fail("smoke", NOW), Grant(TERM, 2), "h/one", "ended", id="failed"),
        pytest.param(lambda rc: rc.expire(NOW + LEASE), Grant(TERM, 2), "h/one", "ended", id="the lease is over"),
        pytest.param(heard(said(1, ONE, term=NEW)), Grant(TERM, 2), "h/one", None, id="carried on"),
    ],
)
def test_check(prepare: Prepare | None, grant: Grant, client: str, code: str | None) -> None:
    rc = holding(HELD)
    if prepare is not None:
        prepare(rc)
    refusal = rc.check(grant, client, NOW)
    assert (refusal and refusal.code) == code
    assert refusal is None or RC in refusal.message


def test_a_command_is_judged_by_the_time_at_which_it_is_carried_out() -> None:
    rc = holding(said(2, holder(2, remaining=1)), said(3, holder(2), holder(3, remaining=1, keep=True)))
    for seq, codes in ((2, [None, "ended"]), (3, [None, None])):
        refusals = [rc.check(Grant(TERM, seq), "h/one", NOW + after) for after in (SECOND - 1, SECOND)]
        assert [refusal and refusal.code for refusal in refusals] == codes


def test_the_reason_given_with_a_revocation_is_what_a_late_command_is_told() -> None:
    rc = holding(HELD, said(3, TWO, revoked=[ONE]))
    refusal = rc.check(ONE.grant, "h/one", NOW)
    assert refusal is not None
    assert refusal.message.endswith("preempted: by an operator")


def test_a_hand_over_changes_grant_and_client_at_once() -> None:
    rc = holding(HELD)
    change = rc.apply_grants(said(3, holder(3, "h/two", place=2)), NOW)
    assert [held.client for held in change.removed] == ["h/one"]
    assert [held.client for held in change.began] == ["h/two"]
    assert change.removed[0].place == change.began[0].place
    codes = [rc.check(Grant(TERM, seq), client, NOW) for seq, client in ((2, "h/one"), (3, "h/two"))]
    assert [refusal and refusal.code for refusal in codes] == ["ended", None]


@pytest.mark.parametrize(("known_as", "interrupted"), [("id2", False), ("id3", True)])
def test_what_goes_on_in_another_client_has_its_id_and_its_place(known_as: str, interrupted: bool) -> None:
    """Taken back from a client that is gone it has a new id: the device is made safe in between."""
    goes_on = replace(holder(3, "h/two", place=2), id=known_as)
    change = holding(HELD).apply_grants(said(3, goes_on), NOW)
    assert (change.interrupts, bool(change.over)) == (interrupted, interrupted)


@pytest.mark.parametrize(
    ("after", "goes_on"),
    [
        ({"continues": "arc2"}, True),
        ({"continues": ""}, False),
        ({"continues": "another"}, False),
        ({"continues": "arc2", "client": "h/two"}, False),
        ({"continues": "arc2", "direct": True}, False),
        ({"continues": "arc2", "rcs": [RC, "video/1", "framegrabber/1"]}, True),
        ({"continues": "arc2", "rcs": [RC, "video/2"]}, False),
    ],
)
def test_a_device_goes_on_in_another_arc_of_its_client_that_says_so(after: dict[str, Any], goes_on: bool) -> None:
    """And that has all that the first had: a camera must not transmit on another's channel."""
    gang = [RC, "video/1"]
    warm, after_it = replace(ONE, rcs=gang), replace(holder(3, "h/one", place=3), rcs=gang)
    change = holding(said(2, warm)).apply_grants(said(3, replace(after_it, **after)), NOW)
    assert (change.interrupts, bool(change.over)) == (not goes_on, not goes_on)


def test_of_two_holds_of_one_name_one_goes_on_and_one_is_over() -> None:
    """At a sharable device, a radio say, that still counts what is not ended."""
    two = replace(holder(3, "h/one"), arc="arc2")
    rc = holding(said(2, ONE), said(3, ONE, two))
    change = rc.apply_grants(said(4, replace(holder(4, "h/one"), continues="arc2")), NOW)
    assert (change.removed, change.over, change.interrupts) == ([ONE, two], [two], False)


def test_a_grant_that_a_snapshot_names_is_not_refused_before_its_publication_comes() -> None:
    """A confirmation may overtake the publication: the snapshot read for it must not decide against it."""
    rc, handed_over = holding(HELD), Grant(TERM, 3)
    codes = []
    for step in (
        lambda: None,
        lambda: rc.apply_snapshot(state(3, view(3, "h/two")), NOW),
        lambda: rc.apply_grants(said(3, holder(3, "h/two", place=2)), NOW),
        lambda: rc.apply_grants(said(4), NOW),
    ):
        step()
        refusal = rc.check(handed_over, "h/two", NOW)
        codes.append(refusal and refusal.code)
    assert codes == ["not_yet", "not_yet", None, "ended"]


def test_only_so_many_ended_grants_are_remembered() -> None:
    rc = holding()
    for seq in range(2, 2 + REMEMBERED + 10):
        rc.apply_grants(said(seq, holder(seq)), NOW)
    refusals = [rc.check(Grant(TERM, seq), "h/one", NOW) for seq in (2, 2 + REMEMBERED)]
    assert [refusal and refusal.code for refusal in refusals] == ["not_holder", "ended"]


def test_an_exclusive_rc_obeys_only_the_newest_of_two_holders() -> None:
    rc = holding(HELD)
    change = rc.apply_grants(said(3, ONE, TWO), NOW, sharable=False)
    assert (grants(rc), change.announce) == ([3], True)

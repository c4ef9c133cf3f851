"""What people read of who waits for whom, who was preferred, and how something ended."""

from __future__ import annotations

import pytest

from zscout.messages import ReasonInfo, Who
from zscout.rcm.request_log import reason_info
from zscout.scheduling.reason import Party, Reason, ReasonCode, ended, named, reason_of, waits
from zscout.types import SECOND, Ns

ALICE, BOB = Who("alice", "ws1", "survey.py"), Who("bob", command="zscout take", comment="the gripper is stuck")
SURVEY = Party("ws1/c1/a", "survey", 0, ALICE, 90 * SECOND)
TAKE = Party("ws2/c2/b", "operator", 10, BOB)
FOREIGN = Party("ws3/plain/c", "mapping", 1, None, 30 * SECOND)


def at(time: Ns) -> str:
    return f"14:{time // SECOND}"


@pytest.mark.parametrize(
    ("who", "text"),
    [
        (ALICE, "arc (alice@ws1)"),
        (BOB, "arc (bob@h)"),
        (Who("carol"), "arc (carol@h)"),
        (Who(command="counter"), "arc (h/c)"),
        (Who(host="ws9"), "arc (h/c)"),
        (Who(comment="nothing else"), "arc (h/c)"),
        (None, "arc (h/c)"),
        (Who("eve\x1b[2J", "ws1\n", "rm\u202e -r"), "arc (eve [2J@ws1 )"),
    ],
)
def test_who_it_is(who: Who | None, text: str) -> None:
    assert named(who, "h/c", "arc") == text


def held(*rcs: tuple[str, Party, str], number: int = 0) -> Reason:
    names, by, patterns = zip(*rcs, strict=True)
    return Reason(ReasonCode.HELD, names, by, number=number or len(rcs), patterns=patterns if any(patterns) else ())


@pytest.mark.parametrize(
    ("reason", "text", "timed"),
    [
        (
            held(("framegrabber/fg1", SURVEY, "")),
            "waits for survey (alice@ws1): framegrabber/fg1",
            "waits for survey (alice@ws1): framegrabber/fg1, until 14:90 at the latest",
        ),
        (
            held(("robot/a", SURVEY, ""), ("robot/b", TAKE, ""), ("robot/c", SURVEY, ""), number=5),
            "waits for survey (alice@ws1): robot/a, robot/c; for operator (bob@ws2): robot/b and 2 more",
            (
                "waits for survey (alice@ws1): robot/a, robot/c, until 14:90 at the latest; "
                "for operator (bob@ws2): robot/b and 2 more"
            ),
        ),
        (
            held(("fg/0", SURVEY, "fg/*"), ("fg/1", FOREIGN, "fg/*"), ("camera/1", TAKE, "fg/*")),
            (
                "waits for one of fg/0 (held by survey (alice@ws1)), 1 (held by mapping (ws3/plain)), "
                "camera/1 (held by operator (bob@ws2))"
            ),
            (
                "waits for one of fg/0 (held by survey (alice@ws1), until 14:90 at the latest), "
                "1 (held by mapping (ws3/plain), until 14:30 at the latest), camera/1 (held by operator (bob@ws2))"
            ),
        ),
        (
            held(("fg/0", TAKE, "fg/*"), ("fg/1", TAKE, "fg/*"), number=9),
            "waits for one of fg/0 (held by operator (bob@ws2)), 1 (held by operator (bob@ws2)) and 7 more",
            None,
        ),
        (held(("fg/0", TAKE, "fg/*")), "waits for operator (bob@ws2): fg/0 for fg/*", None),
        (
            held(("fg/0", TAKE, "fg/*"), ("fg/1", SURVEY, "fg/*#2"), ("fg/2", TAKE, "fg/*#2"), number=9),
            (
                "waits for two of fg/0 (held by operator (bob@ws2)), 1 (held by survey (alice@ws1)), "
                "2 (held by operator (bob@ws2)) and 6 more"
            ),
            None,
        ),
        (
            held(("a/0", TAKE, "a/*"), ("a/1", TAKE, "a/*"), ("fg/0", TAKE, "fg/*"), ("fg/1", TAKE, "fg/*#2")),
            (
                "waits for one of a/0 (held by operator (bob@ws2)), 1 (held by operator (bob@ws2)); "
                "for two of fg/0 (held by operator (bob@ws2)), 1 (held by operator (bob@ws2))"
            ),
            None,
        ),
        (
            Reason(ReasonCode.VETOED, ("radio/rf0",), (SURVEY,), "12 of 10", 1),
            "waits for survey (alice@ws1): radio/rf0 refuses more: 12 of 10",
            "waits for survey (alice@ws1), until 14:90 at the latest: radio/rf0 refuses more: 12 of 10",
        ),
        (
            Reason(ReasonCode.VETOED, ("radio/rf0",), (SURVEY, FOREIGN), "12 of 10", 3, "radio/*"),
            (
                "waits for survey (alice@ws1) and mapping (ws3/plain) and 1 more: "
                "radio/rf0 for radio/* refuses more: 12 of 10"
            ),
            None,
        ),
        (
            Reason(ReasonCode.VETOED, ("radio/rf0", "radio/rf1"), (SURVEY,), "12 of 10", 1, "radio/*"),
            "waits for one of radio/rf0, rf1: radio/rf0 refuses: 12 of 10",
            None,
        ),
        (Reason(ReasonCode.VETOED, ("radio/rf0",), (), "50 of 10"), "radio/rf0 refuses: 50 of 10", None),
    ],
)
def test_who_blocks_whom_comes_first_and_choices_are_named_as_such(
    reason: Reason, text: str, timed: str | None
) -> None:
    assert str(reason) == text
    if timed is not None:
        assert reason.text(at) == timed
    assert waits(text, reason) == (text if text.startswith("waits for ") else f"waits: {text}")
    for of_older in (None, ReasonInfo("of_a_newer_version")):
        assert waits("votes are out", of_older) == "waits: votes are out"
    info = reason_info(reason, 0)
    assert reason_of(info) == (reason if reason.by else None)
    assert waits(text, info) == waits(text, reason)


def test_to_whom_it_was_lost_and_why_is_told_once() -> None:
    preempted = Reason(ReasonCode.PREEMPTED, by=(TAKE,))
    assert (
        ended("preempted", str(preempted), preempted)
        == "preempted by operator (bob@ws2), priority 10: the gripper is stuck"
    )
    displaced = Reason(ReasonCode.DISPLACED, by=(TAKE,))
    assert ended("completed", str(displaced), displaced) == (
        "completed: its minimum runtime is over, and operator (bob@ws2), priority 10, needs it: the gripper is stuck"
    )
    cancelled, released = Reason(ReasonCode.CANCELLED), Reason(ReasonCode.RELEASED, detail="bob@ws2")
    assert ended("cancelled", str(cancelled), cancelled) == "cancelled by its client"
    assert ended("released", str(released), reason_info(released, 0)) == "released by bob@ws2"
    left = Reason(ReasonCode.CLIENT_LOST, detail="its client left the mesh")
    assert ended("client_lost", str(left), left) == "client lost: its client left the mesh"
    assert ended("lost", "", None) == "lost"


def test_an_end_by_its_own_client_is_a_field() -> None:
    own, other = (reason_info(Reason(ReasonCode.RELEASED, detail=by), 0) for by in ("", "bob@ws2"))
    assert own == ReasonInfo("released", detail="its client", own=True)
    assert other == ReasonInfo("released", detail="bob@ws2")


def test_a_view_may_name_requests_otherwise() -> None:
    info = reason_info(Reason(ReasonCode.PREEMPTED, by=(TAKE,)), 0)
    assert str(reason_of(info, lambda party: f"lane {party.arc}")) == (
        "preempted by lane operator, priority 10: the gripper is stuck"
    )


def test_control_characters_of_a_comment_are_not_passed_on() -> None:
    loud = TAKE._replace(who=Who("bob", comment="a\x1b]0;b\x07\nc"))
    assert str(Reason(ReasonCode.PREEMPTED, by=(loud,))).endswith(", priority 10: a ]0;b  c")

"""What people read of who waits for whom, who was preferred, and how something ended."""

from __future__ import annotations

import pytest

from zscout.messages import Who
from zscout.scheduling.reason import Party, Reason, ReasonCode, ended, named, waits
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
        (ALICE, "alice@ws1 (survey.py)"),
        (BOB, "bob@h (zscout take)"),
        (Who("carol"), "carol@h (arc)"),
        (Who(command="counter"), "h (counter)"),
        (Who(host="ws9"), "h/c (arc)"),
        (Who(comment="nothing else"), "h/c (arc)"),
        (None, "h/c (arc)"),
        (Who("eve\x1b[2J", "ws1\n", "rm\u202e -r"), "eve [2J@ws1  (rm  -r)"),
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
            "waits for alice@ws1 (survey.py): framegrabber/fg1",
            "waits for alice@ws1 (survey.py): framegrabber/fg1, until 14:90 at the latest",
        ),
        (
            held(("robot/a", SURVEY, ""), ("robot/b", TAKE, ""), ("robot/c", SURVEY, ""), number=5),
            "waits for alice@ws1 (survey.py): robot/a, robot/c; for bob@ws2 (zscout take): robot/b and 2 more",
            (
                "waits for alice@ws1 (survey.py): robot/a, robot/c, until 14:90 at the latest; "
                "for bob@ws2 (zscout take): robot/b and 2 more"
            ),
        ),
        (
            held(("fg/0", SURVEY, "fg/*"), ("fg/1", FOREIGN, "fg/*"), ("camera/1", TAKE, "fg/*")),
            (
                "waits for one of fg/0 (held by alice@ws1 (survey.py)), 1 (held by ws3/plain (mapping)), "
                "camera/1 (held by bob@ws2 (zscout take))"
            ),
            (
                "waits for one of fg/0 (held by alice@ws1 (survey.py), until 14:90 at the latest), "
                "1 (held by ws3/plain (mapping), until 14:30 at the latest), camera/1 (held by bob@ws2 (zscout take))"
            ),
        ),
        (
            held(("fg/0", TAKE, "fg/*"), ("fg/1", TAKE, "fg/*"), number=9),
            "waits for one of fg/0 (held by bob@ws2 (zscout take)), 1 (held by bob@ws2 (zscout take)) and 7 more",
            None,
        ),
        (held(("fg/0", TAKE, "fg/*")), "waits for bob@ws2 (zscout take): fg/0 for fg/*", None),
        (
            Reason(ReasonCode.VETOED, ("radio/rf0",), (SURVEY,), "12 of 10", 1),
            "waits for alice@ws1 (survey.py): radio/rf0 refuses more: 12 of 10",
            "waits for alice@ws1 (survey.py), until 14:90 at the latest: radio/rf0 refuses more: 12 of 10",
        ),
        (
            Reason(ReasonCode.VETOED, ("radio/rf0",), (SURVEY, FOREIGN), "12 of 10", 3, "radio/*"),
            (
                "waits for alice@ws1 (survey.py) and ws3/plain (mapping) and 1 more: "
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
    assert waits(text) == (text if text.startswith("waits for ") else f"waits: {text}")


def test_to_whom_it_was_lost_and_why_is_told_once() -> None:
    preempted = Reason(ReasonCode.PREEMPTED, by=(TAKE,))
    assert ended("preempted", str(preempted)) == "preempted by bob@ws2 (zscout take), priority 10: the gripper is stuck"
    displaced = Reason(ReasonCode.DISPLACED, by=(TAKE,))
    assert ended("completed", str(displaced)) == (
        "completed: its minimum runtime is over, and bob@ws2 (zscout take), priority 10, needs it: the gripper is stuck"
    )
    assert ended("cancelled", "cancelled by its client") == "cancelled by its client"
    assert ended("client_lost", "its client left the mesh") == "client lost: its client left the mesh"
    assert ended("lost", "") == "lost"


def test_control_characters_of_a_comment_are_not_passed_on() -> None:
    loud = TAKE._replace(who=Who("bob", comment="a\x1b]0;b\x07\nc"))
    assert str(Reason(ReasonCode.PREEMPTED, by=(loud,))).endswith(", priority 10: a ]0;b  c")

"""What a waiting request prints in a pipe: a short line for each reason, once."""

from __future__ import annotations

import asyncio
import io
import json
import re
from collections.abc import Callable
from decimal import Decimal
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.cli.tools import CLOCK
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.request import OpenArc
from zscout.cli.requests import request
from zscout.cli.requests.request import Report
from zscout.messages import HoldView, RcmState, RcView, ReasonInfo, ReasonParty, Who
from zscout.types import SECOND, Grant, Place, Term

TERM = Term(1, "rcm")
ALICE = Who("alice", "ws1", "train.py")
HOLD = HoldView(
    "a1", "train", "ws1/c1", 0, Grant(TERM, 1), Place(TERM, 1), {"gpu/0": {}}, Decimal(60), 5, 1200, True, who=ALICE
)
STATE = RcmState(TERM, 1, "anvil", [HOLD], rcs=[RcView("gpu/0", present=True, sharable=False)])
HELD = ReasonInfo("held", ["gpu/0"], [ReasonParty("ws1/c1", "train", "a1", 0, ALICE, 1200)])
BY_TRAIN = ("waits for train (alice@ws1): gpu/0", HELD, 0)
BEHIND_ONE = ("waits for train (alice@ws1): gpu/0", HELD, 1)
UNDECIDED = ("votes are out", ReasonInfo("voting"), 0)
LINE = rf"next waits for train \(alice@ws1\): gpu/0, until {CLOCK} at the latest"
START = rf"starts at {CLOCK} \(in 20 min\)"

News = tuple[str, ReasonInfo, int]


def printed(
    monkeypatch: pytest.MonkeyPatch, *courses: News, as_json: bool = False, pause: float = 0.1, quiet: bool = False
) -> list[str]:
    """The lines for what a waiting request learns, one after the other."""
    monkeypatch.setattr(request, "REFRESH_INTERVAL_S", 0.02)
    out, looks = io.StringIO(), 0

    async def state() -> RcmState:
        nonlocal looks
        looks += 1
        return STATE

    now: Callable[[], int] = lambda: round(asyncio.get_running_loop().time() * SECOND)  # noqa: E731
    mesh = SimpleNamespace(me=SimpleNamespace(host="desk"), now=now)
    fleet = SimpleNamespace(security=None)
    client = SimpleNamespace(mesh=mesh, fleet=fleet, who=Who("bob", "desk"), state=state)

    async def wait() -> None:
        arc = OpenArc("b1", "next", {"gpu/0": {}}, 0, Decimal(60), keep=True)
        arc.state, arc.since = "queued", now()
        with Report("next", cast("Client", client), as_json=as_json, stream=out) as report:
            async with report.following(report.follow_wait(quiet=quiet)):
                for arc.reason, arc.why, arc.ahead in courses:
                    arc._notified_at, arc.start = now(), now() + 1200 * SECOND
                    report.news(arc)
                    await asyncio.sleep(pause)

    asyncio.run(wait())
    return out.getvalue().splitlines()


def test_a_line_names_the_holder_once(monkeypatch: pytest.MonkeyPatch) -> None:
    (line,) = printed(monkeypatch, BY_TRAIN)
    assert re.fullmatch(f"{LINE}; {START}", line)


def test_a_moment_without_a_decision_prints_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    courses = [UNDECIDED, BY_TRAIN, UNDECIDED, BY_TRAIN]
    assert len(printed(monkeypatch, *courses, pause=0.005)) == 1


def test_what_stays_undecided_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    (line,) = printed(monkeypatch, UNDECIDED)
    assert re.fullmatch(f"next waits: votes are out; {START}", line)


def test_a_new_place_in_the_queue_does_not_repeat_the_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    first, then = printed(monkeypatch, BEHIND_ONE, BY_TRAIN)
    assert re.fullmatch(f"{LINE}; 1 ahead; {START}", first)
    assert re.fullmatch(f"next waits: nobody ahead; {START}", then)


def test_who_tries_once_reads_the_reason_in_the_error_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    assert printed(monkeypatch, BY_TRAIN, quiet=True) == []
    assert len(printed(monkeypatch, BY_TRAIN, quiet=True, as_json=True)) == 1


def test_programs_get_the_holders(monkeypatch: pytest.MonkeyPatch) -> None:
    (line,) = printed(monkeypatch, BY_TRAIN, as_json=True)
    (need,) = cast("list[dict[str, Any]]", json.loads(line)["needs"])
    assert [(holder["rc"], holder["arc"]) for holder in need["holders"]] == [("gpu/0", "train")]

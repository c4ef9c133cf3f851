"""What `zscout why` prints of the requests in the way, and of the user's own among them."""

from __future__ import annotations

from decimal import Decimal

import pytest
from msgspec import structs

from zscout.cli.ownership import User
from zscout.cli.requests.waiting import hold_json
from zscout.cli.requests.why import _print
from zscout.messages import HoldView, ReasonInfo, ReasonParty, WaitView, Who
from zscout.types import Grant, Place, Term

TERM = Term(1, "rcm")
ALICE = Who("alice", "ws1", "train.py")
HOLD = HoldView(
    "a1", "train", "ws1/c1", 0, Grant(TERM, 1), Place(TERM, 1), {"gpu/0": {}}, Decimal(60), 5, 1200, True, who=ALICE
)
HELD = ReasonInfo("held", ["gpu/0"], [ReasonParty("ws1/c1", "train", "a1", 0, ALICE, 1200)])
WAIT = WaitView("b1", "next", "ws1/c2", 0, Place(TERM, 2), {"gpu/0": {}}, Decimal(60), 3, "waits for train", why=HELD)


@pytest.mark.parametrize(
    ("me", "train"),
    [
        (User("alice", "ws2"), "your own request train"),
        (User("bob", "ws1"), "train (alice@ws1)"),
        (User("alice", "ws2", proved=True), "train (alice@ws1)"),
    ],
)
def test_own_requests_in_the_way_are_named_as_such(me: User, train: str, capsys: pytest.CaptureFixture[str]) -> None:
    holder = hold_json(HOLD) | {"rc": "gpu/0", "params": {}}
    need = {"need": "gpu/0", "rc": "gpu/0", "params": {}, "present": True, "sharable": False, "free": []}
    need |= {"holders": [holder], "health": None}
    arc = structs.asdict(WAIT) | {"state": "queued", "needs": [need], "story": [], "ahead": 0, "queued": 1}
    _print(arc, me)
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("next (ws1/c2), priority 0, has waited since ")
    assert lines[2].startswith(f"  waits for {train}: gpu/0, until ")
    assert any(line.startswith(f"  gpu/0: held by {train}, priority 0, since ") for line in lines)

"""Publications and holds as data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from decimal import Decimal
from typing import Any

from zscout.messages import Grants, Holder, PastHold, Revocation, Who
from zscout.services.journal.follower import PublicationReceived
from zscout.types import Grant, Place, Term

TERM = Term(1, "rcm")
LATER = Term(2, "heir")


def grant(seq: int, term: Term = TERM) -> Grant:
    return Grant(term, seq)


def holder(seq: int, *rcs: str, arc: str = "survey", client: str = "desk/one", term: Term = TERM) -> Holder:
    who = Who("alice", "ws1", "./survey.py")
    return Holder(f"id-{arc}", arc, client, grant(seq, term), Place(term, 1), [*rcs], Decimal(60), 60.0, 5, who=who)


def over(seq: int, outcome: str, *rcs: str, arc: str = "survey", term: Term = TERM, **more: Any) -> Revocation:
    return Revocation(f"id-{arc}", arc, "desk/one", grant(seq, term), [*rcs], outcome, f"it {outcome}", **more)


def published(
    seq: int,
    holders: Sequence[Holder] = (),
    revoked: Sequence[Revocation] = (),
    *,
    prev: int | None = None,
    term: Term = TERM,
    begun: Mapping[int, float] | None = None,
) -> Grants:
    rcs: dict[str, list[Holder]] = {}
    for one in holders:
        for rc in one.rcs:
            rcs.setdefault(rc, []).append(one)
    for ended in revoked:
        for rc in ended.rcs:
            rcs.setdefault(rc, [])
    return Grants(term, seq, seq - 1 if prev is None else prev, 0.5, rcs, [*revoked], begun=[*(begun or {}).items()])


def heard(at: float, grants: Grants, silence: float = 0.5) -> PublicationReceived:
    return PublicationReceived(at, silence, grants)


def past(seq: int, began: float, ended: float | None = None, outcome: str = "", **more: Any) -> PastHold:
    known: dict[str, Any] = {
        "id": f"id-{seq}",
        "arc": "survey",
        "client": "desk/one",
        "rcs": ["robot/a"],
        "min_runtime": 60.0,
        "waited": 0.0,
    }
    return PastHold(grant=grant(seq), began=began, ended=ended, outcome=outcome, **(known | more))

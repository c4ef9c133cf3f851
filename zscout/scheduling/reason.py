"""Why an ARC waits, or why a hold or a wait ended: data in effects and messages, text where people read it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from enum import StrEnum
from typing import Final, NamedTuple

from zscout.types import ArcId, Need, RcName

SHOWN = 3
"""How many RCs a reason names; it counts the rest."""


class ReasonCode(StrEnum):
    # An ARC waits:
    ABSENT = "absent"
    """`rcs` are not on the mesh."""
    NO_MATCH = "no_match"
    """No RC is left for the patterns in `rcs`."""
    HELD = "held"
    """`rcs` are held by `by`, one each, who are not preempted for it."""
    VETOED = "vetoed"
    """The RC refuses it beside those who hold it; `detail` in the RC's own words."""
    UNCONFIRMED = "unconfirmed"
    """`rcs` did not confirm a grant: it is not granted again for a while."""
    CLAIMED = "claimed"
    """The client `detail` has an ARC of the same place: one of the two may run."""
    SILENT = "silent"
    """`rcs` do not answer proposals."""
    RESERVED = "reserved"
    """The RC is reserved for `by`, which has waited too long."""
    QUOTA = "quota"
    """`detail`, its host, has its quota of ARCs running: `number`."""
    VOTING = "voting"
    """Votes on it, or on one that ranks before it, are out."""
    SEARCHING = "searching"
    """A search for a better schedule is under way."""
    # A hold, or a wait, ended:
    EXPIRED = "expired"
    """Its minimum runtime is over."""
    LIMIT = "limit"
    """It had the longest time that the fleet gives a hold."""
    PREEMPTED = "preempted"
    """By `by`."""
    DISPLACED = "displaced"
    """A kept hold past its minimum runtime, by `by`."""
    CANCELLED = "cancelled"
    """By `detail`."""
    RELEASED = "released"
    """By `detail`."""
    CLIENT_LOST = "client_lost"
    """`detail` says how."""
    HANDED_OVER = "handed_over"
    """To the client `detail`."""
    RC_LOST = "rc_lost"
    """The RC left; `detail` says why, if that is known."""
    RC_ENDED = "rc_ended"
    """The RC ended the hold."""
    SUPERSEDED = "superseded"
    """At a takeover the RC had a newer holder."""


class Party(NamedTuple):
    """An ARC that is in another's way, or was preferred to it."""

    arc: ArcId
    name: str
    priority: int

    def __str__(self) -> str:
        return f"{self.name}, priority {self.priority}"


class Reason(NamedTuple):
    """A reason; `str` of it is its text. `number` counts `rcs`, of which the first `SHOWN` are named, or is a quota."""

    code: ReasonCode
    rcs: tuple[RcName, ...] = ()
    by: tuple[Party, ...] = ()
    detail: str = ""
    number: int = 0
    pattern: Need | None = None
    """Which pattern of its needs keeps the ARC out; the rest is about one of the RCs that meet it."""

    def __str__(self) -> str:
        text = _TEXTS[self.code](self)
        return text if self.pattern is None else f"no {self.pattern} is to be had: {text}"


def of_rcs(code: ReasonCode, rcs: Sequence[RcName]) -> Reason:
    """A reason that concerns all of `rcs`."""
    return Reason(code, tuple(rcs[:SHOWN]), number=len(rcs))


def _listed(reason: Reason, shown: Iterable[str] | None = None) -> str:
    more = f" and {reason.number - SHOWN} more" if reason.number > SHOWN else ""
    return ", ".join(shown or reason.rcs) + more


_TEXTS: Final[Mapping[ReasonCode, Callable[[Reason], str]]] = {
    ReasonCode.ABSENT: lambda one: f"{_listed(one)} not on the mesh",
    ReasonCode.NO_MATCH: lambda one: f"no RC on the mesh is left for {_listed(one)}",
    ReasonCode.HELD: lambda one: (
        "needs " + _listed(one, [f"{rc} (held by {by})" for rc, by in zip(one.rcs, one.by, strict=True)])
    ),
    ReasonCode.VETOED: lambda one: f"{one.rcs[0]} refuses" + (f": {one.detail}" if one.detail else ""),
    ReasonCode.SILENT: lambda one: f"{_listed(one)} does not answer",
    ReasonCode.UNCONFIRMED: lambda one: f"{_listed(one)} did not confirm the grant",
    ReasonCode.CLAIMED: lambda one: f"{one.detail} claims it as well",
    ReasonCode.RESERVED: lambda one: (
        f"{one.rcs[0]} is kept for {one.by[0].name}, whose time to wait is over before this ends"
    ),
    ReasonCode.QUOTA: lambda one: f"host {one.detail} has {one.number} ARCs running, its quota",
    ReasonCode.VOTING: lambda _: "votes are out",
    ReasonCode.SEARCHING: lambda _: "a better schedule is sought",
    ReasonCode.EXPIRED: lambda _: "its minimum runtime is over",
    ReasonCode.LIMIT: lambda _: "it had the longest time that this fleet gives a hold (max_runtime)",
    ReasonCode.PREEMPTED: lambda one: f"preempted by {one.by[0]}",
    ReasonCode.DISPLACED: lambda one: f"its minimum runtime is over and {one.by[0]}, needs its RCs",
    ReasonCode.CANCELLED: lambda one: f"cancelled by {one.detail}",
    ReasonCode.RELEASED: lambda one: f"released by {one.detail}",
    ReasonCode.CLIENT_LOST: lambda one: one.detail,
    ReasonCode.HANDED_OVER: lambda one: f"handed over to {one.detail}",
    ReasonCode.RC_LOST: lambda one: f"{one.rcs[0]} was lost" + (f": {one.detail}" if one.detail else ""),
    ReasonCode.RC_ENDED: lambda one: f"{one.rcs[0]} ended the hold",
    ReasonCode.SUPERSEDED: lambda one: f"{one.rcs[0]} has a newer holder",
}

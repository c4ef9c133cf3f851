"""Why an ARC waits, or why a hold or a wait ended: data in effects and messages, text where people read it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import StrEnum
from itertools import groupby
from typing import Final, NamedTuple

from zscout.messages import Who
from zscout.types import ArcId, ClientId, Need, Ns, RcName, clean

ITS_CLIENT: Final = "its client"
"""In the `detail` of an end: it was its own client's will."""
SHOWN = 3
"""How many RCs a reason names; it counts the rest."""
SHOWN_CHOICES = 8
"""The same where RCs are choices for a pattern."""


class ReasonCode(StrEnum):
    # An ARC waits:
    ABSENT = "absent"
    """`rcs` are not on the mesh, or can't carry anybody; `detail` says why, as far as that is known."""
    NO_MATCH = "no_match"
    """No RC is left for the patterns in `rcs`; `detail` says why RCs that would do are lost."""
    HELD = "held"
    """`rcs` are held by `by`, one each, who are not preempted for it; of a pattern all its choices are told. `detail`
    is the group of one that was preferred by fair shares."""
    VETOED = "vetoed"
    """The RC refuses it beside `by`, who hold it and are not preempted for it; `detail` in the RC's own words."""
    UNCONFIRMED = "unconfirmed"
    """`rcs` did not confirm a grant: it is not granted again for a while."""
    CLAIMED = "claimed"
    """The client `detail` has an ARC of the same place: one of the two may run."""
    SILENT = "silent"
    """`rcs` do not answer proposals."""
    RESERVED = "reserved"
    """The RC is reserved for `by`, which has waited too long."""
    BOOKED = "booked"
    """The RC is booked by `by` before this would be over."""
    MAINTENANCE = "maintenance"
    """The RC is in maintenance, `by` says whose and until when; or will be before this would be over. For that a kept
    hold ends as well."""
    NOT_YET = "not_yet"
    """It has taken up a booking, whose time is still to come."""
    QUOTA = "quota"
    """`detail`, its host, has its quota of ARCs running: `number`."""
    RC_QUOTA = "rc_quota"
    """With it `detail`, a name or a group, would hold more RCs than its quota: `number`."""
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
    """An ARC that is in another's way, or was preferred to it; `str` of it says whose it is."""

    arc: ArcId
    name: str
    priority: int
    who: Who | None = None
    until: Ns | None = None
    """When it holds no more, or may be preempted for the other, at the latest; None: not known."""

    def __str__(self) -> str:
        return named(self.who, self.arc.rpartition("/")[0], self.name)

    @property
    def comment(self) -> str:
        """What its user wants others to know, as it ends a sentence."""
        return f": {clean(self.who.comment)}" if self.who is not None and self.who.comment else ""


def named(who: Who | None, client: ClientId, arc: str) -> str:
    """Whose ARC that is, for people: `alice@ws1 (survey.py)`; the client and the ARC's name, `ws1/c7 (survey)`, where
    nobody says more."""
    if who is None or not (who.user or who.command):
        return f"{client} ({arc})" if client else arc
    host = who.host or client.partition("/")[0]
    return clean(f"{who.user}@{host}" if who.user else host) + f" ({clean(who.command or arc)})"


Until = Callable[[Ns], str]
"""How the end of another's hold is told: `14:32`."""


class Reason(NamedTuple):
    """A reason; `str` of it is its text. `number` counts `rcs`, of which the first `SHOWN` (with `patterns`
    `SHOWN_CHOICES`) are named, or is a quota."""

    code: ReasonCode
    rcs: tuple[RcName, ...] = ()
    by: tuple[Party, ...] = ()
    detail: str = ""
    number: int = 0
    pattern: Need | None = None
    """Which pattern of its needs keeps the ARC out; the rest is about one of the RCs that meet it, or with `patterns`
    about all of them."""
    patterns: tuple[Need, ...] = ()
    """By each of `rcs` the pattern that it is a choice for, empty where the ARC names it."""

    def __str__(self) -> str:
        return self.text()

    def text(self, until: Until | None = None) -> str:
        """In words; with `until` also until when others hold what is waited for."""
        if self.code is ReasonCode.HELD:
            return _held(self, until)
        if self.code is ReasonCode.VETOED:
            return _vetoed(self, until)
        text = _TEXTS[self.code](self)
        if self.code is ReasonCode.MAINTENANCE:
            text += _last(self.by[0], until)
        return text if self.pattern is None else f"no {self.pattern} is to be had: {text}"


def waits(reason: str) -> str:
    """How something waits, after its name: `waits for alice@ws1 (survey.py): robot/a`, `waits: votes are out`."""
    return reason if reason.startswith("waits ") else f"waits: {reason}"


def ended(outcome: str, reason: str) -> str:
    """How something ended: `preempted by ...`, `lost: robot/a ended the hold`."""
    word = outcome.replace("_", " ")
    return reason if reason.startswith(word) else f"{word}: {reason}" if reason else word


def of_rcs(code: ReasonCode, rcs: Sequence[RcName], detail: str = "") -> Reason:
    """A reason that concerns all of `rcs`."""
    return Reason(code, tuple(rcs[:SHOWN]), number=len(rcs), detail=detail)


def _last(party: Party, until: Until | None) -> str:
    return "" if until is None or party.until is None else f", until {until(party.until)} at the latest"


def _vetoed(reason: Reason, until: Until | None) -> str:
    words = f": {reason.detail}" if reason.detail else ""
    shown = list(dict.fromkeys(f"{party}{_last(party, until)}" for party in reason.by))
    others = reason.number - len(shown)
    shown += [f"{others} more"] if others > 0 else []
    if len(reason.rcs) > 1:
        return f"waits for one of {', '.join(short_names(reason.rcs))}: {reason.rcs[0]} refuses{words}"
    rc = reason.rcs[0] + (f" for {reason.pattern}" if reason.pattern is not None else "")
    return f"waits for {' and '.join(shown)}: {rc} refuses more{words}" if shown else f"{rc} refuses{words}"


def short_names(rcs: Iterable[RcName]) -> Iterator[RcName]:
    """RCs in a row: a kind is not said twice."""
    last = ""
    for rc in rcs:
        kind = rc.partition("/")[0] + "/"
        yield rc.removeprefix(kind) if kind == last else rc
        last = kind


def _held(reason: Reason, until: Until | None) -> str:
    """Who holds what is waited for: first those in the way of what the ARC names, then for each pattern its choices."""
    patterns = reason.patterns or ("",) * len(reason.rcs)
    held = list(zip(reason.rcs, reason.by, patterns, strict=False))
    parts = []
    for party in dict.fromkeys(party for _, party, pattern in held if not pattern):
        rcs = ", ".join(rc for rc, one, pattern in held if not pattern and one == party)
        parts.append(f"{party}: {rcs}{_last(party, until)}")
    for pattern, group in groupby((one for one in held if one[2]), key=lambda one: one[2]):
        choices = list(group)
        if len(choices) == 1 and reason.number <= len(held):
            rc, party, _ = choices[0]
            parts.append(f"{party}: {rc} for {pattern}{_last(party, until)}")
            continue
        names = short_names(rc for rc, _, _ in choices)
        shown = [f"{rc} (held by {one[1]}{_last(one[1], until)})" for rc, one in zip(names, choices, strict=True)]
        parts.append(f"one of {', '.join(shown)}")
    more = f" and {reason.number - len(held)} more" if reason.number > len(held) else ""
    preferred = f"; by fair shares {reason.detail} goes first" if reason.detail else ""
    return f"waits for {'; for '.join(parts)}{more}{preferred}"


def _listed(reason: Reason) -> str:
    more = f" and {reason.number - SHOWN} more" if reason.number > SHOWN else ""
    return ", ".join(reason.rcs) + more


def _because(reason: Reason) -> str:
    return f" ({reason.detail})" if reason.detail else ""


_TEXTS: Final[Mapping[ReasonCode, Callable[[Reason], str]]] = {
    ReasonCode.ABSENT: lambda one: (
        f"{one.rcs[0]} is lost: {one.detail}"
        if one.detail and one.number == 1
        else f"{_listed(one)} not on the mesh{_because(one)}"
    ),
    ReasonCode.NO_MATCH: lambda one: f"no device on the mesh is left for {_listed(one)}{_because(one)}",
    ReasonCode.SILENT: lambda one: f"{_listed(one)} does not answer",
    ReasonCode.UNCONFIRMED: lambda one: f"{_listed(one)} did not confirm the grant",
    ReasonCode.CLAIMED: lambda one: f"{one.detail} claims it as well",
    ReasonCode.RESERVED: lambda one: (
        f"{one.rcs[0]} is kept for {one.by[0]}, whose time to wait is over before this ends"
    ),
    ReasonCode.BOOKED: lambda one: f"{one.rcs[0]} is booked by {one.by[0]} before this would be over",
    ReasonCode.MAINTENANCE: lambda one: f"maintenance of {one.rcs[0]} by {one.by[0]}",
    ReasonCode.NOT_YET: lambda _: "the time of its booking is still to come",
    ReasonCode.QUOTA: lambda one: f"host {one.detail} has {one.number} requests running, its quota",
    ReasonCode.RC_QUOTA: lambda one: f"{one.detail} may hold {one.number} devices at one time",
    ReasonCode.VOTING: lambda _: "votes are out",
    ReasonCode.SEARCHING: lambda _: "a better schedule is sought",
    ReasonCode.EXPIRED: lambda _: "its minimum runtime is over",
    ReasonCode.LIMIT: lambda _: "it had the longest time that this fleet gives a hold (max_runtime)",
    ReasonCode.PREEMPTED: lambda one: f"preempted by {one.by[0]}, priority {one.by[0].priority}{one.by[0].comment}",
    ReasonCode.DISPLACED: lambda one: (
        f"its minimum runtime is over, and {one.by[0]}, priority {one.by[0].priority}, needs it{one.by[0].comment}"
    ),
    ReasonCode.CANCELLED: lambda one: f"cancelled by {one.detail}",
    ReasonCode.RELEASED: lambda one: f"released by {one.detail}",
    ReasonCode.CLIENT_LOST: lambda one: one.detail,
    ReasonCode.HANDED_OVER: lambda one: f"handed over to {one.detail}",
    ReasonCode.RC_LOST: lambda one: f"{one.rcs[0]} was lost" + (f": {one.detail}" if one.detail else ""),
    ReasonCode.RC_ENDED: lambda one: f"{one.rcs[0]} ended the hold",
    ReasonCode.SUPERSEDED: lambda one: f"{one.rcs[0]} has a newer holder",
}

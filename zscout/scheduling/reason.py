"""Reasons for a wait or an end: data in effects and messages, text for people."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from enum import StrEnum
from itertools import groupby
from typing import Final, NamedTuple

from zscout.messages import ReasonInfo, ReasonParty, Who
from zscout.types import SECOND, ArcId, ClientId, Need, Ns, RcName, clean

ITS_CLIENT: Final = "its client"
SHOWN = 3
"""RCs that a reason names; the rest are counted."""
SHOWN_CHOICES = 8
"""The same for choices of a pattern."""


class ReasonCode(StrEnum):
    # An ARC waits:
    ABSENT = "absent"
    """`rcs` are not on the mesh or can't carry holders; `detail`: the cause, if known."""
    UNWELL = "unwell"
    """`rcs` are unwell, and granted to operators only; `detail`: the cause."""
    NO_MATCH = "no_match"
    """No RC is left for the patterns in `rcs`; `detail`: why matching RCs are lost or unwell."""
    HELD = "held"
    """`rcs` are held by `by`, one each, which it may not preempt; for a pattern, all choices. `detail`: the group
    preferred by fair shares."""
    VETOED = "vetoed"
    """The RC refuses it beside the holders `by`, which it may not preempt; `detail`: the RC's own words."""
    UNCONFIRMED = "unconfirmed"
    """`rcs` did not confirm a grant: it is not granted again for a while."""
    CLAIMED = "claimed"
    SILENT = "silent"
    RESERVED = "reserved"
    BOOKED = "booked"
    """The RC is booked by `by` for a time before the ARC would end."""
    MAINTENANCE = "maintenance"
    """The RC is in maintenance by `by`, or will be before the ARC would end. It also ends kept holds."""
    BROKEN = "broken"
    """`by` has reported that the RC is broken: it is granted to operators only."""
    NOT_YET = "not_yet"
    QUOTA = "quota"
    """`detail`, its host, has its quota of ARCs running: `number`."""
    RC_QUOTA = "rc_quota"
    """With this ARC `detail`, a name or a group, would hold more RCs than its quota: `number`."""
    VOTING = "voting"
    """Votes on it or on a higher rank are out."""
    SEARCHING = "searching"
    # A hold, or a wait, ended:
    EXPIRED = "expired"
    LIMIT = "limit"
    """It lasted for the fleet's `max_runtime`."""
    PREEMPTED = "preempted"
    DISPLACED = "displaced"
    """A kept hold past its minimum runtime, by `by`."""
    CANCELLED = "cancelled"
    RELEASED = "released"
    """By `detail`, as CANCELLED; empty: by its own client."""
    CLIENT_LOST = "client_lost"
    HANDED_OVER = "handed_over"
    """To the client `detail`."""
    RC_LOST = "rc_lost"
    """The RC left; `detail`: the cause, if known."""
    RC_ENDED = "rc_ended"
    SUPERSEDED = "superseded"


class Party(NamedTuple):
    """An ARC that is in the way of another or preferred to it; `str` is its name and its person."""

    arc: ArcId
    name: str
    priority: int
    who: Who | None = None
    until: Ns | None = None
    """When its hold ends or may be preempted, at the latest; None: unknown."""
    label: str = ""
    """The text of `str` in views that describe it in other words."""

    def __str__(self) -> str:
        return self.label or named(self.who, self.arc.rpartition("/")[0], self.name)

    @property
    def comment(self) -> str:
        """Its user's comment for others, as the end of a sentence."""
        return f": {clean(self.who.comment)}" if self.who is not None and self.who.comment else ""


def person(who: Who | None, client: ClientId) -> str:
    """The person of an ARC: `alice@ws1`; its client, `ws1/c7`, if it names no user."""
    host = "" if who is None else who.host or client.partition("/")[0]
    return clean(client if who is None or not who.user else f"{who.user}@{host}" if host else who.user)


def named(who: Who | None, client: ClientId, arc: str) -> str:
    """An ARC by its name and its person, for people: `survey (alice@ws1)`."""
    by = person(who, client)
    return f"{clean(arc)} ({by})" if by else clean(arc)


Until = Callable[[Ns], str]
"""Formats the end of a hold: `14:32`."""


class Reason(NamedTuple):
    """A reason; `str` is its text. `number` is a quota, or counts `rcs`, of which `SHOWN` (`SHOWN_CHOICES` with
    `patterns`) are named."""

    code: ReasonCode
    rcs: tuple[RcName, ...] = ()
    by: tuple[Party, ...] = ()
    detail: str = ""
    number: int = 0
    pattern: Need | None = None
    """The unmet pattern; the other fields are about a matching RC, or with `patterns` about all."""
    patterns: tuple[Need, ...] = ()
    """For each of `rcs` the pattern that it is a choice for, empty where named."""

    def __str__(self) -> str:
        return self.text()

    @property
    def own(self) -> bool:
        """Return True if its own client ended it."""
        return self.code in (ReasonCode.CANCELLED, ReasonCode.RELEASED) and not self.detail

    def text(self, until: Until | None = None) -> str:
        if self.code is ReasonCode.HELD:
            return _held(self, until)
        if self.code is ReasonCode.VETOED:
            return _vetoed(self, until)
        text = _TEXTS[self.code](self)
        if self.code is ReasonCode.MAINTENANCE:
            text += _last(self.by[0], until) + self.by[0].comment
        return text if self.pattern is None else f"no {self.pattern} is to be had: {text}"


_NAMING: Final = (ReasonCode.HELD, ReasonCode.VETOED, ReasonCode.MAINTENANCE, ReasonCode.RESERVED, ReasonCode.BOOKED)
_PREFERRED: Final = (ReasonCode.PREEMPTED, ReasonCode.DISPLACED)


def reason_of(why: ReasonInfo | None, label: Callable[[ReasonParty], str] = lambda _: "") -> Reason | None:
    """The reason in a message, if it names other ARCs (`until`: ns from now); None: its text is complete. `label`: the
    text for an ARC, if not its name and person."""
    if why is None or not why.by or not (why.code in _PREFERRED or (why.code in _NAMING and why.rcs)):
        return None
    by = tuple(
        Party(
            f"{party.client}/{party.id}",
            party.arc,
            party.priority,
            party.who,
            None if party.yields_in is None else round(party.yields_in * SECOND),
            label(party),
        )
        for party in why.by
    )
    code, rcs, patterns = ReasonCode(why.code), tuple(why.rcs), tuple(why.patterns)
    return Reason(code, rcs, by, why.detail, why.count, why.pattern, patterns)


def waits_for_others(why: Reason | ReasonInfo | None) -> bool:
    """Return True if the text of a reason begins with `waits for`."""
    if why is None or why.code == ReasonCode.HELD:
        return why is not None
    return why.code == ReasonCode.VETOED and (len(why.rcs) > 1 or len(why.by) > 0)


def waits(reason: str, why: Reason | ReasonInfo | None) -> str:
    """The text after the name of a waiting ARC: `waits for survey (alice@ws1): robot/a`, `waits: votes are out`."""
    return reason if waits_for_others(why) else f"waits: {reason}"


_OUTCOMES: Final = (ReasonCode.PREEMPTED, ReasonCode.CANCELLED, ReasonCode.RELEASED, ReasonCode.HANDED_OVER)
"""Reasons whose text begins with the outcome."""


def ended(outcome: str, reason: str, why: Reason | ReasonInfo | None) -> str:
    """The text for an ended ARC: `preempted by ...`, `lost: robot/a ended the hold`."""
    word = outcome.replace("_", " ")
    return reason if why is not None and why.code in _OUTCOMES else f"{word}: {reason}" if reason else word


def kept(priority: int) -> str:
    """The text for how long a kept hold of this priority lasts after its minimum runtime."""
    return f"until a request of priority {priority} or more waits for it"


def starting(left: float) -> str:
    """The text for a hold whose devices begin within `left` seconds."""
    return f"starting, ready in about {max(1, round(left))} s"


def of_rcs(code: ReasonCode, rcs: Sequence[RcName], detail: str = "") -> Reason:
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
    """RCs for a list, without a kind that repeats the one before."""
    last = ""
    for rc in rcs:
        kind = rc.partition("/")[0] + "/"
        yield rc.removeprefix(kind) if kind == last else rc
        last = kind


def base(pattern: Need) -> Need:
    """`fg/*` for `fg/*#2`, which requests a second such device."""
    return pattern.partition("#")[0]


def some_of(count: int) -> str:
    """`two of`, before choices of which `count` are needed."""
    return f"{_COUNTS.get(count, count)} of"


_COUNTS: Final = dict(enumerate(("one", "two", "three", "four", "five", "six", "seven", "eight"), 1))


def _held(reason: Reason, until: Until | None) -> str:
    patterns = reason.patterns or ("",) * len(reason.rcs)
    held = list(zip(reason.rcs, reason.by, patterns, strict=False))
    parts = []
    for party in dict.fromkeys(party for _, party, pattern in held if not pattern):
        rcs = ", ".join(rc for rc, holder, pattern in held if not pattern and holder == party)
        parts.append(f"{party}: {rcs}{_last(party, until)}")
    for _, group in groupby((choice for choice in held if choice[2]), key=lambda choice: base(choice[2])):
        choices = list(group)
        if len(choices) == 1 and reason.number <= len(held):
            rc, party, need = choices[0]
            parts.append(f"{party}: {rc} for {need}{_last(party, until)}")
            continue
        names = short_names(rc for rc, _, _ in choices)
        shown = [
            f"{rc} (held by {choice[1]}{_last(choice[1], until)})" for rc, choice in zip(names, choices, strict=True)
        ]
        missing = len({need for _, _, need in choices})
        parts.append(f"{some_of(missing)} {', '.join(shown)}")
    more = f" and {reason.number - len(held)} more" if reason.number > len(held) else ""
    preferred = f"; by fair shares {reason.detail} goes first" if reason.detail else ""
    return f"waits for {'; for '.join(parts)}{more}{preferred}"


def _listed(reason: Reason) -> str:
    more = f" and {reason.number - SHOWN} more" if reason.number > SHOWN else ""
    return ", ".join(reason.rcs) + more


def _because(reason: Reason) -> str:
    return f" ({reason.detail})" if reason.detail else ""


_TEXTS: Final[Mapping[ReasonCode, Callable[[Reason], str]]] = {
    ReasonCode.ABSENT: lambda why: (
        f"{why.rcs[0]} is lost: {why.detail}"
        if why.detail and why.number == 1
        else f"{_listed(why)} not on the mesh{_because(why)}"
    ),
    ReasonCode.UNWELL: lambda why: (
        f"{why.rcs[0]} is unwell: {why.detail}" if why.number == 1 else f"{_listed(why)} are unwell{_because(why)}"
    ),
    ReasonCode.NO_MATCH: lambda why: f"no device on the mesh is left for {_listed(why)}{_because(why)}",
    ReasonCode.SILENT: lambda why: f"{_listed(why)} does not answer",
    ReasonCode.UNCONFIRMED: lambda why: f"{_listed(why)} did not confirm the grant",
    ReasonCode.CLAIMED: lambda why: f"{why.detail} claims it as well",
    ReasonCode.RESERVED: lambda why: (
        f"{why.rcs[0]} is kept for {why.by[0]}, whose time to wait is over before this ends"
    ),
    ReasonCode.BOOKED: lambda why: f"{why.rcs[0]} is booked by {why.by[0]} before this would be over",
    ReasonCode.MAINTENANCE: lambda why: f"maintenance of {why.rcs[0]} by {why.by[0]}",
    ReasonCode.BROKEN: lambda why: (
        f"{why.rcs[0]} is broken, as {person(why.by[0].who, '') or why.by[0].name} reports{why.by[0].comment}"
    ),
    ReasonCode.NOT_YET: lambda _: "the time of its booking is still to come",
    ReasonCode.QUOTA: lambda why: f"host {why.detail} has reached its quota of running requests: {why.number}",
    ReasonCode.RC_QUOTA: lambda why: f"{why.detail} may hold {why.number} devices at one time",
    ReasonCode.VOTING: lambda _: "votes are out",
    ReasonCode.SEARCHING: lambda _: "a better schedule is sought",
    ReasonCode.EXPIRED: lambda _: "its minimum runtime is over",
    ReasonCode.LIMIT: lambda _: "it had the longest time that this fleet gives a hold (max_runtime)",
    ReasonCode.PREEMPTED: lambda why: f"preempted by {why.by[0]}, priority {why.by[0].priority}{why.by[0].comment}",
    ReasonCode.DISPLACED: lambda why: (
        f"its minimum runtime is over, and {why.by[0]}, priority {why.by[0].priority}, needs it{why.by[0].comment}"
    ),
    ReasonCode.CANCELLED: lambda why: f"cancelled by {why.detail or ITS_CLIENT}",
    ReasonCode.RELEASED: lambda why: f"released by {why.detail or ITS_CLIENT}",
    ReasonCode.CLIENT_LOST: lambda why: why.detail,
    ReasonCode.HANDED_OVER: lambda why: f"handed over to {why.detail}",
    ReasonCode.RC_LOST: lambda why: f"{why.rcs[0]} was lost" + (f": {why.detail}" if why.detail else ""),
    ReasonCode.RC_ENDED: lambda why: f"{why.rcs[0]} ended the hold",
    ReasonCode.SUPERSEDED: lambda why: f"{why.rcs[0]} has a newer holder",
}

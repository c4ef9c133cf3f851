"""The contention for a request: by need, the devices that meet it and the requests that hold them, as the leader
knows."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from decimal import Decimal
from typing import Any, Final

from zscout.cli import common
from zscout.cli.device_words import absence
from zscout.cli.ownership import User
from zscout.keyexpr import is_pattern, matcher
from zscout.messages import HoldView, RcmState, ReasonInfo, ReasonParty, WaitView, Who
from zscout.scheduling.reason import ReasonCode, named, person, reason_of, starting
from zscout.terminal import clean, clock, span
from zscout.types import SECOND

HOLDERS_IN_WAY: Final = (ReasonCode.HELD, ReasonCode.VETOED)


@dataclass(frozen=True, slots=True)
class RcContention:
    """A device, and the holds of other requests on it."""

    rc: str
    present: bool
    sharable: bool
    holds: list[HoldView]
    lost: str = ""
    """The reason that the device is absent, in words; empty: unknown."""


@dataclass(slots=True)
class NeedContention:
    """A need, and the devices that meet it: the device named, or all that match the pattern."""

    need: str
    rcs: list[RcContention]
    rivals: int = 0
    """The number of the request's other patterns that some of these devices meet as well."""

    @property
    def rc(self) -> str | None:
        return None if is_pattern(self.need) else self.need

    @property
    def present(self) -> bool:
        return any(rc.present for rc in self.rcs)

    @property
    def sharable(self) -> bool:
        return bool(self.rcs) and all(rc.sharable for rc in self.rcs)

    @property
    def free(self) -> list[str]:
        return [rc.rc for rc in self.rcs if rc.present and not rc.holds]

    @property
    def met(self) -> bool:
        """Return True if a free device is left for it, whichever devices meet the other needs."""
        return len(self.free) > self.rivals

    def as_json(self) -> dict[str, Any]:
        """Return the object of `--json`; `rc` is null for a pattern."""
        fields = {name: getattr(self, name) for name in ("need", "rc", "present", "sharable", "free")}
        return fields | {"holders": [hold_json(hold) | {"rc": rc.rc} for rc in self.rcs for hold in rc.holds]}


def contention_of(state: RcmState, needs: Collection[str], own: str = "") -> list[NeedContention]:
    """Without holds of the request `own` (`<host>/<client>/<id>`). A device named by a need meets no pattern."""
    holds = [hold for hold in state.holds if f"{hold.client}/{hold.id}" != own]
    views = {view.rc: view for view in state.rcs}

    def seen(rc: str) -> RcContention:
        view = views.get(rc)
        theirs = [hold for hold in holds if rc in hold.needs]
        if view is None:
            return RcContention(rc, False, False, theirs)
        return RcContention(rc, view.present, view.sharable, theirs, absence(view))

    found = []
    for need in sorted(needs):
        meets = matcher(need)
        matching = sorted(rc for rc in views if rc not in needs and meets(rc)) if is_pattern(need) else [need]
        # Absent devices don't count for a pattern: any other will do.
        rcs = [seen(rc) for rc in matching if not is_pattern(need) or views[rc].present]
        found.append(NeedContention(need, rcs))
    for contention in found:
        own_rcs = {rc.rc for rc in contention.rcs}
        others = (other for other in found if other is not contention)
        contention.rivals = sum(1 for other in others if own_rcs & {rc.rc for rc in other.rcs})
    return found


def whose(view: HoldView | WaitView | ReasonParty) -> str:
    """Person and command of a request: `alice@ws1 (survey.py)`."""
    command = view.who.command if view.who is not None else ""
    return person(view.who, view.client) + (f" ({clean(command)})" if command else "")


def request_words(
    arc: str, who: Who | None, client: str, params: Mapping[str, Decimal] | None = None, me: User | None = None
) -> str:
    """`survey (alice@ws1)`, with the `params` under which it holds a device; `your own request survey` for `me`."""
    name = _own_words(arc) if me is not None and me.owns(client.partition("/")[0], who) else named(who, client, arc)
    return clean(common.with_amounts(name, params or {}))


def _own_words(arc: str) -> str:
    return f"your own request {clean(arc)}"


def comment(who: Who | None) -> str:
    """The request's comment, as the end of a sentence."""
    return f": {clean(who.comment)}" if who is not None and who.comment else ""


def reason_text(reason: str, why: ReasonInfo | None, age: float = 0, me: User | None = None) -> str:
    """Words for why a request of `me` waits, `age` seconds after that was sent; times by this host's clock."""
    known = reason_of(why)
    if known is None:
        return reason
    if me is not None and known.code in HOLDERS_IN_WAY:
        known = known._replace(
            by=tuple(
                party._replace(label=_own_words(party.name))
                if me.owns(party.arc.partition("/")[0], party.who)
                else party
                for party in known.by
            )
        )
    return known.text(lambda until: clock(until / SECOND - age))


def hold_text(hold: HoldView, priority: int, me: User | None = None) -> str:
    """Describe a hold: its request, begin and end. The end is for a request of `me` at this priority."""
    return hold_words(hold_json(hold), priority, me)


def hold_words(hold: Mapping[str, Any], priority: int, me: User | None = None) -> str:
    """Like `hold_text`, for a hold as of `hold_json`, with optional `params`."""
    holder = request_words(hold["arc"], hold["who"], hold["client"], hold.get("params"), me)
    since = f"since {clock(-hold['held'])} ({span(hold['held'])})"
    return f"{holder}, priority {hold['priority']}, {since}, {_until(hold, priority)}{comment(hold['who'])}"


def _until(hold: Mapping[str, Any], priority: int) -> str:
    """Words for the end of a hold, or of its protection from a request of this priority."""
    stays, left = hold["keep"] and priority < hold["priority"], hold["remaining"]
    if (waits := hold.get("waits")) is not None:
        return f"{starting(waits)}, then {span(left)}" + (" at least" if stays else "")
    if left <= 0:
        return "kept for as long as it wants" if stays else "its minimum runtime is over"
    end = f"until {clock(left)} ({span(left)})"
    if hold["priority"] < priority and left <= (hold["protected_from"] or 0):
        return f"protected from preemption {end}"
    return f"{end} at least, and kept for as long as it wants" if stays else f"{end} at the latest"


def hold_json(hold: HoldView) -> dict[str, Any]:
    names = ("arc", "id", "client", "who", "priority", "keep", "protected_from")
    fields = {name: getattr(hold, name) for name in names}
    fields["waits"] = None if hold.waits is None else round(hold.waits, 3)
    return fields | {"held": round(hold.held, 3), "remaining": round(hold.remaining, 3)}

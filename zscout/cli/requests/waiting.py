"""What a request waits for: each need, the RCs that would meet it, and who holds them, as the RCM sees it."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from zscout.cli import common
from zscout.cli.device_words import absence
from zscout.keyexpr import is_pattern, matcher
from zscout.messages import HoldView, RcmState, ReasonInfo, ReasonParty, WaitView, Who
from zscout.scheduling.reason import Party, Reason, ReasonCode, named
from zscout.terminal import clean, clock, span
from zscout.types import SECOND, Ns


@dataclass(frozen=True, slots=True)
class RcContention:
    """One RC, and the holds of others on it."""

    rc: str
    present: bool
    sharable: bool
    holds: list[HoldView]
    lost: str = ""
    """Why it is not present, in words, if that is known."""


@dataclass(slots=True)
class NeedContention:
    """One need, and the RCs that would meet it: the one that it names, or those that match."""

    need: str
    rcs: list[RcContention]
    rivals: int = 0
    """How many of the request's other patterns some of these RCs would meet as well."""

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
        """Whether there is a free one for it, whatever the other needs are met by."""
        return len(self.free) > self.rivals

    def as_json(self) -> dict[str, Any]:
        """For programs; `rc` is null for a pattern."""
        said = {name: getattr(self, name) for name in ("need", "rc", "present", "sharable", "free")}
        return said | {"holders": [hold_json(hold) | {"rc": rc.rc} for rc in self.rcs for hold in rc.holds]}


def contention_of(state: RcmState, needs: Collection[str], own: str = "") -> list[NeedContention]:
    """How each need stands, holds of the ARC `own` (`<host>/<client>/<id>`) left out. What one need names
    does not meet another."""
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
        # What matches and has gone says nothing: another will do.
        rcs = [seen(rc) for rc in matching if not is_pattern(need) or views[rc].present]
        found.append(NeedContention(need, rcs))
    for one in found:
        own_rcs = {rc.rc for rc in one.rcs}
        one.rivals = sum(1 for other in found if other is not one and own_rcs & {rc.rc for rc in other.rcs})
    return found


def whose(view: HoldView | WaitView | ReasonParty) -> str:
    """Whose ARC that is: `alice@ws1 (survey.py)`."""
    return clean(named(view.who, view.client, view.arc))


def reason_text(reason: str, why: ReasonInfo | None, age: float = 0) -> str:
    """A reason to wait in words, with times of day by this host's clock; `age` seconds ago it was so."""
    told = (ReasonCode.HELD, ReasonCode.VETOED, *([ReasonCode.MAINTENANCE] if why is not None and why.by else []))
    if why is None or why.code not in told or not why.rcs:
        return reason  # nobody holds it, or an RCM that tells no more
    parties = [
        Party(f"{one.client}/{one.id}", one.arc, one.priority, one.who, _ns(one.yields_in, age)) for one in why.by
    ]
    words = Reason(
        ReasonCode(why.code), tuple(why.rcs), tuple(parties), why.detail, why.count, why.pattern, tuple(why.patterns)
    )
    return words.text(lambda until: clock(until / SECOND, at_latest=True))


def _ns(seconds: float | None, age: float) -> Ns | None:
    return None if seconds is None else round((seconds - age) * SECOND)


def hold_text(hold: HoldView, priority: int) -> str:
    """Whose hold it is, since and until when, in words, for who asks at this priority."""
    return hold_words(hold_json(hold), priority)


def hold_words(hold: Mapping[str, Any], priority: int) -> str:
    """The same of what `hold_json` made, with `params` if it has any."""
    who: Who | None = hold["who"]
    whose = common.with_amounts(named(who, hold["client"], hold["arc"]), hold.get("params", {}))
    since = f"since {clock(-hold['held'])} ({span(hold['held'])})"
    comment = f": {who.comment}" if who is not None and who.comment else ""
    return clean(f"{whose}, priority {hold['priority']}, {since}, {_until(hold, priority)}{comment}")


def _until(hold: Mapping[str, Any], priority: int) -> str:
    """Until when it is protected against who asks at this priority, or holds at all."""
    stays, left = hold["keep"] and priority < hold["priority"], hold["remaining"]
    if left <= 0:
        return "kept for as long as it wants" if stays else "its minimum runtime is over"
    end = f"until {clock(left, at_latest=True)} ({span(left)})"
    return f"{end} at least, and kept for as long as it wants" if stays else f"{end} at the latest"


def hold_json(hold: HoldView) -> dict[str, Any]:
    """The same for programs."""
    said = {name: getattr(hold, name) for name in ("arc", "id", "client", "who", "priority", "keep")}
    return said | {"held": round(hold.held, 3), "remaining": round(hold.remaining, 3)}

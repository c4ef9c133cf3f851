"""What a request waits for: each need, the RCs that would meet it, and who holds them, as the RCM sees it."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from zscout.keyexpr import is_pattern, matcher
from zscout.messages import HoldView, RcmState
from zscout.terminal import clean, span


@dataclass(frozen=True, slots=True)
class RcContention:
    """One RC, and the holds of others on it."""

    rc: str
    present: bool
    sharable: bool
    holds: list[HoldView]


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
        return RcContention(rc, view is not None and view.present, view is not None and view.sharable, theirs)

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


def hold_text(hold: HoldView) -> str:
    """Whose hold it is and since when, in words."""
    left = "kept" if hold.keep and hold.remaining <= 0 else f"{span(hold.remaining)} left"
    return clean(f"{hold.arc} (priority {hold.priority}, {hold.client}) for {span(hold.held)}, {left}")


def hold_json(hold: HoldView) -> dict[str, Any]:
    """The same for programs."""
    said = {name: getattr(hold, name) for name in ("arc", "id", "client", "priority", "keep")}
    return said | {"held": round(hold.held, 3), "remaining": round(hold.remaining, 3)}

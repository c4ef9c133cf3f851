"""Who held what for how long, and how much of it was used, from a list of holds: pure.

All times are seconds within the window that is accounted for; what lies outside is not counted."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Final

from zscout.messages import PastHold
from zscout.services.journal.merging import Span

THROWN_AWAY: Final = frozenset({"preempted", "lost"})
"""Outcomes of holds that are taken back without their holder's doing."""


@dataclass(slots=True)
class Account:
    """Of one user, group or RC."""

    key: str
    holds: int = 0
    """Holds that stood at some time of the window."""
    held: float = 0.0
    """Seconds for which they stood; two at one time count twice."""
    rc_seconds: float = 0.0
    """The same for each RC of them: a hold of three RCs for 10 s is 30. Of an RC's own account it is `held`."""
    waited: float = 0.0
    """Seconds in the queue before the holds that began in the window, as far as they were told: whole, though the wait
    began before. Waits that no hold ended are not known."""
    preempted: int = 0
    """Holds that ended in the window because they were taken for another ARC before their minimum runtime was over."""
    preempted_seconds: float = 0.0
    """Seconds for which those had stood."""
    thrown_away: float = 0.0
    """Seconds for which holds had stood that ended in the window, before their minimum runtime, because they were
    preempted or an RC was lost. What their programs had done until then is counted as lost, though some keep it."""
    used: float | None = None
    """Of `rc_seconds`, for how much RCs were used, as far as they told; None: none told anything. Of a hold that lies
    partly in the window the same part."""
    used_unknown: int = 0
    """Holds of which not all of these RCs told it: what the others did is not counted."""


def accounts(
    holds: Iterable[PastHold], keys: Callable[[PastHold], Iterable[str]], window: Span, *, by_rc: bool = False
) -> list[Account]:
    """An account for each of `keys` of any hold, those that held most first. A hold that still stands is counted up to
    the end of the window; of one whose end was not heard, only what is known. `by_rc`: its keys are its RCs."""
    found: dict[str, Account] = {}
    for hold in holds:
        ended = window.ended if hold.ended is None else hold.ended
        held = min(ended, window.ended) - max(hold.began, window.began)
        if held < 0:
            continue
        ends_here = hold.ended is not None and hold.ended <= window.ended
        short = hold.min_runtime is None or ended - hold.began < hold.min_runtime
        for key in dict.fromkeys(keys(hold)):
            one = found.setdefault(key, Account(key))
            one.holds += 1
            one.held += held
            one.rc_seconds += held if by_rc else held * len(hold.rcs)
            if hold.waited is not None and hold.began >= window.began:
                one.waited += hold.waited
            rcs = [key] if by_rc else hold.rcs
            if told := [hold.used[rc] for rc in rcs if rc in hold.used]:
                part = held / stood if (stood := ended - hold.began) > 0 else 1.0
                one.used = (one.used or 0.0) + sum(min(seconds * part, held) for seconds in told)
            one.used_unknown += len(told) < len(rcs)
            if ends_here and hold.outcome == "preempted":
                one.preempted += 1
                one.preempted_seconds += held
            if ends_here and short and hold.outcome in THROWN_AWAY:
                one.thrown_away += held
    return sorted(found.values(), key=lambda one: (-one.held, one.key))

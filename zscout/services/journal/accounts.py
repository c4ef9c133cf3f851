"""Usage accounts from a list of holds. Pure. Only seconds within the window are counted."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from zscout.messages import PastHold
from zscout.services.journal.merging import Span


@dataclass(slots=True)
class Account:
    key: str
    holds: int = 0  # holds with some time in the window
    held: float = 0.0  # seconds held; simultaneous holds count twice
    rc_seconds: float = 0.0  # seconds times RCs: three RCs for 10 s are 30. Equals `held` in an RC's own account.
    waited: float = 0.0  # known seconds in the queue, in full, of holds that began in the window
    preempted: int = 0  # holds preempted in the window before their minimum runtime
    preempted_seconds: float = 0.0  # seconds held by those
    thrown_away: float = 0.0
    """Seconds of holds that ended in the window, before their minimum runtime, by preemption or a lost RC. The
    programs' work counts as lost, though some keep it."""
    used: float | None = None  # seconds of reported use, prorated at the window's ends; None: no report
    used_unknown: int = 0  # holds with some RC's use unreported; the other RCs' use counts


def accounts(
    holds: Iterable[PastHold], keys: Callable[[PastHold], Iterable[str]], window: Span, *, by_rc: bool = False
) -> list[Account]:
    """An account for each key of any hold, by seconds held, descending. Holds in force count up to the window's end,
    those with a missed end as far as known. `by_rc`: the keys are RCs."""
    found: dict[str, Account] = {}
    for hold in holds:
        ended = window.ended if hold.ended is None else hold.ended
        held = min(ended, window.ended) - max(hold.began, window.began)
        if held < 0:
            continue
        ends_here = hold.ended is not None and hold.ended <= window.ended
        # A preempted hold had not had the time for which it was protected, which may be more than `min_runtime`.
        is_short = hold.min_runtime is None or ended - hold.began < hold.min_runtime
        thrown_away = hold.outcome == "preempted" or (hold.outcome == "lost" and is_short)
        for key in dict.fromkeys(keys(hold)):
            account = found.setdefault(key, Account(key))
            account.holds += 1
            account.held += held
            account.rc_seconds += held if by_rc else held * len(hold.rcs)
            if hold.waited is not None and hold.began >= window.began:
                account.waited += hold.waited
            rcs = [key] if by_rc else hold.rcs
            if known := [hold.used[rc] for rc in rcs if rc in hold.used]:
                part = held / lasted if (lasted := ended - hold.began) > 0 else 1.0
                account.used = (account.used or 0.0) + sum(min(seconds * part, held) for seconds in known)
            account.used_unknown += len(known) < len(rcs)
            if ends_here and hold.outcome == "preempted":
                account.preempted += 1
                account.preempted_seconds += held
            if ends_here and thrown_away:
                account.thrown_away += held
    return sorted(found.values(), key=lambda account: (-account.held, account.key))

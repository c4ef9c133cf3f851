"""For how long an RC was used under each grant, as the RC itself counts it. Pure; time is passed in.

*Used* is the time from the beginning of the first command that its driver carried out under the grant to the end of the
last one; a frame counts as a command that takes no time. Confirmations are none, nor is what was refused. Of a direct
hold, whose program touches the device past the RC, all is used, from its beginning at the driver on. Nothing counts
after the end of the hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from zscout.messages import MAX_USES, HoldUse
from zscout.types import SECOND, Grant, Ns

MAX_ENDED: Final = 64
"""Holds that are over and still told of, at most: the last ones."""
TOLD_FOR: Final[Ns] = 30 * SECOND
"""Likewise: in three states, at least, so that who missed one hears it."""


@dataclass(slots=True)
class _Use:
    since: Ns | None = None
    """When the first command began; None: there was none."""
    until: Ns = 0
    """When the last one was over."""
    lasts: bool = False
    """A direct hold that has begun at the driver: it is used until it ends."""
    ended: Ns | None = None
    """When the hold ended."""

    def seconds(self, now: Ns) -> float:
        if self.since is None:
            return 0.0
        until = now if self.lasts else self.until
        if self.ended is not None:
            until = min(until, self.ended)
        return round(max(0, until - self.since) / SECOND, 3)


class UseCounter:
    """Counts for one RC."""

    def __init__(self) -> None:
        self._held: dict[Grant, _Use] = {}
        self._ended: dict[Grant, _Use] = {}
        self.news = False
        """Whether there is something of a hold that is over which was not published yet."""

    def hold_began(self, grant: Grant) -> None:
        self._held[grant] = _Use()

    def direct_began(self, grant: Grant, now: Ns) -> None:
        """A direct hold has begun at the driver."""
        if (use := self._held.get(grant)) is not None:
            use.since, use.lasts = now if use.since is None else use.since, True

    def carried_out(self, grant: Grant, began: Ns, now: Ns) -> None:
        """A command from `began` until now, under a grant that was held when it began. May be called from any one
        thread beside the others: what that could lose is a moment of one command."""
        use = self._held.get(grant)
        if use is None:
            if (use := self._ended.get(grant)) is None:
                return
            # It was under way as the hold ended.
            self.news = True
        use.until = max(use.until, now)
        use.since = began if use.since is None else min(use.since, began)

    def hold_ended(self, grant: Grant, now: Ns) -> None:
        if (use := self._held.pop(grant, None)) is not None:
            use.ended, self.news = now, True
            self._ended[grant] = use
            if len(self._ended) > MAX_ENDED:
                del self._ended[next(iter(self._ended))]

    def told(self, now: Ns) -> list[HoldUse]:
        """As it is published: what is over goes first, as its last word."""
        for grant in [one for one, use in self._ended.items() if use.ended is not None and now - use.ended > TOLD_FOR]:
            del self._ended[grant]
        uses = [*self._ended.items(), *self._held.items()]
        return [HoldUse(grant, use.seconds(now)) for grant, use in uses[:MAX_USES]]

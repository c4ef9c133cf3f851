"""Measures the time that an RC was used under each grant. Pure; time is passed in.

*Used* is the time from the begin of the first command that the driver carried out under the grant to the end of the
last command; a frame counts as a command of no duration. Confirmations and refused commands do not count. A direct
hold, whose program uses the device without the RC, is used from its begin at the driver. Nothing counts after the end
of the hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from zscout.messages import MAX_USES, HoldUse
from zscout.types import SECOND, Grant, Ns

MAX_ENDED: Final = 64
"""Ended holds that are still published, the most recent ones."""
PUBLISH_ENDED_FOR: Final[Ns] = 30 * SECOND
"""An ended hold is published for this long: at least three times, in case a receiver misses a publication."""


@dataclass(slots=True)
class _Use:
    since: Ns | None = None
    """Begin of the first command; None: no command yet."""
    until: Ns = 0
    """End of the last command."""
    direct: bool = False
    """The hold is direct and has begun at the driver: it is used until it ends."""
    ended: Ns | None = None
    """End of the hold."""

    def seconds(self, now: Ns) -> float:
        if self.since is None:
            return 0.0
        until = now if self.direct else self.until
        if self.ended is not None:
            until = min(until, self.ended)
        return round(max(0, until - self.since) / SECOND, 3)


class UseCounter:
    """Measures the use of a single RC."""

    def __init__(self) -> None:
        self._held: dict[Grant, _Use] = {}
        self._ended: dict[Grant, _Use] = {}
        self.unpublished = False
        """True if the use of an ended hold has not been published yet; the RC resets it."""

    def hold_began(self, grant: Grant) -> None:
        self._held[grant] = _Use()

    def direct_began(self, grant: Grant, now: Ns) -> None:
        if (use := self._held.get(grant)) is not None:
            use.since, use.direct = now if use.since is None else use.since, True

    def carried_out(self, grant: Grant, began: Ns, now: Ns) -> None:
        """Count a command of a hold in force at `began`. From a second thread, at worst its time is lost."""
        use = self._held.get(grant)
        if use is None:
            if (use := self._ended.get(grant)) is None:
                return
            # The command was running when the hold ended.
            self.unpublished = True
        use.until = max(use.until, now)
        use.since = began if use.since is None else min(use.since, began)

    def hold_ended(self, grant: Grant, now: Ns) -> None:
        if (use := self._held.pop(grant, None)) is not None:
            use.ended, self.unpublished = now, True
            self._ended[grant] = use
            if len(self._ended) > MAX_ENDED:
                del self._ended[next(iter(self._ended))]

    def report(self, now: Ns) -> list[HoldUse]:
        """The uses to publish, ended holds first, since each of their publications may be the last."""
        for grant, use in list(self._ended.items()):
            if use.ended is not None and now - use.ended > PUBLISH_ENDED_FOR:
                del self._ended[grant]
        uses = [*self._ended.items(), *self._held.items()]
        return [HoldUse(grant, use.seconds(now)) for grant, use in uses[:MAX_USES]]

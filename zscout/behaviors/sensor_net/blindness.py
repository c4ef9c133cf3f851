"""Whose fault it is that there is no picture: the channel's or the robot's. Pure; time is passed in.

A robot whose transmitter was switched on shows a picture within seconds. If none comes for `patience`, the
channel may be jammed, its receiver dead, or the robot. So another channel is tried where there is one: a
robot that is not seen on `SUSPECTS` in a row is dead, and one that is, had a bad channel, which is left alone
for a while. A channel without any picture, not even snow, has no receiver that works: its framegrabber gives
up, the hold ends before `patience` is over, and the robot is not to blame.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

SUSPECTS: Final = 2
"""Holds in a row without a picture that prove a robot dead."""
BAD_FOR: Final = 60.0
"""Seconds for which a channel that showed nothing is avoided."""
SILENT: Final = 4.0
"""Seconds without any picture at the end of a hold that prove a receiver dead: framegrabbers give up after
five."""

REMIND: Final = 4.0
"""Seconds without a good picture, above any warm-up, after which a robot may not have heard that it is to
transmit."""


class Blindness:
    """Follows one robot over its holds."""

    def __init__(self, patience: float) -> None:
        self.patience = patience
        """Seconds without a picture, warm-up included."""
        self._dark_since: float | None = None
        self._bad: dict[str, float] = {}
        """Channels on which this robot was not seen, and when."""
        self._in_row = 0
        self._reminded = 0.0
        self._channel = ""
        self._silent_since: float | None = None

    def begin(self, now: float) -> None:
        """A hold has begun: the transmitter is being switched on."""
        self._dark_since = now
        self._channel, self._silent_since = "", now

    def see(self, now: float, good: bool, channel: str, *, came: bool | None = None) -> bool:
        """Takes what a look showed; `came`: any picture, if not a good one. True: no good picture for too
        long on this channel."""
        self._channel = channel
        if good or came:
            self._silent_since = now
        if good:
            self._dark_since = None
            self._in_row = 0
            self._bad.pop(channel, None)
            return False
        if self._dark_since is None:
            self._dark_since = now
        if now - self._dark_since < self.patience:
            return False
        self._bad[channel] = now
        self._in_row += 1
        self._dark_since = None
        return True

    def remind(self, now: float) -> bool:
        """Whether the robot is to be told once more to transmit: its radio goes one way."""
        since = self._dark_since
        if since is None or now - max(since, min(self._reminded, now)) < REMIND:
            return False
        self._reminded = now
        return True

    def end(self, now: float) -> bool:
        """The hold is over. True: its channel gave nothing at all, and is to be left."""
        since, self._silent_since = self._silent_since, None
        if since is None or not self._channel or now - since < SILENT:
            return False
        self._bad[self._channel] = now
        return True

    @property
    def dead(self) -> bool:
        """Whether that is enough to give the robot up; of a single channel, two tries on it are."""
        return self._in_row >= SUSPECTS

    def choose(self, now: float, channels: Iterable[str]) -> str | None:
        """A channel to ask for by name, because another one is to be avoided; None: any will do."""
        self._bad = {channel: at for channel, at in self._bad.items() if now - at < BAD_FOR}
        good = sorted(set(channels) - self._bad.keys())
        return good[0] if self._bad and good else None

    def memory(self) -> dict[str, Any]:
        return {"bad": self._bad, "in_row": self._in_row}

    def recall(self, memory: dict[str, Any]) -> None:
        self._bad = {str(channel): float(at) for channel, at in memory["bad"].items()}
        self._in_row = int(memory["in_row"])

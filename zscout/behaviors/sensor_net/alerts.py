"""When motion in a robot's picture is worth an alert. Pure; time is passed in."""

from __future__ import annotations

from typing import Any, Final

QUIET: Final = 2.0
"""Seconds without motion after which the next one is another event."""


class Alerts:
    """One alert for each time that something moves."""

    def __init__(self) -> None:
        self.count = 0
        self._last: float | None = None
        """When motion was seen last, within one event."""

    @property
    def moving(self) -> bool:
        return self._last is not None

    def see(self, now: float, moving: bool) -> str:
        """`start` where an event begins, `end` where it is over, else an empty word."""
        if moving:
            began, self._last = self._last is None, now
            self.count += began
            return "start" if began else ""
        if self._last is not None and now - self._last >= QUIET:
            self._last = None
            return "end"
        return ""

    def rest(self) -> None:
        """Nobody watches any more: whatever comes next is another event."""
        self._last = None

    def memory(self) -> dict[str, Any]:
        return {"count": self.count}

    def recall(self, memory: dict[str, Any]) -> None:
        self.count = int(memory["count"])

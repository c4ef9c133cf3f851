"""Rate-limited warnings about messages of other processes, which could fill the log."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Final

from zscout.types import SECOND, Ns

PERIOD: Final[Ns] = 10 * SECOND
MAX_KEYS: Final = 64  # keys with a period of their own; all further keys share one period
OTHERS: Final = ("", "")


class SparseLog:
    """Logs at most one warning of a text about each key in `PERIOD`, with the number suppressed since the last."""

    def __init__(self, log: logging.Logger, now: Callable[[], Ns]) -> None:
        self._log, self._now = log, now
        self._logged: dict[tuple[str, str], tuple[Ns, int]] = {}
        """By text and key: time of the last warning, and the number suppressed since."""

    def warning(self, key: str, text: str, *args: object) -> None:
        """`key` is the subject, possibly chosen by another process; `text` and `args` are as in `logging`."""
        now, subject = self._now(), (text, key[:200])
        if subject not in self._logged and len(self._logged) >= MAX_KEYS:
            self._logged = {key: logged for key, logged in self._logged.items() if now - logged[0] < PERIOD}
            subject = OTHERS if len(self._logged) >= MAX_KEYS else subject
        at, left_out = self._logged.get(subject, (now - PERIOD, 0))
        if now - at < PERIOD:
            self._logged[subject] = at, left_out + 1
            return
        self._logged[subject] = now, 0
        more = f" ({left_out} more since the last warning)" if left_out else ""
        self._log.warning(f"{text}%s", *args, more)

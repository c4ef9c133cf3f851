"""Rate-limited warnings about messages of others, which could fill the log."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Final

from zscout.types import SECOND, Ns

PERIOD: Final[Ns] = 10 * SECOND
MAX_KEYS: Final = 64  # keys with a period of their own; all further ones share one
OTHERS: Final = ("", "")


class SparseLog:
    """Logs one warning of a kind about each key in `PERIOD`, with the number left out since the last."""

    def __init__(self, log: logging.Logger, now: Callable[[], Ns]) -> None:
        self._log, self._now = log, now
        self._said: dict[tuple[str, str], tuple[Ns, int]] = {}
        """By text and key: time of the last warning, and how many were left out since."""

    def warning(self, key: str, text: str, *args: object) -> None:
        """`key` is the subject, possibly chosen by others; `text` and `args` are as in `logging`."""
        now, what = self._now(), (text, key[:200])
        if what not in self._said and len(self._said) >= MAX_KEYS:
            self._said = {key: said for key, said in self._said.items() if now - said[0] < PERIOD}
            what = OTHERS if len(self._said) >= MAX_KEYS else what
        at, left_out = self._said.get(what, (now - PERIOD, 0))
        if now - at < PERIOD:
            self._said[what] = at, left_out + 1
            return
        self._said[what] = now, 0
        more = f" ({left_out} more since the last time)" if left_out else ""
        self._log.warning(f"{text}%s", *args, more)

"""What happened to each ARC, in words: a bounded log that `zscout why` filters."""

from __future__ import annotations

from collections import deque

from zscout.messages import StoryLine
from zscout.scheduling.model import SECOND, ArcId, Ns

MAX_LINES = 20_000
MAX_TOLD = 200
"""Lines in one answer: the latest."""


class Story:
    def __init__(self) -> None:
        self._lines: deque[tuple[Ns, ArcId, str, str]] = deque(maxlen=MAX_LINES)

    def tell(self, now: Ns, arc: ArcId, name: str, text: str) -> None:
        self._lines.append((now, arc, name, text))

    def of(self, arc: str, now: Ns) -> list[StoryLine]:
        """The latest lines about an ARC (its name, id, or `<host>/<client>/<id>`), oldest first."""
        lines = [
            StoryLine(ago=(now - at) / SECOND, text=text)
            for at, full, name, text in self._lines
            if arc in (name, full, full.rpartition("/")[2])
        ]
        return lines[-MAX_TOLD:]

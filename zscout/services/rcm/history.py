"""What happened to each ARC, as text: kept for `zscout why`, and written to the log."""

from __future__ import annotations

import logging
from collections import deque

from zscout.mesh import Mesh
from zscout.mesh.supervision import Supervisor
from zscout.messages import StoryLine
from zscout.types import SECOND, ArcId, Ns

log = logging.getLogger(__name__)

MAX_LINES = 20_000
MAX_ANSWERED = 200
"""Lines in one answer: the latest."""
LOG_EVERY = 0.1
"""Seconds that lines for the log are gathered: an entry of its own for each would cost as much as a grant."""
MAX_LOGGED = 50
"""Lines in one entry of the log; the history has them all."""


class ArcHistory:
    """The latest events of one reign, by ARC."""

    def __init__(self, mesh: Mesh, supervisor: Supervisor) -> None:
        self._mesh, self._supervisor = mesh, supervisor
        self._lines: deque[tuple[Ns, ArcId, str, str]] = deque(maxlen=MAX_LINES)
        self._unlogged: list[str] = []

    def record(self, arc: ArcId, name: str, text: str) -> None:
        self._lines.append((self._mesh.now(), arc, name, text))
        if not self._unlogged:
            self._supervisor.call_later(LOG_EVERY, self.flush)
        self._unlogged.append(f"{name} {text}")

    def flush(self) -> None:
        """Writes what was gathered to the log, as one entry."""
        lines, self._unlogged = self._unlogged, []
        if len(lines) > MAX_LOGGED:
            lines[MAX_LOGGED:] = [f"and {len(lines) - MAX_LOGGED} lines more; ask `zscout why`"]
        if lines:
            log.info("%s", "\n  ".join(lines))

    def of(self, arc: str) -> list[StoryLine]:
        """The latest lines about an ARC (its name, id, or `<host>/<client>/<id>`), oldest first."""
        now = self._mesh.now()
        lines = [
            StoryLine(ago=(now - at) / SECOND, text=text)
            for at, full, name, text in self._lines
            if arc in (name, full, full.rpartition("/")[2])
        ]
        return lines[-MAX_ANSWERED:]

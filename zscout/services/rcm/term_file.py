"""The highest term that a manager of a fleet with `[security]` knows, in its state folder."""

from __future__ import annotations

import asyncio
import logging
from pathlib import Path
from typing import Final, Protocol

import msgspec

from zscout.config.state_folder import write_durably
from zscout.config.strict import BadInput, read_bytes
from zscout.messages import MAX_COUNTER, Malformed, decode_received, encode
from zscout.rcm.terms import Terms
from zscout.types import NO_TERM, Term

log = logging.getLogger(__name__)

FILE: Final = "term.json"
WRITE_TIMEOUT_S: Final = 1.0
"""Seconds for which a candidate waits for its disk before it leads."""
MAX_BYTES: Final = 4_096


class TermDisk(Protocol):
    def read(self) -> Term: ...
    async def write(self, term: Term) -> None:
        """Return once it is on disk. Raises OSError."""


class _TermFile(msgspec.Struct):
    fleet: str
    term: Term


class TermFile:
    def __init__(self, folder: Path, fleet: str) -> None:
        self._path, self._fleet = folder / FILE, fleet

    def read(self) -> Term:
        """The stored term; NO_TERM, and a warning in the log, if the file is invalid."""
        if not self._path.exists():
            return NO_TERM
        try:
            kept: _TermFile = decode_received(read_bytes(self._path, max_bytes=MAX_BYTES), _TermFile)
        except (BadInput, Malformed) as error:
            log.warning("%s can't be read, and is not used: %s", self._path, error)
            return NO_TERM
        if kept.fleet != self._fleet or not 0 <= kept.term.counter <= MAX_COUNTER:
            log.warning("%s does not belong to fleet %s, and is not used", self._path, self._fleet)
            return NO_TERM
        return kept.term

    async def write(self, term: Term) -> None:
        await asyncio.to_thread(write_durably, self._path, encode(_TermFile(self._fleet, term)), 0o600)


class KeptTerm:
    """Stores the highest of `terms` on `disk`, from which it was read; without a disk it does nothing."""

    def __init__(self, disk: TermDisk | None, terms: Terms) -> None:
        self._disk, self._terms, self._saved = disk, terms, terms.highest
        self._lock = asyncio.Lock()

    @property
    def is_due(self) -> bool:
        """Return True if `keep` must be called for a higher term: a running call stores later terms as well."""
        return self._disk is not None and not self._lock.locked()

    async def keep(self, tried: Term = NO_TERM) -> None:
        """Store the highest term, `tried` included. Return once it is on disk, or writing failed."""
        if self._disk is None:
            return
        async with self._lock:
            while (term := max(self._terms.highest, tried)) > self._saved:
                try:
                    async with asyncio.timeout(WRITE_TIMEOUT_S):
                        await self._disk.write(term)
                except (OSError, TimeoutError) as error:
                    log.warning("term %d can't be kept on disk: %s", term.counter, error)
                    return
                self._saved = term

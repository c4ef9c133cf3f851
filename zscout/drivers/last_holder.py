"""Remembers over restarts of an RC whether its last hold may have been direct: if so, the RC settles at its start."""

from __future__ import annotations

import asyncio
from pathlib import Path

from zscout.config.state_folder import write_durably


class LastHolder:
    """Kept in memory only, for an RC without an earlier holder."""

    def __init__(self, *, may_be_direct: bool = False) -> None:
        self.may_be_direct = may_be_direct

    async def note(self, *, direct: bool) -> None:
        """Record whether the RC may have a direct holder. Raises OSError if the file can't be written."""
        self.may_be_direct = direct


class UnknownLastHolder(LastHolder):
    """Without a state folder: after each start, the last hold may have been direct."""

    def __init__(self) -> None:
        super().__init__(may_be_direct=True)


class LastHolderFile(LastHolder):
    """Kept by a file, which exists while the last hold may be direct."""

    def __init__(self, folder: Path, rc: str) -> None:
        self._path = folder / "direct" / rc
        super().__init__(may_be_direct=self._path.exists())

    async def note(self, *, direct: bool) -> None:
        await asyncio.to_thread(self._write if direct else self._remove)
        await super().note(direct=direct)

    def _write(self) -> None:
        write_durably(self._path, b"its last holder may touch this device past its RC\n")

    def _remove(self) -> None:
        self._path.unlink(missing_ok=True)

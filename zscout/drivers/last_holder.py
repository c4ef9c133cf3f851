"""Whether the last holder of an RC may have been a direct one, over restarts of the RC: if so, it settles at first."""

from __future__ import annotations

import asyncio
from pathlib import Path

from zscout.config.state_folder import write_durably


class LastHolder:
    """Kept in memory only: there was nobody before."""

    def __init__(self, *, may_be_direct: bool = False) -> None:
        self.may_be_direct = may_be_direct

    async def note(self, *, direct: bool) -> None:
        """From now on the RC may have a direct holder, or has none. Raises OSError where that can't be kept."""
        self.may_be_direct = direct


class UnknownLastHolder(LastHolder):
    """Nothing can be kept: after each start it may have been one."""

    def __init__(self) -> None:
        super().__init__(may_be_direct=True)


class LastHolderFile(LastHolder):
    """Kept by a file, which is there while the last holder may be a direct one."""

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

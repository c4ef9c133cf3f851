"""Differences from what was recorded."""

from __future__ import annotations

from typing import Final, NamedTuple

SEPARATOR: Final = " > "
"""Between the parts of a path."""


class Difference(NamedTuple):
    """One thing that is not as it was. None: not there."""

    path: str
    before: object
    now: object

    def __str__(self) -> str:
        if self.before is None:
            return f"added    {self.path}: {self.now!r}"
        if self.now is None:
            return f"removed  {self.path}: {self.before!r}"
        return f"changed  {self.path}: {self.before!r} to {self.now!r}"

"""Differences from what was recorded."""

from __future__ import annotations

import difflib
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
        if not (isinstance(self.before, str) and isinstance(self.now, str)):
            return f"changed  {self.path}: {self.before!r} to {self.now!r}"
        lines = difflib.ndiff(self.before.splitlines(), self.now.splitlines())
        return "\n".join([f"changed  {self.path}:", *(f"    {line.rstrip()}" for line in lines)])

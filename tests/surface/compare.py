"""Differences from what was recorded, and which of them `changes.py` allows."""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from typing import Final, NamedTuple

from tests.surface.changes import ADDED, CHANGED, REMOVED

SEPARATOR: Final = " > "
"""Between the parts of a path."""


class Difference(NamedTuple):
    """One thing that is not as it was. None: not there."""

    path: str
    before: object
    now: object

    @property
    def allowed(self) -> bool:
        if self.before is None:
            return _listed(self.path, ADDED)
        if self.now is None:
            return _listed(self.path, REMOVED)
        return self.path in CHANGED and CHANGED[self.path][0] == self.now

    def __str__(self) -> str:
        if self.before is None:
            return f"added    {self.path}: {self.now!r}"
        if self.now is None:
            return f"removed  {self.path}: {self.before!r}"
        if not (isinstance(self.before, str) and isinstance(self.now, str)):
            return f"changed  {self.path}: {self.before!r} to {self.now!r}"
        lines = difflib.ndiff(self.before.splitlines(), self.now.splitlines())
        return "\n".join([f"changed  {self.path}:", *(f"    {line.rstrip()}" for line in lines)])


def _listed(path: str, paths: dict[str, str]) -> bool:
    return any(path == one or path.startswith((one + SEPARATOR, f"{one}.")) for one in paths)


def idle(found: Sequence[Difference], within: tuple[str, ...]) -> list[str]:
    """What `changes.py` lists of some sections without effect."""
    paths = {one.path for one in found if one.allowed}
    listed = [one for one in (*ADDED, *REMOVED, *CHANGED) if one.split(SEPARATOR)[0] in within]
    return [one for one in listed if not any(_listed(path, {one: ""}) for path in paths)]

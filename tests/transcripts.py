"""Stories as text, for any core: a player carries out the commands of each line, and what they led to stands under it.

One line is one batch of events; several commands of one instant are joined by `;`. Lines that start with `#` are
comments, indented lines are the effects, and a blank line separates. Times are seconds.
"""

from __future__ import annotations

import os
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

from zscout.types import SECOND, Ns

INDENT = "    "
REWRITE = "ZSCOUT_REWRITE"
"""1: writes down what the cores do now. Read the diff before you trust it."""


class Player(Protocol):
    """One core, and how its commands are written."""

    def batch(self, line: str) -> list[str]:
        """Carries out a line; what it led to. Raises ValueError, KeyError or IndexError if it is wrong."""


def play(player: Player, text: str, name: str) -> str:
    """The same transcript with the effects as they are now. `ValueError` names `name`, line and trouble."""
    lines: list[str] = []
    for number, line in enumerate(text.splitlines(), 1):
        if line.startswith(INDENT):
            continue
        lines.append(line)
        if line.strip() and not line.startswith("#"):
            try:
                lines += [INDENT + effect for effect in player.batch(line)]
            except (ValueError, KeyError, IndexError) as error:
                raise ValueError(f"{name}:{number}: {line!r}: {error!r}") from error
    return "\n".join(lines) + "\n"


def check(player: Player, path: Path) -> None:
    """The story in `path` is the one that the core tells, unless it is to be rewritten."""
    text = path.read_text(encoding="utf-8")
    now = play(player, text, path.name)
    if os.environ.get(REWRITE) == "1":
        path.write_text(now, encoding="utf-8")
        return
    assert now == text, f"{path.name} tells another story; rewrite with {REWRITE}=1 if it is the right one"


def settings(words: Iterable[str], *known: str) -> dict[str, Any]:
    """`key=value` each; raises ValueError for other keys than those that are known."""
    found = dict(word.split("=", 1) for word in words)
    if unknown := found.keys() - set(known):
        raise ValueError(f"unknown options {sorted(unknown)}")
    return found


def ns(text: str) -> Ns:
    """Seconds as they are written, in ns."""
    return int(Fraction(text) * SECOND)


def seconds(at: Ns) -> str:
    """The way back, shortest."""
    return f"{at / SECOND:g}"

"""The key table of docs/protocol/keys.md: it says what is sent where, and so what is fuzzed."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from zscout import messages

PROTOCOL: Final = Path(__file__).parents[2] / "docs" / "protocol" / "keys.md"
_CHUNK: Final = re.compile(r"<(\w+)>")


@dataclass(frozen=True, slots=True, repr=False)
class Row:
    """One key: what is asked there and answered, and what is published there; or it is that of tokens."""

    key: str
    """Below `zscout/<fleet>/`, with words in angle brackets."""
    asked: tuple[type, ...] = ()
    answers: tuple[type, ...] = ()
    published: tuple[type, ...] = ()
    attached: bool = False
    """Whether what is published is the attachment of bytes."""

    def __repr__(self) -> str:
        return f"<{self.key}>"

    @property
    def words(self) -> list[str]:
        return _CHUNK.findall(self.key)

    @property
    def expression(self) -> str:
        """Any key of this row."""
        return _CHUNK.sub("*", self.key)

    def filled(self, **words: str) -> str:
        """The key with these in place of its words."""
        return _CHUNK.sub(lambda found: words[found[1]], self.key)


def read_rows(document: str) -> list[Row]:
    """All rows of the key table, in its order. Raises ValueError for one that does not say what crosses there."""
    table = document[document.index("| key | kind |") :].partition("\n\n")[0]
    rows: list[Row] = []
    for line in table.splitlines()[2:]:
        key, kind = re.split(r"(?<!\\) \| ", line.strip("| \n"))[:2]
        rows.append(_row(key.strip("`").removeprefix("zscout/<fleet>/"), kind, rows))
    return rows


def _row(key: str, kind: str, before: list[Row]) -> Row:
    if kind == "liveliness token":
        return Row(key)
    if kind.startswith("the same"):
        return replace(next(row for row in before if key.startswith(f"{row.key}/")), key=key)
    asked, answers, published = list[type](), list[type](), list[type]()
    attached = "attached" in kind
    for part in kind.split(";"):
        word, _, rest = part.strip().partition(": ")
        if word not in ("query", "publication"):  # more of the part before
            word, rest = "query", part
        first, _, second = rest.partition("->")
        if word == "query":
            asked += _structs(first)
            answers += _structs(second)
        else:
            published += _structs(first)
    if not (asked and answers) and not published:
        raise ValueError(f"the row of {key} names no message: {kind}")
    return Row(key, tuple(asked), tuple(answers), tuple(published), attached)


def _structs(text: str) -> list[type]:
    """Those that a cell names, most of them as links."""
    linked = set(re.findall(r"\[(\w+)\]", text)) - {"Frames"}
    names = [name for name in re.findall(r"\b[A-Z]\w+", text) if name in linked or hasattr(messages, name)]
    return [getattr(messages, name) for name in dict.fromkeys(names)]

"""The pages of the protocol: `docs/protocol.md` is the entry, `docs/protocol/` has the parts."""

from __future__ import annotations

from pathlib import Path
from typing import Final

DOCS: Final = Path(__file__).parents[1] / "docs"
ENTRY: Final = DOCS / "protocol.md"
PARTS: Final = sorted((DOCS / "protocol").glob("*.md"))


def read_page(name: str) -> str:
    """The text of `docs/protocol/<name>.md`."""
    return (DOCS / "protocol" / f"{name}.md").read_text()

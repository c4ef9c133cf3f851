"""The pages of the protocol are short, have a heading for each few sentences, and the entry links them all."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.protocol_pages import ENTRY, PARTS
from tests.test_house import WORN

WRITTEN = [path for path in [ENTRY, *PARTS] if path.stem != "messages"]
"""All but the generated page."""


def sections(page: Path) -> Iterator[tuple[str, list[str]]]:
    """Each heading with its paragraphs and list items; tables and code are left out."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    text = re.sub(r"^\|.*\n", "", text, flags=re.MULTILINE)
    for part in re.split(r"^#+ ", text, flags=re.MULTILINE)[1:]:
        heading, _, body = part.partition("\n")
        paragraphs = re.split(r"\n\n+|\n(?=[-*] |\d+\. )", re.sub(r"\]\([^)]*\)", "]", body))
        yield heading, [paragraph for paragraph in paragraphs if paragraph.strip()]


def words(text: str) -> int:
    return len(text.replace("|", " ").split())


@pytest.mark.parametrize("page", WRITTEN, ids=lambda page: page.stem)
def test_a_page_can_be_read_in_some_minutes(page: Path) -> None:
    prose = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    assert words(prose) <= 1_500
    for heading, paragraphs in sections(page):
        assert sum(map(words, paragraphs)) <= 150, heading
        assert all(words(paragraph) <= 80 for paragraph in paragraphs), heading


@pytest.mark.parametrize("page", [ENTRY, *PARTS], ids=lambda page: page.stem)
def test_a_page_is_in_plain_english(page: Path) -> None:
    prose = re.sub(r"```.*?```|`[^`\n]*`", "", page.read_text(), flags=re.DOTALL)
    for phrase, limit in WORN.items():
        found = re.findall(phrase, prose)
        assert len(found) <= max(1, limit * words(prose) / 1_000), found


def test_the_entry_links_every_page() -> None:
    linked = set(re.findall(r"\(protocol/([\w-]+)\.md\)", ENTRY.read_text()))
    assert linked == {path.stem for path in PARTS}

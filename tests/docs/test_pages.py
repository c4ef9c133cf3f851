"""The pages of the docs are short, have a heading for each few sentences, and are in plain English."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.docs.test_protocol_pages import sections, words
from tests.test_house import WORN

DOCS = Path(__file__).parents[2] / "docs"
PAGES = [path for path in sorted(DOCS.rglob("*.md")) if path.name != "roadmap.md" and "protocol" not in str(path)]
"""All published pages but the protocol, which has tests of its own."""
CHANGELOG, CONTRIBUTING = DOCS.parent / "CHANGELOG.md", DOCS.parent / "CONTRIBUTING.md"
LONG = {CHANGELOG: 3_000}
"""Pages that are searched, not read."""
SPARE = 2
"""A short page may have this many uses of a worn phrase, whatever its rate."""


def name_of(page: Path) -> str:
    return str(page.relative_to(DOCS if DOCS in page.parents else DOCS.parent))


def text_of(page: Path) -> str:
    """The page without blocks of code."""
    return re.sub(r"^\s*```.*?^\s*```\s*$", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize("page", [*PAGES, CHANGELOG, CONTRIBUTING], ids=name_of)
def test_a_page_can_be_read_in_some_minutes(page: Path) -> None:
    assert words(text_of(page)) <= LONG.get(page, 1_500)
    for heading, paragraphs in sections(page):
        assert sum(map(words, paragraphs)) <= 150, heading
        assert all(words(paragraph) <= 80 for paragraph in paragraphs), heading


@pytest.mark.parametrize("page", [*PAGES, CHANGELOG, CONTRIBUTING], ids=name_of)
def test_a_page_is_in_plain_english(page: Path) -> None:
    text = re.sub(r"`[^`\n]*`", "", text_of(page))
    lines = text.splitlines()
    for phrase, limit in WORN.items():
        found = [line for line in lines for _ in re.findall(phrase, line)]
        assert len(found) <= max(SPARE, limit * len(text.split()) / 1000), found


def test_all_pages_together_keep_the_rates() -> None:
    texts = [text_of(page) for page in PAGES]
    total = sum(len(text.split()) for text in texts)
    for phrase, limit in WORN.items():
        uses = sum(len(re.findall(phrase, line)) for text in texts for line in text.splitlines())
        assert uses <= limit * total / 1000, phrase

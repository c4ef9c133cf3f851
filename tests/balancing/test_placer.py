"""Stories of the placer as text.

`ZSCOUT_REWRITE=1` writes down what it does now: read the diff before you trust it.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from tests.balancing import transcript

FILES = sorted((Path(__file__).parent / "transcripts").glob("*.txt"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_transcript(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    now = transcript.play(text, path.name)
    if os.environ.get("ZSCOUT_REWRITE") == "1":
        path.write_text(now, encoding="utf-8")
        return
    assert now == text, (
        f"{path.name} tells another story; rewrite with ZSCOUT_REWRITE=1 if it is the right one"
    )


def test_the_transcripts_are_found() -> None:
    assert len(FILES) >= 10


def test_a_command_that_is_not_understood_is_named_with_its_line() -> None:
    with pytest.raises(ValueError, match=r"story.txt:2: .*no such command: plaice a"):
        transcript.play("host h1\nplaice a\n", "story.txt")

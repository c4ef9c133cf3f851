"""The pictures of README and docs: none is older than what it shows, none is large, none fetches from another host."""

from __future__ import annotations

import importlib.util
import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SPEC = importlib.util.spec_from_file_location("pictures", ROOT / "docs" / "pictures.py")
assert SPEC is not None
assert SPEC.loader is not None
pictures = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(pictures)


@pytest.mark.parametrize("name", pictures.SHOWN)
def test_a_picture_shows_the_code_of_today(name: str) -> None:
    made = json.loads(pictures.MADE.read_text())
    assert made[name] == pictures.digest(pictures.SHOWN[name]), "run make pictures, look at them, and commit them"


@pytest.mark.parametrize("name", pictures.SHOWN)
def test_a_picture_is_small_and_stands_alone(name: str) -> None:
    picture = pictures.FOLDER / name
    assert picture.stat().st_size <= pictures.LARGEST
    if picture.suffix == ".svg":
        addresses = re.findall(r"https?://[^\s\"')]+", picture.read_text())
        assert set(addresses) <= {"http://www.w3.org/2000/svg"}


def test_a_digest_leaves_out_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures, "ROOT", tmp_path)
    digests = set()
    for text in ("x = 1", '"""Words."""\nx = 1  # why', "x = 2"):
        (tmp_path / "code.py").write_text(text)
        digests.add(pictures.digest(["code.py"]))
    assert len(digests) == 2

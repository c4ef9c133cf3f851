"""What programs and people see is what was recorded: a change of it is seen in the commit that makes it."""

from __future__ import annotations

import importlib.util
import json
import re
from functools import cache

import pytest

from tests.surface.compare import Difference
from tests.surface.record import RECORDED, SECTIONS, flat, text
from tests.surface.tree import PACKAGE, sources


@cache
def differences(section: str) -> list[Difference]:
    before = dict(flat(json.loads(RECORDED.read_text())[section], section))
    # As JSON: tuples are lists.
    now = dict(flat(json.loads(text(SECTIONS[section]())), section))
    return [
        Difference(path, before.get(path), now.get(path))
        for path in sorted(before.keys() | now.keys())
        if before.get(path) != now.get(path)
    ]


@pytest.mark.parametrize("section", SECTIONS)
def test_what_is_seen_is_what_was_recorded(section: str) -> None:
    found = [str(one) for one in differences(section)]
    assert not found, "mend it, or if it is meant run `python -m tests.surface.record`:\n" + "\n".join(found)


def test_every_section_is_recorded() -> None:
    assert list(json.loads(RECORDED.read_text())) == list(SECTIONS)


def test_a_lost_option_and_a_changed_text_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    now = json.loads(RECORDED.read_text())["commands"]
    del now["zscout request"]["options"]["--keep"]
    now["zscout status"]["usage"] += " NOW"
    now["zscout take"]["options"]["--new"] = {"takes": "text"}
    monkeypatch.setitem(SECTIONS, "commands", lambda: now)
    found = [str(one) for one in differences.__wrapped__("commands")]
    assert [line.split(":")[0] for line in found] == [
        "removed  commands > zscout request > options > --keep > hidden",
        "removed  commands > zscout request > options > --keep > is_flag",
        "removed  commands > zscout request > options > --keep > names > --keep",
        "removed  commands > zscout request > options > --keep > takes",
        "changed  commands > zscout status > usage",
        "added    commands > zscout take > options > --new > takes",
    ]


def test_every_module_that_a_text_names_is_there() -> None:
    """Modules that are imported when they are used, or started with `-m`, are named in texts."""
    rooms = {path.stem for path in PACKAGE.iterdir()}
    gone = []
    for module, source in sources().items():
        for named, room in re.findall(r"\"(zscout\.(\w+)(?:\.\w+)*)(?::\w+)?\"", source):
            if room in rooms and not _there(named):
                gone.append(f"{module}: {named}")
    assert not gone


def _there(module: str) -> bool:
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:
        return False

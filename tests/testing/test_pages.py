"""The examples of the pages about `zscout.testing`, run as they stand."""

from __future__ import annotations

import inspect
import re
import sys
from pathlib import Path
from typing import Any

import pytest

DOCS = Path(__file__).parents[2] / "docs"


def blocks(page: str) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```$", (DOCS / page).read_text(), re.MULTILINE | re.DOTALL)


def run(code: str, names: dict[str, Any], folder: Path) -> int:
    """Execute a block, then its tests; return how many there were."""
    exec(compile(code, "page", "exec"), names)  # noqa: S102 - our own page
    tests = [names[name] for name in re.findall(r"^async def (test_\w+)", code, re.MULTILINE)]
    for test in tests:
        test(*[folder] * len(inspect.signature(test).parameters))
    return len(tests)


@pytest.mark.parametrize("number", [0, 1])
def test_an_example_of_the_how_to(number: int, tmp_path: Path) -> None:
    assert run(blocks("how-to/test-your-code.md")[number], {}, tmp_path) == 1


def test_the_lamp_of_the_tutorial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    driver, test = (
        next(code for code in blocks("tutorial-device.md") if code.startswith(f"# {name}"))
        for name in ("lamp/lamp.py", "test_lamp.py")
    )
    (tmp_path / "lamp.py").write_text(driver)
    monkeypatch.syspath_prepend(tmp_path)
    assert run(test, {}, tmp_path) == 1
    monkeypatch.delitem(sys.modules, "lamp")
    body = test.partition("@in_virtual_time")[2].split("(tmp_path):\n")[1]
    assert len(body.strip().splitlines()) <= 10

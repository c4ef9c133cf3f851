"""The charts of docs/evaluation show the tables beside them, and each is on its page."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SPEC = importlib.util.spec_from_file_location("charts", ROOT / "docs" / "charts.py")
assert SPEC is not None
assert SPEC.loader is not None
charts = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(charts)


@pytest.mark.parametrize("name", charts.CHARTS)
def test_a_chart_shows_its_table(name: str) -> None:
    chart = charts.CHARTS[name]
    assert len(charts.rows(chart)) > 1
    assert (charts.FOLDER / name).read_text() == charts.svg(chart), "run python docs/charts.py, and look at it"
    assert f"({name})" in (charts.FOLDER / chart.page).read_text()

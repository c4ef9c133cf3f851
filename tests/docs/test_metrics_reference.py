"""docs/reference/metrics.md has every metric as the code has it, and the dashboard no other."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

from zscout.services.metrics.figures import FAMILIES, MAX_RCS, MAX_WAITERS

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "reference" / "metrics.md").read_text()
DASHBOARD = ROOT / "deploy" / "grafana" / "zscout.json"
OF_THE_PROCESS = {"process_cpu_seconds_total", "process_resident_memory_bytes"}
SUFFIXES = {"histogram": ("_bucket", "_sum", "_count"), "counter": ("",), "gauge": ("",)}


def test_the_page_has_every_metric_as_the_code_has_it() -> None:
    rows = [
        [cell.strip() for cell in row.split("|")] for row in re.findall(r"^\| (`zscout_.*) \|$", PAGE, re.MULTILINE)
    ]
    written = {
        name.strip("`"): (kind, tuple(re.findall(r"`(\w+)`", labels)), says) for name, kind, labels, _, says in rows
    }
    assert written == {name: (one.kind, one.labels, one.help) for name, one in FAMILIES.items()}
    assert f"at most {MAX_WAITERS} pairs" in PAGE
    assert f"{MAX_RCS:,} RCs" in PAGE


def test_names_are_prometheus_own_way() -> None:
    for name, family in FAMILIES.items():
        assert re.fullmatch("zscout_[a-z]+(_[a-z]+)*", name)
        assert name.endswith("_total") == (family.kind == "counter")
        assert family.kind != "histogram" or name.endswith("_seconds")


def expressions(value: object) -> Iterator[str]:
    """All PromQL in the dashboard."""
    if isinstance(value, dict):
        for key, one in value.items():
            if key in ("expr", "query") and isinstance(one, str):
                yield one
            else:
                yield from expressions(one)
    elif isinstance(value, list):
        for one in value:
            yield from expressions(one)


def test_the_dashboard_names_only_what_there_is_with_its_labels() -> None:
    found = set[str]()
    for text in expressions(json.loads(DASHBOARD.read_text())):
        found |= {*re.findall(r"\b(?:zscout|process)_\w+", text)}
        for labels in re.findall(r"by \(([^)]*)\)", text):
            known = {label for name in FAMILIES if name in text for label in FAMILIES[name].labels} | {"le"}
            assert {*labels.replace(" ", "").split(",")} <= known, text
    shown = {name + suffix for name, family in FAMILIES.items() for suffix in SUFFIXES[family.kind]}
    assert found <= shown | OF_THE_PROCESS
    # Each metric has its place there.
    missing = {name for name in FAMILIES if not any(one.startswith(name) for one in found)}
    assert missing == set()

"""The core is sealed: what stands outside the room reads it by its surface only."""

from __future__ import annotations

import ast
from pathlib import Path

from zscout.scheduling.core import Core

ROOT = Path(__file__).parents[2]
SURFACE = {
    "handle", "status", "arc", "is_queued", "waiting", "holders", "arcs_of", "arcs", "arcs_of_owners", "count_of",
    "count_of_owner", "is_open", "is_running", "place_of", "at_place", "could_have_issued", "reasons_changed",
    "report_reasons", "slots", "likely_slot", "ask_votes", "booking", "bookings", "charged",
    "charged_in_all", "drained", "upcoming", "upcoming_changed", "contended_holds",
}  # fmt: skip
SURFACE |= {
    "as_events",
    "expects_yes",
    "next_change",
    "next_order",
    "number",
    "batches",
    "term",
    "seq",
    "strategy",
    "policy",
    "patience",
}
ACTIONS = {"start", "preempt", "wait", "propose", "run_again"}


def test_the_surface_of_the_core() -> None:
    assert {name for name in dir(Core()) if not name.startswith("_")} == SURFACE | ACTIONS


def test_nobody_outside_reads_what_is_private_to_the_core() -> None:
    rooms = [path for folder in ("zscout", "studies", "benchmarks", "tests") for path in (ROOT / folder).rglob("*.py")]
    outside = [path for path in rooms if path.parent.name != "scheduling" or "studies" in path.parts]
    assert len(outside) > 200
    reached = [
        f"{path.relative_to(ROOT)}:{node.lineno}: {ast.unparse(node)}"
        for path in outside
        if "zscout.scheduling" in (text := path.read_text())
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Attribute) and _is_a_core(node.value) and node.attr not in SURFACE
    ]
    assert not reached


def _is_a_core(node: ast.expr) -> bool:
    """Whether an expression is called `core`, of whatever it is: `self.core`, `self._core`, `reign.core`."""
    name = node.attr if isinstance(node, ast.Attribute) else node.id if isinstance(node, ast.Name) else ""
    return name.strip("_") == "core"

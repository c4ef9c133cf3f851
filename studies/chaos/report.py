"""The figures of a chaos run."""

from __future__ import annotations

import json
import statistics
from collections.abc import Sequence
from typing import Any, Final, TypeAlias

from studies.chaos.checker import Violation
from studies.chaos.faults import KINDS, SECOND, Fault

Figures: TypeAlias = dict[str, Any]
MEASURES: Final = {
    "next_grant": "from a fault to the first grant of a request made after it",
    "healed": "from its end until all clients are served",
    "zenoh": "the part of `healed` until the last link and token are back",
    "ours": "the rest of `healed`",
}


def spread(values: Sequence[float]) -> Figures:
    ordered = sorted(values)
    if not ordered:
        return {"n": 0}
    p99 = ordered[min(len(ordered) - 1, round(0.99 * (len(ordered) - 1) + 0.499))]
    return {
        "n": len(ordered),
        "median": round(statistics.median(ordered), 3),
        "p99": round(p99, 3),
        "worst": round(ordered[-1], 3),
    }


def figures(faults: Sequence[Fault]) -> dict[str, Figures]:
    found = {}
    for kind in KINDS:
        alone = [fault for fault in faults if fault.kind == kind and fault.alone]
        healed = [fault for fault in alone if fault.served]
        if not alone:
            continue
        found[kind] = {
            "next_grant": spread([(fault.granted - fault.at) / SECOND for fault in alone if fault.granted]),
            "healed": spread([(fault.served - fault.mended) / SECOND for fault in healed]),
            "zenoh": spread([(fault.linked - fault.mended) / SECOND for fault in healed]),
            "ours": spread([(fault.served - fault.linked) / SECOND for fault in healed]),
        }
    return found


def late(faults: Sequence[Fault], start: int) -> list[str]:
    """Texts of the faults with the longest times `ours`, among faults that came alone."""
    alone = sorted(
        (fault for fault in faults if fault.alone and fault.served), key=lambda fault: fault.linked - fault.served
    )
    return [f"{(fault.served - fault.linked) / SECOND:.2f} s after {describe(fault, start)}" for fault in alone[:5]]


def describe(fault: Fault, start: int) -> str:
    return (
        f"{fault.kind} ({fault.how}) of {', '.join(fault.hosts or fault.touched)}"
        f" from {(fault.at - start) / SECOND:.2f} s for {(fault.mended - fault.at) / SECOND:.2f} s"
    )


def around(violation: Violation, faults: Sequence[Fault], start: int) -> str:
    """The violation, with the last faults before it."""
    last = [fault for fault in faults if fault.at <= violation.at][-2:]
    before = "; ".join(describe(fault, start) for fault in last)
    return (
        f"{(violation.at - start) / SECOND:9.3f} s  [{violation.promise}] {violation.text}  (after: {before or 'none'})"
    )


def table(found: dict[str, Figures]) -> str:
    lines = [f"{'s, median/p99/worst':15} {'n':>4}  " + "".join(f"{name:>20}" for name in MEASURES)]
    for kind, rows in found.items():
        number = max(row["n"] for row in rows.values())
        cells = (f"{r['median']:.2f}/{r['p99']:.2f}/{r['worst']:.2f}" if r["n"] else "-" for r in rows.values())
        lines.append(f"{kind:20} {number:>3}  " + "".join(f"{cell:>20}" for cell in cells))
    return "\n".join([*lines, *(f"  {name}: {meaning}" for name, meaning in MEASURES.items())])


def dump(found: Figures) -> str:
    return json.dumps(found)

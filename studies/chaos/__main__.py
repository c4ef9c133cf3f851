"""`make chaos`: faults in a real fleet for a while, then a report. Exit code 0: no promise was broken, 1: some were,
2: it can't run here."""

from __future__ import annotations

import argparse
import random
import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from studies.chaos import net, report
from studies.chaos.checker import events
from studies.chaos.faults import KINDS, SECOND
from studies.chaos.run import Fleet, NotServed, finish, random_faults
from studies.chaos.work import HOSTS, now


def main(words: list[str] | None = None) -> int:
    options = argparse.ArgumentParser(prog="python -m studies chaos", description=__doc__)
    options.add_argument("--minutes", type=float, default=20.0, help="minutes with faults (20)")
    options.add_argument("--count", type=int, help="number of faults, however long that takes")
    options.add_argument("--seed", type=int, default=1, help="selects faults and requests (1)")
    options.add_argument("--only", default="", metavar="KIND,...", help=f"only these kinds: {', '.join(KINDS)}")
    options.add_argument("--json", action="store_true", help="print the report as JSON; always so in a pipe")
    options.add_argument("--traces", type=Path, metavar="FILE", help="write the events of holds, in order of time")
    options.add_argument("--logs", type=Path, metavar="FOLDER", help="keep all logs in this folder")
    asked = options.parse_args(words)
    kinds = [kind.strip() for kind in asked.only.split(",") if kind.strip()] or list(KINDS)
    if unknown := [kind for kind in kinds if kind not in KINDS]:
        options.error(f"no such kind: {', '.join(unknown)}")
    try:
        net.check()
    except net.NoNamespaces as error:
        print(f"chaos: {error}", file=sys.stderr)
        return 2
    net.end_on_signals()
    if asked.logs is not None:
        asked.logs.mkdir(parents=True, exist_ok=True)
    folder = asked.logs or Path(tempfile.mkdtemp(prefix="zscout-chaos-"))
    keep = asked.logs is not None
    try:
        found = run(asked, kinds, folder)
        keep |= bool(found["violations"])
    except KeyboardInterrupt:
        print("chaos: interrupted", file=sys.stderr)
        return 130
    except NotServed as error:
        keep = True
        print(f"chaos: {error}; logs are in {folder}", file=sys.stderr)
        return 1
    finally:
        if not keep:
            shutil.rmtree(folder, ignore_errors=True)
    if asked.json or not sys.stdout.isatty():
        print(report.dump(found))
    else:
        print(report.table(found["figures"]))
        print(f"longest of ours: {'; '.join(found['late'])}")
        print(f"\n{found['faults']} faults in {found['seconds']:.0f} s, seed {asked.seed}; events: {found['told']}")
        print(f"{len(found['violations'])} violations" + (f"; logs are in {folder}" if keep else ""))
        for line in found["violations"][:50]:
            print(line)
    return 1 if found["violations"] else 0


def run(asked: Any, kinds: list[str], folder: Path) -> dict[str, Any]:
    rng = random.Random(f"chaos {asked.seed}")  # noqa: S311 - failures must be repeatable
    start, until = now(), time.monotonic() + asked.minutes * 60
    with Fleet(folder, str(asked.seed)) as fleet:
        print(f"chaos: {len(HOSTS)} hosts, logs in {folder}", file=sys.stderr)
        limit = lambda number: number >= asked.count if asked.count else time.monotonic() > until  # noqa: E731
        faults = random_faults(fleet, rng, kinds, limit)
        try:
            violations, counts = finish(fleet, faults)
        finally:
            if asked.traces is not None:
                write_traces(folder, asked.traces)
    return {
        "seed": asked.seed,
        "seconds": round((now() - start) / SECOND),
        "faults": len(faults),
        "figures": report.figures(faults),
        "late": report.late(faults, start),
        "told": {name: counts[name] for name in ("asked", "entered", "commanded", "command", "publish", "lost")},
        "violations": [report.around(violation, faults, start) for violation in violations],
        "logs": str(folder),
    }


def write_traces(folder: Path, file: Path) -> None:
    """Write the `zscout.trace` lines of all programs in order of time: one behaviour for `formal.traces`."""
    import json

    traced = [
        event
        for host in HOSTS
        for event in events(folder / f"{host}.log")
        if "instance" in event or "instances" in event
    ]
    with file.open("w") as out:
        for event in sorted(traced, key=lambda event: event["at"]):
            out.write(json.dumps(event) + "\n")

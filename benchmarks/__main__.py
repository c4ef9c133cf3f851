"""`make bench`: the cost of grants, as ratios to a bare Zenoh query of the same run."""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
import time
from pathlib import Path

from benchmarks import commands, crowd, latency, process, programs, reporter
from benchmarks.loop import run
from benchmarks.stats import Row, table


def progress(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


async def measure(rounds: int, crowds: int, members: int, before: str | None) -> list[Row]:
    with tempfile.TemporaryDirectory(prefix="zscout-bench-") as name:
        folder = Path(name)
        (folder / "latencies").mkdir()
        latencies = await latency.latencies(folder / "latencies", rounds, progress, before)
        async with latency.fleet_of(folder) as lab:
            programs.start(lab)
            first = await lab.client("first")
            await lab.ready(first, *programs.EXCLUSIVE, *programs.SHARABLE)
            await first.close()
            lab.clients.clear()
            progress("idle nodes")
            rows = await process.idle(lab)
            progress("zscout --help")
            rows += process.help_time(rounds=15)
            (folder / "questions").mkdir()
            rows = latencies + await latency.questions(lab, folder / "questions", rounds, progress) + rows
            (folder / "empty").mkdir()
            rows += await crowd.crowd(lab, folder / "empty", crowds, 3.0, progress, members)
            rows += process.memory_after(lab)
            rows += reporter.costs(lab.nodes["lead"].pid)
    progress("commands")
    return rows + await commands.measure(15)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    parser.add_argument("--rounds", type=int, default=500, help="rounds of each latency (default: 500)")
    parser.add_argument("--crowds", type=int, default=5, help="rounds of the crowd (default: 5)")
    parser.add_argument("--programs", type=int, default=4, help="programs that run the 20 behaviors (default: 4)")
    parser.add_argument(
        "--before", metavar="COMMIT", help="also measure this commit, in the same rounds and in a fleet of its own"
    )
    args = parser.parse_args()
    if args.rounds < 10 or args.crowds < 1 or crowd.BEHAVIORS % args.programs:
        parser.error("at least 10 rounds and 1 crowd; programs must divide 20")
    start = time.monotonic()
    load = os.getloadavg()[0]
    rows = run(measure(args.rounds, args.crowds, args.programs, args.before))
    machine = {
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "load_average_at_start": round(load, 2),
        "load_average_at_end": round(os.getloadavg()[0], 2),
        "seconds": round(time.monotonic() - start),
    }
    if args.json:
        print(json.dumps({"machine": machine, "rows": [row.as_json() for row in rows]}, indent=2))
        return
    print(table(rows))
    print(
        f"\n{machine['cores']} cores, Python {machine['python']}; {machine['seconds']} s; load average "
        f"{machine['load_average_at_start']} before, {machine['load_average_at_end']} after."
        "\nMedians; the latencies interleaved with bare queries, A B A B. Ratios compare medians of one run."
    )


if __name__ == "__main__":
    main()

"""Processor time of one load report: of the whole host, and of a node's process tree."""

from __future__ import annotations

import time
from collections.abc import Callable

from benchmarks.stats import Row, Samples
from zscout.services.node.load_reporter import Gauge
from zscout.services.node.process_use import TreeMeter


def costs(node: int, rounds: int = 200) -> list[Row]:
    """Return a row for each; `node` is the root of the process tree."""
    gauge, meter = Gauge("bench"), TreeMeter(node)
    return [
        _row("CPU of a load report", gauge.report, rounds),
        _row("CPU of a look at a node's process tree", meter.measure, rounds),
    ]


def _row(name: str, measure: Callable[[], object], rounds: int) -> Row:
    samples = Samples()
    for _ in range(rounds):
        start = time.thread_time()
        measure()
        samples.add(time.thread_time() - start)
    return Row(name, samples.median * 1e6, "us", samples.p99 * 1e6, rounds=rounds)

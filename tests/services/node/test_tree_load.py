"""The load of one process tree: on made-up and real processes, and as two nodes of one machine report it."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from tests.hang import HANG
from tests.live.lab import Lab
from tests.services.node.test_load_reporter import PARENT, Bounds, Proc, compute, start
from zscout.messages import LoadReport
from zscout.services.node.load_reporter import Gauge, TreeLoad
from zscout.services.node.process_use import PAGE, TreeMeter, faded

BUSY_NODE = """
import os, subprocess, sys
spin = "import os; parent = os.getppid()\\nwhile os.getppid() == parent: pass"
subprocess.Popen([sys.executable, "-c", spin])
from zscout.node import main
main()
"""
"""A node under which something computes; it ends with the node."""


@pytest.fixture
def proc(tmp_path: Path) -> Proc:
    return Proc(tmp_path)


def meter_of(proc: Proc, root: int) -> TreeMeter:
    return TreeMeter(root, proc=proc.folder, now=lambda: proc.at)


def test_cores_and_memory_are_the_trees_alone_and_since_the_last_look(proc: Proc) -> None:
    proc.process(10, 1, cpu=5.0, pages=10)
    proc.process(11, 10, cpu=1.0, pages=20)
    proc.process(20, 1, cpu=50.0, pages=500)
    meter = meter_of(proc, 10)
    proc.at += 2
    proc.process(11, 10, cpu=2.0, pages=30)
    proc.process(20, 1, cpu=52.0, pages=500)
    use = meter.measure()
    assert (use.elapsed, use.cores, use.memory) == (2.0, 0.5, 40 * PAGE)


def test_a_child_that_ended_is_counted_once_before_and_after_it_is_waited_for(proc: Proc) -> None:
    proc.process(10, 1, cpu=1.0)
    proc.process(11, 10, cpu=100.0)
    meter = meter_of(proc, 10)
    proc.at += 1
    proc.process(11, 10, cpu=100.5, state="Z")
    assert meter.measure().cores == 0.5
    proc.at += 1
    (proc.folder / "11" / "stat").unlink()
    proc.process(10, 1, cpu=1.25, reaped=100.5)
    assert meter.measure().cores == 0.25
    # Time that comes from nowhere is no more than the processors could give.
    proc.at += 1
    proc.process(10, 1, cpu=1.25, reaped=900.0)
    assert meter.measure().cores == os.cpu_count()
    proc.at += 1
    proc.process(10, 1, cpu=1.25)
    assert meter.measure().cores == 0.0
    assert meter.measure().elapsed == 0.0


def test_wanted_is_what_threads_ran_and_waited_for(proc: Proc) -> None:
    proc.process(10, 1)
    proc.thread(10, 10, "1000000000 0 5")
    proc.thread(10, 11, "5000000000 9000000000 5")
    meter = meter_of(proc, 10)
    proc.at += 2
    proc.thread(10, 10, "2000000000 1000000000 9")
    proc.thread(10, 11, "5500000000 9500000000 9")
    assert meter.measure().wanted == 1.5
    # Of two threads, two processors at most, whatever the figures say.
    proc.at += 1
    proc.thread(10, 11, "500000000000 900000000000 9")
    assert meter.measure().wanted == 2.0


def test_wanted_is_the_runnable_where_nobody_tells_who_waited(proc: Proc) -> None:
    for pid, parent in ((10, 1), (11, 10), (20, 1)):
        proc.process(pid, parent)
    for pid, number, state in ((10, 10, "R"), (10, 12, "S"), (10, 13, "D"), (11, 11, "R"), (20, 20, "R")):
        task = proc.folder / str(pid) / "task" / str(number)
        task.mkdir(parents=True)
        (task / "stat").write_text(f"{number} (a) R 1 (b) {state} 1 1")
    meter = meter_of(proc, 10)
    proc.at += 1
    assert meter.measure().wanted == 2.0
    # What ran is a floor: a look may come at a moment of rest.
    proc.at += 1
    proc.process(11, 10, cpu=min(2.0, os.cpu_count() or 1))
    (proc.folder / "11" / "task" / "11" / "stat").write_text("11 (a) S")
    (proc.folder / "10" / "task" / "10" / "stat").write_text("")
    assert meter.measure().wanted == min(2.0, os.cpu_count() or 1)


def test_without_proc_there_is_one_clear_line(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="does not show process 10; mount it, or set load = true"):
        TreeMeter(10, proc=tmp_path)


def test_averages_fade_as_the_kernels_do() -> None:
    averages = 0.0, 0.0, 0.0
    for _ in range(60):
        averages = faded(averages, 2.0, 1.0)
    # A minute on, the share 1 - 1/e is in the first; how often one looks changes nothing.
    assert averages == pytest.approx((1.2642, 0.3625, 0.1290), abs=1e-4)
    assert faded((0.0, 0.0, 0.0), 2.0, 60.0) == pytest.approx(averages)
    assert faded(averages, 0.0, 3_600.0)[0] < 1e-9


@pytest.mark.live
def test_a_real_tree_reports_itself_alone(started: list[subprocess.Popen[str]]) -> None:
    pid = start(started, PARENT)
    cores = Bounds(pid)
    with cores.look():
        gauge = Gauge("anvil", load=TreeLoad(pid))
    compute(pid, 0.6)
    with cores.look():
        report = gauge.report()
    assert cores.least <= report.cpu * report.cores / 100 <= cores.most
    assert report.load_average[0] > 0
    tree = [psutil.Process(pid), *psutil.Process(pid).children()]
    memory = sum(one.memory_info().rss for one in tree)
    assert report.memory_total - report.memory_available == pytest.approx(memory, rel=0.05)


@pytest.mark.live
@pytest.mark.slow
def test_of_two_nodes_on_a_machine_each_reports_its_own(tmp_path: Path) -> None:
    asyncio.run(_each_its_own(tmp_path))


def apart(busy: LoadReport, calm: LoadReport) -> bool:
    """What comes true once both have started: one goes on computing, the other has little to do."""
    used = busy.cpu > 3 * calm.cpu and busy.load_average[0] > 3 * calm.load_average[0]
    return used and busy.memory_available < busy.memory_total


async def _each_its_own(folder: Path) -> None:
    async with Lab(folder, candidates=["calm"]) as lab:
        client = await lab.client()
        heard: dict[str, LoadReport] = {}
        settled = asyncio.Event()

        def on_load(_key: str, report: LoadReport) -> None:
            heard[report.host] = report
            if len(heard) == 2 and apart(heard["busy"], heard["calm"]):
                settled.set()

        client.mesh.subscribe(client.mesh.keys.load_any, LoadReport, on_load)
        lab.node("calm", extra='load = "tree"')
        file = folder / "busy.toml"
        file.write_text('[node]\nhost = "busy"\nfleet = "fleet.toml"\nload = "tree"\n')
        lab.spawn([sys.executable, "-c", BUSY_NODE, str(file)], log="busy.log")
        async with asyncio.timeout(HANG):
            await settled.wait()

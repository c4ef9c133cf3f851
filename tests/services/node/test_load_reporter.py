"""What components use, on made-up and real process trees, and the whole report of this host."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from random import Random

import msgspec
import psutil
import pytest

from tests.hang import HANG
from zscout import messages
from zscout.messages import ComponentUse, LoadReport, Malformed
from zscout.placement.balancer import Balancer
from zscout.services.node.load_reporter import Gauge
from zscout.services.node.process_use import PAGE, TICK, RunningComponent, UseMeter

SPIN = "while True: pass"
PARENT = f"""
import subprocess, sys
child = subprocess.Popen([sys.executable, "-c", {SPIN!r}])
print(child.pid, flush=True)
child.wait()
"""
PAIR = PARENT.replace("child.wait()", SPIN)


@dataclass
class Proc:
    """A made-up /proc, and its clock."""

    folder: Path
    at: float = 100.0

    def process(
        self, pid: int, parent: int, cpu: float = 0, reaped: float = 0, pages: int = 1, state: str = "S", of: str = "a"
    ) -> None:
        """Of a program: `cpu` in seconds, `reaped` that of children that have ended and were waited for."""
        mine, theirs = round(cpu / TICK), round(reaped / TICK)
        start = round(90 / TICK)
        times = f"{mine} 0 {theirs} 0 20 0 1 0 {start}"
        stat = f"{pid} ({of}) {state} {parent} 1 1 0 -1 0 0 0 0 0 {times} 9 {pages} 7"
        (self.folder / str(pid)).mkdir(exist_ok=True)
        (self.folder / str(pid) / "stat").write_text(stat + " 0" * 20)

    def thread(self, pid: int, number: int, text: str) -> None:
        task = self.folder / str(pid) / "task" / str(number)
        task.mkdir(parents=True, exist_ok=True)
        (task / "schedstat").write_text(text)

    def meter(self, *pids: int) -> UseMeter:
        listed = [RunningComponent(f"c{pid}", "camera", 1, pid) for pid in pids]
        return UseMeter(lambda: listed, proc=self.folder, now=lambda: self.at)


@pytest.fixture
def proc(tmp_path: Path) -> Proc:
    (tmp_path / "uptime").write_text("100 1")
    (tmp_path / "7x").mkdir()
    return Proc(tmp_path)


def test_a_tree_is_summed_up_and_nothing_else(proc: Proc) -> None:
    proc.process(10, 1, cpu=1.0, pages=10)
    proc.process(11, 10, cpu=2.0, pages=20, of="a) S 1 (b c")
    proc.process(12, 11, cpu=2.0, pages=30)
    proc.process(20, 1, cpu=50.0, pages=500)
    (use,) = proc.meter(10).measure()
    # It started at 90 and it is 100: 5 s in 10 s.
    assert use == ComponentUse("c10", "camera", 1, 0.5, 60 * PAGE, 3, None)


def test_cpu_is_that_since_the_last_look_with_children_that_ended_meanwhile(proc: Proc) -> None:
    proc.process(10, 1, cpu=1.0)
    proc.process(11, 10, cpu=3.0)
    meter = proc.meter(10)
    meter.measure()
    proc.at += 2
    (proc.folder / "11" / "stat").unlink()
    proc.process(10, 1, cpu=1.5, reaped=3.5)
    (use,) = meter.measure()
    assert (use.cpu, use.processes) == (0.5, 1)
    # A child that found another parent takes its time with it; that is no use below nothing.
    proc.at += 2
    proc.process(10, 1, cpu=1.5)
    assert meter.measure()[0].cpu == 0.0


def test_a_component_that_ended_is_not_told_of(proc: Proc) -> None:
    proc.process(10, 1, state="Z")
    proc.process(11, 10, cpu=3.0)
    proc.process(20, 1)
    (proc.folder / "20" / "stat").write_text("20 (")
    proc.process(30, 1)
    assert [use.component for use in proc.meter(10, 20, 30, 40).measure()] == ["c30"]


def test_a_circle_of_parents_has_an_end(proc: Proc) -> None:
    proc.process(10, 12)
    proc.process(11, 10)
    proc.process(12, 11)
    assert proc.meter(10).measure()[0].processes == 3


def test_served_is_the_share_of_all_threads_since_the_last_look(proc: Proc) -> None:
    proc.process(10, 1)
    proc.process(11, 10)
    proc.thread(10, 10, "1000 1000 5\n")
    proc.thread(10, 15, "1000 0 5\n")
    proc.thread(11, 11, "2000 0 5\n")
    meter = proc.meter(10)
    assert meter.measure()[0].served == 0.8
    assert meter.measure()[0].served is None  # it wanted none
    proc.thread(10, 10, "1500 1500 9")
    proc.thread(11, 11, "100 100 1")  # another thread of the same number
    proc.thread(10, 15, "garbage")
    proc.thread(10, 16, "")
    assert meter.measure()[0].served == 0.5


def test_there_is_a_limit_to_components(proc: Proc) -> None:
    proc.process(10, 1)
    listed = [RunningComponent(f"c{i}", "camera", 1, 10) for i in range(messages.MAX_COMPONENTS + 5)]
    meter = UseMeter(lambda: listed, proc=proc.folder, now=lambda: proc.at)
    assert len(meter.measure()) == messages.MAX_COMPONENTS


def start(processes: list[subprocess.Popen[str]], program: str, core: int | None = None) -> int:
    """Starts a parent and its child, on one core if one is given; returns the parent's pid."""
    mine = os.sched_getaffinity(0)
    if core is not None:
        os.sched_setaffinity(0, {core})  # those it starts inherit it
    try:
        process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True)
    finally:
        os.sched_setaffinity(0, mine)
    processes.append(process)
    assert process.stdout is not None
    assert int(process.stdout.readline()) > 0
    return process.pid


def used(pid: int) -> float:
    """Seconds of processor time of a real tree."""
    tree = [psutil.Process(pid), *psutil.Process(pid).children(recursive=True)]
    return sum(one.cpu_times().user + one.cpu_times().system for one in tree)


class Bounds:
    """The cores that a real tree can have used between two looks, wherever within each it was measured."""

    def __init__(self, pid: int) -> None:
        self._pid = pid
        self._earlier: tuple[float, float, float, float] | None = None
        self.least, self.most = 0.0, 0.0

    @contextmanager
    def look(self) -> Iterator[None]:
        used_before, began = used(self._pid), time.monotonic()
        yield
        ended, used_after = time.monotonic(), used(self._pid)
        if self._earlier is not None:
            used_first, began_first, ended_first, used_last = self._earlier
            # A process counts its time in ticks.
            slack = 4 * TICK
            self.least = (used_before - used_last - slack) / (ended - began_first)
            self.most = (used_after - used_first + slack) / (began - ended_first)
        self._earlier = used_before, began, ended, used_after


def compute(pid: int, seconds: float) -> None:
    """Waits until a tree has used so much more time."""
    until, limit = used(pid) + seconds, time.monotonic() + HANG
    while used(pid) < until:
        assert time.monotonic() < limit
        time.sleep(0.02)


@pytest.mark.live
def test_a_real_tree_is_what_psutil_says(started: list[subprocess.Popen[str]]) -> None:
    pid = start(started, PARENT)
    meter = UseMeter(lambda: [RunningComponent("one", "spinner", 3, pid)])
    cores = Bounds(pid)
    with cores.look():
        meter.measure()
    compute(pid, 0.5)
    with cores.look():
        (use,) = meter.measure()
    assert cores.least <= use.cpu <= cores.most
    tree = [psutil.Process(pid), *psutil.Process(pid).children(recursive=True)]
    assert use.processes == len(tree) == 2
    assert use.memory == pytest.approx(sum(one.memory_info().rss for one in tree), rel=0.05)
    assert (use.component, use.kind, use.incarnation) == ("one", "spinner", 3)


@pytest.mark.live
@pytest.mark.skipif(not Path("/proc/self/schedstat").exists(), reason="the system does not tell")
def test_two_that_share_a_core_have_at_most_half_of_it(started: list[subprocess.Popen[str]]) -> None:
    pid = start(started, PAIR, core=min(os.sched_getaffinity(0)))
    meter = UseMeter(lambda: [RunningComponent("two", "spinner", 0, pid)])
    compute(pid, 0.1)
    meter.measure()
    compute(pid, 0.6)
    (use,) = meter.measure()
    assert use.served is not None
    # At most half of it, and less where other programs compute beside the two.
    assert 0 < use.served < 0.6


@pytest.mark.live
def test_the_report_of_this_host_is_all_that_the_balancer_knows(started: list[subprocess.Popen[str]]) -> None:
    pid = start(started, PARENT)
    gauge = Gauge("anvil", ("gpu", "arm64"), lambda: [RunningComponent("anvil/one", "spinner", 2, pid)])
    gauge.report()
    sent = gauge.report()
    report: LoadReport = messages.decode(messages.encode(sent), LoadReport)
    assert (report.host, report.number, report.labels) == ("anvil", 2, ("gpu", "arm64"))
    assert 0 < report.cores <= (os.cpu_count() or 1)
    assert 0 < report.memory_available <= report.memory_total <= psutil.virtual_memory().total
    assert 0.01 < report.speed < 100
    (use,) = report.components
    assert 0 <= report.cpu <= 100
    assert use.memory > 1_000_000
    balancer = Balancer(Random(0))  # noqa: S311
    balancer.reported(0, report)
    assert balancer.reports == {"anvil": (0, report)}


class First(msgspec.Struct):
    """The report as its first readers knew it."""

    host: str
    number: int
    cores: int
    load_average: tuple[float, float, float]
    cpu: float
    memory_available: int
    memory_total: int


def test_readers_and_writers_of_the_first_version_still_work() -> None:
    gauge = Gauge("anvil")
    old: First = messages.decode(messages.encode(gauge.report()), First)
    assert old.cores == len(os.sched_getaffinity(0))
    new: LoadReport = messages.decode(messages.encode(First("a", 1, 2, (0, 0, 0), 0, 1, 2)), LoadReport)
    assert (new.cores, new.speed, new.labels, new.components) == (2, 1.0, (), ())


@pytest.mark.parametrize(
    "bad",
    [
        {"cores": 0},
        {"cores": -0.5},
        {"cores": 1e7},
        {"speed": 0},
        {"clock": -1},
        {"labels": [""]},
        {"labels": ["x" * 131]},
        {"labels": ["x"] * 33},
        {"components": [{"component": "a", "kind": "k", "incarnation": 1, "cpu": -1, "memory": 1}]},
        {"components": [{"component": "a", "kind": "k", "incarnation": 1, "cpu": 1, "memory": 1 << 61}]},
        {"components": [{"component": "", "kind": "k", "incarnation": 1, "cpu": 1, "memory": 1}]},
    ],
    ids=str,
)
def test_figures_that_no_host_has_are_refused(bad: dict[str, object]) -> None:
    good: dict[str, object] = msgspec.to_builtins(First("a", 1, 2, (0, 0, 0), 0, 1, 2))
    messages.decode(msgspec.json.encode(good), LoadReport)
    with pytest.raises(Malformed):
        messages.decode(msgspec.json.encode(good | bad), LoadReport)

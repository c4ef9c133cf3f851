"""A host's figures: limits of containers in folder trees of both kinds, and the real system's own."""

from __future__ import annotations

import os
import time
from collections.abc import Mapping
from pathlib import Path

import psutil
import pytest

from zscout.services.node import host_figures
from zscout.services.node.host_figures import Cgroup, CpuMeter, HostMemory, Paced

GB = 1_000_000_000
NO_V1_LIMIT = "9223372036854771712"


def group(folder: Path, of: str, files: Mapping[str, str]) -> Cgroup:
    """The control groups of a process for which the system shows these files."""
    for name, text in files.items():
        path = folder / "sys" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (folder / "of").write_text(of)
    return Cgroup(folder / "sys", folder / "of")


def v1_cpu(quota: int, of: str = "") -> dict[str, str]:
    return {f"cpu/{of}cpu.cfs_quota_us": f"{quota}\n", f"cpu/{of}cpu.cfs_period_us": "100000\n"}


CORES: dict[str, tuple[str, dict[str, str], float | None]] = {
    "v2": ("0::/", {"cpu.max": "150000 100000\n"}, 1.5),
    "v2, no limit": ("0::/", {"cpu.max": "max 100000\n"}, None),
    "v2, the group above is tighter": (
        "0::/a/b",
        {"cpu.max": "max 100000", "a/cpu.max": "50000 100000", "a/b/cpu.max": "200000 100000"},
        0.5,
    ),
    "v2, its own is tighter": ("0::/a/b", {"a/cpu.max": "400000 100000", "a/b/cpu.max": "200000 100000"}, 2.0),
    "v2, another's limit": ("0::/a", {"a/cpu.max": "max 100000", "b/cpu.max": "1000 100000"}, None),
    "v2, the way is the host's": ("0::/host/only", {"cpu.max": "100000 100000"}, 1.0),
    "v2, the way leads out": ("0::/../x", {"cpu.max": "100000 100000", "x/cpu.max": "1 100000"}, 1.0),
    "v2 beside v1": ("4:cpu:/\n0::/a", {"unified/a/cpu.max": "100000 100000"}, 1.0),
    "v1": ("1:cpu:/", v1_cpu(250_000), 2.5),
    "v1, no limit": ("1:cpu:/", v1_cpu(-1), None),
    "v1, nested": (
        "3:cpu,cpuacct:/a/b\n1:name=systemd:/x",
        v1_cpu(-1) | v1_cpu(75_000, "a/") | v1_cpu(90_000, "a/b/"),
        0.75,
    ),
    "nothing there": ("0::/", {}, None),
    "garbage": ("\n:\n1\n::::\n0::/", {"cpu.max": "soon\xff later more", "cpu/cpu.cfs_quota_us": "x"}, None),
    "no period": ("0::/", {"cpu.max": "100000"}, None),
    "a period of nothing": ("0::/", {"cpu.max": "100000 0"}, None),
    "less than nothing": ("0::/", {"cpu.max": "-100000 100000"}, None),
    "beyond all numbers": ("0::/", {"cpu.max": "9" * 5_000 + " 100000"}, None),
}


@pytest.mark.parametrize(("of", "files", "expected"), CORES.values(), ids=CORES)
def test_cores_of_a_container(tmp_path: Path, of: str, files: dict[str, str], expected: float | None) -> None:
    assert group(tmp_path, of, files).cores() == expected


def v2_memory(limit: object, used: object, stat: str = "", of: str = "") -> dict[str, str]:
    files = {f"{of}memory.max": f"{limit}\n", f"{of}memory.current": f"{used}\n"}
    return files | ({f"{of}memory.stat": stat} if stat else {})


def v1_memory(limit: object, used: object, of: str = "") -> dict[str, str]:
    return {f"memory/{of}memory.limit_in_bytes": f"{limit}", f"memory/{of}memory.usage_in_bytes": f"{used}"}


DROPPED = f"anon 5\ninactive_file {GB}\nactive_file 7\n"
V1_STAT = {"memory/memory.stat": f"inactive_file 1\ntotal_inactive_file {GB // 2}\n"}
MEMORY: dict[str, tuple[str, dict[str, str], HostMemory | None]] = {
    "v2": ("0::/", v2_memory(4 * GB, GB), HostMemory(3 * GB, 4 * GB)),
    "v2, no limit": ("0::/", v2_memory("max", GB), None),
    "v2, files that can be dropped": ("0::/", v2_memory(4 * GB, 3 * GB, DROPPED), HostMemory(2 * GB, 4 * GB)),
    "v2, the wider one is fuller": (
        "0::/a",
        v2_memory(8 * GB, 7 * GB) | v2_memory(4 * GB, GB, of="a/"),
        HostMemory(GB, 4 * GB),
    ),
    "v2, over the limit": ("0::/", v2_memory(GB, 2 * GB), HostMemory(0, GB)),
    "v2, a stat that can't be": ("0::/", v2_memory(GB, GB, f"inactive_file {9 * GB}"), HostMemory(GB, GB)),
    "v1": ("4:memory:/", v1_memory(2 * GB, GB) | V1_STAT, HostMemory(3 * GB // 2, 2 * GB)),
    "v1, no limit": ("4:memory:/", v1_memory(NO_V1_LIMIT, GB), None),
    "v1, nested": ("4:memory:/a/b", v1_memory(NO_V1_LIMIT, GB) | v1_memory(2 * GB, GB, "a/b/"), HostMemory(GB, 2 * GB)),
    "nothing there": ("", {}, None),
    "nobody tells of the use": ("0::/", {"memory.max": f"{GB}"}, None),
    "garbage": ("0::/", v2_memory("much", 1), None),
    "less than nothing": ("0::/", v2_memory(-1, 1), None),
}


@pytest.mark.parametrize(("of", "files", "expected"), MEMORY.values(), ids=MEMORY)
def test_memory_of_a_container(tmp_path: Path, of: str, files: dict[str, str], expected: HostMemory | None) -> None:
    assert group(tmp_path, of, files).memory() == expected


def test_no_group_is_named_at_all(tmp_path: Path) -> None:
    (tmp_path / "cpu.max").write_text("100000 100000")
    assert Cgroup(tmp_path, tmp_path / "none").cores() == 1.0
    assert Cgroup(tmp_path / "none", tmp_path / "none").memory() is None


def test_the_time_that_the_tightest_group_used(tmp_path: Path) -> None:
    v2 = {"a/cpu.max": "50000 100000", "a/cpu.stat": "usage_usec 2500000\nuser_usec 1\n"}
    assert group(tmp_path / "v2", "0::/a", v2).used() == 2.5
    v1 = {
        "cpu/a/cpu.cfs_quota_us": "50000",
        "cpu/a/cpu.cfs_period_us": "100000",
        "cpu/a/cpu.stat": "nr_periods 7\n",
        "cpuacct/a/cpuacct.usage": "1500000000",
    }
    assert group(tmp_path / "v1", "1:cpu:/a\n2:cpuacct:/a", v1).used() == 1.5
    assert group(tmp_path / "free", "0::/", {"cpu.max": "max 1", "cpu.stat": "usage_usec 5"}).used() is None
    assert group(tmp_path / "mute", "0::/", {"cpu.max": "5 5"}).used() is None


def test_a_limit_counts_where_it_is_less_than_the_host(tmp_path: Path) -> None:
    host, bound = psutil.virtual_memory(), len(os.sched_getaffinity(0))
    small = group(
        tmp_path / "small", "0::/", {"cpu.max": "50000 100000", "memory.max": "1000000", "memory.current": "400000"}
    )
    assert host_figures.cores(small) == 0.5
    assert host_figures.memory(small) == HostMemory(600_000, 1_000_000)
    large = group(
        tmp_path / "large",
        "0::/",
        {"cpu.max": "99900000 100000", "memory.max": f"{2 * host.total}", "memory.current": "0"},
    )
    assert host_figures.cores(large) == bound
    found = host_figures.memory(large)
    assert found.total == host.total
    assert 0 < found.available <= host.total


def test_a_container_that_uses_all_it_may_is_busy_on_an_idle_host(tmp_path: Path) -> None:
    files = {"cpu.max": "1000 100000", "cpu.stat": "usage_usec 0"}
    cgroup = group(tmp_path, "0::/", files)
    before = time.monotonic()
    meter, start = CpuMeter(cgroup), time.monotonic()
    while time.monotonic() - start < 0.1:
        pass
    # As much as 0.01 cores give at most in the time that went by.
    used = time.monotonic() - start
    (tmp_path / "sys" / "cpu.stat").write_text(f"usage_usec {round(used * 10_000)}")
    percent = meter.percent(0.01)
    # What went by besides is the system's, which may have let others run.
    assert 99 * used / (time.monotonic() - before) < percent <= 100
    assert 0 <= meter.percent(0.01) <= 100


def test_a_host_that_computes_is_seen_to(tmp_path: Path) -> None:
    meter = CpuMeter(Cgroup(tmp_path, tmp_path / "none"))
    start = time.process_time()
    while time.process_time() - start < 0.3:
        pass
    assert 5 / (os.cpu_count() or 1) < meter.percent(1) <= 100


@pytest.mark.slow
def test_what_is_dear_to_measure_is_measured_less_often() -> None:
    calls = 0

    def dear() -> int:
        nonlocal calls
        calls += 1
        start = time.thread_time()
        while time.thread_time() - start < 0.01:
            pass
        return calls

    paced = Paced(dear, least=0.0, share=0.01)  # 10 ms each: once in a second
    start = time.monotonic()
    while calls < 2:
        assert paced() == calls
    assert time.monotonic() - start > 0.9
    cheap = Paced(lambda: time.monotonic(), least=0.05, share=1.0)
    start = time.monotonic()  # the pace goes by when it was called, and the process may stand still before it measures
    first = cheap()
    while (second := cheap()) == first:
        pass
    assert second - start >= 0.05


def test_speed_is_about_the_same_each_time_and_the_clock_is_none_or_some() -> None:
    first, second = host_figures.speed(), host_figures.speed()
    assert 0.01 < first < 100
    assert 0.4 < first / second < 2.5
    assert all(0 <= mhz < 100_000 for mhz in host_figures.clock())
    heat = host_figures.temperature()
    assert heat is None or -50 < heat < 200

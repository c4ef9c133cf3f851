"""The reach of the suite's quick tier: the guards of the protocol, lines and branches that it notices.

As a plugin of pytest (`-p studies.suite`) this module removes the guard named by $ZSCOUT_WITHOUT."""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final

import pytest

from studies.faults.guards import GUARDS, without
from zscout.terminal import print_line, print_table

VARIABLE: Final = "ZSCOUT_WITHOUT"
IN_PROCESS: Final = (
    "tests/studies/faults",
    "tests/services/rcm",
    "tests/services/bookings",
    "tests/behaviors/client",
    "tests/drivers",
    "tests/scheduling",
)
"""Folders whose tests run guarded code in their own process, where a guard can be removed."""
ROOMS: Final = ("scheduling", "services", "drivers", "behaviors")
SUMMED: Final = ("covered_lines", "num_statements", "covered_branches", "num_branches")
"""Counts in the summary of a file, in a report of coverage.py."""
MOST: Final = 20
ENDS: Final = 900
"""Seconds after which a run without a guard counts as failed."""
QUICK: Final = "not slow"
ROOT: Final = Path(__file__).parents[1]


def pytest_configure(config: pytest.Config) -> None:
    guard = os.environ.get(VARIABLE)
    if guard:
        stack = ExitStack()
        stack.enter_context(without(guard))
        config.add_cleanup(stack.close)


def guards() -> None:
    """Run the quick tier once without each guard, and print the first test that fails."""
    parser = argparse.ArgumentParser(prog="python -m studies guards", description=guards.__doc__)
    parser.add_argument("guards", nargs="*", metavar="GUARD", help="only these (default: all)")
    names = parser.parse_args().guards or list(GUARDS)
    unknown = [name for name in names if name not in GUARDS]
    if unknown:
        parser.error(f"unknown guard {unknown[0]!r}; write one of: {', '.join(GUARDS)}")
    rows = []
    for name in names:
        began = time.monotonic()
        tests = ("-n", "2", "--dist", "worksteal", "-x", "-m", f"{QUICK} and not live", *IN_PROCESS)
        done = _pytest("-p", "studies.suite", *tests, env={VARIABLE: name})
        failed = [line for line in done.splitlines() if line.startswith(("FAILED ", "ERROR "))]
        first = failed[0].split(maxsplit=1)[1].partition(" - ")[0] if failed else "-"
        rows.append([name, first, f"{time.monotonic() - began:.0f} s"])
        print_line(f"{name}: {rows[-1][1]}", sys.stderr)
    print_table(["removed guard", "noticed first by", "after"], rows)
    print_line(f"{sum(row[1] != '-' for row in rows)} of {len(rows)} guards are noticed by the quick tier")


def coverage() -> None:
    """Run the quick tier and the slow tests under coverage.py, and print what each reaches in four rooms."""
    argparse.ArgumentParser(prog="python -m studies coverage", description=coverage.__doc__).parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        quick = _covered(folder, "quick", QUICK)
        slow = _covered(folder, "slow", "slow")
        whole = folder / "whole"
        _coverage("combine", "--keep", f"--data-file={whole}", str(quick), str(slow))
        reports = [_report(folder, data) for data in (quick, whole)]
    parts = zip(*map(_rooms, reports), strict=True)
    rows = [[now[0], *(f"{part:.1%}" for part in (*now[1:], *then[1:]))] for now, then in parts]
    print_table(["room", "lines, quick", "branches, quick", "lines, whole", "branches, whole"], rows)
    print_line(f"\nThe {MOST} modules of which slow tests alone reach most:")
    only = sorted(_only(*reports), reverse=True)
    print_table(
        ["module", "lines that slow tests alone reach", "of"],
        [[path, str(lines), str(of)] for lines, path, of in only[:MOST]],
    )


def _pytest(*options: str, env: dict[str, str]) -> str:
    """The output of a run, which is ended after ENDS: without its guard a test may wait for ever."""
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", *options]
    whole = os.environ | env
    pytest = subprocess.Popen(command, cwd=ROOT, env=whole, stdout=subprocess.PIPE, text=True, start_new_session=True)
    try:
        return pytest.communicate(timeout=ENDS)[0]
    except subprocess.TimeoutExpired:
        os.killpg(pytest.pid, signal.SIGKILL)
        pytest.wait()
        return f"FAILED a-test-without-end ({ENDS} s)"


def _covered(folder: Path, name: str, tier: str) -> Path:
    """Run the tests of a tier under coverage; return the file of its data."""
    data, settings = folder / name, folder / f"of-{name}.ini"
    packages = "\n".join(f"  zscout.{room}" for room in ROOMS)
    settings.write_text(
        f"[run]\nbranch = true\nparallel = true\nsigterm = true\npatch = subprocess\ndata_file = {data}\n"
        f"source_pkgs =\n{packages}\n"
    )
    print_line(f"the tests that are {tier} ...", sys.stderr)
    tests = ("-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", "3", "--dist", "worksteal", "-m", tier, "tests")
    done = _coverage("run", f"--rcfile={settings}", *tests, check=False)
    print_line(done.stdout.splitlines()[-1] if done.stdout else done.stderr, sys.stderr)
    _coverage("combine", f"--rcfile={settings}", f"--data-file={data}", str(folder))
    return data


def _coverage(*words: str, check: bool = True) -> subprocess.CompletedProcess[str]:
    done = subprocess.run([sys.executable, "-m", "coverage", *words], cwd=ROOT, capture_output=True, text=True)
    if check and done.returncode:
        raise SystemExit(f"coverage {words[0]} failed: {done.stdout}{done.stderr}")
    return done


def _report(folder: Path, data: Path) -> dict[str, Any]:
    """The summary of each file of this checkout, and its executed lines, by path; not of files installed by tests."""
    report = folder / "report.json"
    _coverage("json", "-q", "--ignore-errors", f"--data-file={data}", "-o", str(report))
    files: dict[str, Any] = json.loads(report.read_text())["files"]
    return {path: file for path, file in files.items() if not Path(path).is_absolute()}


def _rooms(files: dict[str, Any]) -> Iterator[tuple[str, float, float]]:
    """For each room the parts of its lines and branches that were executed."""
    for room in ROOMS:
        found = [file["summary"] for path, file in files.items() if f"zscout/{room}/" in path]
        total = {key: sum(file[key] for file in found) for key in SUMMED}
        yield (
            room,
            total["covered_lines"] / total["num_statements"],
            total["covered_branches"] / max(1, total["num_branches"]),
        )


def _only(quick: dict[str, Any], whole: dict[str, Any]) -> Iterator[tuple[int, str, int]]:
    """Lines of each module that slow tests alone execute, most first: their number, the module, its statements."""
    for path, file in whole.items():
        lines = set(file["executed_lines"]) - set(quick.get(path, {"executed_lines": []})["executed_lines"])
        if lines:
            yield len(lines), path, file["summary"]["num_statements"]

"""The tiers of the suite, as a pytest plugin: what a test costs, and which tier it belongs to.

`slow`: over 1 s of processor time, or over 5 s of waiting (a live test: 3 s); `make test` leaves these out. An
`essential` test is not left out, and may take 3 s of processor time. A test that starts a process is `live`. A run
names each test above the bound of its tier, and counts what it left out.
"""

from __future__ import annotations

import os
import resource
import sys
import time
from collections.abc import Generator, Iterator
from typing import Any, Final, NamedTuple

import pytest

MARKERS: Final = {
    "live": "starts processes",
    "slow": "over 1 s of processor time or 5 s of waiting (live: 3 s); not in `make test`",
    "essential": "in `make test` with up to 3 s of processor time: one for each promise of the README",
}
PROCESSOR_S: Final = 1.0
ESSENTIAL_PROCESSOR_S: Final = 3.0
WAITING_S: Final = 5.0
LIVE_WAITING_S: Final = 3.0
MAX_NAMED: Final = 100
"""Tests above a bound that are named in one line each."""
STARTS_A_PROCESS: Final = {"subprocess.Popen", "os.fork", "os.forkpty", "os.posix_spawn"}
"""Audit events."""


class Cost(NamedTuple):
    """Seconds that a test took."""

    wall: float
    processor: float
    """Of this process and of its children that ended meanwhile, without fixtures that several tests share."""

    @property
    def waiting(self) -> float:
        return max(0.0, self.wall - self.processor)


def above(cost: Cost, marks: set[str]) -> str:
    """Why `cost` is above the bound of the tier of a test with these marks; "" if it is not."""
    if "slow" in marks:
        return ""
    processor = ESSENTIAL_PROCESSOR_S if "essential" in marks else PROCESSOR_S
    waiting = LIVE_WAITING_S if "live" in marks else WAITING_S
    if cost.processor > processor:
        return f"{cost.processor:.1f} s of processor time, {processor:g} s at most"
    if cost.waiting > waiting and "essential" not in marks:
        return f"{cost.waiting:.1f} s of waiting, {waiting:g} s at most"
    return ""


def spent() -> float:
    return sum(
        use.ru_utime + use.ru_stime
        for use in (resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN))
    )


class Tiers:
    """Measures tests where they run, and reports where the run ends: with workers, these are other processes."""

    def __init__(self) -> None:
        self.left_out = 0
        self.named: list[str] = []
        self.costs: list[tuple[str, Cost]] = []
        self._started = False
        self._shared = Cost(0.0, 0.0)
        """Setting up and ending shared fixtures, since the present test began."""
        sys.addaudithook(self._on_audit)

    def _on_audit(self, event: str, _args: tuple[Any, ...]) -> None:
        if event in STARTS_A_PROCESS:
            self._started = True

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, Any, Any]:
        self._started = False
        self._shared = Cost(0.0, 0.0)
        item.stash[BEGAN] = Cost(time.monotonic(), spent())
        return (yield)

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef[Any]) -> Generator[None, Any, Any]:
        """Leave out of the test's cost what a fixture costs that others use too: a fleet counts when it ends."""
        if fixturedef.scope == "function":
            return (yield)
        began = Cost(time.monotonic(), spent())
        fixturedef.addfinalizer(lambda: self._share(began))  # finalizers run in reverse: this one last
        try:
            return (yield)
        finally:
            self._share(began)

            def note() -> None:
                nonlocal began
                began = Cost(time.monotonic(), spent())

            fixturedef.addfinalizer(note)

    def _share(self, began: Cost) -> None:
        self._shared = Cost(
            self._shared.wall + time.monotonic() - began.wall, self._shared.processor + spent() - began.processor
        )

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item: pytest.Item) -> Generator[None, Any, Any]:
        answer = yield
        if self._started and item.get_closest_marker("live") is None:
            pytest.fail("this test starts a process: mark it live", pytrace=False)
        return answer

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(
        self, item: pytest.Item, call: pytest.CallInfo[None]
    ) -> Generator[None, pytest.TestReport, pytest.TestReport]:
        report = yield
        if call.when == "teardown":
            began, shared = item.stash[BEGAN], self._shared
            cost = Cost(time.monotonic() - began.wall - shared.wall, spent() - began.processor - shared.processor)
            report.user_properties.append(("cost", [*cost]))
            why = above(cost, {mark.name for mark in item.iter_markers()})
            if why:
                report.user_properties.append(("above", why))
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Called where the run ends, also for what workers report."""
        if report.when == "teardown":
            told = dict(report.user_properties)
            if "above" in told:
                self.named.append(f"{report.nodeid}: {told['above']}")
            if "cost" in told:
                self.costs.append((report.nodeid, Cost(*told["cost"])))  # type: ignore[misc]

    def pytest_deselected(self, items: list[pytest.Item]) -> None:
        self.left_out += sum(item.get_closest_marker("slow") is not None for item in items)

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        output = getattr(session.config, "workeroutput", None)
        if output is not None:
            output["left_out"] = self.left_out

    @pytest.hookimpl(optionalhook=True)
    def pytest_testnodedown(self, node: Any) -> None:
        """A worker has ended: all workers leave out the same."""
        self.left_out = getattr(node, "workeroutput", {}).get("left_out", self.left_out)

    @pytest.hookimpl(trylast=True)
    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        for line in self._lines():
            terminalreporter.write_line(line)
        path = os.environ.get("ZSCOUT_TEST_COSTS")
        if path:
            with open(path, "w") as file:  # noqa: PTH123
                file.writelines(f"{cost.wall:.2f},{cost.processor:.2f},{name}\n" for name, cost in self.costs)

    def _lines(self) -> Iterator[str]:
        if self.named:
            load = f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores"
            yield f"Above the bound of their tier (tests/tiers.py; {load}):"
            yield from (f"  {line}" for line in sorted(self.named)[:MAX_NAMED])
            if len(self.named) > MAX_NAMED:
                yield f"  and {len(self.named) - MAX_NAMED} more"
        if self.left_out:
            yield f"{self.left_out} slow tests were left out: make test-all"


BEGAN: Final = pytest.StashKey[Cost]()


def pytest_configure(config: pytest.Config) -> None:
    for name, meaning in MARKERS.items():
        config.addinivalue_line("markers", f"{name}: {meaning}")
    config.pluginmanager.register(Tiers(), "tiers")

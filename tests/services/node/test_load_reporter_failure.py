"""A load reporter that fails says so: it is logged, its token goes, and it reports again later."""

from __future__ import annotations

import pytest

from tests.mesh.kit import until
from zscout.keyexpr import Role, Sender, Token
from zscout.messages import LoadReport
from zscout.services.node import load_reporter
from zscout.services.node.load_reporter import LoadReporter
from zscout.testing.memory import MemoryNetwork


async def test_a_reporter_that_fails_is_seen_to_and_reports_again(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    faults = 2

    class Unreadable(load_reporter.Gauge):
        def __init__(self, *args: object, **how: object) -> None:
            nonlocal faults
            if faults:
                faults -= 1
                raise OSError("there is no /proc")
            super().__init__("host")

    monkeypatch.setattr(load_reporter, "Gauge", Unreadable)
    network = MemoryNetwork()
    watcher, mesh = network.open("f", Sender("w", "watcher")), network.open("f", Sender("host", "node"))
    tokens: list[bool] = []
    reports: list[LoadReport] = []

    def on_token(_token: Token, alive: bool) -> None:
        tokens.append(alive)

    watch = watcher.watch(watcher.keys.alive_any(Role.LOAD), on_token)
    heard = watcher.subscribe(watcher.keys.load("host"), LoadReport, lambda _key, report: reports.append(report))
    reporter = LoadReporter(mesh)
    reporter.start()
    await until(lambda: len(reports) > 1, within=60)
    assert tokens == [True, False, True, False, True]
    assert sum("the load reporter failed" in record.message for record in caplog.records) == 2
    await reporter.stop()
    await until(lambda: tokens[-1] is False)
    watch.close()
    heard.close()
    for one in (watcher, mesh):
        await one.close()

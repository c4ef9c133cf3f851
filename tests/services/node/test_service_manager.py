"""What a service manager hears, on a real socket."""

from __future__ import annotations

import asyncio
import os
import time
from pathlib import Path

import pytest

from tests.deploy.notify_socket import NotifySocket
from tests.mesh.kit import run
from zscout.keyexpr import new_instance
from zscout.services.node.service_manager import ServiceManager


@pytest.mark.parametrize("abstract", [False, True])
def test_it_hears_what_becomes_of_the_service(tmp_path: Path, abstract: bool) -> None:
    address = f"@zscout-{new_instance()}" if abstract else str(tmp_path / "notify")
    with NotifySocket(address) as heard:
        manager = ServiceManager.from_env({"NOTIFY_SOCKET": address})

        async def story() -> None:
            manager.ready("on the\nmesh")
            before = time.monotonic_ns() // 1_000
            manager.reloading()
            manager.ready("took it")
            manager.stopping("ends")
            first, reloading, *rest = heard.read()
            assert first == {"READY": "1", "STATUS": "on the mesh"}
            assert reloading["RELOADING"] == "1"
            assert before <= int(reloading["MONOTONIC_USEC"]) <= time.monotonic_ns() // 1_000
            assert rest == [{"READY": "1", "STATUS": "took it"}, {"STOPPING": "1", "STATUS": "ends"}]

        run(story())


@pytest.mark.parametrize("whose", ["nobody's", "own", "another's"])
def test_the_watchdog_hears_of_it_three_times_in_its_time_from_when_it_is_ready(tmp_path: Path, whose: str) -> None:
    pid = {"nobody's": "", "own": str(os.getpid()), "another's": "1"}[whose]
    with NotifySocket(str(tmp_path / "notify")) as heard:
        variables = {"NOTIFY_SOCKET": heard.address, "WATCHDOG_USEC": "30000000"}
        manager = ServiceManager.from_env(variables | ({"WATCHDOG_PID": pid} if pid else {}))

        async def story() -> None:
            await asyncio.sleep(31)
            assert heard.read() == []
            manager.ready("")
            manager.ready("")
            assert heard.read() == [{"READY": "1"}] * 2
            for second in range(1, 31):
                await asyncio.sleep(1)
                assert heard.read() == ([{"WATCHDOG": "1"}] if second % 10 == 0 and pid != "1" else []), second
            manager.stopping("")
            await asyncio.sleep(31)
            assert heard.read() == [{"STOPPING": "1"}]

        run(story())


def test_what_the_process_starts_does_not_inherit_it() -> None:
    env = {"NOTIFY_SOCKET": "/nowhere", "WATCHDOG_USEC": "1", "WATCHDOG_PID": "1", "HOME": "/root"}
    ServiceManager.from_env(env)
    assert env == {"HOME": "/root"}


def test_without_a_service_manager_nobody_is_told_and_one_that_is_gone_is_named_once(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    async def story(manager: ServiceManager) -> None:
        manager.ready("")
        await asyncio.sleep(3)
        manager.stopping("")

    run(story(ServiceManager.from_env({"WATCHDOG_USEC": "1000000"})))
    assert caplog.messages == []
    run(story(ServiceManager(str(tmp_path / "gone"), 1.0)))
    assert len(caplog.messages) == 1
    assert caplog.messages[0].startswith("can't send READY=1 to the service manager: [Errno 2]")

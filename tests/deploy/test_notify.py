"""A node and the service manager that started it, over a real notify socket."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
from pathlib import Path

import psutil
import pytest

from tests.cli.cli_fleet import in_lab
from tests.deploy.notify_socket import NotifySocket
from tests.hang import HANG
from tests.live.lab import Lab
from zscout.services.node.service_manager import BEATS, ServiceManager

pytestmark = pytest.mark.live

WATCHDOG = 1.5
"""Seconds."""
TABLE = """
[[rc]]
name = "psu/bench"
driver = "command"
safe = ["sh", "-c", 'env > "%s"']
"""


def start(lab: Lab, heard: NotifySocket, host: str, extra: str = "") -> subprocess.Popen[bytes]:
    lab.env |= {"NOTIFY_SOCKET": heard.address, "WATCHDOG_USEC": str(round(WATCHDOG * 1e6))}
    return lab.node(host, "robot/a", extra=extra)


async def until_stopped(pid: int) -> None:
    async with asyncio.timeout(HANG):
        while psutil.Process(pid).status() != psutil.STATUS_STOPPED:  # noqa: ASYNC110 - another process
            await asyncio.sleep(0.01)


@pytest.mark.slow
def test_a_node_says_that_it_is_ready_that_it_lives_and_that_it_ends(tmp_path: Path) -> None:
    told, control = tmp_path / "told", NotifySocket(str(tmp_path / "control"))

    async def story() -> None:
        async with Lab(tmp_path) as lab:
            with NotifySocket(str(tmp_path / "notify")) as heard:
                node = start(lab, heard, "anvil", TABLE % told)
                ready = await heard.until("READY")
                assert ready["STATUS"] == f"anvil is on the mesh of fleet {lab.fleet.name}"
                await lab.logged("anvil", ready["STATUS"])
                for _ in range(BEATS):
                    assert await heard.until("WATCHDOG") == {"WATCHDOG": "1"}
                # Another one that speaks as often is the clock.
                clock = ServiceManager(control.address, WATCHDOG)
                clock.ready("")
                os.kill(node.pid, signal.SIGSTOP)
                await until_stopped(node.pid)
                heard.read()
                for _ in range(2 * BEATS):
                    await control.until("WATCHDOG")
                assert heard.read() == []
                os.kill(node.pid, signal.SIGCONT)
                await heard.until("WATCHDOG")
                clock.stopping("")
                node.terminate()
                assert (await heard.until("STOPPING"))["STATUS"] == "ends in order"
                assert await asyncio.to_thread(node.wait, HANG) == 0
        # What it starts has nothing to say there.
        assert "ZSCOUT_DO=safe" in told.read_text()
        assert not {"NOTIFY_SOCKET", "WATCHDOG_USEC"} & {
            line.partition("=")[0] for line in told.read_text().split("\n")
        }

    with control:
        asyncio.run(story())


@in_lab()
async def test_a_node_that_can_not_begin_says_why(lab: Lab) -> None:
    with NotifySocket(str(lab.folder / "notify")) as heard:
        node = start(lab, heard, "anvil", "[components]\nmax = 0\n")
        assert "components.max: is 0; write a whole number" in (await heard.until("STOPPING"))["STATUS"]
        assert await asyncio.to_thread(node.wait, HANG) == 2
        assert all("READY" not in message for message in heard.heard)


@in_lab()
async def test_hangup_reads_the_files_again_and_never_ends_the_node(lab: Lab) -> None:
    with NotifySocket(str(lab.folder / "notify")) as heard:
        node = start(lab, heard, "anvil", "[components]\nmax = 3\n")
        await heard.until("READY")
        file = lab.folder / "anvil.toml"
        for old, new, said in (
            ("max = 3", "max = 4", "SIGHUP: applied components.max"),
            ("max = 4", "max = 0", "keeping the previous settings"),
            ("max = 0", "max = 4", "SIGHUP: nothing changed"),
            ("robot/a", "robot/b", "SIGHUP: applied rc.robot/a, rc.robot/b"),
        ):
            file.write_text(file.read_text().replace(old, new))
            node.send_signal(signal.SIGHUP)
            await heard.until("RELOADING")
            assert said in (await heard.until("READY"))["STATUS"]
            await lab.logged("anvil", said)
        # In its last moments too.
        node.terminate()
        while node.poll() is None:
            node.send_signal(signal.SIGHUP)
            await asyncio.sleep(0)
        assert node.returncode == 0

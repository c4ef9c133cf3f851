"""One component's process, without a node: what the host can't do for it, and what it may not do."""

from __future__ import annotations

import asyncio
import socket
import subprocess
import sys
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest

from tests.behaviors.components.kit import ROOT, gone
from tests.hang import HANG
from zscout.behaviors.components import channel
from zscout.behaviors.components.channel import EndReport, Order
from zscout.config.fleet import Fleet, default_fleet
from zscout.keyexpr import new_instance
from zscout.mesh import Refused, Supervisor
from zscout.messages import ComponentSpec, StartComponent, StopComponent
from zscout.services.node.component_process import ComponentProcess
from zscout.services.node.limits import ControlGroups
from zscout.types import SECOND

pytestmark = [pytest.mark.live, pytest.mark.real_time]


ODD = "tests.behaviors.components.odd:"


def made(
    folder: Path,
    spec: ComponentSpec,
    code: str,
    fleet: Fleet | None = None,
    on_end: Callable[[ComponentProcess], None] = lambda _: None,
) -> ComponentProcess:
    start, groups = StartComponent("c", 1, spec), ControlGroups(folder)
    return ComponentProcess("h", fleet or default_fleet(), time.monotonic_ns, groups, start, code, on_end)


def play(
    folder: Path, kind: str, params: dict[str, Any], story: Callable[[ComponentProcess], Awaitable[None]], **limits: Any
) -> ComponentProcess:
    """Runs a kind of `odd.py` as a process on a host without control groups; returns how it ended."""
    fleet = default_fleet()
    mesh = msgspec.structs.replace(fleet.mesh, multicast=False)
    rules = msgspec.structs.replace(fleet, name=f"test-{new_instance()}", mesh=mesh)
    spec = ComponentSpec(kind, params, **limits)
    ends: list[ComponentProcess] = []
    failures: list[Exception] = []

    async def run() -> ComponentProcess:
        process = made(folder, spec, ODD + kind, rules, ends.append)
        process.begin(Supervisor("test", failures.append))
        async with asyncio.timeout(HANG):
            await process.settled.wait()
            pid = process.pid
            await story(process)
            await process.over.wait()
        assert (ends, failures) == ([process], [])
        if pid is not None:
            await gone(pid)
        return process

    return asyncio.run(run())


@pytest.fixture(autouse=True)
def tests_importable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))


def test_memory_is_limited_without_groups_too_and_it_is_said_what_is_not(tmp_path: Path) -> None:
    seen = []

    async def story(process: ComponentProcess) -> None:
        seen.append(process.view().reason)

    limits: dict[str, Any] = {"memory_limit": 200_000_000, "cpu_limit": 0.5}
    process = play(tmp_path, "Eater", {"memory": 1000}, story, **limits)
    assert (process.ended, process.reason) == ("failed", "MemoryError")
    assert "memory_limit holds for each of its processes" in seen[0]
    assert "cpu_limit can't be set" in seen[0]


def test_who_says_what_is_no_message_is_killed(tmp_path: Path) -> None:
    async def story(process: ComponentProcess) -> None:
        await process.over.wait()

    process = play(tmp_path, "Garbler", {}, story)
    assert process.ended == "failed"
    assert "it sent its node an invalid message" in process.reason


def test_who_ends_before_it_has_answered_is_not_waited_for(tmp_path: Path) -> None:
    async def story(process: ComponentProcess) -> None:
        asking = asyncio.create_task(process.checkpoint())
        await asyncio.sleep(0)
        await process.stop(5)
        # Its process may still have said so itself, on its way out.
        with pytest.raises(
            Refused, match=r"it has ended, stopped|\w+ is not running on \w+; see zscout component list"
        ):
            await asking
        with pytest.raises(Refused, match="only a running component can do this"):
            await process.checkpoint()

    process = play(tmp_path, "Restless", {}, story)
    assert (process.ended, process.reason) == ("stopped", "")


async def test_who_is_stopped_before_it_is_ready_ends(tmp_path: Path) -> None:
    fleet = default_fleet()
    process = made(tmp_path, ComponentSpec("Never"), ODD + "Never")
    failures: list[Exception] = []
    process.begin(Supervisor("test", failures.append))
    began = asyncio.get_running_loop().time()
    await process.stop(0.5)
    assert asyncio.get_running_loop().time() - began < fleet.placement.start_timeout / SECOND
    assert (process.phase, process.ended) == ("ended", "stopped")
    assert process.settled.is_set()


async def test_the_last_word_of_who_has_left_counts_though_an_order_to_it_fails(tmp_path: Path) -> None:
    last, process = EndReport("moved"), made(tmp_path, ComponentSpec("counter"), "x:y")
    process._supervisor = Supervisor("test", lambda _: None)
    ours, theirs = socket.socketpair()
    code = (
        "import os, socket, sys\n"
        "node = socket.socket(fileno=int(sys.argv[1]))\n"
        "node.makefile('rb').readline()\n"
        "sys.stdin.readline()\n"
        "node.sendall(bytes.fromhex(sys.argv[2]))\n"
        "os._exit(0)\n"
    )
    command = [sys.executable, "-c", code, str(theirs.fileno()), channel.pack(last).hex()]
    with theirs:
        child = subprocess.Popen(command, pass_fds=(theirs.fileno(),), stdin=subprocess.PIPE)  # noqa: ASYNC220
    serving = asyncio.create_task(process._serve_connection(ours, child))
    while process._orders is None or not process._orders.empty():  # noqa: ASYNC110 - a test waits for any state
        await asyncio.sleep(0.001)
    # Nothing is read before it has left.
    child.communicate(b"\n")
    process._send(Order(0, StopComponent("c")))
    await serving
    assert process._end_report == last

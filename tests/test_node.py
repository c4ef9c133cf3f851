"""A node whose services fail: what ends it, and with which exit code."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from click.testing import CliRunner
from msgspec.structs import replace

from tests.hang import HANG
from tests.live.lab import Lab
from tests.mesh.kit import run, until
from zscout import node as node_module
from zscout.config.node import Node, load_node
from zscout.drivers.driver import RcHandle
from zscout.drivers.generic import ExclusiveDriver
from zscout.keyexpr import Role, Sender, Token
from zscout.mesh import MeshError
from zscout.node import NodeFailed, run_services
from zscout.services.metrics.server import MetricsServer
from zscout.services.node import local_rcs
from zscout.services.node.component_host import ComponentHost
from zscout.testing.memory import MemoryNetwork


class Faulty(ExclusiveDriver):
    """Its figures raise when they are looked at, once it is told to."""

    broken = False

    def figures(self) -> dict[str, float]:
        if self.broken:
            raise KeyError("a fault of the driver")
        return {}


@pytest.fixture
def node(tmp_path: Path) -> Node:
    file = tmp_path / "node.toml"
    file.write_text(
        '[node]\nhost = "anvil"\ncandidate = false\nload = false\n[[rc]]\nname = "robot/a"\ndriver = "exclusive"\n'
    )
    return load_node(file)


def test_an_rc_that_fails_ends_its_node(
    node: Node, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    driver = Faulty()
    monkeypatch.setattr(local_rcs, "driver_for", lambda _rc: driver)

    async def story() -> None:
        network = MemoryNetwork()
        mesh, watcher = network.open("f", Sender("anvil", "node")), network.open("f", Sender("w", "watcher"))
        tokens: dict[str, bool] = {}

        def on_token(token: Token, alive: bool) -> None:
            tokens[token.name] = alive

        watches = [watcher.watch(watcher.keys.alive_any(role), on_token) for role in (Role.NODE, Role.RC)]
        running = asyncio.create_task(run_services(node, mesh, asyncio.Event()))
        await until(lambda: tokens == {"node": True, "robot/a": True})
        driver.broken = True
        with pytest.raises(NodeFailed, match="a fault of the driver"):
            await running
        await until(lambda: tokens == {"node": False, "robot/a": False})
        for watch in watches:
            watch.close()
        for one in (mesh, watcher):
            await one.close()

    run(story())
    logged = next(record for record in caplog.records if record.levelno == logging.ERROR)
    assert logged.message == "robot/a failed"
    assert logged.exc_info is not None


def test_a_driver_that_fails_as_it_is_opened_ends_its_node(
    node: Node, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    class Unopened(ExclusiveDriver):
        async def open(self, _rc: RcHandle) -> None:
            raise KeyError("a fault of the driver")

    monkeypatch.setattr(local_rcs, "driver_for", lambda _rc: Unopened())

    async def story() -> None:
        mesh = MemoryNetwork().open("f", Sender("anvil", "node"))
        with pytest.raises(
            NodeFailed, match="robot/a can't be opened: KeyError\\('a fault of the driver'\\); see the log"
        ):
            await run_services(node, mesh, asyncio.Event())
        await mesh.close()

    run(story())
    assert "robot/a can't be opened" in caplog.messages


def test_a_component_host_that_fails_ends_its_node(node: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    hosts: list[ComponentHost] = []
    begin = ComponentHost.start

    async def start(host: ComponentHost) -> None:
        hosts.append(host)
        await begin(host)

    monkeypatch.setattr(ComponentHost, "start", start)

    async def story() -> None:
        mesh = MemoryNetwork().open("f", Sender("anvil", "node"))
        running = asyncio.create_task(run_services(node, mesh, asyncio.Event()))
        await until(lambda: bool(hosts))
        hosts[0].supervisor.fail(OSError("no more processes"))
        with pytest.raises(NodeFailed, match="no more processes"):
            await running
        await mesh.close()

    run(story())


def test_a_node_that_is_told_to_stop_stops_in_peace(node: Node) -> None:
    async def story() -> None:
        mesh, stop = MemoryNetwork().open("f", Sender("anvil", "node")), asyncio.Event()
        running = asyncio.create_task(run_services(node, mesh, stop))
        await asyncio.sleep(5)
        assert not running.done()
        stop.set()
        await running
        await mesh.close()

    run(story())


def test_of_two_nodes_of_one_name_that_begin_at_one_time_the_later_one_leaves(node: Node) -> None:
    async def story() -> None:
        network, stops = MemoryNetwork(), [asyncio.Event(), asyncio.Event()]
        meshes = [network.open("f", Sender("anvil", "node")) for _ in stops]
        both = [asyncio.create_task(run_services(node, mesh, stop)) for mesh, stop in zip(meshes, stops, strict=True)]
        done, stays = await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
        (left,) = [str(task.exception()) for task in done]
        assert left == "a node named anvil began at the same time; end it, or set another host than anvil under [node]"
        watcher = network.open("f", Sender("w", "watcher"))
        seen = set[str]()
        watcher.watch(watcher.keys.alive_any(Role.RC), lambda token, alive: seen.add(token.name) if alive else None)
        await until(lambda: seen == {"robot/a"})
        for stop in stops:
            stop.set()
        await asyncio.gather(*stays)
        for mesh in (*meshes, watcher):
            await mesh.close()

    run(story())


def test_two_nodes_of_one_name_that_meet_later_say_so(node: Node, caplog: pytest.LogCaptureFixture) -> None:
    async def story() -> None:
        network, stop = MemoryNetwork(), asyncio.Event()
        mesh, other = network.open("f", Sender("anvil", "node")), network.open("f", Sender("anvil", "other"))
        running = asyncio.create_task(run_services(replace(node, rcs=()), mesh, stop))
        await until(lambda: "is on the mesh of fleet" in caplog.text)
        token = other.alive(Token("anvil", Role.NODE, "node", "later"))
        await until(lambda: "another node named anvil is on the mesh too; end one, or set" in caplog.text)
        token.close()
        stop.set()
        await running
        for one in (mesh, other):
            await one.close()

    with caplog.at_level(logging.INFO):
        run(story())


def test_a_node_that_can_not_go_on_exits_with_1(monkeypatch: pytest.MonkeyPatch) -> None:
    async def failing(*_: object) -> None:
        raise NodeFailed("a service failed: KeyError('x'); see the log")

    monkeypatch.setattr(node_module, "_main", failing)
    done = CliRunner().invoke(node_module.main, [])
    assert done.exit_code == 1
    assert "zscout-node: a service failed: KeyError('x'); see the log" in done.stderr


def test_a_file_is_checked_with_its_drivers_and_nothing_begins(tmp_path: Path) -> None:
    file = tmp_path / "node.toml"
    file.write_text('[node]\nhost = "anvil"\n[[rc]]\nname = "robot/a"\ndriver = "exclusive"\n')
    done = CliRunner().invoke(node_module.main, ["--check", str(file)])
    assert (done.exit_code, done.stdout) == (0, f"anvil of fleet zscout: {file} can be used here\n")
    file.write_text(file.read_text().replace("exclusive", "exclusiv"))
    done = CliRunner().invoke(node_module.main, ["--check", str(file)])
    assert done.exit_code == 2
    assert f'{file}: rc[0].driver (robot/a): no driver "exclusiv" is installed here' in done.stderr


@pytest.mark.live
def test_an_rc_that_another_process_of_its_host_offers_is_refused_and_free_when_that_has_ended(node: Node) -> None:
    program = (
        "import sys\n"
        "from zscout.drivers.lock import only_here\n"
        f"with only_here({node.fleet.name!r}, 'anvil', 'robot/a'):\n"
        "    print('here', flush=True)\n"
        "    sys.stdin.read()\n"
    )
    other = subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert other.stdout is not None
    other.stdout.readline()

    async def begin() -> None:
        mesh = MemoryNetwork().open("f", Sender("anvil", "node"))
        stop = asyncio.Event()
        asyncio.get_running_loop().call_later(5, stop.set)
        try:
            await run_services(node, mesh, stop)
        finally:
            await mesh.close()

    with pytest.raises(MeshError, match="robot/a: another process on anvil serves it already"):
        run(begin())
    other.kill()
    other.communicate()
    run(begin())


@pytest.mark.slow
@pytest.mark.live
def test_a_node_ends_though_a_thread_of_a_driver_hangs_in_its_device(tmp_path: Path) -> None:
    program = (
        "import asyncio, sys, time\n"
        "from zscout import node\n"
        "from zscout.services.node import local_rcs\n"
        "from zscout.drivers.generic import ExclusiveDriver\n"
        "class Hung(ExclusiveDriver):\n"
        "    async def safe(self):\n"
        "        await asyncio.to_thread(time.sleep, 10_000)\n"
        "local_rcs.driver_for = lambda _rc: Hung()\n"
        "node.main(sys.argv[1:])\n"
    )
    lab = Lab(tmp_path)
    file = tmp_path / "anvil.toml"
    file.write_text(
        '[node]\nhost = "anvil"\nfleet = "fleet.toml"\n[[rc]]\nname = "robot/a"\ndriver = "exclusive"\nsettle = 0.5\n'
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program, str(file)], env=lab.env, stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    said = iter(process.stderr.readline, "")
    assert any("is on the mesh" in line for line in said)
    process.terminate()
    rest = process.communicate(timeout=HANG)[1]
    assert process.returncode == 1
    assert "a driver's thread hangs: exiting without it" in rest


@pytest.mark.real_time
@pytest.mark.parametrize(("holder", "starts"), [(0, False), (os.geteuid(), False), (4711, True)])
def test_a_port_that_another_user_took_first_is_done_without(
    holder: int, starts: bool, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(node_module, "listeners", lambda _address, _port: [holder])

    async def serve(port: int) -> bool:
        return await node_module._serve("metrics", MetricsServer(dict, "127.0.0.1", port))

    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        if not starts:
            with pytest.raises(NodeFailed, match=rf"\[metrics\] can't be served at 127.0.0.1:{port}: "):
                asyncio.run(serve(port))
            return
        assert not asyncio.run(serve(port))
        assert "user 4711 has the port: running without it" in caplog.text

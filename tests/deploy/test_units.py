"""The units of `deploy/systemd/`: what systemd says of them, and the node as they have it."""

from __future__ import annotations

import asyncio
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import AsyncExitStack, closing
from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import pytest
from msgspec.structs import replace

from tests.cli import tools
from tests.deploy.machine import PROJECT, Machine, missing
from tests.deploy.test_files import with_sites
from tests.drivers.mjpeg import numbered
from tests.hang import HANG
from tests.live.closed import make_keys
from tests.live.lab import Lab
from tests.ports import free_port
from zscout.behaviors.client.client import Client
from zscout.cli.common import NobodyThere
from zscout.config.certificate_authority import CertificateAuthority
from zscout.config.fleet import load_fleet
from zscout.keyexpr import Role

UNITS = sorted((PROJECT / "deploy" / "systemd").glob("*.service"))
EXPOSURE = 2.2
ANALYZE = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None, reason="systemd-analyze is missing: install the package systemd"
)
PROGRAMS = {"/opt/zscout/current/bin/zscout-node": sys.executable, "/etc/zscout/renew-certificate": "/bin/true"}
"""In a unit, and what is here in its place."""

RCS = "framegrabber/f", "psu/bench", "robot/a"
NODE = """
[node]
host = "anvil"
fleet = "fleet.toml"
[components]
max = 3
[recorder]
path = "/var/lib/zscout/runs"
port = %d
[[rc]]
name = "robot/a"
driver = "exclusive"
[[rc]]
name = "framegrabber/f"
driver = "framegrabber"
source = "/etc/zscout/film.avi"
[[rc]]
name = "psu/bench"
driver = "command"
safe = ["sh", "-c", "touch /var/lib/zscout/safe && ! touch /etc/zscout/safe"]
health = ["sh", "-c", "test -z \\"$NOTIFY_SOCKET\\""]
"""
"""What a node does all at once: pictures, commands, components, a recording."""


@pytest.mark.live
@ANALYZE
def test_systemd_finds_nothing_wrong_with_the_units(tmp_path: Path) -> None:
    for unit in (PROJECT / "deploy" / "systemd").iterdir():
        text = unit.read_text()
        for program, here in PROGRAMS.items():
            text = text.replace(program, here)
        (tmp_path / unit.name).write_text(text)
    words = ["systemd-analyze", "verify", "--man=no", *map(str, sorted(tmp_path.iterdir()))]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=HANG)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


@pytest.mark.live
@ANALYZE
@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_a_unit_is_closed_to_what_it_does_not_need(unit: Path) -> None:
    threshold = f"--threshold={round(EXPOSURE * 10)}"
    words = ["systemd-analyze", "security", "--offline=yes", "--no-pager", threshold, str(unit)]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=HANG)
    assert done.returncode == 0, done.stdout


SMALL = '[node]\nhost = "anvil"\nfleet = "fleet.toml"\n[components]\nmax = 3\n'


def film(path: Path) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (160, 120))
    for number in range(50):
        writer.write(numbered(number, grey=False))
    writer.release()


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Lab:
    return Lab(tmp_path_factory.mktemp("lab"))


@pytest.fixture(scope="module")
def machine(lab: Lab, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    if why := missing():
        pytest.skip(why)
    folder = tmp_path_factory.mktemp("machine")
    folder.chmod(0o755)
    with Machine(folder) as machine:
        machine.write("/etc/zscout/fleet.toml", lab.fleet_file.read_text())
        machine.write("/etc/zscout/node.toml", NODE % free_port())
        film(machine.path("/etc/zscout/film.avi"))
        yield machine


@pytest.mark.slow
@pytest.mark.live
def test_a_node_does_all_that_it_does_as_its_unit_has_it(machine: Machine, lab: Lab, tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    # Whatever it calls outside the filter of its unit kills it, instead of being refused.
    machine.write("/etc/systemd/system/zscout-node.service.d/strict.conf", "[Service]\nSystemCallErrorNumber=kill\n")
    machine.run("systemctl", "daemon-reload")
    machine.run("systemctl", "start", "zscout-node")  # returns when it is ready
    assert machine.show("zscout-node", "StatusText") == {
        "StatusText": f"anvil is on the mesh of fleet {lab.fleet.name}"
    }
    node = machine.process("zscout-node")
    status = dict(line.split(":\t", 1) for line in Path(f"/proc/{node.pid}/status").read_text().splitlines())
    assert {status[name] for name in ("CapInh", "CapPrm", "CapEff", "CapBnd", "CapAmb")} == {"0" * 16}
    assert (status["NoNewPrivs"], status["Seccomp"]) == ("1", "2")
    assert "0" not in status["Uid"].split()

    def saw_the_rcm(done: subprocess.CompletedProcess[str]) -> bool:
        return done.returncode != NobodyThere.exit_code

    async def story() -> None:
        async with lab:
            client = await lab.client()
            await lab.ready(client, *RCS)
            # The framegrabber publishes while it is held: until a line comes out of the pipe.
            until = ("--", "sh", "-c", f"read line <{pipe}")
            with closing(client.mesh.frames(client.mesh.keys.frame("framegrabber/f"))) as frames:
                holding = asyncio.create_task(
                    tools.zscout_soon_until(saw_the_rcm, "request", *RCS, *until, env=lab.env)
                )
                assert await frames.next(HANG) is not None
                await asyncio.to_thread(pipe.write_text, "enough\n")
                assert (held := await holding).returncode == 0, held.stderr
            started = await tools.zscout_soon_until(saw_the_rcm, "start", "counter", env=lab.env)
            assert started.returncode == 0, started.stderr

    asyncio.run(story())
    machine.until_logged("recording to /var/lib/zscout/runs/")
    assert machine.show("zscout-node", "NRestarts", "ActiveState") == {"NRestarts": "0", "ActiveState": "active"}
    assert machine.path("/var/lib/zscout/safe").exists()


@pytest.mark.slow
@pytest.mark.live
def test_reload_goes_on_and_a_bad_file_is_told(machine: Machine) -> None:
    machine.write("/etc/zscout/node.toml", SMALL)
    machine.run("systemctl", "restart", "zscout-node")
    pid = machine.show("zscout-node", "MainPID")
    for text, said in ((SMALL.replace("3", "0"), "keeping the previous settings"), (SMALL, "SIGHUP: nothing changed")):
        machine.write("/etc/zscout/node.toml", text)
        machine.run("systemctl", "reload", "zscout-node")
        machine.until_logged(said)
    machine.until("zscout-node", ActiveState="active", SubState="running", NRestarts="0", **pid)


@pytest.mark.slow
@pytest.mark.live
def test_a_frozen_node_is_started_anew_and_one_with_a_bad_file_is_not(machine: Machine) -> None:
    drop_in = "[Service]\nWatchdogSec=8\nTimeoutAbortSec=1\nExecStopPost=sh -c 'echo ended: $SERVICE_RESULT'\n"
    machine.write("/etc/systemd/system/zscout-node.service.d/zz-soon.conf", drop_in)
    machine.write("/etc/zscout/node.toml", SMALL)
    machine.run("systemctl", "daemon-reload")
    machine.run("systemctl", "restart", "zscout-node")
    before = machine.process("zscout-node")
    before.suspend()
    machine.until_logged("ended: watchdog")
    before.wait(HANG)
    machine.until("zscout-node", ActiveState="active", SubState="running")
    assert machine.process("zscout-node").pid != before.pid
    machine.write("/etc/zscout/node.toml", SMALL.replace("3", "0"))
    assert "zscout-node.service" in machine.fails("systemctl", "restart", "zscout-node")
    machine.until("zscout-node", ActiveState="failed", SubState="failed", Result="exit-code", ExecMainStatus="2")
    machine.write("/etc/zscout/node.toml", SMALL)
    machine.run("systemctl", "start", "zscout-node")
    machine.run("systemctl", "stop", "zscout-node")
    machine.until("zscout-node", ActiveState="inactive", Result="success", ExecMainStatus="0")


@pytest.mark.slow
@pytest.mark.live
def test_a_certificate_that_ends_soon_is_among_what_failed(machine: Machine, tmp_path: Path) -> None:
    machine.run("systemctl", "start", "zscout-cert-renew")  # a host of a plain mesh has none
    now, day, ca = datetime.now(UTC), timedelta(days=1), tmp_path / "ca"
    CertificateAuthority.make(ca, 300 * day, now - 100 * day)
    for began, lasts, fails in ((80, 93, True), (80, 170, False), (80, 79, True)):
        made = tmp_path / str(lasts)
        CertificateAuthority.read(ca, now).issue("anvil", made, lasts * day, now - began * day)
        for file in made.iterdir():
            machine.write(f"/etc/zscout/keys/{file.name}", file.read_text())
            machine.path(f"/etc/zscout/keys/{file.name}").chmod(0o640)
        if fails:
            machine.fails("systemctl", "start", "zscout-cert-renew")
            machine.until("zscout-cert-renew", ActiveState="failed", ExecMainStatus="1")
        else:
            machine.run("systemctl", "start", "zscout-cert-renew")
            machine.until("zscout-cert-renew", ActiveState="inactive", ExecMainStatus="0")
    assert "ends soon: renew it" in machine.log()


@pytest.mark.slow
@pytest.mark.live
def test_the_sample_relay_joins_two_sites_as_its_unit_has_it(machine: Machine, tmp_path: Path) -> None:
    endpoint = f"tls/127.0.0.1:{free_port()}"
    sample = PROJECT / "deploy" / "sample"
    text = with_sites((sample / "fleet.toml").read_text())
    machine.write("/etc/zscout/fleet.toml", text.replace("[mesh]", "[mesh]\nmulticast = false"))
    (tmp_path / "fleet.toml").write_text(text)
    machine.write("/etc/zscout/relay.toml", (sample / "relay.toml").read_text().replace("tls/0.0.0.0:7447", endpoint))
    make_keys(tmp_path, "gate", "ada", "ben")
    machine.path("/etc/zscout/keys").mkdir(exist_ok=True)
    for file in (tmp_path / "gate").iterdir():
        machine.write(f"/etc/zscout/keys/{file.name}", file.read_text())
        machine.run("chgrp", "zscout", f"/etc/zscout/keys/{file.name}")
        machine.path(f"/etc/zscout/keys/{file.name}").chmod(0o640)
    machine.write("/etc/systemd/system/zscout-relay.service.d/strict.conf", "[Service]\nSystemCallErrorNumber=kill\n")
    machine.run("systemctl", "daemon-reload")
    machine.run("systemctl", "start", "zscout-relay")  # returns when it is ready

    async def story() -> None:
        hall = load_fleet(tmp_path / "fleet.toml")
        mesh = replace(hall.mesh, multicast=False, listen=(), connect=(endpoint,))
        async with AsyncExitStack() as stack:
            for name, site in (("ada", "hall"), ("ben", "annex")):
                fleet = replace(hall, security=tmp_path / name, mesh=replace(mesh, site=site))
                client = await stack.enter_async_context(Client.connect(fleet=fleet))
            found: set[str] = set()
            while found != {"ada", "ben"}:
                tokens = await client.mesh.living(client.mesh.keys.alive_any(Role.CLIENT), timeout=1)
                found = {token.host for token in tokens}

    async def within() -> None:
        async with asyncio.timeout(HANG):
            await story()

    asyncio.run(within())
    assert machine.show("zscout-relay", "NRestarts", "ActiveState") == {"NRestarts": "0", "ActiveState": "active"}
    machine.run("systemctl", "stop", "zscout-relay")
    machine.until("zscout-relay", ActiveState="inactive", Result="success", ExecMainStatus="0")


def test_the_keys_of_a_host_are_not_of_the_group_that_people_may_be_in() -> None:
    lines = (PROJECT / "deploy" / "sysusers.d" / "zscout.conf").read_text().splitlines()
    assert "m zscout zscout-devices" in lines
    rules = (PROJECT / "deploy" / "udev" / "70-zscout.rules").read_text()
    assert 'GROUP="zscout"' not in rules
    assert rules.count('GROUP="zscout-devices"') == 2

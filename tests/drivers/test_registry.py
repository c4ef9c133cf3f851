"""Drivers that are installed beside zscout: how a node file names them, and the one line where that goes wrong."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import get_args

import pytest

from tests.config.kit import short
from tests.drivers.plugins import install
from tests.hang import HANG
from zscout.config import devices
from zscout.config.node import load_node
from zscout.config.strict import BadInput
from zscout.drivers import registry
from zscout.drivers.driver import Driver
from zscout.types import SECOND

ARM = """
from dataclasses import dataclass
from zscout.drivers.driver import Driver

class Arm(Driver):
    @dataclass(frozen=True)
    class Options:
        port: str
        speed: float = 1.5
        joints: tuple[int, ...] = ()

    def __init__(self, options):
        if options.speed > 100:
            raise ValueError("speed is above 100, which bends it; write less")
        if options.port == "gone":
            raise KeyError(options.port)
        super().__init__(options)

class Bare(Driver):
    pass

class Odd(Driver):
    @dataclass
    class Options:
        port: bytes = b""

class NoDriver:
    pass
"""
BAD = {
    "arm\nspeed = 1": "rc[0].port (arm/a): is missing; add it",
    'arm\nport = "x"\nspeed = "fast"': 'rc[0].speed (arm/a): is the text "fast"; write a number',
    'arm\nport = "x"\njoints = [1, 2.5]': "rc[0].joints[1] (arm/a): is 2.5; write a whole number",
    'arm\nport = "x"\nsped = 1': "rc[0].sped (arm/a): unknown key; did you mean speed?",
    'arm\nport = "x"\nbaud = 1': "rc[0].baud (arm/a): unknown key; known here: joints, port, speed",
    'arm\nport = "x"\nspeed = 101': "rc[0] (arm/a): speed is above 100, which bends it; write less; correct it",
    'arm\nport = "gone"': "rc[0].driver (arm/a): zscout_arm.Arm can't be created: KeyError: 'gone'; fix that",
    "bare\nport = 1": "rc[0].port (arm/a): unknown key; known here: none",
    'odd\nport = "x"': "rc[0].driver (arm/a): the options of zscout_arm.Odd can't be read: rc[0].port has an "
    "unsupported type",
    "nodriver": "rc[0].driver (arm/a): zscout_arm:NoDriver of package zscout_arm 1.0 is not a driver; "
    "name a subclass of",
    "amr": 'rc[0].driver (arm/a): no driver "amr" is installed here; did you mean "arm"? Install its package',
    "sonar": 'rc[0].driver (arm/a): no driver "sonar" is installed here; install its package into this '
    'environment, or write one of "arm", "bare", "broken", "capacity", "command", "exclusive", "framegrabber", ',
    "broken": "rc[0].driver (arm/a): broken:Arm of package broken 1.0 can't be loaded: ModuleNotFoundError: No module "
    "named 'no_such_vendor'; fix that package, or install its needs; --log-level debug shows more",
    "quits": "rc[0].driver (arm/a): quits:Arm of package quits 1.0 can't be loaded: SystemExit: no licence\\x1b[2J;",
    "twice": 'rc[0].driver (arm/a): "twice" comes with one:Arm of package one 1.0 and two:Arm of package two 1.0; '
    "uninstall one of them",
}
"""How the message about a driver begins."""


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    site = tmp_path / "site"
    install(site, "zscout_arm", ARM, arm="Arm", bare="Bare", odd="Odd", nodriver="NoDriver")
    install(site, "broken", "import no_such_vendor", broken="Arm")
    install(site, "quits", "raise SystemExit('no licence\\033[2J')", quits="Arm")
    install(site, "one", "", twice="Arm")
    install(site, "two", "", twice="Arm")
    monkeypatch.syspath_prepend(site)
    monkeypatch.chdir(tmp_path)
    return site


def made(driver: str) -> Driver:
    name, _, options = driver.partition("\n")
    Path("node.toml").write_text(f'[[rc]]\nname = "arm/a"\ndriver = "{name}"\n{options}')
    (rc,) = load_node(Path("node.toml")).rcs
    return registry.driver_for(rc)


@pytest.mark.usefixtures("site")
@pytest.mark.parametrize(("driver", "line"), BAD.items(), ids=map(short, BAD))
def test_what_can_not_be_used_is_one_line_that_says_how_to_mend_it(driver: str, line: str) -> None:
    with pytest.raises(BadInput) as bad:
        made(driver)
    assert str(bad.value).startswith(f"node.toml: {line}")


@pytest.mark.usefixtures("site")
def test_a_driver_is_made_with_its_options() -> None:
    arm = made('arm\nport = "/dev/arm"\njoints = [1, 2]')
    assert type(arm).__name__ == "Arm"
    assert (arm.options.port, arm.options.speed, arm.options.joints) == ("/dev/arm", 1.5, (1, 2))
    assert type(made("bare")).__name__ == "Bare"
    Path("node.toml").write_text('[[rc]]\nname = "arm/a"\ndriver = "bare"\nsettle = 2.5\n')
    (rc,) = load_node(Path("node.toml")).rcs
    assert rc.settle == 5 * SECOND // 2


def test_what_comes_with_zscout_is_found_in_the_same_way() -> None:
    assert set(registry.BUILT_IN) == devices.BUILT_IN
    tables = {str(rc.__struct_config__.tag): rc for rc in get_args(devices.BuiltInRc)}
    for name, table in tables.items():
        module, _, attribute = registry.BUILT_IN[name].partition(":")
        driver = getattr(__import__(module, fromlist=[attribute]), attribute)
        assert issubclass(driver, Driver)
        assert driver.Options is table


@pytest.mark.live
def test_a_node_with_such_a_driver_ends_with_that_line_and_2(site: Path) -> None:
    Path("node.toml").write_text('[[rc]]\nname = "arm/a"\ndriver = "broken"\n')
    command = [sys.executable, "-m", "zscout.node", "node.toml"]
    path = ":".join([str(site), *sys.path])
    done = subprocess.run(command, env={"PYTHONPATH": path}, capture_output=True, text=True, timeout=HANG, check=False)
    assert (done.returncode, done.stderr) == (2, f"zscout-node: node.toml: {BAD['broken']}\n")

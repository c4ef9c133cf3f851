"""The sample fleet and the container file."""

from __future__ import annotations

import re
import shlex
import subprocess
from fnmatch import fnmatchcase
from pathlib import Path

import pytest

from tests.deploy.machine import PROJECT
from tests.hang import HANG
from zscout.config.fleet import load_fleet
from zscout.config.node import load_node

SAMPLE = PROJECT / "deploy" / "sample"
HOSTS = ("anvil", "bellows", "crucible")
INSTRUCTIONS = {"CMD", "COPY", "ENTRYPOINT", "ENV", "FROM", "RUN", "STOPSIGNAL", "USER", "VOLUME", "WORKDIR"}


def with_sites(fleet: str) -> str:
    """The sample fleet as it is where there are other sites."""
    text, count = re.subn(r'^(\s*)# (site = |"tls/gate|relay = )', r"\1\2", fleet, flags=re.MULTILINE)
    assert count == 3
    return text


@pytest.mark.parametrize("host", HOSTS)
def test_a_sample_file_is_read_and_offers_what_its_fleet_expects(host: str) -> None:
    node = load_node(SAMPLE / f"{host}.toml")
    assert node.host == host
    assert node.fleet.candidates == HOSTS
    assert sorted(node.fleet.devices[host]) == sorted(rc.name for rc in node.rcs)
    assert node.fleet.security is not None
    roles = node.fleet.access.roles
    assert roles.manager == HOSTS
    assert all(any(fnmatchcase(rc.name, pattern) for pattern in roles.node[host]) for rc in node.rcs)


def test_the_sample_relay_joins_the_site_of_the_sample_fleet_to_another(tmp_path: Path) -> None:
    (tmp_path / "fleet.toml").write_text(with_sites((SAMPLE / "fleet.toml").read_text()))
    (tmp_path / "relay.toml").write_text((SAMPLE / "relay.toml").read_text())
    relay, hall = load_node(tmp_path / "relay.toml"), load_fleet(tmp_path / "fleet.toml")
    assert hall.mesh.site in relay.fleet.mesh.relay
    assert (relay.fleet.mesh.site, relay.candidate, relay.rcs) == (None, False, ())
    assert relay.fleet.access.roles.relay == (relay.host,)
    assert [one for one in hall.mesh.connect if f"/{relay.host}." in one]


def instructions() -> list[tuple[str, str]]:
    """Of the container file: the instruction and the rest of it."""
    lines = [line for line in (PROJECT / "deploy/container/Containerfile").read_text().splitlines() if line[:1] != "#"]
    whole = "\n".join(lines).replace("\\\n", " ").splitlines()
    return [(line.split(maxsplit=1)[0], line.split(maxsplit=1)[1]) for line in whole if line.strip()]


@pytest.mark.live
def test_the_container_file_says_what_can_be_done() -> None:
    """No builder's word: there may be none here, nor the image that it begins with."""
    found = instructions()
    assert {name for name, _ in found} == INSTRUCTIONS
    assert found[0][0] == "FROM"
    for name, rest in found:
        if name == "RUN":
            done = subprocess.run(["sh", "-n", "-c", rest], capture_output=True, text=True, timeout=HANG, check=False)
            assert done.returncode == 0, done.stderr
        if name == "COPY" and "--from" not in rest:
            *sources, _target = shlex.split(rest)
            assert {source for source in sources if not (PROJECT / source).exists()} == set()


def test_what_a_container_runs_is_nobody_in_particular_and_installed_by_hash() -> None:
    found = instructions()
    last = max(number for number, (name, _) in enumerate(found) if name == "FROM")
    assert [rest for name, rest in found[last:] if name == "USER"] == ["64642:64642"]
    installs = [part for name, rest in found if name == "RUN" for part in rest.split("&&") if "pip install" in part]
    assert len(installs) == 3
    assert all("--require-hashes" in part or "--no-deps" in part for part in installs)

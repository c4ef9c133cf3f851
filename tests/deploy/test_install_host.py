"""What `deploy/install-host` refuses, and what it says that it would do. `python -m tests.install` has it install."""

from __future__ import annotations

import hashlib
import re
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.deploy.machine import PROJECT
from tests.hang import HANG

pytestmark = pytest.mark.live
SCRIPTS = ("deploy/install-host", "deploy/renew-certificate", "deploy/zscout", "tests/deploy/machine.sh", ".ci/run")


@pytest.fixture
def wheel(tmp_path: Path) -> Path:
    file = tmp_path / "zscout-9.8.7-py3-none-any.whl"
    file.write_bytes(b"a wheel")
    return file


def install(*words: object) -> subprocess.CompletedProcess[str]:
    command = [str(PROJECT / "deploy" / "install-host"), *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=HANG)


@pytest.mark.skipif(shutil.which("shellcheck") is None, reason="shellcheck is missing: install the package shellcheck")
@pytest.mark.parametrize("script", SCRIPTS)
def test_a_script_has_nothing_that_shellcheck_knows_to_be_wrong(script: str) -> None:
    done = subprocess.run(["shellcheck", str(PROJECT / script)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "")


@pytest.mark.skipif(shutil.which("systemd-sysusers") is None, reason="systemd is missing: install the package systemd")
def test_a_dry_run_says_all_that_would_be_done_and_does_nothing(wheel: Path, tmp_path: Path) -> None:
    node = tmp_path / "anvil.toml"
    node.write_text('[node]\nhost = "anvil"\n')
    digest = hashlib.sha256(wheel.read_bytes()).hexdigest()
    done = install("--wheel", wheel, "--sha256", digest, "--node", node, "--dry-run")
    assert done.returncode == 0, done.stderr
    *steps, last = done.stdout.splitlines()
    assert last == "nothing was changed"
    assert all(step.startswith("would run: ") for step in steps)
    home = next(word for word in steps[0].split() if word.startswith("/opt/zscout/9.8.7-"))
    in_order = (
        f"-m venv {home}",
        f"{home}/bin/pip install --quiet --disable-pip-version-check --require-hashes -r",
        f"--no-deps {wheel}",
        f"touch {home}/complete",
        f"zscout-node --check {node}",
        "systemd-sysusers /etc/sysusers.d/zscout.conf",
        "-m 750 -o root -g zscout /etc/zscout/keys",
        "/etc/zscout/node.toml",
        "mv -T /opt/zscout/next /opt/zscout/current",
        "/etc/systemd/system/zscout-node.service",
        "systemctl enable --quiet zscout-node.service",
    )
    at = 0
    for part in in_order:
        at = done.stdout.index(part, at)
    assert not Path(home).exists()
    for unit in (PROJECT / "deploy" / "systemd").iterdir():
        assert re.search(rf"install -D .* \S*/{unit.name} /etc/systemd/system/{unit.name}$", done.stdout, re.MULTILINE)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "name the wheel, as in --wheel"),
        (("--weel", "x"), "--weel is not known"),
        (("--wheel",), "--wheel needs a value"),
        (("--wheel", "/nowhere/zscout-1-py3-none-any.whl"), "/nowhere/zscout-1-py3-none-any.whl can't be read"),
        (("--wheel", __file__), "is no wheel of zscout"),
        (("--wheel", "{wheel}", "--sha256", "0"), "is not what it should be: its SHA-256 is"),
        (("--wheel", "{wheel}", "--node", "/nowhere.toml"), "/nowhere.toml can't be read"),
        (("--wheel", "{wheel}", "--keys", "/nowhere"), "/nowhere has no key.pem that can be read"),
    ],
)
def test_what_is_asked_for_wrongly_is_refused_in_one_line(wheel: Path, words: tuple[str, ...], said: str) -> None:
    done = (
        install(*(word.format(wheel=wheel) for word in words), "--dry-run")
        if words != ("--wheel",)
        else install(*words)
    )
    assert done.returncode == 2
    assert done.stdout == ""
    assert said in done.stderr.splitlines()[-1]

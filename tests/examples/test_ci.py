"""The pipelines in examples/ci: their shell lines run against a real fleet, each step as its service runs it."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml  # type: ignore[import-untyped]

from tests.cli.cli_fleet import CliFleet, fleet_of
from tests.cli.tools import gone
from tests.hang import HANG

pytestmark = [pytest.mark.live, pytest.mark.slow]

FILES = Path(__file__).parents[2] / "examples" / "ci"
GITLAB: dict[str, Any] = yaml.safe_load((FILES / "gitlab-ci.yml").read_text())["test-on-board"]
GITHUB: dict[str, Any] = yaml.safe_load((FILES / "github.yml").read_text())["jobs"]["test-on-board"]
JENKINS = (FILES / "Jenkinsfile").read_text()


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory, fleet_kind: str) -> Iterator[CliFleet]:
    folder = tmp_path_factory.mktemp("ci")
    (folder / "zscout").mkdir(mode=0o700)
    programs = folder / "bin"
    programs.mkdir()
    (programs / "zscout").write_text(f'#!/bin/sh\nexec {sys.executable} -m zscout.cli.main "$@"\n')
    (programs / "zscout").chmod(0o755)
    env = {"XDG_RUNTIME_DIR": str(folder), "PATH": f"{programs}:{os.environ['PATH']}"}
    with fleet_of(folder, "dut/board", env=env) as fleet:
        yield fleet


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    folder = tmp_path / "checkout"
    folder.mkdir()
    program(folder, "flash.sh", 'echo "flash $ZSCOUT_RCS" >> log')
    program(folder, "test.sh", 'echo "test $ZSCOUT_GRANT" >> log; exit ${CODE:-0}')
    return folder


def program(folder: Path, name: str, script: str) -> None:
    (folder / name).write_text(f"#!/bin/sh\n{script}\n")
    (folder / name).chmod(0o755)


def shell(fleet: CliFleet, folder: Path, script: str, env: Mapping[str, str] = os.environ) -> subprocess.Popen[str]:
    """One step, in a process group of its own."""
    return subprocess.Popen(
        ["bash", "-e", "-o", "pipefail", "-c", script],
        cwd=folder,
        env=fleet.lab.env | dict(env),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        process_group=0,
    )


def ran(process: subprocess.Popen[str]) -> tuple[int, str]:
    said, _ = process.communicate(timeout=HANG)
    return process.returncode, said


def gitlab(fleet: CliFleet, folder: Path, env: Mapping[str, str]) -> int:
    """All lines in one shell."""
    script = "\n".join(GITLAB["script"])
    code, _ = ran(shell(fleet, folder, script, {"GITLAB_CI": "true", **env}))
    return code


def github(fleet: CliFleet, folder: Path, env: Mapping[str, str]) -> int:
    """A shell for each step, which hand variables on in a file. After a failure only those of `always()` run."""
    variables, worst = folder / "env", 0
    variables.touch()
    for step in GITHUB["steps"]:
        given = dict(line.split("=", 1) for line in variables.read_text().splitlines())
        always = step.get("if", "").startswith("always()") and "TOKEN" in given
        if "run" not in step or (worst and not always):
            continue
        code, _ = ran(shell(fleet, folder, step["run"], {"GITHUB_ENV": str(variables), **given, **env}))
        worst = worst or code
    return worst


def jenkins(fleet: CliFleet, folder: Path, env: Mapping[str, str]) -> int:
    """A shell for each `sh`; the first gives the token, the last one is run always."""
    acquire, *steps = re.findall(r"sh(?:\(returnStdout: true, script:)? '(.*?)'\)?", JENKINS)
    process = shell(fleet, folder, f"{acquire} 2>/dev/null", env)
    code, token = ran(process)
    given = {"TOKEN": token.strip(), **env}
    for step in steps[:-1]:
        code = code or ran(shell(fleet, folder, step, given))[0]
    return code or ran(shell(fleet, folder, steps[-1], given))[0]


SERVICES: dict[str, Callable[[CliFleet, Path, Mapping[str, str]], int]] = {
    "gitlab": gitlab,
    "github": github,
    "jenkins": jenkins,
}


@pytest.mark.parametrize("service", SERVICES)
def test_a_pipeline_flashes_and_tests_under_one_hold(fleet: CliFleet, checkout: Path, service: str) -> None:
    assert SERVICES[service](fleet, checkout, {}) == 0
    flash, test = (checkout / "log").read_text().splitlines()
    assert flash == "flash dut/board"
    assert test.startswith("test [[")
    assert fleet.idle("dut/board")


@pytest.mark.parametrize("service", ["gitlab", "github"])
def test_a_test_that_fails_has_its_own_code_and_gives_the_board_back(
    fleet: CliFleet, checkout: Path, service: str
) -> None:
    assert SERVICES[service](fleet, checkout, {"CODE": "3"}) == 3
    assert fleet.idle("dut/board")


def test_gitlab_tries_again_what_zscout_could_not_do(fleet: CliFleet, checkout: Path) -> None:
    assert GITLAB["retry"]["exit_codes"] == 99
    blocker = fleet.holder("blocker", "dut/board", "--priority", "9")
    script = "\n".join(GITLAB["script"]).replace("--timeout 30m", "--timeout 0")
    code, said = ran(shell(fleet, checkout, script, {"GITLAB_CI": "true"}))
    assert (code, "acquire was not granted at once" in said) == (99, True)
    blocker.terminate()
    assert fleet.idle("dut/board")


def test_a_gitlab_job_that_is_killed_gives_back(fleet: CliFleet, checkout: Path) -> None:
    program(checkout, "test.sh", "echo $$ > pid.new; mv pid.new pid; exec sleep 1000")
    job = shell(fleet, checkout, "\n".join(GITLAB["script"]), {"GITLAB_CI": "true"})
    while not (checkout / "pid").exists():
        assert job.poll() is None
    os.killpg(job.pid, signal.SIGKILL)
    ran(job)
    assert gone(int((checkout / "pid").read_text()))
    assert fleet.idle("dut/board")


@pytest.mark.parametrize(("variable", "number"), [("RUNNER_TRACKING_ID", 9), ("JENKINS_NODE_COOKIE", 15)])
def test_a_job_that_is_cancelled_between_steps_gives_back(
    fleet: CliFleet, checkout: Path, variable: str, number: int
) -> None:
    """GitHub and Jenkins end whatever has a variable of the job's in its environment."""
    mark = f"{variable}=job-of-{checkout.parent.name}"
    code, _ = ran(shell(fleet, checkout, "zscout acquire dut/board --for 2h", dict([mark.split("=")])))
    assert code == 0
    found = [path for path in Path("/proc").glob("[0-9]*") if mark.encode() in environment_of(path)]
    assert len(found) == 1
    os.kill(int(found[0].name), number)
    assert fleet.idle("dut/board")


def environment_of(process: Path) -> list[bytes]:
    try:
        return (process / "environ").read_bytes().split(b"\0")
    except OSError:
        return []

"""The programs in examples/, as a reader would run them."""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.cli import tools
from tests.cli.cli_fleet import CliFleet, fleet_of
from zscout.config.fleet import load_fleet
from zscout.config.node import load_node

pytestmark = pytest.mark.essential
EXAMPLES = Path(__file__).parents[2] / "examples"


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory, fleet_kind: str) -> Iterator[CliFleet]:
    with fleet_of(tmp_path_factory.mktemp("fleet"), "robot/scout33", "radio/rf0:command_rate=10") as fleet:
        yield fleet


@pytest.mark.live
@pytest.mark.parametrize(
    ("program", "words"),
    [
        ("hold_blocking.py", ["holding radio/rf0 robot/scout33", "hello"]),
        ("hold_async.py", ["0\n1\n2"]),
        ("book.py", ["booked from", "hello"]),
    ],
)
def test_a_program_holds_and_commands(fleet: CliFleet, program: str, words: list[str]) -> None:
    done = tools.program_until_in_time(sys.executable, str(EXAMPLES / program), env=fleet.lab.env)
    assert done.returncode == 0, done.stderr
    for word in words:
        assert word in done.stdout
    assert fleet.idle("robot/scout33", "radio/rf0")


@pytest.mark.live
def test_the_component_is_started_by_its_entry_point_and_holds(tmp_path: Path) -> None:
    project = tomllib.loads((EXAMPLES / "survey" / "pyproject.toml").read_text())["project"]
    (kind, where), *_ = project["entry-points"]["zscout.components"].items()
    info = tmp_path / "site" / "survey-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: survey\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[zscout.components]\n{kind} = {where}\n")
    path = f"{tmp_path / 'site'}:{EXAMPLES / 'survey'}"
    with fleet_of(tmp_path, "robot/scout33", env={"PYTHONPATH": path}) as fleet:
        started = fleet.zscout("start", kind)
        assert started.returncode == 0, started.stderr
        fleet.state(lambda state: any("robot/scout33" in hold.needs for hold in state.holds))
        assert fleet.zscout("stop", kind).returncode == 0
        assert fleet.idle("robot/scout33")


def test_the_files_are_read() -> None:
    assert [rc.name for rc in load_node(EXAMPLES / "node.toml").rcs] == ["robot/scout33", "radio/rf0"]
    assert load_fleet(EXAMPLES / "fleet.toml").candidates == ("anvil", "bellows")


def test_the_workload_replays_as_it_says(capsys: pytest.CaptureFixture[str]) -> None:
    assert tools.zscout_here("replay", EXAMPLES / "workload.toml", "--json") == 0
    assert '"outcome": "preempted"' in capsys.readouterr().out

"""`zscout replay`: the paper's Table 1 becomes its Table 2, and whatever else a workload may be."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

import zscout as package
from tests.cli.tools import Terminal, zscout, zscout_here
from tests.services.recorder.paper_run import RCS, TABLE2, events, lanes, second_by_second

HOLDS = (
    ("arc0", 0, 5, "completed", "fgrab1 scout33"), ("arc1", 5, 10, "completed", "fgrab1 scout35"),
    ("arc3", 5, 8, "completed", "fgrab2 scout33"), ("arc2", 8, 11, "preempted", "fgrab2 scout33"),
    ("arc4", 11, 14, "completed", "fgrab1 scout33 scout35"), ("arc2", 14, 18, "completed", "fgrab2 scout33"),
)  # fmt: skip
LINES = ", ".join(
    f'{{"arc": "{arc}", "start": {start}.0, "end": {end}.0, "outcome": "{outcome}", "rcs": ['
    + ", ".join(f'"{"robot" if name.startswith("scout") else "framegrabber"}/{name}"' for name in names.split())
    + "]}"
    for arc, start, end, outcome, names in HOLDS
)
JSON = f'{{"strategy": "priority", "holds": [{LINES}], "unserved": []}}\n'

SHARED = """
[[rc]]
name = "radio/rf0"
sharable = true
capacity = { rate = 0.3 }
[[rc]]
name = "robot/a"
[[arc]]
name = "survey"
at = 0.5
priority = 1
min_runtime = 5.25
[arc.needs]
"radio/rf0" = { rate = 0.15 }
"robot/a" = {}
[[arc]]
name = "mapping"
at = 1
priority = 2
min_runtime = 3
[arc.needs]
"radio/rf0" = { rate = 0.1 }
[[arc]]
name = "operator"
at = 2.75
priority = 10
min_runtime = 3
[arc.needs]
"radio/rf0" = { rate = 0.2 }
[[arc]]
name = "ghost"
at = 3
priority = 10
min_runtime = 3
[arc.needs]
"radio/none" = {}
"""


@pytest.fixture
def table1() -> Path:
    """As it is shipped."""
    (file,) = Path(package.__file__).parent.rglob("table1.toml")
    return file


def cells(text: str) -> list[list[str]]:
    """The table in an output: its rows, each with its label first."""
    rows = [line.split() for line in text.splitlines()]
    return [row for row in rows if row and ("/" in row[0] or row[0] == "seconds")]


@pytest.mark.live
def test_table_1_gives_table_2_as_json_to_the_byte(table1: Path) -> None:
    for seed in ("0", "1"):
        shown = zscout("replay", table1, "--json", env=os.environ | {"PYTHONHASHSEED": seed})
        assert (shown.returncode, shown.stderr) == (0, "")
        assert shown.stdout == JSON


def test_table_1_gives_table_2_as_a_table(table1: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert zscout_here("replay", table1) == 0
    shown = capsys.readouterr().out
    head, *rows = cells(shown)
    assert head == ["seconds", *map(str, range(18))]
    assert [(row[0], " ".join(row[1:])) for row in rows] == list(TABLE2.items())
    assert "arc2 at 11 s by arc4, after 3 of 4 s; ran again from 14 s" in shown
    assert "0 requests unserved" in shown
    assert "\x1b" not in shown


@pytest.mark.live
def test_at_a_narrow_terminal_the_table_is_wrapped_and_coloured(table1: Path) -> None:
    with Terminal("replay", table1, columns=50) as terminal:
        assert terminal.code() == 0
    table = [line for line in terminal.text.splitlines() if line.startswith(("seconds", *RCS))]
    assert max(map(len, table)) <= 50
    shown = cells("\n".join(table))
    assert len(shown) == 2 * (1 + len(RCS))
    halves = dict[str, list[str]]()
    for label, *row in shown:
        halves.setdefault(label, []).extend(row)
    assert halves.pop("seconds") == list(map(str, range(18)))
    assert {rc: " ".join(row) for rc, row in halves.items()} == TABLE2
    assert "\x1b[" in terminal.raw


def test_sharable_rcs_have_a_row_for_each_holder_and_times_that_are_not_whole_a_column_each(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "shared.toml"
    file.write_text(SHARED)
    assert zscout_here("replay", file) == 0
    shown = capsys.readouterr().out
    assert cells(shown) == [
        ["seconds", "0.5", "1", "2.75", "4", "5.75"],
        ["radio/rf0", "survey", "survey", "operator", "operator", "survey"],
        ["radio/rf0", "-", "mapping", "mapping", "-", "-"],
        ["robot/a", "survey", "survey", "-", "-", "survey"],
    ]
    assert "the last to 11 s" in shown
    assert "ghost: radio/none not on the mesh" in shown
    assert zscout_here("replay", file, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["unserved"] == ["ghost"]
    assert [(hold["arc"], hold["start"], hold["end"], hold["outcome"]) for hold in told["holds"]] == [
        ("survey", 0.5, 2.75, "preempted"),
        ("mapping", 1.0, 4.0, "completed"),
        ("operator", 2.75, 5.75, "completed"),
        ("survey", 5.75, 11.0, "completed"),
    ]


def test_a_long_schedule_has_a_column_for_each_interval(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arc = '[[arc]]\nname = "{name}"\nat = {at}\npriority = 1\nmin_runtime = 3600\nneeds = {{"robot/a" = {{}}}}\n'
    file = tmp_path / "long.toml"
    file.write_text('[[rc]]\nname = "robot/a"\n' + arc.format(name="x1", at=0) + arc.format(name="y2", at=7200))
    assert zscout_here("replay", file) == 0
    assert cells(capsys.readouterr().out) == [["seconds", "0", "3600", "7200"], ["robot/a", "x1", "-", "y2"]]


def test_a_schedule_without_end_is_cut_in_the_table_only(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arc = '[[arc]]\nname = "a{n}"\nat = {n}\npriority = 1\nmin_runtime = 0.5\n[arc.needs]\n"robot/a" = {{}}\n'
    file = tmp_path / "many.toml"
    file.write_text('[[rc]]\nname = "robot/a"\n' + "".join(arc.format(n=n) for n in range(600)))
    assert zscout_here("replay", file) == 0
    shown = capsys.readouterr().out
    assert [len(row) for row in cells(shown)] == [501, 501]
    assert "699 more columns are left out" in shown
    assert zscout_here("replay", file, "--json") == 0
    assert len(json.loads(capsys.readouterr().out)["holds"]) == 600


def test_nothing_at_all_is_said_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "empty.toml"
    file.write_text("")
    assert zscout_here("replay", file) == 0
    summary = "Strategy priority: 0 requests on 0 devices; 0 holds, 0 preempted, over 0 s; 0 requests unserved\n"
    assert capsys.readouterr().out == summary
    assert zscout_here("replay", file, "--json") == 0
    assert capsys.readouterr().out == '{"strategy": "priority", "holds": [], "unserved": []}\n'


@pytest.mark.parametrize("strategy", ["optimal", "adaptive"])
def test_the_other_strategies_serve_table_1_as_the_paper_does(
    table1: Path, strategy: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert zscout_here("replay", table1, "--strategy", strategy, "--json") == 0
    assert capsys.readouterr().out == JSON.replace('"priority"', f'"{strategy}"', 1)


@pytest.mark.slow
def test_a_recording_shows_table_2(table1: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = tmp_path / "run.rrd"
    assert zscout_here("replay", table1, "--rrd", recording) == 0
    assert f"zscout view {recording}" in capsys.readouterr().out
    held = lanes(recording, "/devices/**")
    assert {rc: second_by_second(held[f"/devices/{rc}"]) for rc in RCS} == TABLE2
    story = [(at, states[0].split(" · ")[0]) for at, states in lanes(recording, "/requests/**")["/requests/arc2"]]
    kept = [change for index, change in enumerate(story) if index == 0 or change[1] != story[index - 1][1]]
    assert kept == [(1, "waiting"), (8, "running"), (11, "preempted"), (14, "running"), (18, "done")]
    assert any(text.startswith("arc2: preempted by arc4") for text in events(recording))

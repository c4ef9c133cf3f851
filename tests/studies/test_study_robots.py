"""`python -m studies robots`: figures for people and programs, plots, and an end at any time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from rerun.chunk import RrdReader

from studies.robots.study import Quantiles, RobotsReport, StartFigures
from studies.robots.tables import print_report
from tests.studies.tools import study_here

LITTLE = ("robots", "--seconds", "1", "--seeds", "3-3", "--building", "living_room", "--jobs", "1")


@pytest.mark.slow
def test_json_has_the_figures_and_every_run_and_the_plots_are_written(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "robots.rrd"
    some = ("--robots", "1-2", "--channels", "1", "--baud", "300", "--framegrabbers", "1", "--json", "--record", path)
    assert study_here(*LITTLE, *some, "--svg", tmp_path) == 0
    told: dict[str, Any] = json.loads(capsys.readouterr().out)
    assert [(one["robots"], one["channels"], one["runs"]) for one in told["grid"]] == [(1, 1, 1), (2, 1, 1)]
    assert [(one["baud"], one["command_rate"]) for one in told["radio"]] == [(300, 5.0), (300, 2.5)]
    assert told["starts"] == []
    assert [(one["framegrabbers"], one["channels"]) for one in told["receivers"]] == [(1, 4)]
    assert len(told["runs"]) == 5
    assert told["runs"][0]["job"]["seed"] == 3
    # Nobody is placed in a second, and infinity is no JSON.
    assert told["grid"][0]["all_placed"] == {"low": None, "median": None, "high": None}
    assert told["grid"][1]["placed"] == 0
    written = sorted(tmp_path.glob("*.svg"))
    assert [one.name for one in written] == ["robots-noticed.svg", "robots-placed.svg", "robots-radio.svg"]
    for picture in written:
        ElementTree.fromstring(picture.read_text())  # noqa: S314 - our own
    entities = {chunk.entity_path for chunk in RrdReader(path).stream()}
    bars = {"/radio/placed/300_baud_2_5_per_second", "/receivers/placed/1_framegrabbers"}
    assert {"/summary", "/grid/placed/1"} | bars <= entities


@pytest.mark.slow
def test_json_tells_what_became_of_crossings(capsys: pytest.CaptureFixture[str]) -> None:
    some = ("--robots", "1", "--channels", "1", "--seconds", "100", "--json")
    assert study_here(*LITTLE, *some) == 0
    told: dict[str, Any] = json.loads(capsys.readouterr().out)
    (account,) = told["runs"][0]["outcomes"]["account"].values()
    assert sum(account["fates"].values()) > 0


@pytest.mark.slow
def test_a_pipe_gets_plain_tables(capsys: pytest.CaptureFixture[str]) -> None:
    assert study_here(*LITTLE, "--baud", "300", "--slot", "45") == 0
    shown = capsys.readouterr()
    assert shown.err == ""
    assert "\x1b" not in shown.out
    assert "The radio, 4 robots, 4 channels: 1 s, 1 seed in each of living_room\n" in shown.out
    assert "\n300   2.5         never (never-never)   0%" in shown.out
    assert "\n\nTurns, 4 robots, 1 channel: 1 s, 1 seed in each of living_room\nslot  all" in shown.out
    assert "\n45    never (never-never)   0%" in shown.out
    assert "Robots and video channels" not in shown.out


def test_starts_are_shown_with_their_shares(capsys: pytest.CaptureFixture[str]) -> None:
    starts = StartFigures("office", 40, 38, 37, Quantiles(20.2, 41.0, 77.7), 0.25)
    print_report(RobotsReport([], [], [], [], [starts]), ["office"], 40, 120)
    shown = capsys.readouterr().out
    assert "office    40      38 (95%)    37 (92%)              41 s (20-78)       0.2 s\n" in shown


def test_starts_in_a_building_without_a_robot_are_one_line_and_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    empty = tmp_path / "empty.toml"
    empty.write_text('name = "empty"\nwidth = 4\ndepth = 4\n[[light]]\nname = "lamp"\nx = 2\ny = 2\n')
    assert study_here("robots", "--starts", "1", "--jobs", "1", "--building", empty) == 2
    line = f"studies: --building {empty}: it has no robot to start; add a [[robot]]\n"
    assert capsys.readouterr() == ("", line)

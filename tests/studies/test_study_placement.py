"""`python -m studies placement`: the figures, the same every time, for people, programs and the viewer."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from rerun.chunk import RrdReader

from studies.placement.study import BATCHES, SCENARIOS, parts
from tests.cli.tools import Terminal
from tests.studies.tools import STUDIES, study_here
from zscout.types import POLICIES


@pytest.mark.slow
def test_json_has_every_policy_and_metric(capsys: pytest.CaptureFixture[str]) -> None:
    assert study_here("placement", "--seeds", "3-3", "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert told["seeds"] == 1
    assert [(one["scenario"], one["policy"]) for one in told["spreads"]] == [
        (scenario, policy) for scenario in SCENARIOS for policy in POLICIES
    ]
    assert [(one["metric"], one["policy"]) for one in told["batches"]] == list(BATCHES)
    by_policy = {one["policy"]: one for one in told["spreads"] if one["scenario"] == "simultaneous"}
    assert by_policy["least_loaded"]["splits"] == {"12-0-0": 1}
    assert by_policy["pending"]["splits"] == {"4-4-4": 1}
    assert len(told["learnt"]) == 3


@pytest.mark.slow
def test_a_pipe_gets_plain_tables_and_the_recording_has_the_curves_and_marks(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "placement.rrd"
    assert study_here("placement", "--seeds", "1", "--rrd", path) == 0
    shown = capsys.readouterr()
    assert shown.err == ""
    assert "\x1b" not in shown.out
    assert "\nleast_loaded  0 of 1          0 of 1" in shown.out
    assert "(b) one net a minute" in shown.out
    assert f"zscout view {path}" in shown.out
    entities = {chunk.entity_path for chunk in RrdReader(path).stream()}
    for scenario in SCENARIOS:
        for policy in POLICIES:
            for host in range(1, 4):
                assert f"/{scenario}/{policy}/load/workstation{host}" in entities
        assert f"/{scenario}/pending/placed/workstation3" in entities
    assert "/simultaneous/least_loaded/placed/workstation3" not in entities
    assert "/summary" in entities


@pytest.mark.live
def test_at_a_terminal_a_bar_shows_how_far_it_is_and_ctrl_c_ends_it() -> None:
    with Terminal("placement", "--seeds", "500", command=STUDIES) as terminal:
        terminal.until(f"/{500 * parts()}")
        terminal.press("\x03")
        assert terminal.code() == 130
        assert "Traceback" not in terminal.text

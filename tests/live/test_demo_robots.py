"""`zscout demo robots` as people run it: robots hide, an operator takes one, and nothing is left behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from tests.hang import HANG
from tests.services.recorder.paper_run import lanes
from zscout.simulation.building.plan_file import shipped_plans

pytestmark = pytest.mark.live

LONGEST = 45.0
"""Seconds of recording after which the demo is ended from outside: this machine is busy with other work."""
ENDING = HANG
EMPTY = """\
name = "den"
width = 3.0
depth = 3.0
[[light]]
name = "lamp"
x = 1.5
y = 1.5
"""
ROBOTS = ["robot/rat", "robot/scout35"]


def building(folder: Path) -> None:
    """The living room with two of its robots, one of another name: sooner done than with four."""
    text = shipped_plans()["living_room"].read_text()
    two = "[[robot]]".join(text.split("[[robot]]")[:3])
    (folder / "den.toml").write_text(two.replace('"scout33"', '"rat"'))


def start(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    (folder / "tmp").mkdir()
    return subprocess.Popen(
        [sys.executable, "-m", "zscout.cli.main", "demo", "robots", *arguments],
        cwd=folder,
        env=os.environ | {"TMPDIR": str(folder / "tmp")},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def left_of(folder: Path) -> list[psutil.Process]:
    """Processes that belong to the demo whose temporary files lie in `folder`."""
    found = []
    for process in psutil.process_iter():
        try:
            if process.environ().get("TMPDIR") == str(folder / "tmp"):
                found.append(process)
        except (psutil.NoSuchProcess, psutil.AccessDenied, psutil.ZombieProcess):
            continue
    return found


@pytest.mark.slow
def test_robots_hide_on_a_live_mesh_and_nothing_is_left(tmp_path: Path) -> None:
    building(tmp_path)
    demo = start(tmp_path, "--json", "--building", "den.toml", "--speed", "3", "--out", "mine/demo.rrd")
    recording = tmp_path / "mine" / "demo.rrd"
    ended = True
    begun = time.monotonic()
    while demo.poll() is None and not list(tmp_path.rglob("*.rrd")) and time.monotonic() - begun < HANG:
        time.sleep(0.1)  # until it records: ended before that it leaves nothing to look at
    try:
        out, error = demo.communicate(timeout=LONGEST)
    except subprocess.TimeoutExpired:
        ended = False
        demo.send_signal(signal.SIGINT)
        out, error = demo.communicate(timeout=ENDING)
    finally:
        demo.kill()

    _, alive = psutil.wait_procs(left_of(tmp_path), timeout=ENDING)
    assert not alive
    assert list((tmp_path / "tmp").iterdir()) == []
    assert list(tmp_path.rglob("*.rrd")) == [recording]
    # What is recorded is readable to its last word, however the demo ended.
    shown = lanes(recording, "/devices/**")
    assert set(ROBOTS) <= {name.removeprefix("/devices/") for name in shown}

    if not (ended or out):
        assert (demo.returncode, out) == (128 + signal.SIGINT, "")
        assert error == "the recording until then: mine/demo.rrd\n"
        return
    told = json.loads(out)
    assert told["recording"] == "mine/demo.rrd"
    assert told["robots"] == len(ROBOTS)
    assert set(told["hidden"]) | set(told["truly_dark"]) <= set(ROBOTS)
    if ended:  # else it had told all when the signal came
        assert (demo.returncode, error) == (0 if told["placed_after"] is not None else 1, "")
    assert told["grants"] >= 2
    assert told["waits"] >= 1, "whose robot is taken over waits"
    assert 0 < told["median_wait"] <= told["longest_wait"] < told["seconds"]
    assert told["simulated"] <= 3 * told["seconds"]
    assert told["taken"] in ROBOTS
    operator = f"operator-{told['taken'].partition('/')[2]}"
    assert any(text.startswith(operator) for _, texts in shown[f"/devices/{told['taken']}"] for text in texts)
    if told["placed_after"] is not None:
        # The building knows better than a robot's camera: that may err, but not of both.
        assert told["truly_dark"]
        assert told["resumed_after"] is not None


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (None, 'unknown building "den"; name one of living_room, office, random:SEED, or a file'),
        ("width = 3.0\n", "den.toml: name: is missing; add it"),
        (EMPTY, "--building den.toml: there is no robot in it; add a [[robot]]"),
    ],
)
def test_a_building_that_is_no_good_is_one_line_before_anything_is_started(
    tmp_path: Path, text: str | None, words: str
) -> None:
    if text is not None:
        (tmp_path / "den.toml").write_text(text)
    demo = start(tmp_path, "--building", "den" if text is None else "den.toml")
    out, error = demo.communicate(timeout=ENDING)
    assert (demo.returncode, out, error) == (2, "", f"zscout: {words}\n")
    assert not (tmp_path / "runs").exists()

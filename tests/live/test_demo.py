"""`zscout demo table1` as people run it: Table 1 gives Table 2 on a live mesh, and nothing is left behind."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import IO

import psutil
import pytest

from tests.hang import HANG
from tests.services.recorder.paper_run import RCS, TABLE2, colours, events, lanes, rows
from zscout.lab.demo.tables import Observed, differences, paper
from zscout.services.recorder.timeline import OPERATOR_MARK
from zscout.types import SECOND

pytestmark = pytest.mark.live


def start(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    (folder / "tmp").mkdir(exist_ok=True)
    return subprocess.Popen(
        [sys.executable, "-m", "zscout.cli.main", "demo", "table1", *arguments],
        cwd=folder,
        env=os.environ | {"TMPDIR": str(folder / "tmp")},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def read_until(stream: IO[str] | None, words: str) -> None:
    assert stream is not None
    seen = []
    for line in stream:
        seen.append(line)
        if words in line:
            return
    raise AssertionError(f"{words!r} was not said: {seen}")


def children(process: subprocess.Popen[str]) -> list[psutil.Process]:
    return psutil.Process(process.pid).children(recursive=True)


def gone(processes: list[psutil.Process]) -> bool:
    _, alive = psutil.wait_procs(processes, timeout=HANG)
    return not alive


def test_table_1_live_gives_table_2(tmp_path: Path) -> None:
    demo = start(tmp_path, "--json")
    out, error = demo.communicate(timeout=HANG)
    assert demo.returncode == 0, out + error
    result = json.loads(out)
    expected = {rc: row.split() for rc, row in TABLE2.items()}
    assert result["paper"] == result["published"] == result["bodies"] == expected
    assert result["differences"] == []
    assert set(result["loads"]) == {"anvil", "bellows", "crucible"}
    assert all(load["number"] >= 10 for load in result["loads"].values())
    assert list((tmp_path / "tmp").iterdir()) == []

    path = tmp_path / result["recording"]
    assert list(tmp_path.rglob("*.rrd")) == [path]
    assert path.parent == tmp_path / "runs"
    shown = lanes(path, "/rc/**")
    zero = shown["/rc/robot/scout33"][1][0]
    for rc in RCS:
        cells = []
        for second in range(18):
            (state,) = [states for at, states in shown[f"/rc/{rc}"] if at <= zero + second + 0.5][-1]
            cells.append(state.removesuffix(OPERATOR_MARK).removeprefix("arc") or "-")
        assert " ".join(cells) == TABLE2[rc]
    used = {text: colour for lane in colours(path, "/rc/**").values() for text, colour in lane.items()}
    assert set(used) == {"arc0", "arc1", "arc2", "arc3", "arc4" + OPERATOR_MARK}
    assert len(set(used.values())) == 5
    doing = [text.split(" · ")[0] for _, (text,) in lanes(path, "/arc/**")["/arc/arc2"]]
    assert doing[-4:] == ["running", "preempted", "running", "done"]
    assert set(doing[:-4]) == {"waiting"}
    assert {entity for entity, _, _ in rows(path, "/load/**", "Scalars:scalars")} == {
        "/load/anvil",
        "/load/bellows",
        "/load/crucible",
    }
    assert "arc2 is preempted by arc4, priority 10, and waits again" in events(path)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP, signal.SIGKILL])
def test_nothing_runs_on_when_it_is_stopped(tmp_path: Path, number: signal.Signals) -> None:
    demo = start(tmp_path, "--out", "mine/demo.rrd")
    read_until(demo.stdout, "arc0 runs on")
    others = children(demo)
    assert len(others) == 3 + 1 + 5
    demo.send_signal(number)
    _, error = demo.communicate(timeout=HANG)
    assert gone(others)
    if number == signal.SIGKILL:
        assert demo.returncode == -signal.SIGKILL
        return
    assert demo.returncode == 128 + number
    assert error == "the recording until then: mine/demo.rrd\n"
    assert lanes(tmp_path / "mine" / "demo.rrd", "/rc/**")["/rc/robot/scout33"][1][1] == ["arc0"]
    assert list((tmp_path / "tmp").iterdir()) == []


def test_a_node_that_dies_ends_it_with_one_line(tmp_path: Path) -> None:
    demo = start(tmp_path)
    read_until(demo.stdout, "arc0 runs on")
    others = children(demo)
    (bellows,) = (other for other in others if any("bellows.toml" in part for part in other.cmdline()))
    bellows.kill()
    _, error = demo.communicate(timeout=HANG)
    assert demo.returncode == 1
    assert gone(others)
    *_, line = error.strip().splitlines()
    assert line.startswith("zscout: node bellows ended with code -9")


def test_a_place_that_cannot_be_written_is_one_line_at_once(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    demo = start(tmp_path, "--out", "file/demo.rrd")
    _, error = demo.communicate(timeout=HANG)
    assert (demo.returncode, error) == (
        2,
        "zscout: --out file/demo.rrd: can't be written (its folder is a file); give another file\n",
    )


def happened() -> Observed:
    """The paper's example as it should be seen, 30 ms late throughout."""
    expected, seen = paper(), Observed(zero=1000 * SECOND)
    assert seen.zero is not None
    late = SECOND * 3 // 100
    for rc, row in expected.table.items():
        for second, cell in enumerate(row):
            arcs = [] if cell == "-" else [f"arc{cell}"]
            seen.published(rc, arcs, seen.zero + second * SECOND + late)
            for arc in arcs:
                seen.entered(arc, [rc], seen.zero + second * SECOND + late)
                seen.bodies[-1].end = seen.zero + (second + 1) * SECOND + late
    return seen


Spoil = Callable[[Observed], None]


def lose_a_body(seen: Observed) -> None:
    seen.bodies = [body for body in seen.bodies if body.arc != "arc4"]


def enter_twice(seen: Observed) -> None:
    assert seen.zero is not None
    seen.entered("arc1", ["robot/scout33"], seen.zero + 12 * SECOND)
    seen.left("arc1", seen.zero + 13 * SECOND)


def publish_late(seen: Observed) -> None:
    at, _ = seen.changes["robot/scout35"][5]
    seen.changes["robot/scout35"][5] = (at + SECOND // 2, ("arc1",))


@pytest.mark.parametrize(
    ("spoil", "wrong"),
    [
        (lambda _: None, set()),
        (lose_a_body, {(rc, s) for rc in RCS for s in (11, 12, 13) if rc != "framegrabber/fgrab2"}),
        (enter_twice, {("robot/scout33", 12)}),
        (publish_late, {("robot/scout35", 5)}),
    ],
)
def test_every_cell_that_differs_is_named(spoil: Spoil, wrong: set[tuple[str, int]]) -> None:
    seen, table = happened(), paper().table
    spoil(seen)
    now = 1018 * SECOND
    found = differences(table, seen.by_rcm(list(table), 18, now), seen.by_bodies(list(table), 18, now))
    assert {(item.rc, item.second) for item in found} == wrong


def test_the_shipped_tables_are_the_paper_s() -> None:
    assert {rc: " ".join(row) for rc, row in paper().table.items()} == TABLE2
    asked = [(arrival.request.arc, arrival.at) for arrival in paper().workload.arrivals]
    assert asked == [("arc0", 0), ("arc1", 0), ("arc2", SECOND), ("arc3", 2 * SECOND), ("arc4", 11 * SECOND)]

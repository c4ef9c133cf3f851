"""`zscout demo table1` as people run it: Table 1 gives Table 2 on a live mesh, and nothing is left behind."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import urllib.request
from collections.abc import Callable, Sequence
from itertools import groupby
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import psutil
import pytest

from tests.hang import HANG
from tests.services.recorder.paper_run import PERSON, RCS, TABLE2, USER, colours, events, lanes, rows
from zscout.services.recorder.timeline import OPERATOR_MARK
from zscout.simulation.demo.tables import ArcBody, Observed, differences, paper
from zscout.types import SECOND, Ns

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


def read_until(demo: subprocess.Popen[str], words: str) -> None:
    assert demo.stdout is not None
    seen = []
    for line in demo.stdout:
        seen.append(line)
        if words in line:
            return
    _, error = demo.communicate(timeout=HANG)
    raise AssertionError(f"{words!r} was not said: {seen}; it ended with {demo.returncode}: {error}")


def children(process: subprocess.Popen[str]) -> list[psutil.Process]:
    return psutil.Process(process.pid).children(recursive=True)


def turns(cells: list[str], *, free: str) -> list[str]:
    """Who held it, one after the other."""
    return [cell for cell, _ in groupby(cells) if cell != free]


def gone(processes: list[psutil.Process]) -> bool:
    _, alive = psutil.wait_procs(processes, timeout=HANG)
    return not alive


@pytest.mark.slow
def test_table_1_live_gives_table_2(tmp_path: Path) -> None:
    demo = start(tmp_path, "--json")
    out, error = demo.communicate(timeout=HANG)
    assert demo.returncode == 0, out + error
    result = json.loads(out)
    # Cells are who held what in the middle of each second: on a busy machine some are late. Exit code 0 says that
    # all came in the paper's order.
    assert result["paper"] == {rc: row.split() for rc, row in TABLE2.items()}
    assert result["published"].keys() == result["bodies"].keys() == TABLE2.keys()
    assert set(result["loads"]) == {"anvil", "bellows", "crucible"}
    assert all(load["number"] >= 10 for load in result["loads"].values())
    assert list((tmp_path / "tmp").iterdir()) == []

    path = tmp_path / result["recording"]
    assert list(tmp_path.rglob("*.rrd")) == [path]
    assert path.parent == tmp_path / "runs"
    shown = lanes(path, "/devices/**")
    for rc in RCS:
        holders = [
            state.removesuffix(OPERATOR_MARK).removesuffix(PERSON).removeprefix("arc")
            for _, (state,) in shown[f"/devices/{rc}"]
        ]
        assert turns(holders, free="") == turns(TABLE2[rc].split(), free="-")
    used = {text: colour for lane in colours(path, "/devices/**").values() for text, colour in lane.items()}
    assert set(used) == {*(f"arc{number}{PERSON}" for number in range(4)), f"arc4{PERSON}{OPERATOR_MARK}"}
    assert len(set(used.values())) == 5
    words = (text.split(" · ")[0] for _, (text,) in lanes(path, "/requests/**")[f"/requests/{USER}/arc2"])
    doing = [word for word, _ in groupby(words)]  # its reason to wait may change meanwhile
    assert doing[-4:] == ["running", "waiting again", "running", "done"]
    assert set(doing[:-4]) == {"waiting"}
    assert {entity for entity, _, _ in rows(path, "/load/**", "Scalars:scalars")} == {
        "/load/anvil",
        "/load/bellows",
        "/load/crucible",
    }
    told = re.compile(r"arc2 \(\w+\) is preempted by arc4 \(\w+\), priority 10, and waits again")
    assert any(map(told.fullmatch, events(path)))


@pytest.mark.slow
def test_it_is_shown_live_from_its_first_second_and_finished_on_the_same_page(tmp_path: Path) -> None:
    demo = start(tmp_path, "--web")
    assert demo.stdout is not None
    assert demo.stderr is not None
    lines: list[str] = []
    for line in demo.stdout:
        lines.append(line)
        if line.startswith("Live: open "):
            break
    # Nothing has happened yet.
    assert not any(" s  " in line for line in lines)
    address = lines[-1].removeprefix("Live: open ").strip()
    query = parse_qs(urlsplit(address).query)
    assert query["theme"] == ["dark"]
    (stream,) = (urlsplit(url) for url in query["url"])
    with urllib.request.urlopen(address, timeout=HANG) as answer:  # noqa: S310 - our own page
        assert b"Rerun" in answer.read()
    socket.create_connection((stream.hostname or "", stream.port or 0), timeout=HANG).close()
    read_until(demo, "Look at it:")
    assert address in demo.stderr.readline()
    # What was live is served from the file now, and nothing else of the demo is left.
    socket.create_connection((stream.hostname or "", stream.port or 0), timeout=HANG).close()
    others = children(demo)
    assert [other.name() for other in others] == ["rerun"]
    demo.send_signal(signal.SIGINT)
    demo.communicate(timeout=HANG)
    assert demo.returncode == 130
    assert gone(others)


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP, signal.SIGKILL])
def test_nothing_runs_on_when_it_is_stopped(tmp_path: Path, number: signal.Signals) -> None:
    demo = start(tmp_path, "--out", "mine/demo.rrd")
    read_until(demo, "arc0 runs on")
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
    # A recorder that came late has seen it free more than once.
    assert [f"arc0{PERSON}"] in [
        held for _, held in lanes(tmp_path / "mine" / "demo.rrd", "/devices/**")["/devices/robot/scout33"]
    ]
    assert list((tmp_path / "tmp").iterdir()) == []


@pytest.mark.slow
def test_a_node_that_dies_ends_it_with_one_line(tmp_path: Path) -> None:
    demo = start(tmp_path)
    read_until(demo, "arc0 runs on")
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


LATE = SECOND * 3 // 100


def happened() -> Observed:
    """The paper's example as it should be seen, 30 ms late throughout."""
    expected, seen = paper(), Observed(zero=1000 * SECOND)
    assert seen.zero is not None
    for rc, row in expected.table.items():
        second = 0
        for cell, cells in groupby(row):
            arcs = [] if cell == "-" else [f"arc{cell}"]
            seen.published(rc, arcs, at(second))
            begin, second = second, second + len(list(cells))
            seen.bodies += [ArcBody(arc, (rc,), at(begin), at(second)) for arc in arcs]
    return seen


def at(second: int) -> Ns:
    return (1000 + second) * SECOND + LATE


Spoil = Callable[[Observed], None]


def lose_a_body(seen: Observed) -> None:
    seen.bodies = [body for body in seen.bodies if body.arc != "arc4"]


def enter_twice(seen: Observed) -> None:
    seen.entered("arc1", ["robot/scout33"], at(12))
    seen.left("arc1", at(13))


def move(seen: Observed, rcs: Sequence[str], by: Ns) -> None:
    """What was published of second 5."""
    for rc in rcs:
        seen.changes[rc] = [(since + by if since == at(5) else since, arcs) for since, arcs in seen.changes[rc]]


def enter_late(seen: Observed) -> None:
    for body in seen.bodies:
        body.begin += SECOND // 2 if body.arc == "arc4" else 0


def hold_before(seen: Observed) -> None:
    seen.published("framegrabber/fgrab2", ["arc3"], at(0))
    seen.changes["framegrabber/fgrab2"].sort()


@pytest.mark.parametrize(
    ("spoil", "wrong", "same_order"),
    [
        (lambda _: None, set(), True),
        (lose_a_body, {(rc, s) for rc in RCS for s in (11, 12, 13) if rc != "framegrabber/fgrab2"}, False),
        (enter_twice, {("robot/scout33", 12)}, False),
        (lambda seen: move(seen, RCS, SECOND // 2), {(rc, 5) for rc in RCS}, True),
        (enter_late, {(rc, 11) for rc in RCS if rc != "framegrabber/fgrab2"}, True),
        # For an instant the next holder has one of its two RCs.
        (lambda seen: move(seen, ["robot/scout33"], 1), set(), False),
        (hold_before, {("framegrabber/fgrab2", s) for s in range(5)}, False),
    ],
)
def test_every_cell_that_differs_is_named_and_what_is_only_late_is_told_apart(
    spoil: Spoil, wrong: set[tuple[str, int]], same_order: bool
) -> None:
    seen, table = happened(), paper().table
    spoil(seen)
    now = 1018 * SECOND
    found = differences(table, seen.by_rcm(list(table), 18, now), seen.by_bodies(list(table), 18, now))
    assert {(item.rc, item.second) for item in found} == wrong
    assert seen.same_order(table) == same_order


def test_the_shipped_tables_are_the_paper_s() -> None:
    assert {rc: " ".join(row) for rc, row in paper().table.items()} == TABLE2
    asked = [(arrival.request.arc, arrival.at) for arrival in paper().workload.arrivals]
    assert asked == [("arc0", 0), ("arc1", 0), ("arc2", SECOND), ("arc3", 2 * SECOND), ("arc4", 11 * SECOND)]

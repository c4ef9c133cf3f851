"""`python -m studies`: the same answer every time, on all processors, and nothing left behind."""

from __future__ import annotations

import json
import os
import random
import re
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import import_module
from pathlib import Path

import psutil
import pytest
from rerun.chunk import RrdReader

from studies.__main__ import STUDIES as STUDY_TABLE
from studies.options import MAX_SEED, parse_seeds
from studies.recording import VIRTUAL_TIME
from studies.scheduling.families import FAMILIES
from studies.scheduling.trial import STRATEGIES
from tests.cli.tools import Terminal
from tests.hang import HANG
from tests.studies.tools import STUDIES, study, study_here
from tests.thorough import times
from zscout.cli.common import Failed
from zscout.config.strict import BadInput

LONG = ("schedule", "--family", "load65", "--seeds", "200", "--jobs", "2")
"""More work than any test waits for."""


def timeless(text: str) -> str:
    return re.sub(r'"decision_us":\{[^}]*\}', "", text)


@pytest.mark.live
@pytest.mark.slow
def test_the_same_seeds_give_the_same_bytes_on_any_number_of_processors() -> None:
    some = ("--family", "paper", "--family", "calm", "--seeds", "1-2", "--json")
    spread, alone = study("schedule", *some), study("schedule", *some, "--jobs", "1")
    assert (spread.returncode, spread.stderr) == (0, "")
    assert timeless(spread.stdout) == timeless(alone.stdout)
    assert timeless(spread.stdout) != spread.stdout
    told = json.loads(spread.stdout)
    assert told["seeds"] == [1, 2]
    assert [family["family"] for family in told["families"]] == ["paper", "calm"]
    for family in told["families"]:
        assert [one["strategy"] for one in family["strategies"]] == list(STRATEGIES)
        assert 0 < family["degenerate"]["behind"] < family["degenerate"]["situations"]
        assert all(one["decision_us"]["p99"] >= one["decision_us"]["median"] > 0 for one in family["strategies"])


def test_in_a_pipe_it_prints_plain_tables(capsys: pytest.CaptureFixture[str]) -> None:
    assert study_here("schedule", "--family", "paper", "--strategy", "priority", "--seeds", "2") == 0
    shown = capsys.readouterr()
    assert shown.err == ""
    assert "\x1b" not in shown.out
    assert f"paper: {FAMILIES['paper'].summary}\nstrategy " in shown.out
    assert re.search(r"^priority +\d+\.\d% ", shown.out, re.MULTILINE)
    assert "\noptimal" not in shown.out
    assert re.search(r"^unreached +\+0\.\d\d$", shown.out, re.MULTILINE)


@pytest.mark.slow
def test_forecasts_are_held_against_what_came(capsys: pytest.CaptureFixture[str]) -> None:
    some = ("forecasts", "--family", "calm", "--seeds", "1", "--jobs", "1")
    assert study_here(*some, "--json") == 0
    ((calm,),) = json.loads(capsys.readouterr().out).values()
    assert calm["ways"].keys() == {"asked", "learned", "true"}
    assert study_here(*some) == 0
    assert re.search(
        rf"^calm +{calm['queued']} +{calm['ways']['asked']['near']:.1%} ", capsys.readouterr().out, re.MULTILINE
    )


def test_the_list_names_each_study_as_the_page_does(capsys: pytest.CaptureFixture[str]) -> None:
    assert study_here() == 0
    listed = {line.split()[0] for line in capsys.readouterr().out.splitlines()[1:]}
    page = (Path(__file__).parents[2] / "studies" / "README.md").read_text()
    assert listed == set(re.findall(r"^\| `([\w-]+)` \|", page, re.MULTILINE))
    for name, found in STUDY_TABLE.items():
        module, _, entry = found.entry.partition(":")
        assert callable(getattr(import_module(f"studies.{module}"), entry)), name


@pytest.mark.live
@pytest.mark.slow
def test_at_a_terminal_a_bar_shows_how_far_it_is() -> None:
    with Terminal("schedule", "--family", "paper", "--seeds", "3", command=STUDIES) as terminal:
        terminal.until(f"/{3 * len(STRATEGIES)}")
        terminal.until("Features that predict")
        assert terminal.code() == 0


@pytest.mark.live
@pytest.mark.parametrize("left", ["-:--:--", pytest.param("0:", marks=pytest.mark.slow)])
def test_ctrl_c_at_a_terminal_says_nothing(left: str) -> None:
    """At the beginning as well, when its processes are about to start."""
    with Terminal(*LONG, command=STUDIES) as terminal:
        total = 200 * len(STRATEGIES)
        terminal.until(f"/{total} {left}")
        said = len(terminal.text)
        terminal.press("\x03")
        assert terminal.code() == 130
        assert "Traceback" not in terminal.text
        assert re.sub(rf"trials|\d+/{total}|[━╸╺\s:\d-]|\^C", "", terminal.text[said:]) == ""


def session_is_empty(session: int) -> bool:
    """True as soon as no process of a session runs (a zombie does not), False if that takes too long."""
    deadline = time.monotonic() + HANG
    while time.monotonic() < deadline:
        running = []
        for process in psutil.process_iter():
            with suppress(psutil.NoSuchProcess, ProcessLookupError):
                if os.getsid(process.pid) == session and process.status() != psutil.STATUS_ZOMBIE:
                    running.append(process)
        if not running:
            return True
        time.sleep(0.02)
    return False


@pytest.mark.live
@pytest.mark.slow
@pytest.mark.parametrize("seed", range(times(1)))
@pytest.mark.parametrize(
    ("number", "send"),
    [(signal.SIGINT, os.killpg), (signal.SIGTERM, os.kill), (signal.SIGHUP, os.kill), (signal.SIGKILL, os.kill)],
    ids=["ctrl-c", "term", "hangup", "kill"],
)
def test_ended_at_any_time_it_says_nothing_and_leaves_nothing(
    number: signal.Signals, send: Callable[[int, int], None], seed: int
) -> None:
    """Its results are bigger than a pipe: a process may be killed in the middle of one. Ctrl-C, as from a terminal,
    reaches all of its processes; another signal the first one alone."""
    command = [*STUDIES, *LONG, "--strategy", "priority"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        while not psutil.Process(process.pid).children():
            assert process.poll() is None
            time.sleep(0.005)
        time.sleep(random.Random(f"{number} {seed}").uniform(0, 2))  # noqa: S311
        send(process.pid, number)
        out, err = process.communicate(timeout=HANG)
        if number == signal.SIGKILL and "in spawn_main" in err:
            err = ""  # a process that was just being started: none of our code runs in it yet
        code = -number if number == signal.SIGKILL else 128 + number
        assert (process.returncode, out, err) == (code, "", "")
        assert session_is_empty(process.pid)


@pytest.mark.live
def test_processes_that_can_not_start_are_one_line() -> None:
    few = ("sh", "-c", 'ulimit -n 40; exec "$@"', "sh")
    done = subprocess.run([*few, *STUDIES, *LONG, "--jobs", "200"], capture_output=True, text=True, timeout=HANG)
    assert (done.returncode, done.stdout) == (Failed.exit_code, "")
    line = "studies: a process can't be started (Too many open files); use fewer with --jobs 1\n"
    assert done.stderr == line


@pytest.mark.slow
def test_the_recording_has_curves_and_bars_of_every_strategy(tmp_path: Path) -> None:
    path = tmp_path / "study.rrd"
    assert study_here("schedule", "--family", "paper", "--seeds", "4-5", "--rrd", path) == 0
    entities = {chunk.entity_path for chunk in RrdReader(path).stream()}
    for strategy in STRATEGIES:
        for pane in ("used", "waiting", "in_use", "wait_longest_mean"):
            assert f"/paper/{pane}/{strategy}" in entities
    assert "/summary" in entities
    # The plots show the whole run, whatever the viewer's cursor is near.
    windows = view_ranges(path)
    ends = [at for entity, at in changes(path) if entity.startswith("/paper/used/")]
    assert len(windows) == 2
    assert all(start <= 0 and end >= max(ends) > 0 for start, end in windows)
    assert all(end - start <= 1.1 * max(ends) for start, end in windows)


def view_ranges(path: Path) -> list[tuple[float, float]]:
    """What the recording's own layout shows of time, in seconds: the window of each plot."""
    reader = RrdReader(path)
    (layout,) = reader.blueprints()
    column = "TimeAxis:view_range"
    batches = [chunk.to_record_batch() for chunk in reader.stream(store=layout)]
    found = [batch.column(column).to_pylist() for batch in batches if column in batch.schema.names]
    return [(one["start"] / 1e9, one["end"] / 1e9) for [[one]] in found]


def changes(path: Path) -> Iterator[tuple[str, float]]:
    """(entity, seconds) of every point of a curve."""
    for chunk in RrdReader(path).stream().filter(is_static=False):
        for at in chunk.to_record_batch().column(VIRTUAL_TIME).cast("int64").to_pylist():
            yield str(chunk.entity_path), at / 1e9


@pytest.mark.parametrize(
    ("study", "args", "words"),
    [
        ("schedule", ["--seeds", "0"], '--seeds: "0" is an empty range of seeds'),
        ("schedule", ["--seeds", "9-5"], "is an empty range of seeds"),
        ("schedule", ["--seeds", "many"], "write a number, as in 20"),
        ("schedule", ["--seeds", f"{MAX_SEED}-{MAX_SEED + 1}"], f"a seed is at most {MAX_SEED}"),
        ("schedule", ["--seeds", "100000"], "are more than 5000; ask for fewer seeds or families"),
        ("schedule", ["--family", "nothing"], '"nothing" is unknown; write one of'),
        ("schedule", ["--strategy", "luck"], '"luck" is unknown; write one of'),
        ("schedule", ["--jobs", "0"], "--jobs"),
        ("schedule", ["--rrd", "picture.png"], "end it in .rrd"),
        ("schedule", ["--rrd", "no/such/folder/x.rrd"], "x.rrd: can't be written"),
        ("placement", ["--seeds", "1001"], "1001 are more than 1000; ask for fewer"),
        ("placement", ["--rrd", "picture.png"], "end it in .rrd"),
        ("robots", ["--robots", "four"], '--robots "four": write numbers and ranges of them'),
        ("robots", ["--robots", "0-4"], '"0-4" is not within 1 to 16'),
        ("robots", ["--channels", "3-1"], "or backwards"),
        ("robots", ["--channels", "17"], "not within 1 to 16"),
        ("robots", ["--baud", "300-900"], "more than 64 numbers"),
        ("robots", ["--baud", "9"], "not within 110 to 1000000"),
        ("robots", ["--slot", "0"], "not within 1 to 3600"),
        ("robots", ["--building", "palace"], '--building "palace" is unknown'),
        ("robots", ["--building", "no/where.toml"], "no/where.toml"),
        ("robots", ["--seeds", "1000"], "runs are more than 5000"),
        ("robots", ["--rrd", "picture.png"], "end it in .rrd"),
        ("robots", ["--svg", "no/such/folder"], "does not exist"),
        ("replacement", [], "unknown study 'replacement'"),
    ],
)
def test_bad_input_is_one_line_and_code_2(
    study: str, args: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert study_here(study, *args) == 2
    out, line = capsys.readouterr()
    assert (out, line.count("\n"), words in line) == ("", 1, True), line


def test_seeds_are_a_number_or_a_range() -> None:
    assert parse_seeds("3") == range(3)
    assert parse_seeds("5-5") == range(5, 6)
    with pytest.raises(BadInput):
        parse_seeds("-5")

"""What is kept of a recording: few chunks, fewer old pictures, parts that each begin with what is shown."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from itertools import pairwise
from pathlib import Path

import msgspec
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from tests.hang import HANG
from tests.services.recorder.paper_run import colours, events, lanes, rows
from tests.services.recorder.robot_run import head, jpeg, record
from zscout.services.recorder import timeline as module
from zscout.services.recorder.colours import ABSENT, OPERATOR
from zscout.services.recorder.drawing import HolderRow
from zscout.services.recorder.finish import APART, WHOLE, Job, finish
from zscout.services.recorder.process import new_recording, prune, writing
from zscout.services.recorder.timeline import Timeline, TimelineError

CAMERA = "framegrabber/fgrab1"


def chunks(path: Path) -> int:
    return len(RrdReader(path).stream().to_chunks())


@pytest.mark.slow
@pytest.mark.parametrize(("until", "fewer"), [(5, 2), pytest.param(60, 8, marks=pytest.mark.slow)])
def test_a_recording_that_is_over_has_few_chunks_and_all_that_was_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, until: int, fewer: int
) -> None:
    record(tmp_path / "finished.rrd", until)
    monkeypatch.setattr(module, "finish", lambda *_: None)
    # By its clock a file has the more chunks the slower this machine is.
    each = rr.ChunkBatcherConfig.ALWAYS_TEST_ONLY()
    monkeypatch.setattr(rr, "ChunkBatcherConfig", lambda **_: each)
    record(tmp_path / "written.rrd", until)
    finished, written = ((tmp_path / f"{name}.rrd") for name in ("finished", "written"))
    assert fewer * chunks(finished) < chunks(written)
    assert finished.stat().st_size < written.stat().st_size
    for content in ("/devices/**", "/requests/**", "/behavior/**"):
        assert lanes(finished, content) == lanes(written, content)
        assert colours(finished, content) == colours(written, content)
    assert Counter(events(finished)) == Counter(events(written))
    assert _pictures(finished, "/camera/**") == _pictures(written, "/camera/**")
    assert len(RrdReader(finished).blueprints()) > 0
    RrdReader(finished).store()  # it has its footer


def _pictures(path: Path, content: str) -> list[float]:
    return sorted(at for _, at, _ in rows(path, content, "EncodedImage:blob"))


def test_of_old_pictures_one_a_second_stays(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    picture, whole, end = jpeg(0, "scout33", None), 30.0, 90
    monkeypatch.setattr(module, "finish", lambda path, layout: finish(path, layout, whole=whole))
    with Timeline("lab", path=path) as timeline:
        for quarter in range(end * 4 + 1):
            timeline.robots.frame(quarter / 4, CAMERA, head(quarter), picture)
            timeline.event(quarter / 4, f"event {quarter}")
    shown = _pictures(path, "/camera/**")
    old = [at for at in shown if at < end - whole]
    assert [later - at for at, later in pairwise(old)] == [APART] * (len(old) - 1)
    assert len(old) == end - whole
    assert len(shown) - len(old) == whole * 4 + 1
    assert len(events(path)) == end * 4 + 1


@pytest.mark.live
@pytest.mark.slow
def test_a_process_of_its_own_thins_what_is_over_and_says_what_it_can_t(tmp_path: Path) -> None:
    first, picture = tmp_path / "first.rrd", jpeg(0, "scout33", None)
    with Timeline("lab", path=first) as timeline:
        for number in range(4):
            timeline.robots.frame(number / 4, CAMERA, head(number), picture)
        timeline.event(WHOLE + 10, "much later")
        job = timeline.roll(WHOLE + 11, tmp_path / "second.rrd")
    assert job is not None

    def done(job: Job) -> tuple[int, str]:
        told = msgspec.json.encode(job, enc_hook=str)
        command = [sys.executable, "-m", "zscout.services.recorder.finish"]
        ended = subprocess.run(command, input=told, capture_output=True, timeout=HANG, check=False)
        return ended.returncode, ended.stderr.decode()

    assert len(_pictures(first, "/camera/**")) == 4
    assert done(job) == (0, "")
    assert _pictures(first, "/camera/**") == [0]
    (tmp_path / "third.rrd").write_bytes(b"no recording")
    code, words = done(Job(tmp_path / "third.rrd", job.layout))
    assert (code, words.count("\n")) == (1, 1)
    assert "third.rrd can't be rewritten, and stays as it is" in words


def test_what_can_t_be_written_anew_stays_as_it_is(path: Path, tmp_path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        timeline.event(0, "all is well")
        layout = timeline.layout(live=False)
    before = path.read_bytes()
    # A folder in the place of the file that it would write.
    (tmp_path / ".run.finishing").mkdir()
    with pytest.raises((OSError, RuntimeError, ValueError)):
        finish(path, layout)
    assert path.read_bytes() == before


def test_a_recording_goes_on_in_a_file_that_begins_with_what_is_shown(tmp_path: Path) -> None:
    first, second = tmp_path / "first.rrd", tmp_path / "second.rrd"
    with Timeline("lab", path=first) as timeline:
        timeline.holders(1, "robot/a", [HolderRow("survey")])
        timeline.holders(1, "robot/b", [HolderRow("drive", operator=True)])
        timeline.hosts.load(1, "anvil", 1.0)
        timeline.event(2, "before")
        job = timeline.roll(10, second)
        assert job is not None
        timeline.event(11, "after")
        timeline.holders(12, "robot/a", [])
    finish(job.path, job.layout)
    assert (job.path, job.layout.span) == (first, (1, 2))
    assert (events(first), events(second)) == (["before"], ["after"])
    assert lanes(first, "/devices/**")["/devices/robot/a"] == [(1, ["survey"])]
    assert lanes(second, "/devices/**") == {
        "/devices/robot/a": [(10, ["survey"]), (12, [""])],
        "/devices/robot/b": [(10, ["drive (operator)"])],
    }
    assert colours(second, "/devices/robot/b") == {"/devices/robot/b": {"drive (operator)": OPERATOR}}
    assert len(list(rows(second, "/load/anvil", "SeriesLines:colors", static=True))) == 1


def test_a_recording_that_can_t_go_on_in_another_file_goes_on_in_the_same(path: Path, tmp_path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        timeline.event(1, "before")
        with pytest.raises(TimelineError):
            timeline.roll(2, tmp_path / "none" / "run.rrd")
        timeline.event(3, "after")
    assert events(path) == ["before", "after"]


def test_the_oldest_recordings_make_room_but_not_what_is_written(tmp_path: Path) -> None:
    made = [new_recording(tmp_path, "lab") for _ in range(5)]
    for age, path in enumerate(reversed(made)):
        path.write_bytes(b"x" * 1000)
        os.utime(path, ns=(0, 10**18 - age))
    with writing(made[0]):
        prune(tmp_path, "lab", limit=2500)
        assert set(tmp_path.iterdir()) == {made[0], *made[3:]}
    prune(tmp_path, "lab", limit=2500)
    assert set(tmp_path.iterdir()) == {*made[3:]}


def test_who_is_waited_for_comes_first_and_who_is_absent_last(path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        for rc in ("robot/a", "robot/b", "robot/c", "robot/d"):
            timeline.holders(0, rc, [HolderRow("survey")])
        timeline.contended(1, ["robot/c"])
        timeline.holders(2, "robot/a", [], "the node of ws1 is gone")
        timeline.contended(2, ["robot/a"])
        layout = timeline.layout(live=False)
        assert (list(layout.contended), list(layout.absent)) == (["/devices/robot/c"], ["/devices/robot/a"])
        timeline.regroup(3)
        assert list(timeline.layout(live=True).contended) == ["/devices/robot/c"]
        # Nobody waits for it any more.
        timeline.regroup(1000)
        assert list(timeline.layout(live=True).contended) == []
        timeline.holders(1001, "robot/a", [])
        assert list(timeline.layout(live=False).absent) == []
    assert lanes(path, "/devices/robot/a")["/devices/robot/a"][1:] == [(2, ["the node of ws1 is gone"]), (1001, [""])]
    assert colours(path, "/devices/robot/a")["/devices/robot/a"]["the node of ws1 is gone"] == ABSENT


def test_an_operator_is_red_among_arcs_and_events_as_well(path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        timeline.arc(0, "drive", "waiting", "for survey: robot/a", operator=True)
        timeline.arc(1, "drive", "running", "priority 10", operator=True)
        timeline.event(1, "drive runs on robot/a", operator=True)
        timeline.event(2, "survey runs on robot/a")
    assert colours(path, "/requests/drive")["/requests/drive"]["running · priority 10"] == OPERATOR
    told = {text[0]: at for _, at, text in rows(path, "/events", "TextLog:text")}
    assert [at for _, at, colour in rows(path, "/events", "TextLog:color") if colour == [OPERATOR]] == [1]
    assert told == {"drive runs on robot/a": 1, "survey runs on robot/a": 2}

"""What was held before a recording began, as journals tell it."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

from tests.mesh.kit import until
from tests.services.journal.kit import past
from tests.services.journal.test_journal import START, telling
from tests.services.recorder.kit import recording
from tests.services.recorder.paper_run import colours, events, lanes
from zscout.messages import History, JournalGap, Release
from zscout.services.journal.asking import FleetHistory as Journals
from zscout.services.journal.merging import Span
from zscout.services.recorder import past as module
from zscout.services.recorder.colours import ABSENT, OPERATOR, PALETTE, faded
from zscout.services.recorder.drawing import MAX_SLOTS, HolderRow
from zscout.services.recorder.finish import finish
from zscout.services.recorder.past import PastBar, past_lanes, past_of
from zscout.services.recorder.timeline import PAST_PART, Timeline

ZERO = 1_000.0
WINDOW = Span(0.0, ZERO)
SURVEY, NOBODY_KNOWS = PastBar("survey"), PastBar()


def shown(*holds: Any, unknown: tuple[Span, ...] = ()) -> dict[str, list[tuple[float, list[PastBar | None]]]]:
    """By RC; seconds from the beginning of the window."""
    found = past_lanes(holds, unknown, WINDOW, ZERO, operator_priority=10)
    return {rc: [(at + ZERO, [*bars]) for at, bars in lane] for rc, lane in found.items()}


def test_holds_are_shown_at_their_times_and_none_of_what_was_recorded() -> None:
    holds = [
        past(1, -50, 100),
        past(2, 100, 200, arc="drive", priority=10),
        past(3, 900, None),
        past(4, ZERO, None, arc="recorded"),
        past(5, -10, 0.0, arc="long ago"),
    ]
    drive = PastBar("drive", operator=True)
    assert shown(*holds) == {"robot/a": [(0, [SURVEY]), (100, [drive]), (200, [None]), (900, [SURVEY]), (ZERO, [None])]}


def test_several_holders_keep_their_rows() -> None:
    holds = [past(1, 10, 30, arc="a"), past(2, 20, 50, arc="b"), past(3, 30, 40, arc="c")]
    a, b, c = (PastBar(name) for name in "abc")
    lane = shown(*holds)["robot/a"]
    assert lane == [(10, [a, None]), (20, [a, b]), (30, [c, b]), (40, [None, b]), (50, [None, None])]
    crowd = [past(number, 10, 30, arc=f"arc{number}") for number in range(MAX_SLOTS + 3)]
    assert [len(bars) for _, bars in shown(*crowd)["robot/a"]] == [MAX_SLOTS, MAX_SLOTS]


def test_where_nobody_knows_an_rc_is_not_shown_as_free() -> None:
    holds = [past(1, 100, 200), past(2, 300, 400)]
    assert shown(*holds, unknown=(Span(50, 350), Span(500, ZERO)))["robot/a"] == [
        (50, [NOBODY_KNOWS]),
        (100, [SURVEY]),
        (200, [NOBODY_KNOWS]),
        (300, [SURVEY]),
        (400, [None]),
        (500, [NOBODY_KNOWS]),
        (ZERO, [None]),
    ]


def test_of_too_many_rcs_those_that_were_held_last_are_shown(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_LANES", 2)
    holds = [past(number, number, number + 10, rcs=[f"robot/{number}"]) for number in range(5)]
    assert [*shown(*holds)] == ["robot/3", "robot/4"]


def test_what_is_not_known_is_told_in_words() -> None:
    anvil = History("anvil", ZERO, 100.0, gaps=[JournalGap(300.0, 360.0, "off"), JournalGap(990.0, None, "silent")])
    told = Journals(Span(0.0, ZERO + 5), [past(1, 200, 250)], False, {"anvil": anvil}, ["forge"])
    found = past_of(told, ZERO, ZERO, operator_priority=10)
    assert found.words == [
        "the journals of anvil list 1 hold in the 0.278 h before this recording",
        "no journal of forge: off, older than 0.3.0, or too slow",
    ]
    # Nothing is said of when there was no journal yet, nor of what is recorded.
    assert found.gaps == [
        "from 01 Jan 00:05:00 to 01 Jan 00:06:00 UTC the journals are incomplete: anvil did not run",
        "from 01 Jan 00:16:30 to 01 Jan 00:16:40 UTC the journals are incomplete: anvil received nothing from an RCM",
    ]
    assert [at + ZERO for at, _ in found.lanes["robot/a"]] == [200, 250, 300, 360, 990, ZERO]
    latest = past_of(Journals(Span(0.0, ZERO), [past(1, 900, 950)], True, {"anvil": anvil}, []), ZERO, ZERO, 10)
    assert latest.words == ["the journals of anvil list the latest 1 hold in the 0.278 h before this recording"]
    assert len(latest.gaps) == 1


def test_the_past_is_drawn_paler_and_makes_the_run_no_longer(path: Path) -> None:
    drive = PastBar("drive", operator=True)
    with Timeline("lab", path=path) as timeline:
        timeline.holders(0.5, "robot/a", [HolderRow("survey")])
        timeline.past(
            600,
            {
                "robot/a": [(-500, [SURVEY]), (-400, [NOBODY_KNOWS]), (-300, [drive]), (0, [None])],
                "robot/gone": [(-600, [PastBar("film")]), (0, [None])],
            },
        )
        timeline.event(9, "the end")
        layout = timeline.layout(live=False)
    # Too late:
    timeline.past(600, {"robot/late": [(-1, [SURVEY])]})
    assert layout.only_past == ("/devices/robot/gone",)
    assert (layout.past, layout.span) == (600.0, (0.5, 9.0))
    before = [(-500, ["survey (journal)"]), (-400, ["not known"]), (-300, ["drive (operator) (journal)"])]
    assert lanes(path, "/devices/robot/a")["/devices/robot/a"] == [*before, (0, [""]), (0.5, ["survey"])]
    assert colours(path, "/devices/robot/a")["/devices/robot/a"] == {
        "survey": PALETTE[0],
        "survey (journal)": faded(PALETTE[0], PAST_PART),
        "not known": ABSENT,
        "drive (operator) (journal)": faded(OPERATOR, PAST_PART),
    }


def test_only_the_first_file_has_the_past(tmp_path: Path) -> None:
    first, second = tmp_path / "one.rrd", tmp_path / "two.rrd"
    with Timeline("lab", path=first, wall=True) as timeline:
        timeline.start_clock(START)
        timeline.holders(0.5, "robot/a", [])
        timeline.past(600, {"robot/a": [(-500, [SURVEY]), (0, [None])]})
        job = timeline.roll(10, second)
        assert job is not None
        assert (job.layout.past, timeline.layout(live=False).past, timeline.layout(live=True).past) == (600, 0, 600)
    finish(job.path, job.layout)
    assert len(lanes(first, "/devices/**")["/devices/robot/a"]) == 3
    assert [states for _, states in lanes(second, "/devices/**")["/devices/robot/a"]] == [[""]]


async def test_a_recorder_that_comes_late_shows_what_journals_tell(path: Path, tmp_path: Path) -> None:
    told, _ = await telling(tmp_path, "x", "y", rcs=["robot/a", "robot/b"])
    fleet = told.fleet
    one, two = fleet.client("one"), fleet.client("two")
    await one.ask("survey", "robot/a", seconds=6_000)
    await two.ask("film", "robot/b", seconds=600)
    await asyncio.sleep(100)
    await two.do(Release("film"))
    await asyncio.sleep(50)
    here = fleet.mesh("basil", "recorder")
    how: dict[str, Any] = {"past": 3_600, "wall": lambda: START + here.now() / 10**9}
    async with recording(path, here, fleet.watcher, fleet.fleet, clock=True, **how) as timeline:
        await until(lambda: timeline.layout(live=True).past)
        # What happens now is not the past, though the journals have it too.
        await two.ask("again", "robot/b", seconds=600)
        await asyncio.sleep(10)
    await told.close()
    found = lanes(path, "/devices/**")
    assert [states for _, states in found["/devices/robot/a"]] == [["survey (journal)"], [""], ["survey"]]
    assert [states for _, states in found["/devices/robot/b"]] == [["film (journal)"], [""], [""], ["again"]]
    begun, over, *_ = (at for at, _ in found["/devices/robot/b"])
    assert over - begun == pytest.approx(100, abs=1)
    assert over == pytest.approx(-50, abs=1)
    assert found["/devices/robot/a"][1][0] == 0
    assert "the journals of x, y list 2 holds in the 1 h before this recording" in events(path)

"""What is booked, ahead of now: the chart, what is said, and both as a leader on the mesh tells of bookings."""

from __future__ import annotations

import asyncio
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.mesh.kit import until
from tests.services.rcm.booked_fleet import NOON, book, do
from tests.services.rcm.booked_fleet import booked as booked_fleet
from tests.services.recorder.kit import recording
from tests.services.recorder.paper_run import events, rows
from zscout.messages import BookedDate, BookingsTold, BookingView, Unbook
from zscout.services.recorder.ahead import LEFT, MARGIN, MAX_BARS, Bar, ChartLayer, rows_of
from zscout.services.recorder.ahead import chart as chart_of_rows
from zscout.services.recorder.blueprint import AHEAD, CHART_HEAD, CHART_WIDTH, MAX_CHART_ROWS, Ahead, chart_row
from zscout.services.recorder.bookings import AGAIN, MAX_EVENTS, STALE
from zscout.services.recorder.colours import ALERT, FAILED, MAINTENANCE, PALETTE
from zscout.services.recorder.timeline import Timeline

HOUR, DAY = 3_600, 86_400
NOW = NOON
"""Fri 15 Jan 2027, 08:00 UTC."""
TODAY, WEEK = AHEAD


def bar(row: str, start: float, end: float, text: str = "survey", **more: Any) -> Bar:
    """Hours from now."""
    return Bar(row, NOW + start * HOUR, NOW + end * HOUR, text, PALETTE[0], **more)


def chart(bars: list[Bar], now: float, ahead: Ahead) -> dict[str, ChartLayer]:
    return chart_of_rows(bars, now, ahead, rows_of(bars, now))


def boxes(layers: dict[str, ChartLayer]) -> list[tuple[str, float, float, int]]:
    """Text, begin and end in hours from now, and row of each outline, as they are drawn."""
    fields = layers["dates"].fields
    scale = TODAY.seconds / HOUR / (CHART_WIDTH - LEFT)
    drawn = zip(fields["labels"], fields["mins"], fields["sizes"], strict=True)
    ends = [(text, x - LEFT, x - LEFT + wide, y - CHART_HEAD) for text, (x, y), (wide, _) in drawn]
    return [
        (text, round(begin * scale, 6), round(end * scale, 6), round(y // chart_row(1))) for text, begin, end, y in ends
    ]


def texts(layers: dict[str, ChartLayer], layer: str) -> list[str]:
    return list(layers[layer].fields["labels"])


def test_dates_stand_on_the_rows_of_their_rcs_ahead_of_now() -> None:
    bars = [
        bar("robot/b", 2, 4),
        bar("robot/a", 2, 4),
        bar("robot/a", 4, 5, "film"),
        bar("robot/a", 3, 6, "both"),
        bar("radio/rf0", -1, 2, "now"),
        bar("radio/rf0", 23, 30, "late"),
        bar("radio/rf0", -2, -1, "over"),
        bar("radio/rf0", 31, 33, "tomorrow"),
    ]
    layers = chart(bars, NOW, TODAY)
    first = [("now", 0, 2, 0), ("survey", 2, 4, 1), ("survey", 2, 4, 3), ("both", 3, 6, 2)]
    assert boxes(layers) == [*first, ("film", 4, 5, 1), ("late", 23, 24, 0)]
    # What is at one time as another of its RC stands below that.
    assert texts(layers, "names") == ["radio/rf0", "robot/a", "robot/b"]
    assert rows_of(bars, NOW) == 4
    assert texts(layers, "times")[:3] == ["now 08:00", "10:00", "12:00"]
    assert texts(layers, "times")[-4:] == ["Sat 16 Jan", "02:00", "04:00", "06:00"]
    assert texts(chart(bars, NOW, WEEK), "times")[:3] == ["now 08:00", "Sat 16 Jan", "Sun 17 Jan"]


def test_a_text_stands_in_its_outline_else_behind_it_else_a_part_of_it() -> None:
    bars = [bar("a/a", 1, 8, "wide enough"), bar("a/b", 1, 1.5, "behind")]
    bars += [
        bar("a/b", 8, 8.1, "crowded out"),
        bar("a/b", 10, 11.5, "next"),
        bar("a/b", 11.5, 11.6, "none"),
        bar("a/b", 11.7, 13, ""),
    ]
    layers = chart(bars, NOW, TODAY)
    labels = dict(zip(texts(layers, "labels"), layers["labels"].fields["positions"], strict=True))
    assert list(labels) == ["behind", "wide enough", "crowde…", "next", ""]
    begin, end, right = ((at * HOUR / TODAY.seconds) * (CHART_WIDTH - LEFT) + LEFT for at in (1, 8, 1.5))
    assert labels["wide enough"][0] == pytest.approx((begin + end) / 2)
    assert labels["behind"][0] > right


def test_only_maintenance_is_hatched_and_what_is_taken_up_is_thick() -> None:
    layers = chart([bar("a/a", 1, 2, hatched=True), bar("a/b", 1, 2, thick=True)], NOW, TODAY)
    maintenance, taken = layers["dates"].fields["radii"]
    assert abs(taken) > abs(maintenance)
    hatch = layers["hatch"].fields["strips"]
    (x, y), (wide, high) = layers["dates"].fields["mins"][0], layers["dates"].fields["sizes"][0]
    assert len(hatch) > 3
    assert all(x <= at <= x + wide and y - 1e-6 <= up <= y + high + 1e-6 for line in hatch for at, up in line)


def test_more_than_there_is_room_for_is_told() -> None:
    bars = [bar(f"robot/{number:02}", 1, 2) for number in range(MAX_CHART_ROWS + 3)]
    bars += [bar("robot/00", 3 + number / 100, 3 + (number + 1) / 100) for number in range(MAX_BARS)]
    layers = chart(bars, NOW, TODAY)
    assert len(boxes(layers)) == MAX_BARS - 3
    assert texts(layers, "names")[-1] == f"and {MAX_CHART_ROWS + 6} more"
    assert rows_of(bars, NOW) == MAX_CHART_ROWS + 1


@given(
    st.lists(st.tuples(st.sampled_from(["a/a", "a/b"]), st.integers(-30, 60), st.integers(1, 40)), max_size=40),
    st.sampled_from(AHEAD),
)
def test_no_outline_covers_another_or_leaves_the_chart(found: list[tuple[str, int, int]], ahead: Ahead) -> None:
    bars = [bar(row, at / 2, (at + long) / 2) for row, at, long in found]
    layers = chart(bars, NOW, ahead)
    fields = layers["dates"].fields
    drawn = sorted((y, x, x + wide) for (x, y), (wide, _) in zip(fields["mins"], fields["sizes"], strict=True))
    assert all(LEFT <= begin < end <= CHART_WIDTH for _, begin, end in drawn)
    for (y, _, end), (below, begin, _) in pairwise(drawn):
        assert y != below or begin >= end - 1e-6
    high = chart_row(rows_of(bars, NOW))
    assert all((y - CHART_HEAD - MARGIN) % high == 0 for y, _, _ in drawn)


def test_hostile_names_are_tamed() -> None:
    layers = chart([bar("robot/\x1b[31m" + "x" * 99, 1, 20, "one\ntwo \u65e5" + "y" * 200)], NOW, TODAY)
    ((row,), (text,), (told,)) = (texts(layers, layer) for layer in ("names", "labels", "dates"))
    assert row == f"robot/ [31m{'x' * 18}…"
    assert (told[:10], len(told)) == ("one two ?y", 120)
    assert text.startswith("one two ?y")
    assert text.endswith("…")


def test_nothing_is_drawn_where_nothing_is_booked() -> None:
    assert rows_of([], NOW) == 0
    assert all(not next(iter(layer.fields.values())) for layer in chart([], NOW, TODAY).values())


# What is told


def booked(name: str, *needs: str, start: float = 1, hours: float = 1, **more: Any) -> BookingView:
    """A booking whose id is its name; hours from now. `dates` have states, and what else is to be said."""
    at, runtime = int(NOW + start * HOUR), int(hours * HOUR)
    dates = [
        BookedDate(at + number * DAY, at + number * DAY + runtime, **date)
        for number, date in enumerate(more.pop("dates", [{"state": "open"}]))
    ]
    wanted: dict[str, Any] = {need: {} for need in needs}
    patience = Decimal(300)
    return BookingView(name, name, wanted, 1, at, Decimal(runtime), patience, owner="ws1", dates=dates, **more)


def tells(*bookings: BookingView, after: float = 0) -> BookingsTold:
    return BookingsTold(NOW + after, list(bookings))


@pytest.mark.slow
def test_what_changes_is_said_once_and_what_stood_before_is_not(path: Path) -> None:
    survey = booked("survey", "robot/a", "radio/rf0")
    danger = [{"state": "open", "danger": "robot/* is gone", "bound": {"robot/*": "robot/b"}}, {"state": "open"}]
    with Timeline("lab", path=path) as timeline:
        news = timeline.bookings.take
        news(0, tells(survey))
        news(5, tells(survey, after=5))
        film = booked("film", "robot/*", every=1, dates=danger)
        mend = booked("mend", "robot/c", start=20, hours=8, maintenance=True)
        burnt = booked("burnt", "robot/d", start=0, maintenance=True, lasting=True, broken=True)
        news(10, tells(survey, film, mend, burnt, after=10))
        film = booked("film", "robot/*", every=1, dates=[{"state": "conflict", "danger": "crew of ws2 stands"}] * 2)
        news(15, tells(booked("survey", "robot/a", "radio/rf0", dates=[{"state": "taken"}]), film, mend, after=15))
        news(20, tells(booked("film", "robot/*", every=1, dates=[{"state": "open"}]), after=20))
        news(25, tells(booked("film", "robot/*", every=1, dates=[{"state": "open"}]), after=HOUR))
        news(30, tells(after=HOUR + 301))
    assert events(path) == [
        "booking film of ws1 is made: robot/b, Fri 15 Jan, 09:00 to 10:00 UTC, and every day",
        "maintenance mend of ws1 is made: robot/c, Sat 16 Jan, 04:00 to 12:00 UTC",
        "robot/d reported broken by ws1: burnt",
        "booking film of ws1 may not start Fri 15 Jan, 09:00 to 10:00 UTC: robot/* is gone",
        "booking survey of ws1 is taken up",
        "booking film of ws1, Fri 15 Jan, 09:00 to 10:00 UTC, can't be: crew of ws2 stands",
        "booking film of ws1, Sat 16 Jan, 09:00 to 10:00 UTC, can't be: crew of ws2 stands",
        "robot/d no longer reported broken",
        "booking film of ws1, Fri 15 Jan, 09:00 to 10:00 UTC, stands again",
        # What was taken up is over: its ARC is spoken of.
        "booking film of ws1, Sat 16 Jan, 09:00 to 10:00 UTC, is given up",
        "maintenance mend of ws1 is given up",
        "booking film of ws1 has lapsed: it was not taken up",
    ]


@pytest.mark.slow
def test_conflicts_and_danger_are_said_though_they_stood_before(path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        stuck = booked("stuck", "robot/a", dates=[{"state": "conflict", "danger": "crew of ws2 stands"}])
        timeline.bookings.take(0, tells(booked("fine", "robot/b"), stuck))
    assert events(path) == ["booking stuck of ws1, Fri 15 Jan, 09:00 to 10:00 UTC, can't be: crew of ws2 stands"]


def test_a_danger_that_is_over_is_said(path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        for at, danger in enumerate(("robot/a is gone", "robot/a is gone", "", "")):
            timeline.bookings.take(at, tells(booked("fine", "robot/a", dates=[{"state": "open", "danger": danger}])))
    assert events(path) == [
        "booking fine of ws1 may not start Fri 15 Jan, 09:00 to 10:00 UTC: robot/a is gone",
        "booking fine of ws1, Fri 15 Jan, 09:00 to 10:00 UTC, stands again",
    ]


def test_a_flood_of_bookings_is_summed_up(path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        timeline.bookings.take(0, tells())
        timeline.bookings.take(5, tells(*(booked(f"b{number}", "robot/a") for number in range(1_000))))
    assert len(events(path)) == MAX_EVENTS + 1
    assert events(path)[-1] == f"and {1_000 - MAX_EVENTS} more changes of bookings"


def drawn(path: Path, layer: str = "dates", column: str = "Boxes2D:labels") -> list[tuple[float, list[str]]]:
    return [(at, list(names)) for _, at, names in rows(path, f"/ahead/day/{layer}", column)]


def test_outlines_have_the_colour_of_what_they_are_and_go_on_with_time(path: Path) -> None:
    conflict, danger = {"state": "conflict"}, {"state": "open", "danger": "robot/d is gone"}
    with Timeline("lab", path=path) as timeline:
        timeline.holders(0, "robot/z", [])
        timeline.bookings.take(
            0,
            tells(
                booked("a", "robot/a"),
                booked("b", "robot/b", maintenance=True),
                booked("c", "robot/c", dates=[conflict]),
                booked("d", "robot/d", dates=[danger]),
            ),
        )
        assert timeline.layout(live=True).ahead == 4
        timeline.bookings.tick(AGAIN - 1)
        timeline.bookings.tick(AGAIN)
        # Nobody tells any more: now stays where it was.
        timeline.bookings.tick(STALE + 1)
    ((_, _, colours), *_) = rows(path, "/ahead/day/dates", "Boxes2D:colors")
    assert list(colours) == [PALETTE[0], MAINTENANCE, FAILED, ALERT]
    assert drawn(path)[0] == (0, ["a", "maintenance: b", "c, in conflict", "d, in danger"])
    assert [(at, names[0]) for at, names in drawn(path, "times", "Points2D:labels")] == [
        (0, "now 08:00"),
        (AGAIN, "now 08:01"),
        (STALE + 1, "as of 08:00"),
    ]


# On the mesh


@pytest.mark.parametrize("maintenance", [False, True])
async def test_a_booking_appears_and_vanishes(path: Path, maintenance: bool) -> None:
    fleet, _ = await booked_fleet("x")
    client, here = fleet.client("one"), fleet.mesh("basil", "recorder")
    async with recording(path, here, fleet.watcher, fleet.fleet, clock=True, wall=fleet.time) as timeline:
        await asyncio.sleep(1)
        needs = ["robot/a", "robot/b" if maintenance else "robot/*"]
        what = book("crew", *needs, at=2 * HOUR, seconds=HOUR, maintenance=maintenance)
        await do(client, what, BookingView)
        await until(lambda: timeline.bookings.rows == 2)
        await do(client, Unbook("crew"), BookingView)
        await until(lambda: timeline.bookings.rows == 0)
        assert timeline.layout(live=True).ahead == 0
    name = "maintenance: crew" if maintenance else "crew"
    # Erased, not left where it was.
    assert [names for _, names in drawn(path)] == [[name, name]]
    assert [names for _, names in drawn(path, "names", "Points2D:labels")] == [["robot/a", "robot/b"]]
    (size, *_), *_ = (sizes for _, _, sizes in rows(path, "/ahead/day/dates", "Boxes2D:half_sizes"))
    assert 2 * size[0] == pytest.approx((CHART_WIDTH - LEFT) / 24)
    made, gone = (text for text in events(path) if "crew" in text)
    kind = "maintenance" if maintenance else "booking"
    assert made == f"{kind} crew of desk is made: robot/a, robot/b, Fri 15 Jan, 10:00 to 11:00 UTC"
    assert gone == f"{kind} crew of desk is given up"

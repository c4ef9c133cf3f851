"""The study of robots: what is run, how it is summed up, and the processes that it is spread over."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from studies.robots import hide
from studies.robots.field import Field
from studies.robots.field_figures import Outcomes
from studies.robots.study import (
    DRAWN,
    Quantiles,
    RobotsJob,
    RobotsTrial,
    StudyPlan,
    buildings,
    field_figures,
    grid,
    plan_of,
    quantiles_of,
    radio,
    receivers,
    run,
    start_figures,
    turns,
)
from studies.robots.svg import Plot, plots, svg
from zscout.config.strict import BadInput
from zscout.simulation.building.plan_file import shipped_plans

INF = math.inf


def test_more_channels_than_robots_are_left_out_and_a_field_is_run_once() -> None:
    fields = grid([4, 1, 2, 2], [4, 2, 1])
    assert [(one.robots, one.channels) for one in fields] == [(1, 1), (2, 1), (2, 2), (4, 1), (4, 2), (4, 4)]
    assert [(one.robots, one.channels) for one in grid([1], [3])] == [(1, 3)]
    assert [(one.channels, one.receivers) for one in receivers([4, 1, 5])] == [(4, 1), (4, 4)]
    assert receivers([4])[0] in grid([4], [4])
    radios = radio([9_600, 300])
    assert len(radios) == len(set(radios)) == 4
    assert [(one.robots, one.channels, one.slots.hide) for one in turns([60, 30])] == [(4, 1, 30), (4, 1, 60)]
    planned = StudyPlan(fields, radio=radios).jobs(["office", DRAWN], range(2), 60.0)
    # Four robots, four channels and 9600 baud are in both.
    assert len(planned) == len(set(planned)) == (6 + 4 - 1) * 2 * 2
    assert [job.seed for job in planned] == sorted(job.seed for job in planned)


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ([5.0], Quantiles(5, 5, 5)),
        ([2.0, 1.0], Quantiles(1, 1, 2)),
        ([float(number) for number in range(10, 0, -1)], Quantiles(1, 5, 9)),
        ([1.0, 2.0, INF], Quantiles(1, 2, INF)),
        ([INF, INF, 3.0], Quantiles(3, INF, INF)),
    ],
)
def test_a_spread_is_of_values_that_were_there(values: list[float], expected: Quantiles) -> None:
    assert quantiles_of(values) == expected


def outcomes(*placed: float | None, **more: Any) -> Outcomes:
    names = [f"scout{number}" for number in range(len(placed))]
    truths = {name: True for name, at in zip(names, placed, strict=True) if at is not None}
    return Outcomes(placed=dict(zip(names, placed, strict=True)), dark=truths, facing=truths, **more)


def test_runs_are_summed_up_by_what_they_had_to_work_with() -> None:
    field, other = Field(robots=2), Field(robots=2, channels=1)
    runs = [
        outcomes(20.0, 40.0, walks=3, noticed=3, watched=1800.0, false_alarms=1, longest_stop=0.4),
        outcomes(30.0, None, walks=1, noticed=0, watched=1800.0, crossings=4, alerted=3, longest_stop=0.2),
    ]
    trials = [RobotsTrial(RobotsJob("office", number, field), one) for number, one in enumerate(runs)]
    found = field_figures([*trials, RobotsTrial(RobotsJob("office", 0, other), outcomes(None, None))])
    one = found[field]
    assert (one.runs, one.placed, one.dark, one.walks) == (2, 0.75, 1.0, 4)
    assert one.all_placed == Quantiles(40, 40, INF)
    assert (one.noticed, one.noticed_spread) == (0.75, Quantiles(0, 0, 1))
    assert (one.alerted, one.false_alarms, one.longest_stop) == (0.75, 1.0, 0.4)
    never = found[other]
    assert never.placed == 0
    assert all(math.isnan(value) for value in (never.dark, never.noticed, never.alerted, never.false_alarms))


def test_starts_are_summed_up_by_building() -> None:
    def start(building: str, at: float | None, *, dark: bool, facing: bool) -> RobotsTrial:
        return RobotsTrial(RobotsJob(building, 0, None), hide.HideOutcome(building, 0, at, dark, facing, 1.0, 2.0, 0.1))

    trials = [
        start("office", 30.0, dark=True, facing=True),
        start("office", 50.0, dark=True, facing=False),
        start("office", 40.0, dark=False, facing=True),
        start("office", None, dark=True, facing=True),
        start("hall", None, dark=False, facing=False),
    ]
    office, hall = start_figures(trials)
    assert (office.starts, office.dark, office.good, office.seconds) == (4, 2, 1, Quantiles(30, 30, 30))
    assert (hall.starts, hall.dark, hall.good) == (1, 0, 0)
    assert math.isnan(hall.seconds.median)


def test_buildings_are_found_by_name_by_file_or_drawn() -> None:
    assert buildings() == [*shipped_plans(), DRAWN]
    assert plan_of("office", 3) is plan_of("office", 3)
    assert plan_of(str(shipped_plans()["office"]), 0) == plan_of("office", 3)
    assert plan_of(DRAWN, 3).name == "drawn-3"
    with pytest.raises(BadInput, match=r'--building "palace" is unknown; give .*drawn'):
        plan_of("palace", 0)
    with pytest.raises(BadInput, match=r"nowhere\.toml"):
        plan_of("nowhere.toml", 0)


def test_a_job_is_carried_out() -> None:
    trial = run(RobotsJob("office", 1, Field(robots=5, channels=1, frame_rate=2), 2.0))
    assert isinstance(trial.outcomes, Outcomes)
    assert (len(trial.outcomes.placed), trial.outcomes.holds) == (5, 1)
    assert trial.outcomes.seconds == pytest.approx(2)


# The plots


def test_plots_are_pictures_with_every_line_and_what_never_came() -> None:
    trials = [
        RobotsTrial(RobotsJob("office", 0, field), outcomes(*[20.0 * field.channels] * field.robots, walks=1))
        for field in grid([1, 2], [1, 2])
    ]
    trials += [RobotsTrial(RobotsJob("office", 0, field), outcomes(None)) for field in radio([300, 600])]
    figures = list(field_figures(trials).values())
    drawn = plots(figures[:3], figures[3:])
    assert list(drawn) == ["robots-placed.svg", "robots-noticed.svg", "robots-radio.svg"]
    assert plots([], []) == {}
    for plot in drawn.values():
        picture = ElementTree.fromstring(svg(plot))  # noqa: S314 - our own
        words = [one.text for one in picture.iter() if one.tag.endswith("text")]
        assert {plot.title, plot.across, plot.up, *plot.lines} <= set(words)
        assert ("never" in words) == (plot is drawn["robots-radio.svg"])


def test_a_plot_keeps_what_it_draws_within_itself() -> None:
    spreads = [Quantiles(0, 1, 3), Quantiles(7, 9, INF), Quantiles(INF, INF, INF), Quantiles(*[math.nan] * 3)]
    line = [(str(number), spread) for number, spread in enumerate(spreads)]
    picture = ElementTree.fromstring(svg(Plot("<t>", "x", "y", {"a & b": line})))  # noqa: S314 - our own
    _, _, width, height = map(float, picture.attrib["viewBox"].split())
    circles = [one for one in picture.iter() if one.tag.endswith("circle")]
    # Three of the line, one of the legend: nothing is drawn of what is no number.
    assert len(circles) == 4
    for circle in circles:
        assert 0 < float(circle.attrib["cx"]) < width
        assert 0 < float(circle.attrib["cy"]) < height


def test_a_bar_whose_median_never_came_begins_where_its_first_runs_did() -> None:
    picture = ElementTree.fromstring(svg(Plot("t", "x", "y", {"a": [("1", Quantiles(160, INF, INF))]})))  # noqa: S314 - our own
    words = [one.text for one in picture.iter() if one.tag.endswith("text")]
    assert {"0", "150"} <= set(words)


def test_a_building_without_room_is_bad_input(tmp_path: Path) -> None:
    closet = tmp_path / "closet.toml"
    lamp = '[[light]]\nname = "lamp"\nx = 0.8\ny = 0.8\n'
    place = "x = 0.75\ny = 0.75\nwidth = 1.4\ndepth = 1.4\nheight = 1"
    full = f'[[furniture]]\nname = "carton"\nkind = "solid"\n{place}\n'
    closet.write_text(f'name = "closet"\nwidth = 1.5\ndepth = 1.5\n{lamp}{full}')
    with pytest.raises(BadInput, match=r"closet\.toml, seed 2: closet has no open floor"):
        run(RobotsJob(str(closet), 2, Field(robots=2)))

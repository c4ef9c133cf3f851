"""Pictures of recordings with components, taken by the real viewer: of a fleet's hour, and of the study."""

from __future__ import annotations

from pathlib import Path

import pytest

from studies.placement.plots import record
from studies.placement.study import SCENARIOS, study
from studies.recording import COLOURS
from tests.services.recorder.placed_hour import play
from tests.services.recorder.test_viewer_picture import DIMMED, WIDTH, look, pixels, rgb
from zscout.messages import Placements
from zscout.services.recorder.blueprint import MARK_WORDS
from zscout.services.recorder.colours import FAILED, LINES, MARKS, PALETTE
from zscout.services.recorder.timeline import Timeline
from zscout.types import POLICIES, Term

pytestmark = [pytest.mark.live, pytest.mark.slow]

HEIGHT = 900
PANES = 0.62
STUDY = 0.74
"""Part of the width that the panes at the left have."""


def test_an_hour_of_placements_at_a_glance(path: Path, tmp_path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        play(timeline)
    picture, state = look(path, tmp_path, panes=8, height=HEIGHT)
    names = {view.name for view in state.views}
    assert names >= {"Components on each host", f"Load average (1 min) per host   {MARK_WORDS}"}
    left = picture.crop((0, 0, round(WIDTH * PANES), HEIGHT))
    # The lanes of the six components, the first of them an ARC's colour too.
    for colour in PALETTE[:6]:
        assert len(pixels(left, rgb(colour, DIMMED))) > 500
    # Curves and marks, in the lower part.
    curves = left.crop((0, 650, left.width, HEIGHT))
    for colour in LINES[:3]:
        columns = {x for x, _ in pixels(curves, rgb(colour))}
        assert len(columns) > 0.5 * curves.width
    for colour, _ in MARKS.values():
        assert len(pixels(curves, rgb(colour))) > 8
    cross = [x for x, _ in pixels(curves, rgb(FAILED))]
    assert max(cross) - min(cross) < 20
    assert abs(min(cross) / curves.width - 2600 / 3600) < 0.04


def test_words_that_the_viewer_can_t_draw_do_not_end_it(path: Path, tmp_path: Path) -> None:
    """Its font has no such letters, and it ends itself where it is to draw one."""
    with Timeline("lab", path=path) as timeline:
        words = "日本 \U0001f916 ✖ عربى"
        timeline.arc(0, words, "waiting", words)
        timeline.event(0, f"{words}: Grüße, Ελλάδα, Москва, Łódź → “…”")
        timeline.hosts.load(0, words, 1.0)
        tracker = timeline.hosts
        tracker.placements(0, Placements(Term(1, words)))
    look(path, tmp_path)


def test_the_study_s_plots_show_all_and_compare(path: Path, tmp_path: Path) -> None:
    report, outcomes = study([1])
    record(path, report, outcomes)
    picture, _ = look(path, tmp_path, panes=len(SCENARIOS) * len(POLICIES) + 1, height=HEIGHT)
    # The plots of the tab that is open: least_loaded at the upper left, pending at the lower right.
    middle, across = round(WIDTH * STUDY / 2), (95 + 870) // 2
    one_host = picture.crop((0, 95, middle, across - 30))
    even = picture.crop((middle, across + 20, 2 * middle, 850))
    heights = []
    for plot in (one_host, even):
        curve = pixels(plot, rgb(COLOURS[0]))
        columns = {x for x, _ in curve}
        assert min(columns) < 0.1 * plot.width
        assert max(columns) > 0.9 * plot.width
        heights.append(1 - min(y for x, y in curve if x > 0.8 * plot.width) / plot.height)
    # 12 components on one host come to a load of 6, a third of them to 2: on one scale.
    assert heights[0] > 0.85
    assert 0.25 < heights[1] < 0.5
    # Most of the 12 marks stand clear of the curves, about as many of each host.
    stack = even.crop((even.width // 100, round(even.height * 0.57), even.width // 12, round(even.height * 0.88)))
    assert all(len(pixels(stack, rgb(colour))) > 40 for colour in COLOURS[:3])

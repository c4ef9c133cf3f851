"""Where the timeline shows robots in the viewer: panes for the floor, cameras, behaviors and devices."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, NamedTuple

import rerun.blueprint as rrb

FLOOR_WORDS: Final = "green hidden, amber not yet, red operator, violet people"
"""In the title: a legend would cover the plan."""
BESIDE: Final = 4
"""Cameras side by side; more of them have pages of as many."""
LIVE_BEHAVIOR_ROWS: Final = 9
"""Behaviors that a live view has room for."""


class Shown(NamedTuple):
    """What there is of robots: panes are made for these."""

    cameras: tuple[tuple[str, str], ...] = ()
    """Entity and title of each."""
    floor: tuple[int, int] | None = None
    """Width and height of the plan's picture, in pixels."""
    behavior_rows: int = 0
    devices: bool = False

    @property
    def any(self) -> bool:
        """Whether the layout is that of a fleet with robots."""
        return bool(self.cameras or self.floor or self.behavior_rows)


def behavior_pane(axis: rrb.archetypes.TimeAxis) -> rrb.View:
    return rrb.StateTimelineView(origin="/behavior", name="What each behavior is doing", time_view=axis)


def device_pane(axis: rrb.archetypes.TimeAxis) -> rrb.View:
    return rrb.TimeSeriesView(
        origin="/device",
        name="Devices (point at a curve)",
        axis_x=axis,
        # There may be many, and a legend would cover them.
        plot_legend=rrb.PlotLegend(visible=False),
    )


def robot_column(shown: Shown, below: Sequence[rrb.View]) -> rrb.Container:
    """The panes at the right, from the top: the floor, the cameras, and tabs of what else there is."""
    panes: list[rrb.View | rrb.Container] = []
    shares: list[int] = []
    if shown.floor is not None:
        width, height = shown.floor
        bounds = rrb.VisualBounds2D(x_range=[0, width], y_range=[0, height])
        panes.append(rrb.Spatial2DView(origin="/floor", name=f"Floor   {FLOOR_WORDS}", visual_bounds=bounds))
        shares.append(9)
    if shown.cameras:
        panes.append(_cameras(shown.cameras))
        shares.append(5)
    panes.append(rrb.Tabs(*below) if len(below) > 1 else below[0])
    shares.append(6)
    return rrb.Vertical(*panes, row_shares=shares)


def _cameras(cameras: Sequence[tuple[str, str]]) -> rrb.Container:
    views = [rrb.Spatial2DView(origin=entity, name=title) for entity, title in cameras]
    pages = [views[first : first + BESIDE] for first in range(0, len(views), BESIDE)]
    rows = [
        rrb.Horizontal(*page, name=_page_name(BESIDE * number, len(page)))
        for number, page in enumerate(pages)
    ]
    return rows[0] if len(rows) == 1 else rrb.Tabs(*rows)


def _page_name(before: int, count: int) -> str:
    return f"Camera {before + 1}" if count == 1 else f"Cameras {before + 1} to {before + count}"

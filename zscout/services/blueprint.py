"""What the timeline looks like in the Rerun viewer: colours and layout.

One colour, `OPERATOR`, is kept for an operator's takeover and for what was preempted.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import rerun as rr
import rerun.blueprint as rrb

APPLICATION: Final = "zscout"
"""Rerun's application id: recordings and blueprints find each other by it."""
TIME: Final = "mesh_time"
"""The one timeline: a duration, in seconds from whatever zero the caller chose.

The viewer makes the column of times in the event list as wide as this name: "time" cuts off `+10s`."""

OPERATOR: Final = 0xFF1463FF
"""RGBA of operator takeovers and preemptions."""
PALETTE: Final[tuple[int, ...]] = (
    0x4E79A7FF,  # blue
    0xF28E2BFF,  # orange
    0x59A14FFF,  # green
    0xB58ADBFF,  # lilac
    0xEDC948FF,  # yellow
    0x2FB5B5FF,  # teal
    0x9C6B4FFF,  # brown
    0xB9E36BFF,  # lime
    0x6A45C9FF,  # violet
    0x7CC4F0FF,  # sky
    0x7A7A1EFF,  # olive
    0xFFC9A0FF,  # peach
    0x1F6E5AFF,  # pine
    0xDCDCE4FF,  # pearl
)
"""RGBA of ARCs, in order of appearance; the fifteenth has the colour of the first."""
OTHER: Final = 0x8A8A94FF
"""RGBA of what has no colour of its own: a summary, or an ARC past the limit of names."""
STATES: Final[dict[str, int]] = {
    "waiting": 0x6E5A20FF,
    "running": 0x2A7A46FF,
    "preempted": OPERATOR,
    "done": 0x2A2A31FF,
}
"""RGBA of what an ARC is doing; a state not named here gets `OTHER`."""
LINES: Final[tuple[int, ...]] = (0x56C1FFFF, 0xFFB454FF, 0xB5E07BFF, 0xD6A6FFFF, 0xFFF08AFF, 0x5FE0CFFF)
"""RGBA of the load curves, host by host; brighter than `PALETTE`, as a line is thin."""

MARGIN: Final = 0.03
"""Part of a finished run's length that is left free after its end."""
LIVE_WINDOW: Final = 60.0
"""Seconds of the past that a live view shows."""


def blueprint(
    live: bool, end: float | None = None, *, begin: float = 0.0, rc_rows: int = 6, arc_rows: int = 6
) -> rrb.Blueprint:
    """The layout: who holds what, what each ARC does and the loads on one time axis, events beside them.

    `live`: the window slides with the newest data and shows the last minute. Otherwise it is the absolute
    range `begin` to `end` in seconds of the timeline, or all there is when `end` is None. `rc_rows` and
    `arc_rows` are the rows expected in the two upper panes, which share the height accordingly.
    """
    axis = rrb.archetypes.TimeAxis(view_range=_window(live, begin, end))
    panes = rrb.Vertical(
        rrb.StateTimelineView(origin="/rc", name="Who holds each resource", time_view=axis),
        rrb.StateTimelineView(origin="/arc", name="What each ARC is doing", time_view=axis),
        rrb.TimeSeriesView(
            origin="/load",
            name="Load average (1 min) per host",
            axis_x=axis,
            plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
        ),
        row_shares=[_share(rc_rows), _share(arc_rows), 7],
    )
    events = rrb.TextLogView(
        origin="/events",
        name="Events",
        columns=rrb.archetypes.TextLogColumns(timeline_columns=[TIME], text_log_columns=["loglevel", "body"]),
    )
    return rrb.Blueprint(
        rrb.Horizontal(panes, events, column_shares=[62, 38]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIME, play_state="following"),
        auto_layout=False,
        auto_views=False,
    )


def save_blueprint(path: Path, *, live: bool = False, end: float | None = None) -> None:
    """Writes the layout as a Rerun blueprint file (`.rbl`); the arguments are those of `blueprint`."""
    blueprint(live, end).save(APPLICATION, path)


def _window(live: bool, begin: float, end: float | None) -> rr.TimeRange:
    boundary = rr.TimeRangeBoundary
    if live:
        return rr.TimeRange(
            start=boundary.cursor_relative(seconds=-LIVE_WINDOW), end=boundary.cursor_relative(seconds=2.0)
        )
    if end is None:
        return rr.TimeRange(start=boundary.infinite(), end=boundary.infinite())
    # A run of one instant would be an empty range, which shows nothing.
    length = max(end - begin, 1.0) * (1 + MARGIN)
    return rr.TimeRange(start=boundary.absolute(seconds=begin), end=boundary.absolute(seconds=begin + length))


def _share(rows: int) -> int:
    """Height of a pane in rows, with its title and axis; it scrolls past twelve rows."""
    return 2 + min(max(rows, 3), 12)

"""What the timeline looks like in the Rerun viewer: colours and layout.

One colour, `OPERATOR`, is kept for an operator's takeover and for what was preempted.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import rerun as rr
import rerun.blueprint as rrb

from zscout.services.robot_layout import (
    LIVE_BEHAVIOR_ROWS,
    Shown,
    behavior_pane,
    device_pane,
    robot_column,
)

APPLICATION: Final = "zscout"
"""Rerun's application id: recordings and blueprints find each other by it."""
TIME: Final = "mesh_time"
"""The one timeline: a duration, in seconds from whatever zero the caller chose.

The viewer makes the column of times in the event list as wide as this name: "time" cuts off `+10s`."""

OPERATOR: Final = 0xFF1463FF
"""RGBA of operator takeovers and preemptions."""
FAILED: Final = 0xFF3B1FFF
"""RGBA of what was given up."""
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
MARKS: Final[dict[str, tuple[int, rr.components.MarkerShape]]] = {
    "placed": (0xFFFFFFFF, rr.components.MarkerShape.Up),
    "restarted": (0xFFE14DFF, rr.components.MarkerShape.Circle),
    "left": (0xC9A2FFFF, rr.components.MarkerShape.Left),
    "came": (0xC9A2FFFF, rr.components.MarkerShape.Right),
    "given_up": (FAILED, rr.components.MarkerShape.Cross),
}
"""RGBA and shape of what happened to a component, on the load curve of its host."""
MARK_WORDS: Final = "▲ placed  ● restarted  ◀ moved away  ▶ moved here  \u00d7 given up"
"""In the title: a legend of all this would cover the curves."""

MARGIN: Final = 0.03
"""Part of a finished run's length that is left free after its end."""
LIVE_WINDOW: Final = 60.0
"""Seconds of the past that a live view shows."""
LIVE_ROWS: Final = 6
"""RCs, and ARCs, that a live view with robots has room for at least: most come after the first robot."""
LIVE_HOST_ROWS: Final = 10
"""Components that a live view has room for."""
NO_ROBOTS: Final = Shown()


def blueprint(
    live: bool,
    end: float | None = None,
    *,
    begin: float = 0.0,
    rc_rows: int = 6,
    arc_rows: int = 6,
    host_rows: int = 0,
    robots: Shown = NO_ROBOTS,
) -> rrb.Blueprint:
    """The layout: who holds what, what each ARC does and the loads on one time axis, events beside them; with
    components, also what runs on each host and what it uses.

    `live`: the window slides with the newest data and shows the last minute. Otherwise it is the absolute
    range `begin` to `end` in seconds of the timeline, or all there is when `end` is None. `rc_rows`,
    `arc_rows` and `host_rows` are the rows expected in the upper panes, which share the height accordingly.
    Without components `host_rows` is 0; a pane of RCs or ARCs that would be empty beside them is left out.
    With `robots`, their behaviors follow the ARCs, loads and hosts share a place, and floor and cameras are
    at the right, above the events.
    """
    axis = rrb.archetypes.TimeAxis(view_range=_window(live, begin, end))
    lanes = [
        ("/rc", "Who holds each resource", rc_rows),
        ("/arc", "What each ARC is doing", arc_rows),
        ("/host", "What runs on each host", host_rows),
    ]
    shown = [lane for lane in lanes if lane[2] or (lane[0] != "/host" and not host_rows)]
    views: list[rrb.View | rrb.Container] = [
        rrb.StateTimelineView(origin=origin, name=name, time_view=axis) for origin, name, _ in shown
    ]
    shares = [_share(rows) for _, _, rows in shown]
    load: rrb.View | rrb.Container = rrb.TimeSeriesView(
        origin="/",
        contents=["/load/**", "/mark/**"],
        name="Load average (1 min) per host" + (f"   {MARK_WORDS}" if host_rows else ""),
        axis_x=axis,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
    )
    if robots.any:
        if host_rows:
            load = rrb.Tabs(load, views.pop())
            shares.pop()
        if robots.behavior_rows:
            views.append(behavior_pane(axis))
            shares.append(_share(LIVE_BEHAVIOR_ROWS if live else robots.behavior_rows))
    panes = rrb.Vertical(*views, load, row_shares=[*shares, 5 if robots.any else 7])
    return rrb.Blueprint(
        rrb.Horizontal(
            panes,
            _beside(axis, host_rows > 0, robots),
            column_shares=[57, 43] if robots.any else [62, 38],
        ),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=TIME, play_state="following"),
        auto_layout=False,
        auto_views=False,
    )


def _beside(axis: rrb.archetypes.TimeAxis, uses: bool, robots: Shown) -> rrb.View | rrb.Container:
    events = rrb.TextLogView(
        origin="/events",
        name="Events",
        columns=rrb.archetypes.TextLogColumns(timeline_columns=[TIME], text_log_columns=["loglevel", "body"]),
    )
    if not uses and not robots.any:
        return events
    # As tabs they have little room for words.
    more = ("", "") if robots.any else (" of the heaviest components", ", in the colours of the lanes")
    curves = [
        rrb.TimeSeriesView(
            origin=f"/use/{folder}",
            name=name,
            axis_x=axis,
            # Colours are those of the lanes; a legend of many would cover the curves.
            plot_legend=rrb.PlotLegend(visible=False),
        )
        for folder, name in (
            ("cpu", f"CPU{more[0]} (cores){more[1]}"),
            ("memory", f"Memory{more[0]} (MB)"),
        )
    ]
    if robots.any:
        devices = [device_pane(axis)] if robots.devices else []
        return robot_column(robots, [events, *(curves if uses else []), *devices])
    return rrb.Vertical(events, *curves, row_shares=[5, 3, 3])


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

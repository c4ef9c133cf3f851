"""The layout of a recording in the Rerun viewer: a pane for each kind of thing that there is."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

import rerun as rr
import rerun.blueprint as rrb

APPLICATION: Final = "zscout"
"""Rerun's application id: recordings and blueprints find each other by it."""
TIME: Final = "mesh_time"
"""The one timeline: a duration, in seconds from whatever zero the caller chose.

The viewer makes the column of times in the event list as wide as this name: "time" cuts off `+10s`."""
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
FLOOR_WORDS: Final = "green hidden, amber not yet, red operator, violet people"
"""In the title: a legend would cover the plan."""
BESIDE: Final = 4
"""Cameras side by side; more of them have pages of as many."""
LIVE_BEHAVIOR_ROWS: Final = 9
"""Behaviors that a live view has room for."""


class RobotLayout(NamedTuple):
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


NO_ROBOTS: Final = RobotLayout()


def blueprint(
    live: bool,
    end: float | None = None,
    *,
    begin: float = 0.0,
    rc_rows: int = 6,
    arc_rows: int = 6,
    host_rows: int = 0,
    robots: RobotLayout = NO_ROBOTS,
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
            views.append(
                rrb.StateTimelineView(origin="/behavior", name="What each behavior is doing", time_view=axis)
            )
            shares.append(_share(LIVE_BEHAVIOR_ROWS if live else robots.behavior_rows))
    panes = rrb.Vertical(*views, load, row_shares=[*shares, 5 if robots.any else 7])
    root = rrb.Horizontal(
        panes, _beside(axis, host_rows > 0, robots), column_shares=[57, 43] if robots.any else [62, 38]
    )
    return page(root)


def page(
    root: rrb.Container, *, timeline: str = TIME, play_state: Literal["following"] | None = "following"
) -> rrb.Blueprint:
    """A layout of `root` alone: the viewer's own panels are collapsed."""
    return rrb.Blueprint(
        root,
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=timeline, play_state=play_state),
        auto_layout=False,
        auto_views=False,
    )


def _beside(axis: rrb.archetypes.TimeAxis, uses: bool, robots: RobotLayout) -> rrb.View | rrb.Container:
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
        _curves("/use/cpu", f"CPU{more[0]} (cores){more[1]}", axis),
        _curves("/use/memory", f"Memory{more[0]} (MB)", axis),
    ]
    if robots.any:
        below: list[rrb.View] = [events, *(curves if uses else [])]
        if robots.devices:
            below.append(_curves("/device", "Devices (point at a curve)", axis))
        return _robot_column(robots, below)
    return rrb.Vertical(events, *curves, row_shares=[5, 3, 3])


def _curves(origin: str, name: str, axis: rrb.archetypes.TimeAxis) -> rrb.View:
    # A legend of many would cover the curves.
    return rrb.TimeSeriesView(
        origin=origin, name=name, axis_x=axis, plot_legend=rrb.PlotLegend(visible=False)
    )


def _robot_column(shown: RobotLayout, below: Sequence[rrb.View]) -> rrb.Container:
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

"""The layout of a recording in the Rerun viewer: a pane for each kind of thing that there is."""

from __future__ import annotations

from typing import Final, Literal, NamedTuple

import rerun as rr
import rerun.blueprint as rrb

APPLICATION: Final = "zscout"
"""Rerun's application id: recordings and blueprints find each other by it."""
TIME: Final = "mesh_time"
"""The one timeline: a duration, in seconds from whatever zero the caller chose.

The viewer makes the column of times in the event list as wide as this name: "time" cuts off `+10s`."""
# Legends stand in titles: they would cover the curves, or the plan.
MARK_WORDS: Final = "▲ placed  ● restarted  ◀ moved away  ▶ moved here  \u00d7 given up"
FLOOR_WORDS: Final = "green hidden, amber not yet, red operator, violet people"

MARGIN: Final = 0.03
"""Part of a finished run's length that is left free after its end."""
LIVE_WINDOW: Final = 60.0
"""Seconds of the past that a live view shows."""
LIVE_ROWS: Final = 6
"""RCs, and ARCs, that a live view with robots has room for at least: most come after the first robot."""
LIVE_HOST_ROWS: Final = 10
"""Components that a live view has room for."""
LIVE_BEHAVIOR_ROWS: Final = 9
BESIDE: Final = 4
"""Cameras side by side; more of them have pages of as many."""


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
    span: tuple[float, float] | None = None,
    *,
    rc_rows: int = 6,
    arc_rows: int = 6,
    host_rows: int = 0,
    robots: RobotLayout = NO_ROBOTS,
) -> rrb.Blueprint:
    """The layout: who holds what, what each ARC does and the loads on one time axis, events beside them; with
    components, also what runs on each host and what it uses.

    `span`: begin and end of a run that is over, in seconds of the timeline. Without it the layout is live: the window
    slides with the newest data and shows the last minute. `rc_rows`, `arc_rows` and `host_rows` are the rows expected
    in the upper panes, which share the height accordingly. Without components `host_rows` is 0; a pane of RCs or ARCs
    that would be empty beside them is left out. With `robots`, their behaviors follow the ARCs, loads and hosts share a
    place, and floor and cameras are at the right, above the events."""
    axis = rrb.archetypes.TimeAxis(view_range=_window(span))
    behavior_rows = LIVE_BEHAVIOR_ROWS if span is None and robots.behavior_rows else robots.behavior_rows
    lanes = {
        origin: (_share(rows), rrb.StateTimelineView(origin=origin, name=name, time_view=axis))
        for origin, name, rows, alone in (
            ("/rc", "Who holds each resource", rc_rows, not host_rows),
            ("/arc", "What each ARC is doing", arc_rows, not host_rows),
            ("/host", "What runs on each host", host_rows, False),
            ("/behavior", "What each behavior is doing", behavior_rows if robots.any else 0, False),
        )
        if rows or alone
    }
    load: rrb.View | rrb.Container = rrb.TimeSeriesView(
        origin="/",
        contents=["/load/**", "/mark/**"],
        name="Load average (1 min) per host" + (f"   {MARK_WORDS}" if host_rows else ""),
        axis_x=axis,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
    )
    if robots.any and host_rows:
        load = rrb.Tabs(load, lanes.pop("/host")[1])
    shares = [*(share for share, _ in lanes.values()), 5 if robots.any else 7]
    panes = rrb.Vertical(*(view for _, view in lanes.values()), load, row_shares=shares)
    beside = _beside(axis, host_rows > 0, robots)
    return page(rrb.Horizontal(panes, beside, column_shares=[57, 43] if robots.any else [62, 38]))


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
    """The panes at the right, from the top: the floor, the cameras, events and curves; as tabs if there are robots."""

    def curves(origin: str, name: str) -> rrb.View:
        # A legend of many would cover the curves.
        return rrb.TimeSeriesView(origin=origin, name=name, axis_x=axis, plot_legend=rrb.PlotLegend(visible=False))

    events = rrb.TextLogView(
        origin="/events",
        name="Events",
        columns=rrb.archetypes.TextLogColumns(timeline_columns=[TIME], text_log_columns=["loglevel", "body"]),
    )
    below: list[rrb.View] = [events]
    if uses:
        # As tabs they have little room for words.
        more = ("", "") if robots.any else (" of the heaviest components", ", in the colours of the lanes")
        below.append(curves("/use/cpu", f"CPU{more[0]} (cores){more[1]}"))
        below.append(curves("/use/memory", f"Memory{more[0]} (MB)"))
    if not robots.any:
        return rrb.Vertical(*below, row_shares=[5, 3, 3]) if uses else events
    if robots.devices:
        below.append(curves("/device", "Devices (point at a curve)"))
    panes: list[tuple[int, rrb.View | rrb.Container]] = []
    if robots.floor is not None:
        width, height = robots.floor
        bounds = rrb.VisualBounds2D(x_range=[0, width], y_range=[0, height])
        panes.append((9, rrb.Spatial2DView(origin="/floor", name=f"Floor   {FLOOR_WORDS}", visual_bounds=bounds)))
    if robots.cameras:
        views = [rrb.Spatial2DView(origin=entity, name=title) for entity, title in robots.cameras]
        rows = [
            rrb.Horizontal(*views[first : first + BESIDE], name=_page_name(first, len(views)))
            for first in range(0, len(views), BESIDE)
        ]
        panes.append((5, rows[0] if len(rows) == 1 else rrb.Tabs(*rows)))
    panes.append((6, rrb.Tabs(*below) if len(below) > 1 else events))
    return rrb.Vertical(*(pane for _, pane in panes), row_shares=[share for share, _ in panes])


def _page_name(first: int, count: int) -> str:
    last = min(first + BESIDE, count)
    return f"Camera {last}" if last == first + 1 else f"Cameras {first + 1} to {last}"


def _window(span: tuple[float, float] | None) -> rr.TimeRange:
    if span is None:
        relative = rr.TimeRangeBoundary.cursor_relative
        return rr.TimeRange(start=relative(seconds=-LIVE_WINDOW), end=relative(seconds=2.0))
    begin, end = span
    # A run of one instant would be an empty range, which shows nothing.
    length = max(end - begin, 1.0) * (1 + MARGIN)
    absolute = rr.TimeRangeBoundary.absolute
    return rr.TimeRange(start=absolute(seconds=begin), end=absolute(seconds=begin + length))


def _share(rows: int) -> int:
    """Height of a pane in rows, with its title and axis; it scrolls past twelve rows."""
    return 2 + min(max(rows, 3), 12)

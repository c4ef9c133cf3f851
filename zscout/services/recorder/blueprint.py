"""The layout of a recording in the Rerun viewer: a pane for each kind of content."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final, Literal, NamedTuple

import msgspec
import rerun as rr
import rerun.blueprint as rrb

APPLICATION: Final = "zscout"
"""Rerun's application id: recordings and blueprints find each other by it."""
TIME: Final = "mesh_time"
"""The timeline of runs without wall-clock times: a duration, in seconds from a zero that the caller chose.

The viewer makes the column of times in the event list as wide as this name: "time" cuts off `+10s`."""
WALL_TIME: Final = "wall_clock_time"
"""The timeline of a live fleet. The viewer shows it in UTC, or in local time if set so."""
# Legends are in titles, as they would cover the curves or the plan.
MARK_WORDS: Final = "▲ placed  ● restarted  ◀ moved away  ▶ moved here  \u00d7 given up"
FLOOR_WORDS: Final = "green hidden, amber not yet, red operator, violet people"

REQUESTS: Final = "What each request is doing"
MARGIN: Final = 0.03
"""Share of a finished run's length that is left free after its end."""
LIVE_WINDOW: Final = 60.0
"""Seconds that a live view shows."""
LIVE_ROWS: Final = 6
"""Least rows for RCs, and for ARCs, in a live view with robots: most appear after the first robot."""
LIVE_HOST_ROWS: Final = 10
"""Rows for components in a live view."""
LIVE_BEHAVIOR_ROWS: Final = 9
ONE_PANE: Final = 10
"""Most rows of devices in a single pane."""
FOLDED: Final = 8
"""Most lanes of requests without a separate pane of waiting requests, with all requests in a tab."""
MAX_LANE_ROWS: Final = 12
"""Visible rows of lanes in a pane, which scrolls beyond them."""
MAX_WAITING_ROWS: Final = 6
"""Rows of the pane of waiting requests; further requests are counted in the last row."""
MOST_ROWS: Final = ONE_PANE + 1, FOLDED + 1, MAX_WAITING_ROWS
"""Rows of devices, requests and waiting requests beyond which the layout does not change."""
FRAME: Final = 48
"""Height of a pane's title and axis, in pixels like all heights here."""
TITLE: Final = 34
"""Height of the title of a pane without an axis."""
ROW: Final = 41
"""Height of a lane with its label."""
NEXT_ROW: Final = 23
"""Height of a further row of a lane."""
BANNER: Final = 64
LOAD: Final = 200
"""Least height of the load pane: curves, axis and legend."""
LOAD_PART: Final = 0.3
"""Least height of the load pane as a share of the panes above."""
LEGEND: Final = 6
"""Most curves with a visible legend."""
BESIDE: Final = 4
"""Cameras side by side; further cameras get further pages."""


class Ahead(NamedTuple):
    """A chart of bookings."""

    entity: str
    name: str
    seconds: int
    """Seconds ahead of the present."""
    tick: int
    """Seconds between two labelled times."""


AHEAD: Final = (
    Ahead("/ahead/day", "Booked in the next 24 hours (UTC)", 86_400, 7_200),
    Ahead("/ahead/week", "In the next 7 days", 7 * 86_400, 86_400),
)
CHART_WIDTH: Final = 1_000.0
CHART_HEAD: Final = 26.0
"""Width of a chart and height of its line of times, in units of about a pixel."""
MAX_CHART_ROWS: Final = 12
"""Rows of a chart, without the row that counts the rest. The viewer shrinks charts that lack room, except texts."""


class RobotLayout(NamedTuple):
    """Content about robots and other devices, for which panes are made."""

    cameras: tuple[tuple[str, str], ...] = ()
    """Entity and title of each camera."""
    floor: tuple[int, int] | None = None
    """Width and height of the plan's picture, in pixels."""
    behavior_rows: int = 0
    devices: int = 0
    """Curves of devices' figures; numbers above LEGEND are equivalent."""

    @property
    def any(self) -> bool:
        return bool(self.cameras or self.floor or self.behavior_rows)


NO_ROBOTS: Final = RobotLayout()


class Layout(msgspec.Struct, frozen=True):
    """The content to lay out. `span`: start and end of a finished run, in seconds of the timeline; None for a live
    layout, whose window follows the newest data. `wall`: the timeline has wall-clock times. `rc_rows`, `arc_rows` and
    `host_rows`: rows expected in the upper panes, which share the height accordingly; 0 `host_rows`: no components; 0
    `waiting_rows`: no pane of waiting requests. `banner`: a text above all panes. `contended` and `absent`: rows by
    entity of devices that several requests want, and of absent ones; beyond ONE_PANE rows they get panes above and
    below the others. `ahead`: rows of the charts of bookings, 0 without. `past`: seconds before the start from
    journals, 0 without; `only_past`: entities of devices known only from these."""

    span: tuple[float, float] | None = None
    wall: bool = False
    rc_rows: int = 6
    contended: Mapping[str, int] = {}
    absent: Mapping[str, int] = {}
    arc_rows: int = 6
    waiting_rows: int = 0
    banner: str = ""
    host_rows: int = 0
    robots: RobotLayout = NO_ROBOTS
    ahead: int = 0
    past: float = 0.0
    only_past: tuple[str, ...] = ()


def blueprint(layout: Layout) -> rrb.Blueprint:
    """Lay out waiting requests, holders of devices and states of requests on one time axis, with events and loads
    beside them; with components also each host's components and their use, with the loads below. Then empty panes of
    devices or requests are left out. With robots, behaviors follow the requests, loads and hosts share a place, and
    floor and cameras are at the right, above the events."""
    span, robots, host_rows = layout.span, layout.robots, layout.host_rows
    axis = rrb.archetypes.TimeAxis(view_range=_window(span))
    behavior_rows = LIVE_BEHAVIOR_ROWS if span is None and robots.behavior_rows else robots.behavior_rows
    waiting = _waiting_pane(layout, axis)
    lanes = (
        waiting
        | _rc_panes(layout, axis)
        | _charts(layout.ahead)
        | {
            origin: (_share(rows), rrb.StateTimelineView(origin=origin, name=name, time_view=axis))
            for origin, name, rows, alone in (
                ("/requests", REQUESTS, 0 if waiting else layout.arc_rows, not host_rows and not waiting),
                ("/host", "Components on each host", host_rows, False),
                ("/behavior", "What each behavior is doing", behavior_rows if robots.any else 0, False),
            )
            if rows or alone
        }
    )
    load: rrb.View | rrb.Container = rrb.TimeSeriesView(
        origin="/",
        contents=["/load/**", "/mark/**"],
        name="Load average (1 min) per host" + (f"   {MARK_WORDS}" if host_rows else ""),
        axis_x=axis,
        plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop),
    )
    if robots.any and host_rows:
        load = rrb.Tabs(load, lanes.pop("/host")[1])
    height = sum(share for share, _ in lanes.values())
    time = WALL_TIME if layout.wall else TIME
    beside = _beside(axis, host_rows > 0, robots, time)
    if robots.any or host_rows:
        lanes["/load"] = max(LOAD, round(LOAD_PART * height)), load
    else:
        beside = rrb.Vertical(beside, load, row_shares=[7, 3])
    panes = rrb.Vertical(*(view for _, view in lanes.values()), row_shares=[share for share, _ in lanes.values()])
    root: rrb.Container = rrb.Horizontal(panes, beside, column_shares=[57, 43] if robots.any else [62, 38])
    if layout.banner:
        text = rrb.TextDocumentView(origin="/banner", name="Please note")
        root = rrb.Vertical(text, root, row_shares=[BANNER, max(height, 8 * BANNER)])
    return page(root, timeline=time)


def _waiting_pane(layout: Layout, axis: rrb.archetypes.TimeAxis) -> dict[str, tuple[int, rrb.View | rrb.Container]]:
    """The pane of waiting requests, with all requests in a tab; none if all requests have room."""
    if not layout.waiting_rows:
        return {}
    waiting = rrb.StateTimelineView(origin="/who", name="Who waits, and for whom", time_view=axis)
    every = rrb.StateTimelineView(origin="/requests", name=REQUESTS, time_view=axis)
    rows = min(max(layout.waiting_rows, 2), MAX_WAITING_ROWS)
    return {"/waiting": (FRAME + ROW + NEXT_ROW * (rows - 1), rrb.Tabs(waiting, every))}


def chart_row(rows: int) -> float:
    """Height of a chart's row; `rows`: rows of the tallest chart."""
    return 26.0 if rows <= 4 else 24.0


def _charts(rows: int) -> dict[str, tuple[int, rrb.View | rrb.Container]]:
    """The charts of bookings, as pages of one pane; none without rows."""
    bounds = rrb.VisualBounds2D(x_range=[0, CHART_WIDTH], y_range=[0, CHART_HEAD + chart_row(rows) * rows])
    views = [rrb.Spatial2DView(origin=chart.entity, name=chart.name, visual_bounds=bounds) for chart in AHEAD if rows]
    height = TITLE + round(CHART_HEAD + rows * chart_row(rows))
    return {"/ahead": (height, rrb.Tabs(*views))} if views else {}


def _rc_panes(layout: Layout, axis: rrb.archetypes.TimeAxis) -> dict[str, tuple[int, rrb.View | rrb.Container]]:
    """Views of devices with their share of the height, by title. A view sorts lanes by name: contended devices have
    their own above, high enough for all."""
    few = layout.rc_rows <= ONE_PANE
    contended, absent = ({}, {}) if few else (layout.contended, layout.absent)
    apart = {**contended, **absent}
    rest = layout.rc_rows - sum(apart.values())
    panes: dict[str, tuple[int, rrb.View | rrb.Container]] = {}
    without = [f"- {entity}" for entity in (*apart, *layout.only_past)]

    def add(name: str, rows: int, least: int, *contents: str) -> None:
        view: rrb.View | rrb.Container = rrb.StateTimelineView(
            origin="/devices", contents=contents or ["$origin/**", *without], name=name, time_view=axis
        )
        if layout.past and not panes:
            view = rrb.Tabs(view, _past(layout))
        panes[name] = _share(rows, least), view

    if contended:
        add("Devices that several want, and who holds them", 2 * sum(contended.values()), 2, *contended)
    if apart and rest > 0:
        add("Who holds each other device", rest, 2)
    elif not apart and (layout.rc_rows or not layout.host_rows):
        add("Who holds each device", rest, 3)
    if absent:
        add("Devices that are not there", sum(absent.values()), 2, *absent)
    return panes


def _past(layout: Layout) -> rrb.View:
    relative, absolute = rr.TimeRangeBoundary.cursor_relative, rr.TimeRangeBoundary.absolute
    if layout.span is None:
        window = rr.TimeRange(start=relative(seconds=-layout.past), end=relative(seconds=layout.past * MARGIN))
    else:
        begin, end = layout.span
        window = rr.TimeRange(
            start=absolute(seconds=begin - layout.past), end=absolute(seconds=end + layout.past * MARGIN)
        )
    name = f"With the {layout.past / 3600:.3g} h before   dark: from journals"
    return rrb.StateTimelineView(origin="/devices", name=name, time_view=rrb.archetypes.TimeAxis(view_range=window))


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


def _beside(axis: rrb.archetypes.TimeAxis, uses: bool, robots: RobotLayout, time: str) -> rrb.View | rrb.Container:
    """The panes at the right: floor, cameras, events and curves; with robots, events and curves are tabs."""

    def curves(origin: str, name: str, number: int = LEGEND + 1) -> rrb.View:
        # A long legend would cover the curves.
        legend = rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=number <= LEGEND)
        return rrb.TimeSeriesView(origin=origin, name=name, axis_x=axis, plot_legend=legend)

    columns = rrb.archetypes.TextLogColumns(timeline_columns=[time], text_log_columns=["loglevel", "body"])
    events = rrb.TextLogView(origin="/events", name="Events", columns=columns)
    presence = rrb.TextLogView(origin="/presence", name="Who comes and goes", columns=columns)
    below: list[rrb.View | rrb.Container] = [events, presence] if robots.any else [rrb.Tabs(events, presence)]
    if uses:
        # The titles of tabs have little room.
        more = ("", "") if robots.any else (" of the heaviest components", ", in the colours of the lanes")
        below.append(curves("/use/cpu", f"CPU{more[0]} (cores){more[1]}"))
        below.append(curves("/use/memory", f"Memory{more[0]} (MB)"))
    if robots.devices:
        pointed = " (point at a curve)" if robots.devices > LEGEND else ""
        below.append(curves("/device", f"Devices{pointed}", robots.devices))
    if not robots.any:
        return rrb.Vertical(*below, row_shares=[5, *[3] * (len(below) - 1)]) if len(below) > 1 else below[0]
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
    panes.append((6, rrb.Tabs(*below)))
    return rrb.Vertical(*(pane for _, pane in panes), row_shares=[share for share, _ in panes])


def _page_name(first: int, count: int) -> str:
    last = min(first + BESIDE, count)
    return f"Camera {last}" if last == first + 1 else f"Cameras {first + 1} to {last}"


def _window(span: tuple[float, float] | None) -> rr.TimeRange:
    if span is None:
        relative = rr.TimeRangeBoundary.cursor_relative
        return rr.TimeRange(start=relative(seconds=-LIVE_WINDOW), end=relative(seconds=2.0))
    begin, end = span
    # At least 1 s: an empty range would show nothing.
    length = max(end - begin, 1.0) * (1 + MARGIN)
    absolute = rr.TimeRangeBoundary.absolute
    return rr.TimeRange(start=absolute(seconds=begin), end=absolute(seconds=begin + length))


def _share(rows: int, least: int = 3) -> int:
    """Height of a pane of lanes."""
    return FRAME + ROW * min(max(rows, least), MAX_LANE_ROWS)

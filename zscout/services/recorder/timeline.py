"""Writes the activity of the mesh to Rerun: to a recording file, a live server for viewers, or both."""

from __future__ import annotations

import logging
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Final, Self

import rerun as rr

from zscout.config.strict import BadInput
from zscout.ports import free_port
from zscout.services.recorder.blueprint import (
    APPLICATION,
    FOLDED,
    LIVE_HOST_ROWS,
    LIVE_ROWS,
    MAX_CHART_ROWS,
    MAX_WAITING_ROWS,
    MOST_ROWS,
    Layout,
    blueprint,
)
from zscout.services.recorder.bookings import BookingTracker
from zscout.services.recorder.colours import ABSENT, OPERATOR, OTHER, PALETTE, STATES, faded
from zscout.services.recorder.drawing import (
    MAX_EVENT,
    Drawing,
    HolderRow,
    Lanes,
    clean_text,
    disconnect,
    unwritten,
    with_detail,
)
from zscout.services.recorder.finish import Job, finish
from zscout.services.recorder.hosts import HostTracker
from zscout.services.recorder.past import PastBar, PastLane
from zscout.services.recorder.robots import RobotTracker

log = logging.getLogger(__name__)

SERVER_MEMORY: Final = "200MB"
"""Memory of the live server for viewers that connect later; the oldest data is dropped first."""
MAX_ARCS: Final = 2000
MAX_RCS: Final = 1000
WAITING: Final = ("waiting", "waiting again", "preempted")
"""States of a request with a row in the pane of waiting requests."""
WAITING_STATES: Final = 128
RC_STATES: Final = 256
MAX_COLOURS: Final = 10_000
"""ARCs and components with a colour of their own."""
ARC_STATES: Final = 16
OPERATOR_MARK: Final = " (operator)"
"""Suffix of an operator's request in a device's lane."""
CONTENDED: Final = 300.0
"""Seconds for which an RC stays among the contended RCs of a live view after the last request for it waited."""
REGROUP: Final = 5.0
"""Least seconds between two changes of a live view's panes."""
ROWS_MORE: Final = 4
"""Rows by which the chart of bookings grows."""
PAST_MARK: Final = " (journal)"
"""Suffix of a journal's request in a device's lane."""
PAST_PART: Final = 0.4
"""Opacity of a bar from a journal."""
FILE_TICK: Final = 1.0
"""Seconds of data per chunk of a file. A complete file is rewritten in few, large chunks; after a kill it stays as it
is."""
LIVE_TICK: Final = 0.4
"""Seconds of data per chunk for live viewers: a delay that does not disturb."""
FLUSH_SECONDS: Final = 5.0
DISCONNECT_SECONDS: Final = 8.0


class TimelineError(BadInput):
    """The recording can't be written or served; the text is one line with fault, place and remedy."""


class Timeline(Drawing):
    """The Rerun side of a recorder. After `close` every call does nothing. `fleet` names the recording, together with
    the time of the start. `path`: the `.rrd` file, replaced if it exists. `port`: the live server's TCP port on the IP
    address `bind`, 0 for a free port. One of both is required. `wall`: the timeline has wall-clock times, once
    `start_clock` was called. Raises TimelineError if the port is taken or the file can't be written."""

    def __init__(
        self, fleet: str, *, path: Path | None, bind: str = "127.0.0.1", port: int | None = None, wall: bool = False
    ) -> None:
        super().__init__()
        self._fleet, self._wall = fleet, wall
        self.url: str | None = None
        """Address of the live server, for `rerun URL`."""
        self._path: Path | None = None
        self._live: rr.RecordingStream | None = None
        self._file: rr.RecordingStream | None = None
        self._arcs: set[str] = set()
        self._colours: dict[str, int] = {}
        """Colours of requests and components, in order of appearance."""
        self._namesakes: dict[str, str] = {}
        """The first request of each name, whose colour a component or booking of that name shares."""
        self._rc_lanes = Lanes(self, "devices", MAX_RCS, "devices: the others have no lane", colours=RC_STATES)
        self._arc_lanes = Lanes(self, "requests", MAX_ARCS, "requests: the others have no lane", colours=ARC_STATES)
        self._waiting_lane = Lanes(self, "who", 1, "", colours=WAITING_STATES, slots=MAX_WAITING_ROWS)
        self._waiting: dict[str, tuple[str, int]] = {}
        """Text and colour of each waiting request, in order of waiting time, the longest first."""
        self.hosts = HostTracker(self, self._colour_of)
        self.robots = RobotTracker(self)
        self.bookings = BookingTracker(self, self._colour_of)
        self._arranged: object = None
        self._banner = ""
        self._open_colours: dict[str, int] = {}
        """Colours of open requests."""
        self._contended: dict[str, float] = {}
        """By entity of an RC: the last time that a request waited for it."""
        self._absent: set[str] = set()
        self._grouped = -REGROUP
        """Time of the last grouping of RCs for the live view."""
        self._groups: tuple[tuple[str, ...], tuple[str, ...]] = (), ()
        self._rows: tuple[int, int, int] = 0, 0, 0
        """Rows of devices, requests and waiting requests in the live view's layout."""
        self._past, self._past_here = 0.0, False
        """Seconds of the past drawn from journals, and True if the present file has them."""
        if port is not None:
            port = _free_port(bind, port)
            host = f"[{bind}]" if ":" in bind else bind
            self.url = f"rerun+http://{host}:{port}/proxy"
            server = rr.GrpcServerSink(bind_ip=bind, port=port, server_memory_limit=SERVER_MEMORY)
            self._live = self._open(server, self.url, LIVE_TICK)
        if path is not None:
            try:
                self._file = self._open_file(path)
            except TimelineError:
                self._end()
                raise

    def _open_file(self, path: Path) -> rr.RecordingStream:
        try:
            path.open("ab").close()
        except OSError as error:
            raise TimelineError(
                f"can't write the recording {path} ({error.strerror}); "
                "give a file in an existing directory that can be written"
            ) from error
        # A footer needs memory for each chunk, as long as a fleet is recorded. `finish` adds it.
        stream = self._open(rr.FileSink(path, write_footer=not self._wall), str(path), FILE_TICK)
        self._path = path
        return stream

    def _open(self, sink: rr.GrpcServerSink | rr.FileSink, where: str, tick: float) -> rr.RecordingStream:
        start = datetime.now(UTC)
        stream = rr.RecordingStream(
            APPLICATION,
            recording_id=f"{self._fleet}-{start.strftime('%Y%m%dT%H%M%S.%fZ')}",
            batcher_config=rr.ChunkBatcherConfig(flush_tick=tick),
        )
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        try:
            stream.set_sinks(sink, default_blueprint=blueprint(Layout(wall=self._wall)))
            # The server starts in a thread of its own; only a flush shows its failure.
            stream.flush(timeout_sec=FLUSH_SECONDS)
        except (RuntimeError, ValueError) as error:
            disconnect(stream, DISCONNECT_SECONDS)
            raise TimelineError(f"can't write to {where} ({error}); make room there, or choose another") from error
        stream.send_recording_name(f"{self._fleet}, {start:%Y-%m-%d %H:%M:%S} UTC")
        stream.send_recording_start_time_nanos(round(start.timestamp() * 1e9))
        self.streams.append(stream)
        return stream

    def start_clock(self, epoch: float) -> None:
        """Set second 0 to `epoch`, as from `time.time()`. Does nothing on a timeline of durations."""
        if self._wall:
            self.epoch = epoch
            for stream in self.streams:
                stream.send_recording_start_time_nanos(round(epoch * 1e9))

    def roll(self, at: float, path: Path) -> Job | None:
        """Continue in another file, which starts with the present state. Return the job to finish the previous file;
        None: that was not written. Raises TimelineError, and changes nothing, if the new file can't be written."""
        before, old, layout = self._file, self._path, self.layout(live=False)
        if before is None or old is None or self.closed:
            return None
        self.pass_points()
        self._file = self._open_file(path)
        self.restate(self._file, at)
        self._file.send_blueprint(blueprint(self.layout(live=True)))
        self.streams.remove(before)
        self.begin = self.end = at
        self._past_here = False
        self._contended = {entity: since for entity, since in self._contended.items() if at - since <= CONTENDED}
        return Job(old, layout) if disconnect(before, DISCONNECT_SECONDS) else None

    def unwritten(self) -> str:
        """Why the file can't be written; empty if it can. Blocks until it has all logged data."""
        if self._file is None or self._path is None or self.closed:
            return ""
        return unwritten(self._file, self._path, FLUSH_SECONDS)

    def holders(self, at: float, rc: str, holders: Sequence[HolderRow], absent: str = "") -> None:
        """From `at` on, the device (`kind/name`) is held by exactly these requests. `absent`: the text for an absent
        device. Each holder gets a row with its request's name, and `OPERATOR_MARK` for an operator."""
        entity = self._rc_lanes.entity(rc)
        (self._absent.add if absent else self._absent.discard)(entity)
        shown: dict[str, tuple[str, int]] = {absent: (clean_text(absent), ABSENT)} if absent and not holders else {}
        for holder in holders:
            name = clean_text(holder.arc) + (OPERATOR_MARK if holder.operator else "")
            shown[name] = name, OPERATOR if holder.operator else self._colour(at, holder.arc)
        self._rc_lanes.show(at, rc, shown)

    def past(self, seconds: float, lanes: Mapping[str, PastLane]) -> None:
        """Draw the lanes of RCs for up to `seconds` before second 0, from journals."""
        if not lanes or self.closed:
            return
        for rc, changes in lanes.items():
            self._rc_lanes.past(rc, [(at, [self._past_bar(bar) for bar in bars]) for at, bars in changes])
        self._past, self._past_here = seconds, True
        self.arrange()

    def _past_bar(self, bar: PastBar | None) -> tuple[str, int]:
        if bar is None:
            return "", OTHER
        if not bar.arc:
            return "not known", ABSENT
        name = clean_text(bar.arc) + (OPERATOR_MARK if bar.operator else "") + PAST_MARK
        return name, faded(OPERATOR if bar.operator else self._colour_of(bar.arc), PAST_PART)

    def contended(self, at: float, rcs: Iterable[str]) -> None:
        """Requests wait for these RCs: they are shown first."""
        for entity in map(self._rc_lanes.entity, rcs):
            if entity in self._contended or len(self._contended) < MAX_RCS:
                self._contended[entity] = at

    def regroup(self, at: float) -> None:
        """Called regularly."""
        self.pass_points(at)
        if at - self._grouped >= REGROUP:
            self._grouped = at
            self._groups = self._grouped_rcs(at - CONTENDED)
            self._rows = self._rc_lanes.rows, self._arc_lanes.rows, self._waiting_lane.rows
            self.arrange()

    def _grouped_rcs(self, since: float) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Entities of RCs that requests have waited for since `since`, and of absent RCs."""
        there = self._rc_lanes.entities.keys() - self._absent
        contended = (entity for entity, at in self._contended.items() if at >= since and entity in there)
        return tuple(sorted(contended)), tuple(sorted(self._absent))

    def arc(self, at: float, arc: str, state: str, detail: str = "", *, operator: bool = False) -> None:
        """From `at` on, the request is in `state`: "waiting", "running", "preempted", "done" or another word. `arc`:
        its name, with the person in parentheses; the lane is then `person/name`. `detail`, such as why it waits, is
        added to the bar. An empty `state` ends the lane. An `operator`'s running request has an operator's colour."""
        own = self._colour(at, arc)
        if arc not in self._arcs:
            return
        self._open_colours[arc] = own
        if state in ("done", ""):
            del self._open_colours[arc]
        text = with_detail(state, detail)
        colour = (
            OPERATOR
            if operator and state == "running"
            else STATES.get("preempted" if state == "waiting again" else state, OTHER)
        )
        name, _, person = arc.removesuffix(")").partition(" (")
        self._arc_lanes.show(at, f"{person}/{name}" if person else arc, {text: (text, colour)})
        if state in WAITING:
            words = clean_text(f"{arc} {state.replace('waiting', 'waits')} {detail}")
            self._waiting[arc] = words, own if state == "waiting" else colour
        elif self._waiting.pop(arc, None) is None:
            return
        self._waiting_lane.show(at, "waits", self._waiting)

    def banner(self, text: str) -> None:
        """Show `text` above all panes of the live view; remove it if empty."""
        if text != self._banner and not self.closed:
            self._banner = text
            self.log(None, "banner", rr.TextDocument(clean_text(text, MAX_EVENT)))
            self.arrange()

    def close(self) -> None:
        """End file and server within seconds; the file opens on the whole run. Raises TimelineError if incomplete."""
        if self.closed:
            return
        self.closed = True
        layout = self.layout(live=False)
        if layout.span is not None:
            for stream in self.streams:
                stream.send_blueprint(blueprint(layout))
        ended = False
        try:
            self.flush(FLUSH_SECONDS)
        except (RuntimeError, ValueError) as error:
            raise TimelineError(
                f"the end of the recording {self._path or self.url} may be missing ({error}); "
                "is there room on the disk?"
            ) from error
        finally:
            ended = self._end()
        if ended and self._path is not None and self._path.is_file():
            try:
                self._finish(self._path, layout)
            except (OSError, RuntimeError, ValueError) as error:
                log.warning("the recording %s stays as it was written, and opens slowly: %s", self._path, error)

    def _finish(self, path: Path, layout: Layout) -> None:
        finish(path, layout)

    def _end(self) -> bool:
        """Disconnect all; return True if the file was written completely. A hanging viewer delays only the server."""
        ended = {id(stream): disconnect(stream, DISCONNECT_SECONDS) for stream in reversed(self.streams)}
        return ended.get(id(self._file), False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def arrange(self) -> None:
        """Send a new layout if there is something new to show: panes without content are left out."""
        robots = self.robots.shown
        robots = robots._replace(behavior_rows=min(robots.behavior_rows, 1))
        rows = tuple(min(count, most) for count, most in zip(self._rows, MOST_ROWS, strict=True))
        past = self._past, self._rc_lanes.only_past
        now = self.hosts.placing, robots, self._ahead_rows(), past, self._groups, rows, self._banner
        if now != self._arranged and not self.closed:
            self._arranged = now
            layout = blueprint(self.layout(live=True))
            for stream in self.streams:
                stream.send_blueprint(layout)

    def layout(self, *, live: bool) -> Layout:
        """The layout for the present content; panes of a live view may still be empty."""
        robots = self.robots.shown
        rc_rows, arc_rows, host_rows = (lanes.rows for lanes in (self._rc_lanes, self._arc_lanes, self.hosts.lanes))
        if live:
            least = LIVE_ROWS if robots.any else 1
            rc_rows, arc_rows, host_rows = max(rc_rows, least), max(arc_rows, least), LIVE_HOST_ROWS
        rows, zero = self._rc_lanes.entities, self.epoch or 0.0
        contended, absent = self._groups if live else self._grouped_rcs(self.begin)
        waiting_rows = self._waiting_lane.rows if arc_rows > FOLDED else 0
        return Layout(
            span=None if live or self.end < self.begin else (zero + self.begin, zero + self.end),
            wall=self._wall,
            rc_rows=self._rc_lanes.rows if contended or absent else rc_rows,
            contended={entity: rows[entity] for entity in contended},
            absent={entity: rows[entity] for entity in absent if entity in rows},
            arc_rows=arc_rows,
            waiting_rows=waiting_rows,
            banner=self._banner if live else "",
            host_rows=host_rows if self.hosts.placing else 0,
            robots=robots,
            ahead=self._ahead_rows(),
            past=self._past if live or self._past_here else 0.0,
            only_past=self._rc_lanes.only_past,
        )

    def _ahead_rows(self) -> int:
        """Rows of the chart, rounded up: each new layout undoes people's own changes of it."""
        return min(-(-self.bookings.rows // ROWS_MORE) * ROWS_MORE, MAX_CHART_ROWS + 1)

    def _colour(self, at: float, arc: str) -> int:
        others = "names of requests: the others have no lane and no colour of their own"
        if arc not in self._arcs and not self.room(at, self._arcs, MAX_ARCS, others):
            return OTHER
        self._arcs.add(arc)
        return self._colour_of(arc)

    def _colour_of(self, arc: str) -> int:
        """A component or booking shares the colour of the first request of its name. A new name gets the next colour
        among those that the fewest open requests have."""
        name = arc.partition(" (")[0]
        if self._namesakes.get(name, name) == name and len(self._namesakes) < MAX_COLOURS:
            self._namesakes[name] = arc
        key = name if arc == self._namesakes.get(name) else arc
        if key not in self._colours:
            if len(self._colours) >= MAX_COLOURS:
                return OTHER
            taken = Counter(self._open_colours.values())
            after = len(self._colours) % len(PALETTE)
            self._colours[key] = min(PALETTE[after:] + PALETTE[:after], key=lambda colour: taken[colour])
        return self._colours[key]


def _free_port(bind: str, port: int) -> int:
    """Check address and port first: Rerun would only report that its thread ended."""
    try:
        return free_port(bind, port)
    except OSError as error:
        raise TimelineError(
            f"can't listen on {bind}, port {port} ({os.strerror(error.errno or 0)}); "
            "choose another port, or stop the program that uses it"
        ) from error

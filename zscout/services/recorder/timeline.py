"""Writes what the mesh shows to Rerun: a recording file, a live server for viewers, or both."""

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
"""What the live server keeps for viewers that come late; the oldest goes first."""
MAX_ARCS: Final = 2000
MAX_RCS: Final = 1000
WAITING: Final = ("waiting", "waiting again", "preempted")
"""States of a request that has a row in the pane of those who wait."""
WAITING_STATES: Final = 128
RC_STATES: Final = 256
MAX_COLOURS: Final = 10_000
"""ARCs and components that have a colour of their own."""
ARC_STATES: Final = 16
OPERATOR_MARK: Final = " (operator)"
"""Follows the name of the request in a device's lane where an operator holds it."""
CONTENDED: Final = 300.0
"""Seconds for which an RC for which nobody waits any more stands among the contended ones of a live view."""
REGROUP: Final = 5.0
"""Least time between two changes of a live view's panes, in seconds."""
ROWS_MORE: Final = 4
"""The chart of bookings grows by so many rows."""
PAST_MARK: Final = " (journal)"
"""Follows the name of the request in a device's lane where a journal reported it."""
PAST_PART: Final = 0.4
"""Of a colour that is left then."""
FILE_TICK: Final = 1.0
"""Seconds for which a file gathers what it writes: a file that is written to its end is made of few, large chunks
only then, and one whose recorder was killed stays as it is."""
LIVE_TICK: Final = 0.4
"""The same for viewers that look on: for as long as nobody minds."""
FLUSH_SECONDS: Final = 5.0
DISCONNECT_SECONDS: Final = 8.0


class TimelineError(BadInput):
    """The recording can't be written or served: one line that says what, where and how to mend it."""


class Timeline(Drawing):
    """The Rerun side of a recorder. After `close` every call does nothing.

    `fleet` names the recording, together with the time of the start. `path`: the `.rrd` file, replaced if it is there,
    or None. `port`: the live server's TCP port on the IP address `bind`, 0 for a free one, or None for no server; one
    of file and server there must be. `wall`: the timeline has wall-clock times, once `start_clock` was called. Raises
    TimelineError if the port is taken or the file can't be written."""

    def __init__(
        self, fleet: str, *, path: Path | None, bind: str = "127.0.0.1", port: int | None = None, wall: bool = False
    ) -> None:
        super().__init__()
        self._fleet, self._wall = fleet, wall
        self.url: str | None = None
        """Where a viewer finds the live server: `rerun URL`."""
        self._path: Path | None = None
        self._live: rr.RecordingStream | None = None
        self._file: rr.RecordingStream | None = None
        self._arcs: set[str] = set()
        self._colours: dict[str, int] = {}
        """Of requests and components, in order of appearance."""
        self._namesakes: dict[str, str] = {}
        """The first request of each name: a component or booking of that name has the same colour."""
        self._rc_lanes = Lanes(self, "devices", MAX_RCS, "devices: the others have no lane", colours=RC_STATES)
        self._arc_lanes = Lanes(self, "requests", MAX_ARCS, "requests: the others have no lane", colours=ARC_STATES)
        self._waiting_lane = Lanes(self, "who", 1, "", colours=WAITING_STATES, slots=MAX_WAITING_ROWS)
        self._waiting: dict[str, tuple[str, int]] = {}
        """Text and colour of each request that waits, the one that has waited longest first."""
        self.hosts = HostTracker(self, self._colour_of)
        self.robots = RobotTracker(self)
        self.bookings = BookingTracker(self, self._colour_of)
        self._arranged: object = None
        self._banner = ""
        self._open_colours: dict[str, int] = {}
        """Of requests that wait or run."""
        self._contended: dict[str, float] = {}
        """When somebody waited last for an RC, by entity."""
        self._absent: set[str] = set()
        self._grouped = -REGROUP
        """When RCs were grouped last for the live view."""
        self._groups: tuple[tuple[str, ...], tuple[str, ...]] = (), ()
        self._rows: tuple[int, int, int] = 0, 0, 0
        """Rows of devices, requests and those who wait, as the live view has room for."""
        self._past, self._past_here = 0.0, False
        """Seconds of the past that journals told of; and whether the present file has them."""
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
                "give a file in a directory that is there and can be written"
            ) from error
        # A footer needs memory for each chunk, for as long as a fleet is recorded. The finished file has one.
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
            # The server comes up in a thread of its own; only a flush shows its failure.
            stream.flush(timeout_sec=FLUSH_SECONDS)
        except (RuntimeError, ValueError) as error:
            disconnect(stream, DISCONNECT_SECONDS)
            raise TimelineError(f"can't write to {where} ({error}); make room there, or choose another") from error
        stream.send_recording_name(f"{self._fleet}, {start:%Y-%m-%d %H:%M:%S} UTC")
        stream.send_recording_start_time_nanos(round(start.timestamp() * 1e9))
        self.streams.append(stream)
        return stream

    def start_clock(self, epoch: float) -> None:
        """Second 0 is `epoch`, as `time.time()` has it. Nothing where the timeline has durations."""
        if self._wall:
            self.epoch = epoch
            for stream in self.streams:
                stream.send_recording_start_time_nanos(round(epoch * 1e9))

    def roll(self, at: float, path: Path) -> Job | None:
        """Goes on in another file, which begins with what is shown now; returns what there is to finish, if the file
        before it could be written. Raises TimelineError where the new one can't be: then all stays as it is."""
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
        """Why the file can't be written, empty while it can. Blocks until it has what was logged."""
        if self._file is None or self._path is None or self.closed:
            return ""
        return unwritten(self._file, self._path, FLUSH_SECONDS)

    def holders(self, at: float, rc: str, holders: Sequence[HolderRow], absent: str = "") -> None:
        """From `at` on, the device (`kind/name`) is held by exactly these requests; by nobody if empty. `absent`: the
        words for a device that is not there.

        Several holders get a row each. A row reads the request's name, with `OPERATOR_MARK` for an operator's."""
        entity = self._rc_lanes.entity(rc)
        (self._absent.add if absent else self._absent.discard)(entity)
        shown: dict[str, tuple[str, int]] = {absent: (clean_text(absent), ABSENT)} if absent and not holders else {}
        for holder in holders:
            name = clean_text(holder.arc) + (OPERATOR_MARK if holder.operator else "")
            shown[name] = name, OPERATOR if holder.operator else self._colour(at, holder.arc)
        self._rc_lanes.show(at, rc, shown)

    def past(self, seconds: float, lanes: Mapping[str, PastLane]) -> None:
        """What RCs showed before second 0, as journals tell, for up to so many seconds."""
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
        """Somebody waits for these RCs: they are shown first."""
        for entity in map(self._rc_lanes.entity, rcs):
            if entity in self._contended or len(self._contended) < MAX_RCS:
                self._contended[entity] = at

    def regroup(self, at: float) -> None:
        """What time alone brings: call it now and then."""
        self.pass_points(at)
        if at - self._grouped >= REGROUP:
            self._grouped = at
            self._groups = self._grouped_rcs(at - CONTENDED)
            self._rows = self._rc_lanes.rows, self._arc_lanes.rows, self._waiting_lane.rows
            self.arrange()

    def _grouped_rcs(self, since: float) -> tuple[tuple[str, ...], tuple[str, ...]]:
        """Entities of RCs that somebody has waited for since then, and of those that are not there."""
        there = self._rc_lanes.entities.keys() - self._absent
        contended = (entity for entity, at in self._contended.items() if at >= since and entity in there)
        return tuple(sorted(contended)), tuple(sorted(self._absent))

    def arc(self, at: float, arc: str, state: str, detail: str = "", *, operator: bool = False) -> None:
        """From `at` on, the request is in `state`: "waiting", "running", "preempted", "done" or another word.

        `arc` is its name, with the person behind it in parentheses: the lane is then `person/name`. `detail` says more
        in the same bar, such as why it waits. An empty `state` ends the lane. What an `operator` runs has an operator's
        colour."""
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
        """Shows `text` above all panes of the live view; nothing if it is empty."""
        if text != self._banner and not self.closed:
            self._banner = text
            self.log(None, "banner", rr.TextDocument(clean_text(text, MAX_EVENT)))
            self.arrange()

    def close(self) -> None:
        """Ends file and server, within seconds. The file then opens on the whole run.

        Raises TimelineError if not everything could be written."""
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
        """What is done with a file that is over."""
        finish(path, layout)

    def _end(self) -> bool:
        """Whether the file was written to its end; a viewer that hangs holds up the server alone."""
        ended = {id(stream): disconnect(stream, DISCONNECT_SECONDS) for stream in reversed(self.streams)}
        return ended.get(id(self._file), False)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def arrange(self) -> None:
        """Lays the viewer out anew if there is something new to show: a fleet without robots, figures or components
        has no use for empty panes."""
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
        """Panes for what there is; those of a live view may fill yet."""
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
        """A few more than there are: a layout that is sent anew undoes what people have changed of it."""
        return min(-(-self.bookings.rows // ROWS_MORE) * ROWS_MORE, MAX_CHART_ROWS + 1)

    def _colour(self, at: float, arc: str) -> int:
        others = "names of requests: the others have no lane and no colour of their own"
        if arc not in self._arcs and not self.room(at, self._arcs, MAX_ARCS, others):
            return OTHER
        self._arcs.add(arc)
        return self._colour_of(arc)

    def _colour_of(self, arc: str) -> int:
        """The first request of a name shares its colour with a component or booking of that name. A new one gets the
        next colour that the fewest open requests have."""
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
    """Checks address and port first: of a failure Rerun itself reports only that its thread ended."""
    try:
        return free_port(bind, port)
    except OSError as error:
        raise TimelineError(
            f"can't listen on {bind}, port {port} ({os.strerror(error.errno or 0)}); "
            "choose another port, or end the program that has it"
        ) from error

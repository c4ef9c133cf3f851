"""Writes what the mesh shows to Rerun: a recording file, a live server for viewers, or both.

Everything stands on one timeline, as a duration in seconds; the zero is the caller's. Names come from
the mesh, so lanes, names and texts are bounded here, and a name that Rerun would read as a path is cleaned.
"""

from __future__ import annotations

import ipaddress
import math
import os
import socket
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Final, NamedTuple

import rerun as rr
import rerun.blueprint as rrb

from zscout.config.strict import BadInput
from zscout.services.recorder.blueprint import APPLICATION, LIVE_HOST_ROWS, LIVE_ROWS, TIME, blueprint
from zscout.services.recorder.colours import OPERATOR, OTHER, PALETTE, STATES
from zscout.services.recorder.host_pane import (
    HostPane,
    Mark,
    Running,
    Use,
)
from zscout.services.recorder.lanes import (
    Lane,
    clean_path,
    clean_text,
    rows_of,
    written,
)
from zscout.services.recorder.robot_panes import RobotPanes

SERVER_MEMORY: Final = "200MB"
"""What the live server keeps for viewers that come late; the oldest goes first."""
MAX_ARCS: Final = 2000
MAX_RCS: Final = 1000
MAX_COMPONENTS: Final = 10_000
"""Components that have a colour of their own."""
RC_STATES: Final = 256
ARC_STATES: Final = 16
"""Distinct texts of one lane that keep their colour; past it, the one longest unused loses it."""
MAX_EVENT: Final = 500
"""Characters."""
MAX_SECONDS: Final = 9e9
"""Rerun counts nanoseconds in 64 bits."""
OPERATOR_MARK: Final = " (operator)"
"""Follows the ARC's name in an RC's lane where an operator holds it."""
LEVELS: Final = frozenset({"CRITICAL", "ERROR", "WARN", "INFO", "DEBUG", "TRACE"})
FLUSH_SECONDS: Final = 5.0
DISCONNECT_SECONDS: Final = 8.0


class TimelineError(BadInput):
    """The recording can't be written or served: one line that says what, where and how to mend it."""


class HolderRow(NamedTuple):
    """An ARC that holds an RC; `operator` if its priority is an operator's."""

    arc: str
    operator: bool = False


class Timeline:
    """The Rerun side of a recorder. Safe to call from any thread; after `close` every call does nothing.

    `fleet` names the recording, together with the time of the start. `path`: the `.rrd` file, replaced if it
    is there, or None. `port`: the live server's TCP port on the address `bind`, 0 for a free one, or None for
    no server. Raises TimelineError if the port is taken or the file can't be written.

    `at` is seconds, of a size below `MAX_SECONDS`; any other number is a ValueError.
    """

    def __init__(
        self, fleet: str, *, path: Path | None, bind: str = "127.0.0.1", port: int | None = None
    ) -> None:
        if path is None and port is None:
            raise TimelineError("timeline: neither a file nor a port is given; name one, or both")
        self.url: str | None = None
        """Where a viewer finds the live server: `rerun URL`."""
        self._path = path
        self._lock = threading.RLock()
        self._closed = False
        self._arcs: dict[str, int] = {}
        self._arc_lanes: dict[str, Lane] = {}
        self._rc_lanes: dict[str, Lane] = {}
        self._noted: set[str] = set()
        self._begin, self._end = math.inf, -math.inf
        start = datetime.now(UTC)
        self._recording = rr.RecordingStream(
            APPLICATION, recording_id=f"{fleet}-{start.strftime('%Y%m%dT%H%M%S.%fZ')}"
        )
        self._hosts = HostPane(self._recording, self._note, self._component_colour)
        self._components: dict[str, int] = {}
        self._coloured = 0
        self._placing = False
        self.robots = RobotPanes(self._recording, self.writing, self._note, self._arrange)
        """What is shown of robots."""
        self._recording.set_log_time_enabled(False)
        self._recording.set_log_tick_enabled(False)
        self._open(path, bind, port)
        self._recording.send_recording_name(f"{fleet}, {start:%Y-%m-%d %H:%M:%S} UTC")
        self._recording.send_recording_start_time_nanos(int(start.timestamp() * 1e9))

    def _open(self, path: Path | None, bind: str, port: int | None) -> None:
        sinks: list[rr.GrpcServerSink | rr.FileSink] = []
        if port is not None:
            port = _free_port(bind, port)
            host = f"[{bind}]" if ":" in bind else bind
            self.url = f"rerun+http://{host}:{port}/proxy"
            sinks.append(rr.GrpcServerSink(bind_ip=bind, port=port, server_memory_limit=SERVER_MEMORY))
        if path is not None:
            _check_writable(path)
            sinks.append(rr.FileSink(path))
        try:
            self._recording.set_sinks(*sinks, default_blueprint=blueprint(live=True))
            # The server comes up in a thread of its own; only a flush shows its failure.
            self._recording.flush(timeout_sec=FLUSH_SECONDS)
        except (RuntimeError, ValueError) as error:
            self._disconnect()
            raise TimelineError(
                f"timeline: can't write to {path or self.url} ({error}); make room there, or choose another"
            ) from error

    @written
    def holders(self, at: float, rc: str, holders: Sequence[HolderRow]) -> None:
        """From `at` on, the RC (`kind/name`) is held by exactly these ARCs; by nobody if empty.

        Several holders get a row each. A row reads the ARC's name, with `OPERATOR_MARK` for an operator's."""
        if rc not in self._rc_lanes and len(self._rc_lanes) >= MAX_RCS:
            self._note(at, f"more than {MAX_RCS} RCs: the others have no lane")
            return
        lane = self._rc_lanes.setdefault(rc, Lane(clean_path("rc", rc), RC_STATES))
        colours: dict[str, int] = {"": OTHER}
        for holder in holders:
            name = clean_text(holder.arc) + (OPERATOR_MARK if holder.operator else "")
            colours[name] = OPERATOR if holder.operator else self._colour(at, holder.arc)
        rows = lane.seat([name for name in colours if name])
        lane.show(self._recording, [(row, colours.get(row, OTHER)) for row in rows])

    @written
    def arc(self, at: float, arc: str, state: str, detail: str = "") -> None:
        """From `at` on, the ARC is in `state`: "waiting", "running", "preempted", "done" or another word.

        `detail` says more in the same bar, as why it waits. An empty `state` ends the lane."""
        self._colour(at, arc)
        if arc not in self._arcs:
            return
        lane = self._arc_lanes.setdefault(arc, Lane(clean_path("arc", arc), ARC_STATES))
        text = clean_text(f"{state} · {detail}" if state and detail else state)
        lane.show(self._recording, [(text, STATES.get(state, OTHER))])

    @written
    def load(self, at: float, host: str, load1: float, cpu: float | None = None) -> None:
        """A host's load average over 1 minute and, kept under `/cpu`, its CPU use (0 to 1).

        What is not a finite number leaves a gap."""
        self._hosts.load(at, host, load1, cpu)

    @written
    def runs(self, at: float, host: str, components: Sequence[Running]) -> None:
        """From `at` on, exactly these components are on the host; none if empty. Each gets a row."""
        if not self._placing:
            # Only now: a fleet without components has no use for empty panes.
            self._placing = True
            self._arrange()
        self._hosts.runs(at, host, components)

    @written
    def mark(self, at: float, host: str, mark: Mark, component: str) -> None:
        """Marks on the host's load curve what happened to a component there."""
        self._hosts.mark(at, host, mark, component)

    @written
    def uses(self, at: float, host: str, uses: Sequence[Use]) -> None:
        """What all components of a host use; the curve of one that is not named ends."""
        self._hosts.uses(at, host, uses)

    @written
    def event(self, at: float, text: str, level: str = "INFO") -> None:
        """One line in words; `level` as in logging, WARN for what people should look at."""
        known = level if level in LEVELS else "INFO"
        self._recording.log("events", rr.TextLog(clean_text(text, MAX_EVENT), level=known))

    def close(self) -> None:
        """Ends file and server, within seconds. The file then opens on the whole run.

        Raises TimelineError if not everything could be written."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
        if self._end >= self._begin:
            self._recording.send_blueprint(self._layout(live=False))
        try:
            self._recording.flush(timeout_sec=FLUSH_SECONDS)
        except (RuntimeError, ValueError) as error:
            raise TimelineError(
                f"timeline: the end of the recording {self._path or self.url} may be missing ({error}); "
                "is there room on the disk?"
            ) from error
        finally:
            self._disconnect()

    def _layout(self, *, live: bool) -> rrb.Blueprint:
        """Panes for what there is; those of a live view may fill yet."""
        rc_rows, arc_rows, host_rows = rows_of(self._rc_lanes), len(self._arc_lanes), self._hosts.rows
        if live:
            least = LIVE_ROWS if self.robots.shown.any else 1
            rc_rows, arc_rows, host_rows = max(rc_rows, least), max(arc_rows, least), LIVE_HOST_ROWS
        return blueprint(
            live,
            self._end,
            begin=self._begin,
            rc_rows=rc_rows,
            arc_rows=arc_rows,
            host_rows=host_rows if self._placing else 0,
            robots=self.robots.shown,
        )

    def _arrange(self) -> None:
        self._recording.send_blueprint(self._layout(live=True))

    @contextmanager
    def writing(self, at: float) -> Iterator[bool]:
        """Sets the time for what this thread logs meanwhile; yields False after `close`."""
        if not abs(at) < MAX_SECONDS:
            raise ValueError(f"timeline: {at} is no time in seconds; give a number below {MAX_SECONDS:g}")
        with self._lock:
            if not self._closed:
                self._begin, self._end = min(self._begin, at), max(self._end, at)
                self._recording.set_time(TIME, duration=at)
            yield not self._closed

    def __enter__(self) -> Timeline:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _disconnect(self) -> None:
        # A viewer that hangs can hold this up: then it is left to a thread that dies with the process.
        thread = threading.Thread(target=self._recording.disconnect, name="rerun-disconnect", daemon=True)
        thread.start()
        thread.join(DISCONNECT_SECONDS)

    def _colour(self, at: float, arc: str) -> int:
        """The ARC's colour, by order of appearance."""
        if arc not in self._arcs:
            if len(self._arcs) >= MAX_ARCS:
                self._note(
                    at, f"more than {MAX_ARCS} ARC names: the others have no lane and no colour of their own"
                )
                return OTHER
            self._arcs[arc] = self._components.get(arc) or self._next_colour()
        return self._arcs[arc]

    def _component_colour(self, component: str) -> int:
        """That of the ARC with this name, if there is one."""
        if component in self._arcs:
            return self._arcs[component]
        if component not in self._components:
            if len(self._components) >= MAX_COMPONENTS:
                return OTHER
            self._components[component] = self._next_colour()
        return self._components[component]

    def _next_colour(self) -> int:
        self._coloured += 1
        return PALETTE[(self._coloured - 1) % len(PALETTE)]

    def _note(self, at: float, text: str) -> None:
        if text not in self._noted:
            self._noted.add(text)
            self.event(at, f"timeline: {text}", "WARN")


def _free_port(bind: str, port: int) -> int:
    """Checks address and port first: Rerun itself says only that its thread ended."""
    try:
        address = ipaddress.ip_address(bind)
    except ValueError as error:
        raise TimelineError(
            f"timeline: bind = {bind!r} is not an IP address; use 127.0.0.1, or 0.0.0.0 for all networks"
        ) from error
    if not 0 <= port <= 65535:
        raise TimelineError(f"timeline: port {port} is not one of 0 to 65535; 9876 is Rerun's own")
    family = socket.AF_INET6 if address.version == 6 else socket.AF_INET
    try:
        with socket.create_server((bind, port), family=family) as server:
            return int(server.getsockname()[1])
    except OSError as error:
        raise TimelineError(
            f"timeline: can't listen on {bind}, port {port} ({os.strerror(error.errno or 0)}); "
            "choose another port, or end the program that has it"
        ) from error


def _check_writable(path: Path) -> None:
    try:
        with path.open("ab"):
            pass
    except OSError as error:
        raise TimelineError(
            f"timeline: can't write the recording {path} ({error.strerror}); "
            "give a file in a directory that is there and can be written"
        ) from error

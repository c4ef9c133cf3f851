"""Writes what the mesh shows to Rerun: a recording file, a live server for viewers, or both."""

from __future__ import annotations

import os
import socket
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import rerun as rr
import rerun.blueprint as rrb

from zscout.config.strict import BadInput
from zscout.services.recorder.blueprint import APPLICATION, LIVE_HOST_ROWS, LIVE_ROWS, NO_ROBOTS, blueprint
from zscout.services.recorder.colours import OPERATOR, OTHER, PALETTE, STATES
from zscout.services.recorder.drawing import Drawing, HolderRow, Lanes, clean_text, with_detail
from zscout.services.recorder.hosts import HostTracker
from zscout.services.recorder.robots import RobotTracker

SERVER_MEMORY: Final = "200MB"
"""What the live server keeps for viewers that come late; the oldest goes first."""
MAX_ARCS: Final = 2000
MAX_RCS: Final = 1000
RC_STATES: Final = 256
MAX_COLOURS: Final = 10_000
"""ARCs and components that have a colour of their own."""
ARC_STATES: Final = 16
OPERATOR_MARK: Final = " (operator)"
"""Follows the ARC's name in an RC's lane where an operator holds it."""
FLUSH_SECONDS: Final = 5.0
DISCONNECT_SECONDS: Final = 8.0


class TimelineError(BadInput):
    """The recording can't be written or served: one line that says what, where and how to mend it."""


class Timeline(Drawing):
    """The Rerun side of a recorder. After `close` every call does nothing.

    `fleet` names the recording, together with the time of the start. `path`: the `.rrd` file, replaced if it is there,
    or None. `port`: the live server's TCP port on the IP address `bind`, 0 for a free one, or None for no server; one
    of file and server there must be. Raises TimelineError if the port is taken or the file can't be written."""

    def __init__(self, fleet: str, *, path: Path | None, bind: str = "127.0.0.1", port: int | None = None) -> None:
        start = datetime.now(UTC)
        super().__init__(rr.RecordingStream(APPLICATION, recording_id=f"{fleet}-{start.strftime('%Y%m%dT%H%M%S.%fZ')}"))
        self.url: str | None = None
        """Where a viewer finds the live server: `rerun URL`."""
        self._path = path
        self._arcs: set[str] = set()
        self._colours: dict[str, int] = {}
        """Of ARCs and components, by order of appearance: a component has that of the ARC with its name."""
        self._rc_lanes = Lanes(self, "rc", MAX_RCS, "RCs: the others have no lane", colours=RC_STATES)
        self._arc_lanes = Lanes(self, "arc", MAX_ARCS, "ARCs: the others have no lane", colours=ARC_STATES)
        self.hosts = HostTracker(self, self._colour_of)
        self.robots = RobotTracker(self)
        self._arranged: object = (False, NO_ROBOTS)
        self.recording.set_log_time_enabled(False)
        self.recording.set_log_tick_enabled(False)
        self._open(path, bind, port)
        self.recording.send_recording_name(f"{fleet}, {start:%Y-%m-%d %H:%M:%S} UTC")
        self.recording.send_recording_start_time_nanos(int(start.timestamp() * 1e9))

    def _open(self, path: Path | None, bind: str, port: int | None) -> None:
        sinks: list[rr.GrpcServerSink | rr.FileSink] = []
        if port is not None:
            port = _free_port(bind, port)
            host = f"[{bind}]" if ":" in bind else bind
            self.url = f"rerun+http://{host}:{port}/proxy"
            sinks.append(rr.GrpcServerSink(bind_ip=bind, port=port, server_memory_limit=SERVER_MEMORY))
        if path is not None:
            try:
                path.open("ab").close()
            except OSError as error:
                raise TimelineError(
                    f"timeline: can't write the recording {path} ({error.strerror}); "
                    "give a file in a directory that is there and can be written"
                ) from error
            sinks.append(rr.FileSink(path))
        try:
            self.recording.set_sinks(*sinks, default_blueprint=blueprint())
            # The server comes up in a thread of its own; only a flush shows its failure.
            self.recording.flush(timeout_sec=FLUSH_SECONDS)
        except (RuntimeError, ValueError) as error:
            self.disconnect(DISCONNECT_SECONDS)
            raise TimelineError(
                f"timeline: can't write to {path or self.url} ({error}); make room there, or choose another"
            ) from error

    def holders(self, at: float, rc: str, holders: Sequence[HolderRow]) -> None:
        """From `at` on, the RC (`kind/name`) is held by exactly these ARCs; by nobody if empty.

        Several holders get a row each. A row reads the ARC's name, with `OPERATOR_MARK` for an operator's."""
        shown: dict[str, tuple[str, int]] = {}
        for holder in holders:
            name = clean_text(holder.arc) + (OPERATOR_MARK if holder.operator else "")
            shown[name] = name, OPERATOR if holder.operator else self._colour(at, holder.arc)
        self._rc_lanes.show(at, rc, shown)

    def arc(self, at: float, arc: str, state: str, detail: str = "") -> None:
        """From `at` on, the ARC is in `state`: "waiting", "running", "preempted", "done" or another word.

        `detail` says more in the same bar, as why it waits. An empty `state` ends the lane."""
        self._colour(at, arc)
        if arc in self._arcs:
            text = with_detail(state, detail)
            self._arc_lanes.show(at, arc, {text: (text, STATES.get(state, OTHER))})

    def close(self) -> None:
        """Ends file and server, within seconds. The file then opens on the whole run.

        Raises TimelineError if not everything could be written."""
        if self.closed:
            return
        self.closed = True
        if self.end >= self.begin:
            self.recording.send_blueprint(self._layout(live=False))
        try:
            self.recording.flush(timeout_sec=FLUSH_SECONDS)
        except (RuntimeError, ValueError) as error:
            raise TimelineError(
                f"timeline: the end of the recording {self._path or self.url} may be missing ({error}); "
                "is there room on the disk?"
            ) from error
        finally:
            self.disconnect(DISCONNECT_SECONDS)

    def __enter__(self) -> Timeline:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def arrange(self) -> None:
        """Lays the viewer out anew if there is something new to show: a fleet without robots or components
        has no use for empty panes."""
        robots = self.robots.shown
        robots = robots._replace(behavior_rows=min(robots.behavior_rows, 1)) if robots.any else NO_ROBOTS
        now = self.hosts.placing, robots
        if now != self._arranged and not self.closed:
            self._arranged = now
            self.recording.send_blueprint(self._layout(live=True))

    def _layout(self, *, live: bool) -> rrb.Blueprint:
        """Panes for what there is; those of a live view may fill yet."""
        robots = self.robots.shown
        rc_rows, arc_rows, host_rows = (lanes.rows for lanes in (self._rc_lanes, self._arc_lanes, self.hosts.lanes))
        if live:
            least = LIVE_ROWS if robots.any else 1
            rc_rows, arc_rows, host_rows = max(rc_rows, least), max(arc_rows, least), LIVE_HOST_ROWS
        return blueprint(
            None if live else (self.begin, self.end),
            rc_rows=rc_rows,
            arc_rows=arc_rows,
            host_rows=host_rows if self.hosts.placing else 0,
            robots=robots,
        )

    def _colour(self, at: float, arc: str) -> int:
        others = "ARC names: the others have no lane and no colour of their own"
        if arc not in self._arcs and not self.room(at, self._arcs, MAX_ARCS, others):
            return OTHER
        self._arcs.add(arc)
        return self._colour_of(arc)

    def _colour_of(self, name: str) -> int:
        if name not in self._colours:
            if len(self._colours) >= MAX_COLOURS:
                return OTHER
            self._colours[name] = PALETTE[len(self._colours) % len(PALETTE)]
        return self._colours[name]


def _free_port(bind: str, port: int) -> int:
    """Checks address and port first: of a failure Rerun itself reports only that its thread ended."""
    family = socket.AF_INET6 if ":" in bind else socket.AF_INET
    try:
        with socket.create_server((bind, port), family=family) as server:
            return int(server.getsockname()[1])
    except OSError as error:
        raise TimelineError(
            f"timeline: can't listen on {bind}, port {port} ({os.strerror(error.errno or 0)}); "
            "choose another port, or end the program that has it"
        ) from error

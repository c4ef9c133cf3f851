"""`zscout motion`: run the motion detector alone, on any source that OpenCV opens, to place a camera."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Final

import click
from click.shell_completion import CompletionItem

from zscout import terminal
from zscout.cli import common
from zscout.cli.requests.options import SECONDS, seconds_within
from zscout.config.devices import MAX_MIN_AREA, MAX_MIN_DURATION, check_regions, parse_region
from zscout.config.strict import BadInput, Where
from zscout.mesh import clock
from zscout.messages import MotionLimits
from zscout.terminal import LiveLine, many, span
from zscout.types import SECOND

if TYPE_CHECKING:
    from zscout.behaviors.perception.motion import Event
    from zscout.cli.operator.picture_recording import WatchRecording
    from zscout.cli.operator.watch_source import LiveSource, VideoFile

END_TIMEOUT_S: Final = 8.0
"""Longest time from a signal to the end: the recording is written."""
REDRAW_INTERVAL_S: Final = 0.1
"""Interval between two drawings of the live line."""


def _parse_region(text: str, option: str) -> list[float]:
    try:
        return parse_region(text)
    except ValueError as error:
        raise BadInput(f"{option}: {error}") from None


def sources(_ctx: click.Context, _param: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """Complete a source: files, and the cameras of this host."""
    cameras = sorted(str(path) for path in Path("/dev").glob("video*"))
    offered = [CompletionItem(camera) for camera in cameras if incomplete and camera.startswith(incomplete)]
    return offered or [CompletionItem(incomplete, type="file")]


@click.command()
@click.option(
    "--source",
    metavar="FILE|URL|DEVICE",
    type=common.Parsed("source", lambda text, _: text),
    shell_complete=sources,
    required=True,
    help="Read pictures from a video file, an http:// or rtsp:// address, /dev/videoN or its number.",
)
@common.json_option("Print one JSON object on a line for each event, and the summary on stderr.")
@click.option(
    "--record",
    metavar="FILE",
    type=click.Path(path_type=Path, dir_okay=False),
    help="Write pictures, boxes and events as a Rerun recording; open it with `zscout view FILE`.",
)
@click.option("--limit", type=SECONDS, help="End after this much of the source. Default: at its end, or at Ctrl-C.")
@click.option(
    "--ignore",
    metavar="X,Y,X,Y...",
    type=common.Parsed("region", _parse_region),
    multiple=True,
    help="Ignore motion in this region. Its corners are shares of the picture's width and height, from 0 to 1: two "
    "opposite corners of a rectangle, or three or more of a polygon. Can be repeated.",
)
@click.option(
    "--min-area",
    type=click.FloatRange(0, MAX_MIN_AREA),
    default=0.0,
    help="Ignore moving areas below this share of the picture.",
)
@click.option("--min-duration", type=seconds_within(0, MAX_MIN_DURATION), default="0", help="Leave out shorter events.")
def motion(
    source: str,
    as_json: bool,
    record: Path | None,
    limit: float | None,
    ignore: tuple[list[float], ...],
    min_area: float,
    min_duration: float,
) -> None:
    """Report motion: one line for each event, when the event ends.

    A file is read whole, as fast as possible, by its own time stamps. From a URL or camera the newest picture is used,
    and a source that fails is opened again. An event ends when nothing moved for a second. Its `start`, `end` and
    `peak` are seconds of the source; `boxes`, [x, y, width, height] in its pixels, surround motion at the peak; `area`
    surrounds all motion; `frames` counts the pictures with motion. The detector adapts to the scene and needs no
    tuning; docs/watching.md describes its abilities. A framegrabber in the node file has keys with the names of these
    options.

    \b
    Examples:
      zscout motion --source /dev/video0
      zscout motion --source http://127.0.0.1:8080/1.mjpg --json | jq 'select(.frames > 10)'
      zscout motion --source /dev/video0 --limit 600 --record garden.rrd
      zscout motion --source garden.avi --ignore 0,0,0.4,0.1 --min-area 0.01 --min-duration 2
    """
    check_regions(ignore, Where("--ignore"))
    limits = MotionLimits(list(ignore), min_area, min_duration)
    ended_by: list[int] = []
    begun = False

    def on_signal(number: int, _: FrameType | None) -> None:
        # The first signal ends the command at the next picture; at once before any picture, or at a second signal.
        if ended_by or not begun:
            raise common.Interrupted(number)
        ended_by.append(number)

    with ExitStack() as stack:
        stack.enter_context(_ended_by_signals())
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            # Signals that a shell or nohup made this process ignore stay ignored.
            if signal.getsignal(number) is not signal.SIG_IGN:
                stack.callback(signal.signal, number, signal.signal(number, on_signal))
        report = stack.enter_context(_WatchReport(as_json=as_json))
        from zscout.cli.operator.watch_source import open_source

        opened = open_source(source, report.warn)
        stack.callback(opened.close)
        if record is not None:
            os.environ.setdefault("RUST_LOG", "off")  # silence Rerun: this command reports failures
            from zscout.cli.operator.picture_recording import WatchRecording
            from zscout.services.recorder.timeline import TimelineError

            try:
                report.recording = stack.enter_context(WatchRecording(opened.name, record))
            except TimelineError as error:
                raise BadInput(f"--record: {error}") from None
        begun = True
        _watch(opened, report, limits, lambda time: bool(ended_by) or (limit is not None and time > limit))
    report.summary()
    if ended_by:
        raise common.Interrupted(ended_by[0])


@contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Let a signal end this process after END_TIMEOUT_S even if its main thread hangs in a library."""
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    over, before = threading.Event(), signal.set_wakeup_fd(writing, warn_on_full_buffer=False)

    def insist() -> None:
        while numbers := os.read(reading, 1):
            if numbers[0] in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP) and not over.wait(END_TIMEOUT_S):
                os._exit(128 + numbers[0])

    thread = threading.Thread(target=insist, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        signal.set_wakeup_fd(before)
        os.close(writing)
        thread.join()
        os.close(reading)


def _watch(
    source: VideoFile | LiveSource, report: _WatchReport, limits: MotionLimits, over: Callable[[float], bool]
) -> None:
    from zscout.behaviors.perception.motion import EventTracker, MotionDetector

    detector, tracker = MotionDetector(outlines=True, limits=limits), EventTracker(limits.min_duration)
    for time, picture in source.shots():
        if over(time):
            break
        report.at = time
        if picture is None:
            ended = tracker.quiet(time)
        else:
            seen = detector.see(time, picture)
            ended = tracker.see(time, seen)
            report.pictures += 1
            if report.recording is not None:
                report.recording.seen(time, picture, seen.boxes, moving=seen.moving)
        if ended is not None:
            report.event(ended)
        report.show(source.duration, tracker.current)
    last = tracker.close()
    if last is not None:
        report.event(last)


class _WatchReport(LiveLine):
    """The output: events, and a live line at a terminal, on stdout or else on stderr."""

    def __init__(self, *, as_json: bool) -> None:
        super().__init__(sys.stdout if terminal.at_terminal() else sys.stderr)
        self.recording: WatchRecording | None = None
        self.at = 0.0
        """Seconds of the source."""
        self.pictures = 0
        self._json = as_json
        self._events = 0
        self._moving = 0.0
        self._drawn = clock.now()

    def event(self, event: Event) -> None:
        self._events += 1
        self._moving += event.end - event.start
        if self.recording is not None:
            self.recording.words(event.start, _words(event))
        text = _words(event)
        if self._json:
            times = {name: round(getattr(event, name), 3) for name in ("start", "end", "peak")}
            text = json.dumps(event._asdict() | times)
        if terminal.at_terminal():
            self.print(text, "" if self._json else "yellow")
        else:
            terminal.print_line(text)

    def warn(self, text: str) -> None:
        text = terminal.clean(text)
        if self.recording is not None:
            self.recording.words(self.at, text)
        if terminal.at_terminal(sys.stderr):
            self.print(text, "red")
        else:
            terminal.print_line(text, sys.stderr)

    def show(self, duration: float | None, event: Event | None) -> None:
        now = clock.now()
        if not self.watched or now - self._drawn < REDRAW_INTERVAL_S * SECOND:
            return
        self._drawn = now
        from rich.text import Text

        of = "" if duration is None else f" of {span(duration)}"
        line = Text(f"{span(self.at)}{of}  {many(self._events, 'event')}  ", no_wrap=True)
        if event is None:
            line.append("still", style="green")
        else:
            line.append(f"moving for {span(self.at - event.start)}", style="bold yellow")
        self.draw(line.append("  Ctrl-C ends", style="dim"))

    def summary(self) -> None:
        share = f" ({100 * self._moving / self.at:.0f} %)" if self.at > 0 else ""
        line = f"{span(self.at)} watched, {many(self.pictures, 'picture')}; "
        line += f"{many(self._events, 'event')}, motion for {span(self._moving)}{share}"
        terminal.print_line(line, sys.stderr if self._json else sys.stdout)


def _words(event: Event) -> str:
    largest = event.boxes[0]
    things = "one area" if len(event.boxes) == 1 else f"{len(event.boxes)} areas"
    end = "and continues" if event.going_on else f"for {span(event.end - event.start)}"
    return (
        f"{event.start:9.2f} to {event.end:.2f} s: motion {end}, {things} at the peak, the largest "
        f"{largest.width}x{largest.height} at {largest.x},{largest.y}"
    )

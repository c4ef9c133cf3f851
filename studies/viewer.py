"""`python -m studies viewer`: the time until a browser shows a whole recording, the memory of a recorder, and the size
of an hour of four cameras."""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import msgspec
import psutil
from PIL import Image, ImageChops
from rerun.chunk import RrdReader

from benchmarks.stats import Row, table
from studies.chromium import Chromium, find
from tests.services.recorder import robot_run
from zscout.cli.fleet.view import open_viewer
from zscout.config.fleet import MeshConfig, default_fleet
from zscout.config.node import RecorderConfig
from zscout.ports import free_port
from zscout.services.recorder.blueprint import Layout
from zscout.services.recorder.drawing import Drawing
from zscout.services.recorder.process import RecorderJob, Recording, encode_job
from zscout.services.recorder.robots import RobotTracker
from zscout.services.recorder.timeline import Timeline

MEGA = 1e6
QUIET = 20.0
"""A page without changes for this many seconds is complete."""
PATIENCE = 400.0
SETTLED = 10.0
"""Seconds after which the memory of a process is measured."""
CAMERAS = 4
RATE = 2.0
"""Pictures a second."""
PICTURE = 3_700
"""Bytes of a picture of a robot's camera."""
BARE = (
    "import sys, tempfile, rerun as rr;"
    "stream = rr.RecordingStream('bare');"
    "server = rr.GrpcServerSink(bind_ip='127.0.0.1', port=int(sys.argv[1]), server_memory_limit='200MB');"
    "stream.set_sinks(server, rr.FileSink(sys.argv[2]));"
    "stream.log('words', rr.TextLog('ready')); stream.flush(timeout_sec=60);"
    "print('ready', flush=True); sys.stdin.read()"
)


def progress(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


class Repeated(Timeline):
    shift = 0.0

    def log(self, at: float | None, entity: str, *what: object) -> None:
        Drawing.log(self, None if at is None else at + self.shift, entity, *what)  # type: ignore[arg-type]

    def point(self, at: float, entity: str, value: float) -> None:
        super().point(at + self.shift, entity, value)


class Measured(Timeline):
    """Measures the finishing of the recording."""

    written = seconds = 0.0
    """MB before finishing, and its duration."""

    def _finish(self, path: Path, layout: Layout) -> None:
        self.written = path.stat().st_size / MEGA
        start = time.monotonic()
        super()._finish(path, layout)
        self.seconds = time.monotonic() - start


class Unfinished(Repeated):
    def _finish(self, path: Path, layout: Layout) -> None:
        pass


def record(path: Path, megabytes: float, kind: type[Repeated] = Repeated) -> None:
    """Four robots at work, with cameras, floor, loads and events, of about this size. With 0 megabytes only the first
    instant: all panes, but empty."""
    with kind("lab", path=path) as timeline:
        while True:
            timeline.robots = RobotTracker(timeline)
            robot_run.play(timeline, robot_run.SECONDS if megabytes else 0)
            timeline.flush(10)
            timeline.shift += robot_run.SECONDS
            if path.stat().st_size >= megabytes * MEGA:
                return


def record_finished(path: Path, megabytes: float) -> float:
    """The same, but with this size after finishing. Return the size before."""
    written = megabytes
    while True:
        record(path, written)
        size = path.stat().st_size / MEGA
        if size >= megabytes:
            return written
        # Finishing thins out and compresses.
        written *= 1.02 * megabytes / size


async def seconds_until_whole(program: str, recording: Path, picture: Path) -> float:
    """Seconds from the opening of the page to the first picture that does not change any more."""
    async with open_viewer(Recording(str(recording), None), web=True) as (_, address):
        assert address is not None
        return await asyncio.to_thread(_watch, program, address, picture)


def _watch(program: str, address: str, picture: Path) -> float:
    with Chromium(program) as chromium:
        start = time.monotonic()
        chromium.ask("Page.navigate", url=address)
        last: Image.Image | None = None
        since = 0.0
        while time.monotonic() - start < PATIENCE:
            seen = chromium.picture()
            now = time.monotonic() - start
            if last is None or ImageChops.difference(last, seen).getbbox() is not None:
                last, since = seen, now
            elif now - since > QUIET and len(seen.getcolors(1 << 24) or ()) > 64:
                seen.save(picture)
                return since
            time.sleep(0.1)
    raise TimeoutError(f"the page still changed after {PATIENCE:g} s")


async def browser(program: str, folder: Path, megabytes: float, rounds: int, pictures: Path) -> list[Row]:
    """Measure an empty recording and a recording of this size, in turn; and the latter without finishing."""
    empty, whole, written = (folder / f"{name}.rrd" for name in ("empty", "whole", "written"))
    record(empty, 0)
    record(written, record_finished(whole, megabytes), Unfinished)
    took: dict[Path, list[float]] = {empty: [], whole: []}
    for number in range(rounds):
        for path, times in took.items():
            times.append(await seconds_until_whole(program, path, pictures / f"{path.stem}.png"))
            progress(f"{path.stem}, round {number + 1}: {times[-1]:.1f} s")
    raw = await seconds_until_whole(program, written, pictures / "written.png")
    first, later = (sorted(times)[len(times) // 2] for times in took.values())
    size, raw_size = whole.stat().st_size / MEGA, written.stat().st_size / MEGA
    for path in (whole, written):
        chunks = [chunk.num_rows for chunk in RrdReader(path).stream()]
        progress(f"{path.stem}: {len(chunks):,} chunks, {sum(chunks):,} rows")
    return [
        Row("browser, an empty recording", first, "s", rounds=rounds),
        Row(f"browser, {size:.1f} MB: whole", later, "s", rounds=rounds),
        Row(f"browser, {size:.1f} MB: later than empty", later - first, "s", aim=10.0, rounds=rounds),
        Row(f"browser, {raw_size:.1f} MB as written: later than empty", raw - first, "s"),
    ]


def _resident(process: subprocess.Popen[bytes]) -> float:
    time.sleep(SETTLED)
    return psutil.Process(process.pid).memory_info().rss / MEGA


def memory(folder: Path) -> list[Row]:
    """Memory of a recorder on an empty mesh, and of a process with only Rerun, a server and a file."""
    fleet = default_fleet()
    mesh = MeshConfig(multicast=False, listen=("tcp/127.0.0.1:0",))
    job = RecorderJob(
        RecorderConfig(folder / "runs", "127.0.0.1", 0), msgspec.structs.replace(fleet, mesh=mesh), "bench"
    )
    commands = {
        "bare": ([sys.executable, "-c", BARE, str(free_port("127.0.0.1", 0)), str(folder / "bare.rrd")], b""),
        "recorder": ([sys.executable, "-m", "zscout.services.recorder"], encode_job(job)),
    }
    sizes = {}
    for name, (command, job_input) in commands.items():
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, env=os.environ
        )
        assert process.stdin is not None
        assert process.stdout is not None
        process.stdin.write(job_input)
        process.stdin.flush()
        assert process.stdout.readline()
        sizes[name] = _resident(process)
        process.stdin.close()
        process.wait()
        process.stdout.close()
    return [
        Row("RSS, a process with Rerun, server and file", sizes["bare"], "MB"),
        Row("RSS, recorder", sizes["recorder"], "MB"),
        Row("RSS, recorder above that", sizes["recorder"] - sizes["bare"], "MB", aim=30.0),
    ]


def hour(folder: Path) -> list[Row]:
    """An hour of four cameras: its size as written, and after finishing."""
    written = folder / "cameras.rrd"
    pictures = [_sized(robot_run.jpeg(number / 7, "scout33", None)) for number in range(100)]
    with Measured("lab", path=written) as timeline:
        for number in range(round(3600 * RATE)):
            for camera in range(CAMERAS):
                picture = pictures[(number + 7 * camera) % len(pictures)]
                timeline.robots.frame(number / RATE, f"framegrabber/fgrab{camera}", robot_run.head(number), picture)
    kept = written.stat().st_size / MEGA
    return [
        Row("an hour of 4 cameras, as it is written", timeline.written, "MB"),
        Row("an hour of 4 cameras, kept", kept, "MB", aim=100.0),
        Row("finishing that hour", timeline.seconds, "s"),
    ]


def _sized(jpeg: bytes) -> bytes:
    """Pad a picture to about the size of a robot's picture; a decoder stops at the picture's end."""
    return jpeg + bytes(max(0, PICTURE - len(jpeg)))


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m studies viewer", description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    parser.add_argument("--megabytes", type=float, default=10.0, help="of the recording (default: 10)")
    parser.add_argument("--rounds", type=int, default=3, help="of the browser (default: 3)")
    parser.add_argument("--pictures", type=Path, default=None, help="a folder for pictures of the browser")
    parser.add_argument("--no-browser", action="store_true", help="skip the measurements with a browser")
    args = parser.parse_args()
    load, program, rows = os.getloadavg()[0], find(), list[Row]()
    with tempfile.TemporaryDirectory(prefix="zscout-viewer-") as name:
        folder = Path(name)
        rows += memory(folder)
        rows += hour(folder)
        if args.no_browser or program is None:
            progress("no browser: apt-get install chromium fonts-dejavu-core" if program is None else "no browser")
        else:
            pictures = args.pictures or folder
            pictures.mkdir(parents=True, exist_ok=True)
            rows += asyncio.run(browser(program, folder, args.megabytes, args.rounds, pictures))
    if args.json:
        print(json.dumps({"load_average_at_start": round(load, 2), "rows": [row.as_json() for row in rows]}, indent=2))
    else:
        print(table(rows))
        print(f"\n{os.cpu_count()} cores; load average {load:.2f} before, {os.getloadavg()[0]:.2f} after.")

"""The recorder as a program, `python -m zscout.services.recorder`: reads a job from standard input, and records to disk
and live until standard input closes."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import sys
import time
from contextlib import ExitStack, suppress
from typing import BinaryIO, Final
from urllib.parse import urlsplit

import msgspec

from zscout.config.fleet import Fleet
from zscout.config.node import RecorderConfig
from zscout.config.packages import how_to_get
from zscout.config.strict import BadInput
from zscout.keyexpr import Sender
from zscout.logs import log_to_stderr
from zscout.mesh import MeshError, ZenohMesh
from zscout.messages import Recorded
from zscout.services.recorder.process import (
    BAD_SETTINGS,
    MEGABYTE,
    RecorderJob,
    RecorderReport,
    Recording,
    decode_job,
    new_recording,
    prune,
    writing,
)
from zscout.types import SECOND

try:
    import rerun  # noqa: F401 - first, to be named if it is missing: it includes NumPy

    from zscout.services.recorder.finish import Job
    from zscout.services.recorder.recorder import Recorder, RecorderFailed
    from zscout.services.recorder.timeline import Timeline, TimelineError
except ImportError as error:
    if not (missing := how_to_get(error)):
        raise
    sys.stderr.write(f"the recorder {missing}\n")
    sys.exit(BAD_SETTINGS)

log = logging.getLogger("zscout.recorder")

MAX_JOB: Final = 1_000_000
PART: Final = 3_600.0
"""Seconds after which a recording continues in another file."""
MAX_PART: Final = 250 * MEGABYTE
"""Bytes after which a recording continues in another file."""
CHECK_EVERY: Final = 30.0
"""Seconds between two checks of PART, MAX_PART and the limit of all recordings."""
LOOK_EVERY: Final = 2.0
"""Seconds between two checks that the file can be written."""


def main() -> None:
    """Exit codes: 0 after a stop, 1 after a failure, BAD_SETTINGS if a restart would not help."""
    log_to_stderr("INFO", "%(asctime)s recorder %(levelname)s %(message)s")
    try:
        # Redirect standard output of libraries to standard error; this program writes its lines to a copy.
        with os.fdopen(os.dup(1), "wb") as out:
            os.dup2(2, 1)
            job = decode_job(sys.stdin.buffer.readline(MAX_JOB))
            try:
                asyncio.run(_record(job, out))
            except TimelineError as error:
                _report(out, str(error))
                raise
    except (BadInput, MeshError) as error:
        log.error("%s", error)  # noqa: TRY400 - one clear line
        sys.exit(BAD_SETTINGS if isinstance(error, BadInput) else 1)
    except RecorderFailed:
        sys.exit(1)


def _report(out: BinaryIO, fault: str) -> None:
    with suppress(OSError):  # the reader is gone
        out.write(msgspec.json.encode(RecorderReport(fault=fault)) + b"\n")
        out.flush()


async def _record(job: RecorderJob, out: BinaryIO) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)

    def read() -> None:
        """Stop at the end of standard input, which the program that started this one holds open."""
        if not os.read(0, 4096):
            loop.remove_reader(0)
            stop.set()

    with suppress(PermissionError):  # a plain file has no other end
        loop.add_reader(0, read)
    settings, fleet = job.recorder, job.fleet
    with ExitStack() as stack:
        files = _Files(settings, fleet)
        stack.callback(files.close)
        timeline = stack.enter_context(files.timeline)
        files.prune()
        async with await ZenohMesh.open(fleet, Sender(job.host, "recorder")) as mesh:
            out.write(msgspec.json.encode(Recording(str(files.path.absolute()), timeline.url)) + b"\n")
            out.flush()
            where, past = files.where if job.joined else None, settings.past / SECOND
            recorder = Recorder(mesh, fleet, timeline, settings.frames, where, past)
            rolling = asyncio.create_task(files.keep(recorder, out))
            try:
                await recorder.run(stop)
            finally:
                rolling.cancel()
                await asyncio.gather(rolling, return_exceptions=True)
    log.info("the recording is %s", files.path)


class _Files:
    """The present file, and the previous ones. Raises BadInput if it can't be written or served."""

    def __init__(self, settings: RecorderConfig, fleet: Fleet) -> None:
        self._settings, self._fleet = settings, fleet
        self.path = new_recording(settings.path, fleet.name)
        self._written = ExitStack()
        self._written.enter_context(writing(self.path))
        self._began = time.monotonic()
        try:
            self.timeline = Timeline(fleet.name, path=self.path, bind=settings.bind, port=settings.port, wall=True)
        except BadInput:
            self.close()
            self.path.unlink(missing_ok=True)
            raise

    def where(self) -> Recorded:
        port = urlsplit(self.timeline.url or "").port
        return Recorded(str(self.path.absolute()), self.path.stat().st_ino, self._settings.bind, port or 1)

    def prune(self) -> None:
        prune(self._settings.path, self._fleet.name, limit=self._settings.limit * MEGABYTE)

    async def keep(self, recorder: Recorder, out: BinaryIO) -> None:
        """Start another file after PART seconds, at MAX_PART bytes, or if this can't be written (reported at once);
        remove the oldest recordings. Does not return."""
        fault, due = "", time.monotonic() + CHECK_EVERY
        while True:
            await asyncio.sleep(min(LOOK_EVERY, CHECK_EVERY))
            before, fault = fault, await asyncio.to_thread(self.timeline.unwritten)
            if bool(fault) != bool(before):
                _report(out, fault)
                log.log(logging.ERROR if fault else logging.INFO, "%s", fault or f"recording to {self.path}")
            if time.monotonic() < due:
                continue
            due = time.monotonic() + CHECK_EVERY
            try:
                if fault or time.monotonic() - self._began >= PART or self.path.stat().st_size >= MAX_PART:
                    await self._roll(recorder.now())
            except (OSError, BadInput) as error:
                if not fault:
                    log.warning("the recording continues in the same file: %s", error)
            self.prune()

    async def _roll(self, at: float) -> None:
        path = new_recording(self._settings.path, self._fleet.name)
        try:
            job = self.timeline.roll(at, path)
        except BadInput:
            path.unlink(missing_ok=True)
            raise
        before, self.path, self._began = self._written.pop_all(), path, time.monotonic()
        self._written.enter_context(writing(path))
        with before:
            if job is not None:
                await _finished(job)

    def close(self) -> None:
        self._written.close()


async def _finished(job: Job) -> None:
    """Rewrite the file in a separate process, whose memory is freed with it."""
    command = (sys.executable, "-m", "zscout.services.recorder.finish")
    process = await asyncio.create_subprocess_exec(*command, stdin=asyncio.subprocess.PIPE)
    try:
        await process.communicate(msgspec.json.encode(job, enc_hook=str))
    finally:
        if process.returncode is None:
            process.terminate()
            await process.wait()


if __name__ == "__main__":
    main()

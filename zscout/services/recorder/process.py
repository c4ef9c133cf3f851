"""Management of a recorder: its process, its job, and the folder of its recordings.

The recorder is a separate process, as Rerun is large and a node should stay small. Recordings are files named by fleet
and local time; the newest are kept."""

from __future__ import annotations

import asyncio
import fcntl
import logging
import os
import re
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

import msgspec

from zscout.config.fleet import Fleet, beside
from zscout.config.node import RecorderConfig
from zscout.config.strict import BadInput
from zscout.mesh import Supervisor
from zscout.mesh.supervision import done_within

log = logging.getLogger(__name__)

RESTARTS: Final = 5
"""Failures in a row after which the recorder is not restarted."""
PAUSE: Final = 1.0
LONG_ENOUGH: Final = 60.0
"""Seconds of running after which failures count from one again."""
GRACE: Final = 40.0
"""Seconds for the recorder to finish its file."""
QUIET: Final = {"RUST_LOG": "error"}
"""Rerun would warn about each file without a footer, which a file gets only when it is finished."""
BAD_SETTINGS: Final = 2
"""Exit code for an error that a restart would not fix."""
KEEP: Final = 500
"""Recordings of one fleet in one folder; older ones are removed."""
MEGABYTE: Final = 1_000_000
HALF_DONE: Final = 3_600.0
"""Seconds after which the unfinished output of `finish` is a leftover."""
MAX_A_SECOND: Final = 100


class RecorderJob(msgspec.Struct, frozen=True):
    """Standard input of a recorder, as one line of JSON. `recorder.port` 0: any free port."""

    recorder: RecorderConfig
    fleet: Fleet
    host: str
    joined: bool = True
    """Answer other programs that ask for the recording; False for one that ends with a view."""


class Recording(msgspec.Struct, frozen=True):
    """Standard output of a recorder once it records, as one line of JSON."""

    file: str
    url: str | None = None
    """Address of the live view."""


class RecorderReport(msgspec.Struct, frozen=True, omit_defaults=True):
    """Any line of standard output: a Recording, or later a change of `fault`."""

    file: str = ""
    url: str | None = None
    fault: str = ""
    """Why the file can't be written; empty if it can."""


def encode_job(job: RecorderJob) -> bytes:
    return msgspec.json.encode(job, enc_hook=str) + b"\n"


def decode_job(line: bytes) -> RecorderJob:
    """Raises BadInput."""
    try:
        return msgspec.json.decode(line, type=RecorderJob, dec_hook=lambda path, value: path(value))
    except (msgspec.MsgspecError, UnicodeDecodeError, TypeError) as error:
        raise BadInput(f"standard input: not a job of the recorder ({error}); let zscout-node start it") from None


def new_recording(folder: Path, fleet: str) -> Path:
    """Make an empty file `<fleet>-<date>-<time>.rrd` in `folder`, which is made too. Raises BadInput."""
    stem = f"{fleet}-{time.strftime('%Y%m%d-%H%M%S')}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for number in range(1, MAX_A_SECOND):
            path = folder / (f"{stem}.rrd" if number == 1 else f"{stem}-{number}.rrd")
            with suppress(FileExistsError):
                path.touch(exist_ok=False)
                return path
    except OSError as error:
        why = "it is a file" if isinstance(error, FileExistsError) else error.strerror
        raise BadInput(f"recordings can't be written to {folder} ({why}); give another folder") from None
    raise BadInput(f"{folder} has {MAX_A_SECOND} recordings of this second; remove some")


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Protect the file from removal by other recorders."""
    with path.open("ab") as file:
        fcntl.flock(file, fcntl.LOCK_SH)
        yield


def prune(folder: Path, fleet: str, keep: int = KEEP, limit: int | None = None) -> None:
    """Remove the oldest recordings of a fleet until at most `keep` are left, with `limit` bytes in total. Not removed:
    recordings being written, files not named by `new_recording`."""
    name = rf"{re.escape(fleet)}-\d{{8}}-\d{{6}}(-\d+)?"
    ours, half_done = re.compile(rf"{name}\.rrd"), re.compile(rf"\.{name}\.finishing")
    try:
        found = [(path, path.stat()) for path in folder.iterdir() if path.is_file()]
        for path, stat in found:
            if half_done.fullmatch(path.name) and time.time() - stat.st_mtime > HALF_DONE:
                path.unlink()
        recordings = [(path, stat) for path, stat in found if ours.fullmatch(path.name)]
        size = 0
        for number, (path, stat) in enumerate(sorted(recordings, key=lambda found: found[1].st_mtime_ns, reverse=True)):
            size += stat.st_size
            if (number >= keep or (limit is not None and size > limit)) and not _is_written(path):
                path.unlink()
                size -= stat.st_size
    except OSError as error:
        log.warning("old recordings in %s can't be removed: %s", folder, error.strerror)


def _is_written(path: Path) -> bool:
    with path.open("rb") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


class RecorderProcess:
    """A child that records until its standard input closes, so that it can't outlive this process."""

    def __init__(self, recorder: RecorderConfig, fleet: Fleet, host: str) -> None:
        self._job = encode_job(RecorderJob(recorder, msgspec.structs.replace(fleet, mesh=beside(fleet.mesh)), host))
        self._child: asyncio.subprocess.Process | None = None
        self.fault = ""
        """Why nothing is recorded; empty if it is."""
        # A node continues without its recorder: failures are only logged.
        self._supervisor = Supervisor("the recorder's process", lambda _: None)

    async def start(self) -> None:
        self._supervisor.spawn(self._run())

    async def stop(self) -> None:
        """Stop the recorder; return when its file is finished, or after GRACE seconds."""
        await self._supervisor.close()
        child = self._child
        if child is None or child.returncode is not None:
            return
        if child.stdin is not None:
            child.stdin.close()
        if not await done_within(GRACE, child.wait()):
            log.warning("the recorder did not finish in %g s: killing it", GRACE)
            child.kill()
            await child.wait()

    async def _run(self) -> None:
        failures = 0
        while failures < RESTARTS:
            began = time.monotonic()
            try:
                code = await self._record()
            except OSError as error:
                log.warning("the recorder can't be started: %s", error)
                code = 1
            if code in (0, BAD_SETTINGS):
                words = "was ended" if code == 0 else "can't run with these settings"
                log.warning("the recorder %s; this node continues without it", words)
                self.fault = self.fault or f"the recorder {words}; see the node's log"
                return
            failures = 1 if time.monotonic() - began >= LONG_ENOUGH else failures + 1
            log.warning("the recorder ended with code %d", code)
            await asyncio.sleep(PAUSE)
        log.error("the recorder failed %d times in a row and is not restarted; this node continues", RESTARTS)
        self.fault = self.fault or f"the recorder failed {RESTARTS} times in a row; see the node's log"

    async def _record(self) -> int:
        """Run the recorder once; return its exit code."""
        child = self._child = await asyncio.create_subprocess_exec(
            sys.executable,
            *("-m", "zscout.services.recorder"),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            env=os.environ | QUIET,
            start_new_session=True,
        )
        assert child.stdin is not None  # noqa: S101
        assert child.stdout is not None  # noqa: S101
        with suppress(ConnectionError, ValueError):  # the child has ended: its exit code has the cause
            child.stdin.write(self._job)
            await child.stdin.drain()
            while line := await child.stdout.readline():
                report = msgspec.json.decode(line, type=RecorderReport)
                self.fault = report.fault
                if report.file:
                    log.info("recording to %s, live at %s", report.file, report.url)
        return await child.wait()

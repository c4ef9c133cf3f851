"""What surrounds a recorder: its process, its job, and the folder of its recordings.

It is a process of its own, as Rerun is large and a node should stay small. Recordings are files named by fleet and
local time, of which the newest are kept."""

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
"""Failures in a row, after which the recorder is given up."""
PAUSE: Final = 1.0
LONG_ENOUGH: Final = 60.0
"""A recorder that ran for this many seconds is no failure in a row any more."""
GRACE: Final = 40.0
"""Seconds for the recorder to finish its file."""
QUIET: Final = {"RUST_LOG": "error"}
"""Rerun would warn of each file that is to have no footer before it is finished."""
BAD_SETTINGS: Final = 2
"""Its exit code where trying again would not help."""
KEEP: Final = 500
"""Recordings of one fleet in one folder; older ones are removed."""
MEGABYTE: Final = 1_000_000
HALF_DONE: Final = 3_600.0
"""Seconds after which what was to become a finished recording is a leftover."""
MAX_A_SECOND: Final = 100


class RecorderJob(msgspec.Struct, frozen=True):
    """What a recorder reads from its standard input, as one line of JSON. `recorder.port` 0: any free one."""

    recorder: RecorderConfig
    fleet: Fleet
    host: str
    joined: bool = True
    """Whether others may look at what it records: not at what ends with somebody's view."""


class Recording(msgspec.Struct, frozen=True):
    """What a recorder writes to its standard output, as one line of JSON, once it records."""

    file: str
    url: str | None = None
    """Where a viewer finds it live."""


class RecorderReport(msgspec.Struct, frozen=True, omit_defaults=True):
    """Any such line: a Recording, or later whether that can be written."""

    file: str = ""
    url: str | None = None
    fault: str = ""
    """Why it can't be written; empty: it can."""


def encode_job(job: RecorderJob) -> bytes:
    return msgspec.json.encode(job, enc_hook=str) + b"\n"


def decode_job(line: bytes) -> RecorderJob:
    """Raises BadInput."""
    try:
        return msgspec.json.decode(line, type=RecorderJob, dec_hook=lambda path, value: path(value))
    except (msgspec.MsgspecError, UnicodeDecodeError, TypeError) as error:
        raise BadInput(f"standard input: no job for a recorder ({error}); let zscout-node start it") from None


def new_recording(folder: Path, fleet: str) -> Path:
    """Makes an empty `<fleet>-<date>-<time>.rrd` in `folder`, and the folder too. Raises BadInput."""
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
    """No other recorder removes the file meanwhile."""
    with path.open("ab") as file:
        fcntl.flock(file, fcntl.LOCK_SH)
        yield


def prune(folder: Path, fleet: str, keep: int = KEEP, limit: int | None = None) -> None:
    """Removes the oldest recordings of a fleet, until at most `keep` are left, of `limit` bytes in all; but none that
    is being written.

    Nothing is touched that is not named as `new_recording` names files."""
    name = rf"{re.escape(fleet)}-\d{{8}}-\d{{6}}(-\d+)?"
    ours, half_done = re.compile(rf"{name}\.rrd"), re.compile(rf"\.{name}\.finishing")
    try:
        found = [(path, path.stat()) for path in folder.iterdir() if path.is_file()]
        for path, stat in found:
            if half_done.fullmatch(path.name) and time.time() - stat.st_mtime > HALF_DONE:
                path.unlink()
        recordings = [(path, stat) for path, stat in found if ours.fullmatch(path.name)]
        size = 0
        for number, (path, stat) in enumerate(sorted(recordings, key=lambda one: one[1].st_mtime_ns, reverse=True)):
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
    """A child that records until its standard input closes: it can't outlive this process."""

    def __init__(self, recorder: RecorderConfig, fleet: Fleet, host: str) -> None:
        self._job = encode_job(RecorderJob(recorder, msgspec.structs.replace(fleet, mesh=beside(fleet.mesh)), host))
        self._child: asyncio.subprocess.Process | None = None
        self.fault = ""
        """Why nothing is recorded; empty where it is."""
        # A node goes on without its recorder: what fails here is logged.
        self._supervisor = Supervisor("the recorder's process", lambda _: None)

    async def start(self) -> None:
        self._supervisor.spawn(self._run())

    async def stop(self) -> None:
        """Ends the recorder; returns when its file is finished, or GRACE is over."""
        await self._supervisor.close()
        child = self._child
        if child is None or child.returncode is not None:
            return
        if child.stdin is not None:
            child.stdin.close()
        if not await done_within(GRACE, child.wait()):
            log.warning("the recorder did not finish in %g s and is killed", GRACE)
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
                log.warning("the recorder %s; this node goes on without it", words)
                self.fault = self.fault or f"the recorder {words}; see the node's log"
                return
            failures = 1 if time.monotonic() - began >= LONG_ENOUGH else failures + 1
            log.warning("the recorder ended with code %d", code)
            await asyncio.sleep(PAUSE)
        log.error("the recorder failed %d times in a row and is given up; everything else goes on", RESTARTS)
        self.fault = self.fault or f"the recorder failed {RESTARTS} times in a row; see the node's log"

    async def _record(self) -> int:
        """One life of the recorder; returns its exit code."""
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
        with suppress(ConnectionError, ValueError):  # it ended before that: the code says more
            child.stdin.write(self._job)
            await child.stdin.drain()
            while line := await child.stdout.readline():
                report = msgspec.json.decode(line, type=RecorderReport)
                self.fault = report.fault
                if report.file:
                    log.info("records to %s, live at %s", report.file, report.url)
        return await child.wait()

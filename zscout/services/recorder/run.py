"""The recorder as a program: a job on standard input, a recording on disk and live, until that closes."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import msgspec

from zscout.config.strict import BadInput
from zscout.keyexpr import Sender
from zscout.mesh import MeshError, ZenohMesh
from zscout.services.recorder.files import new_recording, prune
from zscout.services.recorder.process import BAD_SETTINGS, RecorderJob, Recording
from zscout.services.recorder.recorder import Recorder, RecorderFailed
from zscout.services.recorder.timeline import Timeline

log = logging.getLogger("zscout.recorder")

MAX_JOB = 1_000_000


def main() -> None:
    """Exit codes: 0 when it was ended, 1 when it failed, BAD_SETTINGS where trying again would not help."""
    logging.basicConfig(
        level="INFO", format="%(asctime)s recorder %(levelname)s %(message)s", stream=sys.stderr
    )
    try:
        # Libraries write to standard output as they like: what this program writes there goes round them.
        with os.fdopen(os.dup(1), "wb") as out:
            os.dup2(2, 1)
            job = _read_job(sys.stdin.buffer.readline(MAX_JOB))
            asyncio.run(_record(job, out))
    except BadInput as error:
        log.error("%s", error)  # noqa: TRY400 - one clear line
        sys.exit(BAD_SETTINGS)
    except MeshError as error:
        log.error("%s", error)  # noqa: TRY400
        sys.exit(1)
    except RecorderFailed:
        sys.exit(1)


def _read_job(line: bytes) -> RecorderJob:
    def path(kind: type, value: Any) -> Any:
        if kind is Path:
            return Path(value)
        raise NotImplementedError

    try:
        return msgspec.json.decode(line, type=RecorderJob, dec_hook=path)
    except (msgspec.MsgspecError, UnicodeDecodeError, TypeError) as error:
        raise BadInput(f"standard input: no job for a recorder ({error}); let zscout-node start it") from None


async def _record(job: RecorderJob, out: BinaryIO) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    _stop_with_input(loop, stop)
    settings, fleet = job.recorder, job.fleet
    path = new_recording(settings.path, fleet.name)
    try:
        timeline = Timeline(fleet.name, path=path, bind=settings.bind, port=settings.port)
    except BadInput:
        path.unlink(missing_ok=True)
        raise
    prune(settings.path, fleet.name)
    with timeline:
        async with await ZenohMesh.open(fleet.name, Sender(job.host, "recorder"), fleet.mesh) as mesh:
            out.write(msgspec.json.encode(Recording(str(path.absolute()), timeline.url)) + b"\n")
            out.flush()
            await Recorder(mesh, fleet, timeline, settings.frames).run(stop)
    log.info("the recording is %s", path)


def _stop_with_input(loop: asyncio.AbstractEventLoop, stop: asyncio.Event) -> None:
    """Whoever started this holds the other end of standard input: its end is ours."""

    def read() -> None:
        if not os.read(0, 4096):
            loop.remove_reader(0)
            stop.set()

    with suppress(PermissionError):  # a plain file has no other end
        loop.add_reader(0, read)

"""The recorder as a program, `python -m zscout.services.recorder`: a job on standard input, a recording on
disk and live, until that closes."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import sys
from contextlib import suppress
from typing import BinaryIO

import msgspec

from zscout.config.packages import how_to_get
from zscout.config.strict import BadInput
from zscout.keyexpr import Sender
from zscout.mesh import MeshError, ZenohMesh
from zscout.services.recorder.process import BAD_SETTINGS, RecorderJob, Recording, decode_job, new_recording, prune

try:
    from zscout.services.recorder.recorder import Recorder, RecorderFailed
    from zscout.services.recorder.timeline import Timeline
except ImportError as error:
    if not (missing := how_to_get(error)):
        raise
    sys.stderr.write(f"the recorder {missing}\n")
    sys.exit(BAD_SETTINGS)

log = logging.getLogger("zscout.recorder")

MAX_JOB = 1_000_000


def main() -> None:
    """Exit codes: 0 when it was ended, 1 when it failed, BAD_SETTINGS where trying again would not help."""
    logging.basicConfig(level="INFO", format="%(asctime)s recorder %(levelname)s %(message)s", stream=sys.stderr)
    try:
        # Libraries write to standard output as they like: what this program writes there goes round them.
        with os.fdopen(os.dup(1), "wb") as out:
            os.dup2(2, 1)
            job = decode_job(sys.stdin.buffer.readline(MAX_JOB))
            asyncio.run(_record(job, out))
    except (BadInput, MeshError) as error:
        log.error("%s", error)  # noqa: TRY400 - one clear line
        sys.exit(BAD_SETTINGS if isinstance(error, BadInput) else 1)
    except RecorderFailed:
        sys.exit(1)


async def _record(job: RecorderJob, out: BinaryIO) -> None:
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)

    def read() -> None:
        """The program that started this holds the other end of standard input: its end is ours."""
        if not os.read(0, 4096):
            loop.remove_reader(0)
            stop.set()

    with suppress(PermissionError):  # a plain file has no other end
        loop.add_reader(0, read)
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


if __name__ == "__main__":
    main()

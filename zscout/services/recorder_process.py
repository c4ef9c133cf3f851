"""Runs the recorder as a process of its own: Rerun is large, and a node should stay small."""

from __future__ import annotations

import asyncio
import logging
import re
import sys

import msgspec

from zscout import clock
from zscout.config import Fleet, Mesh, Recorder
from zscout.scheduling.model import SECOND

log = logging.getLogger(__name__)

RESTARTS = 5
"""Failures in a row, after which the recorder is given up."""
PAUSE = 1.0
LONG_ENOUGH = 60 * SECOND
"""A recorder that ran for this long (ns) is no failure in a row any more."""
GRACE = 15.0
"""Seconds for the recorder to finish its file."""
BAD_SETTINGS = 2
"""Its exit code where trying again would not help."""

_ENDPOINT = re.compile(r"([a-z]+)/(\[[^\]]*\]|[^:]*):(\d+)(.*)")
_EVERYWHERE = {"0.0.0.0": "127.0.0.1", "[::]": "[::1]"}  # noqa: S104 - read, not bound


class Job(msgspec.Struct, frozen=True):
    """What a recorder reads from its standard input, as one line of JSON. `recorder.port` 0: any free one."""

    recorder: Recorder
    fleet: Fleet
    host: str


class Recording(msgspec.Struct, frozen=True):
    """What a recorder tells on its standard output, as one line of JSON, once it records."""

    file: str
    url: str | None = None
    """Where a viewer finds it live."""


def beside(mesh: Mesh) -> Mesh:
    """How a second process joins where a node does: on ports of its own, and linked to the node's."""
    listen, connect = [], list(mesh.connect)
    for endpoint in mesh.listen:
        found = _ENDPOINT.fullmatch(endpoint)
        if found is None:
            continue
        protocol, host, port, more = found.groups()
        listen.append(f"{protocol}/{host}:0{more}")
        if int(port):
            connect.append(f"{protocol}/{_EVERYWHERE.get(host, host)}:{port}{more}")
    return msgspec.structs.replace(mesh, listen=tuple(listen), connect=tuple(dict.fromkeys(connect)))


def encode_job(job: Job) -> bytes:
    """The job as a recorder reads it."""
    return msgspec.json.encode(job, enc_hook=str) + b"\n"


class RecorderProcess:
    """A child that records until its standard input closes: it can't outlive this process."""

    def __init__(self, recorder: Recorder, fleet: Fleet, host: str) -> None:
        own = msgspec.structs.replace(fleet, mesh=beside(fleet.mesh))
        self._job = encode_job(Job(recorder, own, host))
        self._child: asyncio.subprocess.Process | None = None
        self._task: asyncio.Task[None] | None = None

    async def start(self) -> None:
        self._task = asyncio.get_running_loop().create_task(self._run())

    async def stop(self) -> None:
        """Ends the recorder; returns when its file is finished, or GRACE is over."""
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        child = self._child
        if child is None or child.returncode is not None:
            return
        if child.stdin is not None:
            child.stdin.close()
        try:
            async with asyncio.timeout(GRACE):
                await child.wait()
        except TimeoutError:
            log.warning("the recorder did not finish in %g s and is killed", GRACE)
            child.kill()
            await child.wait()

    async def _run(self) -> None:
        failures = 0
        while failures < RESTARTS:
            began = clock.now()
            try:
                code = await self._record()
            except OSError as error:
                log.warning("the recorder can't be started: %s", error)
                code = 1
            if code in (0, BAD_SETTINGS):
                words = "was ended" if code == 0 else "can't run with these settings"
                log.warning("the recorder %s; this node goes on without it", words)
                return
            failures = 1 if clock.now() - began >= LONG_ENOUGH else failures + 1
            log.warning("the recorder ended with code %d", code)
            await asyncio.sleep(PAUSE)
        log.error("the recorder failed %d times in a row and is given up; everything else goes on", RESTARTS)

    async def _record(self) -> int:
        """One life of the recorder; returns its exit code."""
        child = self._child = await asyncio.create_subprocess_exec(
            sys.executable,
            "-m",
            "zscout.services.recorder",
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            start_new_session=True,
        )
        assert child.stdin is not None  # noqa: S101
        assert child.stdout is not None  # noqa: S101
        try:
            child.stdin.write(self._job)
            await child.stdin.drain()
            told = msgspec.json.decode(await child.stdout.readline(), type=Recording)
            log.info("records to %s, live at %s", told.file, told.url)
        except (ConnectionError, ValueError):
            pass  # it ended before that: the code says more
        return await child.wait()

"""Runs the recorder as a process of its own: Rerun is large, and a node should stay small."""

from __future__ import annotations

import asyncio
import logging
import re
import sys
import time

import msgspec

from zscout.config.fleet import Fleet, MeshConfig
from zscout.config.node import RecorderConfig
from zscout.mesh import Supervisor

log = logging.getLogger(__name__)

RESTARTS = 5
"""Failures in a row, after which the recorder is given up."""
PAUSE = 1.0
LONG_ENOUGH = 60.0
"""A recorder that ran for this many seconds is no failure in a row any more."""
GRACE = 15.0
"""Seconds for the recorder to finish its file."""
BAD_SETTINGS = 2
"""Its exit code where trying again would not help."""

_ENDPOINT = re.compile(r"([a-z]+)/(\[[^\]]*\]|[^:]*):(\d+)(.*)")
_EVERYWHERE = {"0.0.0.0": "127.0.0.1", "[::]": "[::1]"}  # noqa: S104 - read, not bound


class RecorderJob(msgspec.Struct, frozen=True):
    """What a recorder reads from its standard input, as one line of JSON. `recorder.port` 0: any free one."""

    recorder: RecorderConfig
    fleet: Fleet
    host: str


class Recording(msgspec.Struct, frozen=True):
    """What a recorder writes to its standard output, as one line of JSON, once it records."""

    file: str
    url: str | None = None
    """Where a viewer finds it live."""


def beside(mesh: MeshConfig) -> MeshConfig:
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


def encode_job(job: RecorderJob) -> bytes:
    """The job as a recorder reads it."""
    return msgspec.json.encode(job, enc_hook=str) + b"\n"


class RecorderProcess:
    """A child that records until its standard input closes: it can't outlive this process."""

    def __init__(self, recorder: RecorderConfig, fleet: Fleet, host: str) -> None:
        own = msgspec.structs.replace(fleet, mesh=beside(fleet.mesh))
        self._job = encode_job(RecorderJob(recorder, own, host))
        self._child: asyncio.subprocess.Process | None = None
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
            began = time.monotonic()
            try:
                code = await self._record()
            except OSError as error:
                log.warning("the recorder can't be started: %s", error)
                code = 1
            if code in (0, BAD_SETTINGS):
                words = "was ended" if code == 0 else "can't run with these settings"
                log.warning("the recorder %s; this node goes on without it", words)
                return
            failures = 1 if time.monotonic() - began >= LONG_ENOUGH else failures + 1
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
            recording = msgspec.json.decode(await child.stdout.readline(), type=Recording)
            log.info("records to %s, live at %s", recording.file, recording.url)
        except (ConnectionError, ValueError):
            pass  # it ended before that: the code says more
        return await child.wait()

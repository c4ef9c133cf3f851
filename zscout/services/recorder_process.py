"""Runs the recorder as a process of its own: Rerun is large, and a node should stay small."""

from __future__ import annotations

import asyncio
import logging
import sys

import msgspec

from zscout.config import Fleet, Recorder

log = logging.getLogger(__name__)

RESTARTS = 5
GRACE = 8.0
"""Seconds for the recorder to finish its file."""


class RecorderProcess:
    """A child that records until its standard input closes: it can't outlive this process."""

    def __init__(self, recorder: Recorder, fleet: Fleet, host: str) -> None:
        self.recorder, self.fleet, self.host = recorder, fleet, host
        self._child: asyncio.subprocess.Process | None = None
        self._task: asyncio.Task[None] | None = None

    async def start(self) -> None:
        self._task = asyncio.get_running_loop().create_task(self._run())

    async def stop(self) -> None:
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
        for _ in range(RESTARTS):
            self._child = await asyncio.create_subprocess_exec(
                sys.executable,
                "-m",
                "zscout.services.recorder",
                stdin=asyncio.subprocess.PIPE,
                start_new_session=True,
            )
            assert self._child.stdin is not None  # noqa: S101
            job = {"recorder": self.recorder, "fleet": self.fleet, "host": self.host}
            self._child.stdin.write(msgspec.json.encode(job, enc_hook=str) + b"\n")
            await self._child.stdin.drain()
            code = await self._child.wait()
            log.warning("the recorder ended with code %d", code)
            if code == 2:
                return
            await asyncio.sleep(1.0)
        log.error("the recorder ended %d times and is given up; everything else goes on", RESTARTS)

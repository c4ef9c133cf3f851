"""A building served in real time: its radio on a serial line, its cameras over HTTP.

A single thread steps the world, draws watched channels, and lists positions. The event loop carries the radio's bytes
and the pictures, which stay quick while a picture is drawn.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack
from functools import partial
from pathlib import Path
from typing import Final, Self, TypeVar

import cv2

from zscout.config.strict import BadInput
from zscout.drivers.packets import Packet
from zscout.messages.behaviors import BuildingPlan, BuildingPoses
from zscout.simulation.building.air import Air
from zscout.simulation.building.plan import Plan
from zscout.simulation.building.radio_line import MAX_SPEED, RadioLine
from zscout.simulation.building.video_server import VideoServer
from zscout.simulation.building.view import building_plan, poses
from zscout.simulation.building.world import World
from zscout.simulation.building.world_clock import STEP, FramePace, WorldClock
from zscout.types import MAX_CHANNEL

CHANNELS: Final = 4
MIN_FRAMES: Final = 0.1
MAX_FRAMES: Final = 60.0
QUALITY: Final = 85  # of the JPEGs, 1 to 100
MAX_PACKETS: Final = 1_000  # that wait for the next step; older packets are dropped
AT_ONCE: Final = 5  # steps before other work on the thread

T = TypeVar("T")


class Served:
    """A plan in motion that looks like a real building to drivers. `speed`: its seconds per second of real time;
    `frame_rate` (frames a second) and `baud` (of the radio's line) are in its seconds. `loss`: share of radio packets
    that no robot receives. `http`: host and port (0: any free port) of the video; `channels`: number of video
    receivers. Entering raises BadInput for a resource that is not available."""

    def __init__(
        self,
        plan: Plan,
        *,
        seed: int = 0,
        speed: float = 1.0,
        frame_rate: float = 10.0,
        baud: int = 9600,
        loss: float = 0.0,
        http: tuple[str, int] = ("127.0.0.1", 0),
        radio_link: Path | None = None,
        channels: int = CHANNELS,
    ) -> None:
        if not 0 < speed <= MAX_SPEED:
            raise BadInput(f"speed {speed:g}: write more than 0 and at most {MAX_SPEED:g}")
        if not MIN_FRAMES <= frame_rate <= MAX_FRAMES:
            raise BadInput(f"{frame_rate:g} frames a second: write {MIN_FRAMES:g} to {MAX_FRAMES:g}")
        if not 1 <= channels <= MAX_CHANNEL:
            raise BadInput(f"{channels} video channels: write 1 to {MAX_CHANNEL}")
        self.plan, self.seed, self.speed, self.frame_rate = plan, seed, speed, frame_rate
        self.channels = [channel_name(number + 1) for number in range(channels)]
        self.video = VideoServer(self.channels, host=http[0], port=http[1])
        self._baud, self._loss, self._link = baud, loss, radio_link
        self._packets: deque[Packet] = deque(maxlen=MAX_PACKETS)
        self._pace = FramePace(channels, frame_rate)
        self._stack = AsyncExitStack()
        self.frames = 0

    async def __aenter__(self) -> Self:
        async with AsyncExitStack() as stack:
            await stack.enter_async_context(self.video)
            self.radio = stack.enter_context(
                RadioLine(
                    self._baud, self._on_packet, speed=self.speed, loss=self._loss, seed=self.seed, link=self._link
                )
            )
            # For pictures of this size, threads take longer to start than to work.
            cv2.setNumThreads(1)
            self._worker = stack.enter_context(ThreadPoolExecutor(1, "building"))
            await self.in_world(self._make)
            self.clock = WorldClock(self.speed, asyncio.get_running_loop().time())
            self._running = asyncio.create_task(self._run())
            stack.push_async_callback(self._stop)
            self._stack = stack.pop_all()
        return self

    async def __aexit__(self, *exc: object) -> None:
        await self._stack.aclose()

    @property
    def time(self) -> float:
        """Seconds of the building since its start."""
        return self.clock.time

    @property
    def late(self) -> int:
        """Watched frames that were left out for lack of time."""
        return self._pace.late

    def true_speed(self) -> float:
        """Recent seconds of the building per second of real time: below `speed` if this machine is too busy."""
        return self.clock.true_speed(asyncio.get_running_loop().time())

    def unplug_radio(self) -> None:
        self.radio.unplug()

    def plug_radio(self) -> None:
        self.radio.plug()

    def kill(self, robot: str) -> None:
        """Raises KeyError for an unknown robot."""
        self.world.bodies[robot].alive = False

    def stall(self, channel: int, *, stalled: bool = True) -> None:
        """Stop the frames of a channel (from 1) with its connections open, or resume them."""
        self.video.stall(channel_name(channel), stalled=stalled)

    async def poses(self) -> BuildingPoses:
        return await self.in_world(lambda: poses(self.world, self.speed))

    async def map(self) -> BuildingPlan:
        return await asyncio.to_thread(building_plan, self.plan)

    async def in_world(self, work: Callable[[], T]) -> T:
        """Call `work` between two steps, on the world's thread."""
        return await asyncio.get_running_loop().run_in_executor(self._worker, work)

    async def until(self, time: float) -> None:
        """`time` is in seconds. Raises errors of the building."""
        while self.time < time:
            wait = max(STEP, time - self.time) / self.speed
            done, _ = await asyncio.wait({self._running}, timeout=min(wait, 60.0))
            if done:
                self._running.result()

    def _make(self) -> None:
        self.world = World(self.plan, seed=self.seed)
        self._air = Air(seed=self.seed)

    def _on_packet(self, packet: Packet, _at: float) -> None:
        self._packets.append(packet)

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        owed = 0
        while True:
            owed += self.clock.due(loop.time())
            if owed:
                steps = min(owed, AT_ONCE)
                owed -= steps
                packets = list(self._packets)
                self._packets.clear()
                await self.in_world(partial(self._step, steps, packets))
                continue
            channel = self._channel_due()
            if channel is None:
                await asyncio.sleep(self.clock.until_next(loop.time()))
                continue
            jpeg = await self.in_world(partial(self._draw, channel + 1))
            self.frames += 1
            self.video.show(self.channels[channel], jpeg)

    def _channel_due(self) -> int | None:
        watched = set(self.video.watched)
        numbers = range(len(self.channels))
        time = self.clock.time
        self._pace.skip(time, [number for number in numbers if self.channels[number] not in watched])
        return self._pace.next(time, [number for number in numbers if self.channels[number] in watched])

    def _step(self, steps: int, packets: list[Packet]) -> None:
        for packet in packets:
            for body in self.world.bodies.values():
                body.receive(packet, self.world.time)
        for _ in range(steps):
            self.world.step(STEP)

    def _draw(self, channel: int) -> bytes:
        picture = self._air.receive(self.world, channel)
        return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()

    async def _stop(self) -> None:
        self._running.cancel()
        await asyncio.gather(self._running, return_exceptions=True)


def channel_name(number: int) -> str:
    return f"ch{number}"

"""Frames on the mesh: large, many, and only the newest matters.

Unlike with messages, a publisher knows whether there are subscribers, it drops a frame that can't be sent at once, and
a slow subscriber misses frames but never the newest."""

from __future__ import annotations

import asyncio
import functools
import logging
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from zscout import messages
from zscout.mesh.sparse_log import SparseLog
from zscout.mesh.transport import Transport, TransportPublisher
from zscout.messages import MAX_FRAME, FrameHead, Malformed
from zscout.types import Ns

log = logging.getLogger(__name__)

MAX_HEAD = 2_048  # bytes attached to a frame


@dataclass(frozen=True, slots=True)
class Frame:
    """A picture as published; a notebook displays it."""

    key: str
    head: FrameHead
    """`number` counts pictures since the source was first opened, `time` is in seconds on the framegrabber's own clock,
    `grant` is the hold under which the picture was taken."""
    jpeg: bytes
    arrived: Ns
    """Time of arrival on this host's clock."""

    def __repr__(self) -> str:
        size, taken = f"{self.head.width}x{self.head.height}", f"{self.head.time:.3f} s"
        return f"<Frame {self.head.number}: {size}, {len(self.jpeg):,} bytes, taken at {taken}>"

    def _repr_jpeg_(self) -> bytes:
        return self.jpeg


class FramePublisher:
    """Publishes frames on one key. One thread at a time may call `put`."""

    def __init__(self, publisher: TransportPublisher, deliver: Callable[..., None]) -> None:
        self._publisher, self._deliver = publisher, deliver
        self.close = publisher.undeclare
        self.watched = False  # True if there are subscribers; valid once `follow` was called

    def follow(self, changed: Callable[[bool], None]) -> None:
        """Call `changed(watched)` in the event loop at each change."""

        def update(watched: bool) -> None:
            if watched != self.watched:
                self.watched = watched
                changed(watched)

        update(self._publisher.match(functools.partial(self._deliver, update)))

    def put(self, head: FrameHead, jpeg: bytes) -> None:
        """Publish a frame; drop it if it would have to wait. Raises ValueError for more than MAX_FRAME bytes."""
        if len(jpeg) > MAX_FRAME:
            raise ValueError(f"a frame of {len(jpeg)} bytes is too large; at most {MAX_FRAME} are sent")
        self._publisher.put(jpeg, messages.encode(head))


class FrameWatch:
    """The newest frame on a key or key expression."""

    def __init__(self, transport: Transport, key: str, deliver: Callable[..., None], now: Callable[[], Ns]) -> None:
        self._deliver, self._now = deliver, now
        self._malformed_log = SparseLog(log, now)
        self._lock = threading.Lock()
        self._newest: tuple[str, bytes, bytes | None, Ns] | None = None
        self._arrived = asyncio.Event()
        self.missed = 0  # frames replaced before they were taken
        self.malformed = 0
        self.close = transport.subscriber(key, self._on_sample)

    def _on_sample(self, key: str, jpeg: bytes, attachment: bytes | None) -> None:
        # In Zenoh's thread.
        with self._lock:
            replaced, self._newest = self._newest is not None, (key, jpeg, attachment, self._now())
            if replaced:
                self.missed += 1
        if not replaced:
            self._deliver(self._arrived.set)

    def take(self) -> Frame | None:
        """Return the newest frame, or None if it was taken already."""
        with self._lock:
            newest, self._newest = self._newest, None
        self._arrived.clear()
        if newest is None:
            return None
        key, jpeg, attachment, arrived = newest
        try:
            if len(jpeg) > MAX_FRAME:
                raise Malformed(f"{len(jpeg)} bytes are too many for a frame")
            if attachment is None:
                raise Malformed("a frame without its header")
            head: FrameHead = messages.decode(attachment, FrameHead, MAX_HEAD)
        except Malformed as error:
            self.malformed += 1
            self._malformed_log.warning(key, "ignored a frame on %.200r: %s", key, error)
            return None
        return Frame(key, head, jpeg, arrived)

    async def next(self, timeout: float) -> Frame | None:
        """Wait for the newest frame; return None if none arrived within `timeout` seconds."""
        with suppress(TimeoutError):
            async with asyncio.timeout(timeout):
                while (frame := self.take()) is None:
                    await self._arrived.wait()
                return frame
        return None

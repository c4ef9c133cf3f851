"""Frames on the mesh: large, many, and only the newest is of use.

They go apart from the messages: a publisher knows whether anybody looks, a frame that can't be sent at once
is dropped, and who is slower than the frames misses those in between, never the newest.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Self

import zenoh
from zenoh.handlers import Callback

from zscout import clock, messages
from zscout.mesh.inbox import Inbox
from zscout.messages import MAX_FRAME, FrameHead, Malformed
from zscout.scheduling.model import Ns

log = logging.getLogger(__name__)

MAX_HEAD = 2_048
"""Bytes of what is attached to a frame."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One picture as it came."""

    key: str
    head: FrameHead
    jpeg: bytes
    arrived: Ns
    """On this host's clock."""


class FramePublisher:
    """Publishes frames on one key. `put` may be called from any one thread at a time."""

    def __init__(self, session: zenoh.Session, key: str, inbox: Inbox) -> None:
        self._publisher = session.declare_publisher(
            key,
            encoding=zenoh.Encoding.IMAGE_JPEG,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA,
            express=True,
        )
        self._inbox = inbox
        self._watched = False
        self._listener: object | None = None

    @property
    def watched(self) -> bool:
        """Whether anybody subscribes, as far as is known since `follow`."""
        return self._watched

    def follow(self, changed: Callable[[bool], None]) -> None:
        """Calls `changed(watched)` in the event loop from now on, first with how it stands."""

        def tell(watched: bool) -> None:
            if watched != self._watched:
                self._watched = watched
                changed(watched)

        def on_matching(status: zenoh.MatchingStatus) -> None:
            self._inbox.offer(None, tell, bool(status.matching))

        self._listener = self._publisher.declare_matching_listener(
            Callback(on_matching, _nothing, indirect=False)
        )
        # The package's own types call it a bool; the object it gives is true in either case.
        status: Any = self._publisher.matching_status
        tell(bool(status.matching))

    def put(self, head: FrameHead, jpeg: bytes) -> None:
        """Publishes a frame, or drops it where that would have to wait. Raises ValueError for more than
        MAX_FRAME bytes."""
        if len(jpeg) > MAX_FRAME:
            raise ValueError(f"a frame of {len(jpeg)} bytes is too large; at most {MAX_FRAME} are sent")
        try:
            self._publisher.put(jpeg, attachment=messages.encode(head))
        except zenoh.ZError as error:
            log.warning("a frame on %s was not sent: %s", self._publisher.key_expr, error)

    def close(self) -> None:
        self._publisher.undeclare()  # type: ignore[no-untyped-call]


class FrameWatch:
    """The newest frame on a key (or of each publication on a key expression, whichever came last)."""

    def __init__(self, session: zenoh.Session, key: str, inbox: Inbox) -> None:
        self._inbox = inbox
        self._lock = threading.Lock()
        self._newest: tuple[zenoh.Sample, Ns] | None = None
        self._there = asyncio.Event()
        self.missed = 0
        """Frames that a newer one replaced before they were looked at."""
        self.malformed = 0
        self._subscriber = session.declare_subscriber(
            key, Callback(self._on_sample, _nothing, indirect=False)
        )

    def _on_sample(self, sample: zenoh.Sample) -> None:
        # In Zenoh's thread.
        with self._lock:
            replaced, self._newest = self._newest is not None, (sample, clock.now())
            if replaced:
                self.missed += 1
        if not replaced:
            self._inbox.offer(None, self._there.set)

    def take(self) -> Frame | None:
        """The newest frame, if there is one that was not taken yet."""
        with self._lock:
            newest, self._newest = self._newest, None
        self._there.clear()
        if newest is None:
            return None
        sample, arrived = newest
        attachment = sample.attachment
        try:
            if len(sample.payload) > MAX_FRAME:
                raise Malformed(f"{len(sample.payload)} bytes are too many for a frame")
            if attachment is None:
                raise Malformed("a frame without its head")
            head: FrameHead = messages.decode(attachment.to_bytes(), FrameHead, MAX_HEAD)
        except Malformed as error:
            self.malformed += 1
            log.warning("ignored a frame on %.200r: %s", str(sample.key_expr), error)
            return None
        return Frame(str(sample.key_expr), head, sample.payload.to_bytes(), arrived)

    async def next(self, timeout: float) -> Frame | None:
        """The newest frame, once there is one; None if none came within `timeout` seconds."""
        try:
            async with asyncio.timeout(timeout):
                while True:
                    frame = self.take()
                    if frame is not None:
                        return frame
                    await self._there.wait()
        except TimeoutError:
            return None

    def close(self) -> None:
        self._subscriber.undeclare()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()


def _nothing() -> None:
    """Zenoh calls this when a declaration ends."""

"""From a capture to the mesh: encodes and publishes the newest picture, in a thread of its own."""

from __future__ import annotations

import logging
import statistics
import threading
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from zscout.drivers.capture import Capture, CapturedFrame
from zscout.mesh import clock
from zscout.messages import MAX_FRAME, FrameHead
from zscout.types import SECOND, Grant

if TYPE_CHECKING:
    from zscout.mesh.frames import FramePublisher

log = logging.getLogger(__name__)

MAX_AGE: Final = 1.0
"""Seconds; an older picture is not published as if it were new."""
PATIENCE: Final = 0.25
"""Seconds from one look at whether it should stop to the next, where no pictures come."""
EARLY: Final = 0.5
"""Share of the interval between two frames by which one may come early."""
GREY: Final = 3
"""Difference of the colours up to which a picture is grey: what decoding makes of a grey picture that was
coded in colour."""
MEASURED: Final = 64
"""Frames over which the latency is measured."""
RATE_SPAN: Final = 3.0
"""Seconds over which the rate is measured."""


class FramePacer:
    """At most `rate` frames a second without holding any back: one that comes too early is passed over.

    The generic cell rate algorithm (ITU-T I.371, annex A) with a tolerance of EARLY intervals, so that a
    source that is a little faster, or uneven, loses no more than what is too much. Times are seconds.
    """

    def __init__(self, rate: float) -> None:
        self._period = 1 / rate
        self._due = float("-inf")

    def admits(self, now: float) -> bool:
        """Whether a picture that is there `now` is published."""
        if now < self._due - EARLY * self._period:
            return False
        self._due = max(self._due, now) + self._period
        return True


class FrameMeter:
    """What a framegrabber has published. Written by one pump at a time, read by the event loop."""

    def __init__(self) -> None:
        self.published = 0
        self.too_large = 0
        """Frames of more than MAX_FRAME bytes, which are not sent."""
        self.width = 0
        self.height = 0
        self.size = 0
        """Bytes of the newest frame."""
        self._times: deque[float] = deque(maxlen=1_024)
        self._latencies: deque[float] = deque(maxlen=MEASURED)

    def count(self, head: FrameHead, size: int, now: float) -> None:
        self.published += 1
        self.width, self.height, self.size = head.width, head.height, size
        self._times.append(now)
        self._latencies.append(now - head.time)

    def rate(self, now: float) -> float:
        """Frames a second of late; 0 while there were none."""
        times = [time for time in list(self._times) if now - time <= RATE_SPAN]
        return (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 and times[-1] > times[0] else 0.0

    def latency(self) -> float:
        """Seconds from reading a picture to its publication: the median of the last; 0 without any."""
        return statistics.median(list(self._latencies) or [0.0])


@dataclass(frozen=True, slots=True)
class FrameOrigin:
    """Under what a picture is published: number of the picture before the capture's first, and the rest."""

    first: int
    grant: Grant
    source: str


class FramePump:
    """Publishes the pictures of a capture that are read from now on, until it is stopped.

    At most `rate` frames a second, with JPEG `quality` 1..100, and only while somebody subscribes: otherwise
    nothing is even encoded.
    """

    def __init__(
        self,
        publisher: FramePublisher,
        capture: Capture,
        meter: FrameMeter,
        shot: FrameOrigin,
        *,
        rate: float,
        quality: int,
    ) -> None:
        self._publisher = publisher
        self._capture = capture
        self._meter = meter
        self._shot = shot
        self._quality = quality
        self._pace = FramePacer(rate)
        self._after = capture.number
        self._lock = threading.Lock()
        self._stopped = False
        self._complained = False
        self._thread = threading.Thread(target=self._run, name="frame pump", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """Nothing is published any more when this returns; the thread ends a little later."""
        with self._lock:
            self._stopped = True

    def join(self) -> None:
        """Waits for the end of the thread, after `stop`: some tenths of a second at most."""
        self._thread.join()

    def _run(self) -> None:
        while not self._stopped:
            captured = self._capture.wait(self._after, PATIENCE)
            if captured is None:
                if not self._capture.alive:
                    return
                continue
            self._after = captured.number
            if self._publisher.watched and self._pace.admits(captured.time):
                self._publish(captured)

    def _publish(self, captured: CapturedFrame) -> None:
        try:
            jpeg = encode(captured.picture, self._quality)
        except cv2.error as error:
            self._complain(f"a picture can't be encoded: {str(error).strip()[:200]}")
            return
        if len(jpeg) > MAX_FRAME:
            self._meter.too_large += 1
            self._complain(
                f"frames of {len(jpeg)} bytes are too large, at most {MAX_FRAME} are sent; lower "
                "`quality`, or the resolution of the source"
            )
            return
        height, width = captured.picture.shape[:2]
        head = FrameHead(
            number=self._shot.first + captured.number,
            time=captured.time,
            width=width,
            height=height,
            grant=self._shot.grant,
            source=self._shot.source,
        )
        with self._lock:
            now = clock.now() / SECOND
            if not self._stopped and now - captured.time <= MAX_AGE:
                self._publisher.put(head, jpeg)
                self._meter.count(head, len(jpeg), now)

    def _complain(self, words: str) -> None:
        if not self._complained:
            self._complained = True
            log.warning("%s", words)


def encode(picture: NDArray[np.uint8], quality: int) -> bytes:
    """A picture as JPEG; one without colour as a grey JPEG, whatever its form. Raises cv2.error for one that
    JPEG can't have."""
    shown = picture[:, :, 1] if picture.ndim == 3 and is_grey(picture) else picture
    _, coded = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return coded.tobytes()


def is_grey(picture: NDArray[np.uint8]) -> bool:
    """Whether a BGR picture has no colour. A few of its pixels settle it for most that have."""
    few = picture[::16, ::16].astype(np.int16)
    if int(np.ptp(few, axis=2).max(initial=0)) > GREY:
        return False
    blue, green, red = cv2.split(picture)
    return cv2.norm(blue, green, cv2.NORM_INF) <= GREY and cv2.norm(green, red, cv2.NORM_INF) <= GREY

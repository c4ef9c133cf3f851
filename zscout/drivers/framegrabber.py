"""A framegrabber: pictures of an OpenCV source, published as JPEG while it is held and has subscribers.

It is tuned to the video RC in its holder's gang. A capture thread reads the source (`capture.py`), a pump thread
encodes and publishes, and the event loop supervises both. Without a picture when its node starts, or for UNWELL_AFTER
while it is held, a framegrabber reports itself unwell, keeps trying, and recovers with the first picture."""

from __future__ import annotations

import asyncio
import logging
import math
import statistics
import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping
from fractions import Fraction
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Self

import cv2
import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from zscout.config.devices import FramegrabberRc
from zscout.drivers.airtime import Bucket
from zscout.drivers.capture import Capture, CapturedFrame, seconds
from zscout.drivers.driver import Driver, RcHandle
from zscout.mesh import Refused
from zscout.messages import MAX_FRAME, Figures, FrameHead, Holder, MotionLimits, Parameter
from zscout.types import SECOND

if TYPE_CHECKING:
    from zscout.mesh.frames import FramePublisher

log = logging.getLogger(__name__)

UNWELL_AFTER: Final = 5.0
"""Seconds without a picture after which a held framegrabber is unwell; longer for a slow source."""
TRY_NEXT_AFTER: Final = 5.0
"""Seconds for each source while a framegrabber without pictures tries several; longer for a slow source."""
PICTURE_WITHIN: Final = 1.5
OPEN_TIMEOUT: Final = 2.0
OPENING: Final = 1.0
"""Seconds that a node waits for a first picture before it offers the RC as unwell."""
POLL_S: Final = 0.02
CHECK_PERIOD_S: Final = 0.2
"""Between two checks of the source."""
MAX_AGE: Final = 1.0
"""Seconds; older pictures are not published."""
FRAME_WAIT: Final = 0.25
"""Seconds between two checks whether to stop, while no pictures come."""
EARLY: Final = Fraction(1, 2)
"""Part of the interval between two frames by which a frame may come early."""
GREY: Final = 3
"""Largest difference between the colours of a grey picture, which may have been coded in colour."""
MEASURED: Final = 64
"""Frames over which the latency is measured."""
RATE_SPAN: Final = 3.0
"""Seconds over which the rate is measured."""


class FramegrabberDriver(Driver):
    """`sources`: sources for `Capture`, by the video RC that each shows; {"": source} for a single source of any
    channel. At most `rate` frames a second are published, with JPEG `quality` 1..100. `picture_within`: seconds from
    one picture to the next at most; `still_after` and `transport` as in `Capture`. `motion`: sent with each frame, for
    motion detectors.

    Commands: `tune` (`to`: a video RC, if the gang leaves it open), `snapshot` (the present state)."""

    Options = FramegrabberRc

    def __init__(
        self,
        sources: Mapping[str, str],
        *,
        rate: float,
        quality: int,
        picture_within: float = PICTURE_WITHIN,
        still_after: float | None = None,
        transport: str = "tcp",
        motion: MotionLimits | None = None,
    ) -> None:
        if not sources or not 0 < rate < math.inf or not 1 <= quality <= 100:
            raise ValueError("a framegrabber needs a source, a rate above 0 and a quality of 1 to 100")
        self._sources = dict(sources)
        self._receives = ", ".join(sorted(sources))
        self._rate, self._quality, self._motion = rate, quality, motion
        self._slow = 2 * picture_within if picture_within > PICTURE_WITHIN else 0.0
        # FFmpeg reads three pictures before it returns the first.
        opening = max(OPEN_TIMEOUT, 2 * self._slow)
        self._capturing = partial(
            Capture, open_timeout=opening, read_timeout=picture_within, still_after=still_after, transport=transport
        )
        self._faults: dict[str, str] = {}
        """The newest failure by source."""
        self._meter = FrameMeter()
        self._holder: Holder | None = None
        self._source: str | None = None
        """The key of `sources` to which it is tuned."""
        self._untuned = ""
        """Why it is held, but not tuned."""
        self._capture: Capture | None = None
        self._pump: FramePump | None = None
        self._watching: asyncio.Task[None] | None = None
        self._silent = 0.0
        """Seconds without a picture since the hold began, without stalls of this process."""
        self._unwell = False
        self._before: Counter[str] = Counter()
        """The counts of former captures."""

    @classmethod
    def configured(cls, options: Any) -> Self:
        still = options.still_after
        return cls(
            options.by_video,
            rate=options.rate,
            quality=options.quality,
            picture_within=options.picture_within / SECOND,
            still_after=None if still is None else still / SECOND,
            transport=options.transport,
            motion=options.motion,
        )

    async def open(self, rc: RcHandle) -> None:
        self._rc = rc
        self._publisher = rc.frame_publisher()
        self._publisher.follow(lambda _watched: self._close_unless_needed())
        await self._try_sources()

    async def _try_sources(self) -> None:
        """Open the sources until one has a picture. Without any it is unwell from the start."""
        end, self._unwell = seconds() + OPENING, True
        for source in sorted(self._sources):
            capture = self._open(source)
            while capture.number == 0 and not capture.failed and seconds() < end:  # noqa: ASYNC110 - set by a thread
                await asyncio.sleep(POLL_S)
            if capture.number:
                self._unwell = False
                self._close_unless_needed()
                self._before.clear()
                return
            self._faults[source] = capture.health
        self._fail()

    def _fail(self) -> None:
        names = [name for name in self._faults if name]
        about = f" of {names[0]}" if len(names) == 1 else ""
        self._rc.unwell(f"no picture{about}: {'; '.join(self._faults.values())}")

    async def close(self) -> None:
        self._unwell = False
        capture, pump = self._capture, self._pump
        self._let_go()
        if pump is not None:
            await asyncio.to_thread(pump.join)
        if capture is not None:
            await asyncio.to_thread(capture.stop)
        self._publisher.close()

    async def begin(self, holder: Holder) -> None:
        self._holder = holder
        source, self._untuned = self._of_gang(holder.rcs)
        if source is None:
            log.warning("%s: held by %s, but %s", self._rc.name, holder.arc, self._untuned)
            self._stop_pump()
            if not self._unwell:
                self._let_go()
        else:
            self._tune(source, holder)

    async def safe(self) -> None:
        self._holder = None
        self._stop_pump()
        self._close_unless_needed()

    async def command(self, holder: Holder, do: Mapping[str, Any]) -> Any:
        match do.get("name"):
            case "tune":
                self._tune(self._wanted(holder, do.get("to")), holder)
                return {"source": self._source}
            case "snapshot":
                return self._snapshot()
            case _:
                return await super().command(holder, do)

    def figures(self) -> Figures:
        """Rates per second, over the last 3 s; median latency from reading to publication, over the last 64 pictures.
        `dropped`, `opened` and `stalls` count since the node started."""
        totals, meter = self._totals(), self._meter
        return {
            "frames_per_second": round(meter.rate(seconds()), 1),
            "latency_ms": round(1000 * meter.latency(), 1),
            "published": meter.published,
            "dropped": totals["dropped"],
            "opened": totals["opened"],
            "stalls": totals["stalls"],
            "frozen_seconds": round(self._capture.frozen) if self._capture is not None else 0,
            "too_large": meter.too_large,
            "width": meter.width,
            "height": meter.height,
            "bytes": meter.size,
        }

    def parameters(self) -> list[Parameter]:
        return []

    def _totals(self) -> Counter[str]:
        own = {name: getattr(self._capture, name, 0) for name in ("number", "dropped", "opened", "stalls")}
        return self._before + Counter(own)

    def _of_gang(self, rcs: list[str]) -> tuple[str | None, str]:
        """Return the source that a gang determines, or None and the reason."""
        if "" in self._sources:
            return "", ""
        videos = [rc for rc in rcs if rc.startswith("video/")]
        known = sorted(rc for rc in videos if rc in self._sources)
        if known:
            return known[0], ""
        if videos:
            return None, f"it does not receive {', '.join(videos)}; it receives {self._receives}"
        if len(self._sources) == 1:
            return next(iter(self._sources)), ""
        return None, f"no video channel is in its hold; tune it to one of {self._receives}"

    def _wanted(self, holder: Holder, to: object) -> str:
        if "" in self._sources:
            raise Refused("bad_command", f"{self._rc.name} has only one source; there is nothing to tune")
        if not isinstance(to, str) or to not in self._sources:
            raise Refused("bad_command", f"{self._rc.name} receives {self._receives}; set `to` to one of them")
        videos = [rc for rc in holder.rcs if rc.startswith("video/")]
        if videos and to not in videos:
            raise Refused("bad_command", f"your request holds {', '.join(videos)}, not {to}; request {to} as well")
        return to

    def _tune(self, source: str, holder: Holder) -> None:
        self._stop_pump()
        self._untuned, self._silent = "", 0.0
        capture = self._capture
        if capture is None or source != self._source:
            capture = self._open(source)
        head = FrameHead(
            self._before["number"], 0, width=0, height=0, grant=holder.grant, source=source, motion=self._motion
        )
        used = partial(self._rc.used, holder.grant)
        rate, quality = self._rate, self._quality
        self._pump = FramePump(self._publisher, capture, self._meter, head, used, rate=rate, quality=quality)

    def _open(self, source: str) -> Capture:
        self._let_go()
        self._source = source
        capture = self._capture = self._capturing(self._sources[source])
        if self._watching is None or self._watching.done():
            self._watching = self._rc.supervisor.spawn(self._watch_over())
        return capture

    def _let_go(self) -> None:
        """Stop reading. The capture's thread ends by itself, without waiting here."""
        self._stop_pump()
        if self._capture is not None:
            self._capture.stop(0)
            self._before = self._totals()
        self._capture = self._source = None

    def _stop_pump(self) -> None:
        if self._pump is not None:
            self._pump.stop()
        self._pump = None

    def _close_unless_needed(self) -> None:
        """Keep the source while held, unwell or watched: then the next holder has its picture at once."""
        if self._holder is None and not self._publisher.watched and not self._unwell:
            self._let_go()

    async def _watch_over(self) -> None:
        """Report the RC unwell without pictures, and recovered when they return."""
        seen, last = (self._capture, 0), seconds()
        while (capture := self._capture) is not None:
            now, newest = seconds(), (capture, capture.number)
            if newest == seen:
                # If this process stalled, its capture did too: the source is not at fault.
                self._silent += min(now - last, 2 * CHECK_PERIOD_S)
            else:
                self._silent = 0.0
                if self._unwell and capture.number > 0:
                    self._unwell = False
                    self._faults.clear()
                    self._rc.recover()
                    self._close_unless_needed()
            seen, last = newest, now
            if self._unwell:
                name = self._source or ""
                if capture.failed and self._faults.get(name) != capture.health:
                    self._faults[name] = capture.health
                    self._fail()
                if self._silent > max(TRY_NEXT_AFTER, self._slow) and self._holder is None:
                    self._try_next()
            elif self._holder is not None and self._silent > (patience := max(UNWELL_AFTER, self._slow)):
                self._unwell = True
                about = f" of {self._source}" if self._source else ""
                self._faults = {self._source or "": capture.health}
                self._rc.unwell(f"no picture{about} for {patience:g} s: {capture.health}")
            await asyncio.sleep(CHECK_PERIOD_S)

    def _try_next(self) -> None:
        """Open the next of several sources, so that a dead source does not block the others."""
        names = sorted(self._sources)
        if len(names) > 1 and self._source is not None:
            self._open(names[(names.index(self._source) + 1) % len(names)])

    def _snapshot(self) -> dict[str, Any]:
        capture = self._capture
        if capture is None:
            return {"source": None, "health": self._untuned or "not open", "number": 0}
        number = self._before["number"] + capture.number
        found: dict[str, Any] = {"source": self._source, "health": capture.health, "number": number}
        newest = capture.wait(0, 0)
        if newest is not None:
            height, width = newest.picture.shape[:2]
            found |= {"width": width, "height": height, "age": round(seconds() - newest.time, 3)}
        return found


def pace_of(rate: float) -> Bucket:
    """A bucket for at most `rate` frames a second. With its tolerance of EARLY intervals a slightly faster or uneven
    source loses only its surplus (generic cell rate algorithm, ITU-T I.371, annex A)."""
    return Bucket(1 + EARLY, Fraction(rate), 0)


class FrameMeter:
    """Statistics of published frames. Written by one pump at a time, read by the event loop."""

    def __init__(self) -> None:
        self.published = self.too_large = 0
        """Frames; more than MAX_FRAME bytes are too large, and not sent."""
        self.width = self.height = self.size = 0
        """Pixels and bytes of the newest frame."""
        self._times: deque[float] = deque(maxlen=1_024)
        self._latencies: deque[float] = deque(maxlen=MEASURED)

    def count(self, head: FrameHead, size: int, now: float) -> None:
        self.published += 1
        self.width, self.height, self.size = head.width, head.height, size
        self._times.append(now)
        self._latencies.append(now - head.time)

    def rate(self, now: float) -> float:
        """Frames a second in the last RATE_SPAN; 0 without frames."""
        times = [time for time in list(self._times) if now - time <= RATE_SPAN]
        return (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 and times[-1] > times[0] else 0.0

    def latency(self) -> float:
        """Median of the seconds from reading a picture to its publication; 0 without frames."""
        return statistics.median(list(self._latencies) or [0.0])


class FramePump:
    """A thread that publishes the new pictures of a capture, until it is stopped. `head`: the common part of all frame
    heads; frame numbers count from its number. `published` is called in this thread for each frame. At most `rate`
    frames a second, with JPEG `quality` 1..100. Without subscribers nothing is even encoded."""

    def __init__(
        self,
        to: FramePublisher,
        capture: Capture,
        meter: FrameMeter,
        head: FrameHead,
        published: Callable[[], object],
        *,
        rate: float,
        quality: int,
    ) -> None:
        self._publisher, self._capture, self._meter, self._head = to, capture, meter, head
        self._published = published
        self._quality = quality
        self._pace = pace_of(rate)
        self._after = capture.number
        self._lock = threading.Lock()
        self._stopped = False
        self._complained = False
        self._thread = threading.Thread(target=self._run, name="frame pump", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Stop publishing: when this returns, no frame follows. The thread ends a little later."""
        with self._lock:
            self._stopped = True

    def join(self) -> None:
        """At most some tenths of a second, after `stop`."""
        self._thread.join()

    def _run(self) -> None:
        while not self._stopped:
            captured = self._capture.wait(self._after, FRAME_WAIT)
            if captured is None:
                if not self._capture.alive:
                    return
                continue
            self._after = captured.number
            if self._publisher.watched and self._pace.admits(1, round(captured.time * SECOND)):
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
                f"frames of {len(jpeg)} bytes are too large to send (limit {MAX_FRAME}); lower "
                "`quality`, or the resolution of the source"
            )
            return
        height, width = captured.picture.shape[:2]
        number = self._head.number + captured.number
        frozen = round(captured.frozen, 1)
        head = structs.replace(self._head, number=number, time=captured.time, width=width, height=height, frozen=frozen)
        with self._lock:
            now = seconds()
            if not self._stopped and now - captured.time <= MAX_AGE:
                self._publisher.put(head, jpeg)
                self._meter.count(head, len(jpeg), now)
                self._published()

    def _complain(self, words: str) -> None:
        if not self._complained:
            self._complained = True
            log.warning("%s", words)


def encode(picture: NDArray[np.uint8], quality: int) -> bytes:
    """Encode a picture as JPEG, and as grey JPEG if it has no colour. Raises cv2.error if JPEG can't hold it."""
    shown = picture[:, :, 1] if picture.ndim == 3 and is_grey(picture) else picture
    _, coded = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return coded.tobytes()


def is_grey(picture: NDArray[np.uint8]) -> bool:
    """Return True if a BGR picture has no colour. Most coloured pictures are detected by a few of their pixels."""
    few = picture[::16, ::16].astype(np.int16)
    if int(np.ptp(few, axis=2).max(initial=0)) > GREY:
        return False
    blue, green, red = cv2.split(picture)
    return cv2.norm(blue, green, cv2.NORM_INF) <= GREY and cv2.norm(green, red, cv2.NORM_INF) <= GREY

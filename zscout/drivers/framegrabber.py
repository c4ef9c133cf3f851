"""A framegrabber: pictures of an OpenCV source, published as JPEG while it is held and has subscribers.

It is tuned to the video RC that is in the gang of its holder. Three things happen side by side: a capture reads the
source (`capture.py`), a pump encodes and publishes in a thread of its own, and the event loop supervises both: a
framegrabber that has no picture as its node begins, or for LOST_AFTER while it is held, reports itself lost, goes on
trying, and is back with the first picture."""

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

LOST_AFTER: Final = 5.0
"""Seconds without a picture after which a framegrabber that is held is lost; a slow source has longer."""
TRY_NEXT: Final = 5.0
"""Seconds that a lost framegrabber tries one of several sources, likewise."""
PICTURE_WITHIN: Final = 1.5
OPEN_TIMEOUT: Final = 2.0
OPENING: Final = 1.0
"""Seconds that a node waits for a first picture before it offers the RC as lost."""
LOOK: Final = 0.02
CHECK: Final = 0.2
"""Seconds from one look at the source to the next."""
MAX_AGE: Final = 1.0
"""Seconds; an older picture is not published as if it were new."""
FRAME_WAIT: Final = 0.25
"""Seconds from one look at whether it should stop to the next, where no pictures come."""
EARLY: Final = Fraction(1, 2)
"""Share of the interval between two frames by which one may come early."""
GREY: Final = 3
"""Difference of the colours up to which a picture is grey: what decoding makes of a grey picture that was
coded in colour."""
MEASURED: Final = 64
"""Frames over which the latency is measured."""
RATE_SPAN: Final = 3.0
"""Seconds over which the rate is measured."""


class FramegrabberDriver(Driver):
    """`sources` are what `Capture` takes, by the video RC that each shows; {"": source} where there is only
    one, whatever it shows. At most `rate` frames a second are published, with JPEG `quality` 1..100. `picture_within`:
    seconds from one picture to the next at most; `still_after` and `transport` as `Capture` takes them. `motion`: sent
    with each frame, for whoever detects motion in it.

    Commands: `tune` (`to`: a video RC, where the gang does not settle it), `snapshot` (its present state)."""

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
            raise ValueError("a framegrabber has a source, a rate above 0 and a quality of 1 to 100")
        self._sources = dict(sources)
        self._receives = ", ".join(sorted(sources))
        self._rate, self._quality, self._motion = rate, quality, motion
        self._slow = 2 * picture_within if picture_within > PICTURE_WITHIN else 0.0
        # Before it gives the first, FFmpeg looks at three pictures.
        opening = max(OPEN_TIMEOUT, 2 * self._slow)
        self._capturing = partial(
            Capture, open_timeout=opening, read_timeout=picture_within, still_after=still_after, transport=transport
        )
        self._faults: dict[str, str] = {}
        """Of each source that failed: the newest reason."""
        self._meter = FrameMeter()
        self._holder: Holder | None = None
        self._source: str | None = None
        """Of `sources`: to what it is tuned."""
        self._untuned = ""
        """Why it is tuned to nothing while it is held."""
        self._capture: Capture | None = None
        self._pump: FramePump | None = None
        self._watching: asyncio.Task[None] | None = None
        self._silent = 0.0
        """Seconds without a picture while it was open and this process awake, since the hold began."""
        self._lost = False
        self._before: Counter[str] = Counter()
        """What the captures have counted that were let go."""

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
        """Opens its sources until one has a picture. Where none has, it is lost from the beginning."""
        end, self._lost = seconds() + OPENING, True
        for source in sorted(self._sources):
            capture = self._open(source)
            while capture.number == 0 and not capture.failed and seconds() < end:  # noqa: ASYNC110 - a thread's
                await asyncio.sleep(LOOK)
            if capture.number:
                self._lost = False
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
        self._lost = False
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
            if not self._lost:
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
        """Rates are per second, over the last 3 s; latency is from reading a picture to its publication, the
        median of the last 64; `dropped`, `opened` and `stalls` count since the node began."""
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

    # Tuning

    def _of_gang(self, rcs: list[str]) -> tuple[str | None, str]:
        """The source that a gang settles, or why it settles none."""
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
        """Publishes pictures of this source from now on, under the grant of `holder`."""
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
        """Stops reading. The capture's thread ends by itself: nobody waits for it here."""
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
        """A source stays open while the framegrabber is held, and afterwards while it has subscribers: the
        next holder has its picture at once. A lost one stays open to be found again."""
        if self._holder is None and not self._publisher.watched and not self._lost:
            self._let_go()

    async def _watch_over(self) -> None:
        """Reports the RC lost, and back, by the pictures that come."""
        seen, last = (self._capture, 0), seconds()
        while (capture := self._capture) is not None:
            now, newest = seconds(), (capture, capture.number)
            if newest == seen:
                # Where this process stood still, its capture did so too, through no fault of the source.
                self._silent += min(now - last, 2 * CHECK)
            else:
                self._silent = 0.0
                if self._lost and capture.number > 0:
                    self._lost = False
                    self._faults.clear()
                    self._rc.recover()
                    self._close_unless_needed()
            seen, last = newest, now
            if self._lost:
                name = self._source or ""
                if capture.failed and self._faults.get(name) != capture.health:
                    self._faults[name] = capture.health
                    self._fail()
                if self._silent > max(TRY_NEXT, self._slow) and self._holder is None:
                    self._try_next()
            elif self._holder is not None and self._silent > (patience := max(LOST_AFTER, self._slow)):
                self._lost = True
                about = f" of {self._source}" if self._source else ""
                self._faults = {self._source or "": capture.health}
                self._rc.unwell(f"no picture{about} for {patience:g} s: {capture.health}")
            await asyncio.sleep(CHECK)

    def _try_next(self) -> None:
        """With several sources, one that is dead must not keep the others from being used."""
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
    """Admits at most `rate` frames a second without holding any back: one that comes too early is skipped.
    Its tolerance of EARLY intervals keeps a source that is a little faster, or uneven, from losing more than
    its surplus (the generic cell rate algorithm, ITU-T I.371, annex A)."""
    return Bucket(1 + EARLY, Fraction(rate), 0)


class FrameMeter:
    """What a framegrabber has published. Written by one pump at a time, read by the event loop."""

    def __init__(self) -> None:
        self.published = self.too_large = 0
        """Frames; too large are those of more than MAX_FRAME bytes, which are not sent."""
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
        """Frames a second in the last RATE_SPAN; 0 without any."""
        times = [time for time in list(self._times) if now - time <= RATE_SPAN]
        return (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 and times[-1] > times[0] else 0.0

    def latency(self) -> float:
        """Seconds from reading a picture to its publication: the median of the last; 0 without any."""
        return statistics.median(list(self._latencies) or [0.0])


class FramePump:
    """Publishes the pictures of a capture that are read from now on, until it is stopped; in a thread of its
    own. `head` is what the heads of frames have in common; their numbers go on from its number. `published` is
    called with each frame that went out, in that thread.

    At most `rate` frames a second, with JPEG `quality` 1..100, and only while somebody subscribes: otherwise nothing is
    even encoded."""

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
        """Nothing is published any more when this returns; the thread ends a little later."""
        with self._lock:
            self._stopped = True

    def join(self) -> None:
        """Waits for the end of the thread, after `stop`: some tenths of a second at most."""
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
                f"frames of {len(jpeg)} bytes are too large, at most {MAX_FRAME} are sent; lower "
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

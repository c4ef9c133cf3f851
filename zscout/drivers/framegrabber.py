"""A framegrabber: pictures of an OpenCV source, published as JPEG while somebody holds it and somebody looks.

It is tuned to the video RC that stands in the gang of its holder. Three things happen side by side: a capture
reads the source (`capture.py`), a pump encodes and publishes in a thread of its own, and the event loop
watches over both: a framegrabber that has no picture for LOST_AFTER while it is held reports itself lost,
goes on trying, and is back with the first picture.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Self

from zscout.drivers.capture import Capture
from zscout.drivers.driver import Driver, RcHandle
from zscout.drivers.frame_pump import FrameMeter, FrameOrigin, FramePump
from zscout.mesh import Refused, clock
from zscout.messages import Figures, Holder
from zscout.types import SECOND

if TYPE_CHECKING:
    from zscout.mesh.frames import FramePublisher

log = logging.getLogger(__name__)

LOST_AFTER: Final = 5.0
"""Seconds without a picture after which a framegrabber that is held is lost."""
TRY_NEXT: Final = 5.0
"""Seconds that a lost framegrabber tries one of several sources."""
CHECK: Final = 0.2
"""Seconds from one look at the source to the next."""


@dataclass(frozen=True, slots=True)
class CaptureTotals:
    """What the captures of a framegrabber have counted that it has let go."""

    pictures: int = 0
    dropped: int = 0
    opened: int = 0
    stalls: int = 0

    def and_of(self, capture: Capture | None) -> Self:
        if capture is None:
            return self
        return type(self)(
            self.pictures + capture.number,
            self.dropped + capture.dropped,
            self.opened + capture.opened,
            self.stalls + capture.stalls,
        )


class FramegrabberDriver(Driver):
    """`sources` are what `Capture` takes, by the video RC that each shows; {"": source} where there is only
    one, whatever it shows. At most `rate` frames a second are published, with JPEG `quality` 1..100.

    Commands: `tune` (`to`: a video RC, where the gang does not settle it), `snapshot` (how things stand).
    """

    _rc: RcHandle
    _publisher: FramePublisher

    def __init__(self, sources: Mapping[str, str], *, rate: float, quality: int) -> None:
        if not sources or not 0 < rate < math.inf or not 1 <= quality <= 100:
            raise ValueError("a framegrabber has a source, a rate above 0 and a quality of 1 to 100")
        self._sources = dict(sources)
        self._rate = rate
        self._quality = quality
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
        self._before = CaptureTotals()

    async def open(self, rc: RcHandle) -> None:
        self._rc = rc
        self._publisher = rc.mesh.frame_publisher(rc.mesh.keys.frame(rc.name))
        self._publisher.follow(self._on_watched)

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
            log.warning("%s: held by %s, but %s", self._name, holder.arc, self._untuned)
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
        totals = self._before.and_of(self._capture)
        meter = self._meter
        return {
            "frames_per_second": round(meter.rate(_now()), 1),
            "latency_ms": round(1000 * meter.latency(), 1),
            "published": meter.published,
            "dropped": totals.dropped,
            "opened": totals.opened,
            "stalls": totals.stalls,
            "too_large": meter.too_large,
            "width": meter.width,
            "height": meter.height,
            "bytes": meter.size,
        }

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
            return None, f"it does not receive {', '.join(videos)}; it receives {self._receives()}"
        if len(self._sources) == 1:
            return next(iter(self._sources)), ""
        return None, f"no video RC is in its gang; tune it to one of {self._receives()}"

    def _wanted(self, holder: Holder, to: object) -> str:
        if "" in self._sources:
            raise Refused("bad_command", f"{self._name} has one source only; there is nothing to tune")
        if not isinstance(to, str) or to not in self._sources:
            raise Refused("bad_command", f"{self._name} receives {self._receives()}; set `to` to one of them")
        videos = [rc for rc in holder.rcs if rc.startswith("video/")]
        if videos and to not in videos:
            raise Refused(
                "bad_command", f"your ARC holds {', '.join(videos)}, not {to}; ask the RCM for {to} also"
            )
        return to

    def _receives(self) -> str:
        return ", ".join(sorted(self._sources))

    def _tune(self, source: str, holder: Holder) -> None:
        """Publishes pictures of this source from now on, under the grant of `holder`."""
        self._stop_pump()
        self._untuned, self._silent = "", 0.0
        capture = self._capture
        if capture is None or source != self._source:
            capture = self._open(source)
        shot = FrameOrigin(self._before.pictures, holder.grant, source)
        self._pump = FramePump(
            self._publisher, capture, self._meter, shot, rate=self._rate, quality=self._quality
        )
        self._pump.start()

    def _open(self, source: str) -> Capture:
        self._let_go()
        self._source = source
        capture = self._capture = Capture(self._sources[source])
        capture.start()
        if self._watching is None or self._watching.done():
            self._watching = self._rc.supervisor.spawn(self._watch_over())
        return capture

    def _let_go(self) -> None:
        """Stops reading. The capture's thread ends by itself: nobody waits for it here."""
        self._stop_pump()
        if self._capture is not None:
            self._capture.stop(0)
            self._before = self._before.and_of(self._capture)
        self._capture = self._source = None

    def _stop_pump(self) -> None:
        if self._pump is not None:
            self._pump.stop()
            self._pump = None

    def _on_watched(self, _watched: bool) -> None:
        self._close_unless_needed()

    def _close_unless_needed(self) -> None:
        """A source stays open while somebody holds the framegrabber, and afterwards while somebody looks: the
        next holder has its picture at once. A lost one stays open to be found again."""
        if self._holder is None and not self._publisher.watched and not self._lost:
            self._let_go()

    # Watching over the source

    async def _watch_over(self) -> None:
        """Reports the RC lost, and back, by the pictures that come."""
        seen, last = (self._capture, 0), _now()
        while (capture := self._capture) is not None:
            now, newest = _now(), (capture, capture.number)
            if newest == seen:
                # Where this process stood still, its capture did so too: that says nothing of the source.
                self._silent += min(now - last, 2 * CHECK)
            else:
                self._silent = 0.0
                if self._lost and capture.number > 0:
                    self._found()
            seen, last = newest, now
            if self._lost:
                if self._silent > TRY_NEXT and self._holder is None:
                    self._try_next()
            elif self._holder is not None and self._silent > LOST_AFTER:
                self._lose(capture)
            await asyncio.sleep(CHECK)

    def _lose(self, capture: Capture) -> None:
        self._lost = True
        about = f" of {self._source}" if self._source else ""
        self._rc.fail(f"no picture{about} for {LOST_AFTER:g} s: {capture.health}")

    def _found(self) -> None:
        self._lost = False
        self._rc.recover()
        self._close_unless_needed()

    def _try_next(self) -> None:
        """With several sources, one that is dead must not keep the others from being used."""
        names = sorted(self._sources)
        if len(names) > 1 and self._source is not None:
            self._open(names[(names.index(self._source) + 1) % len(names)])

    # Status

    @property
    def _name(self) -> str:
        return self._rc.name

    def _snapshot(self) -> dict[str, Any]:
        capture = self._capture
        if capture is None:
            return {"source": None, "health": self._untuned or "not open", "number": 0}
        found: dict[str, Any] = {
            "source": self._source,
            "health": capture.health,
            "number": self._before.pictures + capture.number,
        }
        newest = capture.newest(0)
        if newest is not None:
            height, width = newest.picture.shape[:2]
            found |= {"width": width, "height": height, "age": round(_now() - newest.time, 3)}
        return found


def _now() -> float:
    return clock.now() / SECOND

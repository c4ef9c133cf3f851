"""Sources of pictures for `zscout motion`: files, by their own time stamps, and live sources."""

from __future__ import annotations

import os
import stat
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zscout.behaviors.perception.motion import MAX_SIDE
from zscout.config.strict import BadInput, quoted
from zscout.drivers.capture import FILE_RATE, FILE_RATES, MAX_PIXELS, MISSES, Capture, is_utf8, kind_of, seconds, shown

OPEN_TIMEOUT_S: Final = 5.0
READ_TIMEOUT_S: Final = 2.0
"""Timeouts of sources that are URLs."""
WAIT_S: Final = 0.2
"""Longest wait for one picture of a live source."""
MIN_SIDE: Final = 8
MAX_LEAP_S: Final = 86_400.0
"""Largest believable step between the time stamps of two pictures of a file."""
HEAD_BYTES: Final = 4096
TEXT_BYTES: Final = bytes((*range(7, 14), 27, *range(32, 256)))
"""The bytes of a text; the head of a video has others."""


class Shot(NamedTuple):
    """A picture at `time`, in seconds of the source; None: no picture came until then."""

    time: float
    picture: NDArray[np.uint8] | None


def open_source(source: str, report: Callable[[str], None]) -> VideoFile | LiveSource:
    """Open a file, URL or device. `report` receives failures and recoveries of a live source. Raises BadInput."""
    if not source or "\0" in source:
        raise BadInput("--source is empty; name a file, a URL or a device like /dev/video0")
    if kind_of(source) == "file":
        return VideoFile(Path(source))
    return LiveSource(source, report)


class VideoFile:
    """A video file. Times are the file's time stamps, from its first picture on."""

    def __init__(self, path: Path) -> None:
        """Raises BadInput."""
        self.name = str(path)
        try:
            if not stat.S_ISREG(path.stat().st_mode):
                raise BadInput(f"{quoted(self.name)} is not a file; name a video file, a URL or a device")
            with path.open("rb") as file:
                head = file.read(HEAD_BYTES)
        except (OSError, ValueError) as error:
            why = (error.strerror if isinstance(error, OSError) else None) or error
            raise BadInput(f"{quoted(self.name)} can't be read ({why}); name a video file, a URL or a device") from None
        no_video = BadInput(f"there is no video in {quoted(self.name)}; name a file that FFmpeg can read")
        if not is_utf8(str(path.absolute())):
            raise BadInput(
                f"the name of {quoted(self.name)} or its folder is not UTF-8, which OpenCV can't open; rename it"
            )
        # Refuse texts: FFmpeg would draw a text as a picture, and open any address in a playlist.
        if not head or not head.translate(None, TEXT_BYTES):
            raise no_video
        # FFmpeg would log every damaged picture to stderr (-8: quiet).
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        if "OPENCV_LOG_LEVEL" not in os.environ:
            cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
        # Absolute: a relative name with a colon in it would be a protocol to FFmpeg.
        self._video = cv2.VideoCapture(str(path.absolute()), cv2.CAP_FFMPEG)
        self._first = self._read() if self._video.isOpened() else None
        if self._first is None:
            self._video.release()
            raise no_video
        _check(self._first, self.name)
        rate = self._video.get(cv2.CAP_PROP_FPS)
        self._period = 1 / (rate if FILE_RATES[0] <= rate <= FILE_RATES[1] else FILE_RATE)
        count = self._video.get(cv2.CAP_PROP_FRAME_COUNT)
        self.duration = count * self._period if 1 <= count < 1e9 else None
        """Seconds; None: unknown."""

    def shots(self) -> Iterator[Shot]:
        picture, zero, last = self._first, self._stamp(), 0.0
        self._first = None
        while picture is not None:
            _check(picture, self.name)
            yield Shot(last, picture)
            picture = self._read()
            at = self._stamp() - zero
            # Replace a time stamp that is missing, goes back or leaps too far by the usual step.
            last = at if last < at <= last + MAX_LEAP_S else last + self._period

    def close(self) -> None:
        self._video.release()

    def _stamp(self) -> float:
        return float(self._video.get(cv2.CAP_PROP_POS_MSEC)) / 1000

    def _read(self) -> NDArray[np.uint8] | None:
        """Return the next picture; None at the end. Damaged pictures are skipped, at most MISSES in a row."""
        for _ in range(MISSES):
            good, picture = self._video.read()
            if good and picture.dtype == np.uint8:
                return np.asarray(picture, np.uint8)
        return None


class LiveSource:
    """As for framegrabbers: the newest picture, reopened after failures. Times are seconds since the first picture."""

    duration: float | None = None

    def __init__(self, source: str, report: Callable[[str], None]) -> None:
        """Wait for the first picture. Raises BadInput if the source fails before."""
        self.name = shown(source)
        self._report = report
        self._capture = Capture(source, open_timeout=OPEN_TIMEOUT_S, read_timeout=READ_TIMEOUT_S)
        try:
            first = None
            while first is None:
                first = self._capture.wait(0, WAIT_S)
                if first is None and self._capture.failed:
                    raise BadInput(f"{self._capture.health}; name a source that delivers pictures")
            _check(first.picture, self.name)
        except BaseException:
            self.close()
            raise
        self._zero = first.time

    def shots(self) -> Iterator[Shot]:
        """Yield all pictures, without end; an empty shot every WAIT_S without a picture."""
        number, missing, frozen = 0, None, False
        while True:
            taken = self._capture.wait(number, WAIT_S)
            if taken is not None:
                if bool(taken.frozen) != frozen:
                    frozen = not frozen
                    words = f"is frozen: the same picture for {taken.frozen:.0f} s" if frozen else "has new pictures"
                    self._report(f"{self.name} {words}")
                number, at = taken.number, taken.time - self._zero
                if missing is not None:
                    self._report(f"{self.name} delivers pictures again, after {at - missing:.1f} s")
                    missing = None
                _check(taken.picture, self.name)
                yield Shot(at, taken.picture)
                continue
            now = seconds() - self._zero
            health = self._capture.health
            if health != "ok" and missing is None:
                missing = now
                self._report(f"{health}; opening it again")
            yield Shot(now, None)

    def close(self) -> None:
        self._capture.stop()


def _check(picture: NDArray[np.uint8], name: str) -> None:
    height, width = picture.shape[:2]
    if min(height, width) < MIN_SIDE or max(height, width) > MAX_SIDE or height * width > MAX_PIXELS:
        raise BadInput(
            f"the pictures of {quoted(name)} are {width} by {height} pixels; each side must have {MIN_SIDE} to "
            f"{MAX_SIDE} pixels, and the picture at most {MAX_PIXELS // 1_000_000} million"
        )

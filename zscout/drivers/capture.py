"""The newest picture of any source that OpenCV can open: a device, a file, or a URL.

OpenCV returns pictures in order, however old they are: a slow reader falls further and further behind. So a thread
reads all of them and keeps only the newest. It reopens its source whenever that fails, and describes its state in
`health`."""

from __future__ import annotations

import atexit
import logging
import os
import re
import stat
import threading
import weakref
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal
from urllib.parse import urlsplit

import cv2
import numpy as np
from numpy.typing import NDArray

from zscout.drivers.source_fault import REMEDY, UNDECODABLE, why_closed
from zscout.mesh import clock
from zscout.types import SECOND

log = logging.getLogger(__name__)

PAUSES: Final = (0.2, 2.0)
"""Seconds between two attempts to open a source: the first, and the longest."""
MAX_PIXELS: Final = 1 << 24
"""Largest picture. Larger pictures count as a failure of the source."""
FILE_RATE: Final = 25.0
"""Pictures a second of a file without a rate, or with a rate outside FILE_RATES."""
FILE_RATES: Final = (0.1, 240.0)
STALLED: Final = 0.8
"""A read that fails after this part of its timeout has timed out; if it fails sooner, the source was cut off."""
MISSES: Final = 3
"""This many failed reads in a row end a source: FFmpeg skips single pictures that it can't decode."""
STILL_AFTER: Final = 10.0
"""A camera counts as frozen after this many seconds of identical pictures, because sensors have noise."""
OPTIONS: Final = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
ASKING: Final = 2.0
"""Seconds for a camera's server to answer why it sends no pictures."""
EXIT_WAIT: Final = 2.5
"""Seconds that the exit of the process waits for threads inside OpenCV: longer than their timeouts."""

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")


@dataclass(frozen=True, slots=True)
class CapturedFrame:
    """`number` counts from 1, also over reopenings of the source; `time`: when it was read, in seconds of this host's
    clock; `picture`: uint8, (height, width) or (height, width, 3) BGR."""

    number: int
    time: float
    picture: NDArray[np.uint8]
    frozen: float = 0.0
    """For how many seconds all pictures have been identical, if the source counts as frozen; else 0."""


class Capture:
    """Reads one source in a thread of its own, until `stop`.

    `source` is a device (`/dev/video0`, or its number), a URL (`http://`, `rtsp://`, ...) or a file, which is read at
    its own rate and repeated. `open_timeout` and `read_timeout` are in seconds; a source without a picture for
    `read_timeout` is reopened. `still_after`: seconds of bitwise identical pictures after which it is `frozen`; 0:
    never; None: STILL_AFTER, and never for files. `transport` of RTSP: tcp or udp. All attributes can be read from any
    thread."""

    def __init__(
        self,
        source: str,
        *,
        open_timeout: float = 2.0,
        read_timeout: float = 1.5,
        still_after: float | None = None,
        transport: str = "tcp",
    ) -> None:
        self.source = source
        self.kind = kind_of(source)
        self.failed = False
        """True if the source could not be opened, or no longer gives pictures."""
        self.health = "not open yet"
        """`ok` while pictures come; otherwise the fault as text, without passwords of a URL."""
        self.number = 0
        """Number of the newest picture; 0 before the first."""
        self.opened = 0
        """How often the source was opened."""
        self.dropped = 0
        """Pictures that a newer picture replaced before they were read."""
        self.frozen = 0.0
        """For how many seconds its pictures have been identical; 0 while that is less than `still_after`."""
        self.stalls = 0
        """How often an open source gave no picture for `read_timeout`."""
        self._open_timeout, self._read_timeout = open_timeout, read_timeout
        self._still_after = (0.0 if self.kind == "file" else STILL_AFTER) if still_after is None else still_after
        self._same_since = 0.0
        self._transport = transport
        self._stop = threading.Event()
        self._new_picture = threading.Condition()
        self._newest: CapturedFrame | None = None
        self._taken = True
        self._due = 0.0
        # A daemon, so that the process can exit without waiting until OpenCV gives up.
        self._thread = threading.Thread(target=self._run, name=f"capture {shown(source)}"[:60], daemon=True)
        self._thread.start()
        _LIVING.add(self)

    def stop(self, wait: float = 1.0) -> None:
        """Stop, and wait at most `wait` seconds for the thread. In OpenCV it ends only at the source's timeout."""
        self._stop.set()
        with self._new_picture:
            self._new_picture.notify_all()
        self._thread.join(wait)

    @property
    def alive(self) -> bool:
        """True while the thread runs; after `stop`, while it is blocked in OpenCV."""
        return self._thread.is_alive()

    def wait(self, after: int, timeout: float) -> CapturedFrame | None:
        """Return the newest picture, numbered above `after`; None after `timeout` seconds, or once stopped."""
        with self._new_picture:
            self._new_picture.wait_for(lambda: self.number > after or self._stop.is_set(), timeout)
            if self._stop.is_set() or self.number <= after:
                return None
            self._taken = True
            return self._newest

    def _run(self) -> None:
        pause = PAUSES[0]
        while not self._stop.is_set():
            before = self.number
            try:
                self._read_all()
            except cv2.error as error:
                self._set_health(f"OpenCV failed on {shown(self.source)}: {str(error).strip()[:200]}")
            if self.number > before:
                pause = PAUSES[0]
                if self.kind == "file":
                    continue
            self._stop.wait(pause)
            pause = min(2 * pause, PAUSES[1])

    def _read_all(self) -> None:
        began = seconds()
        with _TRANSPORT.of(self._transport, self.source):
            video = _open(self.source, self.kind, self._open_timeout, self._read_timeout)
        try:
            if not video.isOpened():
                self._set_health(self._why_closed(seconds() - began))
                return
            self.opened += 1
            if self.health == "not open yet":
                self.health = "open, no picture yet"
            before = self.number
            period = _file_period(video) if self.kind == "file" else 0.0
            misses = 0
            while not self._stop.is_set():
                if period and not misses:
                    # After a stall, continue at the normal rate instead of catching up.
                    self._due = max(self._due + period, seconds())
                    if self._stop.wait(max(0.0, self._due - seconds())):
                        return
                asked = seconds()
                good, picture = video.read()
                if self._stop.is_set():
                    return
                if not good:
                    misses += 1
                    waited = seconds() - asked
                    if misses < MISSES and waited < STALLED * self._read_timeout:
                        continue
                    self._ended(video, waited, pictures=self.number - before)
                    return
                misses = 0
                height, width = picture.shape[:2]
                if picture.dtype != np.uint8 or height * width > MAX_PIXELS:
                    size = f"{width} by {height} pixels; at most {MAX_PIXELS // 1_000_000} million can be"
                    wrong = size if picture.dtype == np.uint8 else "not of 8 bits"
                    self._set_health(f"the pictures of {shown(self.source)} are {wrong}")
                    return
                self._keep(np.asarray(picture, np.uint8))
        finally:
            video.release()

    def _keep(self, picture: NDArray[np.uint8]) -> None:
        now, was = seconds(), self.frozen
        if self._newest is None or not _same(picture, self._newest.picture):
            self._same_since = now
        still = now - self._same_since
        frozen = still if self._still_after and still >= self._still_after else 0.0
        health = f"frozen: the same picture for more than {self._still_after:g} s" if frozen else "ok"
        if frozen and not was:
            log.warning("%s is %s", shown(self.source), health)
        elif self.health != health:
            log.info("%s gives %spictures", shown(self.source), "new " if was else "")
        with self._new_picture:
            if not self._taken:
                self.dropped += 1
            self._taken = False
            self.number += 1
            self._newest = CapturedFrame(self.number, now, picture, frozen)
            self.health, self.failed, self.frozen = health, False, frozen
            self._new_picture.notify_all()

    def _ended(self, video: cv2.VideoCapture, waited: float, *, pictures: int) -> None:
        name = shown(self.source)
        if codec := self.number == 0 and UNDECODABLE.get(_codec(video)):
            self._set_health(f"{name} sends {codec}, which can't be decoded here; {REMEDY}")
        elif self.kind == "file":
            if self.number == 0:
                self._set_health(f"there is no picture in {name}")
        elif waited >= STALLED * self._read_timeout:
            self.stalls += 1
            self._set_health(f"no picture from {name} for {self._read_timeout:g} s")
        elif pictures != 1:  # a still camera is reopened for each picture
            self._set_health(f"{name} was cut off")

    def _why_closed(self, waited: float) -> str:
        name = shown(self.source)
        if self.kind == "url":
            late = waited >= STALLED * self._open_timeout
            why = None if self._stop.is_set() else why_closed(self.source, min(ASKING, self._open_timeout))
            if late and (why is None or "did not answer" in why):
                slow = "" if why else "; if it gives pictures as rarely, raise picture_within"
                return f"{name} did not answer within {self._open_timeout:g} s{slow}"
            return f"{name} can't be opened: {why or 'it sends nothing that OpenCV can decode'}"
        path = _device_path(self.source) if self.kind == "device" else Path(self.source)
        try:
            mode = path.stat().st_mode
        except OSError as error:
            return f"{name} can't be opened: {error.strerror}"
        if not os.access(path, os.R_OK):
            return f"{name} can't be opened: permission denied"
        if self.kind == "device":
            return f"{name} can't be opened: is it a camera, and free?"
        return f"{name} can't be opened: it is not a video" if stat.S_ISREG(mode) else f"{name} is not a file"

    def _set_health(self, words: str) -> None:
        if words != self.health:
            log.warning("%s", words)
            self.health, self.failed = words, True


_LIVING: weakref.WeakSet[Capture] = weakref.WeakSet()


@atexit.register
def _stop_all() -> None:
    """Stop all captures: a thread that returns from OpenCV during interpreter shutdown would abort the process."""
    captures = list(_LIVING)
    for capture in captures:
        capture.stop(0)
    end = seconds() + EXIT_WAIT
    for capture in captures:
        capture.stop(max(0.0, end - seconds()))


class _Transport:
    """OpenCV reads RTSP's transport from the environment on opening: sources with different ones open in turn."""

    def __init__(self) -> None:
        self._turn = threading.Lock()
        self._changed = threading.Condition()
        self._given: str | None = None
        self._now, self._opening = "tcp", 0

    @contextmanager
    def of(self, transport: str, source: str) -> Iterator[None]:
        if not source.lower().startswith("rtsp"):
            yield
            return
        with self._turn, self._changed:
            self._changed.wait_for(lambda: not self._opening or self._now == transport)
            if transport != self._now:
                if transport == "udp":
                    self._given = os.environ.get(OPTIONS)
                    # With `udp+tcp`, FFmpeg itself falls back to TCP.
                    os.environ[OPTIONS] = f"{self._given or 'fflags;discardcorrupt'}|rtsp_transport;udp+tcp"
                elif self._given is not None:
                    os.environ[OPTIONS] = self._given
                else:
                    del os.environ[OPTIONS]
                self._now = transport
            self._opening += 1
        try:
            yield
        finally:
            with self._changed:
                self._opening -= 1
                self._changed.notify_all()


_TRANSPORT: Final = _Transport()


def kind_of(source: str) -> Literal["device", "file", "url"]:
    """The kind of a source, by its spelling alone."""
    if (source.isascii() and source.isdigit()) or source.startswith("/dev/"):
        return "device"
    return "url" if _URL.match(source) else "file"


def shown(source: str) -> str:
    """Return a source for messages and logs: a URL without user, password and query, which may be secret."""
    if kind_of(source) != "url":
        return source
    try:
        parts = urlsplit(source)
        host = parts.hostname or ""
        port = "" if parts.port is None else f":{parts.port}"
    except ValueError:
        return f"{source.partition('://')[0]}://..."
    host = f"[{host}]" if ":" in host else host
    return f"{parts.scheme}://{host}{port}{parts.path}"


def is_utf8(name: str) -> bool:
    """Return True if the name is valid UTF-8. OpenCV aborts the process at other names."""
    return not any("\ud800" <= char <= "\udfff" for char in name)


def _open(source: str, kind: str, open_timeout: float, read_timeout: float) -> cv2.VideoCapture:
    # These variables are read when a backend is first used. -8: quiet, as FFmpeg would log every torn picture on the
    # node's stderr. discardcorrupt: FFmpeg would return half pictures as whole ones. rtsp_transport;tcp: OpenCV's own
    # default. THREAD_SAFE: with OpenCV's lock, one silent server blocks the opening of all other sources; FFmpeg needs
    # no lock since 4.0.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    os.environ.setdefault(OPTIONS, "rtsp_transport;tcp|fflags;discardcorrupt")
    os.environ.setdefault("OPENCV_FFMPEG_IS_THREAD_SAFE", "1")
    os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(max(1, round(read_timeout))))
    if "OPENCV_LOG_LEVEL" not in os.environ:
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    if not is_utf8(source):
        return cv2.VideoCapture()
    if kind == "device":
        return cv2.VideoCapture(str(_device_path(source)), cv2.CAP_V4L2)
    # One decoding thread: each further thread would delay pictures by one.
    options: list[Any] = [cv2.CAP_PROP_N_THREADS, 1]
    if kind == "url":
        options += [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, round(1000 * open_timeout)]
        options += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, round(1000 * read_timeout)]
    return cv2.VideoCapture(source, cv2.CAP_FFMPEG, options)


def _same(picture: NDArray[np.uint8], other: NDArray[np.uint8]) -> bool:
    """Return True if two pictures are bitwise identical. For most pictures a few pixels suffice."""
    few = slice(None, None, 16)
    return (
        picture.shape == other.shape
        and np.array_equal(picture[few, few], other[few, few])
        and np.array_equal(picture, other)
    )


def _codec(video: cv2.VideoCapture) -> str:
    code = int(video.get(cv2.CAP_PROP_FOURCC)) & 0xFFFFFFFF
    return code.to_bytes(4, "little").decode("ascii", "replace").strip("\0 ").lower()


def _device_path(source: str) -> Path:
    return Path(f"/dev/video{source}" if source.isdigit() else source)


def _file_period(video: cv2.VideoCapture) -> float:
    rate = video.get(cv2.CAP_PROP_FPS)
    least, most = FILE_RATES
    return 1 / (rate if least <= rate <= most else FILE_RATE)


def seconds() -> float:
    return clock.now() / SECOND

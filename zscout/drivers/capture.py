"""The newest picture of any source that OpenCV can open: a device, a file, or a URL.

OpenCV hands out pictures in order, however old they are: a reader that is too slow falls behind without end. So a
thread of its own reads all of them and keeps only the newest. It opens its source again whenever that fails, and
describes its state in words."""

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
"""Of one picture; larger ones count as a failure of the source."""
FILE_RATE: Final = 25.0
"""Pictures a second of a file without a rate, or with one beyond belief."""
FILE_RATES: Final = (0.1, 240.0)
STALLED: Final = 0.8
"""A read that failed after this share of its timeout ran into it; one that failed sooner was cut off."""
MISSES: Final = 3
"""Reads in a row that may fail: FFmpeg gives up a picture that it can't make out, and reads on."""
STILL_AFTER: Final = 10.0
"""Seconds of pictures that are all the same after which a camera counts as frozen: sensors have noise."""
OPTIONS: Final = "OPENCV_FFMPEG_CAPTURE_OPTIONS"
ASKING: Final = 2.0
"""Seconds that a camera's server may take to say why it gives no pictures."""
EXIT_WAIT: Final = 2.5
"""Seconds that the end of the process waits for threads that OpenCV holds up: longer than their timeouts."""

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*://")


@dataclass(frozen=True, slots=True)
class CapturedFrame:
    """One picture. `number` counts from 1 and goes on when the source is opened again; `time` is when it was read, in
    seconds of this host's own clock; `picture` is uint8, (height, width) or (height, width, 3) BGR."""

    number: int
    time: float
    picture: NDArray[np.uint8]
    frozen: float = 0.0
    """For how many seconds all have been like this one, if the source counts as frozen by that."""


class Capture:
    """Reads one source in a thread of its own, until `stop`.

    `source` is a device (`/dev/video0`, or its number), a URL (`http://`, `rtsp://`, ...) or else a file, which is read
    at its own rate, and from its start again when it ends. `open_timeout` and `read_timeout` are seconds; a source that
    gives no picture for `read_timeout` is opened again. `still_after`: seconds of the same picture, to the last bit,
    after which it is `frozen`; 0: never; None: STILL_AFTER for all but files. `transport` of RTSP: tcp or udp. All
    attributes may be read from any thread."""

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
        """Whether its source could not be opened, or gives no pictures any more."""
        self.health = "not open yet"
        """`ok` while pictures come; or in words what is wrong, without passwords that are in a URL."""
        self.number = 0
        """Of the newest picture; 0 while there was none."""
        self.opened = 0
        """How often the source was opened."""
        self.dropped = 0
        """Pictures that a newer one replaced before anybody looked at them."""
        self.frozen = 0.0
        """For how many seconds its pictures have all been the same; 0 while that is less than `still_after`."""
        self.stalls = 0
        """How often an open source gave nothing for `read_timeout`."""
        self._open_timeout, self._read_timeout = open_timeout, read_timeout
        self._still_after = (0.0 if self.kind == "file" else STILL_AFTER) if still_after is None else still_after
        self._same_since = 0.0
        self._transport = transport
        self._stop = threading.Event()
        self._new_picture = threading.Condition()
        self._newest: CapturedFrame | None = None
        self._taken = True
        self._due = 0.0
        # A daemon: a process that ends need not wait for ever until OpenCV has given up.
        self._thread = threading.Thread(target=self._run, name=f"capture {shown(source)}"[:60], daemon=True)
        self._thread.start()
        _LIVING.add(self)

    def stop(self, wait: float = 1.0) -> None:
        """Ends the reading, and waits at most `wait` seconds for it: a thread that OpenCV holds up ends by
        itself at the source's timeout."""
        self._stop.set()
        with self._new_picture:
            self._new_picture.notify_all()
        self._thread.join(wait)

    @property
    def alive(self) -> bool:
        """Whether the thread runs, be it only until OpenCV lets go of it."""
        return self._thread.is_alive()

    def wait(self, after: int, timeout: float) -> CapturedFrame | None:
        """The newest picture with a number above `after`, as soon as there is one; None if none came within
        `timeout` seconds, or when the capture was stopped."""
        with self._new_picture:
            self._new_picture.wait_for(lambda: self.number > after or self._stop.is_set(), timeout)
            if self._stop.is_set() or self.number <= after:
                return None
            self._taken = True
            return self._newest

    # In the thread

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
        """Opens the source, and reads it until it fails or ends."""
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
                    # After a stall it goes on from there, rather than rush through what it missed.
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
        """A source that was open gives no more pictures."""
        name = shown(self.source)
        if codec := self.number == 0 and UNDECODABLE.get(_codec(video)):
            self._set_health(f"{name} sends {codec}, which can't be decoded here; {REMEDY}")
        elif self.kind == "file":
            if self.number == 0:
                self._set_health(f"there is no picture in {name}")
        elif waited >= STALLED * self._read_timeout:
            self.stalls += 1
            self._set_health(f"no picture from {name} for {self._read_timeout:g} s")
        elif pictures != 1:  # a camera of stills is opened for each
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
    """A thread that comes out of OpenCV while the interpreter goes down would abort the process."""
    captures = list(_LIVING)
    for capture in captures:
        capture.stop(0)
    end = seconds() + EXIT_WAIT
    for capture in captures:
        capture.stop(max(0.0, end - seconds()))


class _Transport:
    """OpenCV takes the transport of RTSP from the environment alone, as it opens: sources of one transport are opened
    side by side, those of another in turn."""

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
                    # With the last, FFmpeg itself falls back to TCP.
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
    """What a source is, by its form alone."""
    if (source.isascii() and source.isdigit()) or source.startswith("/dev/"):
        return "device"
    return "url" if _URL.match(source) else "file"


def shown(source: str) -> str:
    """A source as it may be shown and logged: a URL without user, password and query, where secrets are."""
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
    """Whether OpenCV may be given this name: it ends the process at one with other bytes."""
    return not any("\ud800" <= char <= "\udfff" for char in name)


def _open(source: str, kind: str, open_timeout: float, read_timeout: float) -> cv2.VideoCapture:
    # These are read when a backend is first used. FFmpeg would complain about every torn picture on the
    # node's own stderr (-8: quiet), and hands out half a picture as a whole one unless set to discard it
    # (TCP for RTSP is what OpenCV itself asks for). Without OpenCV's lock around it one silent server held up
    # the opening of all other sources; FFmpeg has needed none since 4.0.
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
    # One thread to decode: several would each hold a picture back.
    options: list[Any] = [cv2.CAP_PROP_N_THREADS, 1]
    if kind == "url":
        options += [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, round(1000 * open_timeout)]
        options += [cv2.CAP_PROP_READ_TIMEOUT_MSEC, round(1000 * read_timeout)]
    return cv2.VideoCapture(source, cv2.CAP_FFMPEG, options)


def _same(picture: NDArray[np.uint8], other: NDArray[np.uint8]) -> bool:
    """Return True if two pictures are the same to the last bit. A few of their pixels settle it for most."""
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
    """This host's own clock, in seconds."""
    return clock.now() / SECOND

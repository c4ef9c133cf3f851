"""Whether something moves in a camera's picture, and where. Pure: time and pictures in.

    detector = MotionDetector()
    seen = detector.see(time, picture)      # seen.moving, seen.boxes

A background of running means and variances per pixel (Wren et al., "Pfinder", 1997; the two thresholds are
Canny's hysteresis), with what a real camera needs beside it:

- Rates are by time, not by picture, so that 2 and 30 pictures a second learn alike.
- Each picture is first brought to the background's brightness: gain and offset by least squares over blocks,
  from which those that do not fit are left out. So flicker, exposure and slow light changes move nothing.
- A pixel counts by how many standard deviations of its own noise it is off, never by grey levels: no tuning.
- Lines that fit the background when moved aside are torn by the transmission.
- A change of most of the picture at once is a switched light or a moved camera: it is learned at once.
- Something moves once it was seen in two of three pictures, in about the same place.

What stays is learned as that pixel's noise: whoever stops is no motion any more after a second or two, and
leaves no ghost behind when he goes. The background itself follows within half a minute.
"""

from __future__ import annotations

from collections import deque
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

WIDTH: Final = 160
"""Columns of the picture that is looked at; larger ones are reduced to it."""
MAX_SIDE: Final = 8_192
BLOCKS: Final = 20
"""Blocks across, by which brightness is compared."""
LEARN: Final = 6.0
"""Seconds in which the background follows what is no motion."""
ABSORB: Final = 30.0
"""Seconds in which it follows what is. The variance is fed by the square of it, and so
follows much sooner."""
WARM: Final = 1.0
"""Seconds of the first look: all is background, and nothing is told."""
WARM_PICTURES: Final = 4
STRONG: Final = 6.5
"""Standard deviations that begin a region."""
WEAK: Final = 3.2
"""That go on with one."""
FLOOR: Final = 1.3
"""Grey levels that the noise of a smoothed picture has at least: quantisation and compression."""
SMALLEST: Final = 0.0012
"""Share of the picture that a region has at least."""
BAND: Final = 5.0
THIN: Final = 0.07
"""A region BAND times as wide as it is high, and no higher than this share of the picture, is torn lines."""
ASIDE: Final = 32
"""Columns by which torn lines are sought aside."""
UPHEAVAL: Final = 0.55
"""Share of the picture that changes where it is not something in it that moves."""
ALL_OFF: Final = 4.0
"""Standard deviations by which the median pixel is off in a picture of something else."""
SURE: Final = 2
"""Pictures of the last RECENT in which something is seen in one place."""
RECENT: Final = 3
MEMORY: Final = 1.2
"""Seconds after which an earlier sighting confirms nothing."""
MAX_BOXES: Final = 16

Picture = NDArray[np.uint8]
_Plane = NDArray[np.float32]


class Box(NamedTuple):
    """Left, top, width and height in pixels of the source."""

    x: int
    y: int
    width: int
    height: int


class Seen(NamedTuple):
    """What a picture showed."""

    moving: bool
    boxes: tuple[Box, ...] = ()
    """Where, largest first; of a sighting that is not sure yet as well."""
    learning: bool = False
    """Nothing can be told yet, or not any more: the background is new."""


class MotionDetector:
    """The memory of one camera."""

    def __init__(self) -> None:
        self._mean: _Plane | None = None
        self._variance: _Plane
        self._begun = 0.0
        self._pictures = 0
        self._last = 0.0
        self._sightings: deque[tuple[float, NDArray[np.uint8]]] = deque(maxlen=RECENT - 1)

    def see(self, time: float, picture: Picture) -> Seen:
        """Takes a picture of shape (height, width), or (height, width, 3) in BGR, made at `time` in seconds
        of any clock. Raises ValueError for what is no picture."""
        grey, across, down = reduced(picture)
        if self._mean is None or self._mean.shape != grey.shape:
            return self._begin(time, grey)
        passed = min(1.0, max(0.0, time - self._last))
        self._last = time
        self._pictures += 1
        level = _levelled(grey, self._mean)
        away = level - self._mean
        if self._pictures < WARM_PICTURES or time - self._begun < WARM:
            self._learn(away, None, 1.0 / self._pictures, 1.0)
            return Seen(False, learning=True)
        score, middle = self._score(level, self._mean)
        if middle > ALL_OFF:
            return self._begin(time, grey)
        mask = self._regions(score, level, self._mean)
        share = float(np.count_nonzero(mask)) / mask.size
        if share > UPHEAVAL:
            return self._begin(time, grey)
        self._learn(away, mask, passed / LEARN, passed / ABSORB)
        boxes = _boxes(mask, across, down, picture.shape[1], picture.shape[0])
        return Seen(self._sure(time, mask), boxes)

    def _begin(self, time: float, grey: _Plane) -> Seen:
        self._mean = grey.copy()
        self._variance = np.full_like(grey, FLOOR**2)
        self._begun = self._last = time
        self._pictures = 1
        self._sightings.clear()
        return Seen(False, learning=True)

    def _score(self, level: _Plane, mean: _Plane) -> tuple[_Plane, float]:
        """By how many standard deviations of its noise each pixel is off, smoothed, in terms of what this
        picture's pixels are off in general. And that median."""
        # Neighbours are alike noisy: their mean is a floor under what few pictures tell of one pixel.
        spread = np.sqrt(np.maximum(np.maximum(self._variance, cv2.blur(self._variance, (5, 5))), FLOOR**2))
        score = np.abs(cv2.GaussianBlur(level - mean, (3, 3), 0)) / spread
        # Smoothing leaves about 0.4 of independent noise; what is left of it is judged by its own measure.
        middle = float(np.median(score))
        score /= middle / 0.674 if middle > 0.3 else 0.45
        return np.asarray(score, np.float32), middle

    def _learn(self, away: _Plane, mask: NDArray[np.uint8] | None, still: float, moved: float) -> None:
        """Follows the picture, by `still` and where something moves by `moved` (shares, 0 to 1)."""
        if self._mean is None:
            return
        rate: _Plane | float = min(1.0, still)
        if mask is not None:
            # Around what moves its shadow and its blur are, too.
            around = cv2.dilate(mask, np.ones((5, 5), np.uint8))
            rate = np.where(around > 0, np.float32(min(1.0, moved)), np.float32(min(1.0, still)))
        self._mean += rate * away
        self._variance += rate * (away * away - self._variance)

    def _regions(self, score: _Plane, level: _Plane, mean: _Plane) -> NDArray[np.uint8]:
        """Where the score is above WEAK, connected, and somewhere in it above STRONG: 255, elsewhere 0."""
        weak = (score > WEAK).astype(np.uint8)
        # A line that is torn, or a single hot pixel, is thinner than anything that moves.
        thick = cv2.morphologyEx(weak, cv2.MORPH_OPEN, np.ones((3, 2), np.uint8))
        weak = np.asarray(cv2.morphologyEx(thick, cv2.MORPH_CLOSE, np.ones((7, 5), np.uint8)), np.uint8)
        count, labels, stats, _ = cv2.connectedComponentsWithStats(weak, connectivity=8)
        strong = np.bincount(labels.ravel(), weights=(score > STRONG).ravel(), minlength=count)
        area = stats[:, cv2.CC_STAT_AREA]
        keep = (area >= SMALLEST * score.size) & (strong >= 0.15 * area)
        # A thin band along the lines is a fault of the transmission.
        for region in np.flatnonzero(keep & (stats[:, cv2.CC_STAT_HEIGHT] <= THIN * score.shape[0])):
            top, high = stats[region, cv2.CC_STAT_TOP], stats[region, cv2.CC_STAT_HEIGHT]
            wide = stats[region, cv2.CC_STAT_WIDTH] > BAND * high
            keep[region] = not (wide or _torn(level[top : top + high], mean[top : top + high]))
        keep[0] = False
        return np.where(keep[labels], np.uint8(255), np.uint8(0))

    def _sure(self, time: float, mask: NDArray[np.uint8]) -> bool:
        """Whether what is seen was seen lately, near there."""
        near = np.asarray(cv2.dilate(mask, np.ones((15, 25), np.uint8)), np.uint8)
        agree = sum(time - at <= MEMORY and bool(np.any(earlier & near)) for at, earlier in self._sightings)
        self._sightings.append((time, mask))
        return bool(np.any(mask)) and 1 + agree >= SURE


def reduced(picture: Picture) -> tuple[_Plane, float, float]:
    """The picture grey and WIDTH columns wide at most, and by what its columns and rows are multiplied for
    those of the source. Raises ValueError."""
    grey_shape = picture.ndim == 2 or (picture.ndim == 3 and picture.shape[2] == 3)
    if (
        picture.dtype != np.uint8
        or not grey_shape
        or not all(8 <= side <= MAX_SIDE for side in picture.shape[:2])
    ):
        raise ValueError(
            f"no picture: {picture.dtype} of shape {picture.shape}; sides of 8 to {MAX_SIDE} are taken"
        )
    height, width = picture.shape[:2]
    if width > WIDTH:
        rows = max(8, round(height * WIDTH / width))
        picture = np.asarray(cv2.resize(picture, (WIDTH, rows), interpolation=cv2.INTER_AREA), np.uint8)
    if picture.ndim == 3:
        picture = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)
    return picture.astype(np.float32), width / picture.shape[1], height / picture.shape[0]


def _levelled(grey: _Plane, mean: _Plane) -> _Plane:
    """The picture with the gain and offset taken out by which it differs from the background."""
    rows = max(2, round(BLOCKS * grey.shape[0] / grey.shape[1]))
    now = cv2.resize(grey, (BLOCKS, rows), interpolation=cv2.INTER_AREA).ravel().astype(np.float64)
    was = cv2.resize(mean, (BLOCKS, rows), interpolation=cv2.INTER_AREA).ravel().astype(np.float64)
    # Black and white have no gain.
    fits = (now > 4) & (now < 250)
    gain, offset = 1.0, 0.0
    for _ in range(3):
        if np.count_nonzero(fits) < 12:
            return grey
        x, y = was[fits], now[fits]
        spread = float(np.var(x))
        gain = float(np.mean((x - x.mean()) * (y - y.mean())) / spread) if spread > 4 else 1.0
        gain = min(2.5, max(0.4, gain))
        offset = float(y.mean() - gain * x.mean())
        off = np.abs(now - gain * was - offset)
        fits = (now > 4) & (now < 250) & (off <= max(1.5, 2.5 * float(np.median(off[fits]))))
    return ((grey - np.float32(offset)) / np.float32(gain)).astype(np.float32)


def _torn(lines: _Plane, mean: _Plane) -> bool:
    """Whether some lines of a picture look like the background's, but stand aside."""
    aside = [((lines - mean) ** 2).mean(axis=1)]
    for by in range(2, min(ASIDE, lines.shape[1] // 2)):
        aside.append(((lines[:, by:] - mean[:, :-by]) ** 2).mean(axis=1))
        aside.append(((lines[:, :-by] - mean[:, by:]) ** 2).mean(axis=1))
    return bool(np.min(aside, axis=0).sum() < 0.5 * aside[0].sum())


def _boxes(mask: NDArray[np.uint8], across: float, down: float, width: int, height: int) -> tuple[Box, ...]:
    """The regions of a mask in pixels of the source, largest first."""
    _, _, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    found = sorted(stats[1:].tolist(), key=lambda one: -one[cv2.CC_STAT_AREA])[:MAX_BOXES]
    return tuple(
        Box(
            min(width - 1, round(x * across)),
            min(height - 1, round(y * down)),
            max(1, min(width, round((x + w) * across)) - round(x * across)),
            max(1, min(height, round((y + h) * down)) - round(y * down)),
        )
        for x, y, w, h, _ in found
    )

"""Motion in a camera's pictures: where, and from when to when. Pure: times and pictures in.

A `MotionDetector` returns a `Seen` per picture, an `EventTracker` turns these into events. A background of running
means and variances per pixel (Wren et al., "Pfinder", 1997; the two thresholds are Canny's hysteresis), adapted to
real cameras:
- Rates are per second, so that 2 and 30 pictures a second learn alike.
- Each picture is adjusted to the background's brightness, by gain and offset from robust least squares over blocks. So
flicker, exposure and slow changes of light are no motion.
- A pixel's deviation is measured in standard deviations of its own noise, never in grey levels: no tuning.
- Bands of light that roll over the picture are compensated by a gain per line.
- Lines that fit the background when displaced are torn by the transmission.
- A change of most of the picture at once is a switched light or a moved camera, and is learned at once. A person
close to the lens is recognized by growing, and is not learned.
- Small regions that don't move after they appear are no motion: the digits of a clock.
- Drops of rain and flakes of snow appear in one picture each (`rain.py`).
- Motion must be in two of three pictures at about the same place, or in one picture as an upright, clear region.

Deviations that persist are learned as that pixel's noise: a person who stops is no motion after a second or two, and
leaves no ghost behind. The background itself follows within half a minute."""

from __future__ import annotations

from collections import deque
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zscout.behaviors.perception.outline import Mask, Outlines
from zscout.behaviors.perception.presence import Presence
from zscout.behaviors.perception.rain import Rain, labelled
from zscout.messages import MotionLimits

WIDTH: Final = 160  # columns of the analysed picture; larger ones are reduced to it
MAX_SIDE: Final = 8_192
BLOCKS: Final = 20  # blocks across for comparing brightness
STRIPES: Final = 16  # parts of a line for finding bands of light
DARK: Final = 8.0  # grey levels below which a part of a line has no gain of its own
FAINT: Final = 0.5  # median grey levels of such parts below which nothing is a band
BANDED: Final = 2.0  # largest factor of a band, up or down
WHITE: Final = 240.0  # grey levels from which noise may be clipped, so that a pixel follows the light less
LEARN: Final = 6.0  # seconds in which the background follows pixels without motion
ABSORB: Final = 30.0  # seconds in which it follows motion. The variance grows by the square, and follows much sooner.
WARM: Final = 1.0  # seconds of the first look: all is background, and nothing is reported
WARM_PICTURES: Final = 4
CLEARER: Final = 0.7
"""The first look restarts below this share of its noise: a camera's warm-up would hide motion for long."""
OTHER: Final = 4.0
OTHER_NOISE: Final = 2.0
"""The first look also restarts at another scene: half of the picture differs by this many grey levels and by this
multiple of its noise."""
ALIKE: Final = 1.2  # after a pause, the largest factor of a known picture's noise, up or down ...
CHANGED: Final = 0.2  # ... and the largest share of it that changed.
AGREE: Final = (0.15, 1.0)
"""Seconds, least and most, between two such pictures: another robot's last picture comes alone."""
APART: Final = 3  # so many in a row suffice if they come farther apart
STANDS: Final = 0.25  # largest share of differing pixels in a changed region that counts as still
RETURN: Final = 2.0
STRANGE: Final = 8
"""Seconds after a pause, or number of slower pictures, to wait for known ones; then all is learned again."""
STRONG: Final = 6.5  # standard deviations that begin a region
WEAK: Final = 3.2  # standard deviations that continue a region
FLOOR: Final = 1.3  # least noise of a smoothed picture in grey levels: quantisation and compression
SMALLEST: Final = 0.0012  # least share of the picture in a region
BAND: Final = 5.0
THIN: Final = 0.07  # torn lines are regions BAND times as wide as high, and no higher than this share of the picture
ASIDE: Final = 32  # largest displacement of torn lines in columns
UPHEAVAL: Final = 0.55  # share of changed pixels that no motion explains, but one that grew
NEAR: Final = 0.12  # least share of the picture in motion for a person near the lens
STIRS: Final = 0.02  # least share of that motion that changes, and ...
STILL: Final = 2.0  # ... seconds without that after which the person is learned, ...
NEAR_FOR: Final = 60.0  # ... or seconds in any case: a branch before the lens never stops
FOLLOWS: Final = 8.0  # grey levels by which light may change from one picture to the next then
LEFT: Final = 0.05  # least share of the picture that gives its noise
ALL_OFF: Final = 4.0  # standard deviations of the median pixel in a picture of another scene
UPRIGHT: Final = 0.15
CERTAIN: Final = 0.005
"""Least share of the picture's height, and of its area, in a region reported at first sight. It is also no wider than
high, and half of it above STRONG: transmission faults lie along the lines, and noise is never like it."""
SURE: Final = 2  # pictures of the last RECENT that must show anything else in one place
RECENT: Final = 3
STANDS_AT_ONCE: Final = 0.014  # largest share of the picture in a clock's digits, which change and then do not move
CHANGES: Final = 2.4  # standard deviations by which a pixel of so small a region changes
QUIET: Final = 3.0  # most noise in grey levels with which that is known
STIRS_SMALL: Final = 0.1  # least share of so small a region that changes between two pictures if it moves
MEMORY: Final = 1.2  # seconds after which an earlier sighting confirms nothing
MAX_BOXES: Final = 16
GAP: Final = 1.0  # seconds without motion that end an event

_THICK, _JOINED, _NEXT, _RIM = (np.ones(size, np.uint8) for size in ((3, 2), (7, 5), (15, 25), (5, 5)))

Picture = NDArray[np.uint8]
_Plane = NDArray[np.float32]
_Regions = NDArray[np.int32]  # left, top, width, height and area of each


class Box(NamedTuple):
    """A rectangle in pixels of the source."""

    x: int
    y: int
    width: int
    height: int


class Seen(NamedTuple):
    moving: bool
    boxes: tuple[Box, ...] = ()  # largest first, including sightings not confirmed yet
    learning: bool = False  # the background is new: nothing is known
    present: bool = False  # nothing moves, but the last mover is still there
    mask: Mask | None = None  # moving pixels, if requested and known


class Event(NamedTuple):
    """A stretch of motion. Times are seconds of the pictures' clock."""

    start: float
    end: float  # last picture with motion
    peak: float  # picture with the largest moving area
    boxes: tuple[Box, ...]  # motion at the peak, largest first, in pixels of the source
    area: Box  # around all motion of the event
    frames: int  # pictures with motion
    going_on: bool = False  # True if the watch ended during the event


class _Moving(NamedTuple):
    """The moving regions of a reduced picture."""

    mask: NDArray[np.uint8]  # 255 in them
    labels: NDArray[np.int32]  # the region of each pixel, some of which don't move
    stats: _Regions  # of all labels
    kept: NDArray[np.bool_]  # labels that move
    clear: NDArray[np.bool_]  # labels of regions that are certain at first sight

    def while_changing(self, off: _Plane, noise: float) -> NDArray[np.uint8]:
        """Leave out small regions that don't differ from another picture by `off`, as a clock's digits, unless noise
        hides changes."""
        if noise > QUIET:
            return self.mask
        # Smoothing leaves 0.6 of the noise of two pictures.
        changed = (np.abs(cv2.GaussianBlur(off, (3, 3), 0)) > 0.6 * CHANGES * max(FLOOR, noise)) & (self.mask > 0)
        area = self.stats[:, cv2.CC_STAT_AREA]
        share = np.bincount(self.labels[changed], minlength=len(area)) / np.maximum(area, 1)
        return _of_regions(self.labels, self.kept & ((share >= STIRS_SMALL) | (area > STANDS_AT_ONCE * self.mask.size)))


class _Meanwhile:
    def __init__(self, since: float, level: _Plane, mask: NDArray[np.uint8], row: int) -> None:
        self.since, self.pictures, self.row = since, 1, row
        self.level, self._mask = level.copy(), mask
        self._differ = np.zeros(level.shape, np.bool_)

    def add(self, level: _Plane, mask: NDArray[np.uint8]) -> None:
        off = level - self.level
        # Smoothing leaves 0.6 of the noise of two pictures.
        self._differ |= np.abs(cv2.GaussianBlur(off, (3, 3), 0)) > 0.6 * WEAK * max(FLOOR, _noise(level))
        self._mask = self._mask | mask
        self.pictures += 1
        self.level += off / self.pictures

    def another(self) -> NDArray[np.bool_]:
        """Return the changed regions that are still, as a mask: they are the new background. The others move, or were
        spoiled in transmission."""
        count, labels = cv2.connectedComponents(_with_rim(self._mask))
        area = np.bincount(labels.ravel(), minlength=count)
        differ = np.bincount(labels.ravel(), weights=self._differ.ravel(), minlength=count)
        stands = differ < STANDS * area
        stands[0] = False
        return np.asarray(stands[labels], np.bool_)


class _Near:
    """A person close to the lens: neither a change of light nor another scene, and not learned while moving."""

    def __init__(self, time: float, level: _Plane, mask: NDArray[np.uint8]) -> None:
        self.mask = mask
        self._since = self._stirred = time
        self._level = level

    def stirs(self, time: float, level: _Plane, mask: NDArray[np.uint8], noise: float) -> bool:
        """Take a picture and its moving pixels; return True unless the person is still, or has been there for long."""
        self.mask = mask
        # Smoothing leaves 0.6 of the noise of two pictures.
        off = np.abs(cv2.GaussianBlur(level - self._level, (3, 3), 0)) > 0.6 * WEAK * max(FLOOR, noise)
        if np.count_nonzero(off & (mask > 0)) >= STIRS * np.count_nonzero(mask):
            self._level, self._stirred = level, time
        return time - self._stirred <= STILL and time - self._since <= NEAR_FOR


class MotionDetector:
    def __init__(self, *, outlines: bool = False, limits: MotionLimits | None = None) -> None:
        """With `outlines`, also report moving pixels, and fit boxes. `limits.min_duration` is for EventTracker."""
        self._limits = limits or MotionLimits()
        self._ignored: Mask | None = None  # 255 where motion does not count; None without such regions
        self._smallest = max(SMALLEST, self._limits.min_area)
        self._outlines = Outlines() if outlines else None
        self._mean: _Plane = np.empty((0, 0), np.float32)
        self._variance = self._mean
        self._begun = self._last = 0.0
        self._pictures = 0
        self._noise = 0.0  # in grey levels: the most of the first look, or the last before a pause
        self._latest = self._mean
        self._paused = False
        self._back: float | None = None  # time of the first picture after a pause, with no gap since
        self._strange = 0  # pictures since then that did not fit
        self._meanwhile: _Meanwhile | None = None  # summary of fitting pictures since then
        self._presence = Presence()
        self._near: _Near | None = None
        self._light = 1.0, 0.0  # gain and offset of the last picture against the background
        self._middle = 0.0  # median deviation of the last picture
        self._rain = Rain()
        self._sightings: deque[tuple[float, NDArray[np.uint8], NDArray[np.uint8], _Plane]] = deque(maxlen=RECENT - 1)

    def see(self, time: float, picture: Picture) -> Seen:
        """`picture`: (height, width), or (height, width, 3) in BGR, made at `time` (seconds of any clock). Raises
        ValueError for other arrays."""
        passed = min(1.0, max(0.0, time - self._last))
        seen, regions = self._look(time, picture, passed)
        if self._outlines is None:
            return seen
        if regions is None:
            if not self._paused:
                self._outlines.learn(picture, 1.0 / self._pictures)
            return seen
        mask = self._outlines.trace(picture, regions, passed / LEARN)
        if self._ignored is not None:
            mask[self._drawn(picture.shape[1], picture.shape[0]) > 0] = 0
        return seen._replace(boxes=tuple(_fitted(box, mask) for box in seen.boxes), mask=mask)

    def _look(self, time: float, picture: Picture, passed: float) -> tuple[Seen, Mask | None]:
        """Also return the moving regions of the reduced picture, if known."""
        grey, across, down = reduced(picture)
        if self._mean.shape != grey.shape:
            return self._begin(time, grey), None
        self._last, self._latest = time, grey
        level, self._light = _levelled(grey, self._mean, self._hidden(), self._light, self._ignored)
        if self._ignored is not None:
            np.copyto(level, self._mean, where=self._ignored > 0)
        away = level - self._mean
        if self._paused:
            return self._return(time, grey, level, away, passed), None
        self._pictures += 1
        if self._pictures < WARM_PICTURES or time - self._begun < WARM:
            if self._is_no_first_look(grey, away):
                return self._begin(time, grey), None
            self._learn(away, None, 1.0 / self._pictures, 1.0)
            return Seen(False, learning=True), None
        score, middle = self._score(away)
        found = self._regions(score, level, time)
        mask = found.mask
        share = np.count_nonzero(mask) / (mask.size if self._ignored is None else max(1, np.sum(self._ignored == 0)))
        # The noise is needed only if something moves.
        noise = _median(self._variance[::4, ::4]) ** 0.5 if share or self._near is not None else 0.0
        stirs = self._near is not None and self._near.stirs(time, level, mask, noise)
        if middle > ALL_OFF or (share > UPHEAVAL and not stirs):
            return self._begin(time, grey), None
        drops = self._rain.drops
        # A pixel that is clearly off is learned slowly, even outside regions: a busy road is no noise.
        moved = mask | (score > STRONG).astype(np.uint8)
        if drops is not None:
            moved |= drops
        self._learn(away, moved, passed / LEARN, 0.0 if stirs else passed / ABSORB)
        largest = sorted(found.stats[found.kept].tolist(), key=lambda region: -region[cv2.CC_STAT_AREA])[:MAX_BOXES]
        height, width = picture.shape[:2]
        boxes = tuple(
            Box(
                min(width - 1, round(x * across)),
                min(height - 1, round(y * down)),
                max(1, min(width, round((x + w) * across)) - round(x * across)),
                max(1, min(height, round((y + h) * down)) - round(y * down)),
            )
            for x, y, w, h, _ in largest
        )
        moving = self._sure(time, found, level, noise) or any(
            not self._rain.pictures and drops is None and not self._stands_aside(level, region)
            for region in found.stats[found.clear].tolist()
        )
        if not moving or share < NEAR:
            self._near = None
        elif self._near is None:
            self._near = _Near(time, level, mask)
        if drops is not None and not moving:
            # An unconfirmed drop begins no event.
            boxes = ()
        noise = _noise(grey) if self._presence.expects(moving) else 0.0
        present = self._presence.see(time, level, self._mean, mask if moving else None, noise)
        return Seen(moving, boxes, present=present), mask

    def _is_no_first_look(self, grey: _Plane, away: _Plane) -> bool:
        """Return True if the background shows another scene, or a camera that was warming up."""
        noise, before = _noise(grey), self._noise
        self._noise = max(before, noise)
        return noise < CLEARER * before or _off(away) > max(OTHER, OTHER_NOISE * noise)

    def pause(self) -> None:
        """The first pictures after a pause that fit the background continue it; until then nothing is reported."""
        self._sightings.clear()
        self._presence.clear()
        self._near = None
        self._rain = Rain()
        if self._pictures < WARM_PICTURES:
            self._mean = np.empty((0, 0), np.float32)
        elif not self._paused:
            self._noise = _noise(self._latest)
            self._paused = True
        self._back, self._strange, self._meanwhile = None, 0, None

    def _return(self, time: float, grey: _Plane, level: _Plane, away: _Plane, passed: float) -> Seen:
        if self._back is None or passed >= AGREE[1]:
            self._back = time
        score, middle = self._score(away)
        mask = self._regions(score, level, time).mask
        changed = np.count_nonzero(mask) / mask.size
        alike = 1 / ALIKE <= _noise(grey) / max(self._noise, 1e-3) <= ALIKE
        if not alike or middle > ALL_OFF or changed > CHANGED:
            # The camera is warming up or was moved, or the picture is from another camera.
            self._meanwhile, self._strange = None, self._strange + 1
            anew = time - self._back > RETURN or self._strange >= STRANGE
            return self._begin(time, grey) if anew else Seen(False, learning=True)
        if self._meanwhile is None or time - self._meanwhile.since > AGREE[1]:
            self._meanwhile = _Meanwhile(time, level, mask, 1 if self._meanwhile is None else self._meanwhile.row + 1)
        else:
            self._meanwhile.add(level, mask)
        if time - self._meanwhile.since < AGREE[0] and self._meanwhile.row < APART:
            return Seen(False, learning=True)
        self._paused = False
        # Changes during the pause count as still. With so few pictures, their noise and mean are uncertain.
        another = self._meanwhile.another()
        noise = max(FLOOR, _noise(level)) ** 2 * (1 + 1 / self._meanwhile.pictures)
        self._mean = np.where(another, self._meanwhile.level, self._mean)
        self._variance = np.where(another, np.maximum(self._variance, np.float32(noise)), self._variance)
        return Seen(False)

    def _drawn(self, width: int, height: int) -> Mask:
        """255 in the ignored regions of a picture of this size."""
        drawn = np.zeros((height, width), np.uint8)
        for region in self._limits.ignore:
            corners = np.array(region).reshape(-1, 2) * (width, height)
            if len(corners) == 2:
                (left, top), (right, bottom) = corners
                corners = np.array([(left, top), (right, top), (right, bottom), (left, bottom)])
            # Integer coordinates are the centres of pixels.
            cv2.fillPoly(drawn, [np.rint(corners - 0.5).astype(np.int32)], (255,))
        return drawn

    def _begin(self, time: float, grey: _Plane) -> Seen:
        if self._limits.ignore and (self._ignored is None or self._ignored.shape != grey.shape):
            self._ignored = self._drawn(grey.shape[1], grey.shape[0])
        self._mean, self._latest = grey.copy(), grey
        self._variance = np.full_like(grey, FLOOR**2)
        self._begun = self._last = time
        self._pictures, self._noise, self._paused = 1, _noise(grey), False
        self._sightings.clear()
        self._presence.clear()
        self._near = None
        self._rain = Rain()
        return Seen(False, learning=True)

    def _hidden(self) -> NDArray[np.uint8] | None:
        """Return a mask, above 0 where a person near the lens was in the last picture; None without one."""
        return None if self._near is None else _with_rim(self._near.mask)

    def _score(self, away: _Plane) -> tuple[_Plane, float]:
        """By how many standard deviations each pixel is off, smoothed, relative to the median; and the median."""
        # Neighbours have similar noise: their mean bounds one pixel's few samples from below.
        spread = np.sqrt(np.maximum(np.maximum(self._variance, cv2.blur(self._variance, (5, 5))), FLOOR**2))
        score = np.abs(cv2.GaussianBlur(away, (3, 3), 0)) / spread
        hidden = self._hidden()
        if hidden is None:
            shown = score if self._ignored is None else score[self._ignored == 0]
            self._middle = _median(shown) if shown.size else 0.0
        elif (left := score[hidden == 0]).size >= LEFT * score.size:
            # The person may cover more by now, so use the lower quartile, scaled to the median of normal noise.
            noise = float(np.quantile(left, 0.25)) * 0.674 / 0.319
            self._middle = noise if noise <= ALL_OFF else self._middle
        middle = self._middle
        # Smoothing leaves about 0.4 of independent noise; judge the rest by its own median.
        score /= middle / 0.674 if middle > 0.3 else 0.45
        return np.asarray(score, np.float32), middle

    def _learn(self, away: _Plane, mask: NDArray[np.uint8] | None, still: float, moved: float) -> None:
        """Follow the picture by `still`, and in motion by `moved` (shares, 0 to 1)."""
        rate: _Plane | float = min(1.0, still)
        if mask is not None:
            rate = np.where(_with_rim(mask) > 0, np.float32(min(1.0, moved)), np.float32(min(1.0, still)))
        self._mean += rate * away
        self._variance += rate * (away * away - self._variance)

    def _regions(self, score: _Plane, level: _Plane, time: float) -> _Moving:
        """Regions of pixels above WEAK, some above STRONG."""
        weak = (score > WEAK).astype(np.uint8)
        # Torn lines and hot pixels are thinner than anything that moves.
        thick = np.asarray(cv2.morphologyEx(weak, cv2.MORPH_OPEN, _THICK), np.uint8)
        thick = self._rain.without_drops(time, thick, SMALLEST * thick.size)
        if not cv2.countNonZero(thick):
            none = np.zeros(0, np.bool_)
            return _Moving(thick, thick.astype(np.int32), np.zeros((0, 5), np.int32), none, none)
        weak = np.asarray(cv2.morphologyEx(thick, cv2.MORPH_CLOSE, _JOINED), np.uint8)
        labels, stats, _ = labelled(weak)
        strong = np.bincount(labels[score > STRONG], minlength=len(stats))
        area = stats[:, cv2.CC_STAT_AREA]
        keep = (area >= self._smallest * score.size) & (strong >= 0.15 * area)
        # A thin band along the lines is a transmission fault.
        for region in np.flatnonzero(keep & (stats[:, cv2.CC_STAT_HEIGHT] <= THIN * score.shape[0])):
            wide = stats[region, cv2.CC_STAT_WIDTH] > BAND * stats[region, cv2.CC_STAT_HEIGHT]
            keep[region] = not (wide or self._stands_aside(level, stats[region]))
        keep[0] = False
        clear = keep & (strong >= 0.5 * area) & (area >= CERTAIN * score.size)
        clear &= stats[:, cv2.CC_STAT_HEIGHT] >= np.maximum(UPRIGHT * score.shape[0], stats[:, cv2.CC_STAT_WIDTH])
        return _Moving(_of_regions(labels, keep), labels, stats, keep, clear)

    def _stands_aside(self, level: _Plane, region: _Regions | list[int]) -> bool:
        top, high = region[cv2.CC_STAT_TOP], region[cv2.CC_STAT_HEIGHT]
        return _torn(level[top : top + high], self._mean[top : top + high])

    def _sure(self, time: float, found: _Moving, level: _Plane, noise: float) -> bool:
        """Return True if recent sightings nearby confirm this sighting."""
        mask = found.mask
        agree, fresh, before = 0, np.zeros_like(mask), np.zeros_like(mask)
        moves = bool(found.kept.any())
        if moves:
            for at, earlier, whole, then in self._sightings:
                if time - at <= MEMORY and cv2.countNonZero(whole):
                    moving = found.while_changing(level - then, noise)
                    agree += bool(cv2.countNonZero(earlier & _around(moving)))
                    fresh, before = fresh | moving, before | whole
            fresh |= mask & ~_around(before)
        # A region that does not move can't confirm later sightings either.
        self._sightings.append((time, fresh, mask, level))
        return moves and 1 + agree >= (SURE if self._rain.drops is None else RECENT)


def _of_regions(labels: NDArray[np.int32], wanted: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """255 in the wanted regions, else 0."""
    return np.where(wanted, np.uint8(255), np.uint8(0)).take(labels)


def _around(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the area in which the next sighting of the same motion may be."""
    return np.asarray(cv2.dilate(mask, _NEXT), np.uint8)


def _with_rim(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.dilate(mask, _RIM), np.uint8)


def _fitted(box: Box, mask: Mask) -> Box:
    """Fit a box to the motion in it and in a rim around it; unchanged without motion."""
    rim_x, rim_y = box.width // 4 + 1, box.height // 4 + 1
    left, top = max(0, box.x - rim_x), max(0, box.y - rim_y)
    x, y, width, height = cv2.boundingRect(mask[top : box.y + box.height + rim_y, left : box.x + box.width + rim_x])
    return Box(left + x, top + y, width, height) if width else box


def reduced(picture: Picture) -> tuple[_Plane, float, float]:
    """The picture in grey, at most WIDTH columns wide, and the factors to the source's size. Raises ValueError."""
    planes = picture.ndim in (2, 3) and picture.shape[2:] in ((), (3,))
    sides = all(8 <= side <= MAX_SIDE for side in picture.shape[:2])
    if picture.dtype != np.uint8 or not planes or not sides:
        raise ValueError(f"not a picture: {picture.dtype} of shape {picture.shape}; a side has 8 to {MAX_SIDE} pixels")
    height, width = picture.shape[:2]
    if width > WIDTH:
        rows = max(8, round(height * WIDTH / width))
        picture = np.asarray(cv2.resize(picture, (WIDTH, rows), interpolation=cv2.INTER_AREA), np.uint8)
    if picture.ndim == 3:
        picture = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)
    return picture.astype(np.float32), width / picture.shape[1], height / picture.shape[0]


def _median(values: NDArray[Any]) -> float:
    """The median of numbers without NaN, for which numpy's slower function also looks."""
    half, odd = divmod(values.size, 2)
    parted = np.partition(values, half, axis=None)
    return float(parted[half]) if odd else float((parted[:half].max() + parted[half]) / 2)


def _noise(grey: _Plane) -> float:
    """Standard deviation of noise and fine texture, in grey levels, from second differences between lines."""
    return float(np.mean(np.abs(np.diff(grey, 2, axis=0)))) / 1.954


def _off(away: _Plane) -> float:
    """Median deviation of a smoothed picture in grey levels."""
    return _median(np.abs(cv2.GaussianBlur(away, (3, 3), 0)))


def _levelled(
    grey: _Plane,
    mean: _Plane,
    hidden: NDArray[np.uint8] | None,
    last: tuple[float, float],
    ignored: NDArray[np.uint8] | None = None,
) -> tuple[_Plane, tuple[float, float]]:
    """The picture at the background's brightness, without bands of light, and its gain and offset. `last`: those of the
    picture before. Pixels with `hidden` or `ignored` above 0 don't measure the light."""
    gain, offset = _light(grey, mean, hidden, last, ignored)
    near = hidden
    if ignored is not None:
        hidden = ignored if hidden is None else hidden | ignored
    bands = _bands(grey, mean, gain, offset, hidden)
    even = grey
    if bands is not None:
        even = grey / bands
        gain, offset = _light(even, mean, near, last, ignored)
    level = (even - np.float32(offset)) / np.float32(gain)
    brightest = float(mean.max())
    if max(brightest, (gain * brightest + offset) * (1.0 if bands is None else float(bands.max()))) <= WHITE:
        return level, (gain, offset)
    expected = np.float32(gain) * mean + np.float32(offset)
    if bands is not None:
        expected = bands * expected
    white = np.maximum(mean, expected) > WHITE
    if np.any(white):
        # White is clipped: any value between background and expectation fits.
        was, should = mean[white], expected[white]
        off = grey[white] - np.clip(grey[white], np.minimum(was, should), np.maximum(was, should))
        level[white] = was + off / np.float32(gain)
    return level, (gain, offset)


def _light(
    grey: _Plane,
    mean: _Plane,
    hidden: NDArray[np.uint8] | None,
    last: tuple[float, float],
    ignored: NDArray[np.uint8] | None,
) -> tuple[float, float]:
    rows = max(2, round(BLOCKS * grey.shape[0] / grey.shape[1]))
    now = cv2.resize(grey, (BLOCKS, rows), interpolation=cv2.INTER_AREA).ravel().astype(np.float64)
    was = cv2.resize(mean, (BLOCKS, rows), interpolation=cv2.INTER_AREA).ravel().astype(np.float64)
    # Black and white have no gain.
    lit = (now > 4) & (now < 250)
    if ignored is not None:
        lit &= cv2.resize(ignored, (BLOCKS, rows), interpolation=cv2.INTER_AREA).ravel() == 0
    fits = lit
    gain, offset = 1.0, 0.0
    if hidden is not None:
        lit = lit & (cv2.resize(hidden, (BLOCKS, rows), interpolation=cv2.INTER_AREA).ravel() == 0)
        gain, offset = last
        # The person may by now be in front of most other blocks.
        fits = lit & (np.abs(now - gain * was - offset) <= FOLLOWS)
    for _ in range(3):
        if np.count_nonzero(fits) < 12:
            return last if hidden is not None else (1.0, 0.0)
        x, y = was[fits], now[fits]
        x_mean, y_mean = x.sum() / x.size, y.sum() / y.size
        x -= x_mean
        spread = float(x @ x) / x.size
        gain = float(x @ (y - y_mean)) / x.size / spread if spread > 4 else 1.0
        gain = min(2.5, max(0.4, gain))
        offset = float(y_mean - gain * x_mean)
        off = np.abs(now - gain * was - offset)
        fits = lit & (off <= max(1.5, 2.5 * _median(off[fits])))
    return gain, offset


def _bands(grey: _Plane, mean: _Plane, gain: float, offset: float, hidden: NDArray[np.uint8] | None) -> _Plane | None:
    """Each line's gain if light rolls over the picture in bands, as mains lighting does, else None. Bands must halve
    the median error of the best fit without them, `gain` and `offset`."""
    stripes = STRIPES, grey.shape[0]
    now = np.asarray(cv2.resize(grey, stripes, interpolation=cv2.INTER_AREA), np.float32)
    was = np.asarray(cv2.resize(mean, stripes, interpolation=cv2.INTER_AREA), np.float32)
    expected = np.float32(gain) * was + np.float32(offset)
    shown = np.ones(now.shape, np.bool_)
    if hidden is not None:
        shown = cv2.resize(hidden, stripes, interpolation=cv2.INTER_AREA) == 0
        if np.count_nonzero(shown) < shown.size / 2:
            return None
        now = np.where(shown, now, expected)
    without = _median(np.abs(now - expected)[shown])
    if without < FAINT:
        return None
    # Moving things seldom fill half of a line's stripes.
    gains = np.sort(now / np.maximum(was, np.float32(DARK)), axis=1)
    middle = (gains[:, STRIPES // 2 - 1] + gains[:, STRIPES // 2]) / 2
    light = np.asarray(cv2.blur(middle, (1, 5)), np.float32).reshape(-1, 1)
    bands = light / max(0.1, float(light.mean()))
    if bands.max() > BANDED or bands.min() < 1 / BANDED or _median(np.abs(now - light * was)[shown]) > 0.5 * without:
        return None
    return np.asarray(bands, np.float32)


def _torn(lines: _Plane, mean: _Plane) -> bool:
    """Return True if some lines match the background only when displaced."""
    rows, columns = lines.shape
    most = min(ASIDE, columns // 2) - 1
    offsets = np.arange(-most, most + 1)
    here = lines.astype(np.float64)
    there = np.zeros((rows, columns + 2 * most))
    there[:, most:-most] = mean
    # The square of a difference, summed over the columns that overlap: of both squares, and of twice the product.
    product = np.einsum("rdx,rx->rd", np.lib.stride_tricks.sliding_window_view(there, columns, axis=1), here)
    sums, of_mean = _up_to(here), _up_to(there)
    squares = sums[:, np.minimum(columns, columns - offsets)] - sums[:, np.maximum(0, -offsets)]
    squares += of_mean[:, columns:] - of_mean[:, : 2 * most + 1]
    aside = (squares - 2 * product) / (columns - np.abs(offsets))
    still = aside[:, most].sum()
    aside[:, (most - 1, most + 1)] = np.inf
    return bool(aside.min(axis=1).sum() < 0.5 * still)


def _up_to(lines: NDArray[np.float64]) -> NDArray[np.float64]:
    """The sum of squares of the first 0, 1, 2 ... columns."""
    sums = np.zeros((lines.shape[0], lines.shape[1] + 1))
    np.cumsum(lines * lines, axis=1, out=sums[:, 1:])
    return sums


class EventTracker:
    """Turns a MotionDetector's results into events, each returned once, at its end."""

    def __init__(self, min_duration: float = 0.0) -> None:
        """Leave out events shorter than `min_duration` seconds."""
        self._shortest = min_duration
        self._event: Event | None = None  # the present event, so far
        self._most = 0
        self._first: tuple[float, tuple[Box, ...]] | None = None  # a sighting that the next picture may confirm

    @property
    def current(self) -> Event | None:
        """The present event so far, once it is long enough."""
        event = self._event
        return event if event is not None and event.end - event.start >= self._shortest else None

    def see(self, time: float, seen: Seen) -> Event | None:
        """Take the result for `time`, which must not decrease; return an event that has ended before, if any."""
        ended = self.quiet(time)
        recent = self._first is not None and time - self._first[0] <= MEMORY
        if not seen.moving:
            if seen.boxes and self._event is None and not recent:
                self._first = time, seen.boxes
            return ended
        event = self._event
        if event is None:
            # A confirmed event began with its first sighting.
            start, boxes = self._first if self._first is not None and recent else (time, ())
            event = Event(start, time, time, seen.boxes, around((*boxes, *seen.boxes)), 1 if boxes else 0)
            self._most, self._first = -1, None
        covered = sum(box.width * box.height for box in seen.boxes)
        if covered > self._most:
            self._most = covered
            event = event._replace(peak=time, boxes=seen.boxes)
        area = around((event.area, *seen.boxes))
        self._event = event._replace(end=time, area=area, frames=event.frames + 1)
        return ended

    def quiet(self, time: float) -> Event | None:
        """Take note that there was no picture until `time`; return an event that this ends, if any."""
        if self._event is None or time - self._event.end <= GAP:
            return None
        event, self._event, self._first = self.current, None, None
        return event

    def close(self) -> Event | None:
        """End the watch; return the unfinished event, if any."""
        event, self._event = self.current, None
        return event._replace(going_on=True) if event is not None else None


def around(boxes: tuple[Box, ...]) -> Box:
    if not boxes:
        return Box(0, 0, 0, 0)
    left, top = min(box.x for box in boxes), min(box.y for box in boxes)
    right = max(box.x + box.width for box in boxes)
    return Box(left, top, right - left, max(box.y + box.height for box in boxes) - top)

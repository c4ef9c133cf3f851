"""Whether something moves in a camera's picture, where, and from when to when. Pure: time and pictures in.

    detector, tracker = MotionDetector(), EventTracker()
    seen = detector.see(time, picture)      # seen.moving, seen.boxes
    event = tracker.see(time, seen)         # one that is over, or None

A background of running means and variances per pixel (Wren et al., "Pfinder", 1997; the two thresholds are
Canny's hysteresis), with what a real camera needs beside it:

- Rates are by time, not by picture, so that 2 and 30 pictures a second learn alike.
- Each picture is first brought to the background's brightness: gain and offset by least squares over blocks,
  from which those that do not fit are left out. So flicker, exposure and slow light changes move nothing.
- A pixel counts by how many standard deviations of its own noise it is off, never by grey levels: no tuning.
- Lines that fit the background when moved aside are torn by the transmission.
- A change of most of the picture at once is a switched light or a moved camera: it is learned at once.
- Something moves once it was seen in two of three pictures, in about the same place; or in one, upright and clear.

What stays is learned as that pixel's noise: whoever stops is no motion any more after a second or two, and
leaves no ghost behind on leaving. The background itself follows within half a minute.
"""

from __future__ import annotations

from collections import deque
from typing import Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zscout.behaviors.perception.outline import Mask, Outlines
from zscout.behaviors.perception.presence import Presence

WIDTH: Final = 160
"""Columns of the picture that is looked at; larger ones are reduced to it."""
MAX_SIDE: Final = 8_192
BLOCKS: Final = 20
"""Blocks across, by which brightness is compared."""
WHITE: Final = 240.0
"""Grey levels from which noise may be cut off at the top, and so a pixel does not follow the light as others do."""
LEARN: Final = 6.0
"""Seconds in which the background follows what is no motion."""
ABSORB: Final = 30.0
"""Seconds in which it follows what is. The variance is fed by the square of it, and so follows much sooner."""
WARM: Final = 1.0
"""Seconds of the first look: all is background, and nothing is reported."""
WARM_PICTURES: Final = 4
CLEARER: Final = 0.7
"""A picture of the first look whose noise is less than this part of the first one's begins it anew: the camera was
still warming up, and what its noise taught would hide what moves for a long time."""
OTHER: Final = 4.0
OTHER_NOISE: Final = 2.0
"""So does one of which half is off by more than so many grey levels, and so many times its noise: the first was of
something else. A channel may still show the robot that had it before."""
ALIKE: Final = 1.2
"""A picture after a pause has at most so many times the noise of the last before it, and at least as much less,"""
CHANGED: Final = 0.2
"""and is another in at most this share: else it is not of the background that is known."""
AGREE: Final = (0.15, 1.0)
"""Seconds, at least and at most, between two such pictures that go on with it: the last of another robot is alone."""
APART: Final = 3
"""So many in a row do that come farther apart."""
STANDS: Final = 0.25
"""Less than this share of what has become another since differs between them where it does not move."""
RETURN: Final = 2.0
STRANGE: Final = 8
"""Seconds after a pause in which pictures are waited for that fit what was known before, or so many of them where they
come farther apart; then all is learned anew."""
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
UPRIGHT: Final = 0.15
CERTAIN: Final = 0.005
"""Shares of the picture, in height and in all, that a region has at least which is told at first sight. It is no wider
than high as well, and half of it is above STRONG: what is spoiled on the way lies along the lines, and noise is nowhere
like it."""
SURE: Final = 2
"""Pictures of the last RECENT in which anything else is seen in one place."""
RECENT: Final = 3
MEMORY: Final = 1.2
"""Seconds after which an earlier sighting confirms nothing."""
MAX_BOXES: Final = 16
GAP: Final = 1.0
"""Seconds without motion that end an event; what moves again sooner goes on with it."""

Picture = NDArray[np.uint8]
_Plane = NDArray[np.float32]
_Regions = NDArray[np.int32]
"""Left, top, width, height and area of each."""


class Box(NamedTuple):
    """Left, top, width and height in pixels of the source."""

    x: int
    y: int
    width: int
    height: int


class Seen(NamedTuple):
    moving: bool
    boxes: tuple[Box, ...] = ()
    """Where, largest first; of a sighting that is not sure yet as well."""
    learning: bool = False
    """Nothing is known yet, or not any more: the background is new."""
    present: bool = False
    """Nothing moves, but what moved last is still there."""
    mask: Mask | None = None
    """Which pixels of the picture move, if that was asked for, and all is known."""


class Event(NamedTuple):
    """A stretch of motion. Times are seconds of the clock by which the pictures came."""

    start: float
    """Of the first picture in which what moves was seen."""
    end: float
    """Of the last one."""
    peak: float
    """Of the picture in which it covered most."""
    boxes: tuple[Box, ...]
    """All that moved at the peak, largest first, in pixels of the source."""
    area: Box
    """Around all that moved from start to end."""
    frames: int
    """Pictures with motion."""
    going_on: bool = False
    """It was not over when the watch was."""


class _Meanwhile:
    """What pictures after a pause show of what has become another while nobody looked."""

    def __init__(self, since: float, level: _Plane, mask: NDArray[np.uint8], row: int) -> None:
        self.since, self.pictures, self.row = since, 1, row
        self.level, self._mask = level.copy(), mask
        self._differ = np.zeros(level.shape, np.bool_)
        """Where they differ."""

    def add(self, level: _Plane, mask: NDArray[np.uint8]) -> None:
        off = level - self.level
        # Of two that are smoothed 0.6 of their noise is left.
        self._differ |= np.abs(cv2.GaussianBlur(off, (3, 3), 0)) > 0.6 * WEAK * max(FLOOR, _noise(level))
        self._mask = self._mask | mask
        self.pictures += 1
        self.level += off / self.pictures

    def another(self) -> NDArray[np.bool_]:
        """Where what is another stands: the rest moves, or was spoiled on the way."""
        count, labels = cv2.connectedComponents(_with_rim(self._mask))
        area = np.bincount(labels.ravel(), minlength=count)
        differ = np.bincount(labels.ravel(), weights=self._differ.ravel(), minlength=count)
        stands = differ < STANDS * area
        stands[0] = False
        return np.asarray(stands[labels], np.bool_)


class MotionDetector:
    def __init__(self, *, outlines: bool = False) -> None:
        """With `outlines` it tells the very pixels that move, and boxes close around them."""
        self._outlines = Outlines() if outlines else None
        self._mean: _Plane = np.empty((0, 0), np.float32)
        self._variance = self._mean
        self._begun = self._last = 0.0
        self._pictures = 0
        self._noise = 0.0
        """The most of the pictures of the first look, or that of the last before a pause; in grey levels."""
        self._latest = self._mean
        self._paused = False
        self._back: float | None = None
        """When the first picture after a pause came, with no gap since."""
        self._strange = 0
        """How many pictures after it did not fit."""
        self._meanwhile: _Meanwhile | None = None
        """What those show that have all fitted."""
        self._presence = Presence()
        self._sightings: deque[tuple[float, NDArray[np.uint8]]] = deque(maxlen=RECENT - 1)

    def see(self, time: float, picture: Picture) -> Seen:
        """Takes a picture of shape (height, width), or (height, width, 3) in BGR, made at `time` in seconds
        of any clock. Raises ValueError for what is no picture."""
        passed = min(1.0, max(0.0, time - self._last))
        seen, regions = self._look(time, picture, passed)
        if self._outlines is None:
            return seen
        if regions is None:
            if not self._paused:
                self._outlines.learn(picture, 1.0 / self._pictures)
            return seen
        mask = self._outlines.trace(picture, regions, passed / LEARN)
        return seen._replace(boxes=tuple(_fitted(box, mask) for box in seen.boxes), mask=mask)

    def _look(self, time: float, picture: Picture, passed: float) -> tuple[Seen, Mask | None]:
        """And where something moves in the reduced picture, if that is known."""
        grey, across, down = reduced(picture)
        if self._mean.shape != grey.shape:
            return self._begin(time, grey), None
        self._last, self._latest = time, grey
        level = _levelled(grey, self._mean)
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
        mask, regions, clear = self._regions(score, level)
        if middle > ALL_OFF or np.count_nonzero(mask) / mask.size > UPHEAVAL:
            return self._begin(time, grey), None
        self._learn(away, mask, passed / LEARN, passed / ABSORB)
        largest = sorted(regions.tolist(), key=lambda one: -one[cv2.CC_STAT_AREA])[:MAX_BOXES]
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
        moving = self._sure(time, mask) or any(not self._stands_aside(level, region) for region in clear.tolist())
        noise = _noise(grey) if self._presence.expects(moving) else 0.0
        present = self._presence.see(time, level, self._mean, mask if moving else None, noise)
        return Seen(moving, boxes, present=present), mask

    def _is_no_first_look(self, grey: _Plane, away: _Plane) -> bool:
        """Whether the background so far is of something else, or of a camera that was still warming up."""
        noise, before = _noise(grey), self._noise
        self._noise = max(before, noise)
        return noise < CLEARER * before or _off(away) > max(OTHER, OTHER_NOISE * noise)

    def pause(self) -> None:
        """No pictures come for a while. What is known of the background is kept: the first picture afterwards that
        fits it goes on with it. Until then nothing is reported."""
        self._sightings.clear()
        self._presence.clear()
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
        mask, _, _ = self._regions(score, level)
        changed = np.count_nonzero(mask) / mask.size
        alike = 1 / ALIKE <= _noise(grey) / max(self._noise, 1e-3) <= ALIKE
        if not alike or middle > ALL_OFF or changed > CHANGED:
            # The camera is warming up, or this is not its picture; or it is not where it was.
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
        # What is another now has become so while nobody looked, and moves no more than the rest. Nothing is known of
        # its noise but the picture's own, and its mean is as sure as so few pictures make it.
        another = self._meanwhile.another()
        noise = max(FLOOR, _noise(level)) ** 2 * (1 + 1 / self._meanwhile.pictures)
        self._mean = np.where(another, self._meanwhile.level, self._mean)
        self._variance = np.where(another, np.maximum(self._variance, np.float32(noise)), self._variance)
        return Seen(False)

    def _begin(self, time: float, grey: _Plane) -> Seen:
        self._mean, self._latest = grey.copy(), grey
        self._variance = np.full_like(grey, FLOOR**2)
        self._begun = self._last = time
        self._pictures, self._noise, self._paused = 1, _noise(grey), False
        self._sightings.clear()
        self._presence.clear()
        return Seen(False, learning=True)

    def _score(self, away: _Plane) -> tuple[_Plane, float]:
        """By how many standard deviations of its noise each pixel is off, smoothed, in terms of what this
        picture's pixels are off in general. And that median."""
        # Neighbours are alike noisy: their mean is a floor under what few pictures tell of one pixel.
        spread = np.sqrt(np.maximum(np.maximum(self._variance, cv2.blur(self._variance, (5, 5))), FLOOR**2))
        score = np.abs(cv2.GaussianBlur(away, (3, 3), 0)) / spread
        # Smoothing leaves about 0.4 of independent noise; what is left of it is judged by its own measure.
        middle = float(np.median(score))
        score /= middle / 0.674 if middle > 0.3 else 0.45
        return np.asarray(score, np.float32), middle

    def _learn(self, away: _Plane, mask: NDArray[np.uint8] | None, still: float, moved: float) -> None:
        """Follows the picture, by `still` and where something moves by `moved` (shares, 0 to 1)."""
        rate: _Plane | float = min(1.0, still)
        if mask is not None:
            rate = np.where(_with_rim(mask) > 0, np.float32(min(1.0, moved)), np.float32(min(1.0, still)))
        self._mean += rate * away
        self._variance += rate * (away * away - self._variance)

    def _regions(self, score: _Plane, level: _Plane) -> tuple[NDArray[np.uint8], _Regions, _Regions]:
        """Where the score is above WEAK, connected, and somewhere in it above STRONG: 255, elsewhere 0. Left, top,
        width, height and area of each region. And the same of those that are certain at first sight."""
        weak = (score > WEAK).astype(np.uint8)
        # A line that is torn, or a single hot pixel, is thinner than anything that moves.
        thick = cv2.morphologyEx(weak, cv2.MORPH_OPEN, np.ones((3, 2), np.uint8))
        weak = np.asarray(cv2.morphologyEx(thick, cv2.MORPH_CLOSE, np.ones((7, 5), np.uint8)), np.uint8)
        count, labels, found, _ = cv2.connectedComponentsWithStats(weak, connectivity=8)
        stats: _Regions = np.asarray(found, np.int32)
        strong = np.bincount(labels.ravel(), weights=(score > STRONG).ravel(), minlength=count)
        area = stats[:, cv2.CC_STAT_AREA]
        keep = (area >= SMALLEST * score.size) & (strong >= 0.15 * area)
        # A thin band along the lines is a fault of the transmission.
        for region in np.flatnonzero(keep & (stats[:, cv2.CC_STAT_HEIGHT] <= THIN * score.shape[0])):
            wide = stats[region, cv2.CC_STAT_WIDTH] > BAND * stats[region, cv2.CC_STAT_HEIGHT]
            keep[region] = not (wide or self._stands_aside(level, stats[region]))
        keep[0] = False
        clear = keep & (strong >= 0.5 * area) & (area >= CERTAIN * score.size)
        clear &= stats[:, cv2.CC_STAT_HEIGHT] >= np.maximum(UPRIGHT * score.shape[0], stats[:, cv2.CC_STAT_WIDTH])
        return np.where(keep[labels], np.uint8(255), np.uint8(0)), stats[keep], stats[clear]

    def _stands_aside(self, level: _Plane, region: _Regions | list[int]) -> bool:
        """Whether lines of a region are torn."""
        top, high = region[cv2.CC_STAT_TOP], region[cv2.CC_STAT_HEIGHT]
        return _torn(level[top : top + high], self._mean[top : top + high])

    def _sure(self, time: float, mask: NDArray[np.uint8]) -> bool:
        """Whether what is seen was seen lately, near there."""
        near = np.asarray(cv2.dilate(mask, np.ones((15, 25), np.uint8)), np.uint8)
        agree = sum(time - at <= MEMORY and bool(np.any(earlier & near)) for at, earlier in self._sightings)
        self._sightings.append((time, mask))
        return bool(np.any(mask)) and 1 + agree >= SURE


def _with_rim(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Around what moves its shadow and its blur are, too."""
    return np.asarray(cv2.dilate(mask, np.ones((5, 5), np.uint8)), np.uint8)


def _fitted(box: Box, mask: Mask) -> Box:
    """A box drawn close around what moves in it, or within a rim around it; as it was, if nothing does."""
    rim_x, rim_y = box.width // 4 + 1, box.height // 4 + 1
    left, top = max(0, box.x - rim_x), max(0, box.y - rim_y)
    x, y, width, height = cv2.boundingRect(mask[top : box.y + box.height + rim_y, left : box.x + box.width + rim_x])
    return Box(left + x, top + y, width, height) if width else box


def reduced(picture: Picture) -> tuple[_Plane, float, float]:
    """The picture grey and WIDTH columns wide at most, and by what its columns and rows are multiplied for
    those of the source. Raises ValueError."""
    planes = picture.ndim in (2, 3) and picture.shape[2:] in ((), (3,))
    sides = all(8 <= side <= MAX_SIDE for side in picture.shape[:2])
    if picture.dtype != np.uint8 or not planes or not sides:
        raise ValueError(f"no picture: {picture.dtype} of shape {picture.shape}; a side has 8 to {MAX_SIDE} pixels")
    height, width = picture.shape[:2]
    if width > WIDTH:
        rows = max(8, round(height * WIDTH / width))
        picture = np.asarray(cv2.resize(picture, (WIDTH, rows), interpolation=cv2.INTER_AREA), np.uint8)
    if picture.ndim == 3:
        picture = np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), np.uint8)
    return picture.astype(np.float32), width / picture.shape[1], height / picture.shape[0]


def _noise(grey: _Plane) -> float:
    """Standard deviation of a picture's noise and fine texture, in grey levels: by what lines differ from the mean of
    their neighbours."""
    return float(np.mean(np.abs(np.diff(grey, 2, axis=0)))) / 1.954


def _off(away: _Plane) -> float:
    """By how many grey levels half of a smoothed picture is off."""
    return float(np.median(np.abs(cv2.GaussianBlur(away, (3, 3), 0))))


def _levelled(grey: _Plane, mean: _Plane) -> _Plane:
    """The picture with the gain and offset taken out by which it differs from the background."""
    rows = max(2, round(BLOCKS * grey.shape[0] / grey.shape[1]))
    now = cv2.resize(grey, (BLOCKS, rows), interpolation=cv2.INTER_AREA).ravel().astype(np.float64)
    was = cv2.resize(mean, (BLOCKS, rows), interpolation=cv2.INTER_AREA).ravel().astype(np.float64)
    # Black and white have no gain.
    fits = lit = (now > 4) & (now < 250)
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
        fits = lit & (off <= max(1.5, 2.5 * float(np.median(off[fits]))))
    level = ((grey - np.float32(offset)) / np.float32(gain)).astype(np.float32)
    expected = np.float32(gain) * mean + np.float32(offset)
    white = np.maximum(mean, expected) > WHITE
    if np.any(white):
        # White may be brighter than it can be told: it stays as it was, or becomes what it should be.
        was, should = mean[white], expected[white]
        off = grey[white] - np.clip(grey[white], np.minimum(was, should), np.maximum(was, should))
        level[white] = was + off / np.float32(gain)
    return level


def _torn(lines: _Plane, mean: _Plane) -> bool:
    """Whether some lines of a picture look like the background's, but stand aside."""
    aside = [((lines - mean) ** 2).mean(axis=1)]
    for by in range(2, min(ASIDE, lines.shape[1] // 2)):
        aside.append(((lines[:, by:] - mean[:, :-by]) ** 2).mean(axis=1))
        aside.append(((lines[:, :-by] - mean[:, by:]) ** 2).mean(axis=1))
    return bool(np.min(aside, axis=0).sum() < 0.5 * aside[0].sum())


class EventTracker:
    """Takes what a MotionDetector sees. Each event comes back once, when it is over."""

    def __init__(self) -> None:
        self.current: Event | None = None
        """The event that is not over yet, as far as it goes."""
        self._most = 0
        self._first: tuple[float, tuple[Box, ...]] | None = None
        """A sighting that the next picture may confirm."""

    def see(self, time: float, seen: Seen) -> Event | None:
        """Takes what was seen at `time`, which never goes back. The event that had ended before, if any."""
        ended = self.quiet(time)
        recent = self._first is not None and time - self._first[0] <= MEMORY
        if not seen.moving:
            if seen.boxes and self.current is None and not recent:
                self._first = time, seen.boxes
            return ended
        event = self.current
        if event is None:
            # What is certain only now began with the sighting that it confirms.
            start, boxes = self._first if self._first is not None and recent else (time, ())
            event = Event(start, time, time, seen.boxes, around((*boxes, *seen.boxes)), 1 if boxes else 0)
            self._most, self._first = -1, None
        covered = sum(box.width * box.height for box in seen.boxes)
        if covered > self._most:
            self._most = covered
            event = event._replace(peak=time, boxes=seen.boxes)
        area = around((event.area, *seen.boxes))
        self.current = event._replace(end=time, area=area, frames=event.frames + 1)
        return ended

    def quiet(self, time: float) -> Event | None:
        """No picture came until `time`. The event that is over by that, if any."""
        event = self.current
        if event is None or time - event.end <= GAP:
            return None
        self.current = self._first = None
        return event

    def close(self) -> Event | None:
        """The watch is over. The event that was going on, if any."""
        event, self.current = self.current, None
        return event._replace(going_on=True) if event is not None else None


def around(boxes: tuple[Box, ...]) -> Box:
    """The box around all of these; an empty one around none."""
    if not boxes:
        return Box(0, 0, 0, 0)
    left, top = min(box.x for box in boxes), min(box.y for box in boxes)
    right = max(box.x + box.width for box in boxes)
    return Box(left, top, right - left, max(box.y + box.height for box in boxes) - top)

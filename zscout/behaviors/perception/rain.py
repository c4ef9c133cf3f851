"""Rain and snow: many small regions, each in one picture only, all the time. Pure.

A drop is elsewhere in the next picture; a person still covers part of their earlier place. While it rains, a region
counts only if it covers part of its earlier place and is larger than the drops, or if it is much larger."""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

DROP: Final = 6  # pixels of the smallest drop or flake that counts
LASTS: Final = 0.3  # largest share of a drop that was in the picture before too
PARTS: Final = (4, 3)  # of the picture, across and down: a person in pieces is in few of them
FALLS: Final = 3  # parts with drops, in each of two pictures in a row, that make rain; ...
FALLS_FOR: Final = 5.0  # ... seconds without that, after three in a row, after which the rain is over.
LARGER: Final = 2.0
MUCH_LARGER: Final = 5.0
"""Multiples of the median drop from which a region is no drop: if it covers part of where it was, and in any case."""
OFTEN: Final = 0.35  # most seconds between two pictures that show what lasts

Regions = NDArray[np.uint8]  # 0 or 1


class Rain:
    def __init__(self) -> None:
        self.drops: Regions | None = None  # of the last picture; None without rain
        self._before: Regions | None = None
        self.pictures = 0  # in a row, up to the last, with so many drops
        self._until = self._last = -math.inf

    def without_drops(self, time: float, regions: Regions, smallest: float) -> Regions:
        """The regions that are no drops; all without rain. Relevant ones have at least `smallest` pixels."""
        before, self._before, self.drops = self._before, regions, None
        passed, self._last = time - self._last, time
        if OFTEN < passed < math.inf:
            self.pictures = 0
            return regions
        if not cv2.countNonZero(regions):
            self.pictures, self.drops = 0, regions if time <= self._until else None
            return regions
        labels, stats, middles = labelled(regions)
        area = stats[:, cv2.CC_STAT_AREA]
        lasts = np.zeros(len(area), np.intp)
        if before is not None and before.shape == regions.shape:
            lasts = np.bincount(labels[before > 0], minlength=len(area))
        counts = area >= DROP
        counts[0] = False
        fresh = counts & (lasts < LASTS * area)
        across, down = PARTS[0] / regions.shape[1], PARTS[1] / regions.shape[0]
        places = {(int(x * across), int(y * down)) for x, y in middles[fresh].tolist()}
        # A crowd always shows some small pieces too.
        enough = 2 * np.count_nonzero(fresh) >= np.count_nonzero(counts)
        self.pictures = self.pictures + 1 if enough and len(places) >= FALLS else 0
        if self.pictures > 2:
            self._until = time + FALLS_FOR
        if self.pictures < 2 and time > self._until:
            return regions
        drop = float(np.median(area[fresh])) if places else 0.0
        moves = (lasts >= max(smallest, drop)) & (area >= LARGER * drop) | (area >= max(smallest, MUCH_LARGER * drop))
        moves[0] = False
        moving = moves.astype(np.uint8).take(labels)
        self.drops = regions - moving
        return moving


def labelled(regions: Regions) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float64]]:
    """The connected region of each pixel, 0 outside; each region's left, top, width, height and area; its middle."""
    # On pictures of 160 columns, OpenCV's default algorithm takes more than twice as long.
    _, labels, stats, middles = cv2.connectedComponentsWithStatsWithAlgorithm(regions, 8, cv2.CV_32S, cv2.CCL_GRANA)
    return np.asarray(labels, np.int32), np.asarray(stats, np.int32), np.asarray(middles, np.float64)

"""Which pixels of a picture move, at its own resolution and in its colours. Pure.

The detector finds where something moves in a picture of 160 columns, by each pixel's own noise (`motion.py`). Within
that, and a little around it, a pixel moves that differs from a background of full resolution by more than the
picture's noise. Nothing is looked for elsewhere, so this costs little more than to keep that background."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from zscout.behaviors.perception.garble import noise_of

AROUND: Final = 9
"""Pixels of the reduced picture by which a region is widened: its rim is smoothed away there."""
DIFFERS: Final = 16.0
"""Grey levels of any colour by which a pixel differs at least ..."""
NOISE: Final = 4.0
"""... and so many times the picture's noise."""
SPARSE: Final = 4
"""Every so many columns are looked at for it."""
HOLE: Final = 5
"""Pixels across up to which holes are closed, and specks left out."""

Mask = NDArray[np.uint8]
"""255 where something moves, elsewhere 0."""


class Outlines:
    def __init__(self) -> None:
        self._mean: NDArray[np.float32] = np.empty((0, 0), np.float32)

    def learn(self, picture: NDArray[np.uint8], share: float) -> None:
        """Follows the whole picture by this share, 0 to 1."""
        if self._mean.shape != picture.shape:
            self._mean = picture.astype(np.float32)
        else:
            cv2.accumulateWeighted(picture, self._mean, share)

    def trace(self, picture: NDArray[np.uint8], regions: Mask, share: float) -> Mask:
        """Which pixels of the picture move, where `regions` of a reduced one do; the background follows the others by
        this share."""
        height, width = picture.shape[:2]
        if self._mean.shape != picture.shape or not regions.any():
            self.learn(picture, share)
            return np.zeros((height, width), np.uint8)
        wide = cv2.dilate(regions, np.ones((AROUND, AROUND), np.uint8))
        wide = cv2.resize(wide, (width, height), interpolation=cv2.INTER_NEAREST)
        left, top, across, down = cv2.boundingRect(wide)
        part = np.s_[top : top + down, left : left + across]
        off = cv2.absdiff(picture[part], cv2.convertScaleAbs(self._mean[part]))
        if off.ndim == 3:
            blue, green, red = cv2.split(off)
            off = cv2.max(cv2.max(blue, green), red)
        lines = picture[:, ::SPARSE] if picture.ndim == 2 else picture[:, ::SPARSE, 1]
        _, moving = cv2.threshold(off, max(DIFFERS, NOISE * noise_of(lines)), 255, cv2.THRESH_BINARY)
        moving = cv2.medianBlur(cv2.bitwise_and(moving, wide[part]), HOLE)
        mask = np.zeros((height, width), np.uint8)
        mask[part] = cv2.morphologyEx(moving, cv2.MORPH_CLOSE, np.ones((HOLE, HOLE), np.uint8))
        cv2.accumulateWeighted(picture, self._mean, share, cv2.bitwise_not(wide))
        return mask

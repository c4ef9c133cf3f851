"""The moving pixels of a picture, at its own resolution and in its colours. Pure.

The detector finds moving regions in a picture of 160 columns, by each pixel's own noise (`motion.py`). In and close to
these regions, a pixel of the source moves if it differs from a full-resolution background by more than the picture's
noise."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from zscout.behaviors.perception.garble import noise_of

AROUND: Final = 9  # pixels of the reduced picture by which regions grow: smoothing has removed their rim
DIFFERS: Final = 16.0  # least grey levels of any colour by which a moving pixel differs ...
NOISE: Final = 4.0  # ... and multiple of the picture's noise.
SPARSE: Final = 4  # every so many columns serve to estimate the noise
HOLE: Final = 5  # pixels across of the largest holes closed and specks removed

Mask = NDArray[np.uint8]  # 255 where something moves, else 0


class Outlines:
    def __init__(self) -> None:
        self._mean: NDArray[np.float32] = np.empty((0, 0), np.float32)

    def learn(self, picture: NDArray[np.uint8], share: float) -> None:
        """`share`: 0 to 1."""
        if self._mean.shape != picture.shape:
            self._mean = picture.astype(np.float32)
        else:
            cv2.accumulateWeighted(picture, self._mean, share)

    def trace(self, picture: NDArray[np.uint8], regions: Mask, share: float) -> Mask:
        """The moving pixels within `regions` of the reduced picture; elsewhere the background follows by `share`."""
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

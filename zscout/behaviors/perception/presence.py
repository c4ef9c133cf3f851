"""Presence of a person who moved and stopped. Pure.

A motionless person soon counts as noise (`motion.py`). But something is *present* while the picture, in the area of the
last motion, differs from the background before that motion, for at most LONGEST."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

LONGEST: Final = 60.0  # most seconds of presence after the last motion
ANOTHER: Final = 3.0  # multiple of a picture's noise, smoothed, and ...
LEAST: Final = 6.0  # ... grey levels by which a pixel counts as changed.
SHARE: Final = 0.35  # least share of changed pixels where it last moved: rims and shadows come and go

GONE: Final = 2.0  # seconds of absence after which the background counts as known again

Plane = NDArray[np.float32]
Regions = NDArray[np.uint8]


class Presence:
    def __init__(self) -> None:
        self._before: Plane | None = None  # background before the motion; None without recent motion
        self._moved_at = self._there_at = 0.0  # times of the last motion, and of the last presence without motion
        self._where: Regions = np.empty((0, 0), np.uint8)  # region of the last motion

    def expects(self, moving: bool) -> bool:
        """Return True if the next picture's noise is needed."""
        return not moving and self._before is not None

    def clear(self) -> None:
        self._before = None

    def see(self, time: float, level: Plane, mean: Plane, moving: Regions | None, noise: float) -> bool:
        """Return True if something is present that does not move. `level`: brightness; `mean`: background."""
        if moving is not None:
            if self._before is None:
                self._before = mean.copy()
            self._moved_at, self._where = time, moving
            return False
        if self._before is None:
            return False
        off = np.abs(cv2.GaussianBlur(level - self._before, (3, 3), 0))
        another = off[self._where > 0] > max(LEAST, ANOTHER * 0.4 * noise)
        if np.count_nonzero(another) >= SHARE * another.size:
            self._there_at = time
        if time - self._moved_at > LONGEST or time - max(self._there_at, self._moved_at) > GONE:
            self.clear()
            return False
        return self._there_at == time

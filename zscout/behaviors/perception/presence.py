"""Whether who moved and stopped is still there. Pure.

Who stands still is soon learned as noise (`motion.py`), and is no motion any more. But where he moved last, the picture
is not as it was before he came: as long as that is so, and no longer than LONGEST, something is *present*. Whoever
walks out of the picture leaves it as it was."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

LONGEST: Final = 60.0
"""Seconds after the last motion for which something is present at most."""
ANOTHER: Final = 3.0
"""Times a picture's noise, smoothed, and ..."""
LEAST: Final = 6.0
"""... grey levels, by which a pixel is another than before he came."""
SHARE: Final = 0.35
"""Share of the pixels that moved last which are so while he is there: his rim and his shadow come and go."""

GONE: Final = 2.0
"""Seconds without him after which what is behind him counts as known again."""

Plane = NDArray[np.float32]
Regions = NDArray[np.uint8]


class Presence:
    def __init__(self) -> None:
        self._before: Plane | None = None
        """The background as it was before something moved; None: nothing does, or did lately."""
        self._moved_at = self._there_at = 0.0
        """When something moved, and was there without moving, last."""
        self._where: Regions = np.empty((0, 0), np.uint8)
        """Where it moved last."""

    def expects(self, moving: bool) -> bool:
        """Whether the noise of the next picture is needed."""
        return not moving and self._before is not None

    def clear(self) -> None:
        self._before = None

    def see(self, time: float, level: Plane, mean: Plane, moving: Regions | None, noise: float) -> bool:
        """Takes a picture `level` in brightness with the background `mean`; `moving`: where something moves, None:
        nothing does. Whether something is present that does not move."""
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

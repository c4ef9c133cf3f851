"""The camera's electronics: lens blur, slow automatic exposure, noise by light and gain, gamma, 8 bits."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from zscout.simulation.building.solids import Floats

GAMMA: Final = 2.2
SETTLES: Final = 1.0  # s, time constant of the exposure
TARGET: Final = 0.22  # mean linear level of the exposure; 1 is white
LEAST_GAIN: Final = 0.3
MOST_GAIN: Final = 12.0
_READ: Final = 0.0012  # linear noise of a dark pixel at gain 1
_SHOT: Final = 0.00016  # variance per linear light and gain (shot noise)
_STEPS: Final = 4096
# Low linear light makes many grey levels, so the table is indexed by the square root.
_SHARES: Final = np.arange(_STEPS) / (_STEPS - 1)
_TABLE: Final[NDArray[np.uint8]] = np.round(255 * _SHARES ** (2 / GAMMA)).astype(np.uint8)


def _vignette() -> Floats:
    y, x = np.mgrid[-1:1:120j, -1:1:160j]
    falls: Floats = (1 - 0.18 * (0.64 * x * x + 0.36 * y * y)).astype(np.float32)
    return falls


_VIGNETTE: Final = _vignette()


class Sensor:
    def __init__(self, noise: float, rng: np.random.Generator) -> None:
        self._noise, self._rng = noise, rng
        self.gain = 1.0  # factor on linear light
        self._last: float | None = None

    def flicker(self) -> float:
        """A random phase of the lamps' flicker, -1 to 1."""
        return float(np.sin(self._rng.uniform(0, 2 * np.pi)))

    def expose(self, linear: Floats, now: float) -> NDArray[np.uint8]:
        """The 8-bit picture of linear light (120, 160) at `now`, seconds."""
        linear = cv2.GaussianBlur(linear, (3, 3), 0.6) * _VIGNETTE
        # Clipped, so that a window in the picture does not turn the rest black.
        mean = float(np.minimum(linear * self.gain, 1.5).mean()) / self.gain
        wanted = float(np.clip(TARGET / max(mean, 1e-6), LEAST_GAIN, MOST_GAIN))
        if self._last is None:
            self.gain = wanted
        elif now > self._last:
            share = 1 - np.exp(-(now - self._last) / SETTLES)
            # In stops, as for apertures and shutters.
            self.gain *= float((wanted / self.gain) ** share)
        self._last = now
        level = linear * self.gain
        if self._noise > 0:
            spread = np.sqrt((_READ * self.gain) ** 2 + _SHOT * self.gain * np.maximum(level, 0))
            level += self._noise * spread * self._rng.standard_normal(level.shape, np.float32)
        index = np.sqrt(np.clip(level, 0, 1)) * (_STEPS - 1)
        return np.asarray(_TABLE[index.astype(np.intp)], np.uint8)

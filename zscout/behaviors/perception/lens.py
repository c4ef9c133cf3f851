"""A Scout's camera: its pictures, whether they are spoiled, where a pixel looks, how bright it is. Pure.

A pinhole, 4 cm above the floor, level: row 59.5 looks straight ahead, a point of the floor at distance d
appears `RISE / d` rows below it. Bearings are radians, to the left positive; distances metres along the axis.

Noise is estimated from the second differences along columns: lines of a true picture are alike, and what is
not smooth in it are a few edges, so the median of their size is the noise (as in Immerkaer, "Fast noise
variance estimation", 1996). A cheap camera in the dark has up to 27 grey levels of it, a jammed picture 34
and more, snow some 60: measured in the simulated building at up to three times the usual noise.

Where a receiver has lost its sync, lines stand aside. A line is like the one before where it is; torn from it, it is so
somewhere else. That is looked for in waves of 11 to 53 columns: shorter ones are mostly noise, and longer ones
are much alike wherever they stand.
"""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from zscout.drivers.image_size import jpeg_size

ROWS: Final = 120
COLUMNS: Final = 160
FIELD: Final = math.radians(65.0)
"""Horizontal field of view."""
FOCAL: Final = COLUMNS / 2 / math.tan(FIELD / 2)
"""Pixels."""
MIDDLE: Final = COLUMNS / 2 - 0.5
EYE: Final = 0.04
"""Metres of the camera above the floor."""
RISE: Final = FOCAL * EYE
"""Rows below the horizon, times metres."""
GAMMA: Final = 2.2
MAX_PIXELS: Final = 4_000_000
"""Of a JPEG picture; a larger one is not decoded."""
SNOW: Final = 48.0
"""Grey levels of noise of a channel without a transmitter."""
JAMMED: Final = 31.0
"""Above this nothing can be seen, two transmitters or a very weak one."""
FLAT: Final = 0.3
"""Grey levels by which a line varies that holds no picture: no camera is as quiet."""
CUT: Final = 0.25
"""Share of such lines that make half a picture."""
ALIKE: Final = 0.52
"""Correlation of neighbouring lines, wherever they fit best, from which there is enough in a picture to tell by: noise
alone has up to 0.48."""
ASIDE: Final = 0.4
"""By how much less they correlate as they stand, in a picture that is all torn."""
_NORMAL: Final = 0.674 * 6**0.5
"""Median size of a second difference of normal noise of standard deviation 1."""

Picture = NDArray[np.uint8]
"""Grey, shape (120, 160), row 0 at the top, gamma 2.2."""


_LONGEST: Final = 3
_KINDS: Final = 12
"""Of waves in a line, from this many in it on."""


def _waves() -> NDArray[np.float32]:
    turns = 2 * np.pi / COLUMNS * np.outer(np.arange(COLUMNS), _LONGEST + np.arange(_KINDS))
    return np.concatenate((np.cos(turns), np.sin(turns)), axis=1).astype(np.float32)


_WAVES: Final = _waves()
_LINEAR: Final = ((np.arange(256) / 255.0) ** GAMMA).astype(np.float32)


def grey_picture(data: bytes) -> NDArray[np.uint8] | None:
    """A JPEG picture from outside, grey, of shape (height, width); None for what is none or has over MAX_PIXELS."""
    size = jpeg_size(data)
    if size is None or size[0] * size[1] > MAX_PIXELS:
        return None
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    return None if picture is None else np.asarray(picture, np.uint8)


def linear(picture: Picture) -> NDArray[np.float32]:
    """Brightness 0 to 1 without the gamma, same shape: proportional to the light that came in."""
    return _LINEAR[picture]


def bearing(column: float) -> float:
    """Radians to the left of the axis."""
    return -math.atan((column - MIDDLE) / FOCAL)


def garbled(picture: Picture) -> str | None:
    """What is wrong with it in one word, or None if it may be believed."""
    noise = noise_of(picture)
    if noise > JAMMED:
        return "snow" if noise > SNOW else "jammed"
    lines = picture
    if noise <= FLAT:
        # A picture drawn without noise is a picture still; one without anything in it is none.
        if np.ptp(picture) < 3:
            return "blank"
        lines = picture[picture.shape[0] // 2 :]
    flat = np.count_nonzero(lines.std(axis=1) < FLAT)
    if flat > CUT * picture.shape[0]:
        return "cut"
    return "torn" if _all_torn(picture) else None


def noise_of(picture: Picture) -> float:
    """Standard deviation of the noise in grey levels, by the differences between three lines in a row."""
    second = np.abs(np.diff(picture.astype(np.int16), 2, axis=0))
    # The middle of a histogram: a partition of so many numbers takes four times as long.
    counts = cv2.calcHist([second.astype(np.uint16)], [0], None, [1021], [0, 1021]).ravel().cumsum()
    half = float(counts[-1]) / 2
    place = int(np.searchsorted(counts, half))
    before = float(counts[place - 1]) if place else 0.0
    inside = (half - before) / max(1.0, float(counts[place]) - before)
    return (place - 0.5 + inside) / _NORMAL if place else inside * 0.5 / _NORMAL


def _all_torn(picture: Picture) -> bool:
    """Whether nearly all lines are torn from their neighbours. Few are in any picture of an analog receiver."""
    both = picture.astype(np.float32) @ _WAVES
    # What is in a line counts by its square root: neither a few bright lines alone nor those of mere noise.
    size = np.einsum("ij,ij->i", both, both) ** 0.25
    both /= size[:, None] + 1e-3
    whole = float(size[:-1] @ size[1:]) + 1e-3
    waves = both[:, :_KINDS] - 1j * both[:, _KINDS:]
    pairs = waves[:-1] * waves[1:].conj()
    in_place = float(pairs.real.sum()) / whole
    if in_place > 1 - ASIDE:
        return False
    # Their correlation at every second column aside.
    spectrum = np.zeros((len(pairs), COLUMNS // 4 + 1), np.complex64)
    spectrum[:, _LONGEST : _LONGEST + _KINDS] = pairs
    anywhere = float(np.fft.irfft(spectrum, axis=1).max(axis=1).sum()) * (COLUMNS / 4) / whole
    return anywhere > ALIKE and anywhere - in_place > ASIDE

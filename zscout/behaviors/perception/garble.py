"""Whether a picture is one at all: snow, jammed by a second transmitter, cut short, or blank. Pure.

Noise is estimated from the second differences along columns: lines of a true picture are alike, and what is
not smooth in it are a few edges, so the median of their size is the noise (as in Immerkaer, "Fast noise
variance estimation", 1996). A cheap camera in the dark has up to 27 grey levels of it, a jammed picture 34
and more, snow some 60: measured in the simulated building at up to three times the usual noise.
"""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np

from zscout.behaviors.perception.lens import Picture

SNOW: Final = 48.0
"""Grey levels of noise of a channel without a transmitter."""
JAMMED: Final = 31.0
"""Above this nothing can be seen, two transmitters or a very weak one."""
FLAT: Final = 0.3
"""Grey levels by which a line varies that holds no picture: no camera is as quiet."""
CUT: Final = 0.25
"""Share of such lines that make half a picture."""
_NORMAL: Final = 0.674 * 6**0.5
"""Median size of a second difference of normal noise of standard deviation 1."""


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
    return "cut" if flat > CUT * picture.shape[0] else None


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

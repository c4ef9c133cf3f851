"""Defects that make a picture unusable. Pure.

Noise is the median size of second differences along columns, as true pictures have few edges (Immerkaer, "Fast noise
variance estimation", 1996). A cheap camera in the dark has up to 27 grey levels of it, a jammed picture 34 and more,
snow about 60: measured in the simulated building at up to three times the usual noise.

Without sync, lines are displaced: each matches the one before at an offset. Offsets are sought in waves of 11 to 53
columns: shorter ones are mostly noise, longer ones match at any offset."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from zscout.behaviors.perception.lens import COLUMNS, Picture

SNOW: Final = 48.0  # grey levels of noise of a channel without a transmitter
JAMMED: Final = 31.0  # noise of two transmitters, or a very weak one
FLAT: Final = 0.3  # grey levels by which an empty line varies: every camera has more
CUT: Final = 0.25  # share of such lines that make half a picture
ALIKE: Final = 0.52
"""Correlation of neighbouring lines at the best offset, enough to judge: noise alone has up to 0.48."""
ASIDE: Final = 0.4  # loss of correlation in place, in a picture that is all torn
_NORMAL: Final = 0.674 * 6**0.5  # median second difference of normal noise of standard deviation 1
_LONGEST: Final = 3
_KINDS: Final = 12  # kinds of waves, from _LONGEST per line on


def _waves() -> NDArray[np.float32]:
    turns = 2 * np.pi / COLUMNS * np.outer(np.arange(COLUMNS), _LONGEST + np.arange(_KINDS))
    return np.concatenate((np.cos(turns), np.sin(turns)), axis=1).astype(np.float32)


_WAVES: Final = _waves()


def garbled(picture: Picture) -> str | None:
    """The defect in one word, or None."""
    noise = noise_of(picture)
    if noise > JAMMED:
        return "snow" if noise > SNOW else "jammed"
    lines = picture
    if noise <= FLAT:
        # A picture drawn without noise is valid unless it is empty.
        if np.ptp(picture) < 3:
            return "blank"
        lines = picture[picture.shape[0] // 2 :]
    flat = np.count_nonzero(lines.std(axis=1) < FLAT)
    if flat > CUT * picture.shape[0]:
        return "cut"
    return "torn" if _all_torn(picture) else None


def noise_of(picture: Picture) -> float:
    """Standard deviation of the noise in grey levels, from three lines in a row."""
    second = np.abs(np.diff(picture.astype(np.int16), 2, axis=0))
    # The middle of a histogram: partitioning so many numbers takes four times as long.
    counts = cv2.calcHist([second.astype(np.uint16)], [0], None, [1021], [0, 1021]).ravel().cumsum()
    half = float(counts[-1]) / 2
    place = int(np.searchsorted(counts, half))
    before = float(counts[place - 1]) if place else 0.0
    inside = (half - before) / max(1.0, float(counts[place]) - before)
    return (place - 0.5 + inside) / _NORMAL if place else inside * 0.5 / _NORMAL


def _all_torn(picture: Picture) -> bool:
    """Return True if nearly all lines are torn from their neighbours; any analog receiver tears a few."""
    both = picture.astype(np.float32) @ _WAVES
    # Weighted by square root: neither a few bright lines nor many noisy ones dominate.
    size = np.einsum("ij,ij->i", both, both) ** 0.25
    both /= size[:, None] + 1e-3
    whole = float(size[:-1] @ size[1:]) + 1e-3
    waves = both[:, :_KINDS] - 1j * both[:, _KINDS:]
    pairs = waves[:-1] * waves[1:].conj()
    in_place = float(pairs.real.sum()) / whole
    if in_place > 1 - ASIDE:
        return False
    # Correlation at every second column of offset.
    spectrum = np.zeros((len(pairs), COLUMNS // 4 + 1), np.complex64)
    spectrum[:, _LONGEST : _LONGEST + _KINDS] = pairs
    anywhere = float(np.fft.irfft(spectrum, axis=1).max(axis=1).sum()) * (COLUMNS / 4) / whole
    return anywhere > ALIKE and anywhere - in_place > ASIDE

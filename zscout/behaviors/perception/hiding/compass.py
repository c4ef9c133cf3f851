"""How far a robot turned between two pictures: the picture's own shift, whatever the wheels did. Pure.

A turn on the spot moves everything by the same angle, near or far. So each picture is laid out by angle
instead of by pixel, reduced to a few bands of rows without their slow changes (light, exposure), and the
shift with the best normalised cross-correlation is the turn: J. P. Lewis, "Fast Normalized
Cross-Correlation" (1995), here along one axis, by FFT.
"""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zscout.behaviors.perception.lens import COLUMNS, FIELD, FOCAL, GAMMA, MIDDLE, Picture

STEP: Final = FIELD / COLUMNS
"""Radians between two columns of a strip."""
BANDS: Final = 20
_TOP, _BOTTOM = 4, 84
"""Rows used. Below them the floor is so near that a turn about the wheels is not one about the camera."""
_NEAR: Final = 80
"""First row of the near floor: 25 cm ahead."""
_OVERLAP: Final = 36
"""Columns that two strips must share at least: a turn of up to 50 degrees is measured."""
_SLOW: Final = 31
"""Columns over which the mean is taken away."""
_GREY: Final = 1.5
"""Grey levels of noise that a band carries anyway: less than this is no texture."""

_SOURCE: Final = np.clip(MIDDLE - FOCAL * np.tan((MIDDLE - np.arange(COLUMNS)) * STEP), 0, COLUMNS - 1)
"""The column of the picture, between two pixels, that each column of a strip shows."""
_LEFT: Final = np.minimum(_SOURCE.astype(np.intp), COLUMNS - 2)
_SHARE: Final = (_SOURCE - _LEFT).astype(np.float32)

Strip = NDArray[np.int8]
"""Shape (20, 160): bands of rows, columns by angle; grey levels off the slow mean, times `SCALE`."""
SCALE: Final = 3.0
Tones = NDArray[np.uint8]
"""Grey levels, laid out as a strip."""


class Turn(NamedTuple):
    angle: float
    """Radians to the left."""
    likeness: float
    """Correlation at that shift: near 1 is sure, below about 0.4 is a guess."""


def strip_and_tones(picture: Picture) -> tuple[Strip, Tones]:
    """What `turned` compares, in whole numbers, so that a checkpoint keeps it exactly; and the same part of
    the picture as it is, to compare exposures."""
    by_angle = _by_angle(picture[_TOP:_BOTTOM])
    return _off_the_mean(by_angle, (_SLOW, 1)), np.rint(by_angle).astype(np.uint8)


def brighter(old: Tones, new: Tones, angle: float) -> float:
    """By which factor the camera opened from `old` to `new`, between which the robot turned by `angle`: the
    median over what both show, neither too dark nor white. 1 if they share too little."""
    shift = round(angle / STEP)
    if abs(shift) > COLUMNS - 16:
        return 1.0
    first = new[:, max(0, shift) : COLUMNS + min(0, shift)]
    second = old[:, max(0, -shift) : COLUMNS - max(0, shift)]
    usable = (np.minimum(first, second) > 12) & (np.maximum(first, second) < 235)
    if np.count_nonzero(usable) < 100:
        return 1.0
    ratio = float(np.median(first[usable].astype(np.float32) / second[usable]))
    return float(min(4.0, max(0.25, ratio**GAMMA)))


def floor_strip(picture: Picture) -> Strip:
    """The near floor's grain, laid out likewise. It stays as it is while the robot turns on the spot or
    pushes in vain, and is another one after a few centimetres of way."""
    return _off_the_mean(cv2.blur(_by_angle(picture[_NEAR:]), (3, 1)), (25, 7))


def _by_angle(rows: NDArray[np.uint8]) -> NDArray[np.float32]:
    bands = cv2.resize(rows, (COLUMNS, BANDS), interpolation=cv2.INTER_AREA).astype(np.float32)
    return np.asarray(bands[:, _LEFT] * (1 - _SHARE) + bands[:, _LEFT + 1] * _SHARE, np.float32)


def _off_the_mean(levels: NDArray[Any], around: tuple[int, int]) -> Strip:
    off = levels - cv2.blur(levels, around, borderType=cv2.BORDER_REFLECT)
    return np.asarray(np.rint(np.clip(off * SCALE, -127, 127)), np.int8)


def turned(old: Strip, new: Strip, expected: float = 0.0, spread: float = math.radians(40)) -> Turn:
    """The turn that best makes `old` into `new`.

    `expected` and `spread` (radians) say where to look first: a turn that is off by `spread` has to be more
    alike by 0.15. The angle is a whole number of columns (0.4 degrees)."""
    after, before = new.astype(np.float32), old.astype(np.float32)
    fast, slow = (np.fft.rfft(one, 2 * COLUMNS, axis=1) for one in (after, before))
    common = np.fft.irfft((fast * np.conj(slow)).sum(axis=0), 2 * COLUMNS)
    shifts = np.arange(_OVERLAP - COLUMNS, COLUMNS - _OVERLAP + 1)
    noise = (_GREY * SCALE) ** 2 * BANDS * (COLUMNS - np.abs(shifts))
    energy = (_ends(before, -shifts) + noise) * (_ends(after, shifts) + noise)
    likeness = common[shifts] / np.sqrt(energy)
    # Content that moves to the right in the picture (a positive shift) is a turn to the left.
    off = (shifts * STEP - expected) / spread
    best = int(np.argmax(likeness - 0.15 * off**2))
    return Turn(float(shifts[best]) * STEP, float(likeness[best]))


def _ends(strip: NDArray[np.float32], shifts: NDArray[np.intp]) -> NDArray[np.float64]:
    """Energy of the part of a strip that a shift leaves in the picture: from `shift` on, or up to its end."""
    running = np.concatenate(([0.0], np.cumsum((strip**2).sum(axis=0), dtype=np.float64)))
    from_shift, to_end = running[-1] - running[np.maximum(shifts, 0)], running[COLUMNS + np.minimum(shifts, 0)]
    return np.asarray(np.where(shifts >= 0, from_shift, to_end), np.float64)

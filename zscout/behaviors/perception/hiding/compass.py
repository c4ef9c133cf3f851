"""Turn of a robot between two pictures, from the pictures' shift alone. Pure.

A turn on the spot moves everything by the same angle, near or far. So each picture is laid out by angle, reduced to a
few bands of rows without slow changes (light, exposure); the shift with the best normalised cross-correlation is the
turn (J. P. Lewis, "Fast Normalized Cross-Correlation", 1995; here along one axis, by FFT)."""

from __future__ import annotations

import math
from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from zscout.behaviors.perception.lens import COLUMNS, FIELD, FOCAL, GAMMA, MIDDLE, Picture

STEP: Final = FIELD / COLUMNS  # radians between two columns of a strip
BANDS: Final = 20
_TOP, _BOTTOM = 4, 84  # rows used: on the floor below them, a turn about the wheels differs from one about the camera
_NEAR: Final = 80  # first row of the near floor: 25 cm ahead
_OVERLAP: Final = 36  # least columns shared by two strips: turns of up to 50 degrees are measured
_SLOW: Final = 31  # columns of the mean that is subtracted
_GREY: Final = 1.5  # grey levels of a band's noise: less is no texture

_SOURCE: Final = np.clip(MIDDLE - FOCAL * np.tan((MIDDLE - np.arange(COLUMNS)) * STEP), 0, COLUMNS - 1)
"""The column of the picture, between two pixels, for each column of a strip."""
_LEFT: Final = np.minimum(_SOURCE.astype(np.intp), COLUMNS - 2)
_SHARE: Final = (_SOURCE - _LEFT).astype(np.float32)

Strip = NDArray[np.int8]
"""Shape (20, 160): bands of rows, columns by angle; grey levels off the slow mean, times `SCALE`."""
SCALE: Final = 3.0
Tones = NDArray[np.uint8]  # grey levels, laid out as a strip


class Turn(NamedTuple):
    angle: float  # radians to the left
    likeness: float  # correlation at that shift: near 1 is sure, below about 0.4 a guess


def strip_and_tones(picture: Picture) -> tuple[Strip, Tones]:
    """The strip for `turned`, of integers that a checkpoint keeps exactly, and the plain tones for `brighter`."""
    by_angle = _by_angle(picture[_TOP:_BOTTOM])
    return _off_the_mean(by_angle, (_SLOW, 1)), np.rint(by_angle).astype(np.uint8)


def brighter(old: Tones, new: Tones, angle: float) -> float:
    """The camera's gain from `old` to `new` over a turn by `angle`: a median, 1 for too few shared pixels."""
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
    """A strip of the near floor's texture: the same only if the robot turns on the spot or pushes without moving."""
    return _off_the_mean(cv2.blur(_by_angle(picture[_NEAR:]), (3, 1)), (25, 7))


def _by_angle(rows: NDArray[np.uint8]) -> NDArray[np.float32]:
    bands = cv2.resize(rows, (COLUMNS, BANDS), interpolation=cv2.INTER_AREA).astype(np.float32)
    return np.asarray(bands[:, _LEFT] * (1 - _SHARE) + bands[:, _LEFT + 1] * _SHARE, np.float32)


def _off_the_mean(levels: NDArray[Any], around: tuple[int, int]) -> Strip:
    off = levels - cv2.blur(levels, around, borderType=cv2.BORDER_REFLECT)
    return np.asarray(np.rint(np.clip(off * SCALE, -127, 127)), np.int8)


def turned(old: Strip, new: Strip, expected: float = 0.0, spread: float = math.radians(40)) -> Turn:
    """Return the turn that best maps `old` to `new`, in whole columns (0.4 degrees). `expected` (radians) is preferred:
    `spread` away, a turn must correlate better by 0.15."""
    after, before = new.astype(np.float32), old.astype(np.float32)
    fast, slow = (np.fft.rfft(strip, 2 * COLUMNS, axis=1) for strip in (after, before))
    common = np.fft.irfft((fast * np.conj(slow)).sum(axis=0), 2 * COLUMNS)
    shifts = np.arange(_OVERLAP - COLUMNS, COLUMNS - _OVERLAP + 1)
    noise = (_GREY * SCALE) ** 2 * BANDS * (COLUMNS - np.abs(shifts))
    energy = (_ends(before, -shifts) + noise) * (_ends(after, shifts) + noise)
    likeness = common[shifts] / np.sqrt(energy)
    # A positive shift, to the right in the picture, is a turn to the left.
    off = (shifts * STEP - expected) / spread
    best = int(np.argmax(likeness - 0.15 * off**2))
    return Turn(float(shifts[best]) * STEP, float(likeness[best]))


def _ends(strip: NDArray[np.float32], shifts: NDArray[np.intp]) -> NDArray[np.float64]:
    """Energy of the part of a strip that a shift leaves in the picture."""
    running = np.concatenate(([0.0], np.cumsum((strip**2).sum(axis=0), dtype=np.float64)))
    from_shift, to_end = running[-1] - running[np.maximum(shifts, 0)], running[COLUMNS + np.minimum(shifts, 0)]
    return np.asarray(np.where(shifts >= 0, from_shift, to_end), np.float64)

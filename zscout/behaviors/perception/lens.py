"""A Scout's camera: where a pixel looks, and how bright it is. Pure.

A pinhole, 4 cm above the floor, level: row `HORIZON` looks straight ahead, a point of the floor at distance d
appears `RISE / d` rows below it. Bearings are radians, to the left positive; distances metres along the axis.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

ROWS: Final = 120
COLUMNS: Final = 160
FIELD: Final = math.radians(65.0)
"""Horizontal field of view."""
FOCAL: Final = COLUMNS / 2 / math.tan(FIELD / 2)
"""Pixels."""
HORIZON: Final = ROWS / 2 - 0.5
"""Row of the horizon, counted from the centre of row 0."""
MIDDLE: Final = COLUMNS / 2 - 0.5
EYE: Final = 0.04
"""Metres of the camera above the floor."""
RISE: Final = FOCAL * EYE
"""Rows below the horizon, times metres: a floor point at distance d is `RISE / d` rows below the horizon."""
GAMMA: Final = 2.2

Picture = NDArray[np.uint8]
"""Grey, shape (120, 160), row 0 at the top, gamma 2.2."""

_LINEAR: Final = ((np.arange(256) / 255.0) ** GAMMA).astype(np.float32)


def is_picture(picture: NDArray[np.uint8]) -> bool:
    """Whether it has the form of a picture of this camera."""
    return picture.shape == (ROWS, COLUMNS) and picture.dtype == np.uint8


def linear(picture: Picture) -> NDArray[np.float32]:
    """Brightness 0 to 1 without the gamma, same shape: proportional to the light that came in."""
    return _LINEAR[picture]


def bearing(column: float) -> float:
    """Radians to the left of the axis."""
    return -math.atan((column - MIDDLE) / FOCAL)


def column(bearing: float) -> float:
    """The column that looks there; outside 0 to 159 if it is out of the picture."""
    return MIDDLE - FOCAL * math.tan(bearing)


def floor_distance(row: float) -> float:
    """Metres along the axis to the floor seen in this row; endless at the horizon and above."""
    return RISE / (row - HORIZON) if row > HORIZON else math.inf


def floor_row(distance: float) -> float:
    """The row that sees the floor at this distance."""
    return HORIZON + RISE / distance

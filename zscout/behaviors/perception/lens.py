"""A Scout's camera: its pictures, bearings of pixels, brightness. Pure.

A pinhole, 4 cm above the floor, level: row 59.5 looks straight ahead, a floor point at distance d appears `RISE / d`
rows below it. Bearings are radians, to the left positive; distances metres along the axis."""

from __future__ import annotations

import math
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from zscout.drivers.image_size import jpeg_size

ROWS: Final = 120
COLUMNS: Final = 160
FIELD: Final = math.radians(65.0)  # horizontal field of view
FOCAL: Final = COLUMNS / 2 / math.tan(FIELD / 2)  # pixels
MIDDLE: Final = COLUMNS / 2 - 0.5
EYE: Final = 0.04  # metres of the camera above the floor
RISE: Final = FOCAL * EYE  # rows below the horizon, times metres
GAMMA: Final = 2.2
MAX_PIXELS: Final = 4_000_000  # larger JPEG pictures are not decoded

Picture = NDArray[np.uint8]  # grey, shape (120, 160), row 0 at the top, gamma 2.2

_LINEAR: Final = ((np.arange(256) / 255.0) ** GAMMA).astype(np.float32)


def grey_picture(data: bytes) -> NDArray[np.uint8] | None:
    """An outside JPEG picture in grey, shape (height, width); None if it is invalid or exceeds MAX_PIXELS."""
    size = jpeg_size(data)
    if size is None or size[0] * size[1] > MAX_PIXELS:
        return None
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    return None if picture is None else np.asarray(picture, np.uint8)


def linear(picture: Picture) -> NDArray[np.float32]:
    """Brightness 0 to 1 without the gamma: proportional to the light."""
    return _LINEAR[picture]


def bearing(column: float) -> float:
    """Radians to the left."""
    return -math.atan((column - MIDDLE) / FOCAL)

"""JPEG pictures from outside, decoded if they are not too large."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from zscout.drivers.image_size import jpeg_size

MAX_PIXELS: Final = 4_000_000


def grey_picture(data: bytes) -> NDArray[np.uint8] | None:
    """The picture, grey, of shape (height, width); None for what is no JPEG or has over MAX_PIXELS."""
    size = jpeg_size(data)
    if size is None or size[0] * size[1] > MAX_PIXELS:
        return None
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    return None if picture is None else np.asarray(picture, np.uint8)

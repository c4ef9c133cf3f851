"""JPEG pictures from outside: how large one is before it is decoded, and then its pixels."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

MAX_PIXELS: Final = 4_000_000
_FRAME_HEADERS: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""Markers of a frame header (ITU-T T.81, table B.1)."""


def jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in pixels as the frame header tells them; None for what is no JPEG."""
    if data[:2] != b"\xff\xd8":
        return None
    at = 2
    while at + 9 <= len(data):
        if data[at] != 0xFF:
            return None
        marker = data[at + 1]
        if marker in _FRAME_HEADERS:
            return int.from_bytes(data[at + 7 : at + 9], "big"), int.from_bytes(data[at + 5 : at + 7], "big")
        # Every segment that may come before the frame header has a length of at least 2.
        at += 2 + max(2, int.from_bytes(data[at + 2 : at + 4], "big"))
    return None


def grey_picture(data: bytes) -> NDArray[np.uint8] | None:
    """The picture, grey, of shape (height, width); None for what is no JPEG or has over MAX_PIXELS."""
    size = jpeg_size(data)
    if size is None or not 0 < size[0] * size[1] <= MAX_PIXELS:
        return None
    picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    return None if picture is None else np.asarray(picture, np.uint8)

"""The size of an encoded picture, read from its head: a viewer that decodes a foreign picture allocates as many pixels
as the head declares."""

from __future__ import annotations

import struct
from typing import Final

_PNG: Final = b"\x89PNG\r\n\x1a\n"
_PNG_END: Final = b"\x00\x00\x00\x00IEND\xaeB`\x82"
_FRAMES: Final = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""JPEG's markers of a frame (ITU-T T.81, table B.1), which contain the picture's size."""
_ALONE: Final = frozenset({0x01, *range(0xD0, 0xD8)})
"""Markers without a length."""
_SCAN: Final = b"\xff\xda"
MAX_SCANS: Final = 64
"""Passes over a progressive picture: cameras make up to a dozen, and a reader decodes all pixels in each."""


def jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in pixels; None if `data` does not begin like a JPEG, or has more than MAX_SCANS scans."""
    if data[:2] != b"\xff\xd8" or data.count(_SCAN) > MAX_SCANS:
        return None
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # a filling byte
            at += 1
        elif marker in _ALONE:
            at += 2
        elif marker in _FRAMES:
            if at + 9 > len(data):
                return None
            height, width = struct.unpack_from(">HH", data, at + 5)
            return (width, height) if width and height else None
        else:
            (length,) = struct.unpack_from(">H", data, at + 2)
            if length < 2:
                return None
            at += 2 + length
    return None


def png_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in pixels; None if `data` does not begin and end like a PNG."""
    if len(data) < 45 or data[:8] != _PNG or data[8:16] != b"\x00\x00\x00\x0dIHDR" or data[-12:] != _PNG_END:
        return None
    width, height = struct.unpack_from(">II", data, 16)
    return (width, height) if width and height else None

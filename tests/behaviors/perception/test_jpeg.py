"""JPEG pictures from outside: what is legal is read, what is too large is not decoded."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from zscout.behaviors.perception.lens import MAX_PIXELS, grey_picture

PICTURE = np.arange(120 * 160, dtype=np.uint8).reshape(120, 160)
JPEG = cv2.imencode(".jpg", PICTURE)[1].tobytes()


@pytest.mark.parametrize("count", [1, 2, 7])
def test_fill_bytes_before_a_marker_are_legal(count: int) -> None:
    """ITU-T T.81, B.1.1.2: any marker may be preceded by fill bytes 0xFF."""
    frame = JPEG.index(b"\xff\xc0")
    filled = JPEG[:2] + b"\xff" * count + JPEG[2:frame] + b"\xff" * count + JPEG[frame:]
    expected, picture = grey_picture(JPEG), grey_picture(filled)
    assert expected is not None
    assert picture is not None
    assert np.array_equal(picture, expected)


def test_what_is_no_picture_or_claims_too_many_pixels_is_none() -> None:
    size = JPEG.index(b"\xff\xc0") + 5
    huge = JPEG[:size] + (MAX_PIXELS // 160).to_bytes(2, "big") + (161).to_bytes(2, "big") + JPEG[size + 4 :]
    for data in (b"", b"\xff\xd8", JPEG[:40], JPEG[2:], huge):
        assert grey_picture(data) is None

"""Real recordings, and what is in them as looked up by hand. They come with Debian's opencv-doc 4.6."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

FOLDER: Final = Path("/usr/share/doc/opencv-doc/examples/data")
PASSERS_BY: Final = FOLDER / "vtest.avi"
"""79.5 s of a road and lawns with passers-by, 768x576 at 10 pictures/s: never without somebody."""
GARDEN: Final = FOLDER / "tree.avi"
"""29.5 s of a tree in the wind, 320x240 at 2.3 pictures/s; nobody is there until a hand comes in."""
HAND: Final = 23.0
"""Seconds of GARDEN until the hand: it is in picture 53, at 23.1 s, and in all after that."""
EMPTY_LAWN: Final = (slice(336, 576), slice(0, 320), 45.0)
"""Rows and columns of PASSERS_BY, and the seconds until which nobody steps there."""

_PEOPLE: Final = """
60: 366 169 382 237, 381 180 398 259, 402 184 425 263, 468 203 498 293, 507 201 530 284, 616 234 650 341
160: 39 94 55 136, 350 172 380 245, 434 205 465 296, 478 202 506 286, 502 222 542 308, 658 103 676 161,\
 672 108 700 181
260: 40 172 62 243, 163 147 188 217, 321 214 363 303, 485 177 510 250, 529 243 570 341, 622 126 644 193,\
 642 132 662 193
360: 370 176 400 247, 442 180 475 252, 436 241 462 337, 529 195 570 286, 700 237 735 337, 736 238 758 329
460: 350 213 388 299, 508 203 540 250, 511 228 546 317, 752 353 768 400
660: 177 151 210 222, 266 152 300 228, 462 203 493 284, 616 178 645 259, 687 295 727 412, 300 357 357 490
760: 229 192 252 271, 240 234 283 326, 316 176 344 253, 460 182 488 246, 455 222 490 315, 654 204 682 303,\
 684 121 702 180, 736 52 760 98
"""
PEOPLE: Final[dict[int, list[tuple[int, ...]]]] = {
    int(number): [tuple(map(int, person.split())) for person in people.split(",")]
    for number, _, people in (line.partition(":") for line in _PEOPLE.split("\n") if line)
}
"""Left, top, right and bottom of everybody in some pictures of PASSERS_BY, by the picture's number from 0."""


def pictures(path: Path) -> Iterator[tuple[float, NDArray[np.uint8]]]:
    """Seconds of the file, and the picture."""
    video = cv2.VideoCapture(str(path))
    try:
        while True:
            good, picture = video.read()
            if not good:
                return
            yield video.get(cv2.CAP_PROP_POS_MSEC) / 1000, np.asarray(picture, np.uint8)
    finally:
        video.release()


def covered(person: tuple[int, ...], box: tuple[int, int, int, int]) -> float:
    """The share of a person that lies in a box (left, top, width, height)."""
    left, top, right, bottom = person
    across = min(right, box[0] + box[2]) - max(left, box[0])
    down = min(bottom, box[1] + box[3]) - max(top, box[1])
    return max(0, across) * max(0, down) / ((right - left) * (bottom - top))

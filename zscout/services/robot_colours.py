"""The colours of robots and of what they do. Green is hidden, amber not yet, yellow an alert.

An operator has the colour that is kept for him everywhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from zscout.services.blueprint import OPERATOR, STATES

ALERT: Final = 0xFFE11AFF
HIDDEN: Final = 0x35C76BFF
IN_THE_OPEN: Final = 0xF59300FF
CAMERA: Final = 0x4FC3FFFF
"""RGBA of the field of view of a camera that is on."""
PERSON: Final = 0xB46BFFFF
PALE: Final = 0xD8DCE4FF
"""RGBA of words that say nothing special."""
DOING: Final[dict[str, int]] = {
    "search": 0x2F6FD6FF,
    "approach": 0x17A2B8FF,
    "unstick": 0xB5541CFF,
    "enter": 0x7A4FE0FF,
    "turn": 0xD08BEBFF,
    "hidden": HIDDEN,
    "watch": 0xA6DB4EFF,
    "wait": STATES["waiting"],
    "alert": ALERT,
    "blind": 0x6C7886FF,
    "lost": 0xC3C7D0FF,
    "operator": OPERATOR,
}
"""RGBA of what a behavior says that it is doing; other words have that of what has none of its own."""


def faded(colour: int, part: float) -> int:
    """An RGBA colour, seen through by 1 - `part`."""
    return colour & 0xFFFFFF00 | round(255 * part)


def bright(colour: int) -> int:
    """The colour of a text: halfway to white, for the viewer writes on what is half dark."""
    return sum((((colour >> shift & 0xFF) + 0xFF) // 2) << shift for shift in (24, 16, 8)) | colour & 0xFF


def rgba(colours: Sequence[int]) -> NDArray[np.uint32]:
    """Colours as Rerun takes them: of a list of three or four it could not tell whether they are one."""
    return np.array(colours, np.uint32)

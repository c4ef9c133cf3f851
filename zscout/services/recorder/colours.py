"""Colours of a recording, RGBA. Robots are green when hidden, amber before, yellow at an alert."""

from __future__ import annotations

from typing import Final

import rerun as rr

OPERATOR: Final = 0xFF1463FF
"""RGBA reserved for operator takeovers and preemptions."""
FAILED: Final = 0xFF3B1FFF
"""RGBA of failures that are not retried, and of conflicts."""
PALETTE: Final[tuple[int, ...]] = (
    0x4E79A7FF,  # blue
    0xF28E2BFF,  # orange
    0x59A14FFF,  # green
    0xB58ADBFF,  # lilac
    0xEDC948FF,  # yellow
    0x2FB5B5FF,  # teal
    0x9C6B4FFF,  # brown
    0xB9E36BFF,  # lime
    0x6A45C9FF,  # violet
    0x7CC4F0FF,  # sky
    0x7A7A1EFF,  # olive
    0xFFC9A0FF,  # peach
    0x1F6E5AFF,  # pine
    0xDCDCE4FF,  # pearl
)
"""RGBA of ARCs, in order of appearance; repeated after the last."""
OTHER: Final = 0x8A8A94FF
"""RGBA of bars without a colour of their own: a summary, or an ARC beyond the limit of names."""
ABSENT: Final = 0x55555CFF
"""RGBA of an absent RC."""
MAINTENANCE: Final = 0xC0C6D4FF
"""RGBA of maintenance."""
GRID: Final = 0x3A3F4AFF
"""RGBA of a chart's lines between rows and at times."""
NOW: Final = 0xF4F6FAFF
STATES: Final[dict[str, int]] = {
    "waiting": 0x6E5A20FF,
    "running": 0x2A7A46FF,
    "preempted": OPERATOR,
    "done": 0x2A2A31FF,
}
"""RGBA of the states of a request; others get `OTHER`."""
LINES: Final[tuple[int, ...]] = (0x56C1FFFF, 0xFFB454FF, 0xB5E07BFF, 0xD6A6FFFF, 0xFFF08AFF, 0x5FE0CFFF)
"""RGBA of load curves by host; brighter than `PALETTE`, as lines are thin."""
MARKS: Final[dict[str, tuple[int, rr.components.MarkerShape]]] = {
    "placed": (0xFFFFFFFF, rr.components.MarkerShape.Up),
    "restarted": (0xFFE14DFF, rr.components.MarkerShape.Circle),
    "left": (0xC9A2FFFF, rr.components.MarkerShape.Left),
    "came": (0xC9A2FFFF, rr.components.MarkerShape.Right),
    "given_up": (FAILED, rr.components.MarkerShape.Cross),
}
"""RGBA and shape of a component's events on the load curve of its host."""
ALERT: Final = 0xFFE11AFF
HIDDEN: Final = 0x35C76BFF
IN_THE_OPEN: Final = 0xF59300FF
CAMERA: Final = 0x4FC3FFFF
"""RGBA of the field of view of an active camera."""
PERSON: Final = 0xB46BFFFF
PALE: Final = 0xD8DCE4FF
"""RGBA of plain text."""
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
    "present": 0xF2D98CFF,
    "blind": 0x6C7886FF,
    "lost": 0xC3C7D0FF,
    "operator": OPERATOR,
}
"""RGBA of a behavior's activity; other activities get `OTHER`."""


def faded(colour: int, part: float) -> int:
    """The colour with opacity `part`."""
    return colour & 0xFFFFFF00 | round(255 * part)


def bright(colour: int) -> int:
    """A text colour, halfway to white: the viewer writes on a half-dark background."""
    return sum((((colour >> shift & 0xFF) + 0xFF) // 2) << shift for shift in (24, 16, 8)) | colour & 0xFF

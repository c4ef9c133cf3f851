"""Dark places in a picture: low gaps along the floor, where they are and how dark. Pure.

Brightness is compared within one picture only, since the camera sets its exposure by itself. A gap beneath
something low spans the horizon, because the camera stands lower than the gap's upper edge. Its rows below the
horizon give the distance, the ratio of the rows above to those below its height over the floor, at any
distance. That ratio tells the gap beneath a sofa (0.12 m) from the dark side of a carton (0.4 m). The gap is
sought at several levels of darkness, so that a gap in the shade of a dark sofa is found inside that shade.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zscout.behaviors.perception.lens import COLUMNS, EYE, FOCAL, RISE, ROWS, Picture, bearing, linear

LEVELS: Final = (0.04, 0.08, 0.15, 0.25)
"""Shares of the lit floor's brightness, below which something is dark: from the depth of a gap to shade."""
LOWEST: Final = 0.055
"""Metres: a lower gap is closed to the robot, or is a mark on the floor."""
HIGHEST: Final = 0.27
"""Metres: what is dark to a greater height is a dark face, or a shadow."""
NARROWEST: Final = 0.16
"""Metres: a narrower gap is no way in for a robot of 0.12 m."""
MOST_CONTRAST: Final = 120.0
_BELOW: Final = ROWS // 2
"""First row below the horizon."""
_ROOF: Final = 14
"""Rows at the top of the picture."""
_THINNEST: Final = 3
"""Columns less one of a place that counts: the narrowest way in, 6 m off."""
_CLOSE: Final = 0.3
"""Metres; nearer than that, a gap's upper edge may be out of the picture."""


class DarkPlace(NamedTuple):
    """A dark gap at the floor line. Bearings in radians (left positive), lengths in metres."""

    bearing: float
    distance: float
    width: float
    height: float
    """Of its upper edge over the floor; a lower bound where the edge is out of the picture."""
    darkness: float
    """Its brightness as a share of the lit floor's."""
    left: int
    right: int
    """First and last column."""


class View(NamedTuple):
    """The light and dark of one picture. Brightness is linear, 0 to 1."""

    lit: float
    """The lit floor of this picture."""
    near: float
    """The floor just ahead of the robot, 8 to 10 cm."""
    middling: float
    """The median of the whole picture."""
    ahead: float
    """Straight ahead at the horizon, and what stands there up to a hand's width above."""
    sides: tuple[float, float]
    """The left and the right half of the band around the horizon."""
    places: tuple[DarkPlace, ...]
    """Nearest first."""
    contrast: NDArray[np.float32]
    """Per column: the brightest floor seen further off, over the near floor; at most `MOST_CONTRAST`."""
    outside: float
    """The floor seen in the brighter half of the columns."""
    above: float
    """What is above, at the top of the picture: a roof is dark where it is dark below, a wall is not."""


def analyse(picture: Picture) -> View:
    """Light and dark places of one picture of shape (120, 160)."""
    light = linear(picture)
    lit = max(float(np.percentile(light[_BELOW + 3 :], 80)), 1e-4)
    near = _middle(light[110:, 20:140])
    # The fourth brightest row: floor, not a line of light at its end.
    top = np.partition(light[_BELOW + 1 : 104], -4, axis=0)[-4]
    band = light[_BELOW - 16 : _BELOW + 4]
    return View(
        lit=lit,
        near=near,
        middling=_middle(light[::3, ::3]),
        ahead=_middle(band[:, 60:100]),
        sides=(_middle(band[:, : COLUMNS // 2]), _middle(band[:, COLUMNS // 2 :])),
        places=_places(light, lit),
        contrast=np.minimum(top / max(near, 2e-4), MOST_CONTRAST),
        outside=float(np.percentile(top, 75)),
        above=_middle(light[:_ROOF]),
    )


def _places(light: NDArray[np.float32], lit: float) -> tuple[DarkPlace, ...]:
    """Candidates of all levels; of those that overlap, the widest at the darkest level that still holds it."""
    # A little smoothing along the rows: noise does not break a gap, edges between rows stay.
    smooth = light.copy()
    smooth[:, 1:-1] = (light[:, :-2] + light[:, 1:-1] + light[:, 2:]) / 3
    found: list[DarkPlace] = []
    for level in LEVELS:
        for place in _at_level(smooth, lit, level):
            rivals = [other for other in found if place.left <= other.right and other.left <= place.right]
            # A lighter level may widen what a darker one found; it must not water it down.
            if any(place.darkness > 1.6 * other.darkness + 0.02 or place.width < other.width for other in rivals):
                continue
            found = [*(other for other in found if other not in rivals), place]
    return tuple(sorted(found, key=lambda place: place.distance))


def _at_level(light: NDArray[np.float32], lit: float, level: float) -> list[DarkPlace]:
    dark = light < level * lit
    light_below, below = _run(dark[_BELOW:])
    light_above, above = _run(dark[_BELOW - 1 :: -1])
    # Through a gap that is open behind one may see a strip of the lit room, at the horizon.
    inside = (2 * light_below <= below) & (2 * light_above <= above) & (below >= 1) & (above >= 1)
    # Rows below the horizon at which the dark ends, between the pixels: the row where it ends is part dark.
    end, column = np.minimum(_BELOW + below, ROWS - 2), np.arange(COLUMNS)
    exact = below + 1 - np.clip(light[end, column] / np.maximum(light[end + 1, column], 1e-5), 0, 1)
    places = []
    for first, last in _stretches(inside, below):
        if last - first < _THINNEST:
            continue
        columns = slice(first, last + 1)
        held = inside[columns]
        under = _middle(exact[columns][held])
        over = _middle(above[columns][held])
        distance = RISE / under
        width = (last + 1 - first) / FOCAL * distance
        height = EYE * (1 + over / under)
        if over >= _BELOW - 1:
            if distance >= _CLOSE:
                # Dark to the top of the picture: a face.
                continue
            height = min(height, HIGHEST)
        if width < NARROWEST or not LOWEST <= height <= HIGHEST:
            continue
        rows = slice(max(0, _BELOW - int(over)), _BELOW + max(1, int(under)))
        darkness = _middle(light[rows, columns]) / lit
        lintel = light[max(0, _BELOW - int(1.4 * over) - 4) : max(0, _BELOW - int(over) - 1), columns]
        if lintel.size and _middle(lintel) < max(2 * darkness, 0.5 * level) * lit:
            # No edge above: the lower part of a dark face.
            continue
        places.append(DarkPlace(bearing((first + last) / 2), distance, width, height, darkness, first, last))
    return places


def _middle(values: NDArray[Any]) -> float:
    """The median, or the upper one of two; many times as quick as NumPy's for a few numbers."""
    flat = values.ravel()
    return float(np.partition(flat, flat.size // 2)[flat.size // 2])


def _run(dark: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Per column: how many rows come before the first dark one, and before the first light one after that.
    Both are 0 if none is dark."""
    first = np.argmax(dark, axis=0)
    light = ~dark & (np.arange(len(dark))[:, None] > first)
    last = np.where(light.any(axis=0), np.argmax(light, axis=0), len(dark))
    none = ~dark.any(axis=0)
    first[none], last[none] = 0, 0
    return first, last


def _stretches(inside: NDArray[np.bool_], below: NDArray[np.intp]) -> list[tuple[int, int]]:
    """Columns that belong together: next to each other (two may be missing), at like distances."""
    columns = np.flatnonzero(inside)
    rows = below[columns]
    jump = np.abs(np.diff(rows)) > 1.5 + 0.3 * np.minimum(rows[1:], rows[:-1])
    cuts = np.flatnonzero((np.diff(columns) > 3) | jump) + 1
    return [(int(run[0]), int(run[-1])) for run in np.split(columns, cuts) if len(run)]

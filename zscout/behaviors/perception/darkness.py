"""Dark places in a picture: low gaps along the floor, where they are and how dark. Pure.

The camera sets its own exposure, so brightness is compared within one picture. It stands lower than a gap's upper edge,
so a gap spans the horizon. Its rows below the horizon give the distance; the ratio of rows above to below gives its
height, which separates a sofa's gap (0.12 m) from a carton's dark side (0.4 m). Several levels of darkness find a gap
within the shade of a dark sofa."""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zscout.behaviors.perception.lens import COLUMNS, EYE, FOCAL, RISE, ROWS, Picture, bearing, linear

LEVELS: Final = (0.04, 0.08, 0.15, 0.25)
"""Shares of the lit floor's brightness that count as dark, from a gap's depth to shade."""
LOWEST: Final = 0.055  # metres: a lower gap is closed to the robot, or a mark on the floor
HIGHEST: Final = 0.27  # metres: a higher dark area is a face or a shadow
NARROWEST: Final = 0.16  # metres: narrower gaps do not admit a robot of 0.12 m
MOST_CONTRAST: Final = 120.0
_BELOW: Final = ROWS // 2  # first row below the horizon
_ROOF: Final = 14  # rows at the top of the picture
_THINNEST: Final = 3  # columns, less one, of the narrowest entrance, 6 m off
_CLOSE: Final = 0.3  # metres; nearer, a gap's upper edge may be out of the picture


class DarkPlace(NamedTuple):
    """A dark gap at the floor line. Bearings in radians (left positive), lengths in metres."""

    bearing: float
    distance: float
    width: float
    height: float  # of its upper edge above the floor; a lower bound if the edge is out of the picture
    darkness: float  # its brightness as a share of the lit floor's
    left: int
    right: int  # first and last column


class View(NamedTuple):
    """Brightness in one picture, linear, 0 to 1."""

    lit: float
    near: float  # the floor 8 to 10 cm ahead
    middling: float  # the median of the whole picture
    ahead: float  # straight ahead at the horizon, and up to a hand's width above
    sides: tuple[float, float]  # left and right half of the band around the horizon
    places: tuple[DarkPlace, ...]  # nearest first
    contrast: NDArray[np.float32]  # per column: brightest distant floor over near floor, at most `MOST_CONTRAST`
    outside: float  # the floor in the brighter half of the columns
    above: float  # top of the picture: above a dark floor a roof is dark, a wall is not


def analyse(picture: Picture) -> View:
    """Measure the light and find the dark places of one picture of shape (120, 160)."""
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
    """Find the dark places of all levels; of overlapping places keep the widest, at its darkest level."""
    # Smooth along the rows: noise does not break a gap, edges between rows stay.
    smooth = light.copy()
    smooth[:, 1:-1] = (light[:, :-2] + light[:, 1:-1] + light[:, 2:]) / 3
    found: list[DarkPlace] = []
    for level in LEVELS:
        for place in _at_level(smooth, lit, level):
            rivals = [other for other in found if place.left <= other.right and other.left <= place.right]
            # A lighter level may widen a darker find, not dilute it.
            if any(place.darkness > 1.6 * other.darkness + 0.02 or place.width < other.width for other in rivals):
                continue
            found = [*(other for other in found if other not in rivals), place]
    return tuple(sorted(found, key=lambda place: place.distance))


def _at_level(light: NDArray[np.float32], lit: float, level: float) -> list[DarkPlace]:
    dark = light < level * lit
    light_below, below = _run(dark[_BELOW:])
    light_above, above = _run(dark[_BELOW - 1 :: -1])
    # A gap that is open behind may show a strip of the lit room at the horizon.
    inside = (2 * light_below <= below) & (2 * light_above <= above) & (below >= 1) & (above >= 1)
    # Rows from the horizon to the end of the dark, in fractions: the last row is partly dark.
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
    """The median, or the upper one of two; much faster than NumPy's for few numbers."""
    flat = values.ravel()
    return float(np.partition(flat, flat.size // 2)[flat.size // 2])


def _run(dark: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Per column: rows before the first dark one, and before the next light one; 0 if none is dark."""
    first = np.argmax(dark, axis=0)
    light = ~dark & (np.arange(len(dark))[:, None] > first)
    last = np.where(light.any(axis=0), np.argmax(light, axis=0), len(dark))
    none = ~dark.any(axis=0)
    first[none], last[none] = 0, 0
    return first, last


def _stretches(inside: NDArray[np.bool_], below: NDArray[np.intp]) -> list[tuple[int, int]]:
    """Runs of columns: adjacent (two may be missing), at similar distances."""
    columns = np.flatnonzero(inside)
    rows = below[columns]
    jump = np.abs(np.diff(rows)) > 1.5 + 0.3 * np.minimum(rows[1:], rows[:-1])
    cuts = np.flatnonzero((np.diff(columns) > 3) | jump) + 1
    return [(int(run[0]), int(run[-1])) for run in np.split(columns, cuts) if len(run)]

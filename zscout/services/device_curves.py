"""The devices' part of the timeline: the figures that RCs tell, each a curve.

Everything is logged at the time that the recording stands at.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Final

import rerun as rr

from zscout.services.blueprint import LINES
from zscout.services.lanes import clean_path, clean_text

MAX_SERIES: Final = 200
SPACING: Final = 0.5
"""Seconds between two points; devices tell once a second at most."""
AGAIN: Final = 30.0
"""Seconds after which a figure that has not changed is drawn again."""


class DeviceCurves:
    """`note` tells people once of something left out."""

    def __init__(self, recording: rr.RecordingStream, note: Callable[[float, str], None]) -> None:
        self._recording, self._note = recording, note
        self._told: dict[tuple[str, str], tuple[float, float]] = {}
        """When and what, by RC and figure."""

    @property
    def any(self) -> bool:
        return bool(self._told)

    def show(self, at: float, rc: str, figures: Mapping[str, float]) -> None:
        """What an RC (`kind/name`) tells of its device; what is not a finite number is left out."""
        for figure, value in figures.items():
            key = rc, figure
            told, last = self._told.get(key, (-math.inf, math.nan))
            if not math.isfinite(value) or at - told < (AGAIN if value == last else SPACING):
                continue
            path = clean_path("device", f"{rc}/{figure.replace('/', '_')}")
            if key not in self._told:
                if len(self._told) >= MAX_SERIES:
                    self._note(at, f"more than {MAX_SERIES} figures of devices: the others are not drawn")
                    continue
                colour = LINES[len(self._told) % len(LINES)]
                line = rr.SeriesLines(
                    names=[clean_text(f"{rc} {figure}")],
                    colors=[colour],
                    widths=[1.5],
                    interpolation_mode=rr.components.InterpolationMode.StepAfter,
                )
                self._recording.log(path, line, static=True)
            self._told[key] = at, value
            self._recording.log(path, rr.Scalars(value))

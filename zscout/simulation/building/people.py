"""People who walk their paths now and then: times, places of their feet, and shapes for cameras."""

from __future__ import annotations

from typing import Final

import numpy as np

from zscout.simulation.building.casting import Cylinder
from zscout.simulation.building.plan import Person

STRIDE: Final = 0.7  # m of a step; the feet swing by half of it ahead and behind
FOOT: Final = 0.055  # m, radius of a leg at the floor
_HIP: Final = 0.8
_TALL: Final = 1.75
_APART: Final = 0.09


class Walker:
    """Absent between walks."""

    def __init__(self, person: Person, rng: np.random.Generator) -> None:
        self._person, self._rng = person, rng
        path = np.array(person.path, float)
        steps = np.diff(path, axis=0)
        lengths = np.hypot(steps[:, 0], steps[:, 1])
        keep = lengths > 1e-6
        self._starts = path[:-1][keep]
        self._ways = steps[keep] / lengths[keep][:, None]
        self._lengths = lengths[keep]
        self._ends = np.cumsum(self._lengths)
        self._begins = self._wait(person.first)
        self._walked = 0
        self.here = False
        self.x = self.y = 0.0
        self._way = self._ways[0]
        self._gone = 0.0

    def at(self, time: float) -> None:
        """Advance to `time`, seconds; never back."""
        person = self._person
        while True:
            self._gone = (time - self._begins) * person.speed
            if self._gone < self._ends[-1]:
                break
            self._walked += 1
            self._begins += float(self._ends[-1]) / person.speed + self._wait(person.every)
        self.here = self._gone >= 0 and not (person.walks and self._walked >= person.walks)
        if not self.here:
            return
        leg = int(np.searchsorted(self._ends, self._gone, side="right"))
        self._way = self._ways[leg]
        x, y = self._starts[leg] + self._way * (self._gone - (self._ends[leg] - self._lengths[leg]))
        self.x, self.y = float(x), float(y)

    def feet(self) -> list[tuple[float, float, float]]:
        """Circles (x, y, radius) of the feet on the floor."""
        if not self.here:
            return []
        swing = STRIDE / 2 * float(np.sin(np.pi * self._gone / STRIDE))
        way_x, way_y = float(self._way[0]), float(self._way[1])
        dx, dy, side_x, side_y = way_x * swing, way_y * swing, way_y * _APART, way_x * _APART
        return [(self.x + dx * sign - side_x * sign, self.y + dy * sign + side_y * sign, FOOT) for sign in (1, -1)]

    def shapes(self, light: float) -> list[Cylinder]:
        """Cylinders for cameras; `light` is the light on the floor there."""
        if not self.here:
            return []
        shade = self._person.shade
        legs = [Cylinder(x, y, radius, 0.0, _HIP, shade * 0.7, light, person=True) for x, y, radius in self.feet()]
        return [*legs, Cylinder(self.x, self.y, 0.18, _HIP, _TALL, shade, light, person=True)]

    def _wait(self, seconds: float) -> float:
        jitter = self._person.jitter
        return seconds * float(self._rng.uniform(1 - jitter, 1 + jitter))

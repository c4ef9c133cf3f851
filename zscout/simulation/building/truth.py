"""Ground truth about light and places, which robots are measured against but cannot read."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from zscout.simulation.building.bodies import RADIUS
from zscout.simulation.building.casting import EYE, VIEW
from zscout.simulation.building.collisions import Obstacles
from zscout.simulation.building.light import Lit, hidden
from zscout.simulation.building.plan import Plan
from zscout.simulation.building.solids import Cuboids, Floats

DARK: Final = 0.25  # places are dark below this share of the open floor's median light
BRIGHTER: Final = 3.0  # floor is lit with this many times the light of the robot's own place
FACING: Final = 0.4  # a robot faces lit floor if this share of its columns shows some
_REACH: Final = 4.0
_COLUMNS: Final = 33


class Truth:
    """Maps of a plan's floor by cell, each of shape (rows, columns)."""

    def __init__(self, plan: Plan, boxes: Cuboids, lit: Lit, obstacles: Obstacles) -> None:
        self._plan, self._boxes, self.cell = plan, boxes, lit.cell
        self.light: Floats = lit.floor.sum(0)
        self.standing = obstacles.room_for(RADIUS, lit.cell, self.light.shape)  # where a robot's middle can be
        self.open = self.standing & ~self._covered()  # standing, and nothing above
        bare = self.light[self.open]
        self.median_light = float(np.median(bare)) if len(bare) else float(np.median(self.light))
        # Starts are on the largest connected floor: elsewhere furniture may enclose a robot.
        _, parts = cv2.connectedComponents(self.standing.astype(np.uint8), connectivity=4)
        counts = np.bincount(parts[self.open])
        start = self.open & (parts == counts.argmax()) if len(counts) else self.open
        lit_floor = start & (self.light >= self.median_light * 0.4)
        self._lit_cells = np.argwhere(lit_floor if lit_floor.any() else start)

    @property
    def dark(self) -> NDArray[np.bool_]:
        """Dark cells where a robot's middle can be."""
        return self.standing & (self.light < DARK * self.median_light)

    def floor_light(self, x: float, y: float) -> float:
        """Linear light on the floor, interpolated between cells; outside, the light at the wall."""
        rows, columns = self.light.shape
        u = min(max(x / self.cell - 0.5, 0), columns - 1.001)
        v = min(max(y / self.cell - 0.5, 0), rows - 1.001)
        a, b = int(u), int(v)
        u, v = u - a, v - b
        low, high = self.light[b : b + 2, a : a + 2] @ np.array([1 - u, u])
        return float(low * (1 - v) + high * v)

    def faces_light(self, x: float, y: float, heading: float) -> bool:
        """Return True if at least FACING of the columns from (x, y) show floor within 4 m that has BRIGHTER times the
        light of this place and half of the open floor's median."""
        here = self.floor_light(x, y)
        wanted = max(BRIGHTER * here, 0.5 * self.median_light)
        angle = heading + np.linspace(-VIEW / 2, VIEW / 2, _COLUMNS)
        distance = np.arange(0.15, _REACH, 0.1)
        at_x = (x + np.cos(angle)[:, None] * distance).ravel()
        at_y = (y + np.sin(angle)[:, None] * distance).ravel()
        inside = (at_x > 0) & (at_x < self._plan.width) & (at_y > 0) & (at_y < self._plan.depth)
        column = np.clip(at_x / self.cell, 0, self.light.shape[1] - 1).astype(np.intp)
        row = np.clip(at_y / self.cell, 0, self.light.shape[0] - 1).astype(np.intp)
        bright = inside & (self.light[row, column] >= wanted)
        chosen = np.flatnonzero(bright)
        way = np.stack((at_x[chosen] - x, at_y[chosen] - y, np.full(len(chosen), -EYE)), 1).astype(np.float32)
        origin = np.tile(np.array([x, y, EYE], np.float32), (len(chosen), 1))
        seen = ~hidden(origin, way, np.full(len(chosen), 0.999, np.float32), self._boxes)
        return len(np.unique(chosen[seen] // len(distance))) >= FACING * _COLUMNS

    def reachable(self, x: float, y: float) -> NDArray[np.bool_]:
        """Cells that a robot could reach from (x, y)."""
        _, parts = cv2.connectedComponents(self.standing.astype(np.uint8), connectivity=4)
        row = int(np.clip(y / self.cell, 0, parts.shape[0] - 1))
        column = int(np.clip(x / self.cell, 0, parts.shape[1] - 1))
        reached: NDArray[np.bool_] = (parts == parts[row, column]) & self.standing
        return reached

    def random_open(self, rng: np.random.Generator) -> tuple[float, float]:
        """A place on the largest connected piece of open, lit floor."""
        if not len(self._lit_cells):
            raise ValueError(f"{self._plan.name} has no open floor")
        row, column = self._lit_cells[rng.integers(len(self._lit_cells))]
        return (float(column) + 0.5) * self.cell, (float(row) + 0.5) * self.cell

    def _covered(self) -> NDArray[np.bool_]:
        mask = np.zeros(self.light.shape, np.uint8)
        for corners in self._boxes.corners():
            cv2.fillConvexPoly(mask, np.round(corners / self.cell - 0.5).astype(np.int32), 1)
        return mask.astype(np.bool_)

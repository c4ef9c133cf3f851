"""Collisions of robots, as circles, with upright boxes and circles."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from zscout.simulation.building.plan import ROBOT_HEIGHT, Plan
from zscout.simulation.building.solids import Cuboids

Grid = NDArray[np.float64]

_ROUNDS = 4
SLACK = 1e-4  # m that a robot may reach into what it touches


class Obstacles:
    """The walls, and the parts of furniture below a robot's height."""

    def __init__(self, plan: Plan, boxes: Cuboids) -> None:
        low = boxes.where(boxes.low < ROBOT_HEIGHT)
        self.width, self.depth = plan.width, plan.depth
        self._x, self._y = low.x.astype(float), low.y.astype(float)
        self._cos, self._sin = low.cos.astype(float), low.sin.astype(float)
        self._half_width, self._half_depth = low.half_width.astype(float), low.half_depth.astype(float)

    def gap(self, x: float, y: float) -> float:
        """Metres from a point to the nearest obstacle; below 0 inside."""
        room = min(x, self.width - x, y, self.depth - y)
        if not len(self._x):
            return room
        across, along = self._offsets(x, y)
        outside = np.hypot(np.maximum(across, 0), np.maximum(along, 0))
        return min(room, float((outside + np.minimum(np.maximum(across, along), 0)).min()))

    def room_for(self, radius: float, cell: float, shape: tuple[int, int]) -> NDArray[np.bool_]:
        """True where a circle at the middle of a cell touches nothing; `shape` (rows, columns), `cell` in metres."""
        x, y = (np.arange(shape[1]) + 0.5) * cell, (np.arange(shape[0]) + 0.5) * cell
        across, along = np.minimum(x, self.width - x) >= radius, np.minimum(y, self.depth - y) >= radius
        free: NDArray[np.bool_] = along[:, None] & across
        for box in range(len(self._x)):
            # Test only the cells around the box.
            reach = float(np.hypot(self._half_width[box], self._half_depth[box])) + radius
            left, right = np.searchsorted(x, (self._x[box] - reach, self._x[box] + reach))
            low, high = np.searchsorted(y, (self._y[box] - reach, self._y[box] + reach))
            dx, dy = x[left:right] - self._x[box], y[low:high, None] - self._y[box]
            cos, sin = self._cos[box], self._sin[box]
            off = np.maximum(np.abs(dx * cos + dy * sin) - self._half_width[box], 0)
            beside = np.maximum(np.abs(dy * cos - dx * sin) - self._half_depth[box], 0)
            free[low:high, left:right] &= np.hypot(off, beside) >= radius
        return free

    def push_out(
        self, x: float, y: float, radius: float, others: list[tuple[float, float, float]]
    ) -> tuple[float, float]:
        """Push a circle out of each obstacle and of `others` (x, y, radius) in turn. In a narrow corner the new place
        may still overlap (`gap`)."""
        for _ in range(_ROUNDS):
            before = (x, y)
            x, y = min(max(x, radius), self.width - radius), min(max(y, radius), self.depth - radius)
            x, y = self._out_of_boxes(x, y, radius)
            for other_x, other_y, other_radius in others:
                away_x, away_y = x - other_x, y - other_y
                apart, least = math.hypot(away_x, away_y), radius + other_radius
                if apart < least:
                    scale = least / apart if apart > 1e-6 else 1.0
                    x, y = other_x + away_x * scale, other_y + away_y * scale
            if (x, y) == before:
                break
        return x, y

    def _offsets(self, x: float, y: float) -> tuple[Grid, Grid]:
        dx, dy = x - self._x, y - self._y
        across = np.abs(dx * self._cos + dy * self._sin) - self._half_width
        along = np.abs(dy * self._cos - dx * self._sin) - self._half_depth
        return across, along

    def _out_of_boxes(self, x: float, y: float, radius: float) -> tuple[float, float]:
        across, along = self._offsets(x, y)
        for box in np.flatnonzero(np.maximum(across, along) < radius):
            cos, sin = self._cos[box], self._sin[box]
            dx, dy = x - self._x[box], y - self._y[box]
            u, v = dx * cos + dy * sin, dy * cos - dx * sin
            half_u, half_v = self._half_width[box], self._half_depth[box]
            edge_u, edge_v = min(max(u, -half_u), half_u), min(max(v, -half_v), half_v)
            apart = float(np.hypot(u - edge_u, v - edge_v))
            if apart >= radius:
                continue
            if apart > 1e-9:
                scale = radius / apart
                u, v = edge_u + (u - edge_u) * scale, edge_v + (v - edge_v) * scale
            elif half_u - abs(u) < half_v - abs(v):
                u = (half_u + radius) * (1 if u >= 0 else -1)
            else:
                v = (half_v + radius) * (1 if v >= 0 else -1)
            x, y = float(self._x[box] + u * cos - v * sin), float(self._y[box] + u * sin + v * cos)
        return x, y

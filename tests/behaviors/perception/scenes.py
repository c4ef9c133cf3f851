"""Made-up scenes with known truth: a furnished wall, and somebody who walks along it."""

from __future__ import annotations

from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

WIDTH: Final = 160
HEIGHT: Final = 120
WALKER: Final = (14, 52)
"""Width and height of a walker in pixels."""
FLOOR: Final = 100
"""The row on which he walks."""

Light = float | NDArray[np.float64]


class Scene:
    """What a camera of `noise` grey levels sees. A walker's place is the middle column of him."""

    def __init__(self, seed: int = 0, *, noise: float = 4.0) -> None:
        self.rng = np.random.default_rng(seed)
        self.noise = noise
        coarse = self.rng.uniform(60, 190, (6, 8)).astype(np.float32)
        wall = cv2.resize(coarse, (WIDTH, HEIGHT), interpolation=cv2.INTER_NEAREST)
        grain = cv2.GaussianBlur(self.rng.normal(0, 12, (HEIGHT, WIDTH)).astype(np.float32), (5, 5), 0)
        self.wall = cv2.GaussianBlur(wall, (3, 3), 0) + grain

    def picture(self, walker: float | None = None, *, gain: Light = 1.0, shade: float = 35.0) -> NDArray[np.uint8]:
        """One picture; `gain` is the light's, of all or of each line."""
        plane = self.wall
        if walker is not None:
            left, top, width, height = box_of(walker)
            plane = plane.copy()
            plane[top : top + height, max(0, left) : max(0, left + width)] = shade
        plane = plane * gain + self.rng.normal(0, self.noise, plane.shape)
        return np.clip(plane, 0, 255).astype(np.uint8)


def box_of(walker: float) -> tuple[int, int, int, int]:
    """Left, top, width and height of a walker."""
    return round(walker) - WALKER[0] // 2, FLOOR - WALKER[1], *WALKER


def overlap(one: tuple[int, int, int, int], other: tuple[int, int, int, int]) -> float:
    """Common area over that of both (intersection over union)."""
    across = min(one[0] + one[2], other[0] + other[2]) - max(one[0], other[0])
    down = min(one[1] + one[3], other[1] + other[3]) - max(one[1], other[1])
    common = max(0, across) * max(0, down)
    return common / (one[2] * one[3] + other[2] * other[3] - common)

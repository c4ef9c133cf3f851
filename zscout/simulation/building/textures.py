"""Textures of floors and surfaces, seeded by the plan's name: planks, tiles, carpet, grain."""

from __future__ import annotations

import zlib
from functools import lru_cache
from typing import Final

import cv2
import numpy as np

from zscout.simulation.building.plan import Plan
from zscout.simulation.building.solids import Floats

GRAIN_SIZE: Final = 256


@lru_cache(maxsize=1)
def grain() -> Floats:
    """Tileable noise of mean 0 at fine and broad scales, shape (256, 256), about -0.35 to 0.35."""
    rng = np.random.default_rng(20010117)
    total = np.zeros((GRAIN_SIZE, GRAIN_SIZE), np.float32)
    for size, weight in ((256, 0.5), (64, 0.8), (16, 0.7)):
        noise = rng.standard_normal((size, size), np.float32)
        # Three copies in a row make the seams fit.
        wide = cv2.resize(np.tile(noise, (3, 3)), (3 * GRAIN_SIZE,) * 2, interpolation=cv2.INTER_CUBIC)
        total += weight * wide[GRAIN_SIZE : 2 * GRAIN_SIZE, GRAIN_SIZE : 2 * GRAIN_SIZE]
    total -= total.mean()
    tiled: Floats = np.clip(total * (0.13 / total.std()), -0.4, 0.4).astype(np.float32)
    return tiled


def floor_albedo(plan: Plan, cell: float, shape: tuple[int, ...]) -> Floats:
    """The reflected share of light by cell of the floor, with rugs; `shape` is (rows, columns)."""
    rng = np.random.default_rng(zlib.crc32(plan.name.encode()))
    y, x = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    x, y = (x + 0.5) * cell, (y + 0.5) * cell
    match plan.covering:
        case "planks":
            row = np.floor(y / 0.12).astype(np.intp)
            shift = rng.random(row.max() + 1)[row]
            plank = np.floor(x / 1.1 + shift).astype(np.intp)
            pattern = 1 + 0.12 * rng.standard_normal((row.max() + 1, plank.max() + 1))[row, plank]
        case "tiles":
            a, b = np.floor(x / 0.3).astype(np.intp), np.floor(y / 0.3).astype(np.intp)
            pattern = 1 + 0.05 * rng.standard_normal((b.max() + 1, a.max() + 1))[b, a]
            pattern = np.where((x % 0.3 < cell) | (y % 0.3 < cell), 0.7, pattern)
        case "carpet":
            pattern = 1 + 0.10 * rng.standard_normal(shape)
        case "plain":
            pattern = np.ones(shape)
    albedo = plan.floor_shade * np.clip(pattern, 0.5, 1.5)
    for rug in plan.rugs:
        cos, sin = np.cos(rug.turn), np.sin(rug.turn)
        across, along = (x - rug.x) * cos + (y - rug.y) * sin, (y - rug.y) * cos - (x - rug.x) * sin
        on = (np.abs(across) < rug.width / 2) & (np.abs(along) < rug.depth / 2)
        albedo = np.where(on, rug.shade * (1 + 0.08 * rng.standard_normal(shape)), albedo)
    shares: Floats = albedo.astype(np.float32)
    return shares

"""Rooms for tests: bare ones built piece by piece, and the shipped ones, each read once."""

from __future__ import annotations

import json
from functools import lru_cache
from typing import Any, Final

import msgspec
import numpy as np

from zscout.simulation.building.casting import FOCAL, WIDTH
from zscout.simulation.building.plan import Furniture, Light, Noise, Person, Plan, Robot, Rug, Wall
from zscout.simulation.building.plan_file import load_plan, shipped_plans

LAMP: Final = Light(name="lamp", x=2.0, y=1.5)
QUIET: Final = Noise(sensor=0, analog=0, flicker=0, daylight=0)
SOFA: Final = Furniture(name="sofa", kind="sofa", x=2.0, y=2.55, width=1.6, depth=0.85, height=0.8)
TABLE: Final = Furniture(name="table", kind="table", x=0.8, y=1.2, width=1.0, depth=0.8, height=0.74)
CARTON: Final = Furniture(name="carton", kind="solid", x=3.2, y=0.8, width=0.5, depth=0.4, height=0.4, shade=0.03)


def room(
    *furniture: Furniture,
    walls: tuple[Wall, ...] = (),
    lights: tuple[Light, ...] = (LAMP,),
    people: tuple[Person, ...] = (),
    rugs: tuple[Rug, ...] = (),
    robots: int = 1,
    slip: float = 0.0,
    noise: Noise = QUIET,
) -> Plan:
    """4 x 3 m under one lamp, with robots r1, r2 ... in a row along x from (1, 1), heading along x."""
    return Plan(
        name="room",
        width=4.0,
        depth=3.0,
        walls=walls,
        furniture=furniture,
        lights=lights,
        people=people,
        rugs=rugs,
        robots=tuple(
            Robot(name=f"r{number}", id=number, x=0.6 + 0.4 * number, y=1.0, slip=slip)
            for number in range(1, robots + 1)
        ),
        noise=noise,
    )


@lru_cache
def shipped(name: str) -> Plan:
    return load_plan(shipped_plans()[name])


def toml_of(plan: Plan) -> str:
    """The plan as a file says it, every key written out."""
    text, tables = "", ""
    data: dict[str, Any] = msgspec.to_builtins(plan)
    for key, value in data.items():
        if isinstance(value, dict):
            tables += f"\n[{key}]\n{_keys(value)}"
        elif isinstance(value, list | tuple):
            tables += "".join(f"\n[[{key}]]\n{_keys(item)}" for item in value)
        else:
            text += _keys({key: value})
    return text + tables


def _keys(table: dict[str, Any]) -> str:
    # A TOML value of these kinds is written as in JSON.
    return "".join(f"{key} = {json.dumps(value)}\n" for key, value in table.items())


def column_at(angle: float) -> int:
    """The column that looks `angle` radians to the left of the middle."""
    return round(WIDTH / 2 - 0.5 - FOCAL * float(np.tan(angle)))

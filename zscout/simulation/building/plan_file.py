"""Plans from files, read strictly and checked for consistency."""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import Final

from zscout.config.strict import BadInput, Where, check_name, check_unique, quoted, read_toml
from zscout.simulation.building.plan import Furniture, Light, Person, Plan, Robot, Rug

RANDOM: Final = "random"  # `random:SEED` draws a building
MAX_SEED: Final = 2**32 - 1
MAX_BYTES: Final = 100_000
PORCH: Final = 1.0  # m beyond the outer walls, for paths that come in by a door


def load_plan(path: Path) -> Plan:
    """Raises BadInput, which names file, key and remedy."""
    plan = read_toml(path, Plan, max_bytes=MAX_BYTES)
    top = Where(str(path))
    check_plan(plan, top)
    check_starts(plan, top)
    return plan


def shipped_plans() -> dict[str, Path]:
    folder = Path(str(resources.files("zscout.simulation.building"))) / "plans"
    return {path.stem: path for path in sorted(folder.glob("*.toml"))}


def known_buildings() -> str:
    return ", ".join((*shipped_plans(), f"{RANDOM}:SEED"))


def plan_named(name: str) -> Plan:
    """The plan of a shipped building, of `random:SEED`, or of a file. Raises BadInput."""
    shipped = shipped_plans()
    if name in shipped:
        return load_plan(shipped[name])
    kind, colon, seed = name.partition(":")
    if kind == RANDOM and colon:
        if not (seed.isascii() and seed.isdigit() and len(seed) <= 10 and int(seed) <= MAX_SEED):
            raise BadInput(f"{quoted(name)}: write random: and a number from 0 to {MAX_SEED}")
        from zscout.simulation.building.drawn import drawn_plan

        return drawn_plan(int(seed))
    path = Path(name)
    if path.suffix != ".toml" and not path.is_file():
        raise BadInput(f"unknown building {quoted(name)}; name one of {known_buildings()}, or a file")
    return load_plan(path)


def check_plan(plan: Plan, top: Where) -> None:
    """Raises BadInput for an inconsistent plan."""
    check_name(plan.name, top / "name")
    if not plan.lights:
        raise (top / "light").bad("is missing", "add a [[light]]: cameras see nothing without one")
    named: tuple[tuple[str, Sequence[Furniture | Light | Person | Robot]], ...] = (
        ("furniture", plan.furniture),
        ("light", plan.lights),
        ("person", plan.people),
        ("robot", plan.robots),
    )
    for key, things in named:
        for number, thing in enumerate(things):
            check_name(thing.name, (top / key).item(number, thing.name) / "name")
        check_unique([thing.name for thing in things], top / key, "name")
    check_unique([str(robot.id) for robot in plan.robots], top / "robot", "id")
    for number, wall in enumerate(plan.walls):
        where = (top / "wall").item(number)
        _check_point(wall.start, plan, where / "start")
        _check_point(wall.end, plan, where / "end")
        if math.dist(wall.start, wall.end) < 0.05:
            raise where.bad("is shorter than 0.05 m", "move its end")
    flat_things: tuple[tuple[str, Sequence[Furniture | Rug | Robot]], ...] = (
        ("furniture", plan.furniture),
        ("rug", plan.rugs),
        ("robot", plan.robots),
    )
    for key, flat in flat_things:
        for number, placed in enumerate(flat):
            name = getattr(placed, "name", "")
            _check_point((placed.x, placed.y), plan, (top / key).item(number, name))
    for number, piece in enumerate(plan.furniture):
        _check_piece(piece, plan, (top / "furniture").item(number, piece.name))
    for number, light in enumerate(plan.lights):
        _check_light(light, plan, (top / "light").item(number, light.name))
    for number, person in enumerate(plan.people):
        where = (top / "person").item(number, person.name) / "path"
        if len(person.path) < 2:
            raise where.bad("has less than two points", "write two or more, as in [[0.5, 1], [3, 1]]")
        for corner, point in enumerate(person.path):
            _check_point(point, plan, where.item(corner, person.name), PORCH)
        if all(math.dist(person.path[0], point) < 0.1 for point in person.path):
            raise where.bad("has no length", "move one of its points by 0.1 m or more")


def _check_point(point: tuple[float, ...], plan: Plan, where: Where, beyond: float = 0.0) -> None:
    if len(point) != 2:
        raise where.bad("is not two numbers", "write a place as [x, y]")
    x, y = point
    if not (-beyond <= x <= plan.width + beyond and -beyond <= y <= plan.depth + beyond):
        ends = [f"from {0 - beyond:g} to {size + beyond:g}" for size in (plan.width, plan.depth)]
        raise where.bad(f"({x:g}, {y:g}) is outside the plan", f"write x {ends[0]}, y {ends[1]}")


def _check_piece(piece: Furniture, plan: Plan, where: Where) -> None:
    def at_most(key: str, value: float, bound: float, meaning: str) -> None:
        if value > bound:
            raise (where / key).bad(f"is {value:g} m", f"write at most {bound:g}, {meaning}")

    at_most("height", piece.height, plan.height, "the room's")
    if piece.kind in ("raised", "sofa", "bed"):
        at_most("clearance", piece.clearance, piece.height - 0.02, "below the height")
    if piece.kind not in ("solid", "shelf"):
        at_most("leg", piece.leg, min(piece.width, piece.depth) / 2, "half of the piece")


def _check_light(light: Light, plan: Plan, where: Where) -> None:
    _check_point((light.x, light.y), plan, where)
    if light.z > plan.height:
        raise (where / "z").bad(f"is {light.z:g} m", f"write at most {plan.height:g}, the room's height")
    if light.kind == "window":
        edge = min(light.x, plan.width - light.x, light.y, plan.depth - light.y)
        if edge > 0.01:
            raise where.bad("is not in an outer wall", "put its x or y on an outer wall")
        if not light.depth / 2 <= light.z <= plan.height - light.depth / 2:
            raise (where / "z").bad(
                f"is {light.z:g} m, so the window leaves its wall",
                "write the height of its middle, at least half its depth above the floor and below the ceiling",
            )


def check_starts(plan: Plan, top: Where) -> None:
    """Raises BadInput for robots that start within a wall, furniture or each other, since they could not move."""
    # Imported late: these load numpy, which most commands do not need.
    from zscout.simulation.building.bodies import RADIUS
    from zscout.simulation.building.collisions import Obstacles
    from zscout.simulation.building.solids import cuboids_of

    obstacles = Obstacles(plan, cuboids_of(plan))
    for number, robot in enumerate(plan.robots):
        where = (top / "robot").item(number, robot.name)
        if obstacles.gap(robot.x, robot.y) < RADIUS:
            raise where.bad(
                f"({robot.x:g}, {robot.y:g}) is in or touches a wall or furniture",
                f"leave {RADIUS:g} m around its middle",
            )
        for other in plan.robots[:number]:
            if math.dist((robot.x, robot.y), (other.x, other.y)) < 2 * RADIUS:
                raise where.bad(f"overlaps {other.name}", f"leave {2 * RADIUS:g} m between their middles")

"""Buildings in files: what a good one means, and the exact line that each kind of bad one ends in."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.config.kit import NAME_RULE, short
from tests.simulation.building.rooms import shipped, toml_of
from zscout.config.strict import BadInput
from zscout.simulation.building.drawn import drawn_plan
from zscout.simulation.building.plan import MAX_FURNITURE, Furniture
from zscout.simulation.building.plan_file import MAX_BYTES, load_plan, shipped_plans

GOOD = """
name = "study"
width = 4.0
depth = 3.0

wall = [{start = [2.6, 3.0], end = [2.6, 1.6]}]
furniture = [
    {name = "couch", kind = "sofa", x = 1.2, y = 2.4, width = 1.6, depth = 0.8, height = 0.75},
    {name = "desk", kind = "table", x = 3.3, y = 2.5, width = 1.0, depth = 0.6, height = 0.74},
]
light = [
    {name = "ceiling", x = 2.0, y = 1.5},
    {name = "window", kind = "window", x = 0.0, y = 1.5, z = 1.5, width = 1.2, depth = 1.0},
]
person = [{name = "ada", path = [[-0.5, 1.0], [3.0, 1.0]]}]
robot = [
    {name = "scout33", id = 33, x = 1.0, y = 1.0},
    {name = "scout35", id = 35, x = 2.0, y = 1.0},
]
"""

BAD = {
    ('name = "study"', 'name = "my study"'): (f'name: "my study" is not a name; {NAME_RULE}'),
    ("width = 4.0", "width = 40"): ("width: is 40; write a number from 1.5 to 20"),
    ("depth = 3.0", 'depth = 3.0\ncovering = "grass"'): (
        'covering: is the text "grass"; write "carpet", "plain", "planks" or "tiles"'
    ),
    ("start = [2.6, 3.0]", "start = [2.6]"): ("wall[0].start: is not two numbers; write a place as [x, y]"),
    ("start = [2.6, 3.0]", "start = [2.6, 3.5]"): (
        "wall[0].start: (2.6, 3.5) is outside the plan; write x from 0 to 4, y from 0 to 3"
    ),
    ("end = [2.6, 1.6]", "end = [2.6, 2.98]"): ("wall[0]: is shorter than 0.05 m; move its end"),
    ('kind = "sofa"', 'kind = "couch"'): (
        'furniture[0].kind (couch): is the text "couch"; '
        'write "bed", "chair", "desk", "raised", "shelf", "sofa", "solid" or "table"'
    ),
    ("y = 2.4", "y = 3.4"): (
        "furniture[0] (couch): (1.2, 3.4) is outside the plan; write x from 0 to 4, y from 0 to 3"
    ),
    ("height = 0.75", "height = 2.6"): ("furniture[0].height (couch): is 2.6 m; write at most 2.5, the room's"),
    ("height = 0.75", "height = 0.13"): (
        "furniture[0].clearance (couch): is 0.12 m; write at most 0.11, below the height"
    ),
    ("height = 0.74", "height = 0.74, leg = 0.301"): (
        "furniture[1].leg (desk): is 0.301; write a number from 0.02 to 0.3"
    ),
    ("width = 1.0, ", "width = 0.05, "): ("furniture[1].leg (desk): is 0.05 m; write at most 0.025, half of the piece"),
    ("x = 0.0, ", "x = 0.5, "): ("light[1] (window): is not in an outer wall; put its x or y on an outer wall"),
    ("z = 1.5", "z = 0.4"): (
        "light[1].z (window): is 0.4 m, so the window leaves its wall; "
        "write the height of its middle, at least half its depth above the floor and below the ceiling"
    ),
    ("x = 2.0, y = 1.5", "x = 2.0, y = 1.5, z = 2.6"): (
        "light[0].z (ceiling): is 2.6 m; write at most 2.5, the room's height"
    ),
    ("path = [[-0.5, 1.0], [3.0, 1.0]]", "path = [[-0.5, 1.0]]"): (
        "person[0].path (ada): has less than two points; write two or more, as in [[0.5, 1], [3, 1]]"
    ),
    ("[3.0, 1.0]]", "[5.5, 1.0]]"): (
        "person[0].path[1] (ada): (5.5, 1) is outside the plan; write x from -1 to 5, y from -1 to 4"
    ),
    ("[3.0, 1.0]]", "[-0.45, 1.0]]"): ("person[0].path (ada): has no length; move one of its points by 0.1 m or more"),
    ("[3.0, 1.0]]", "[1, 2, 3]]"): ("person[0].path[1] (ada): has 3 entries; at most 2 are allowed"),
    ("id = 33", "id = 255"): ("robot[0].id (scout33): is 255; write a whole number from 0 to 254"),
    ("id = 33", "id = 35"): ('robot[1].id (35): "35" is already at robot[0]; rename or remove one of the two'),
    ('name = "ada"', 'name = "ada", speed = 0'): ("person[0].speed (ada): is 0; write a number from 0.1 to 3"),
    ("x = 1.0, y = 1.0", "x = 2.6, y = 1.62"): (
        "robot[0] (scout33): (2.6, 1.62) is in or touches a wall or furniture; leave 0.06 m around its middle"
    ),
    ("x = 1.0, y = 1.0", "x = 2.1, y = 1.0"): (
        "robot[1] (scout35): overlaps scout33; leave 0.12 m between their middles"
    ),
    ("x = 1.0, y = 1.0", "x = 0.05, y = 1.0"): (
        "robot[0] (scout33): (0.05, 1) is in or touches a wall or furniture; leave 0.06 m around its middle"
    ),
}


def read(folder: Path, text: str) -> str:
    """The line that reading `text` ends in."""
    path = folder / "plan.toml"
    path.write_text(text)
    with pytest.raises(BadInput) as caught:
        load_plan(path)
    line = str(caught.value)
    assert line.startswith(f"{path}: ")
    return line.removeprefix(f"{path}: ")


@pytest.mark.parametrize(("change", "line"), BAD.items(), ids=[short(one[1]) for one in BAD])
def test_a_bad_building_is_one_line_with_place_and_remedy(change: tuple[str, str], line: str, tmp_path: Path) -> None:
    old, new = change
    assert GOOD.count(old) == 1
    assert read(tmp_path, GOOD.replace(old, new)) == line


def test_too_much_of_anything_is_refused(tmp_path: Path) -> None:
    piece = 'kind = "solid", x = 1, y = 1, width = 1, depth = 1, height = 1'
    pieces = "".join(f'{{name = "f{n}", {piece}}},' for n in range(MAX_FURNITURE - 1))
    line = f"furniture: has {MAX_FURNITURE + 1} entries; at most {MAX_FURNITURE} are allowed"
    assert read(tmp_path, GOOD.replace("furniture = [", f"furniture = [{pieces}")) == line
    line = f"has more than {MAX_BYTES:,} bytes; shorten or split it"
    assert read(tmp_path, GOOD + "#" * MAX_BYTES) == line


def test_what_a_good_file_leaves_out_is_usual(tmp_path: Path) -> None:
    path = tmp_path / "plan.toml"
    path.write_text(GOOD)
    plan = load_plan(path)
    assert plan.furniture[0] == Furniture("couch", "sofa", 1.2, 2.4, 1.6, 0.8, 0.75, 0.0, 0.12, 0.05, 0.4)
    assert plan.walls[0].thickness == 0.1
    assert plan.lights[1].kind == "window"
    assert plan.people[0].path == ((-0.5, 1.0), (3.0, 1.0))
    assert [robot.id for robot in plan.robots] == [33, 35]
    assert plan.noise.sensor == 1.0


@pytest.mark.parametrize("name", ["living_room", "office", "drawn"])
def test_a_building_written_out_reads_as_the_same(name: str, tmp_path: Path) -> None:
    plan = drawn_plan(3) if name == "drawn" else shipped(name)
    path = tmp_path / "plan.toml"
    path.write_text(toml_of(plan))
    assert load_plan(path) == plan


def test_every_shipped_building_is_good() -> None:
    assert {"living_room", "office"} <= shipped_plans().keys()
    for name, path in shipped_plans().items():
        plan = load_plan(path)
        assert plan.name == name
        assert len(plan.robots) >= 4
        assert plan.people


def test_a_building_without_light_is_refused(tmp_path: Path) -> None:
    dark = GOOD[: GOOD.index("light = [")] + GOOD[GOOD.index("person = [") :]
    assert read(tmp_path, dark) == "light: is missing; add a [[light]]: cameras see nothing without one"

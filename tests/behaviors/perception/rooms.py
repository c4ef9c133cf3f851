"""A plain room for looking at one piece of furniture from a known place."""

from __future__ import annotations

from zscout.behaviors.perception.lens import Picture
from zscout.simulation.building.bodies import Pose
from zscout.simulation.building.plan import Furniture, Light, Plan, Robot, Rug
from zscout.simulation.building.world import World


def room(*furniture: Furniture, rugs: tuple[Rug, ...] = ()) -> Plan:
    """5 x 4 m, one lamp in the middle, one robot at its middle that looks along +x."""
    return Plan(
        name="plain",
        width=5,
        depth=4,
        furniture=furniture,
        rugs=rugs,
        lights=(Light(name="lamp", x=2.5, y=2.0),),
        robots=(Robot(name="scout", id=1, x=2.5, y=2.0),),
    )


def sofa(x: float) -> Furniture:
    """Its front, 2 m wide with a gap of 0.12 m, at `x`, towards the robot."""
    return Furniture(name="sofa", kind="sofa", x=x + 0.425, y=2.0, width=2.0, depth=0.85, height=0.8, turn=-1.5708)


def carton(x: float) -> Furniture:
    """A black box of 0.45 m on the floor, its face at `x`."""
    return Furniture(name="carton", kind="solid", x=x + 0.25, y=2.0, width=0.5, depth=0.6, height=0.45, shade=0.02)


def seen_from(plan: Plan, x: float, y: float, heading: float, *, seed: int = 1) -> Picture:
    """What a robot standing there sees, its exposure settled."""
    world = World(plan, seed=seed, starts={"scout": Pose(x, y, heading)})
    world.picture("scout")
    for _ in range(30):
        world.step(0.1)
    return world.picture("scout")

"""A hidden robot that watches, under virtual time: its alerts to people, and its false alarms.

`watch` is a single watch; `cases` are many, in several buildings at several levels of noise.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple

import cv2
import msgspec
import numpy as np

from zscout.behaviors.perception.garble import garbled
from zscout.behaviors.perception.motion import MotionDetector
from zscout.simulation.building.air import Air
from zscout.simulation.building.drawn import drawn_plan
from zscout.simulation.building.plan import Plan
from zscout.simulation.building.plan_file import load_plan, shipped_plans
from zscout.simulation.building.world import World

PIXELS: Final = 60
"""A crossing counts from this number of pixels of a person."""
IN_TIME: Final = 1.0
"""Time limit for the alert, in seconds."""
CLEAR: Final = 2.0
"""Seconds after the last pixel of a person during which an alert is not a false alarm."""
STEP: Final = 0.1
DRAWN: Final = "drawn"
"""Name of a building that is drawn at random from the case's seed."""
NOISES: Final = (0.5, 1.0, 2.0)
"""Factors of the usual noise of camera and air."""
FIRST_WALK: Final = 6.0
NEXT_WALK: Final = 20.0
"""Seconds until a person comes, and from leaving to coming again; with the plan's jitter."""


@dataclass(slots=True)
class Watched:
    """The outcome of a watch."""

    crossings: int = 0
    alerted: int = 0
    """Crossings alerted within IN_TIME."""
    late: list[float] = field(default_factory=list)
    """Seconds until the alerts of other crossings, without those never alerted."""
    false_alarms: int = 0
    """Spells of alarm with no person in view for CLEAR."""
    empty: float = 0.0
    """Seconds without a person in view."""
    garbled: int = 0
    pictures: int = 0

    def add(self, other: Watched) -> None:
        self.crossings += other.crossings
        self.alerted += other.alerted
        self.late += other.late
        self.false_alarms += other.false_alarms
        self.empty += other.empty
        self.garbled += other.garbled
        self.pictures += other.pictures


def watch(plan: Plan, *, seed: int, noise: float, seconds: float, rate: float = 5.0) -> Watched:
    """Watch from a dark place that faces the light, with `rate` pictures a second and `noise` times the usual noise of
    camera and air."""
    spoiled = msgspec.structs.replace(plan.noise, sensor=noise, analog=noise)
    world = World(msgspec.structs.replace(plan, noise=spoiled), seed=seed)
    air, detector, out = Air(seed=seed), MotionDetector(), Watched()
    robot = hide_at_random(world, np.random.default_rng(seed))
    world.bodies[robot].transmit(1, -60.0)
    due, since, alerted, wrong, last_person = 1.0, None, False, False, -60.0
    while world.time < seconds:
        world.step(STEP)
        if world.time < due:
            continue
        due += 1 / rate
        picture, now = air.receive(world, 1), world.time
        people = world.people_in_view(robot)
        out.pictures += 1
        if people:
            last_person = now
        if garbled(picture):
            out.garbled += 1
            continue
        moving = detector.see(now, picture).moving
        if people >= PIXELS and since is None:
            since, alerted = now, False
            out.crossings += 1
        if since is not None and moving and not alerted:
            alerted = True
            if now - since <= IN_TIME + 1e-6:
                out.alerted += 1
            else:
                out.late.append(now - since)
        if now - last_person > CLEAR:
            since = None
            out.empty += 1 / rate
            out.false_alarms += moving and not wrong
            wrong = moving
    return out


def hide_at_random(world: World, rng: np.random.Generator) -> str:
    """Put the first robot into a dark place, facing the light; return its name. Raises ValueError if there is none."""
    name = next(iter(world.bodies))
    truth = world.truth
    dark = np.argwhere(truth.dark)
    for _ in range(5_000):
        row, column = dark[rng.integers(len(dark))]
        x, y = (float(column) + 0.5) * truth.cell, (float(row) + 0.5) * truth.cell
        heading = float(rng.uniform(-np.pi, np.pi))
        if truth.faces_light(x, y, heading) and world.clear(x, y):
            world.bodies[name].place(x, y, heading)
            return name
    raise ValueError(f"{world.plan.name} has no dark place that faces the light")


class Case(NamedTuple):
    building: str
    """The name of a shipped plan, or DRAWN."""
    noise: float
    seed: int
    seconds: float = 90.0
    """Virtual time."""


def cases(
    buildings: Iterable[str], *, seeds: int, noises: Sequence[float] = NOISES, seconds: float = 90.0
) -> list[Case]:
    """All cases, seed by seed, so that a study that is stopped early is complete for its first seeds."""
    names = list(buildings)
    return [Case(name, noise, seed, seconds) for seed in range(seeds) for name in names for noise in noises]


def watch_case(case: Case) -> Watched:
    """Run a case, in any process. People walk often: see FIRST_WALK."""
    # Each process uses one processor: more threads would slow the other processes down.
    cv2.setNumThreads(1)
    return watch(plan_of(case), seed=case.seed, noise=case.noise, seconds=case.seconds)


def plan_of(case: Case) -> Plan:
    """The case's building, with people who walk often. Raises KeyError if it is unknown."""
    drawn = case.building == DRAWN
    plan = drawn_plan(case.seed) if drawn else load_plan(shipped_plans()[case.building])
    people = tuple(msgspec.structs.replace(person, first=FIRST_WALK, every=NEXT_WALK) for person in plan.people)
    return msgspec.structs.replace(plan, people=people)

"""A hidden robot that watches, under virtual time: what it alerts to, and when it does so for nothing.

`watch` is one such watch, `cases` are many of them, in several buildings at several levels of noise.
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
"""Of a person in the picture, from which a crossing counts."""
IN_TIME: Final = 1.0
"""Seconds within which it is to be alerted."""
CLEAR: Final = 2.0
"""Seconds after the last pixel of a person during which a word about motion is no false alarm."""
STEP: Final = 0.1
DRAWN: Final = "drawn"
"""The building of a case that is drawn at random, from the case's seed."""
NOISES: Final = (0.5, 1.0, 2.0)
"""Times the usual noise of camera and air."""
FIRST_WALK: Final = 6.0
NEXT_WALK: Final = 20.0
"""Seconds until somebody comes, and from his leaving to his coming again; with the plan's own jitter."""


@dataclass(slots=True)
class Watched:
    """What came of it."""

    crossings: int = 0
    alerted: int = 0
    """Of these, within IN_TIME."""
    late: list[float] = field(default_factory=list)
    """Seconds by which the others were later; what was never alerted is not here."""
    false_alarms: int = 0
    """Spells of alarm that began with nobody in view, or lasted until CLEAR after the last one was."""
    empty: float = 0.0
    """Seconds in which nobody was in view."""
    garbled: int = 0
    pictures: int = 0

    def add(self, other: Watched) -> None:
        """Makes it the sum of both."""
        self.crossings += other.crossings
        self.alerted += other.alerted
        self.late += other.late
        self.false_alarms += other.false_alarms
        self.empty += other.empty
        self.garbled += other.garbled
        self.pictures += other.pictures


def watch(plan: Plan, *, seed: int, noise: float, seconds: float, rate: float = 5.0) -> Watched:
    """Watches from a dark place of `plan` that faces the light, at `rate` pictures a second, with `noise`
    times the usual noise of camera and air."""
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
    """Puts the first robot into a dark place from which it faces the light; its name. Raises ValueError where
    there is none."""
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
    """One watch of many."""

    building: str
    """The name of a shipped plan, or DRAWN."""
    noise: float
    seed: int
    seconds: float = 90.0
    """Of virtual time."""


def cases(
    buildings: Iterable[str], *, seeds: int, noises: Sequence[float] = NOISES, seconds: float = 90.0
) -> list[Case]:
    """All of them, seed by seed, so that a study that is cut short is still even."""
    names = list(buildings)
    return [Case(name, noise, seed, seconds) for seed in range(seeds) for name in names for noise in noises]


def watch_case(case: Case) -> Watched:
    """Carries out one case, in whatever process. People walk often: see FIRST_WALK."""
    # One process, one processor: more threads would only get into the others' way.
    cv2.setNumThreads(1)
    return watch(plan_of(case), seed=case.seed, noise=case.noise, seconds=case.seconds)


def plan_of(case: Case) -> Plan:
    """Its building, with people who walk often. Raises KeyError for an unknown one."""
    drawn = case.building == DRAWN
    plan = drawn_plan(case.seed) if drawn else load_plan(shipped_plans()[case.building])
    people = tuple(msgspec.structs.replace(one, first=FIRST_WALK, every=NEXT_WALK) for one in plan.people)
    return msgspec.structs.replace(plan, people=people)

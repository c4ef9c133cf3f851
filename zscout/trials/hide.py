"""One Scout, a building and what stands between them, in a closed loop under virtual time.

The mind sees what comes out of the receiver, `latency` late and `frame_rate` times a second; its commands go
out at most `command_rate` times a second, and some are lost. What came of it is told from the building's own
truth, which the mind never sees.
"""

from __future__ import annotations

import math
import random
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from typing import Final

import cv2
import numpy as np

from zscout.hiding.body import Act
from zscout.hiding.hider import Hider
from zscout.packets import Camera, Drive, Packet, Stop
from zscout.simulation.air import Air
from zscout.simulation.bodies import Pose
from zscout.simulation.plan import Plan
from zscout.simulation.world import World
from zscout.vision.lens import Picture

LIMIT: Final = 120.0
WARM_UP: Final = 3.0
STEP: Final = 0.05
"""Seconds of one step of the building."""
CHANNEL: Final = 1


@dataclass(frozen=True, slots=True)
class Link:
    """What stands between a mind and its robot."""

    frame_rate: float = 5.0
    """Pictures a second."""
    latency: float = 0.15
    """Seconds from a picture to the wheels' hearing of it, half on each way."""
    loss: float = 0.05
    """Share of commands that never arrive."""
    command_rate: float = 5.0
    """Commands a second at most."""
    missing: float = 0.0
    """Share of pictures that never arrive."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """How one trial went, by the building's own truth."""

    building: str
    seed: int
    hidden_at: float | None
    """Seconds from the first picture to the mind's own word; None if it never said so."""
    dark: bool
    """The floor at the robot has less than a quarter of the median light."""
    faces_light: bool
    bumped: float
    """Seconds of pushing against something."""
    travelled: float
    """Metres."""
    share: float
    """Light at the robot's place over the median."""
    path: tuple[tuple[float, float, float, float, str], ...] = field(repr=False, default=())
    """Time, x, y, heading, state; at every picture."""

    @property
    def good(self) -> bool:
        return self.hidden_at is not None and self.dark and self.faces_light


Watch = Callable[[float, World, Picture | None, Act], None]


def trial(
    plan: Plan,
    start: Pose,
    seed: int,
    *,
    link: Link | None = None,
    limit: float = LIMIT,
    watch: Watch | None = None,
) -> Outcome:
    """One robot (the plan's first) from `start`; the others stand where the plan has them. Ends when the mind
    says that it is hidden, or after `limit` seconds from the first good picture."""
    link = link or Link()
    robot = plan.robots[0]
    world = World(plan, seed=seed, starts={robot.name: start})
    air = Air(seed=seed)
    dice = random.Random(seed)  # noqa: S311 - a trial is repeated by its seed
    hider = Hider(seed=seed)
    body = world.bodies[robot.name]
    number = 0
    body.hear(Camera(robot.id, number, CHANNEL), world.time)
    while world.time < WARM_UP:
        world.step(STEP)
    begun, next_picture, may_send = world.time, world.time, world.time
    pictures: deque[tuple[float, Picture]] = deque()
    commands: deque[tuple[float, Packet]] = deque()
    path: list[tuple[float, float, float, float, str]] = []
    bumped = 0.0
    hidden_at: float | None = None
    stood = True
    while world.time - begun < limit:
        now = world.time
        if now >= next_picture - 1e-6:
            next_picture += 1 / link.frame_rate
            if dice.random() >= link.missing:
                pictures.append((now + link.latency / 2, air.receive(world, CHANNEL)))
        while pictures and pictures[0][0] <= now + 1e-6:
            picture = pictures.popleft()[1]
            act = hider.see(now, picture)
            path.append((now - begun, body.x, body.y, body.heading, hider.state))
            if watch is not None:
                watch(now - begun, world, picture, act)
            if act.hidden:
                hidden_at = now - begun
            # A robot that stands and is to stand needs no packet.
            if (act.moves or not stood) and now >= may_send - 1e-6:
                may_send = max(may_send, now - 1 / link.command_rate) + 1 / link.command_rate
                number = (number + 1) % 256
                packet: Packet = Stop(robot.id, number)
                if act.moves:
                    packet = Drive(robot.id, number, act.left, act.right, max(0.02, act.lasts))
                stood = not act.moves
                if dice.random() >= link.loss:
                    commands.append((now + link.latency / 2, packet))
        while commands and commands[0][0] <= now + 1e-6:
            body.hear(commands.popleft()[1], now)
        if hidden_at is not None:
            break
        world.step(STEP)
        bumped += STEP * body.bumped
    for _ in range(20):
        world.step(STEP)
    share = world.floor_light(body.x, body.y) / world.median_light
    return Outcome(
        building=plan.name,
        seed=seed,
        hidden_at=hidden_at,
        dark=world.is_dark(robot.name),
        faces_light=world.faces_light(robot.name),
        bumped=bumped,
        travelled=body.travelled,
        share=share,
        path=tuple(path),
    )


@dataclass(frozen=True, slots=True)
class Job:
    """One trial of a batch: a random start, lit and clear, drawn by the seed."""

    plan: Plan
    seed: int
    link: Link = Link()


def run(job: Job) -> Outcome:
    """Carries out one job."""
    start = World(job.plan, seed=job.seed).random_start(np.random.default_rng(job.seed))
    return trial(job.plan, start, job.seed, link=job.link)


def run_all(jobs: Sequence[Job], *, processes: int = 2) -> list[Outcome]:
    """All jobs, in their order, spread over processes."""
    if processes < 2:
        return [run(job) for job in jobs]
    with ProcessPoolExecutor(processes, initializer=cv2.setNumThreads, initargs=(1,)) as pool:
        return list(pool.map(run, jobs))


@dataclass(frozen=True, slots=True)
class Figures:
    """Of the trials in one building."""

    building: str
    trials: int
    hidden: int
    """Said to be hidden, in a truly dark place, within the limit."""
    good: int
    """Of these, with the camera to the lit part."""
    median: float
    """Seconds until hidden, of the good ones; NaN if there is none."""
    slow: float
    """Nine of ten good ones were faster."""
    bumped: float
    """Mean seconds of pushing against something."""


def figures(outcomes: Iterable[Outcome]) -> list[Figures]:
    """Sums up by building, in the order in which they first come."""
    by_building: dict[str, list[Outcome]] = {}
    for outcome in outcomes:
        by_building.setdefault(outcome.building, []).append(outcome)
    summed = []
    for building, those in by_building.items():
        times = [one.hidden_at for one in those if one.good and one.hidden_at is not None]
        median, slow = np.percentile(times, [50, 90]) if times else (math.nan, math.nan)
        summed.append(
            Figures(
                building=building,
                trials=len(those),
                hidden=sum(one.hidden_at is not None and one.dark for one in those),
                good=len(times),
                median=float(median),
                slow=float(slow),
                bumped=float(np.mean([one.bumped for one in those])),
            )
        )
    return summed

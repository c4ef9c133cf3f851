"""A Scout, a building and the link between them, in a closed loop under virtual time.

The controller sees the receiver's pictures, `latency` late and `frame_rate` times a second. It sends commands at most
`command_rate` times a second, and some are lost. The outcome is judged by the building's ground truth, which the
controller never sees.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from zscout.behaviors.perception.hiding.hider import Hider
from zscout.behaviors.perception.hiding.state import WheelCommand
from zscout.behaviors.perception.lens import Picture
from zscout.drivers.packets import CameraPacket, DrivePacket, Packet, StopPacket
from zscout.simulation.building.air import Air
from zscout.simulation.building.bodies import Pose
from zscout.simulation.building.plan import Plan
from zscout.simulation.building.world import World

LIMIT: Final = 120.0
WARM_UP: Final = 3.0
STEP: Final = 0.05
"""Seconds of one step of the building."""
CHANNEL: Final = 1


@dataclass(frozen=True, slots=True)
class LinkConditions:
    """The link between a controller and its robot."""

    frame_rate: float = 5.0
    """Pictures a second."""
    latency: float = 0.15
    """Seconds from a picture to its command, half in each direction."""
    loss: float = 0.05
    """Share of commands that never arrive."""
    command_rate: float = 5.0
    """Most commands a second."""
    missing: float = 0.0
    """Share of pictures that never arrive."""


@dataclass(frozen=True, slots=True)
class HideOutcome:
    """The outcome of a trial, by the building's ground truth."""

    building: str
    seed: int
    hidden_at: float | None
    """Seconds from the first picture until the controller reports that it is hidden; None: never."""
    dark: bool
    """The floor at the robot has less than a quarter of the median light."""
    faces_light: bool
    bumped: float
    """Seconds of pushing against something."""
    travelled: float
    """Metres."""
    share: float
    """Light at the robot's place, divided by the median."""
    path: tuple[tuple[float, float, float, float, str], ...] = field(repr=False, default=())
    """Time, x, y, heading, state; at every picture."""

    @property
    def good(self) -> bool:
        return self.hidden_at is not None and self.dark and self.faces_light


Watch = Callable[[float, World, Picture | None, WheelCommand], None]


def trial(
    plan: Plan,
    start: Pose,
    seed: int,
    *,
    link: LinkConditions | None = None,
    limit: float = LIMIT,
    watch: Watch | None = None,
) -> HideOutcome:
    """Run the plan's first robot from `start`; the others stay. Ends when the controller reports that it is hidden, or
    `limit` seconds after the first picture."""
    link = link or LinkConditions()
    robot = plan.robots[0]
    world = World(plan, seed=seed, starts={robot.name: start})
    air = Air(seed=seed)
    dice = random.Random(seed)  # noqa: S311 - a trial is repeated by its seed
    hider = Hider(seed=seed)
    body = world.bodies[robot.name]
    number = 0
    body.receive(CameraPacket(robot.id, number, CHANNEL), world.time)
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
            # A robot that stands and remains there needs no packet.
            if (act.moves or not stood) and now >= may_send - 1e-6:
                may_send = max(may_send, now - 1 / link.command_rate) + 1 / link.command_rate
                number = (number + 1) % 256
                packet: Packet = StopPacket(robot.id, number)
                if act.moves:
                    packet = DrivePacket(robot.id, number, act.left, act.right, max(0.02, act.lasts))
                stood = not act.moves
                if dice.random() >= link.loss:
                    commands.append((now + link.latency / 2, packet))
        while commands and commands[0][0] <= now + 1e-6:
            body.receive(commands.popleft()[1], now)
        if hidden_at is not None:
            break
        world.step(STEP)
        bumped += STEP * body.bumped
    for _ in range(20):
        world.step(STEP)
    share = world.floor_light(body.x, body.y) / world.median_light
    return HideOutcome(
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
class HideJob:
    """A trial of a batch: a random lit and clear start, drawn by the seed."""

    plan: Plan
    seed: int
    link: LinkConditions = LinkConditions()


def run(job: HideJob) -> HideOutcome:
    start = World(job.plan, seed=job.seed).random_start(np.random.default_rng(job.seed))
    return trial(job.plan, start, job.seed, link=job.link)

"""The building alive: virtual time in which people walk, robots move and their cameras see."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

import numpy as np

from zscout.simulation.building.bodies import RADIUS, WHEEL_BASE, Body, Pose
from zscout.simulation.building.camera import Camera, Picture, shaded_by
from zscout.simulation.building.casting import Cylinder, columns_of
from zscout.simulation.building.collisions import SLACK, Obstacles
from zscout.simulation.building.light import light_of
from zscout.simulation.building.people import Walker
from zscout.simulation.building.plan import ROBOT_HEIGHT, Plan
from zscout.simulation.building.sensor import Sensor
from zscout.simulation.building.solids import cuboids_of
from zscout.simulation.building.truth import DARK, Truth

MAX_STEP: Final = 0.1
"""Seconds."""
_SUBSTEP: Final = 0.02
"""Seconds in which a robot moves 6 mm at most: less than anything is thick."""
_GRIP: Final = 0.5
"""Share of the way along an obstacle that is left to a robot that rubs against it."""


class World:
    """A plan in motion. The same plan, seed, starts and calls give the same world, bit for bit."""

    def __init__(self, plan: Plan, *, seed: int = 0, starts: Mapping[str, Pose] | None = None) -> None:
        """`starts` overrides where the named robots begin. Raises KeyError for one that the plan lacks."""
        self.plan = plan
        self.time = 0.0
        """Seconds since the beginning."""
        boxes = cuboids_of(plan)
        lit = light_of(plan)
        self._camera = Camera(plan, boxes, lit)
        self.obstacles = Obstacles(plan, boxes)
        self.truth = Truth(plan, boxes, lit, self.obstacles)
        self.median_light = self.truth.median_light
        """Of the floor with nothing above it, linear."""
        unknown = set(starts or {}) - {robot.name for robot in plan.robots}
        if unknown:
            raise KeyError(f"the plan has no robot {min(unknown)}")
        # Each part draws from a stream of its own, so that a look more or a robot less changes no other.
        streams = np.random.SeedSequence(seed).spawn(3)
        bodies = [np.random.default_rng(one) for one in streams[0].spawn(len(plan.robots))]
        sensors = [np.random.default_rng(one) for one in streams[1].spawn(len(plan.robots))]
        walkers = [np.random.default_rng(one) for one in streams[2].spawn(len(plan.people) + 1)]
        self.bodies: dict[str, Body] = {}
        """By robot name."""
        self._sensors: dict[str, Sensor] = {}
        for robot, rng, sensor_rng in zip(plan.robots, bodies, sensors, strict=True):
            start = (starts or {}).get(robot.name, Pose(robot.x, robot.y, robot.heading))
            self.bodies[robot.name] = Body(robot, start, rng)
            self._sensors[robot.name] = Sensor(plan.noise.sensor, sensor_rng)
        self._room = dict.fromkeys(self.bodies, (0.0, 0.0, 0.0))
        """Where a robot was when it was last measured, and how far from there it is from touching furniture
        or a wall: most steps are shorter and need no measuring."""
        self.walkers = [Walker(person, rng) for person, rng in zip(plan.people, walkers, strict=False)]
        self._phase = float(walkers[-1].uniform(0, 2 * np.pi))

    def step(self, dt: float) -> None:
        """Goes on by `dt` seconds, above 0 and at most 0.1."""
        if not 0 < dt <= MAX_STEP + 1e-9:
            raise ValueError(f"a step of {dt:g} s; it is above 0 and at most {MAX_STEP:g} s")
        parts = max(1, round(dt / _SUBSTEP))
        for _ in range(parts):
            self._move(dt / parts)

    def picture(self, robot: str) -> Picture:
        """What a robot's camera gives now, before the air: uint8 (120, 160). Its exposure follows the
        pictures that are taken, so a look is part of what must be repeated for the same world."""
        body = self.bodies[robot]
        sensor = self._sensors[robot]
        noise = self.plan.noise
        lamps = 1 + noise.flicker * sensor.flicker()
        linear = self._camera.linear(*body.pose, self._moving(robot), lamps, self._daylight())
        return sensor.expose(linear, self.time)

    def _move(self, dt: float) -> None:
        self.time += dt
        feet: list[tuple[float, float, float]] = []
        for walker in self.walkers:
            walker.at(self.time)
            feet += walker.feet()
        for body in self.bodies.values():
            left, right = body.roll(dt, self.time)
            near = [foot for foot in feet if abs(foot[0] - body.x) < 0.5 and abs(foot[1] - body.y) < 0.5]
            if left == 0.0 and right == 0.0 and not near:
                body.bumped = body.bumped and body.still and self._touches(body)
                continue
            self._drive(body, left, right, dt, near)

    def _drive(self, body: Body, left: float, right: float, dt: float, feet: list[tuple[float, float, float]]) -> None:
        turn = (right - left) / WHEEL_BASE * dt
        forward = (left + right) / 2 * dt
        middle = body.heading + turn / 2
        x, y = body.x + forward * math.cos(middle), body.y + forward * math.sin(middle)
        others = [(one.x, one.y, RADIUS) for one in self.bodies.values() if one is not body] + feet
        body.heading = math.remainder(body.heading + turn, math.tau)
        body.bumped = not self._is_free(body, x, y, others)
        if body.bumped:
            x, y = self.obstacles.push_out(x, y, RADIUS, others)
            # Rubbing along costs way; the wheels turn on in place.
            if not feet:
                x, y = body.x + (x - body.x) * _GRIP, body.y + (y - body.y) * _GRIP
            if not self._fits(body, x, y):
                return
        body.travelled += math.hypot(x - body.x, y - body.y)
        body.x, body.y = x, y

    def _is_free(self, body: Body, x: float, y: float, others: list[tuple[float, float, float]]) -> bool:
        """Whether a robot there touches nothing; `others` are circles (x, y, radius)."""
        at_x, at_y, room = self._room[body.name]
        if math.hypot(x - at_x, y - at_y) >= room:
            room = self.obstacles.gap(x, y) - RADIUS
            self._room[body.name] = (x, y, room)
        return room > 0 and all(
            math.hypot(x - other_x, y - other_y) >= RADIUS + radius for other_x, other_y, radius in others
        )

    def _fits(self, body: Body, x: float, y: float) -> bool:
        if self.obstacles.gap(x, y) < RADIUS - SLACK:
            return False
        return all(
            (apart := math.hypot(x - one.x, y - one.y)) >= 2 * RADIUS - SLACK
            or apart >= math.hypot(body.x - one.x, body.y - one.y)
            for one in self.bodies.values()
            if one is not body
        )

    def _touches(self, body: Body) -> bool:
        return self.obstacles.gap(body.x, body.y) < RADIUS + 2 * SLACK

    def _moving(self, robot: str | None) -> list[Cylinder]:
        shapes: list[Cylinder] = []
        for walker in self.walkers:
            if walker.here:
                # In a doorway there is no floor to be lit, and yet nobody is black there.
                light = max(self.floor_light(walker.x, walker.y), self.median_light * DARK)
                shapes += walker.shapes(light)
        for body in self.bodies.values():
            if body.name != robot:
                light = self.floor_light(body.x, body.y)
                shapes.append(Cylinder(body.x, body.y, 0.05, 0.0, ROBOT_HEIGHT, 0.25, light, person=False))
        return shapes

    def _daylight(self) -> float:
        noise = self.plan.noise
        return 1 + noise.daylight * float(np.sin(2 * np.pi * self.time / noise.daylight_period + self._phase))

    # Ground truth: what no robot knows

    def floor_light(self, x: float, y: float) -> float:
        """Light on the floor there, linear, lamps and windows at their usual; no robot's shadow counted."""
        return self.truth.floor_light(x, y)

    def is_dark(self, robot: str) -> bool:
        """Whether the robot is in a truly dark place: light below a quarter of the open floor's median."""
        body = self.bodies[robot]
        return self.floor_light(body.x, body.y) < self.median_light * DARK

    def faces_light(self, robot: str) -> bool:
        """Whether its camera looks at the lit part of the room; the rule is `Truth.faces_light`'s."""
        return self.truth.faces_light(*self.bodies[robot].pose)

    def people_in_view(self, robot: str, pose: Pose | None = None) -> int:
        """Pixels of the robot's picture that show somebody walking, unhidden; or that would if it stood elsewhere."""
        if not any(walker.here for walker in self.walkers):
            return 0
        pose, shapes = pose or self.bodies[robot].pose, self._moving(robot)
        parts = [columns_of(*pose, shape) for shape in shapes if shape.person]
        within = [part for part in parts if part is not None]
        if not within:
            return 0
        columns = slice(min(part.start for part in within), max(part.stop for part in within))
        caster = self._camera.caster
        surface = caster.with_moving(caster.cast(*pose, columns), pose.x, pose.y, shapes).surface
        people = np.array([shape.person for shape in shapes])
        moving = surface[surface >= caster.first_moving] - caster.first_moving
        return int(np.count_nonzero(people[moving]))

    def shadow_in_view(self, robot: str) -> bool:
        """Whether somebody who walks stands where his shadow may be seen in the robot's picture, himself or not."""
        if not any(walker.here for walker in self.walkers):
            return False
        pose = self.bodies[robot].pose
        return any(shape.person and shaded_by(*pose, shape) is not None for shape in self._moving(robot))

    def crossing(self, robot: str, least: int = 60) -> bool:
        """Whether people who walk cover `least` pixels or more of the robot's picture now."""
        return self.people_in_view(robot) >= least

    def clear(self, x: float, y: float) -> bool:
        """Whether a robot could stand there: no wall, furniture, robot or foot in its way."""
        circles = [(body.x, body.y, RADIUS) for body in self.bodies.values()]
        circles += [foot for walker in self.walkers for foot in walker.feet()]
        return self.obstacles.gap(x, y) >= RADIUS and all(
            np.hypot(x - other_x, y - other_y) >= RADIUS + radius for other_x, other_y, radius in circles
        )

    def random_start(self, rng: np.random.Generator) -> Pose:
        """A pose on open, lit and clear floor, any heading."""
        for _ in range(10_000):
            x, y = self.truth.random_open(rng)
            if self.clear(x, y):
                return Pose(x, y, float(rng.uniform(-np.pi, np.pi)))
        raise ValueError(f"{self.plan.name} has no open floor for one more robot")

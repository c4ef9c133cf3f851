"""People walk, robots move and cameras see, in virtual time."""

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

MAX_STEP: Final = 0.1  # s
_SUBSTEP: Final = 0.02  # s; a robot moves at most 6 mm, less than the thickness of any obstacle
_GRIP: Final = 0.5  # share of its way that a robot keeps while it rubs along an obstacle


class World:
    """A plan in motion. The same plan, seed, starts and calls give the same world, bit for bit."""

    def __init__(self, plan: Plan, *, seed: int = 0, starts: Mapping[str, Pose] | None = None) -> None:
        """`starts` overrides the start of the named robots. Raises KeyError for robots that the plan lacks."""
        self.plan = plan
        self.time = 0.0  # s since the beginning
        boxes = cuboids_of(plan)
        lit = light_of(plan)
        self._camera = Camera(plan, boxes, lit)
        self.obstacles = Obstacles(plan, boxes)
        self.truth = Truth(plan, boxes, lit, self.obstacles)
        self.median_light = self.truth.median_light
        unknown = set(starts or {}) - {robot.name for robot in plan.robots}
        if unknown:
            raise KeyError(f"the plan has no robot {min(unknown)}")
        # Each part has its own stream: an additional picture or a missing robot changes no other part.
        sizes = (len(plan.robots), len(plan.robots), len(plan.people) + 1)
        bodies, sensors, walkers = (
            [np.random.default_rng(seeds) for seeds in stream.spawn(size)]
            for stream, size in zip(np.random.SeedSequence(seed).spawn(3), sizes, strict=True)
        )
        self.bodies: dict[str, Body] = {}
        self._sensors: dict[str, Sensor] = {}
        for robot, rng, sensor_rng in zip(plan.robots, bodies, sensors, strict=True):
            start = (starts or {}).get(robot.name, Pose(robot.x, robot.y, robot.heading))
            self.bodies[robot.name] = Body(robot, start, rng)
            self._sensors[robot.name] = Sensor(plan.noise.sensor, sensor_rng)
        # Where each robot was last measured, and its distance to walls and furniture there: shorter ways need no test.
        self._room = dict.fromkeys(self.bodies, (0.0, 0.0, 0.0))
        self.walkers = [Walker(person, rng) for person, rng in zip(plan.people, walkers, strict=False)]
        self._phase = float(walkers[-1].uniform(0, 2 * np.pi))

    def step(self, dt: float) -> None:
        """Advance by `dt` seconds, above 0 and at most MAX_STEP."""
        if not 0 < dt <= MAX_STEP + 1e-9:
            raise ValueError(f"a step is {dt:g} s; it must be above 0 and at most {MAX_STEP:g} s")
        parts = max(1, round(dt / _SUBSTEP))
        for _ in range(parts):
            self._move(dt / parts)

    def picture(self, robot: str) -> Picture:
        """The robot's camera picture before transmission, uint8 (120, 160). Each call changes the camera's
        exposure: to repeat a run exactly, make the same calls."""
        sensor, noise = self._sensors[robot], self.plan.noise
        lamps = 1 + noise.flicker * sensor.flicker()
        linear = self._camera.linear(*self.bodies[robot].pose, self._moving(robot), lamps, self._daylight())
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
        others = [(other.x, other.y, RADIUS) for other in self.bodies.values() if other is not body] + feet
        body.heading = math.remainder(body.heading + turn, math.tau)
        body.bumped = not self._is_free(body, x, y, others)
        if body.bumped:
            x, y = self.obstacles.push_out(x, y, RADIUS, others)
            if not feet:
                x, y = body.x + (x - body.x) * _GRIP, body.y + (y - body.y) * _GRIP
            if not self._fits(body, x, y):
                return
        body.travelled += math.hypot(x - body.x, y - body.y)
        body.x, body.y = x, y

    def _is_free(self, body: Body, x: float, y: float, others: list[tuple[float, float, float]]) -> bool:
        """Return True if the robot would touch nothing at (x, y); `others` are circles (x, y, radius)."""
        at_x, at_y, room = self._room[body.name]
        if math.hypot(x - at_x, y - at_y) >= room:
            room = self.obstacles.gap(x, y) - RADIUS
            self._room[body.name] = (x, y, room)
        return room > 0 and all(
            math.hypot(x - other_x, y - other_y) >= RADIUS + radius for other_x, other_y, radius in others
        )

    def _fits(self, body: Body, x: float, y: float) -> bool:
        return self.obstacles.gap(x, y) >= RADIUS - SLACK and all(
            (apart := math.hypot(x - other.x, y - other.y)) >= 2 * RADIUS - SLACK
            or apart >= math.hypot(body.x - other.x, body.y - other.y)
            for other in self.bodies.values()
            if other is not body
        )

    def _touches(self, body: Body) -> bool:
        return self.obstacles.gap(body.x, body.y) < RADIUS + 2 * SLACK

    def _moving(self, robot: str | None) -> list[Cylinder]:
        shapes: list[Cylinder] = []
        for walker in self.walkers:
            if walker.here:
                # A doorway has no lit floor, but people are not black there.
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

    # Ground truth, unknown to robots

    def floor_light(self, x: float, y: float) -> float:
        """Linear light on the floor in usual light, without shadows of robots."""
        return self.truth.floor_light(x, y)

    def is_dark(self, robot: str) -> bool:
        """Return True if the robot's place has less than a quarter of the open floor's median light."""
        body = self.bodies[robot]
        return self.floor_light(body.x, body.y) < self.median_light * DARK

    def faces_light(self, robot: str) -> bool:
        return self.truth.faces_light(*self.bodies[robot].pose)

    def people_in_view(self, robot: str, pose: Pose | None = None) -> int:
        """Pixels of the robot's picture that show walking people, from `pose` if given."""
        pose, shapes = pose or self.bodies[robot].pose, self._moving(robot)
        within = [part for shape in shapes if shape.person and (part := columns_of(*pose, shape)) is not None]
        if not within:
            return 0
        columns = slice(min(part.start for part in within), max(part.stop for part in within))
        caster = self._camera.caster
        surface = caster.with_moving(caster.cast(*pose, columns), pose.x, pose.y, shapes).surface
        people = np.array([shape.person for shape in shapes])
        moving = surface[surface >= caster.first_moving] - caster.first_moving
        return int(np.count_nonzero(people[moving]))

    def shadow_in_view(self, robot: str) -> bool:
        """Return True if the robot's picture may show a walking person's shadow."""
        pose = self.bodies[robot].pose
        return any(shape.person and shaded_by(*pose, shape) is not None for shape in self._moving(robot))

    def crossing(self, robot: str, least: int = 60) -> bool:
        """Return True if walking people cover at least `least` pixels of the robot's picture."""
        return self.people_in_view(robot) >= least

    def clear(self, x: float, y: float) -> bool:
        circles = [(body.x, body.y, RADIUS) for body in self.bodies.values()]
        circles += [foot for walker in self.walkers for foot in walker.feet()]
        return self.obstacles.gap(x, y) >= RADIUS and all(
            np.hypot(x - other_x, y - other_y) >= RADIUS + radius for other_x, other_y, radius in circles
        )

    def random_start(self, rng: np.random.Generator) -> Pose:
        """On open, lit and clear floor, any heading."""
        for _ in range(10_000):
            x, y = self.truth.random_open(rng)
            if self.clear(x, y):
                return Pose(x, y, float(rng.uniform(-np.pi, np.pi)))
        raise ValueError(f"{self.plan.name} has no open floor for one more robot")

"""A robot's body: firmware, motors, and slip on the floor."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from zscout.drivers.packets import CameraPacket, DrivePacket, HaltPacket, Packet, StopPacket
from zscout.simulation.building.plan import Robot

WHEEL_BASE: Final = 0.11  # m between the wheels
RADIUS: Final = 0.06  # m; the body collides as a cylinder
TOP_SPEED: Final = 0.30  # m/s of a wheel at command 1
WARM_UP: Final = 2.0  # s until the camera's transmitter gives a good picture
LAG: Final = 0.1  # s, time constant of the motors
_DRIFTS: Final = 0.5  # s, time constant of the wheels' noise


class Pose(NamedTuple):
    """Metres and radians."""

    x: float
    y: float
    heading: float


class Body:
    """A robot, moved by the world and driven by `receive` or `command`."""

    def __init__(self, robot: Robot, start: Pose, rng: np.random.Generator) -> None:
        self.name, self.id = robot.name, robot.id
        self.x, self.y, self.heading = start
        self.left = self.right = 0.0  # commands, -1 to 1 of top speed
        self.camera: int | None = None  # the transmitter's channel; None: off
        self.camera_on_since = 0.0
        self.alive = True  # False: the battery is empty, wheels and transmitter are off
        self.bumped = False  # touches something (ground truth, unknown to the robot)
        self.travelled = 0.0  # m
        self.speed_left = self.speed_right = 0.0  # m/s of the wheels, after the motors' lag
        self._until = 0.0
        self._last: Packet | None = None
        self._slip = robot.slip
        self._gains = [float(gain) for gain in 1 + robot.slip * rng.standard_normal(2).clip(-2, 2)]
        self._wander = (0.0, 0.0)
        self._rng = rng

    @property
    def pose(self) -> Pose:
        return Pose(self.x, self.y, self.heading)

    def place(self, x: float, y: float, heading: float) -> None:
        self.x, self.y, self.heading = float(x), float(y), float(heading)
        self.speed_left = self.speed_right = 0.0

    def receive(self, packet: Packet, now: float) -> None:
        """Receive a packet at `now`, the world's seconds. Packets for other robots and repetitions are ignored; these
        are compared whole, since senders may use the same numbers."""
        if not self.alive or packet.robot != self.id or packet == self._last:
            return
        self._last = packet
        match packet:
            case DrivePacket(left=left, right=right, lasts=lasts):
                self.command(left, right, lasts, now)
            case StopPacket():
                self.command(0, 0, 0, now)
            case CameraPacket(channel=channel):
                self.transmit(channel or None, now)
            case HaltPacket():
                self.command(0, 0, 0, now)
                self.transmit(None, now)

    def command(self, left: float, right: float, lasts: float, now: float) -> None:
        """Turn the wheels at these shares of top speed until `now + lasts`."""
        self.left, self.right = float(np.clip(left, -1, 1)), float(np.clip(right, -1, 1))
        self._until = now + lasts

    def transmit(self, channel: int | None, now: float) -> None:
        """Set the transmitter's channel, or None for off. A change of channel needs no new warm-up."""
        if channel is not None and self.camera is None:
            self.camera_on_since = now
        self.camera = channel

    def warmth(self, now: float) -> float:
        """Progress of the camera's warm-up: 0 off or just switched on, 1 a good picture."""
        if self.camera is None or not self.alive:
            return 0.0
        return min(1.0, max(0.0, (now - self.camera_on_since) / WARM_UP))

    def roll(self, dt: float, now: float) -> tuple[float, float]:
        """Ground speeds of both wheels, m/s, for the next `dt` seconds from `now`."""
        if not self.alive:
            self.camera = None
        if not self.alive or now >= self._until:
            self.left = self.right = 0.0
        share = 1 - math.exp(-dt / LAG)
        self.speed_left += (self.left * TOP_SPEED - self.speed_left) * share
        self.speed_right += (self.right * TOP_SPEED - self.speed_right) * share
        if self.still:
            self.speed_left = self.speed_right = 0.0
            return 0.0, 0.0
        # Slip drifts.
        kept, spread = 1 - dt / _DRIFTS, self._slip * math.sqrt(2 * dt / _DRIFTS)
        noise = self._rng.standard_normal
        self._wander = (self._wander[0] * kept + spread * noise(), self._wander[1] * kept + spread * noise())
        left, right = (gain * (1 + drift) for gain, drift in zip(self._gains, self._wander, strict=True))
        return self.speed_left * left, self.speed_right * right

    @property
    def still(self) -> bool:
        """Return True if the wheels are at rest and no command turns them."""
        idle = self.left == 0.0 and self.right == 0.0
        return idle and abs(self.speed_left) < 1e-4 and abs(self.speed_right) < 1e-4

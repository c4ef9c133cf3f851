"""A robot's body: its firmware, its motors, and what of its commands the floor lets through."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from zscout.drivers.packets import CameraPacket, DrivePacket, HaltPacket, Packet, StopPacket
from zscout.simulation.building.plan import Robot

WHEEL_BASE: Final = 0.11
"""Metres between the wheels."""
RADIUS: Final = 0.06
"""Metres; the body is a cylinder to whatever it meets."""
TOP_SPEED: Final = 0.30
"""Metres a second of a wheel at command 1."""
WARM_UP: Final = 2.0
"""Seconds until the camera's transmitter gives a picture."""
LAG: Final = 0.1
"""Time constant of the motors, s."""
_DRIFTS: Final = 0.5
"""Time constant of the noise in what the wheels do, s."""


class Pose(NamedTuple):
    """Where a robot stands and looks; metres and radians."""

    x: float
    y: float
    heading: float


class Body:
    """One robot. The world moves it; whoever drives it calls `receive` or `command`."""

    def __init__(self, robot: Robot, start: Pose, rng: np.random.Generator) -> None:
        self.name = robot.name
        self.id = robot.id
        self.x, self.y, self.heading = start
        self.left = 0.0
        """Commanded, -1 to 1 of top speed."""
        self.right = 0.0
        self.camera: int | None = None
        """The channel that the transmitter is on; None: off."""
        self.camera_on_since = 0.0
        self.alive = True
        """False: the battery is gone. Wheels stand and the transmitter is off."""
        self.bumped = False
        """Touches something now. Ground truth: no robot knows."""
        self.travelled = 0.0
        """Metres in all."""
        self.speed_left = 0.0
        """Of the wheel itself, m/s, after the motor's lag."""
        self.speed_right = 0.0
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
        """Somebody lifts the robot and sets it down there, wheels standing."""
        self.x, self.y, self.heading = float(x), float(y), float(heading)
        self.speed_left = self.speed_right = 0.0

    def receive(self, packet: Packet, now: float) -> None:
        """The firmware gets a packet at `now`, the world's time in seconds. One for another robot is passed
        over, and so is one that is the last again: senders repeat what must arrive. The number alone does not
        tell, for another sender may happen to have come to the same."""
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
        """Turns the wheels at these shares of top speed until `now + lasts`."""
        self.left, self.right = float(np.clip(left, -1, 1)), float(np.clip(right, -1, 1))
        self._until = now + lasts

    def transmit(self, channel: int | None, now: float) -> None:
        """The camera's transmitter on that channel, or off. Another channel needs no warming up again."""
        if channel is not None and self.camera is None:
            self.camera_on_since = now
        self.camera = channel

    def warmth(self, now: float) -> float:
        """How far the camera is there: 0 off or just switched on, 1 a good picture."""
        if self.camera is None or not self.alive:
            return 0.0
        return min(1.0, max(0.0, (now - self.camera_on_since) / WARM_UP))

    def roll(self, dt: float, now: float) -> tuple[float, float]:
        """The wheels' ground speed, m/s, for the next `dt` seconds from `now` on."""
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
        # The floor's own part, which drifts.
        kept, spread = 1 - dt / _DRIFTS, self._slip * math.sqrt(2 * dt / _DRIFTS)
        noise = self._rng.standard_normal
        self._wander = (self._wander[0] * kept + spread * noise(), self._wander[1] * kept + spread * noise())
        left, right = (gain * (1 + drift) for gain, drift in zip(self._gains, self._wander, strict=True))
        return self.speed_left * left, self.speed_right * right

    @property
    def still(self) -> bool:
        """Whether the wheels stand and no command turns them."""
        idle = self.left == 0.0 and self.right == 0.0
        return idle and abs(self.speed_left) < 1e-4 and abs(self.speed_right) < 1e-4

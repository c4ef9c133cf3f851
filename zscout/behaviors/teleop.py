"""Teleoperation: an operator takes a robot, drives it by a `Pilot`, and gives it back.

teleop = Teleop(client, RobotNeeds("robot/scout33"), Pilot(), priority=10)
running = asyncio.create_task(teleop.run())
teleop.take()
teleop.pilot.press(now, "forward")
teleop.wake()
teleop.give_back()
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Coroutine
from dataclasses import dataclass
from typing import Any, Final, Literal, TypeAlias

from zscout.behaviors.client.arc import Held, Revoked, hold
from zscout.behaviors.client.client import Client, CommandRefused, RequestRefused
from zscout.behaviors.client.request import OpenArc
from zscout.behaviors.sensor_net.held_robot import HeldRobot, RobotNeeds
from zscout.mesh.supervision import done_within
from zscout.messages import ReasonInfo
from zscout.types import SECOND, Ns

PERIOD: Final = 0.05
"""Seconds between two readings of the pilot."""
LONGEST: Final = 0.6
"""Longest drive of a single command, in seconds: the robot stops after that if its operator is cut off."""
RETRY_AFTER: Final = 1.0
"""Seconds after a refusal until the robot is requested again."""

AT_LEAST: Final = 1.0
"""Minimum runtime of the hold, in seconds: another operator can't take over sooner."""

ASKS_AGAIN: Final = frozenset({"preempted", "lost"})
"""Outcomes of a hold after which the robot is requested again. Others are deliberate ends."""
FIRST: Final = 0.6
"""Seconds of driving per press of a key."""
NEXT: Final = 0.25
"""Seconds of driving per repetition of a pressed key."""
REPEATS: Final = 0.55
"""Most seconds between two presses of a key that count as repetition."""
STICK_TIMEOUT: Final = 1.0
"""Seconds for which a stick's last report counts."""
TURN: Final = 0.5
"""Share of the speed at which the robot turns on the spot: at full speed it would be hard to aim."""
DEAD_ZONE: Final = 0.08
"""Positions of a stick that count as 0: it never rests exactly there."""
SLOWEST: Final = 0.1
NOTCH: Final = 0.1
"""Change of the speed per press of + or -."""

State: TypeAlias = Literal["free", "waiting", "driving"]
Way: TypeAlias = Literal["forward", "back", "left", "right"]
WHEELS: Final[dict[Way, tuple[float, float]]] = {
    "forward": (1.0, 1.0),
    "back": (-1.0, -1.0),
    "left": (-TURN, TURN),
    "right": (TURN, -TURN),
}


@dataclass(frozen=True, slots=True)
class Wheels:
    """Speeds of the wheels, -1 to 1 of top speed, for at most `lasts` seconds."""

    left: float
    right: float
    lasts: float

    @property
    def still(self) -> bool:
        return self.left == 0 and self.right == 0


STOP: Final = Wheels(0.0, 0.0, 0.0)


class Pilot:
    """Translates keys and sticks to speeds of the wheels. Pure; time is passed in, in seconds.

    A terminal reports no releases: a key held down is repeated, first after a delay of a quarter to half a second, then
    some 30 times a second. So a press drives for FIRST seconds, which bridges the delay, each repetition for NEXT, and
    the robot stops soon after the key is released. A stick's position counts until its next report, at most for
    STICK_TIMEOUT.
    """

    def __init__(self, speed: float = 0.6) -> None:
        """`speed` is the share of top speed, above 0 and at most 1; raises ValueError for others."""
        if not 0 < speed <= 1:
            raise ValueError(f"speed is {speed:g}; it must be above 0 and at most 1")
        self.speed = speed
        self._ways: dict[Way, tuple[float, float]] = {}
        """By direction: time of the key's last press, and the time until which it drives."""
        self._stick: tuple[float, float, float] | None = None
        """Last report of a stick: time, forward, right."""

    def press(self, now: float, way: Way) -> None:
        came, drives_until = self._ways.get(way, (-math.inf, now))
        # A repetition never shortens the time of the press.
        self._ways[way] = (now, max(drives_until, now + (NEXT if now - came <= REPEATS else FIRST)))
        opposite: dict[Way, Way] = {"forward": "back", "back": "forward", "left": "right", "right": "left"}
        self._ways.pop(opposite[way], None)

    def stick(self, now: float, forward: float, right: float) -> None:
        """Take a stick's position, each axis -1 to 1; NaN counts as released."""
        values = [value if abs(value) >= DEAD_ZONE else 0.0 for value in (forward, right)]
        self._stick = (now, *(max(-1.0, min(1.0, value)) for value in values))  # type: ignore[assignment]

    def stop(self) -> None:
        """Stop at once; forget all keys and the stick."""
        self._ways.clear()
        self._stick = None

    def faster(self, notches: int) -> None:
        """Negative: slower."""
        self.speed = round(max(SLOWEST, min(1.0, self.speed + notches * NOTCH)), 2)

    def wheels(self, now: float) -> Wheels:
        """Return the speeds wanted at `now`; call it often."""
        self._ways = {way: times for way, times in self._ways.items() if now < times[1]}
        if self._ways:
            # Two keys together drive a curve.
            left = sum(WHEELS[way][0] for way in self._ways)
            right = sum(WHEELS[way][1] for way in self._ways)
            lasts = max(until for _, until in self._ways.values()) - now
        else:
            at, forward, across = self._stick or (now, 0.0, 0.0)
            lasts = STICK_TIMEOUT - (now - at)
            if lasts <= 0 or not (forward or across):
                return STOP
            left, right = forward + TURN * across, forward - TURN * across
        # Neither wheel exceeds `speed`.
        most = max(1.0, abs(left), abs(right))
        return Wheels(self.speed * left / most, self.speed * right / most, lasts)


class Teleop:
    def __init__(
        self,
        client: Client,
        needs: RobotNeeds,
        pilot: Pilot,
        *,
        priority: int,
        changed: Callable[[], None] = lambda: None,
    ) -> None:
        """`changed` is called when `state`, `why` or `takeover` changes."""
        self.client, self.needs, self.pilot, self.priority = client, needs, pilot, priority
        self.state: State = "free"
        self.why = ""
        """For people: the reason to wait, or why the robot was lost."""
        self.reason: ReasonInfo | None = None
        """The leader's reason to wait, in structured form, if `why` has its text."""
        self.robot: HeldRobot | None = None
        self.held: Held | None = None
        self.takeover: float | None = None
        """Seconds from the last `take` to the first drive command that the robot's RC accepted."""
        self._changed = changed
        self._wanted, self._unwanted = asyncio.Event(), asyncio.Event()
        self._wake = asyncio.Event()
        self._asked_at: Ns = 0
        self._name = f"operator-{needs.robot.partition('/')[2]}"

    def take(self) -> None:
        """Request the robot, and keep requesting it until `give_back`."""
        if not self._wanted.is_set():
            self._asked_at, self.takeover = self.client.mesh.now(), None
            self._wanted.set()
            self._unwanted.clear()
        self.wake()

    def give_back(self) -> None:
        """A preempted holder gets it again."""
        self.pilot.stop()
        self._wanted.clear()
        self._unwanted.set()
        self.wake()

    def wake(self) -> None:
        """Read the pilot at once, without waiting for PERIOD."""
        self._wake.set()

    async def run(self) -> None:
        """Take, drive and give back the robot on request, until cancelled, which also gives it back."""
        self.client.internals.watch(self._on_notice)
        while True:
            await self._wanted.wait()
            self._set_state("waiting", "for the RCM")
            why = ""
            try:
                await self._while_wanted(self._drive())
                if self._wanted.is_set():
                    # To request it again would preempt another operator of the same rank, and so on in turns.
                    ending = self.held.arc._ending if self.held is not None else None
                    successor = (ending.by or ending.reason) if ending is not None else ""
                    why = f"it was taken by {successor or 'another request'}"
                    self.give_back()
            except Revoked as revoked:
                self._set_state("waiting", f"it was taken away: {revoked}")
                if revoked.outcome not in ASKS_AGAIN:
                    why = str(revoked)
                    self.give_back()
            except (CommandRefused, RequestRefused) as refused:
                self._set_state("waiting", str(refused))
                await asyncio.sleep(RETRY_AFTER)
            finally:
                self.robot = self.held = None
            if not self._wanted.is_set():
                self._set_state("free", why)

    def _on_notice(self, arc: OpenArc) -> None:
        if arc.name == self._name and arc.state == "queued" and self.state == "waiting" and arc.reason:
            self._set_state("waiting", arc.reason, arc.why)

    async def _while_wanted(self, work: Coroutine[Any, Any, None]) -> None:
        """Cancel `work` when the robot is given back."""
        tasks = [asyncio.create_task(work), asyncio.create_task(self._unwanted.wait())]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()
            results = await asyncio.gather(*tasks, return_exceptions=True)
        if isinstance(results[0], Exception):
            raise results[0]

    async def _drive(self) -> None:
        # Wait for a camera that has not joined yet.
        how: dict[str, Any] = {"priority": self.priority, "min_runtime": AT_LEAST, "wait_for_device": True}
        async with hold(self.client, self._name, self.needs.needs(), **how) as held:
            robot = self.robot = HeldRobot(held, self.needs)
            self.held = held
            self._set_state("driving", "")
            while True:
                # The wheels before the camera: an operator in a hurry must not wait for it.
                await self._steer(robot)
                await robot.camera(True)
                await done_within(PERIOD, self._wake.wait())

    async def _steer(self, robot: HeldRobot) -> None:
        self._wake.clear()
        wheels = self.pilot.wheels(self.client.mesh.now() / SECOND)
        obeyed = await robot.drive(wheels.left, wheels.right, min(wheels.lasts, LONGEST))
        if self.takeover is None and obeyed and not wheels.still:
            self.takeover = (self.client.mesh.now() - self._asked_at) / SECOND
            self._changed()

    def _set_state(self, state: State, why: str, reason: ReasonInfo | None = None) -> None:
        if (state, why) != (self.state, self.why):
            self.state, self.why, self.reason = state, why, reason
            self._changed()

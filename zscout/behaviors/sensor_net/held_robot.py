"""A robot that is held together with its radio, a video channel and a framegrabber."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from zscout.behaviors.client.arc import Held
from zscout.behaviors.client.client import CommandRefused
from zscout.drivers.packets import MAX_PACKET
from zscout.types import SECOND, Ns

GONE: Final = frozenset({"ended", "free", "not_holder", "wrong_client"})
"""Refusals that mean: this hold is over, and the client's notice is on its way."""


@dataclass(frozen=True, slots=True)
class RobotNeeds:
    """What a behavior with one robot needs at the same moment. All but `robot` may be patterns."""

    robot: str
    radio: str = "radio/*"
    video: str = "video/*"
    framegrabber: str = "framegrabber/*"
    command_rate: float = 5.0
    """Commands in a second that it will send at most."""

    def needs(self, *, video: str | None = None) -> dict[str, dict[str, Any]]:
        """As an ARC asks for them; `video` names another channel than usual."""
        return {
            self.robot: {},
            self.radio: {"command_rate": self.command_rate, "packet_size": MAX_PACKET},
            video or self.video: {"transmitters": 1},
            self.framegrabber: {},
        }


class HeldRobot:
    """Commands to the robot, at the rate that its ARC asked for."""

    def __init__(self, held: Held, needs: RobotNeeds, *, video: str | None = None) -> None:
        self.held = held
        self.robot = held.rc(needs.robot)
        self.video = held.rc(video or needs.video)
        self.framegrabber = held.rc(needs.framegrabber)
        self._period: Ns = round(SECOND / needs.command_rate)
        self._next: Ns = 0
        self._still = False
        """Whether the last that was sent is a stop."""
        self._transmits: bool | None = None
        """As it was last commanded; None: not yet, or it may not have received it."""
        self.sent = self.refused = 0

    async def camera(self, on: bool, *, remind: bool = False) -> bool:
        """Switches its transmitter on, to the channel that is held, or off. Sent once, unless `remind`:
        call this again until it is True."""
        if on != self._transmits or remind:
            self._transmits = on if await self._command({"name": "camera", "on": on}) else None
        return on == self._transmits

    async def drive(self, left: float, right: float, lasts: float) -> bool:
        """Turns the wheels (-1 to 1 of top speed) for `lasts` seconds at most, unless the next command comes
        before. False: not sent, because it was too early for another one.

        Wheels that are to stand are stopped at once, by one command."""
        if left == 0 and right == 0:
            self._still = self._still or await self._command({"name": "stop"})
            return self._still
        now = self.held.now()
        if now < self._next:
            return False
        # A command that comes late does not make the next one late as well.
        self._next = max(self._next + self._period, now)
        self._still = False
        return await self._command({"name": "drive", "left": left, "right": right, "lasts": lasts})

    async def _command(self, do: dict[str, Any]) -> bool:
        try:
            await self.held.command(self.robot, do)
        except CommandRefused as refused:
            self.refused += 1
            if refused.code in GONE:
                # What takes the hold away also interrupts the body that we are in.
                await self.held.over()
            return False
        self.sent += 1
        return True

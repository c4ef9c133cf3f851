"""A robot held together with its radio, a video channel and a framegrabber."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from zscout.behaviors.client.arc import Held
from zscout.behaviors.client.client import CommandRefused
from zscout.config.strict import quoted
from zscout.drivers.packets import MAX_PACKET
from zscout.types import SECOND, Ns

GONE: Final = frozenset({"ended", "free", "not_holder", "wrong_client"})
"""Refusals after the end of this hold; the client's notice is on its way."""


@dataclass(frozen=True, slots=True)
class RobotNeeds:
    """The simultaneous needs of a behavior with one robot. All but `robot` may be patterns."""

    robot: str
    radio: str = "radio/*"
    video: str = "video/*"
    framegrabber: str = "framegrabber/*"
    command_rate: float = 5.0  # most commands per second

    def shared_camera(self) -> str:
        """Return why the framegrabber can't be a need of its own, or an empty string."""
        for purpose, need in (("radio", self.radio), ("video channel", self.video)):
            if self.framegrabber == need:
                return f"{quoted(need)} is needed already, as the {purpose}"
        return ""

    def needs(self, *, video: str | None = None) -> dict[str, dict[str, Any]]:
        """For an ARC; `video` names another channel than usual."""
        return {
            self.robot: {},
            self.radio: {"command_rate": self.command_rate, "packet_size": MAX_PACKET},
            video or self.video: {"transmitters": 1},
            self.framegrabber: {},
        }


class HeldRobot:
    def __init__(self, held: Held, needs: RobotNeeds, *, video: str | None = None) -> None:
        self.held = held
        self.robot = held.rc(needs.robot)
        self.video = held.rc(video or needs.video)
        self.framegrabber = held.rc(needs.framegrabber)
        self._period: Ns = round(SECOND / needs.command_rate)
        self._next: Ns = 0
        self._still = False  # the last command was a stop
        self._transmits: bool | None = None  # as last commanded; None if unknown
        self.sent = self.refused = 0

    async def camera(self, on: bool, *, remind: bool = False) -> bool:
        """Switch its transmitter on (to the held channel) or off, once unless `remind`; repeat until True."""
        if on != self._transmits or remind:
            self._transmits = on if await self._command({"name": "camera", "on": on}) else None
        return on == self._transmits

    async def drive(self, left: float, right: float, lasts: float) -> bool:
        """Turn the wheels (-1 to 1 of top speed) for `lasts` seconds. Stops are sent at once, by one command; others
        return False, unsent, if they come too early."""
        if left == 0 and right == 0:
            self._still = self._still or await self._command({"name": "stop"})
            return self._still
        now = self.held.now()
        if now < self._next:
            return False
        # A late command does not delay the next.
        self._next = max(self._next + self._period, now)
        self._still = False
        return await self._command({"name": "drive", "left": left, "right": right, "lasts": lasts})

    async def _command(self, do: dict[str, Any]) -> bool:
        try:
            await self.held.command(self.robot, do)
        except CommandRefused as refused:
            self.refused += 1
            if refused.code in GONE:
                # The revocation also interrupts this body.
                await self.held.over()
            return False
        self.sent += 1
        return True

"""What one robot of a sensor net does with what it sees. Pure: time and pictures in, wheels and words out.

A scout has two tasks. It *hides* until it stands in the dark and faces the light, and then *watches* for
motion. It does either only while it is held, and lives on in between; `PlaceRobot` puts it on the mesh, the
studies and tests run it under virtual time.
"""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Any, Final, Literal, TypeAlias

from zscout.behaviors.perception.garble import garbled
from zscout.behaviors.perception.hiding.hider import Hider
from zscout.behaviors.perception.lens import Picture
from zscout.behaviors.perception.motion import Box, MotionDetector
from zscout.behaviors.sensor_net.blindness import Blindness

PATIENCE: Final = 10.0
"""Seconds from the beginning of a hold, or from the last picture, until the robot counts as not seen."""

QUIET: Final = 2.0
"""Seconds without motion after which the next one is another event."""

Task: TypeAlias = Literal["hide", "watch"]


@dataclass(frozen=True, slots=True)
class Step:
    """What follows from one look."""

    left: float
    """Wheels: -1 to 1 of top speed."""
    right: float
    lasts: float
    """Seconds that they may turn without a newer command."""
    doing: str
    detail: str
    boxes: tuple[Box, ...] = ()
    """Of what moves, in pixels of the picture."""
    alert: bool = False
    """Something has begun to move."""
    quiet: bool = False
    """It has stopped moving: boxes shown before are old."""
    over: bool = False
    """The task of this hold is done: give it back, and ask for the other."""
    blind: bool = False
    """No picture for too long: give the hold back."""


class Alerts:
    """One alert for each time that something moves."""

    def __init__(self) -> None:
        self.count = 0
        self._last: float | None = None
        """When motion was seen last, within one event."""

    @property
    def moving(self) -> bool:
        return self._last is not None

    def see(self, now: float, moving: bool) -> str:
        """`start` where an event begins, `end` where it is over, else an empty word."""
        if moving:
            began, self._last = self._last is None, now
            self.count += began
            return "start" if began else ""
        if self._last is not None and now - self._last >= QUIET:
            self._last = None
            return "end"
        return ""

    def rest(self) -> None:
        """Nobody watches any more: whatever comes next is another event."""
        self._last = None

    def memory(self) -> dict[str, Any]:
        return {"count": self.count}

    def recall(self, memory: dict[str, Any]) -> None:
        self.count = int(memory["count"])


class Scout:
    """One robot's part of the net."""

    def __init__(self, *, seed: int = 0) -> None:
        self.hider = Hider(seed=seed)
        self.alerts = Alerts()
        self.blindness = Blindness(PATIENCE)
        self._detector = MotionDetector()
        self._task: Task = "hide"
        """Of the present hold."""
        self._held = False
        self.silent = False
        """Whether the last hold ended without any picture: its channel is to be left."""

    @property
    def task(self) -> Task:
        """What it would be held for now."""
        return "watch" if self.hider.state == "hidden" else "hide"

    def held(self, now: float) -> None:
        """A hold begins, or goes on elsewhere after a move. `now` in seconds, by the clock of all calls."""
        if self._held:
            return
        self._held = True
        self._task = self.task
        self._detector = MotionDetector()
        self.hider.resumed(now)
        self.blindness.begin(now)

    def released(self, now: float) -> None:
        """The hold is over, for whatever reason: the robot stands, and somebody else may move it."""
        self._held = False
        self.silent = self.blindness.end(now)
        self.hider.interrupted(now)
        self.alerts.rest()

    def see(self, now: float, picture: Picture | None, channel: str) -> Step:
        """Takes the newest picture, or None if none came, from the robot on this video channel."""
        defect = garbled(picture) if picture is not None else None
        good = picture is not None and defect is None
        blind = self.blindness.see(now, good, channel, came=picture is not None)
        act = self.hider.see(now, picture, defect)
        step = Step(
            act.left, act.right, act.lasts, act.doing, act.why, blind=blind, over=self.task != self._task
        )
        if self._task == "hide" or step.over or step.blind:
            return step
        if picture is None or not good:
            return Step(0, 0, 0, "blind", "no good picture")
        return self._watch(now, picture)

    def _watch(self, now: float, picture: Picture) -> Step:
        seen = self._detector.see(now, picture)
        edge = self.alerts.see(now, seen.moving)
        doing = "alert" if self.alerts.moving else "watch"
        words = f"motion {self.alerts.count}" if self.alerts.moving else f"{self.alerts.count} alerts so far"
        boxes = tuple(seen.boxes) if self.alerts.moving else ()
        return Step(0, 0, 0, doing, words, boxes, alert=edge == "start", quiet=edge == "end")

    # What outlives a move

    def memory(self) -> dict[str, Any]:
        """All but what the detector has learned: that begins anew."""
        return {
            "hider": base64.b64encode(self.hider.checkpoint()).decode(),
            "alerts": self.alerts.memory(),
            "blindness": self.blindness.memory(),
            "task": self._task,
            "held": self._held,
        }

    def recall(self, memory: dict[str, Any]) -> None:
        """Raises ValueError for what is no such memory."""
        self.hider = Hider.restore(base64.b64decode(memory["hider"]))
        self.alerts.recall(memory["alerts"])
        self.blindness.recall(memory["blindness"])
        self._task = "watch" if memory["task"] == "watch" else "hide"
        self._held = bool(memory["held"])

"""What one robot of a sensor net does with what it sees. Pure: time and pictures in, wheels and words out.

A scout has two tasks, each only while it is held: it *hides* until it stands in the dark and faces the light,
and then *watches* for motion.
"""

from __future__ import annotations

import base64
import math
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final, Literal, TypeAlias

from zscout.behaviors.perception.garble import garbled
from zscout.behaviors.perception.hiding.hider import Hider
from zscout.behaviors.perception.lens import Picture
from zscout.behaviors.perception.motion import Box, MotionDetector

NO_PICTURE_TIMEOUT: Final = 10.0
"""Seconds from the beginning of a hold, or from the last picture, until the robot counts as not seen."""

QUIET: Final = 2.0
"""Seconds without motion after which the next one is another event."""
SUSPECTS: Final = 2
"""Holds in a row without a picture that prove a robot dead."""
BAD_FOR: Final = 60.0
"""Seconds for which a channel that showed nothing is avoided."""
NO_SIGNAL_TIMEOUT: Final = 4.0
"""Seconds without any picture at the end of a hold that prove a receiver dead: framegrabbers give up after five."""
REMIND: Final = 4.0
"""Seconds without a good picture, above any warm-up, after which a robot may not have received the command to
transmit."""

LATELY: Final = 2
"""Turns to watch back to which what was seen counts."""

Task: TypeAlias = Literal["hide", "watch"]


@dataclass(frozen=True, slots=True)
class Step:
    left: float
    right: float
    lasts: float
    """Wheels: -1 to 1 of top speed, for so many seconds without a newer command."""
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
    learning: bool = False
    """It watches, and can't tell yet what moves."""


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


class Blindness:
    """Why there is no picture of a robot, over its holds: because of the channel, or of the robot.

    A robot whose transmitter is on shows a picture within seconds. If none comes for `timeout`, the channel
    may be jammed, its receiver dead, or the robot. So another channel is tried where there is one: a robot
    that is not seen on SUSPECTS in a row is dead; one that is seen had a bad channel, which is avoided for a
    while. A channel without any picture, not even snow, has no receiver that works: its framegrabber gives
    up, the hold ends before `timeout` is over, and the robot is not to blame.
    """

    def __init__(self, timeout: float) -> None:
        self.timeout = timeout
        """Seconds without a picture, warm-up included."""
        self._dark_since: float | None = None
        self._bad: dict[str, float] = {}
        """Channels on which this robot was not seen, and when."""
        self._in_row = 0
        self._reminded = 0.0
        self._channel = ""
        self._no_signal_since: float | None = None

    def begin(self, now: float) -> None:
        """A hold has begun: the transmitter is being switched on."""
        self._dark_since = now
        self._channel, self._no_signal_since = "", now

    def see(self, now: float, good: bool, channel: str, *, came: bool | None = None) -> bool:
        """Takes what a look showed; `came`: any picture, if not a good one. True: no good picture for too
        long on this channel."""
        self._channel = channel
        if good or came:
            self._no_signal_since = now
        if good:
            self._dark_since = None
            self._in_row = 0
            self._bad.pop(channel, None)
            return False
        if self._dark_since is None:
            self._dark_since = now
        if now - self._dark_since < self.timeout:
            return False
        self._bad[channel] = now
        self._in_row += 1
        self._dark_since = None
        return True

    def remind(self, now: float) -> bool:
        """Whether the robot is to be commanded once more to transmit: its radio goes one way."""
        since = self._dark_since
        if since is None or now - max(since, min(self._reminded, now)) < REMIND:
            return False
        self._reminded = now
        return True

    def end(self, now: float) -> bool:
        """The hold is over. True: its channel gave nothing at all, and is to be left."""
        since, self._no_signal_since = self._no_signal_since, None
        if since is None or not self._channel or now - since < NO_SIGNAL_TIMEOUT:
            return False
        self._bad[self._channel] = now
        return True

    @property
    def dead(self) -> bool:
        """Whether that is enough to give the robot up; of a single channel, two tries on it are."""
        return self._in_row >= SUSPECTS

    def choose(self, now: float, channels: Iterable[str]) -> str | None:
        """A channel to ask for by name, because another one is to be avoided; None: any will do. Where all are, the
        one that showed nothing the longest ago."""
        self._bad = {channel: at for channel, at in self._bad.items() if now - at < BAD_FOR}
        if self._bad.keys().isdisjoint(channels := set(channels)):
            return None
        return min(channels, key=lambda channel: (self._bad.get(channel, -math.inf), channel))

    def memory(self) -> dict[str, Any]:
        return {"bad": self._bad, "in_row": self._in_row}

    def recall(self, memory: dict[str, Any]) -> None:
        self._bad = {str(channel): float(at) for channel, at in memory["bad"].items()}
        self._in_row = int(memory["in_row"])


class Scout:
    def __init__(self, *, seed: int = 0) -> None:
        self.hider = Hider(seed=seed)
        self.alerts = Alerts()
        self.blindness = Blindness(NO_PICTURE_TIMEOUT)
        self._detector = MotionDetector()
        self._task: Task = "hide"
        """Of the present hold."""
        self._alerts = 0
        """Before the present turn."""
        self._turns: deque[bool] = deque(maxlen=LATELY)
        """Of its last turns to watch: whether it saw somebody."""
        self._held = self.no_signal = False
        """The last hold ended without any picture, not even snow, so its channel is to be left."""

    @property
    def task(self) -> Task:
        """What it would be held for now."""
        return "watch" if self.hider.state == "hidden" else "hide"

    @property
    def saw_somebody(self) -> bool:
        """Whether it has lately."""
        return any(self._turns)

    def held(self, now: float, *, goes_on: bool = False) -> None:
        """A hold begins, or `goes_on` elsewhere after a move. `now` in seconds, by the clock of all calls."""
        if self._held:
            if goes_on:
                return
            # It was lost on the way, and others may have moved the robot.
            self.released(now)
        self._held = True
        self._task = self.task
        self._alerts = self.alerts.count
        if self._task == "hide":
            self._turns.clear()
            self._detector = MotionDetector()
        else:
            # It is where it was, if nobody has moved it: what it knows of its background it need not learn again.
            self._detector.pause()
        self.hider.resumed(now)
        self.blindness.begin(now)

    def released(self, now: float) -> None:
        """The hold is over, for whatever reason: the wheels are stopped, and others may move the robot."""
        if self._held and self._task == "watch":
            self._turns.append(self.alerts.count > self._alerts)
        self._held = False
        self.no_signal = self.blindness.end(now)
        self.hider.interrupted(now)
        self.alerts.rest()

    def see(self, now: float, picture: Picture | None, channel: str) -> Step:
        """Takes the newest picture, or None if none came, from the robot on this video channel."""
        defect = garbled(picture) if picture is not None else None
        good = picture is not None and defect is None
        blind = self.blindness.see(now, good, channel, came=picture is not None)
        act = self.hider.see(now, picture, defect)
        step = Step(act.left, act.right, act.lasts, act.doing, act.why, blind=blind, over=self.task != self._task)
        if self._task == "hide" or step.over or step.blind:
            return step
        if picture is None or not good:
            # Nobody sees whether it goes on: what moves later is another event.
            edge = self.alerts.see(now, False)
            return Step(0, 0, 0, "blind", "no good picture", quiet=edge == "end")
        seen = self._detector.see(now, picture)
        edge, count = self.alerts.see(now, seen.moving), self.alerts.count
        if self.alerts.moving:
            return Step(0, 0, 0, "alert", f"motion {count}", tuple(seen.boxes), alert=edge == "start")
        if seen.present:
            return Step(0, 0, 0, "present", f"who moved stands still, motion {count}", quiet=edge == "end")
        words = f"{count} alerts so far"
        return Step(0, 0, 0, "watch", words, quiet=edge == "end", learning=seen.learning)

    # What outlives a move

    def memory(self) -> dict[str, Any]:
        """All but what the detector has learned: that begins anew."""
        return {
            "hider": base64.b64encode(self.hider.checkpoint()).decode(),
            "alerts": {"count": self.alerts.count, "before": self._alerts, "turns": list(self._turns)},
            "blindness": self.blindness.memory(),
            "task": self._task,
            "held": self._held,
        }

    def recall(self, memory: dict[str, Any]) -> None:
        """Raises ValueError for what is no such memory."""
        self.hider = Hider.restore(base64.b64decode(memory["hider"]))
        alerts = memory["alerts"]
        self.alerts.count = int(alerts["count"])
        self._alerts = int(alerts.get("before", self.alerts.count))
        self._turns = deque(map(bool, alerts.get("turns", ())), maxlen=LATELY)
        self.blindness.recall(memory["blindness"])
        self._task = "watch" if memory["task"] == "watch" else "hide"
        self._held = bool(memory["held"])

"""Decisions of one robot of a sensor net. Pure: times and pictures in, wheel speeds and status out.

While held, it first *hides* until it stays in the dark and faces the light, and then *watches* for motion."""

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
from zscout.messages import MotionLimits

NO_PICTURE_TIMEOUT: Final = 10.0  # seconds from a hold's start, or the last picture, until the robot counts as unseen

QUIET: Final = 2.0  # seconds without motion that separate two events
SUSPECTS: Final = 2  # holds in a row without a picture that prove a robot dead
BAD_FOR: Final = 60.0  # seconds for which an empty channel is avoided
NO_SIGNAL_TIMEOUT: Final = 4.0  # seconds that prove a receiver dead: framegrabbers give up after five
REMIND: Final = 4.0  # seconds without a good picture, above any warm-up, before the command to transmit is repeated

LATELY: Final = 2  # turns to watch that count as recent

Task: TypeAlias = Literal["hide", "watch"]


@dataclass(frozen=True, slots=True)
class Step:
    left: float
    right: float
    lasts: float  # wheels: -1 to 1 of top speed, for so many seconds without a newer command
    doing: str
    detail: str
    boxes: tuple[Box, ...] = ()  # around motion, in pixels of the picture
    alert: bool = False  # motion began
    quiet: bool = False  # motion ended: earlier boxes are old
    over: bool = False  # the task is done: give the hold back, and request the other
    blind: bool = False  # no picture for too long: give the hold back
    learning: bool = False  # watching, but still learning the background


class Alerts:
    def __init__(self) -> None:
        self.count = 0
        self._last: float | None = None  # last motion of the present event
        self._spell: tuple[float, float] | None = None  # first and last motion, with pauses shorter than QUIET

    @property
    def moving(self) -> bool:
        return self._last is not None

    def see(self, now: float, moving: bool, min_duration: float = 0.0) -> str:
        """`start` or `end` of an event, else empty. An event starts once motion has lasted `min_duration` seconds."""
        if moving:
            first, last = self._spell or (now, now)
            self._spell = now if now - last >= QUIET else first, now
            if now - self._spell[0] < min_duration and self._last is None:
                return ""
            began, self._last = self._last is None, now
            self.count += began
            return "start" if began else ""
        if self._last is not None and now - self._last >= QUIET:
            self._last = None
            return "end"
        return ""

    def rest(self) -> None:
        """The watch ended: later motion is another event."""
        self._last = self._spell = None


class Blindness:
    """Why a robot shows no picture, over its holds: the channel's fault, or its own. Without one for `timeout`, the
    channel may be jammed, its receiver dead, or the robot. So another channel is tried if there is one: a robot unseen
    on SUSPECTS in a row is dead; once it is seen, the earlier channel was bad, and is avoided for a while. A channel
    without even snow has no working receiver: the hold ends before `timeout`, and the robot is not to blame."""

    def __init__(self, timeout: float) -> None:
        self.timeout = timeout  # seconds without a picture, warm-up included
        self._dark_since: float | None = None
        self._bad: dict[str, float] = {}  # channels without this robot's picture, and the time
        self._in_row = 0
        self._reminded = 0.0
        self._channel = ""
        self._no_signal_since: float | None = None

    def begin(self, now: float) -> None:
        """A hold has begun: the transmitter is being switched on."""
        self._dark_since = now
        self._channel, self._no_signal_since = "", now

    def see(self, now: float, good: bool, channel: str, *, came: bool | None = None) -> bool:
        """Record a look; `came`: any picture, even a bad one. Return True without a good picture for too long."""
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
        """Return True to repeat the command to transmit: the radio goes one way."""
        since = self._dark_since
        if since is None or now - max(since, min(self._reminded, now)) < REMIND:
            return False
        self._reminded = now
        return True

    def end(self, now: float) -> bool:
        """The hold ended; return True if its channel showed nothing at all."""
        since, self._no_signal_since = self._no_signal_since, None
        if since is None or not self._channel or now - since < NO_SIGNAL_TIMEOUT:
            return False
        self._bad[self._channel] = now
        return True

    @property
    def dead(self) -> bool:
        """Return True to give the robot up; on a single channel two tries count."""
        return self._in_row >= SUSPECTS

    def choose(self, now: float, channels: Iterable[str]) -> str | None:
        """A channel to request by name because another is bad; None: any. If all are bad, the oldest."""
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
        self._limits: MotionLimits | None = None
        self._task: Task = "hide"  # of the present hold
        self._alerts = 0  # count before the present turn
        self._turns: deque[bool] = deque(maxlen=LATELY)  # for each recent turn to watch: True if it saw motion
        self.frozen = 0.0  # seconds for which the source has sent the same picture, if it counts as frozen: see `see`
        self._was_frozen = False  # at the last look
        self._held = self.no_signal = False  # no_signal: the last hold ended without even snow

    @property
    def task(self) -> Task:
        return "watch" if self.hider.state == "hidden" else "hide"

    @property
    def saw_somebody(self) -> bool:
        return any(self._turns)

    def held(self, now: float, *, goes_on: bool = False) -> None:
        """A hold begins, or with `goes_on` continues after a move. `now` in seconds, on the same clock in all calls."""
        if self._held:
            if goes_on:
                return
            # It was lost meanwhile, and others may have moved the robot.
            self.released(now)
        self._held = True
        self._task = self.task
        self._alerts = self.alerts.count
        if self._task == "hide":
            self._turns.clear()
            self._detector = MotionDetector(limits=self._limits)
        else:
            # The robot is probably where it was: keep its background.
            self._detector.pause()
        self.hider.resumed(now)
        self.blindness.begin(now)

    def released(self, now: float) -> None:
        """The hold ended for any reason: the wheels are stopped, and others may move the robot."""
        if self._held and self._task == "watch":
            self._turns.append(self.alerts.count > self._alerts)
        self._held = False
        self.no_signal = self.blindness.end(now)
        self.hider.interrupted(now)
        self.alerts.rest()

    def limit(self, limits: MotionLimits | None) -> None:
        if limits != self._limits:
            self._limits, self._detector = limits, MotionDetector(limits=limits)

    def see(self, now: float, picture: Picture | None, channel: str) -> Step:
        """Take the newest picture, or None, from the robot on this video channel; set `frozen` before."""
        defect = garbled(picture) if picture is not None else None
        good = picture is not None and defect is None
        blind = self.blindness.see(now, good, channel, came=picture is not None)
        act = self.hider.see(now, picture, defect)
        step = Step(act.left, act.right, act.lasts, act.doing, act.why, blind=blind, over=self.task != self._task)
        if self._task == "hide" or step.over or step.blind:
            return step
        if picture is None or not good:
            # Blind: later motion is another event.
            edge = self.alerts.see(now, False)
            return Step(0, 0, 0, "blind", "no good picture", quiet=edge == "end")
        began, self._was_frozen = bool(self.frozen) and not self._was_frozen, bool(self.frozen)
        if self.frozen:
            # Nothing moves in a frozen picture: people must know, and motion after it is another event.
            edge, words = self.alerts.see(now, False), f"frozen: the same picture for {self.frozen:.0f} s"
            return Step(0, 0, 0, "blind", words, alert=began, quiet=edge == "end")
        seen = self._detector.see(now, picture)
        least = self._limits.min_duration if self._limits is not None else 0.0
        edge, count = self.alerts.see(now, seen.moving, least), self.alerts.count
        if self.alerts.moving:
            return Step(0, 0, 0, "alert", f"motion {count}", tuple(seen.boxes), alert=edge == "start")
        if seen.present:
            return Step(0, 0, 0, "present", f"the mover is still there, motion {count}", quiet=edge == "end")
        words = f"{count} alerts so far"
        return Step(0, 0, 0, "watch", words, quiet=edge == "end", learning=seen.learning)

    def memory(self) -> dict[str, Any]:
        """All but the detector's background."""
        return {
            "hider": base64.b64encode(self.hider.checkpoint()).decode(),
            "alerts": {"count": self.alerts.count, "before": self._alerts, "turns": list(self._turns)},
            "blindness": self.blindness.memory(),
            "task": self._task,
            "held": self._held,
        }

    def recall(self, memory: dict[str, Any]) -> None:
        """Raises ValueError for an invalid memory."""
        self.hider = Hider.restore(base64.b64decode(memory["hider"]))
        alerts = memory["alerts"]
        self.alerts.count = int(alerts["count"])
        self._alerts = int(alerts.get("before", self.alerts.count))
        self._turns = deque(map(bool, alerts.get("turns", ())), maxlen=LATELY)
        self.blindness.recall(memory["blindness"])
        self._task = "watch" if memory["task"] == "watch" else "hide"
        self._held = bool(memory["held"])

"""The building's clock: so many of its seconds to one of ours, never a jump. Pure: our time is passed in."""

from __future__ import annotations

from collections import deque
from typing import Final

STEP: Final = 0.02
"""Seconds of the building from one step of its world to the next."""
MAX_BEHIND: Final = 0.25
"""Seconds of the building that are caught up; what is missing beyond them never comes."""
WINDOW: Final = 2.0
"""Seconds of ours over which the true speed is taken."""


class WorldClock:
    """When steps are due. `speed` of the building's seconds pass in one of ours.

    A process that gets too little of the machine, or was stopped for a while, finds the clock behind: some of
    that is caught up, the rest is lost (`slipped`), and the building is slower than was asked for."""

    def __init__(self, speed: float, now: float) -> None:
        """`now` in seconds on any steady clock."""
        self.speed = speed
        self.steps = 0
        """That were due so far."""
        self.slipped = 0.0
        """Seconds of the building that were not caught up."""
        self._zero = now
        self._recent: deque[tuple[float, int]] = deque([(now, 0)])

    @property
    def time(self) -> float:
        """Of the building, in seconds since it began, once all steps that were due are made."""
        return self.steps * STEP

    def due(self, now: float) -> int:
        """How many steps are to be made at `now`."""
        behind = (now - self._zero) * self.speed - self.time
        if behind > MAX_BEHIND:
            self.slipped += behind - MAX_BEHIND
            self._zero += (behind - MAX_BEHIND) / self.speed
            behind = MAX_BEHIND
        steps = max(0, int(behind / STEP + 1e-6))
        self.steps += steps
        if now - self._recent[-1][0] >= WINDOW / 8:
            self._recent.append((now, self.steps))
            while now - self._recent[0][0] > WINDOW:
                self._recent.popleft()
        return steps

    def until_next(self, now: float) -> float:
        """Seconds of ours from `now` until a step is due."""
        return max(0.0, self._zero + (self.time + STEP) / self.speed - now)

    def true_speed(self, now: float) -> float:
        """The building's seconds in one of ours, over the last WINDOW."""
        begin, steps = self._recent[0]
        return (self.steps - steps) * STEP / (now - begin) if now > begin else self.speed


class FramePace:
    """When each channel's next frame is due, in the building's time: evenly, one channel after the other."""

    def __init__(self, channels: int, rate: float) -> None:
        """`rate` in frames per second of the building."""
        self._period = 1 / rate
        self._due = [self._period * number / channels for number in range(channels)]
        self.late = 0
        """Frames that were left out, for there was no time."""

    def next(self, time: float, watched: list[int]) -> int | None:
        """Which of the `watched` channels (from 0) is to be drawn at `time`: the one that waits longest."""
        waiting = [number for number in watched if self._due[number] <= time + 1e-9]
        if not waiting:
            return None
        number = min(waiting, key=self._due.__getitem__)
        left_out = int((time - self._due[number]) / self._period)
        self._due[number] += (left_out + 1) * self._period
        self.late += left_out
        return number

    def skip(self, time: float, unwatched: list[int]) -> None:
        """Nobody looks at these: their frames are not late."""
        for number in unwatched:
            missed = time - self._due[number]
            if missed > 0:
                self._due[number] += (int(missed / self._period) + 1) * self._period

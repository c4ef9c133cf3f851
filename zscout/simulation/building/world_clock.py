"""The building's clock: proportional to real time, without jumps. Pure: real time is passed in."""

from __future__ import annotations

from collections import deque
from typing import Final

STEP: Final = 0.02  # s of the building per step of its world
MAX_BEHIND: Final = 0.25  # s of the building that are caught up at most
WINDOW: Final = 2.0  # s of real time over which the true speed is measured


class WorldClock:
    """The times of steps, at `speed` seconds of the building per real second, `now` on any steady clock. If the process
    runs too little, MAX_BEHIND is caught up; the rest is lost and added to `slipped`."""

    def __init__(self, speed: float, now: float) -> None:
        self.speed = speed
        self.steps = 0
        self.slipped = 0.0  # s of the building
        self._zero = now
        self._recent: deque[tuple[float, int]] = deque([(now, 0)])

    @property
    def time(self) -> float:
        """Seconds of the building after all due steps."""
        return self.steps * STEP

    def due(self, now: float) -> int:
        """Number of steps due at `now` since the last call."""
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
        """Seconds of real time from `now` until a step is due."""
        return max(0.0, self._zero + (self.time + STEP) / self.speed - now)

    def true_speed(self, now: float) -> float:
        """Seconds of the building per second of real time, over the last WINDOW."""
        begin, steps = self._recent[0]
        return (self.steps - steps) * STEP / (now - begin) if now > begin else self.speed


class FramePace:
    """Times of each channel's frames in the building's time, at `rate` frames per second, channels in turn."""

    def __init__(self, channels: int, rate: float) -> None:
        self._period = 1 / rate
        self._due = [self._period * number / channels for number in range(channels)]
        self.late = 0  # frames left out for lack of time

    def next(self, time: float, watched: list[int]) -> int | None:
        """The `watched` channel (from 0) that has been due longest at `time`, or None."""
        waiting = [number for number in watched if self._due[number] <= time + 1e-9]
        if not waiting:
            return None
        number = min(waiting, key=self._due.__getitem__)
        left_out = int((time - self._due[number]) / self._period)
        self._due[number] += (left_out + 1) * self._period
        self.late += left_out
        return number

    def skip(self, time: float, unwatched: list[int]) -> None:
        """Skip due frames of channels without watchers; they do not count as late."""
        for number in unwatched:
            if (missed := time - self._due[number]) > 0:
                self._due[number] += (int(missed / self._period) + 1) * self._period

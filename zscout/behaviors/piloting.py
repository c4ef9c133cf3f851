"""From keys and sticks to wheels: what an operator's hands ask of a robot. Pure; time is passed in.

A terminal tells no releases: a key that is held down comes again and again, first after a delay of a quarter
to half a second, then some 30 times a second. So a press drives for FIRST seconds, which bridges the delay, a
repetition for NEXT, and a released key stops the robot by itself soon after. A stick tells where it stands;
it counts until it says otherwise, and a pad that falls silent is taken to be let go after SILENT.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal, TypeAlias

FIRST: Final = 0.6
"""Seconds that one press of a key drives."""
NEXT: Final = 0.25
"""Seconds that each repetition does."""
REPEATS: Final = 0.55
"""Seconds within which the same key again is a repetition."""
SILENT: Final = 1.0
"""Seconds that a stick counts without a word."""
TURN: Final = 0.5
"""Share of the speed at which the robot turns on the spot: a full turn would be too quick to aim."""
DEAD_ZONE: Final = 0.08
"""Of a stick: it never rests at exactly 0."""
SLOWEST: Final = 0.1
NOTCH: Final = 0.1
"""What one press of + or - changes."""

Way: TypeAlias = Literal["forward", "back", "left", "right"]
WHEELS: Final[dict[Way, tuple[float, float]]] = {
    "forward": (1.0, 1.0),
    "back": (-1.0, -1.0),
    "left": (-TURN, TURN),
    "right": (TURN, -TURN),
}


@dataclass(frozen=True, slots=True)
class Wheels:
    """What the robot is to do: -1 to 1 of top speed, for `lasts` seconds at most."""

    left: float
    right: float
    lasts: float

    @property
    def still(self) -> bool:
        return self.left == 0 and self.right == 0


STOP: Final = Wheels(0.0, 0.0, 0.0)


class Pilot:
    """What the operator wants at any moment."""

    def __init__(self, speed: float = 0.6) -> None:
        """`speed` is the share of top speed, above 0 and at most 1; raises ValueError for others."""
        if not 0 < speed <= 1:
            raise ValueError(f"speed {speed:g} is not above 0 and at most 1")
        self.speed = speed
        self._ways: dict[Way, tuple[float, float]] = {}
        """By way that is being driven: when its key came last, and until when that drives."""
        self._stick: tuple[float, float, float] | None = None
        """When it spoke last, forward, to the right."""

    def press(self, now: float, way: Way) -> None:
        """A key that drives, pressed or repeated."""
        last = self._ways.get(way)
        repeated = last is not None and now - last[0] <= REPEATS
        until = now + (NEXT if repeated else FIRST)
        # A repetition never cuts short what the press gave.
        self._ways[way] = (now, max(until, last[1]) if last is not None else until)
        opposite: dict[Way, Way] = {"forward": "back", "back": "forward", "left": "right", "right": "left"}
        self._ways.pop(opposite[way], None)

    def stick(self, now: float, forward: float, right: float) -> None:
        """A pad's stick, -1 to 1 each; what is not a number counts as let go."""
        values = [value if abs(value) >= DEAD_ZONE else 0.0 for value in (forward, right)]
        self._stick = (now, *(max(-1.0, min(1.0, value)) for value in values))  # type: ignore[assignment]

    def stop(self) -> None:
        """At once, whatever was asked before."""
        self._ways.clear()
        self._stick = None

    def faster(self, notches: int) -> None:
        """By so many notches; negative is slower."""
        self.speed = round(max(SLOWEST, min(1.0, self.speed + notches * NOTCH)), 2)

    def wheels(self, now: float) -> Wheels:
        """What is wanted now; ask often."""
        self._ways = {way: times for way, times in self._ways.items() if now < times[1]}
        if self._ways:
            left = sum(WHEELS[way][0] for way in self._ways)
            right = sum(WHEELS[way][1] for way in self._ways)
            # Two keys at once drive a curve; neither wheel above what was asked for.
            most = max(1.0, abs(left), abs(right))
            lasts = max(until for _, until in self._ways.values()) - now
            return Wheels(self.speed * left / most, self.speed * right / most, lasts)
        if self._stick is not None:
            at, forward, across = self._stick
            if now - at < SILENT and (forward or across):
                left, right = forward + TURN * across, forward - TURN * across
                most = max(1.0, abs(left), abs(right))
                return Wheels(self.speed * left / most, self.speed * right / most, SILENT - (now - at))
        return STOP

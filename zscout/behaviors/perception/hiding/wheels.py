"""A Scout's body as far as hiding depends on it, and what its wheels are commanded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class BodyModel:
    """Two wheels and no other sense than the camera. Metres, metres per second."""

    wheel_base: float = 0.11
    radius: float = 0.06
    top_speed: float = 0.30
    """Of each wheel."""

    @property
    def top_spin(self) -> float:
        """Radians per second with the wheels at full speed against each other."""
        return 2 * self.top_speed / self.wheel_base


SCOUT: Final = BodyModel()


@dataclass(frozen=True, slots=True)
class WheelCommand:
    """What the wheels are to do now, and why."""

    left: float
    right: float
    """Shares of top speed, -1 to 1."""
    lasts: float
    """Seconds that the wheels may turn without a newer command; 0 with wheels that stand."""
    doing: str
    """One word, the hider's state: search, approach, unstick, enter, turn or hidden."""
    why: str
    """A few words for an operator."""
    hidden: bool = False

    @property
    def moves(self) -> bool:
        return self.left != 0 or self.right != 0

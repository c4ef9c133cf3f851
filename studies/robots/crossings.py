"""The fates of crossings in a sensor net: for each person who walks through a placed robot's field of view, whether the
robot alerted in time, and if not, why. Judged by the building's ground truth, which no robot knows."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Final, Literal, TypeAlias, get_args

from studies.robots.watch import CLEAR, IN_TIME, PIXELS
from zscout.simulation.building.air import SOLID
from zscout.simulation.building.bodies import Pose
from zscout.simulation.building.world import World

Fate: TypeAlias = Literal[
    "in time", "off the air", "warming up", "not hidden", "no picture", "learning", "told late", "not told"
]
"""The fate of a crossing. If it is not *in time*, this is the first obstacle as the crossing began: the transmitter was
off; the camera was warming up; the robot was not at its hidden place, or still checked whether it was; its picture was
bad; it was learning its background. Without an obstacle the alert was late or missing."""
FATES: Final[tuple[Fate, ...]] = get_args(Fate)
_AWAY: Final = frozenset[Fate | None]({"off the air", "warming up"})
LOOK: Final = 0.25
"""Seconds between two checks for people in view."""
MOVED, TURNED = 0.1, 0.2
"""Metres and radians by which a robot at its place may deviate from it."""


@dataclass(slots=True)
class CrossingsOf:
    """Crossings of one robot's place."""

    fates: Counter[Fate] = field(default_factory=Counter)
    could: int = 0
    """Crossings that could be in time: the camera was warm, and on the air until the time limit."""
    told: int = 0
    """Crossings in time among crossings that could be."""

    @property
    def all(self) -> int:
        return self.fates.total()

    @property
    def in_time(self) -> float:
        """Share of crossings in time; NaN without crossings."""
        return self.fates["in time"] / self.all if self.all else math.nan

    def add(self, other: CrossingsOf) -> None:
        self.fates += other.fates
        self.could += other.could
        self.told += other.told


@dataclass(slots=True)
class _Place:
    """Where a robot last reported to be hidden, and the present crossing of its view from there."""

    pose: Pose
    obstacle: Fate | None = None
    """The obstacle as the present crossing began."""
    since: float | None = None
    """When the present crossing began; None: no person is in view."""
    last_person: float = -math.inf
    told_at: float | None = None


class Crossings:
    """The crossings of a run. `found` is by robot; a robot that was never hidden has no place."""

    def __init__(self, world: World, robots: list[str]) -> None:
        self.found = {robot: CrossingsOf() for robot in robots}
        self._world = world
        self._places: dict[str, _Place] = {}
        self._doing: dict[str, Fate | None] = {}
        """By held robot: what kept it from reporting a crossing at its last look. Robots without a look are not held,
        though their transmitters may be on for a moment longer."""
        self._looked = 0.0

    def hidden(self, robot: str) -> None:
        """The robot reports that it is hidden, and does not move."""
        place, pose = self._places.get(robot), self._world.bodies[robot].pose
        if place is None:
            self._places[robot] = _Place(pose)
        elif not same_place(place.pose, pose):
            self._close(robot, place)
            self._places[robot] = _Place(pose)

    def looked(self, robot: str, *, watches: bool, picture: bool, learning: bool, alert: bool) -> None:
        """A held robot's look: it `watches`, had a good `picture`, is `learning` its background, gives an `alert`."""
        if not watches:
            self._doing[robot] = "not hidden"
        elif not picture:
            self._doing[robot] = "no picture"
        else:
            self._doing[robot] = "learning" if learning else None
        place = self._places.get(robot)
        if alert and place is not None and place.since is not None and place.told_at is None:
            place.told_at = self._world.time

    def stepped(self) -> None:
        """The building advanced by a step."""
        now = self._world.time
        if now - self._looked < LOOK:
            return
        self._looked = now
        for robot, place in self._places.items():
            people = self._world.people_in_view(robot, place.pose)
            if people:
                place.last_person = now
            if people >= PIXELS and place.since is None:
                place.since, place.obstacle, place.told_at = now, self._obstacle(robot, place), None
            elif place.since is not None and now - place.last_person > CLEAR:
                self._close(robot, place)

    def _obstacle(self, robot: str, place: _Place) -> Fate | None:
        body = self._world.bodies[robot]
        if body.camera is None or robot not in self._doing:
            return "off the air"
        if body.warmth(self._world.time) < SOLID:
            return "warming up"
        if not same_place(place.pose, body.pose):
            return "not hidden"
        return self._doing[robot]

    def _close(self, robot: str, place: _Place) -> None:
        """Count the present crossing, if any: it is over."""
        if place.since is None:
            return
        # On average the person was in view for half of LOOK before `since`.
        in_time = place.told_at is not None and place.told_at - place.since <= IN_TIME - LOOK / 2
        if in_time:
            fate: Fate = "in time"
        else:
            fate = place.obstacle or ("not told" if place.told_at is None else "told late")
        could = place.obstacle not in _AWAY
        self.found[robot].fates[fate] += 1
        self.found[robot].could += could
        self.found[robot].told += could and in_time
        place.since = None

    def ended(self, robot: str) -> None:
        """The robot's hold has ended."""
        self._doing.pop(robot, None)
        place = self._places.get(robot)
        if place is None or place.since is None or place.told_at is not None:
            return
        if place.obstacle not in _AWAY and self._world.time - place.since < IN_TIME:
            place.obstacle = "off the air"


def same_place(here: Pose, other: Pose) -> bool:
    """Return True if a robot at `here` has not left the place `other`."""
    apart = math.hypot(here.x - other.x, here.y - other.y)
    return apart <= MOVED and abs(math.remainder(here.heading - other.heading, math.tau)) <= TURNED

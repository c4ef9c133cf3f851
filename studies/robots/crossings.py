"""Where the crossings of a sensor net go: of each person who walks through what a placed robot would see, whether it
was told in time, and if not, why. Judged by the building's own truth, which no robot knows."""

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
"""Of one crossing. What is not *in time* has the first that was in its way as it began: the robot's transmitter was
off; its camera was warming up; it was not where it had hidden, or was still looking whether it is; its picture was bad;
its background was being learned; nothing was, and it was told late or not at all."""
FATES: Final[tuple[Fate, ...]] = get_args(Fate)
_AWAY: Final = frozenset[Fate | None]({"off the air", "warming up"})
LOOK: Final = 0.25
"""Seconds between two looks at who is in view."""
MOVED, TURNED = 0.1, 0.2
"""Metres and radians by which a robot may be off its place and still be there."""


@dataclass(slots=True)
class CrossingsOf:
    """Those of one robot's place."""

    fates: Counter[Fate] = field(default_factory=Counter)
    could: int = 0
    """Of these: began while its camera was warm, and it was on the air for as long as there was to tell it in."""
    told: int = 0
    """Of those that could: in time."""

    @property
    def all(self) -> int:
        return self.fates.total()

    @property
    def in_time(self) -> float:
        """Share of all; NaN of none."""
        return self.fates["in time"] / self.all if self.all else math.nan

    def add(self, other: CrossingsOf) -> None:
        """Makes it the sum of both."""
        self.fates += other.fates
        self.could += other.could
        self.told += other.told


@dataclass(slots=True)
class _Place:
    """Where a robot last was hidden by its own word, and who crosses what it sees from there."""

    pose: Pose
    obstacle: Fate | None = None
    """What was in the way as the present crossing began."""
    since: float | None = None
    """When that was; None: nobody is in view."""
    last_person: float = -math.inf
    told_at: float | None = None


class Crossings:
    """Follows one run. `found` is by robot; one that was never hidden has no place."""

    def __init__(self, world: World, robots: list[str]) -> None:
        self.found = {robot: CrossingsOf() for robot in robots}
        self._world = world
        self._places: dict[str, _Place] = {}
        self._doing: dict[str, Fate | None] = {}
        """What keeps each robot that is held from telling of a crossing, as it looked last. One that has not looked is
        not held, though its transmitter may take a moment to hear of that."""
        self._looked = 0.0

    def hidden(self, robot: str) -> None:
        """It is hidden by its own word, and stands still."""
        place, pose = self._places.get(robot), self._world.bodies[robot].pose
        if place is None:
            self._places[robot] = _Place(pose)
        elif not same_place(place.pose, pose):
            self._close(robot, place)
            self._places[robot] = _Place(pose)

    def looked(self, robot: str, *, watches: bool, picture: bool, learning: bool, alert: bool) -> None:
        """It has looked, under its hold: whether it watches, had a good picture, learns its background, tells of
        motion."""
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
        """The building went on."""
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
        """The crossing is over, if there is one."""
        if place.since is None:
            return
        # He was in view for half of a look, as a mean, before that was seen here.
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
        """Its hold is over."""
        self._doing.pop(robot, None)
        place = self._places.get(robot)
        if place is None or place.since is None or place.told_at is not None:
            return
        if place.obstacle not in _AWAY and self._world.time - place.since < IN_TIME:
            place.obstacle = "off the air"


def same_place(one: Pose, other: Pose) -> bool:
    """Whether a robot that stands here has not left that place."""
    apart = math.hypot(one.x - other.x, one.y - other.y)
    return apart <= MOVED and abs(math.remainder(one.heading - other.heading, math.tau)) <= TURNED

"""Outcomes of a sensor net in a building, judged by the building's ground truth, which no robot knows."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from studies.robots.crossings import Crossings, CrossingsOf, same_place
from studies.robots.watch import CLEAR, IN_TIME, PIXELS
from zscout.behaviors.sensor_net.net import WATCHING
from zscout.behaviors.sensor_net.scout import Step
from zscout.simulation.building.bodies import WARM_UP, Body, Pose
from zscout.simulation.building.casting import EYE, VIEW
from zscout.simulation.building.light import hidden
from zscout.simulation.building.solids import cuboids_of
from zscout.simulation.building.world import World

SETTLED: Final = 120.0
"""Seconds within which all should be placed: later walks count in any case."""
WARMED: Final = 2.0
"""Crossings count after this many seconds of watching, when the background has been learned."""
STANDS: Final = 0.01
"""Metres a second below which a wheel counts as stopped, because motors run out slowly."""
RUN_OUT: Final = 6.0
"""Seconds for which wheels are observed after the end of a hold: no drive packet lasts longer."""
_REACH: Final = 6.0
"""Metres at which a robot still covers a pixel or two."""


@dataclass(slots=True)
class Outcomes:
    """Outcomes of a run. Times in seconds of virtual time."""

    placed: dict[str, float | None] = field(default_factory=dict)
    """When each robot first reported to be hidden; None: never."""
    dark: dict[str, bool] = field(default_factory=dict)
    """By robot: True if it then stood in a truly dark place."""
    facing: dict[str, bool] = field(default_factory=dict)
    """By robot: True if its camera then faced the lit part."""
    walks: int = 0
    """Walks of people through the building that began when all had been placed, or should have been."""
    noticed: int = 0
    """Walks during which a robot reported motion."""
    crossings: int = 0
    """Crossings of a watching robot's picture by people."""
    alerted: int = 0
    """Crossings alerted within IN_TIME."""
    resumed: list[float] = field(default_factory=list)
    """For each turn of a robot that had not moved since it hid: seconds from when it was held and its camera warm until
    it could report motion."""
    account: dict[str, CrossingsOf] = field(default_factory=dict)
    """All crossings of each robot's place, whether it was held or not."""
    false_alarms: int = 0
    """Alerts without any motion in view."""
    robot_alarms: int = 0
    """Alerts without a person in view, but with another robot that drove."""
    shadow_alarms: int = 0
    """Alerts without a person in view, but with the shadow of a person beside or behind the robot."""
    watched: float = 0.0
    """Seconds of watching, all robots together."""
    watches: dict[str, float] = field(default_factory=dict)
    """Seconds of watching after all had been placed, by robot."""
    holds: int = 0
    preemptions: int = 0
    blind: int = 0
    """Holds released because no picture came."""
    turned_unheld: float = 0.0
    """Seconds that wheels turned without a hold, all robots together."""
    longest_stop: float = 0.0
    """The longest time from the end of a hold until the wheels stopped."""
    seconds: float = 0.0

    @property
    def all_placed(self) -> float:
        """When the last robot was placed; infinite if one never was."""
        return max((math.inf if at is None else at for at in self.placed.values()), default=math.inf)


class Judge:
    """Observes a run, and fills in its `Outcomes`."""

    def __init__(self, world: World, outcomes: Outcomes) -> None:
        self.outcomes = outcomes
        self._world = world
        self._watchers = {name: Watcher() for name in outcomes.placed}
        self._moved_at = dict.fromkeys(world.bodies, -math.inf)
        self._resuming: dict[str, tuple[float, Pose]] = {}
        """Held robots that were placed before and can't report motion yet: the start of the hold, and the pose then."""
        self._unheld_since: dict[str, float] = {}
        """End of the hold, for robots whose hold ended less than RUN_OUT ago."""
        self._turned: set[str] = set()
        """Robots of `_unheld_since` whose wheels turned at the last check."""
        self._walks: dict[int, bool | None] = {}
        """By number of a walker in the building: True if the walk was noticed; None if it doesn't count."""
        self._boxes = cuboids_of(world.plan)
        self._crossings = Crossings(world, list(outcomes.placed))
        outcomes.account = self._crossings.found

    def placed(self, robot: str) -> None:
        """The robot reports that it is hidden; the outcomes record the first time."""
        if self.outcomes.placed[robot] is None:
            self.outcomes.placed[robot] = self._world.time
            self.outcomes.dark[robot] = self._world.is_dark(robot)
            self.outcomes.facing[robot] = self._world.faces_light(robot)
        self._crossings.hidden(robot)

    def held(self, robot: str) -> None:
        self.outcomes.holds += 1
        if self.outcomes.placed[robot] is not None:
            self._resuming[robot] = self._world.time, self._world.bodies[robot].pose
        self._unheld_since.pop(robot, None)
        self._turned.discard(robot)
        self._watchers[robot] = Watcher()

    def ended(self, robot: str, *, preempted: bool) -> None:
        self.outcomes.preemptions += preempted
        self._unheld_since[robot] = self._world.time
        self._resuming.pop(robot, None)
        self._crossings.ended(robot)
        if _turns(self._world.bodies[robot]):
            self._turned.add(robot)

    def looked(self, robot: str, step: Step, interval: float) -> None:
        """Compare a look of a watching robot, one every `interval` seconds, with the true scene in its view."""
        watches = step.doing in WATCHING or step.doing == "blind"
        self._crossings.looked(
            robot, watches=watches, picture=step.doing != "blind", learning=step.learning, alert=step.doing == "alert"
        )
        if step.doing in WATCHING:
            if not step.learning and (resuming := self._resuming.pop(robot, None)) is not None:
                (since, pose), body = resuming, self._world.bodies[robot]
                if same_place(pose, body.pose):
                    self.outcomes.resumed.append(self._world.time - max(since, body.camera_on_since + WARM_UP))
            self.outcomes.watched += interval
            if math.isfinite(self.outcomes.all_placed):
                self.outcomes.watches[robot] = self.outcomes.watches.get(robot, 0.0) + interval
            people = self._world.people_in_view(robot)
            shadow = self._world.shadow_in_view(robot)
            self._watchers[robot].look(
                self._world.time, people, shadow, step, lambda: self._robot_in_view(robot), self.outcomes
            )

    def stepped(self, dt: float, *, alarm: bool) -> None:
        """The building advanced by `dt` seconds. `alarm`: some robot reports motion."""
        now, out = self._world.time, self.outcomes
        for name, body in self._world.bodies.items():
            turns = _turns(body)
            if turns:
                self._moved_at[name] = now
            since = self._unheld_since.get(name)
            if since is None:
                continue
            if turns:
                out.turned_unheld += dt
                self._turned.add(name)
            if name in self._turned:
                # Up to the step in which they stopped: rounded up.
                out.longest_stop = max(out.longest_stop, now - since)
            if not turns:
                self._turned.discard(name)
                if now - since > RUN_OUT:
                    del self._unheld_since[name]
        self._follow_walks(alarm)
        self._crossings.stepped()

    def _follow_walks(self, alarm: bool) -> None:
        out, now = self.outcomes, self._world.time
        for number, walker in enumerate(self._world.walkers):
            if walker.here:
                ready = now >= SETTLED or now >= out.all_placed
                noticed = self._walks.setdefault(number, False if ready else None)
                self._walks[number] = noticed if noticed is None else noticed or alarm
            elif (noticed := self._walks.pop(number, None)) is not None:
                # Counted when it is over, to leave out walks that the run's end cuts short.
                out.walks += 1
                out.noticed += noticed

    def _robot_in_view(self, robot: str) -> bool:
        """Return True if another robot that drove a moment ago is, or just was, in view of this robot's camera."""
        body, now = self._world.bodies[robot], self._world.time
        for other in self._world.bodies.values():
            away = math.hypot(other.x - body.x, other.y - body.y)
            if other is body or now - self._moved_at[other.name] > CLEAR or away > _REACH:
                continue
            off = math.atan2(other.y - body.y, other.x - body.x) - body.heading
            # With a margin for its width, and for a robot that has just left the picture.
            if abs(math.remainder(off, math.tau)) > VIEW / 2 + math.atan2(0.3, away):
                continue
            origin = np.array([[body.x, body.y, EYE]], np.float32)
            way = np.array([[other.x - body.x, other.y - body.y, 0.0]], np.float32)
            if not hidden(origin, way, np.ones(1, np.float32), self._boxes)[0]:
                return True
        return False


class Watcher:
    """A robot that watches during one hold."""

    def __init__(self) -> None:
        self.began: float | None = None
        self.since: float | None = None
        """When the person in view appeared."""
        self.open = False
        """True during a crossing whose outcome is not known yet."""
        self.last_person = self.last_shadow = -math.inf

    def look(
        self, now: float, people: int, shadow: bool, step: Step, bustle: Callable[[], bool], out: Outcomes
    ) -> None:
        if self.began is None:
            self.began = now
        if people:
            self.last_person = now
        if shadow:
            self.last_shadow = now
        if people >= PIXELS and self.since is None:
            self.since, self.open = now, now - self.began >= WARMED
        late = self.since is not None and now - self.since > IN_TIME + 1e-6
        # A crossing cut short by the hold's end before either does not count.
        if self.open and (late or step.doing == "alert"):
            self.open = False
            out.crossings += 1
            out.alerted += not late
        if now - self.last_person > CLEAR:
            self.since = None
            if step.alert:
                if now - self.last_shadow <= CLEAR:
                    out.shadow_alarms += 1
                elif bustle():
                    out.robot_alarms += 1
                else:
                    out.false_alarms += 1


def _turns(body: Body) -> bool:
    """Return True if a wheel turns, or is commanded to turn."""
    commanded = body.left != 0 or body.right != 0
    return commanded or max(abs(body.speed_left), abs(body.speed_right)) > STANDS

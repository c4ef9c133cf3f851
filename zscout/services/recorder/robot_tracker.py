"""What is published of robots, put together for the timeline: who looks through which camera, what each
behavior does, who is where. Pure but for the timeline, whose times are passed in."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final, NamedTuple

from zscout.keyexpr import Sender
from zscout.messages import (
    BehaviorSaid,
    Box,
    BuildingPlan,
    BuildingPoses,
    FrameHead,
    Holder,
    HoldView,
    Placed,
    RcState,
)
from zscout.services.recorder.colours import DOING, OPERATOR, PALE
from zscout.services.recorder.drawing import clean_text
from zscout.services.recorder.floor_plan import PersonMark, RobotMark
from zscout.services.recorder.rate_limit import RateLimiter
from zscout.services.recorder.timeline import Timeline
from zscout.types import Grant

log = logging.getLogger(__name__)

MAX_FOLLOWED: Final = 2_000
"""Behaviors, and RCs, that are followed at one time."""
MAX_BOXES: Final = 32
"""Over one picture, whoever drew them."""
POSE_SPACING: Final = 0.09
"""Seconds between two records of where all are."""
SILENCE: Final = 10.0
"""Seconds without a message from a building after which nobody knows who is where, and another may be
shown."""
PLAN_AGAIN: Final = 5.0
"""Seconds until a plan that did not come is asked for again."""
HEALTH_SPACING: Final = 1.0
"""Seconds between two events about the health of one RC."""
MAX_NAMED: Final = 24
"""Characters of a name on floor and pictures."""

Place = tuple[Sender, str]
"""A behavior: its client, and its path."""


class RobotHold(NamedTuple):
    """What matters here of a hold: the robots of its gang, and whether it is an operator's."""

    robots: tuple[str, ...] = ()
    operator: bool = False


@dataclass(slots=True)
class _Building:
    sender: Sender
    seen_at: float
    time: float = 0.0
    """Its own."""
    asked: float = -PLAN_AGAIN
    name: str = ""
    planned: bool = False
    refused: bool = False


@dataclass(slots=True)
class _Health:
    words: str = "ok"
    """As it is."""
    shown: str = "ok"
    """As it was shown last."""
    at: float = -HEALTH_SPACING


@dataclass(slots=True)
class _Camera:
    robots: tuple[str, ...] = ()
    operator: bool = False
    boxes: dict[Place, list[Box]] = field(default_factory=dict)


class RobotTracker:
    """Writes to `timeline` what is published of robots."""

    def __init__(self, timeline: Timeline) -> None:
        self.timeline, self.panes = timeline, timeline.robots
        self._limiter = RateLimiter()
        self._reports: dict[Place, BehaviorSaid] = {}
        """What each behavior does, the one that reported longest ago first."""
        self._holds: dict[str, Mapping[Grant, RobotHold]] = {}
        """Of robots and framegrabbers."""
        self._cameras: dict[str, _Camera] = {}
        self._health: dict[str, _Health] = {}
        self._building: _Building | None = None
        self._others: set[Sender] = set()

    def held(self, rc: str, holds: Mapping[Grant, RobotHold]) -> None:
        """The holds of an RC, all of them."""
        if rc.partition("/")[0] not in ("robot", "framegrabber"):
            return
        if holds and (rc in self._holds or len(self._holds) < MAX_FOLLOWED):
            self._holds[rc] = holds
        else:
            self._holds.pop(rc, None)

    def dropped(self, rc: str, grants: Iterable[Grant]) -> None:
        """These holds of an RC are over."""
        over = set(grants)
        left = {grant: hold for grant, hold in self._holds.get(rc, {}).items() if grant not in over}
        self.held(rc, left)

    # Behaviors

    def behavior(self, at: float, sender: Sender, report: BehaviorSaid) -> None:
        """What a behavior reports, as it comes."""
        kept = self._limiter.offer(at, sender, report)
        if kept is not None:
            self._take(at, sender, kept)

    def tick(self, at: float) -> None:
        """What time alone brings: call it some times a second."""
        for sender, report in list(self._limiter.due(at)):
            self._take(at, sender, report)
        for sender, count in list(self._limiter.dropped(at)):
            self.timeline.event(
                at, f"behaviors of {sender} say too much: {count} sayings were left out", "WARN"
            )
        for rc, health in self._health.items():
            self._show_health(at, rc, health)
        building = self._building
        if building is not None and building.planned and at - building.seen_at > SILENCE:
            building.planned = False
            self.panes.floor.clear(at)
            self.timeline.event(
                at, f"building {building.name} is silent: who is where is not known any more", "WARN"
            )

    def left(self, at: float, sender: Sender) -> None:
        """A client is gone, and its behaviors with it."""
        for place, report in list(self._reports.items()):
            if place[0] == sender:
                self._take(at, sender, BehaviorSaid(report.path, ""))
        self._limiter.forget(sender)

    def _take(self, at: float, sender: Sender, report: BehaviorSaid) -> None:
        place = sender, report.path
        before = self._reports.pop(place, None)
        if report.doing and len(self._reports) < MAX_FOLLOWED:
            self._reports[place] = report
        # A behavior that has moved to another client is over in the old one only.
        elsewhere = not report.doing and any(path == report.path for _, path in self._reports)
        if not elsewhere:
            self.panes.behavior(at, report.path, "alert" if report.alert else report.doing, _detail(report))
        if report.alert:
            self.timeline.event(at, _alert(report), "WARN")
        for camera in {report.camera, before.camera if before is not None else ""} - {""}:
            self._mark(at, camera, place, report.boxes if camera == report.camera and report.doing else [])

    def _doing(self, robot: str) -> BehaviorSaid | None:
        """The newest report about a robot."""
        about = (
            report for report in reversed(self._reports.values()) if report.robot in (robot, f"robot/{robot}")
        )
        return next(about, None)

    # Cameras

    def frame(self, at: float, camera: str, head: FrameHead, jpeg: bytes) -> None:
        """A picture of the framegrabber `camera`."""
        seen = self._cameras.get(camera)
        if seen is None:
            if len(self._cameras) >= MAX_FOLLOWED:
                return
            seen = self._cameras[camera] = _Camera()
        hold = (
            self._holds.get(camera, {}).get(head.grant, RobotHold())
            if head.grant is not None
            else RobotHold()
        )
        if hold.robots != seen.robots and seen.boxes:
            seen.boxes.clear()
            self.panes.boxes(at, _short(camera), [])
        seen.robots, seen.operator = hold
        words, colour = self._caption(seen)
        self.panes.picture(at, _short(camera), jpeg, words, colour)

    def no_frame(self, at: float, camera: str) -> None:
        """No picture has come for a while."""
        seen = self._cameras.get(camera)
        if seen is None:
            return
        if seen.boxes:
            seen.boxes.clear()
            self.panes.boxes(at, _short(camera), [])
        held = bool(self._holds.get(camera))
        names = ", ".join(_name(robot) for robot in seen.robots)
        words = " · ".join(word for word in (names, "no picture") if word) if held else "not held"
        self.panes.old_picture(at, _short(camera), words, PALE)

    def _caption(self, seen: _Camera) -> tuple[str, int]:
        names = ", ".join(_name(robot) for robot in seen.robots)
        if seen.operator:
            return (f"{names} · operator" if names else "operator"), OPERATOR
        report = self._doing(seen.robots[0].partition("/")[2]) if len(seen.robots) == 1 else None
        if report is None:
            return names, PALE
        return f"{names} · {report.doing}", DOING.get(report.doing, PALE)

    def _mark(self, at: float, camera: str, place: Place, boxes: list[Box]) -> None:
        seen = self._cameras.get(camera)
        if seen is None:
            return
        if boxes:
            seen.boxes[place] = boxes
        else:
            seen.boxes.pop(place, None)
        drawn = [box for some in seen.boxes.values() for box in some]
        self.panes.boxes(at, _short(camera), drawn[:MAX_BOXES])

    # Devices

    def state(self, at: float, state: RcState) -> None:
        """What an RC publishes of itself: its device's figures, and its health."""
        if state.figures:
            self.panes.figures(at, state.rc, state.figures)
        health = self._health.get(state.rc)
        if health is None:
            if state.health == "ok" or len(self._health) >= MAX_FOLLOWED:
                return
            health = self._health[state.rc] = _Health()
        health.words = state.health
        self._show_health(at, state.rc, health)

    def _show_health(self, at: float, rc: str, health: _Health) -> None:
        if health.words == health.shown or at - health.at < HEALTH_SPACING:
            return
        health.shown, health.at = health.words, at
        if health.words == "ok":
            self.timeline.event(at, f"{rc} is well again")
        else:
            self.timeline.event(at, f"{rc} fails: {health.words}", "WARN")

    # The building

    def poses(self, at: float, sender: Sender, poses: BuildingPoses) -> None:
        """Who is where in a building."""
        building = self._building
        if building is not None and building.sender != sender and at - building.seen_at <= SILENCE:
            if sender not in self._others and len(self._others) < MAX_FOLLOWED:
                self._others.add(sender)
                self.timeline.event(
                    at, f"a second building, of {sender}, is not shown: that of {building.sender} is", "WARN"
                )
            return
        if building is None or building.sender != sender or poses.time < building.time - 1:
            # Its time goes back: it is another building that the same client simulates now.
            self._building = building = _Building(sender, at)
            self._others.discard(sender)
        elif building.planned and at - building.seen_at < POSE_SPACING:
            return
        building.seen_at, building.time = at, poses.time
        if building.planned:
            robots = [self._robot(placed) for placed in poses.robots]
            people = [PersonMark(clean_text(one.name, MAX_NAMED), one.x, one.y) for one in poses.people]
            self.panes.floor.show(at, robots, people, _caption_of(building.name, poses))

    def wants_plan(self, at: float) -> Sender | None:
        """Whom to ask for a building's plan now, if anybody."""
        building = self._building
        if building is None or building.planned or building.refused or at - building.seen_at > SILENCE:
            return None
        if at - building.asked < PLAN_AGAIN:
            return None
        building.asked = at
        return building.sender

    def plan(self, at: float, sender: Sender, plan: BuildingPlan) -> None:
        """A building's plan."""
        building = self._building
        if building is None or building.sender != sender or building.planned:
            return
        building.name = clean_text(plan.name, MAX_NAMED)
        why = self.panes.plan(at, plan.width, plan.depth, plan.picture)
        building.planned, building.refused = not why, bool(why)
        if why:
            self.timeline.event(at, f"building {building.name} of {sender} can't be shown: {why}", "WARN")

    def _robot(self, placed: Placed) -> RobotMark:
        report = self._doing(placed.name)
        operator = any(hold.operator for hold in self._holds.get(f"robot/{placed.name}", {}).values())
        return RobotMark(
            clean_text(placed.name, MAX_NAMED),
            placed.x,
            placed.y,
            placed.heading,
            camera=placed.camera != 0,
            hidden=placed.hidden,
            colour=OPERATOR if operator else None,
            words="operator" if operator else (report.doing if report is not None else ""),
            alert=report is not None and not operator and (report.alert or report.doing == "alert"),
        )


def _detail(report: BehaviorSaid) -> str:
    """What stands behind the word in a lane: of an alert under another word, that too."""
    words = (report.doing if report.alert and report.doing != "alert" else "", report.detail)
    return " · ".join(word for word in words if word)


def _alert(report: BehaviorSaid) -> str:
    who = _name(report.robot) if report.robot else report.path
    if report.doing == "alert":
        return f"{who} sees {report.detail}" if report.detail else f"{who} sees something"
    return f"{who}: {_detail(report)}"


def _caption_of(name: str, poses: BuildingPoses) -> str:
    minutes, seconds = divmod(max(0, int(poses.time)), 60)
    speed = "" if poses.speed == 1 else f" · {poses.speed:g} times as fast"
    return f"{name} · {minutes}:{seconds:02}{speed}"


def _short(rc: str) -> str:
    return rc.partition("/")[2] or rc


def _name(robot: str) -> str:
    return clean_text(robot.removeprefix("robot/"), MAX_NAMED)


def hold_of(hold: Holder | HoldView, operator_priority: int) -> RobotHold:
    """What matters here of a hold."""
    rcs = hold.rcs if isinstance(hold, Holder) else hold.needs
    robots = tuple(sorted(rc for rc in rcs if rc.startswith("robot/")))
    return RobotHold(robots, hold.priority >= operator_priority)

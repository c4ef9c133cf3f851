"""What is published of robots, put together for the timeline: who looks through which camera, what each
behavior does, who is where. Pure but for the timeline, whose times are passed in."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

from zscout.keyexpr import Sender
from zscout.messages import BehaviorSaid, Box, BuildingPlan, BuildingPoses, FrameHead, Placed, RcState
from zscout.services.recorder.colours import DOING, OPERATOR, PALE
from zscout.services.recorder.drawing import clean_text
from zscout.services.recorder.floor_plan import PersonMark, RobotMark
from zscout.services.recorder.timeline import HolderRow, Timeline
from zscout.types import SECOND, Grant, Ns

RATE: Final = 20
"""Reports of one sender recorded in a second, and at once."""
MAX_WAITING: Final = 256
"""Paths of one sender whose newest report waits for its turn."""
MAX_SENDERS: Final = 1_000
DROPS_EVERY: Final = 10.0
"""Seconds between two figures of what was dropped of one sender."""
MAX_FOLLOWED: Final = 2_000
"""Behaviors, and RCs, that are followed at one time."""
MAX_BOXES: Final = 32
"""Over one picture, whoever drew them."""
POSE_SPACING: Final = 0.09
"""Seconds between two records of where all are."""
SILENCE: Final = 10.0
"""Seconds without a message from a building after which it is not known who is where, and another may be
shown."""
PLAN_AGAIN: Final = 5.0
"""Seconds until a plan that did not come is asked for again."""
HEALTH_SPACING: Final = 1.0
"""Seconds between two events about the health of one RC."""
MAX_NAMED: Final = 24
"""Characters of a name on floor and pictures."""

BehaviorKey = tuple[Sender, str]
"""A behavior: its client, and its path."""


@dataclass(slots=True)
class _Sender:
    full_at: Ns
    """When as many reports as in a second may come at once, in ns."""
    waiting: dict[str, BehaviorSaid] = field(default_factory=dict)
    """The newest report of each path that came too fast, oldest first."""
    dropped: int = 0
    counted_at: float = -DROPS_EVERY

    def take(self, at: float) -> bool:
        """Whether the rate allows one more report now."""
        now = round(at * SECOND)
        if self.full_at - (RATE - 1) * SECOND // RATE > now:
            return False
        self.full_at = max(self.full_at, now) + SECOND // RATE
        return True


class RateLimiter:
    """Passes on the reports of each sender, at most `RATE` a second. What comes faster waits, and of each
    path only the newest is kept: however much was dropped, what is passed on last is how it is."""

    def __init__(self) -> None:
        self._senders: dict[Sender, _Sender] = {}

    def offer(self, at: float, sender: Sender, report: BehaviorSaid) -> BehaviorSaid | None:
        """The report itself if it is to be recorded now."""
        state = self._senders.pop(sender, None)
        if state is None:
            if len(self._senders) >= MAX_SENDERS:
                del self._senders[next(iter(self._senders))]
            state = _Sender(round(at * SECOND))
        self._senders[sender] = state
        if not state.waiting and state.take(at):
            return report
        state.dropped += state.waiting.pop(report.path, None) is not None
        if len(state.waiting) < MAX_WAITING:
            state.waiting[report.path] = report
        else:
            state.dropped += 1
        return None

    def due(self, at: float) -> Iterator[tuple[Sender, BehaviorSaid]]:
        """What has waited and is to be recorded now."""
        for sender, state in self._senders.items():
            while state.waiting and state.take(at):
                yield sender, state.waiting.pop(next(iter(state.waiting)))

    def dropped(self, at: float) -> Iterator[tuple[Sender, int]]:
        """Senders of which reports were dropped, and how many since the last figure."""
        for sender, state in self._senders.items():
            if state.dropped and at - state.counted_at >= DROPS_EVERY:
                state.counted_at, count, state.dropped = at, state.dropped, 0
                yield sender, count

    def forget(self, sender: Sender) -> None:
        self._senders.pop(sender, None)


NO_HOLD: Final = HolderRow("")


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
    hold: HolderRow = NO_HOLD
    boxes: dict[BehaviorKey, list[Box]] = field(default_factory=dict)

    @property
    def names(self) -> str:
        return ", ".join(_name(robot) for robot in self.hold.robots)


class RobotTracker:
    """Writes to `timeline` what is published of robots."""

    def __init__(self, timeline: Timeline) -> None:
        self.timeline, self.panes = timeline, timeline.robots
        self._limiter = RateLimiter()
        self._reports: dict[BehaviorKey, BehaviorSaid] = {}
        """What each behavior does, the one that reported longest ago first."""
        self.holds: dict[str, dict[Grant, HolderRow]] = {}
        """By RC."""
        self._cameras: dict[str, _Camera] = {}
        self._health: dict[str, _Health] = {}
        self._building: _Building | None = None
        self._others: set[Sender] = set()

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
        for sender, count in self._limiter.dropped(at):
            self._warn(at, f"behaviors of {sender} say too much: {count} sayings were left out")
        for rc, health in self._health.items():
            self._show_health(at, rc, health)
        building = self._building
        if building is not None and building.planned and at - building.seen_at > SILENCE:
            building.planned = False
            self.panes.floor.clear(at)
            self._warn(at, f"building {building.name} is silent: who is where is not known any more")

    def left(self, at: float, sender: Sender) -> None:
        """A client is gone, and its behaviors with it."""
        for path in [path for client, path in self._reports if client == sender]:
            self._take(at, sender, BehaviorSaid(path, ""))
        self._limiter.forget(sender)

    def _warn(self, at: float, text: str) -> None:
        self.timeline.event(at, text, "WARN")

    def _take(self, at: float, sender: Sender, report: BehaviorSaid) -> None:
        key = sender, report.path
        before = self._reports.pop(key, None)
        if report.doing and len(self._reports) < MAX_FOLLOWED:
            self._reports[key] = report
        # A behavior that has moved to another client is over in the old one only.
        elsewhere = not report.doing and any(path == report.path for _, path in self._reports)
        if not elsewhere:
            self.panes.behavior(at, report.path, "alert" if report.alert else report.doing, _detail(report))
        if report.alert:
            self._warn(at, _alert(report))
        for camera in {report.camera, before.camera if before is not None else ""} & self._cameras.keys():
            boxes = self._cameras[camera].boxes
            if camera == report.camera and report.doing and report.boxes:
                boxes[key] = report.boxes
            else:
                boxes.pop(key, None)
            drawn = [box for some in boxes.values() for box in some]
            self.panes.boxes(at, _short(camera), drawn[:MAX_BOXES])

    def _doing(self, robot: str) -> BehaviorSaid | None:
        """The newest report about a robot."""
        names = robot, f"robot/{robot}"
        return next((report for report in reversed(self._reports.values()) if report.robot in names), None)

    # Cameras

    def frame(self, at: float, camera: str, head: FrameHead, jpeg: bytes) -> None:
        """A picture of the framegrabber `camera`."""
        seen = self._cameras.get(camera)
        if seen is None:
            if len(self._cameras) >= MAX_FOLLOWED:
                return
            seen = self._cameras[camera] = _Camera()
        holds = self.holds.get(camera, {})
        hold = holds.get(head.grant, NO_HOLD) if head.grant is not None else NO_HOLD
        if hold.robots != seen.hold.robots:
            self._forget_boxes(at, camera, seen)
        seen.hold = hold
        self.panes.picture(at, _short(camera), jpeg, *self._caption(seen))

    def no_frame(self, at: float, camera: str) -> None:
        """No picture has come for a while."""
        seen = self._cameras.get(camera)
        if seen is None:
            return
        self._forget_boxes(at, camera, seen)
        words = "not held"
        if self.holds.get(camera):
            words = " · ".join(filter(None, (seen.names, "no picture")))
        self.panes.old_picture(at, _short(camera), words, PALE)

    def _forget_boxes(self, at: float, camera: str, seen: _Camera) -> None:
        if seen.boxes:
            seen.boxes.clear()
            self.panes.boxes(at, _short(camera), [])

    def _caption(self, seen: _Camera) -> tuple[str, int]:
        """Words and colour."""
        _, operator, robots = seen.hold
        if operator:
            return (f"{seen.names} · operator" if robots else "operator"), OPERATOR
        report = self._doing(robots[0].partition("/")[2]) if len(robots) == 1 else None
        if report is None:
            return seen.names, PALE
        return f"{seen.names} · {report.doing}", DOING.get(report.doing, PALE)

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
            self._warn(at, f"{rc} fails: {health.words}")

    # The building

    def poses(self, at: float, sender: Sender, poses: BuildingPoses) -> None:
        """Who is where in a building."""
        building = self._building
        if building is not None and building.sender != sender and at - building.seen_at <= SILENCE:
            if sender not in self._others and len(self._others) < MAX_FOLLOWED:
                self._others.add(sender)
                self._warn(at, f"a second building, of {sender}, is not shown: that of {building.sender} is")
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
            minutes, seconds = divmod(max(0, int(poses.time)), 60)
            speed = "" if poses.speed == 1 else f" · {poses.speed:g} times as fast"
            caption = f"{building.name} · {minutes}:{seconds:02}{speed}"
            self.panes.floor.show(at, robots, people, caption)

    def wants_plan(self, at: float) -> Sender | None:
        """The client to ask for its building's plan now, if any."""
        building = self._building
        if building is None or building.planned or building.refused:
            return None
        if at - building.seen_at > SILENCE or at - building.asked < PLAN_AGAIN:
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
            self._warn(at, f"building {building.name} of {sender} can't be shown: {why}")

    def _robot(self, placed: Placed) -> RobotMark:
        report = self._doing(placed.name)
        operator = any(hold.operator for hold in self.holds.get(f"robot/{placed.name}", {}).values())
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
    words = report.doing if report.alert and report.doing != "alert" else ""
    return " · ".join(filter(None, (words, report.detail)))


def _alert(report: BehaviorSaid) -> str:
    who = _name(report.robot) if report.robot else report.path
    if report.doing == "alert":
        return f"{who} sees {report.detail or 'something'}"
    return f"{who}: {_detail(report)}"


def _short(rc: str) -> str:
    return rc.partition("/")[2] or rc


def _name(robot: str) -> str:
    return clean_text(robot.removeprefix("robot/"), MAX_NAMED)

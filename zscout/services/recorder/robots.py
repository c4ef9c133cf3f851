"""The robots' part of the timeline: activities of behaviors, pictures of cameras, figures and health of devices, and
the floor. Times are passed in."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final

import rerun as rr

from zscout.drivers.airtime import Bucket
from zscout.drivers.image_size import jpeg_size
from zscout.keyexpr import Sender
from zscout.messages import BehaviorSaid, Box, FrameHead, RcState
from zscout.services.recorder.blueprint import LEGEND, RobotLayout
from zscout.services.recorder.colours import ALERT, DOING, LINES, OPERATOR, OTHER, PALE, bright
from zscout.services.recorder.drawing import Drawing, HolderRow, Lanes, clean_path, clean_text, with_detail
from zscout.services.recorder.floor_plan import MAX_NAME, FloorPlan, Look
from zscout.types import SECOND, Grant

RATE: Final = 20
"""Reports of one sender recorded in a second, and in a burst."""
MAX_WAITING: Final = 256
"""Paths of one sender whose newest report may wait."""
MAX_SENDERS: Final = 1_000
DROPS_EVERY: Final = 10.0
"""Seconds between two events about dropped reports of a sender."""
MAX_FOLLOWED: Final = 2_000
"""Behaviors, and RCs, followed at one time."""
MAX_LANES: Final = 500
MAX_DEPTH: Final = 8
"""Levels of the tree of behaviors that become parts of an entity."""
DETAILS: Final = 200
"""Distinct texts with details in one lane; further ones are shown without details."""
MAX_CAMERAS: Final = 32
MAX_SIDE: Final = 4_096
"""Pixels of a picture's longer side."""
MAX_BOXES: Final = 32
"""Boxes over one picture, of all behaviors."""
DIM: Final = 0.25
"""Opacity of an outdated picture."""
MAX_CAPTION: Final = 48
"""Characters."""
HEALTH_SPACING: Final = 1.0
"""Seconds between two events about the health of one RC."""
MAX_SERIES: Final = 200
SPACING: Final = 0.5
"""Seconds between two points; devices report once a second at most."""
AGAIN: Final = 30.0
"""Seconds after which an unchanged figure is drawn again."""

BehaviorKey = tuple[Sender, str]
"""A behavior's client and path."""
NO_HOLD: Final = HolderRow("")


@dataclass(slots=True)
class _Sender:
    bucket: Bucket
    waiting: dict[str, BehaviorSaid] = field(default_factory=dict)
    """The newest waiting report of each path, oldest first."""
    dropped: int = 0
    counted_at: float = -DROPS_EVERY


class RateLimiter:
    """Passes on at most `RATE` reports a second of each sender. Of further ones the newest of each path waits."""

    def __init__(self) -> None:
        self._senders: dict[Sender, _Sender] = {}

    def offer(self, at: float, sender: Sender, report: BehaviorSaid) -> bool:
        """Return True if the report may be recorded now; else it waits."""
        state = self._senders.pop(sender, None)
        if state is None:
            if len(self._senders) >= MAX_SENDERS:
                del self._senders[next(iter(self._senders))]
            state = _Sender(Bucket(Fraction(RATE), Fraction(RATE), round(at * SECOND)))
        self._senders[sender] = state
        if not state.waiting and state.bucket.admits(1, round(at * SECOND)):
            return True
        state.dropped += state.waiting.pop(report.path, None) is not None
        if len(state.waiting) < MAX_WAITING:
            state.waiting[report.path] = report
        else:
            state.dropped += 1
        return False

    def due(self, at: float) -> Iterator[tuple[Sender, BehaviorSaid]]:
        """Yield waiting reports that may be recorded now."""
        for sender, state in self._senders.items():
            while state.waiting and state.bucket.admits(1, round(at * SECOND)):
                yield sender, state.waiting.pop(next(iter(state.waiting)))

    def dropped(self, at: float) -> Iterator[tuple[Sender, int]]:
        """Yield senders of dropped reports, with their number since the last time."""
        for sender, state in self._senders.items():
            if state.dropped and at - state.counted_at >= DROPS_EVERY:
                state.counted_at, count, state.dropped = at, state.dropped, 0
                yield sender, count

    def forget(self, sender: Sender) -> None:
        self._senders.pop(sender, None)


@dataclass(slots=True)
class _Health:
    words: str = ""
    """The present state in words; empty if well."""
    shown: str = ""
    """The state shown last."""
    at: float = -HEALTH_SPACING


@dataclass(slots=True)
class _Camera:
    name: str
    entity: str
    hold: HolderRow = NO_HOLD
    boxes: dict[BehaviorKey, list[Box]] = field(default_factory=dict)
    size: tuple[int, int] | None = None
    """Size of the last picture in pixels; None before it has a pane."""
    jpeg: bytes = b""
    """Its last picture."""
    old: bool = False

    @property
    def robots(self) -> str:
        return ", ".join(_name(robot) for robot in self.hold.robots)


class RobotTracker:
    def __init__(self, drawing: Drawing) -> None:
        self._drawing = drawing
        self.floor = FloorPlan(drawing, self._look)
        self.holds: dict[str, dict[Grant, HolderRow]] = {}
        """Holders by RC and grant."""
        self._limiter = RateLimiter()
        self._reports: dict[BehaviorKey, BehaviorSaid] = {}
        """The newest report of each behavior, the oldest first."""
        self._behaviors = Lanes(drawing, "behavior", MAX_LANES, "behaviors: the others have no lane", depth=MAX_DEPTH)
        self._cameras: dict[str, _Camera] = {}
        self._health: dict[str, _Health] = {}
        self._duplicates: dict[tuple[str, str], str] = {}
        """By RC and host: the instance for which this instance is on standby."""
        self._figures: dict[tuple[str, str], tuple[float, float]] = {}
        """Time and value of the last point, by RC and figure."""

    @property
    def shown(self) -> RobotLayout:
        cameras = [(camera.entity, clean_text(camera.name, MAX_CAPTION)) for camera in self._with_pane()]
        return RobotLayout(tuple(cameras), self.floor.size, self._behaviors.rows, min(len(self._figures), LEGEND + 1))

    def tick(self, at: float) -> None:
        """Called several times a second."""
        for sender, report in list(self._limiter.due(at)):
            self._take(at, sender, report)
        for sender, count in self._limiter.dropped(at):
            self._drawing.warn(at, f"too many reports of behaviors from {sender}: dropped {count}")
        for rc, health in self._health.items():
            self._show_health(at, rc, health)
        self.floor.tick(at)

    def behavior(self, at: float, sender: Sender, report: BehaviorSaid) -> None:
        if self._limiter.offer(at, sender, report):
            self._take(at, sender, report)

    def left(self, at: float, sender: Sender) -> None:
        """End the behaviors of a client that is gone."""
        for path in [path for client, path in self._reports if client == sender]:
            self._take(at, sender, BehaviorSaid(path, ""))
        self._limiter.forget(sender)

    def _take(self, at: float, sender: Sender, report: BehaviorSaid) -> None:
        key = sender, report.path
        before = self._reports.pop(key, None)
        if report.doing and len(self._reports) < MAX_FOLLOWED:
            self._reports[key] = report
        # A behavior that moved to another client continues there.
        if report.doing or all(path != report.path for _, path in self._reports):
            self._show_behavior(at, report)
        if report.alert:
            self._drawing.warn(at, _alert(report))
        for camera in {report.camera, before.camera if before is not None else ""} & self._cameras.keys():
            seen = self._cameras[camera]
            if camera == report.camera and report.doing and report.boxes:
                seen.boxes[key] = report.boxes
            else:
                seen.boxes.pop(key, None)
            self._draw_boxes(at, seen)

    def _show_behavior(self, at: float, report: BehaviorSaid) -> None:
        doing = "alert" if report.alert else report.doing
        known = self._behaviors.texts(report.path)
        if not doing and known is None:
            return
        word = clean_text(doing)
        text = with_detail(doing, _detail(report))
        # A further text could have no colour of its own; the word alone has the right colour.
        if known is not None and len(known) >= DETAILS and text not in known:
            text = word
        self._behaviors.show(at, report.path, {text: (text, DOING.get(word, OTHER))})
        self._drawing.arrange()

    def _doing(self, robot: str) -> BehaviorSaid | None:
        names = robot, f"robot/{robot}"
        return next((report for report in reversed(self._reports.values()) if report.robot in names), None)

    def _look(self, robot: str) -> Look:
        if any(hold.operator for hold in self.holds.get(f"robot/{robot}", {}).values()):
            return Look("operator", OPERATOR)
        report = self._doing(robot)
        return Look(report.doing, alert=report.alert or report.doing == "alert") if report is not None else Look()

    def frame(self, at: float, camera: str, head: FrameHead, jpeg: bytes) -> None:
        seen = self._cameras.get(camera)
        if seen is None:
            if len(self._cameras) >= MAX_FOLLOWED:
                return
            name = camera.removeprefix("framegrabber/")
            seen = self._cameras[camera] = _Camera(name, clean_path("camera", name.replace("/", "_")))
        hold = self.holds.get(camera, {}).get(head.grant, NO_HOLD) if head.grant is not None else NO_HOLD
        if hold.robots != seen.hold.robots:
            seen.boxes.clear()
            self._draw_boxes(at, seen)
        seen.hold = hold
        size = jpeg_size(jpeg)
        if size is None or max(size) > MAX_SIDE:
            self._drawing.note(
                at, f"{seen.name} sends pictures that are no JPEG of at most {MAX_SIDE} pixels a side: left out"
            )
            return
        others = "cameras: the pictures of the others are not shown"
        if seen.size is None and not self._drawing.room(at, self._with_pane(), MAX_CAMERAS, others):
            return
        seen.size, seen.old = size, False
        self._draw_picture(at, seen, jpeg, 1.0)
        self._write(at, seen, *self._caption(seen))
        self._drawing.arrange()

    def no_frame(self, at: float, camera: str) -> None:
        """No picture has arrived for a while: dim the last picture until the next."""
        seen = self._cameras.get(camera)
        if seen is None:
            return
        seen.boxes.clear()
        self._draw_boxes(at, seen)
        if not seen.old and seen.size is not None:
            seen.old = True
            self._draw_picture(at, seen, seen.jpeg, DIM)
        words = " · ".join(filter(None, (seen.robots, "no picture"))) if self.holds.get(camera) else "not held"
        self._write(at, seen, words, PALE)

    def _draw_picture(self, at: float, seen: _Camera, jpeg: bytes, opacity: float) -> None:
        """Log the whole picture at each change: a file, or a late viewer, may lack the previous one."""
        seen.jpeg = jpeg
        self._drawing.show_again(
            at, seen.entity, rr.EncodedImage, contents=jpeg, media_type="image/jpeg", opacity=opacity
        )

    def _with_pane(self) -> list[_Camera]:
        return [camera for _, camera in sorted(self._cameras.items()) if camera.size is not None]

    def _caption(self, seen: _Camera) -> tuple[str, int]:
        """Text and colour of a camera's caption."""
        _, operator, robots = seen.hold
        if operator:
            return (f"{seen.robots} · operator" if robots else "operator"), OPERATOR
        report = self._doing(robots[0].partition("/")[2]) if len(robots) == 1 else None
        if report is None:
            return seen.robots, PALE
        return f"{seen.robots} · {report.doing}", DOING.get(report.doing, PALE)

    def _write(self, at: float, seen: _Camera, caption: str, colour: int) -> None:
        """Draw the caption below the middle of the upper edge: a view's title can't change with time."""
        words = clean_text(caption, MAX_CAPTION)
        self._drawing.show(
            at,
            f"{seen.entity}/caption",
            rr.Points2D,
            positions=[(seen.size[0] / 2, 0.0)] if words and seen.size is not None else [],
            radii=[0.0],
            colors=[bright(colour)],
            labels=[words],
            show_labels=True,
        )

    def _draw_boxes(self, at: float, seen: _Camera) -> None:
        boxes = [box for some in seen.boxes.values() for box in some][:MAX_BOXES]
        self._drawing.show(
            at,
            f"{seen.entity}/boxes",
            rr.Boxes2D,
            array=[box for box in boxes if _is_inside(box, *(seen.size or (0, 0)))],
            array_format=rr.Box2DFormat.XYWH,
            colors=[ALERT],
            radii=[-1.5],
        )

    def state(self, at: float, state: RcState) -> None:
        """Take the state of an RC: figures and health of its device, or that it is on standby."""
        instance = state.rc, state.host
        if state.duplicate_of != self._duplicates.get(instance, "") and len(self._duplicates) < MAX_FOLLOWED:
            self._duplicates[instance] = state.duplicate_of
            role = f"on standby: duplicate of {state.duplicate_of}" if state.duplicate_of else "serves"
            (self._drawing.warn if state.duplicate_of else self._drawing.event)(
                at, f"{state.rc} at {state.host} {role}"
            )
        if state.duplicate_of:
            return
        if state.figures:
            self._draw_figures(at, state.rc, state.figures)
        words = "" if state.health == "ok" else f"fails: {state.health}"
        if not words and state.unwell is not None:
            words = f"is unwell: {state.unwell.why}"
        if state.rc in self._health or (words and len(self._health) < MAX_FOLLOWED):
            health = self._health.setdefault(state.rc, _Health())
            health.words = words
            self._show_health(at, state.rc, health)

    def _show_health(self, at: float, rc: str, health: _Health) -> None:
        if health.words == health.shown or at - health.at < HEALTH_SPACING:
            return
        health.shown, health.at = health.words, at
        if health.words:
            self._drawing.warn(at, f"{rc} {health.words}")
        else:
            self._drawing.event(at, f"{rc} is well again")

    def _draw_figures(self, at: float, rc: str, figures: Mapping[str, float]) -> None:
        """Leaves out values that are not finite."""
        for figure, value in figures.items():
            key = rc, figure
            drawn_at, last = self._figures.get(key, (-math.inf, math.nan))
            if not math.isfinite(value) or at - drawn_at < (AGAIN if value == last else SPACING):
                continue
            entity = clean_path("device", f"{rc}/{figure.replace('/', '_')}")
            if key not in self._figures:
                others = "figures of devices: the others are not drawn"
                if not self._drawing.room(at, self._figures, MAX_SERIES, others):
                    continue
                step = rr.components.InterpolationMode.StepAfter
                colour = LINES[len(self._figures) % len(LINES)]
                self._drawing.curve(entity, f"{rc} {figure}", colour, 1.5, interpolation_mode=step)
            self._figures[key] = at, value
            self._drawing.point(at, entity, value)
        self._drawing.arrange()


def _detail(report: BehaviorSaid) -> str:
    """The detail after the word in a lane; for an alert, preceded by the report's own word."""
    words = report.doing if report.alert and report.doing != "alert" else ""
    return " · ".join(filter(None, (words, report.detail)))


def _alert(report: BehaviorSaid) -> str:
    subject = _name(report.robot) if report.robot else report.path
    if report.doing == "alert":
        return f"{subject} sees {report.detail or 'something'}"
    return f"{subject}: {_detail(report)}"


def _name(robot: str) -> str:
    return clean_text(robot.removeprefix("robot/"), MAX_NAME)


def _is_inside(box: Box, width: int, height: int) -> bool:
    left, top, wide, high = box
    return 0 <= left < width and 0 <= top < height and 0 < wide <= width and 0 < high <= height

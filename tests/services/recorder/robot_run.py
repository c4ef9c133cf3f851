"""A made-up minute of Place Sensor Net: four robots take turns at two cameras, hide, watch, and an operator
drives one of them for a while. All is told in the messages that a mesh would bring."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, Final

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from tests.services.recorder.paper_run import rows
from zscout.keyexpr import Sender
from zscout.messages import BehaviorSaid, BuildingPlan, BuildingPoses, FrameHead, Placed, RcState
from zscout.services.recorder.drawing import HolderRow
from zscout.services.recorder.robots import RobotTracker
from zscout.services.recorder.timeline import Timeline
from zscout.types import Grant, Term

SECONDS: Final = 60
ROBOTS: Final = ("scout33", "scout34", "scout35", "scout36")
NET: Final = Sender("anvil", "net")
BUILDING: Final = Sender("anvil", "living_room")
WIDTH, DEPTH, PIXELS = 6.0, 4.5, 150
"""Metres, and pixels of each."""
SOFA, TABLE, SHELF, BED = ((0.2, 2.4, 1.1, 1.9), (2.4, 1.6, 1.4, 0.9), (4.9, 0.1, 1.0, 0.5), (4.3, 3.2, 1.6, 1.1))
"""Furniture: left, bottom, width and depth in metres."""

CAMERA = "framegrabber/fgrab1"
GRANT = Grant(Term(1, "rcm"), 7)

# Robot: the turns it has, each from, to, camera, what it does there and when in the turn.
Turn = tuple[float, float, int, tuple[tuple[float, str, str], ...]]
SEARCHES = ((0.0, "search", "turns to look round"), (3.0, "approach", "the sofa"), (8.0, "enter", "under it"))
TURNS: Final[dict[str, tuple[Turn, ...]]] = {
    "scout33": (
        (0, 14, 1, (*SEARCHES, (11.0, "turn", "to the light"), (13.0, "hidden", ""))),
        (28, 44, 1, ((0.0, "watch", "0 alerts"), (7.0, "alert", "motion (1)"), (10.0, "watch", "1 alerts"))),
    ),
    "scout34": (
        (
            0,
            30,
            2,
            (
                (0.0, "search", "turns to look round"),
                (5.0, "approach", "the bed"),
                (13.0, "unstick", "it does not move"),
                (17.0, "approach", "the bed"),
                (23.0, "enter", "under it"),
            ),
        ),
        (44, 60, 2, ((0.0, "approach", "the bed"), (5.0, "turn", "to the light"), (7.0, "hidden", ""))),
    ),
    "scout35": ((14, 28, 1, (*SEARCHES, (11.0, "turn", "to the light"), (13.0, "hidden", ""))),),
    "scout36": ((44, 60, 1, ((0.0, "search", "turns to look round"), (7.0, "approach", "the shelf"))),),
}
OPERATOR: Final = (30.0, 44.0, "scout34")
WAYS: Final[dict[str, tuple[tuple[float, float, float], ...]]] = {
    "scout33": ((0, 2.6, 0.6), (3, 2.6, 0.6), (8, 1.6, 2.0), (13, 0.8, 2.9)),
    "scout34": (
        *((second, 3.6, 0.7) for second in (0, 5)),
        (13, 4.1, 2.2),
        (17, 3.9, 2.0),
        (30, 4.4, 2.9),
        (44, 2.0, 1.1),
        (60, 4.6, 3.6),
    ),
    "scout35": ((0, 4.6, 1.2), (17, 4.6, 1.2), (27, 3.0, 2.0)),
    "scout36": ((0, 1.0, 1.0), (51, 1.0, 1.0), (60, 2.3, 0.9)),
}
"""Second, x and y."""
HIDDEN: Final = {"scout33": 12.0, "scout34": 54.0, "scout35": 26.0}
PERSON: Final = (33.0, 41.0)
"""Seconds between which somebody walks through."""


def told(kind: Any, **fields: Any) -> Any:
    """As JSON brings it: nothing is taken that a real message could not hold."""
    return msgspec.json.decode(msgspec.json.encode(fields), type=kind)


def png() -> bytes:
    """The plan: light from the middle, furniture in the dark."""
    rows, columns = round(DEPTH * PIXELS), round(WIDTH * PIXELS)
    y, x = np.mgrid[0:rows, 0:columns] / PIXELS
    floor = 60 + 170 * np.exp(-((x - 3) ** 2 + (y - 2.2) ** 2) / 5)
    picture = np.asarray(floor, np.uint8)
    for left, bottom, wide, deep in (SOFA, TABLE, SHELF, BED):
        first = round(left * PIXELS), round((DEPTH - bottom - deep) * PIXELS)
        last = round((left + wide) * PIXELS), round((DEPTH - bottom) * PIXELS)
        picture[first[1] : last[1], first[0] : last[0]] //= 4
        cv2.rectangle(picture, first, last, 200, 2)
    return bytes(cv2.imencode(".png", picture)[1])


def jpeg(at: float, robot: str, box: tuple[int, int, int, int] | None) -> bytes:
    """What a camera sees: floor, wall, something dark ahead, and perhaps somebody."""
    noise = np.random.default_rng(round(at * 1000) + len(robot))
    picture: NDArray[np.float64] = np.full((120, 160), 150.0)
    picture[60:] = np.linspace(90, 190, 60)[:, None]
    side = 80 + 50 * math.sin(at / 6 + ord(robot[-1]))
    size = 14 + 2 * (at % 14)
    cv2.rectangle(picture, (round(side - size), round(60 - size / 2)), (round(side + size), 66), 28.0, -1)
    if box is not None:
        left, top, wide, high = box
        cv2.rectangle(picture, (left, top), (left + wide, top + high), 60.0, -1)
    picture += noise.normal(0, 7, picture.shape)
    encoded = cv2.imencode(".jpg", np.clip(picture, 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 80])
    return bytes(encoded[1])


def play(timeline: Timeline, until: int = SECONDS) -> None:
    """The run, as the recorder would write it; its first `until` seconds."""
    grants: dict[tuple[int, float], Grant] = {}
    happens: list[tuple[float, Any]] = []
    for robot, turns in TURNS.items():
        happens.append((0.0, lambda at, robot=robot: wait(timeline, at, robot, "for its turn")))
        for number, turn in enumerate(turns):
            grants[turn[2], turn[0]] = Grant(Term(1, "rcm"), len(grants) + 1)
            happens += _turn(timeline, robot, "watch" if number and robot == "scout33" else "hide", turn, grants)
    begin, end, robot = OPERATOR
    grants[2, begin] = Grant(Term(1, "rcm"), 99)

    def stop(at: float) -> None:
        _free(timeline, at, "drive", robot, 2)

    happens += [
        (begin, lambda at: _hold(timeline, at, "drive", robot, 2, grants[2, begin], operator=True)),
        (end, stop),
    ]
    # What ends at one moment goes before what begins.
    happens.sort(key=lambda one: (one[0], one[1].__name__ != "stop"))
    for tenth in range(until * 10 + 1):
        at = tenth / 10
        while happens and happens[0][0] <= at:
            moment, what = happens.pop(0)
            what(moment)
        _building(timeline, at, tenth)
        if tenth % 5 == 0:
            _frames(timeline, at, grants)
        if tenth % 10 == 0:
            _second(timeline, at)
        timeline.robots.tick(at)


def wait(timeline: Timeline, at: float, robot: str, why: str) -> None:
    said(timeline, at, f"{robot}/hide", "wait", why, robot)
    timeline.arc(at, f"{robot}-hide", "waiting", "framegrabber/* is held by scout33-hide and scout34-hide")


def said(timeline: Timeline, at: float, path: str, doing: str, detail: str, robot: str, **more: Any) -> None:
    fields = {"path": f"place_sensor_net/{path}", "doing": doing, "detail": detail, "robot": f"robot/{robot}"}
    timeline.robots.behavior(at, NET, told(BehaviorSaid, **fields, **more))


def _turn(
    timeline: Timeline, robot: str, task: str, turn: Turn, grants: dict[tuple[int, float], Grant]
) -> list[tuple[float, Any]]:
    """What happens in one turn, by second."""
    begin, end, camera, steps = turn
    path, arc = f"{robot}/{task}", f"{robot}-{task}"

    def start(at: float) -> None:
        _hold(timeline, at, arc, robot, camera, grants[camera, begin])

    def step(doing: str, detail: str) -> Any:
        more: dict[str, Any] = {"camera": f"framegrabber/fgrab{camera}"} if task == "watch" else {}
        if doing == "alert":
            more |= {"alert": True, "boxes": [[88, 30, 26, 44]]}
        return lambda at: said(timeline, at, path, doing, detail, robot, **more)

    def stop(at: float) -> None:
        _free(timeline, at, arc, robot, camera)
        if (robot, end) == (OPERATOR[2], OPERATOR[0]):
            timeline.arc(at, arc, "preempted", "by drive (priority 10) on robot/scout34")
            timeline.event(at, f"{arc} is preempted by drive (priority 10) on robot/{robot}, and waits again", "WARN")
            said(timeline, at, path, "wait", "the hold is over", robot)
        else:
            timeline.arc(at, arc, "done")
            said(timeline, at, path, "", "", robot)

    return [(begin, start), *((begin + after, step(doing, detail)) for after, doing, detail in steps), (end, stop)]


def _rcs(robot: str, camera: int) -> tuple[str, ...]:
    return f"robot/{robot}", f"framegrabber/fgrab{camera}", f"video/ch{camera}"


_RADIO: dict[str, HolderRow] = {}


def _hold(
    timeline: Timeline, at: float, arc: str, robot: str, camera: int, grant: Grant, *, operator: bool = False
) -> None:
    holder = HolderRow(arc, operator, (f"robot/{robot}",))
    for rc in _rcs(robot, camera):
        timeline.robots.holds[rc] = {grant: holder}
        timeline.holders(at, rc, [holder])
    _RADIO[arc] = holder
    timeline.holders(at, "radio/rf0", list(_RADIO.values()))
    timeline.arc(at, arc, "running", f"priority {10 if operator else 1} · min 12 s")
    timeline.event(at, f"{arc} runs on {', '.join(sorted((*_rcs(robot, camera), 'radio/rf0')))}")


def _free(timeline: Timeline, at: float, arc: str, robot: str, camera: int) -> None:
    for rc in _rcs(robot, camera):
        timeline.robots.holds[rc] = {}
        timeline.holders(at, rc, [])
    _RADIO.pop(arc, None)
    timeline.holders(at, "radio/rf0", list(_RADIO.values()))
    if arc == "drive":
        timeline.arc(at, arc, "done")


def _building(timeline: Timeline, at: float, tenth: int) -> None:
    if tenth % 2:
        return
    robots = []
    for robot, way in WAYS.items():
        x, y, heading = _on(way, at)
        held = any(begin <= at < end for begin, end, _, _ in TURNS[robot])
        held |= robot == OPERATOR[2] and OPERATOR[0] <= at < OPERATOR[1]
        hidden = at >= HIDDEN.get(robot, math.inf)
        robots.append({"name": robot, "x": x, "y": y, "heading": heading, "camera": int(held), "hidden": hidden})
    begin, end = PERSON
    there = begin <= at < end
    people = [{"name": "walker", "x": 5.6 - 0.6 * (at - begin), "y": 1.2}] if there else []
    timeline.robots.floor.poses(at, BUILDING, told(BuildingPoses, time=at * 2, speed=2.0, robots=robots, people=people))
    if timeline.robots.floor.wants_plan(at) is not None:
        plan = BuildingPlan("living_room", WIDTH, DEPTH, png())
        timeline.robots.floor.plan(at, BUILDING, msgspec.json.decode(msgspec.json.encode(plan), type=BuildingPlan))


def _on(way: tuple[tuple[float, float, float], ...], at: float) -> tuple[float, float, float]:
    """Place and heading on a way."""
    last = way[0]
    heading = 1.0
    for step in way[1:]:
        if (step[1], step[2]) != (last[1], last[2]):
            heading = math.atan2(step[2] - last[2], step[1] - last[1])
        if at < step[0]:
            part = (at - last[0]) / (step[0] - last[0])
            return last[1] + part * (step[1] - last[1]), last[2] + part * (step[2] - last[2]), heading
        last = step
    return last[1], last[2], heading + math.pi


def _frames(timeline: Timeline, at: float, grants: dict[tuple[int, float], Grant]) -> None:
    for camera in (1, 2):
        turn = [
            (robot, begin)
            for robot, turns in (*TURNS.items(), (OPERATOR[2], ((*OPERATOR[:2], 2, ()),)))
            for begin, end, used, _ in turns
            if used == camera and begin <= at < end
        ]
        name = f"framegrabber/fgrab{camera}"
        if not turn:
            timeline.robots.no_frame(at, name)
            continue
        robot, begin = turn[0]
        somebody = (88, 30, 26, 44) if robot == "scout33" and 35 <= at < 38 else None
        grant = grants[camera, begin]
        head = told(FrameHead, number=round(at * 10), time=at, width=160, height=120, grant=grant)
        timeline.robots.frame(at, name, head, jpeg(at, robot, somebody))


def _second(timeline: Timeline, at: float) -> None:
    for number, host in enumerate(("anvil", "basil", "crucible")):
        timeline.hosts.load(at, host, 0.4 + 0.3 * number + 0.2 * math.sin(at / 9 + number), 0.3)
    for robot in ROBOTS:
        figures = {"commands": 5 + math.sin(at / 5 + ord(robot[-1])), "latency_ms": 20 + 4 * math.sin(at)}
        state = {"rc": f"robot/{robot}", "host": "cart", "instance": "i", "sharable": False}
        timeline.robots.state(at, told(RcState, **state, figures=figures))
        if at == 50 and robot == "scout36":
            timeline.robots.state(at, told(RcState, **state, health="radio/rf0 is not there"))


def record(path: Path, until: int = SECONDS) -> None:
    _RADIO.clear()
    with Timeline("lab", path=path) as timeline:
        play(timeline, until)
    _RADIO.clear()


# What single tests tell, and read back


def say(tracker: RobotTracker, at: float, path: str, doing: str, by: Sender = NET, **more: Any) -> None:
    tracker.behavior(at, by, told(BehaviorSaid, path=path, doing=doing, **more))


def head(number: int, grant: Grant | None = GRANT) -> FrameHead:
    found: FrameHead = told(FrameHead, number=number, time=number, width=160, height=120, grant=grant)
    return found


def poses(robots: list[Placed], people: list[Placed] | None = None, time: float = 0.0) -> BuildingPoses:
    return BuildingPoses(time, robots=robots, people=people or [])


def captions(path: Path, camera: str) -> list[tuple[float, str, int]]:
    """Second, words and colour; no words where there were none from then on."""
    entity = f"/camera/{camera}/caption"
    words = {at: value[0] for _, at, value in rows(path, entity, "Points2D:labels")}
    shades = {at: value[0] for _, at, value in rows(path, entity, "Points2D:colors")}
    ends = {at: "" for _, at, _ in rows(path, entity, "Clear:is_recursive")}
    return sorted((at, text, shades.get(at, 0)) for at, text in (words | ends).items())

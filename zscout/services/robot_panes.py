"""What a timeline shows of robots: their pictures, the floor, behaviors and devices, on one timeline."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager

import rerun as rr

from zscout.messages import Box
from zscout.services.behavior_lanes import BehaviorLanes
from zscout.services.device_curves import DeviceCurves
from zscout.services.floor_plan import FloorPlan, Person, Robot
from zscout.services.pictures import Pictures
from zscout.services.robot_layout import Shown


class RobotPanes:
    """A part of `Timeline`, as safe to call from any thread. `writing(at)` sets the time and tells whether
    anything is written still; `note` tells people once of something left out; `arrange` makes the layout
    anew, whenever there is something new to lay out."""

    def __init__(
        self,
        recording: rr.RecordingStream,
        writing: Callable[[float], AbstractContextManager[bool]],
        note: Callable[[float, str], None],
        arrange: Callable[[], None],
    ) -> None:
        self._writing, self._arrange = writing, arrange
        self._pictures = Pictures(recording, note)
        self._floor = FloorPlan(recording)
        self._behaviors = BehaviorLanes(recording, note)
        self._devices = DeviceCurves(recording, note)
        self._arranged: tuple[object, ...] = ((), None, False, False)

    @property
    def shown(self) -> Shown:
        return Shown(self._pictures.shown, self._floor.size, self._behaviors.rows, self._devices.any)

    def picture(self, at: float, camera: str, jpeg: bytes, caption: str, colour: int) -> None:
        """A camera's newest picture, with what it shows in words."""
        with self._write(at) as written:
            if written:
                self._pictures.picture(at, camera, jpeg, caption, colour)

    def old_picture(self, at: float, camera: str, caption: str, colour: int) -> None:
        """From `at` on, the camera's last picture is not how it is any more."""
        with self._write(at) as written:
            if written:
                self._pictures.old(camera, caption, colour)

    def boxes(self, at: float, camera: str, boxes: Sequence[Box]) -> None:
        """From `at` on, exactly these are drawn over the camera's pictures."""
        with self._write(at) as written:
            if written:
                self._pictures.boxes(camera, boxes)

    def plan(self, at: float, width: float, depth: float, png: bytes) -> str:
        """The plan of the building that `poses` tells of; returns why it can't be shown, or an empty text."""
        with self._write(at) as written:
            return self._floor.plan(width, depth, png) if written else ""

    def poses(self, at: float, robots: Sequence[Robot], people: Sequence[Person], caption: str) -> None:
        """Who is where, from `at` on."""
        with self._write(at) as written:
            if written:
                self._floor.show(at, robots, people, caption)

    def nobody(self, at: float) -> None:
        """From `at` on, nobody knows who is where."""
        with self._write(at) as written:
            if written:
                self._floor.clear()

    def behavior(self, at: float, path: str, doing: str, detail: str = "") -> None:
        """From `at` on, the behavior at `path` in the tree is `doing` this; it has ended if empty."""
        with self._write(at) as written:
            if written:
                self._behaviors.show(at, path, doing, detail)

    def figures(self, at: float, rc: str, figures: Mapping[str, float]) -> None:
        """What an RC tells of its device."""
        with self._write(at) as written:
            if written:
                self._devices.show(at, rc, figures)

    @contextmanager
    def _write(self, at: float) -> Iterator[bool]:
        with self._writing(at) as written:
            yield written
            shown = self.shown
            now = (shown.cameras, shown.floor, shown.behavior_rows > 0, shown.devices and shown.any)
            # Only now: a fleet without robots has no use for empty panes.
            if written and now != self._arranged and shown.any:
                self._arranged = now
                self._arrange()

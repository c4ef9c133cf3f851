"""What a timeline shows of robots: their pictures, the floor, behaviors and devices, on one timeline."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import Final

import rerun as rr

from zscout.messages import Box
from zscout.services.recorder.blueprint import RobotLayout
from zscout.services.recorder.colours import DOING, LINES, OTHER
from zscout.services.recorder.floor_plan import FloorPlan, PersonMark, RobotMark
from zscout.services.recorder.lanes import Lane, clean_path, clean_text, rows_of, written
from zscout.services.recorder.pictures import Pictures

MAX_LANES: Final = 500
MAX_DEPTH: Final = 8
"""Behaviors above each other that have parts of an entity of their own."""
DETAILS: Final = 200
"""Distinct texts of one lane with their details; from then on it shows the words alone."""
BEHAVIOR_STATES: Final = 256
"""Distinct texts of one lane that keep their colour."""
MAX_SERIES: Final = 200
SPACING: Final = 0.5
"""Seconds between two points; devices report once a second at most."""
AGAIN: Final = 30.0
"""Seconds after which a figure that has not changed is drawn again."""


class RobotPanes:
    """A part of `Timeline`, as safe to call from any thread. `writing` is the timeline's; `note` logs once
    that something is left out; `arrange` makes the layout anew, whenever there is something new to lay
    out."""

    def __init__(
        self,
        recording: rr.RecordingStream,
        writing: Callable[[float], AbstractContextManager[bool]],
        note: Callable[[float, str], None],
        arrange: Callable[[], None],
    ) -> None:
        self._recording, self._note, self._arrange = recording, note, arrange
        self.writing = writing
        self._pictures = Pictures(recording, note)
        self._floor = FloorPlan(recording)
        self._behaviors: dict[str, Lane] = {}
        """By entity: paths that differ may be cleaned to the same."""
        self._figures: dict[tuple[str, str], tuple[float, float]] = {}
        """When and what was drawn last, by RC and figure."""
        self._arranged: tuple[object, ...] = ((), None, False, False)

    @property
    def shown(self) -> RobotLayout:
        return RobotLayout(
            self._pictures.shown, self._floor.size, rows_of(self._behaviors), bool(self._figures)
        )

    @written
    def picture(self, at: float, camera: str, jpeg: bytes, caption: str, colour: int) -> None:
        """A camera's newest picture, with what it shows in words."""
        self._pictures.picture(at, camera, jpeg, caption, colour)
        self._lay_out()

    @written
    def old_picture(self, at: float, camera: str, caption: str, colour: int) -> None:
        """From `at` on, the camera's last picture is not how it is any more."""
        self._pictures.old(camera, caption, colour)

    @written
    def boxes(self, at: float, camera: str, boxes: Sequence[Box]) -> None:
        """From `at` on, exactly these are drawn over the camera's pictures."""
        self._pictures.boxes(camera, boxes)

    def plan(self, at: float, width: float, depth: float, png: bytes) -> str:
        """The plan of the building that `poses` is about; returns why it can't be shown, or an empty text."""
        with self.writing(at) as open_still:
            why = self._floor.plan(width, depth, png) if open_still else ""
            if open_still:
                self._lay_out()
        return why

    @written
    def poses(
        self, at: float, robots: Sequence[RobotMark], people: Sequence[PersonMark], caption: str
    ) -> None:
        """Who is where, from `at` on."""
        self._floor.show(at, robots, people, caption)

    @written
    def nobody(self, at: float) -> None:
        """From `at` on, nobody knows who is where."""
        self._floor.clear()

    @written
    def behavior(self, at: float, path: str, doing: str, detail: str = "") -> None:
        """From `at` on, the behavior at `path` in the tree is `doing` this, one word, and `detail` says more
        of it in the same bar; it has ended if empty."""
        entity = clean_path("behavior", path, MAX_DEPTH)
        name = "/".join(map(str, entity))
        lane = self._behaviors.get(name)
        if lane is None:
            if not doing:
                return
            if len(self._behaviors) >= MAX_LANES:
                self._note(at, f"more than {MAX_LANES} behaviors: the others have no lane")
                return
            lane = self._behaviors[name] = Lane(entity, BEHAVIOR_STATES)
        word = clean_text(doing)
        text = clean_text(f"{doing} · {detail}" if doing and detail else doing)
        # A text that had lost its colour would get any; the word alone says as much in the right one.
        if text not in lane.colours and len(lane.colours) >= DETAILS:
            text = word
        lane.show(self._recording, [(text, DOING.get(word, OTHER))])
        self._lay_out()

    @written
    def figures(self, at: float, rc: str, figures: Mapping[str, float]) -> None:
        """What an RC (`kind/name`) reports of its device; what is not a finite number is left out."""
        for figure, value in figures.items():
            key = rc, figure
            drawn_at, last = self._figures.get(key, (-math.inf, math.nan))
            if not math.isfinite(value) or at - drawn_at < (AGAIN if value == last else SPACING):
                continue
            path = clean_path("device", f"{rc}/{figure.replace('/', '_')}")
            if key not in self._figures:
                if len(self._figures) >= MAX_SERIES:
                    self._note(at, f"more than {MAX_SERIES} figures of devices: the others are not drawn")
                    continue
                line = rr.SeriesLines(
                    names=[clean_text(f"{rc} {figure}")],
                    colors=[LINES[len(self._figures) % len(LINES)]],
                    widths=[1.5],
                    interpolation_mode=rr.components.InterpolationMode.StepAfter,
                )
                self._recording.log(path, line, static=True)
            self._figures[key] = at, value
            self._recording.log(path, rr.Scalars(value))
        self._lay_out()

    def _lay_out(self) -> None:
        """Only once there is something to show: a fleet without robots has no use for empty panes."""
        shown = self.shown
        now = (shown.cameras, shown.floor, shown.behavior_rows > 0, shown.devices and shown.any)
        if shown.any and now != self._arranged:
            self._arranged = now
            self._arrange()

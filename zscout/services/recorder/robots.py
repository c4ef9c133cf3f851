"""The robots' part of the timeline: cameras, the floor, what each behavior does, and figures of devices.

A camera is the name of its framegrabber.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import rerun as rr

from zscout.drivers.image_size import jpeg_size
from zscout.messages import Box
from zscout.services.recorder.blueprint import RobotLayout
from zscout.services.recorder.colours import ALERT, DOING, LINES, OTHER, PALE, bright
from zscout.services.recorder.drawing import Drawing, Lanes, clean_path, clean_text, with_detail
from zscout.services.recorder.floor_plan import FloorPlan

MAX_CAMERAS: Final = 32
MAX_SIDE: Final = 4_096
"""Pixels of a picture's longer side."""
DIM: Final = 0.25
"""Opacity of a picture that is an old one."""
MAX_CAPTION: Final = 48
"""Characters."""
MAX_LANES: Final = 500
MAX_DEPTH: Final = 8
"""Behaviors above each other that have parts of an entity of their own."""
DETAILS: Final = 200
"""Distinct texts of one lane with their details; from then on it shows the words alone."""
MAX_SERIES: Final = 200
SPACING: Final = 0.5
"""Seconds between two points; devices report once a second at most."""
AGAIN: Final = 30.0
"""Seconds after which a figure that has not changed is drawn again."""


@dataclass(slots=True)
class _Camera:
    entity: str
    size: tuple[int, int] = (0, 0)
    old: bool = False


class RobotPanes:
    """Draws what robots do and see."""

    def __init__(self, drawing: Drawing) -> None:
        self._drawing = drawing
        self.floor = FloorPlan(drawing)
        self._cameras: dict[str, _Camera] = {}
        others = "behaviors: the others have no lane"
        self._behaviors = Lanes(drawing, "behavior", MAX_LANES, others, depth=MAX_DEPTH)
        self._figures: dict[tuple[str, str], tuple[float, float]] = {}
        """When and what was drawn last, by RC and figure."""

    @property
    def shown(self) -> RobotLayout:
        cameras = tuple(
            (camera.entity, clean_text(name, MAX_CAPTION)) for name, camera in sorted(self._cameras.items())
        )
        return RobotLayout(cameras, self.floor.size, self._behaviors.rows, bool(self._figures))

    def picture(self, at: float, name: str, jpeg: bytes, caption: str, colour: int = PALE) -> None:
        """A camera's newest picture, and what is seen through it in words."""
        size = jpeg_size(jpeg)
        if size is None or max(size) > MAX_SIDE:
            self._drawing.note(
                at, f"{name} sends what is no JPEG of at most {MAX_SIDE} pixels a side: left out"
            )
            return
        camera = self._cameras.get(name)
        if camera is None:
            others = "cameras: the pictures of the others are not shown"
            if not self._drawing.room(at, self._cameras, MAX_CAMERAS, others):
                return
            camera = self._cameras[name] = _Camera(clean_path("camera", name.replace("/", "_")))
        camera.size, camera.old = size, False
        image = rr.EncodedImage(contents=jpeg, media_type="image/jpeg", opacity=1.0)
        self._drawing.log(at, camera.entity, image)
        self._write(at, camera, caption, colour)
        self._drawing.arrange()

    def old_picture(self, at: float, name: str, caption: str, colour: int = PALE) -> None:
        """From `at` on, the camera's last picture is not how it is now: it is dimmed until the next one."""
        camera = self._cameras.get(name)
        if camera is None:
            return
        if not camera.old:
            camera.old = True
            self._drawing.log(at, camera.entity, rr.EncodedImage.from_fields(opacity=DIM))
        self._write(at, camera, caption, colour)

    def boxes(self, at: float, name: str, boxes: Sequence[Box]) -> None:
        """From `at` on, exactly these are drawn over the camera's pictures, in their pixels."""
        camera = self._cameras.get(name)
        if camera is None:
            return
        self._drawing.show(
            at,
            f"{camera.entity}/boxes",
            rr.Boxes2D,
            array=[box for box in boxes if _is_inside(box, *camera.size)],
            array_format=rr.Box2DFormat.XYWH,
            colors=[ALERT],
            radii=[-1.5],
        )

    def _write(self, at: float, camera: _Camera, caption: str, colour: int) -> None:
        """The caption hangs from the middle of the upper edge: a view's title could not follow the time."""
        words = clean_text(caption, MAX_CAPTION)
        self._drawing.show(
            at,
            f"{camera.entity}/caption",
            rr.Points2D,
            positions=[(camera.size[0] / 2, 0.0)] if words else [],
            radii=[0.0],
            colors=[bright(colour)],
            labels=[words],
            show_labels=True,
        )

    def plan(self, at: float, width: float, depth: float, png: bytes) -> str:
        """The plan of the building that `floor` is about; returns why it can't be shown, or an empty text."""
        why = self.floor.plan(at, width, depth, png)
        self._drawing.arrange()
        return why

    def behavior(self, at: float, path: str, doing: str, detail: str = "") -> None:
        """From `at` on, the behavior at `path` in the tree is `doing` this, one word, and `detail` says more
        of it in the same bar; it has ended if empty."""
        known = self._behaviors.texts(path)
        if not doing and known is None:
            return
        word = clean_text(doing)
        text = with_detail(doing, detail)
        # A text that had lost its colour would get any; the word alone says as much in the right one.
        if known is not None and len(known) >= DETAILS and text not in known:
            text = word
        self._behaviors.show(at, path, {text: (text, DOING.get(word, OTHER))})
        self._drawing.arrange()

    def figures(self, at: float, rc: str, figures: Mapping[str, float]) -> None:
        """What an RC (`kind/name`) reports of its device; what is not a finite number is left out."""
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
            self._drawing.log(at, entity, rr.Scalars(value))
        self._drawing.arrange()


def _is_inside(box: Box, width: int, height: int) -> bool:
    left, top, wide, high = box
    return 0 <= left < width and 0 <= top < height and 0 < wide <= width and 0 < high <= height

"""The cameras' part of the timeline: pictures as they came, what they show in words, and boxes over them.

Everything is logged at the time that the recording stands at. A camera is the name of its framegrabber.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Final

import rerun as rr

from zscout.drivers.image_size import jpeg_size
from zscout.messages import Box
from zscout.services.recorder.colours import ALERT, PALE, bright
from zscout.services.recorder.lanes import clean_path, clean_text

MAX_CAMERAS: Final = 32
MAX_SIDE: Final = 4_096
"""Pixels of a picture's longer side."""
DIM: Final = 0.25
"""Opacity of a picture that is an old one."""
MAX_CAPTION: Final = 48
"""Characters."""


@dataclass(slots=True)
class _Camera:
    entity: list[object]
    size: tuple[int, int] = (0, 0)
    caption: tuple[str, int] = ("", 0)
    boxes: list[Box] = field(default_factory=list)
    old: bool = False


class Pictures:
    """`note` logs once that something is left out."""

    def __init__(self, recording: rr.RecordingStream, note: Callable[[float, str], None]) -> None:
        self._recording, self._note = recording, note
        self._cameras: dict[str, _Camera] = {}

    @property
    def shown(self) -> tuple[tuple[str, str], ...]:
        """Entity and title of each camera, by name."""
        return tuple(
            ("/" + "/".join(map(str, camera.entity)), clean_text(name, MAX_CAPTION))
            for name, camera in sorted(self._cameras.items())
        )

    def picture(self, at: float, name: str, jpeg: bytes, caption: str, colour: int = PALE) -> None:
        """A camera's newest picture, and what is seen through it."""
        size = jpeg_size(jpeg)
        if size is None or max(size) > MAX_SIDE:
            self._note(at, f"{name} sends what is no JPEG of at most {MAX_SIDE} pixels a side: left out")
            return
        camera = self._cameras.get(name)
        if camera is None:
            if len(self._cameras) >= MAX_CAMERAS:
                self._note(at, f"more than {MAX_CAMERAS} cameras: the pictures of the others are not shown")
                return
            camera = self._cameras[name] = _Camera(clean_path("camera", name.replace("/", "_")))
        if camera.size != size:
            camera.size, camera.caption = size, ("", 0)
        camera.old = False
        self._recording.log(
            camera.entity, rr.EncodedImage(contents=jpeg, media_type="image/jpeg", opacity=1.0)
        )
        self._write(camera, caption, colour)

    def old(self, name: str, caption: str, colour: int = PALE) -> None:
        """What is shown of this camera is not how it is now: it is dimmed until the next picture."""
        camera = self._cameras.get(name)
        if camera is None:
            return
        if not camera.old:
            camera.old = True
            self._recording.log(camera.entity, rr.EncodedImage.from_fields(opacity=DIM))
        self._write(camera, caption, colour)

    def boxes(self, name: str, boxes: Sequence[Box]) -> None:
        """What is marked in the picture from now on, in its pixels; nothing if empty."""
        camera = self._cameras.get(name)
        if camera is None:
            return
        width, height = camera.size
        inside = [box for box in boxes if _is_inside(box, width, height)]
        if inside == camera.boxes:
            return
        camera.boxes = inside
        entity = [*camera.entity, "boxes"]
        if not inside:
            self._recording.log(entity, rr.Clear(recursive=False))
            return
        shapes = rr.Boxes2D(array=inside, array_format=rr.Box2DFormat.XYWH, colors=[ALERT], radii=[-1.5])
        self._recording.log(entity, shapes)

    def _write(self, camera: _Camera, caption: str, colour: int) -> None:
        """The caption hangs from the middle of the upper edge: a view's title could not follow the time."""
        words = clean_text(caption, MAX_CAPTION)
        if (words, colour) == camera.caption:
            return
        camera.caption = words, colour
        entity = [*camera.entity, "caption"]
        if not words:
            self._recording.log(entity, rr.Clear(recursive=False))
            return
        place = [(camera.size[0] / 2, 0.0)]
        label = rr.Points2D(place, radii=[0.0], colors=[bright(colour)], labels=[words], show_labels=True)
        self._recording.log(entity, label)


def _is_inside(box: Box, width: int, height: int) -> bool:
    left, top, wide, high = box
    return 0 <= left < width and 0 <= top < height and 0 < wide <= width and 0 < high <= height

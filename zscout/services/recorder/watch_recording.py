"""What a watch saw, as a Rerun recording: pictures with boxes where something moves, and events in words."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from zscout.behaviors.perception.motion import Box
from zscout.services.recorder.blueprint import TIME
from zscout.services.recorder.colours import OPERATOR, OTHER
from zscout.services.recorder.picture_stream import PictureRecording

WIDTH: Final = 640
"""Columns of a recorded picture; larger ones are reduced."""
QUALITY: Final = 75
MAX_BYTES: Final = 2 << 30
"""Of pictures in one recording; then only boxes and events are written."""


class WatchRecording(PictureRecording):
    """Writes to one file."""

    def __init__(self, title: str, file: Path) -> None:
        """Raises TimelineError where `file` can't be written."""
        share = rrb.TimeSeriesView(origin="/moving", name="Share of the picture that moves, %")
        super().__init__("watch", title, between=[share], shares=[6, 1, 1], port=None, file=file)
        self._bytes = 0

    def picture(self, at: float, picture: NDArray[np.uint8], boxes: Sequence[Box], *, moving: bool) -> None:
        """A picture, `at` seconds of the source, with boxes in its pixels: `moving`, or else not sure yet."""
        height, width = picture.shape[:2]
        scale = min(1.0, WIDTH / width)
        self._stream.set_time(TIME, duration=at)
        if self._bytes < MAX_BYTES:
            if scale < 1:
                size = (WIDTH, max(1, round(height * scale)))
                picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
            coded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()
            self._bytes += len(coded)
            self._stream.log("picture", rr.EncodedImage(contents=coded, media_type="image/jpeg"))
        self._stream.log(
            "picture/moving",
            rr.Boxes2D(
                array=[[side * scale for side in box] for box in boxes] or np.zeros((0, 4)),
                array_format=rr.Box2DFormat.XYWH,
                colors=np.full(len(boxes), OPERATOR if moving else OTHER, np.uint32),
            ),
        )
        share = sum(box.width * box.height for box in boxes) / (height * width) if moving else 0.0
        self._stream.log("moving", rr.Scalars(100 * share))

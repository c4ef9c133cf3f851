"""What a watch saw, as a Rerun recording: pictures with boxes where something moves, and events in words."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from zscout.keyexpr import new_instance
from zscout.services.blueprint import APPLICATION, OPERATOR, TIME
from zscout.services.lanes import clean_text
from zscout.services.timeline import TimelineError
from zscout.vision.motion import Box

WIDTH: Final = 640
"""Columns of a recorded picture; larger ones are reduced."""
QUALITY: Final = 75
MAX_BYTES: Final = 2 << 30
"""Of pictures in one recording; then only boxes and events are written."""


class WatchRecording:
    """Writes to one file. A context manager."""

    def __init__(self, title: str, file: Path) -> None:
        """Raises TimelineError where `file` can't be written."""
        layout = rrb.Blueprint(
            rrb.Vertical(
                rrb.Spatial2DView(origin="/picture", name=clean_text(title)),
                rrb.TimeSeriesView(origin="/moving", name="Share of the picture that moves, %"),
                rrb.TextLogView(origin="/events", name="Events"),
                row_shares=[6, 1, 1],
            ),
            rrb.BlueprintPanel(state="collapsed"),
            rrb.SelectionPanel(state="collapsed"),
            rrb.TimePanel(state="collapsed", timeline=TIME),
            auto_layout=False,
            auto_views=False,
        )
        self._bytes = 0
        self._recording = rr.RecordingStream(APPLICATION, recording_id=f"watch-{new_instance()}")
        try:
            file.parent.mkdir(parents=True, exist_ok=True)
            self._recording.set_sinks(rr.FileSink(file), default_blueprint=layout)
        except (OSError, RuntimeError, ValueError) as error:
            raise TimelineError(
                f"can't record to {file} ({error}); name a file that can be written"
            ) from error

    def picture(self, at: float, picture: NDArray[np.uint8], boxes: Sequence[Box], *, moving: bool) -> None:
        """A picture, `at` seconds of the source, with boxes in its pixels: `moving`, or else not sure yet."""
        height, width = picture.shape[:2]
        scale = min(1.0, WIDTH / width)
        self._recording.set_time(TIME, duration=at)
        if self._bytes < MAX_BYTES:
            if scale < 1:
                size = (WIDTH, max(1, round(height * scale)))
                picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
            coded = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes()
            self._bytes += len(coded)
            self._recording.log("picture", rr.EncodedImage(contents=coded, media_type="image/jpeg"))
        colour = OPERATOR if moving else 0x8A8A94FF
        self._recording.log(
            "picture/moving",
            rr.Boxes2D(
                array=[[side * scale for side in box] for box in boxes] or np.zeros((0, 4)),
                array_format=rr.Box2DFormat.XYWH,
                colors=np.full(len(boxes), colour, np.uint32),
            ),
        )
        share = sum(box.width * box.height for box in boxes) / (height * width) if moving else 0.0
        self._recording.log("moving", rr.Scalars(100 * share))

    def say(self, at: float, text: str) -> None:
        """One line in words."""
        self._recording.set_time(TIME, duration=at)
        self._recording.log("events", rr.TextLog(clean_text(text)))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._recording.disconnect()

"""Rerun recordings of a camera by `zscout drive` and `zscout motion`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Final, Self

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from zscout.behaviors.perception.motion import Box
from zscout.cli.common import Failed
from zscout.keyexpr import new_instance
from zscout.services.recorder.blueprint import APPLICATION, page
from zscout.services.recorder.colours import OPERATOR, OTHER
from zscout.services.recorder.drawing import Drawing, clean_text, disconnect, unwritten
from zscout.services.recorder.timeline import TimelineError

SERVER_MEMORY: Final = "100MB"
"""Data kept for a viewer that opens late."""
DISCONNECT_SECONDS: Final = 3.0
FLUSH_SECONDS: Final = 3.0
CHECK_INTERVAL_BYTES: Final = 1 << 22
"""Bytes of pictures between two checks that the file can be written."""
MAX_WIDTH: Final = 640
"""Columns of a recorded picture; wider pictures are scaled down."""
JPEG_QUALITY: Final = 75
MAX_PICTURE_BYTES: Final = 2 << 30
"""Size of all pictures of a recording; after that only boxes and events are written."""


class PictureRecording(Drawing):
    """In a file, or served on loopback, or both. Times are seconds since a zero of the caller's choice."""

    def __init__(
        self,
        command: str,
        title: str,
        *,
        port: int | None = None,
        file: Path | None = None,
        between: Sequence[rrb.View] = (),
        shares: Sequence[int] = (5, 1),
    ) -> None:
        """`port` must be free. Raises TimelineError if `file` can't be written."""
        self._recording = rr.RecordingStream(APPLICATION, recording_id=f"{command}-{new_instance()}")
        super().__init__(self._recording)
        self._file = file
        self.url = f"rerun+http://127.0.0.1:{port}/proxy" if port is not None else ""
        """Address for a viewer; empty if it is not served."""
        layout = page(
            rrb.Vertical(
                rrb.Spatial2DView(origin="/picture", name=clean_text(title)),
                *between,
                rrb.TextLogView(origin="/events", name="Events"),
                row_shares=list(shares),
            ),
            play_state="following" if self.url else None,
        )
        sinks: list[rr.GrpcServerSink | rr.FileSink] = []
        if port is not None:
            sinks.append(rr.GrpcServerSink(bind_ip="127.0.0.1", port=port, server_memory_limit=SERVER_MEMORY))
        try:
            if file is not None:
                file.parent.mkdir(parents=True, exist_ok=True)
                sinks.append(rr.FileSink(file))
            self._recording.set_sinks(*sinks, default_blueprint=layout)
        except (OSError, RuntimeError, ValueError) as error:
            raise TimelineError(f"can't record to {file} ({error}); name a file that can be written") from error

    def words(self, at: float, text: str) -> None:
        self.log(at, "events", rr.TextLog(clean_text(text)))

    def picture(self, at: float, jpeg: bytes) -> None:
        self.log(at, "picture", rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))

    def check(self) -> None:
        """Block until the file has everything logged so far. Raises Failed if it can't be written."""
        if self._file is not None and (why := unwritten(self._recording, self._file, FLUSH_SECONDS)):
            raise Failed(why)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is None:
                self.check()
        finally:
            disconnect(self._recording, DISCONNECT_SECONDS)


class WatchRecording(PictureRecording):
    """A recording of pictures with boxes around motion, in a file."""

    def __init__(self, title: str, file: Path) -> None:
        share = rrb.TimeSeriesView(origin="/moving", name="Share of the picture that moves, %")
        super().__init__("watch", title, file=file, between=[share], shares=[6, 1, 1])
        self._bytes = 0

    def seen(self, at: float, picture: NDArray[np.uint8], boxes: Sequence[Box], *, moving: bool) -> None:
        """Record a picture with boxes in its pixels. `moving`: motion is certain."""
        height, width = picture.shape[:2]
        scale = min(1.0, MAX_WIDTH / width)
        if self._bytes < MAX_PICTURE_BYTES:
            if scale < 1:
                size = (MAX_WIDTH, max(1, round(height * scale)))
                picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
            jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
            if self._bytes // CHECK_INTERVAL_BYTES != (self._bytes + len(jpeg)) // CHECK_INTERVAL_BYTES:
                self.check()
            self._bytes += len(jpeg)
            self.picture(at, jpeg)
        shapes = [[side * scale for side in box] for box in boxes] or np.zeros((0, 4))
        colours = np.full(len(boxes), OPERATOR if moving else OTHER, np.uint32)
        self.log(at, "picture/moving", rr.Boxes2D(array=shapes, array_format=rr.Box2DFormat.XYWH, colors=colours))
        share = sum(box.width * box.height for box in boxes) / (height * width) if moving else 0.0
        self.log(at, "moving", rr.Scalars(100 * share))

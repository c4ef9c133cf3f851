"""Pictures that one command shows as a Rerun recording of its own, as for the operator who drives a robot."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import rerun as rr
import rerun.blueprint as rrb

from zscout.keyexpr import new_instance
from zscout.services.recorder.blueprint import APPLICATION, TIME, page
from zscout.services.recorder.lanes import clean_text
from zscout.services.recorder.timeline import TimelineError

MEMORY: Final = "100MB"
"""What is kept for a viewer that opens late."""
DISCONNECT_SECONDS: Final = 3.0


class PictureRecording:
    """Pictures above events, on one timeline. A context manager."""

    def __init__(
        self,
        name: str,
        title: str,
        *,
        between: Sequence[rrb.View] = (),
        shares: Sequence[int],
        port: int | None,
        file: Path | None,
    ) -> None:
        layout = page(
            rrb.Vertical(
                rrb.Spatial2DView(origin="/picture", name=clean_text(title)),
                *between,
                rrb.TextLogView(origin="/events", name="Events"),
                row_shares=list(shares),
            ),
            play_state="following" if port is not None else None,
        )
        self._stream = rr.RecordingStream(APPLICATION, recording_id=f"{name}-{new_instance()}")
        sinks: list[rr.GrpcServerSink | rr.FileSink] = []
        if port is not None:
            sinks.append(rr.GrpcServerSink(bind_ip="127.0.0.1", port=port, server_memory_limit=MEMORY))
        try:
            if file is not None:
                file.parent.mkdir(parents=True, exist_ok=True)
                sinks.append(rr.FileSink(file))
            self._stream.set_sinks(*sinks, default_blueprint=layout)
        except (OSError, RuntimeError, ValueError) as error:
            raise TimelineError(
                f"can't record to {file} ({error}); name a file that can be written"
            ) from error

    def event(self, at: float, text: str) -> None:
        """One line in words, `at` seconds since whatever zero the caller chose."""
        self._stream.set_time(TIME, duration=at)
        self._stream.log("events", rr.TextLog(clean_text(text)))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stream.disconnect()


class PictureStream(PictureRecording):
    """One robot's pictures, served on loopback, and written to `file` if one is named."""

    def __init__(self, title: str, port: int, file: Path | None = None) -> None:
        """`port` must be free. Raises TimelineError where `file` can't be written."""
        super().__init__("drive", title, shares=[5, 1], port=port, file=file)
        self.url = f"rerun+http://127.0.0.1:{port}/proxy"

    def show(self, at: float, jpeg: bytes) -> None:
        """A picture, `at` seconds since whatever zero the caller chose."""
        self._stream.set_time(TIME, duration=at)
        self._stream.log("picture", rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # A viewer that hangs can hold this up: then it is left to a thread that dies with the process.
        thread = threading.Thread(target=self._stream.disconnect, daemon=True)
        thread.start()
        thread.join(DISCONNECT_SECONDS)

"""One robot's picture for the operator who drives it: a Rerun stream of its own, live and as a file."""

from __future__ import annotations

import threading
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import rerun as rr
import rerun.blueprint as rrb

from zscout.keyexpr import new_instance
from zscout.services.blueprint import APPLICATION, TIME
from zscout.services.lanes import clean_text
from zscout.services.timeline import TimelineError

MEMORY: Final = "100MB"
"""What is kept for a viewer that opens late."""
DISCONNECT_SECONDS: Final = 3.0


class PictureStream:
    """Pictures and words, served on loopback, and written to `file` if one is named. A context manager."""

    def __init__(self, title: str, port: int, file: Path | None = None) -> None:
        """`port` must be free. Raises TimelineError where `file` can't be written."""
        layout = rrb.Blueprint(
            rrb.Vertical(
                rrb.Spatial2DView(origin="/picture", name=clean_text(title)),
                rrb.TextLogView(origin="/events", name="Events"),
                row_shares=[5, 1],
            ),
            rrb.BlueprintPanel(state="collapsed"),
            rrb.SelectionPanel(state="collapsed"),
            rrb.TimePanel(state="collapsed", timeline=TIME, play_state="following"),
            auto_layout=False,
            auto_views=False,
        )
        self._recording = rr.RecordingStream(APPLICATION, recording_id=f"drive-{new_instance()}")
        sinks: list[rr.GrpcServerSink | rr.FileSink] = [
            rr.GrpcServerSink(bind_ip="127.0.0.1", port=port, server_memory_limit=MEMORY)
        ]
        try:
            if file is not None:
                file.parent.mkdir(parents=True, exist_ok=True)
                sinks.append(rr.FileSink(file))
            self._recording.set_sinks(*sinks, default_blueprint=layout)
        except (OSError, RuntimeError, ValueError) as error:
            raise TimelineError(
                f"can't record to {file} ({error}); name a file that can be written"
            ) from error
        self.url = f"rerun+http://127.0.0.1:{port}/proxy"

    def show(self, at: float, jpeg: bytes) -> None:
        """A picture, `at` seconds since whatever zero the caller chose."""
        self._recording.set_time(TIME, duration=at)
        self._recording.log("picture", rr.EncodedImage(contents=jpeg, media_type="image/jpeg"))

    def say(self, at: float, text: str) -> None:
        """One line in words."""
        self._recording.set_time(TIME, duration=at)
        self._recording.log("events", rr.TextLog(clean_text(text)))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        # A viewer that hangs can hold this up: then it is left to a thread that dies with the process.
        thread = threading.Thread(target=self._recording.disconnect, daemon=True)
        thread.start()
        thread.join(DISCONNECT_SECONDS)

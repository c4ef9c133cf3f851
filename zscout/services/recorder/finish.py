"""Finishes a recording: rewrites it in few large chunks, and thins old pictures.

A viewer needs time for each chunk, whatever its size, and a recorder writes thousands. As a program,
`python -m zscout.services.recorder.finish` reads a job from standard input: its memory is freed when it exits."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

import msgspec
import numpy as np
import rerun as rr
from rerun.chunk import Chunk, OptimizationProfile, RrdReader

from zscout.services.recorder.blueprint import APPLICATION, Layout, blueprint

WHOLE: Final = 600.0
"""Seconds at the end of a recording whose pictures are all kept."""
APART: Final = 1.0
"""Seconds between the older pictures of a camera that are kept."""
PICTURE: Final = "EncodedImage:blob"
PROFILE: Final = OptimizationProfile(
    max_bytes=2 << 20, max_rows=65_536, max_rows_if_unsorted=65_536, extra_passes=50, gop_batching=False
)
WRITE_SECONDS: Final = 30.0


class Job(msgspec.Struct, frozen=True):
    """A complete recording, and its layout."""

    path: Path
    layout: Layout


def finish(path: Path, layout: Layout, *, whole: float = WHOLE) -> None:
    """Rewrite a recording in place. On failure raises OSError, RuntimeError or ValueError; the file stays as it was."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a live recording has no footer
        reader = RrdReader(path)
        store = reader.recordings()[0]
    end = layout.span[1] if layout.span is not None else 0.0
    chunks = reader.stream(store=store).flat_map(_thinned((end - whole) * 1e9)).collect(optimize=PROFILE)
    new = path.with_name(f".{path.stem}.finishing")
    stream = rr.RecordingStream(APPLICATION, recording_id=store.recording_id, send_properties=False)
    try:
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        layout_now = blueprint(layout)
        stream.save(new, default_blueprint=layout_now)
        stream.send_blueprint(layout_now)
        stream.send_chunks(chunks)
        stream.flush(timeout_sec=WRITE_SECONDS)
        stream.disconnect()
        new.replace(path)
    except BaseException:
        stream.disconnect()
        with suppress(OSError):
            new.unlink()
        raise


def _thinned(before: float) -> Callable[[Chunk], Iterator[Chunk]]:
    """Leave out pictures older than `before` (ns of the timeline) within APART seconds of the last picture kept."""
    last: dict[str, int] = {}

    def thin(chunk: Chunk) -> Iterator[Chunk]:
        batch = chunk.to_record_batch() if not chunk.is_static else None
        if batch is None or PICTURE not in batch.schema.names:
            yield chunk
            return
        times = batch.column(chunk.timeline_names[0]).cast("int64").to_numpy()
        pictures = batch.column(PICTURE).is_valid().to_numpy(zero_copy_only=False)
        keep = np.ones(len(times), bool)
        for row in np.flatnonzero(pictures & (times < before)):
            at = int(times[row])
            keep[row] = at - last.get(chunk.entity_path, at - round(APART * 1e9)) >= APART * 1e9
            if keep[row]:
                last[chunk.entity_path] = at
        if keep.all():
            yield chunk
        elif keep.any():
            yield from Chunk.from_record_batch(batch.take(np.flatnonzero(keep)))

    return thin


def main() -> None:
    """Exit with code 1 and an error line on failure."""
    job = msgspec.json.decode(sys.stdin.buffer.read(), type=Job, dec_hook=lambda kind, value: kind(value))
    try:
        finish(job.path, job.layout)
    except (OSError, RuntimeError, ValueError) as error:
        sys.exit(f"{job.path} can't be rewritten, and stays as it is: {error}")


if __name__ == "__main__":
    main()

"""The common parts of the studies' recordings: the file, its page of tabs beside a summary, and curves.

Only these functions import Rerun, which is large.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Final

from zscout.config.strict import BadInput
from zscout.types import SECOND, Ns

if TYPE_CHECKING:
    import rerun as rr
    import rerun.blueprint as rrb

VIRTUAL_TIME: Final = "virtual_time"
"""The timeline of curves over time: a duration in seconds."""
COLOURS: Final = (0x56C1FFFF, 0xFFB454FF, 0xB5E07BFF, 0xD6A6FFFF)
"""RGBA."""
MARGIN: Final = 0.03
"""Free part of the width at the sides of a plot."""
WRITE_SECONDS: Final = 10.0


@contextmanager
def recording(path: Path, application: str, blueprint: rrb.Blueprint, summary: str) -> Iterator[rr.RecordingStream]:
    """Replaces an existing file; `summary`, in Markdown, is shown beside its tabs. Raises BadInput if the file can't be
    written."""
    import rerun as rr

    stream = rr.RecordingStream(application)
    try:
        stream.save(path, default_blueprint=blueprint)
        yield stream
        stream.log("summary", rr.TextDocument(summary, media_type="text/markdown"), static=True)
        stream.flush(timeout_sec=WRITE_SECONDS)
    except (RuntimeError, OSError, ValueError) as error:
        raise BadInput(f"--rrd {path}: it can't be written ({error}); give another file") from None
    finally:
        stream.disconnect()


def tabs_and_summary(tabs: Sequence[rrb.Container], time: str, shares: tuple[int, int] = (68, 32)) -> rrb.Blueprint:
    """Plots in tabs, and the summary beside them; `shares` of the width."""
    import rerun.blueprint as rrb

    from zscout.services.recorder.blueprint import page

    root = rrb.Horizontal(
        rrb.Tabs(*tabs, active_tab=0),
        rrb.TextDocumentView(origin="/summary", name="Results"),
        column_shares=list(shares),
    )
    # Otherwise it plays, and the cursor moves over plots that show everything anyway.
    return page(root, timeline=time, play_state="following")


def whole_time(end: Ns) -> rrb.archetypes.TimeAxis:
    """An axis from 0 to `end`: without it, a plot shows only times near the viewer's cursor."""
    import rerun as rr
    import rerun.blueprint as rrb

    boundary, seconds = rr.TimeRangeBoundary, end / SECOND
    return rrb.archetypes.TimeAxis(
        view_range=rr.TimeRange(
            start=boundary.absolute(seconds=-MARGIN * seconds), end=boundary.absolute(seconds=(1 + MARGIN) * seconds)
        )
    )


def draw_curve(
    stream: rr.RecordingStream, entity: str, look: rr.SeriesLines | rr.SeriesPoints, points: Sequence[tuple[Ns, float]]
) -> None:
    """Points over virtual time."""
    import rerun as rr

    stream.log(entity, look, static=True)
    times = rr.TimeColumn(VIRTUAL_TIME, duration=[at / SECOND for at, _ in points])
    stream.send_columns(entity, indexes=[times], columns=rr.Scalars.columns(scalars=[value for _, value in points]))

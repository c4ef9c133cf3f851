"""Where recordings lie: files named by fleet and local time, of which the newest are kept."""

from __future__ import annotations

import logging
import re
import time
from pathlib import Path

from zscout.config.strict import BadInput

log = logging.getLogger(__name__)

KEEP = 50
"""Recordings of one fleet in one folder; older ones are removed."""
MAX_A_SECOND = 100


def new_recording(folder: Path, fleet: str) -> Path:
    """Makes an empty `<fleet>-<date>-<time>.rrd` in `folder`, and the folder too. Raises BadInput."""
    stamp = time.strftime("%Y%m%d-%H%M%S")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for number in range(1, MAX_A_SECOND):
            path = folder / (f"{fleet}-{stamp}.rrd" if number == 1 else f"{fleet}-{stamp}-{number}.rrd")
            try:
                path.touch(exist_ok=False)
            except FileExistsError:
                continue
            return path
    except OSError as error:
        why = "it is a file" if isinstance(error, FileExistsError) else error.strerror
        raise BadInput(f"recordings can't be written to {folder} ({why}); give another folder") from None
    raise BadInput(f"{folder} has {MAX_A_SECOND} recordings of this second; remove some")


def prune(folder: Path, fleet: str, keep: int = KEEP) -> list[Path]:
    """Removes all but the newest `keep` recordings of a fleet; returns those removed.

    Nothing is touched that is not named as `new_recording` names files."""
    ours = re.compile(rf"{re.escape(fleet)}-\d{{8}}-\d{{6}}(-\d+)?\.rrd")
    removed: list[Path] = []
    try:
        found = [path for path in folder.iterdir() if ours.fullmatch(path.name) and path.is_file()]
        for path in sorted(found, key=lambda path: path.stat().st_mtime_ns, reverse=True)[keep:]:
            path.unlink()
            removed.append(path)
    except OSError as error:
        log.warning("old recordings in %s can't be removed: %s", folder, error.strerror)
    return removed

"""The behaviors' part of the timeline: a lane for each place in the tree of behaviors.

Everything is logged at the time that the recording stands at.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import rerun as rr

from zscout.services.blueprint import OTHER
from zscout.services.lanes import Lane, clean_path, clean_text, rows_of
from zscout.services.robot_colours import DOING

MAX_LANES: Final = 500
MAX_DEPTH: Final = 8
"""Behaviors above each other that have parts of an entity of their own."""
DETAILS: Final = 200
"""Distinct texts of one lane with their details; from then on it shows the words alone."""
STATES: Final = 256
"""Distinct texts of one lane that keep their colour."""


class BehaviorLanes:
    """`note` tells people once of something left out."""

    def __init__(self, recording: rr.RecordingStream, note: Callable[[float, str], None]) -> None:
        self._recording, self._note = recording, note
        self._lanes: dict[str, Lane] = {}
        """By entity: paths that differ may be cleaned to the same."""

    @property
    def rows(self) -> int:
        return rows_of(self._lanes)

    def show(self, at: float, path: str, doing: str, detail: str = "") -> None:
        """From `at` on, the behavior at `path` is `doing` this, one word, and `detail` says more of it in the
        same bar. An empty word ends the bar."""
        entity = clean_path("behavior", path, MAX_DEPTH)
        name = "/".join(map(str, entity))
        lane = self._lanes.get(name)
        if lane is None:
            if not doing:
                return
            if len(self._lanes) >= MAX_LANES:
                self._note(at, f"more than {MAX_LANES} behaviors: the others have no lane")
                return
            lane = self._lanes[name] = Lane(entity, STATES)
        word = clean_text(doing)
        text = clean_text(f"{doing} · {detail}" if doing and detail else doing)
        # A text that had lost its colour would get any; the word alone tells as much in the right one.
        if text not in lane.colours and len(lane.colours) >= DETAILS:
            text = word
        lane.show(self._recording, [(text, DOING.get(word, OTHER))])

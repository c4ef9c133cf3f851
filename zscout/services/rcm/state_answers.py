"""Answers queries for the state of a leader (`zscout status`, `why`)."""

from __future__ import annotations

from typing import Final, NamedTuple

from msgspec.structs import replace

from zscout import messages
from zscout.mesh import IncomingQuery, Mesh
from zscout.rcm.leader import Leader
from zscout.rcm.state_view import StateView
from zscout.types import SECOND, Ns

STATE_AGE: Final[Ns] = SECOND // 20
"""An answer about the state may be this old (rule 20): building it costs as much as many grants."""
MAX_BUILT: Final = 4
"""Answers of one kind that are built within STATE_AGE, where the state changes."""


class _Built(NamedTuple):
    """An answer about the state, and after which batch of events it was built."""

    state: messages.RcmState
    encoded: bytes
    batches: int
    built: int
    """How many were built within STATE_AGE."""


class StateAnswers:
    def __init__(self, mesh: Mesh, leader: Leader, view: StateView) -> None:
        self._mesh, self._leader, self._view = mesh, leader, view
        self._states: dict[messages.StateAsk, _Built] = {}
        self._since: Ns = 0

    def answer(self, query: IncomingQuery[messages.StateAsk]) -> None:
        asked, now, seq = query.message, self._mesh.now(), self._leader.seq
        if asked.holds_only:
            query.answer(self._view.state(asked, seq, now))  # RCs reckon ends by it: never of an earlier instant
            return
        alike, batches = replace(asked, arc=None), self._leader.core.batches
        if now - self._since > STATE_AGE:
            self._since = now
            self._states.clear()
        known = self._states.get(alike)
        if known is None or (known.built < MAX_BUILT and known.batches != batches):
            state = self._view.state(alike, seq, now)
            built = 1 if known is None else known.built + 1
            known = self._states[alike] = _Built(state, messages.encode(state), batches, built)
        if asked.arc is None:
            query.answer(known.state, known.encoded)
        else:
            query.answer(replace(known.state, story=self._leader.registry.story(now, asked.arc)))

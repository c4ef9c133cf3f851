"""Votes of sharable RCs: proposals out, ballots in."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from functools import partial

from zscout.config.fleet import Fleet
from zscout.mesh import Mesh, MeshError, Reply
from zscout.mesh.supervision import Supervisor
from zscout.messages import Ballot, Proposal, ProposedHolder, decimals
from zscout.scheduling.core import Core
from zscout.scheduling.model import Propose, Vote, VoteOverdue
from zscout.services.rcm.registry import request_id
from zscout.types import SECOND, RcName

log = logging.getLogger(__name__)

LATE_VOTE = 2.0
"""Seconds within which a late vote still counts."""
MAX_REASON = 500


class Voting:
    """Asks RCs for their votes; each answer, and each that is overdue, is an event."""

    def __init__(
        self,
        mesh: Mesh,
        fleet: Fleet,
        core: Core,
        supervisor: Supervisor,
        emit: Callable[[Vote | VoteOverdue], None],
    ) -> None:
        self.mesh, self.core = mesh, core
        self._timeout = fleet.timing.vote_timeout / SECOND
        self._supervisor, self._emit = supervisor, emit
        self._voted = supervisor.guard(self._on_ballot)
        self._late = max(LATE_VOTE, 2 * self._timeout)

    def propose(self, effect: Propose) -> None:
        arcs = ((self.core.arc(arc), params) for arc, params in effect.holders.items())
        holders = [
            ProposedHolder(request_id(arc.id), arc.name, arc.request.client, decimals(params))
            for arc, params in arcs
            if arc is not None
        ]
        proposal = Proposal(proposal=effect.proposal, term=self.core.term, holders=holders)
        # Overdue once; an answer that comes before the query ends still counts.
        overdue = self._supervisor.call_later(self._timeout, self._emit, VoteOverdue(effect.proposal))
        voted = partial(self._voted, effect.rc, effect.proposal, overdue)
        try:
            self.mesh.ask_then(self.mesh.keys.vote(effect.rc), proposal, Ballot, voted, timeout=self._late)
        except MeshError as error:
            log.warning("%s", error)

    def _on_ballot(
        self, rc: RcName, proposal: int, overdue: asyncio.TimerHandle, reply: Reply[Ballot] | None
    ) -> None:
        overdue.cancel()
        ballot = reply.message if reply is not None else None
        if ballot is not None and ballot.proposal == proposal:
            self._emit(Vote(proposal, ballot.accept, ballot.reason[:MAX_REASON]))
            return
        if reply is not None and reply.problem is not None:
            log.warning("%s did not vote: %s", rc, reply.problem.message)
        self._emit(VoteOverdue(proposal))

"""A node's figures at one moment, of itself and as a leader."""

from __future__ import annotations

from zscout.config.node import Node
from zscout.mesh import Mesh
from zscout.services.metrics.figures import HoldFigures, Samples
from zscout.services.node.local_rcs import LocalRcs
from zscout.services.rcm.candidate import Candidate
from zscout.types import VERSION


class NodeFigures:
    """Read in the event loop, so that all figures are of one moment."""

    def __init__(self, node: Node, mesh: Mesh, rcs: LocalRcs) -> None:
        self._node, self._mesh, self._rcs = node, mesh, rcs
        self.candidate: Candidate | None = None
        self.holds = HoldFigures(node.fleet.access)

    def samples(self) -> Samples:
        found: Samples = {
            "zscout_info": {(self._node.fleet.name, self._mesh.me.host, VERSION): 1},
            "zscout_links": {(): self._mesh.links()},
            "zscout_unwell_seconds": {(rc.name,): rc.unwell_for for rc in self._rcs.controllers},
            "zscout_lost": {(rc.name,): int(rc.health != "ok") for rc in self._rcs.controllers},
            "zscout_commands_total": {(rc.name,): rc.tally.answered for rc in self._rcs.controllers},
            "zscout_commands_refused_total": {
                (rc.name, code): count for rc in self._rcs.controllers for code, count in rc.tally.refused().items()
            },
        }
        return found if self.candidate is None else found | self._of_candidate(self.candidate)

    def _of_candidate(self, candidate: Candidate) -> Samples:
        rcm = candidate.rcm
        found: Samples = {
            "zscout_leading": {(): int(rcm is not None)},
            "zscout_term": {(): candidate.known.counter},
            "zscout_terms_led_total": {(): candidate.terms_led},
            "zscout_refusals_total": {(code,): count for code, count in candidate.tally.refused().items()},
        }
        if rcm is not None:
            found["zscout_queue_length"] = {(): rcm.core.waiting}
        return found | self.holds.samples(self._mesh.now(), leading=rcm is not None)

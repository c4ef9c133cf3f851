"""The load balancer: load reports in, rankings out. It runs beside the leading RCM."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable
from contextlib import ExitStack
from typing import Final

from zscout.keyexpr import RANDOM, Role, Token, check_name
from zscout.mesh import IncomingQuery, Mesh
from zscout.mesh.supervision import Supervisor
from zscout.messages import HostRanking, KnownLoad, LoadReport, RankAsk
from zscout.placement.balancer import Balancer
from zscout.placement.model import RankQuery
from zscout.types import SECOND, HostName

log = logging.getLogger(__name__)

READ_EVERY: Final = 0.1
"""Seconds; the reports of a thousand hosts would else wake this loop a thousand times in each."""
AT_ONCE: Final = 32
"""Reports that are read between two other things that the loop has to do."""
DEPTH: Final = 4_096
"""Reports kept until they are read; of more the oldest are lost, and the next ones make up for them."""


class LoadBalancer:
    """Answers which hosts are best, until it is stopped or fails. What it knows of hosts comes from their
    reports alone, so a new leader's balancer knows all that report within a second."""

    def __init__(self, mesh: Mesh, on_failure: Callable[[Exception], object]) -> None:
        self.mesh = mesh
        self.core = Balancer(RANDOM.get())
        self._supervisor = Supervisor("the load balancer", on_failure)
        self._lost: set[HostName] = set()
        """Hosts that are gone: reports that they sent before, and that are not read yet, must not bring them
        back. Cleared once all of those are read."""
        self._declarations = ExitStack()

    def start(self) -> None:
        keys, mesh, guard = self.mesh.keys, self.mesh, self._supervisor.guard
        self._reports = mesh.poll_latest(keys.load_any, LoadReport, depth=DEPTH)
        for declared in (
            self._reports,
            mesh.watch(keys.alive_any(Role.LOAD), guard(self._on_reporter)),
            mesh.serve(keys.rank, RankAsk, guard(self._on_query)),
        ):
            self._declarations.callback(declared.close)
        self._supervisor.call_later(READ_EVERY, self._read)

    def stop(self) -> None:
        self._supervisor.cancel()
        self._declarations.close()

    def _read(self) -> None:
        """Reads a few reports at most: whatever else waits for this loop is done in between."""
        read = 0
        for key, report in itertools.islice(self._reports.each(), AT_ONCE):
            read += 1
            # A report is believed of the host in whose key it stands.
            try:
                if key == self.mesh.keys.load(report.host) and report.host not in self._lost:
                    self.core.reported(self.mesh.now(), report)
            except ValueError as error:
                log.debug("ignored a load report on %.200r: %s", key, error)
        if read < AT_ONCE:
            self._lost.clear()
        self._supervisor.call_later(0.0 if read == AT_ONCE else READ_EVERY, self._read)

    def _on_reporter(self, token: Token, alive: bool) -> None:
        if alive:
            self._lost.discard(token.host)
        else:
            self._lost.add(token.host)
            self.core.lost(token.host)

    def _on_query(self, query: IncomingQuery[RankAsk]) -> None:
        ask = query.message
        for host in ask.hosts or ():
            check_name(host, "host")
        now = self.mesh.now()
        ranking = self.core.rank(now, RankQuery.of(ask), ask.at_most)
        left_out = dict(itertools.islice(ranking.left_out.items(), ask.at_most))
        reports = None
        if ask.reports:
            named = [*(one.host for one in ranking.hosts), *left_out]
            known = (self.core.reports[host] for host in named if host in self.core.reports)
            reports = [KnownLoad((now - at) / SECOND, report) for at, report in known]
        query.answer(HostRanking(list(ranking.hosts), ranking.metric, ranking.why, left_out, ranking.more, reports))

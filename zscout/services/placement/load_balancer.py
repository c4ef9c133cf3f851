"""The load balancer beside the leading RCM: load reports in, rankings out."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable
from contextlib import ExitStack
from typing import Final

from zscout.keyexpr import RANDOM, Role, Token, check_name
from zscout.mesh import IncomingQuery, Lane, Mesh
from zscout.mesh.supervision import Supervisor
from zscout.messages import HostRanking, KnownLoad, LoadReport, RankAsk
from zscout.placement.balancer import Balancer
from zscout.placement.model import RankQuery
from zscout.types import SECOND, HostName

log = logging.getLogger(__name__)

READ_EVERY: Final = 0.1  # seconds; a thousand hosts' reports would otherwise wake this loop as often
AT_ONCE: Final = 32  # reports read before the loop does other work
DEPTH: Final = 4_096  # reports kept unread; the oldest are lost, and later ones replace them


class LoadBalancer:
    """Ranks hosts until stopped or failed. Load reports are its only state, so a new leader has it all within 1 s."""

    def __init__(self, mesh: Mesh, on_failure: Callable[[Exception], object]) -> None:
        self.mesh = mesh
        self.core = Balancer(RANDOM.get())
        self._supervisor = Supervisor("the load balancer", on_failure)
        self._lost: set[HostName] = set()  # gone, with unread reports that must not bring them back
        self._declarations = ExitStack()

    def start(self) -> None:
        keys, mesh, guard = self.mesh.keys, self.mesh, self._supervisor.guard
        self._reports = mesh.poll_latest(keys.load_any, LoadReport, depth=DEPTH)
        for declared in (
            self._reports,
            mesh.watch(keys.alive_any(Role.LOAD), guard(self._on_reporter)),
            *(
                mesh.serve(key, RankAsk, guard(self._on_query), lane=Lane.QUESTION)
                for key in (keys.rank, keys.rank_any)
            ),
        ):
            self._declarations.callback(declared.close)
        self._supervisor.call_later(READ_EVERY, self._read)

    def stop(self) -> None:
        self._supervisor.cancel()
        self._declarations.close()

    def _read(self) -> None:
        read = 0
        for key, report in itertools.islice(self._reports.each(), AT_ONCE):
            read += 1
            # A report must come from the host in its key.
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
        left_out = {host: str(why) for host, why in itertools.islice(ranking.left_out.items(), ask.at_most)}
        reports = None
        if ask.reports:
            named = [*(ranked.host for ranked in ranking.hosts), *left_out]
            known = (self.core.reports[host] for host in named if host in self.core.reports)
            reports = [KnownLoad((now - at) / SECOND, report) for at, report in known]
        query.answer(HostRanking(list(ranking.hosts), ranking.metric, ranking.why, left_out, ranking.more, reports))

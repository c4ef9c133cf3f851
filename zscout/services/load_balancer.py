"""The load balancer: load reports in, rankings out. It runs beside the leading RCM."""

from __future__ import annotations

import asyncio
import itertools
import logging
import random
from typing import Final

from zscout import clock
from zscout.balancing.balancer import Balancer
from zscout.balancing.model import Question, Report, Requirements, Use
from zscout.keyexpr import Role, Token, check_name
from zscout.mesh import Declared, Mesh, Request
from zscout.messages import HostRanking, LoadReport, RankAsk, RankedHost

log = logging.getLogger(__name__)

LOOK_EVERY: Final = 0.1
"""Seconds; the reports of a thousand hosts would else wake this loop a thousand times in each."""
HANDFUL: Final = 32
"""Reports that are taken in between two other things that the loop has to do."""
DEPTH: Final = 4_096
"""Reports kept between two looks; of more the oldest are lost, and the next ones make up for them."""
MIN_CORES: Final = 0.01
MIN_SPEED: Final = 1e-3
"""A host that reports less is slow, and no division by zero."""


class LoadBalancer:
    """Answers which host is the best, until stopped. What it knows of hosts comes from their reports alone,
    so a new leader's balancer knows all that report within a second."""

    def __init__(self, mesh: Mesh, rng: random.Random | None = None) -> None:
        self.mesh = mesh
        self.core = Balancer(rng or random.Random())  # noqa: S311 - lots and noise, not secrets
        self._lost: set[str] = set()
        """Hosts that are gone: what they sent before, and nobody has looked at yet, must not bring them back.
        Forgotten once all of that was looked at."""
        self._declared: list[Declared] = []

    def start(self) -> None:
        keys, mesh = self.mesh.keys, self.mesh
        self._reports = mesh.overhear(keys.load_any, LoadReport, depth=DEPTH)
        self._next = asyncio.get_running_loop().call_later(LOOK_EVERY, self._look)
        self._declared = [
            self._reports,
            mesh.watch(keys.alive_any(Role.LOAD), self._on_reporter),
            mesh.serve(keys.rank, RankAsk, self._on_asked),
        ]

    def stop(self) -> None:
        self._next.cancel()
        for declared in reversed(self._declared):
            declared.close()
        self._declared = []

    def _look(self) -> None:
        """Takes in a handful of reports at most: whatever else waits for this loop is done in between."""
        loop = asyncio.get_running_loop()
        taken = 0
        try:
            for key, report in itertools.islice(self._reports.each(), HANDFUL):
                taken += 1
                self._on_load(key, report)
        finally:
            more = taken == HANDFUL
            if not more:
                self._lost.clear()
            self._next = loop.call_later(0.0 if more else LOOK_EVERY, self._look)

    def _on_load(self, key: str, report: LoadReport) -> None:
        # A report is believed of the host in whose key it stands.
        try:
            if key == self.mesh.keys.load(report.host) and report.host not in self._lost:
                self.core.reported(clock.now(), report_of(report))
        except ValueError as error:
            log.debug("ignored a load report on %.200r: %s", key, error)

    def _on_reporter(self, token: Token, alive: bool) -> None:
        if alive:
            self._lost.discard(token.host)
        else:
            self._lost.add(token.host)
            self.core.lost(token.host)

    def _on_asked(self, request: Request[RankAsk]) -> None:
        asked = request.message
        for host in asked.hosts or ():
            check_name(host, "host")
        question = Question(
            kind=asked.kind,
            metric=asked.metric,
            policy=asked.policy,
            requirements=Requirements(frozenset(asked.labels), asked.memory),
            hosts=None if asked.hosts is None else frozenset(asked.hosts),
        )
        ranking = self.core.rank(clock.now(), question, asked.at_most)
        request.answer(
            HostRanking(
                hosts=[RankedHost(one.host, one.score, one.reason) for one in ranking.hosts],
                metric=ranking.metric,
                why=ranking.why,
                left_out=dict(itertools.islice(ranking.left_out.items(), asked.at_most)),
                more=ranking.more,
            )
        )


def report_of(told: LoadReport) -> Report:
    """A load report as the core has it."""
    return Report(
        host=told.host,
        number=told.number,
        cores=max(MIN_CORES, told.cores),
        load_average=told.load_average,
        cpu=told.cpu / 100,
        memory_available=told.memory_available,
        memory_total=told.memory_total,
        speed=max(MIN_SPEED, told.speed),
        clock=told.clock,
        clock_rated=told.clock_rated,
        temperature=told.temperature,
        labels=frozenset(told.labels),
        uses=tuple(
            Use(one.component, one.kind, one.incarnation, one.cpu, one.memory, one.served)
            for one in told.components
        ),
    )

"""A fleet in memory, in virtual time: real RCMs, and RCs and clients that speak the protocol and no more."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from decimal import Decimal
from pathlib import Path
from typing import Any

import msgspec

from tests.services.kit import MemoryFleet, answer
from tests.services.kit import Refusal as Refusal
from zscout.config.fleet import Fleet, default_fleet
from zscout.keyexpr import Role, Token
from zscout.mesh import IncomingQuery, Mesh, Refused
from zscout.messages import (
    Ask,
    Ballot,
    ClientRequests,
    Grants,
    Holder,
    Notice,
    OpenRequest,
    Operation,
    Parameter,
    Proposal,
    RcAsk,
    RcmState,
    RcState,
    RcView,
    Revocation,
    StateAsk,
)
from zscout.rcm.recovery import RecoveredState
from zscout.rcm.terms import BELIEVED, Verdict, Word
from zscout.services.rcm.candidate import Candidate, CandidateParts
from zscout.services.rcm.rcm import Rcm
from zscout.testing.memory import MemoryMesh
from zscout.types import NO_TERM, Grant, Place, Term


@dataclass
class FakeRc:
    """An RC that holds what is published, and votes as it is told to."""

    mesh: Mesh
    name: str
    instance: str = "i1"
    sharable: bool = False
    term: Term = NO_TERM
    seq: int = 0
    holders: list[Holder] = field(default_factory=list)
    leader: bool = False
    accept: bool | None = True
    """Its vote; None: not before it is told to `vote`."""
    unreadable: str = ""
    """Answer proposals with a holder of this name by an error."""
    proposals: list[Proposal] = field(default_factory=list)
    asked: list[RcAsk] = field(default_factory=list)
    rules: int = 0
    health: str = "ok"
    parameters: list[Parameter] | None = None
    deaf: bool = False
    """Whether it answers no question of its state."""
    ignored: list[IncomingQuery[RcAsk]] = field(default_factory=list)
    unanswered: list[IncomingQuery[Proposal]] = field(default_factory=list)

    def start(self) -> None:
        keys, mesh = self.mesh.keys, self.mesh
        self.publisher = mesh.publisher(keys.rc_state(self.name), RcState)
        mesh.subscribe(keys.grants, Grants, self._on_grants)
        mesh.serve(keys.rc_state(self.name), RcAsk, self._on_asked)
        mesh.serve(keys.vote(self.name), Proposal, self._on_proposal)
        self.token = mesh.alive(Token(mesh.me.host, Role.RC, self.name, self.instance))

    def state(self, **more: Any) -> RcState:
        return RcState(
            rc=self.name,
            host=self.mesh.me.host,
            instance=self.instance,
            sharable=self.sharable,
            term=self.term,
            seq=self.seq,
            holders=self.holders,
            leader=self.leader,
            rules=self.rules,
            parameters=self.parameters,
            **({"health": self.health} | more),
        )

    def publish(self, **more: Any) -> None:
        self.publisher.put(self.state(**more))

    @property
    def arcs(self) -> list[str]:
        return [holder.arc for holder in self.holders]

    def _on_grants(self, _key: str, grants: Grants) -> None:
        if grants.term >= self.term:
            self.term, self.seq = grants.term, grants.seq
            self.holders = grants.rcs.get(self.name, self.holders)

    def _on_asked(self, query: IncomingQuery[RcAsk]) -> None:
        self.asked.append(query.message)
        if self.deaf:
            self.ignored.append(query)  # who asks waits for as long as it can wait
            return
        promise = query.message.promise
        if promise is not None and promise < self.term:
            raise Refused("old_term", f"obeys term {self.term.counter}", self.term)
        self.term = promise or self.term
        query.answer(self.state())

    def _on_proposal(self, query: IncomingQuery[Proposal]) -> None:
        self.proposals.append(query.message)
        if any(holder.arc == self.unreadable for holder in query.message.holders):
            raise Refused("bad_request", "no such parameter: pace")
        self.unanswered.append(query)
        if self.accept is not None:
            self.vote(self.accept)

    def vote(self, accept: bool) -> None:
        for query in self.unanswered:
            query.answer(Ballot(query.message.proposal, accept, "" if accept else "too much"))
        self.unanswered.clear()


@dataclass
class FakeClient:
    """A program that asks, and keeps all that it hears."""

    mesh: Mesh
    log: list[tuple[str, str, str]]
    """(who, what, state) in the order in which it arrived, of all clients of a fleet."""
    notices: list[Notice] = field(default_factory=list)
    open: list[OpenRequest] = field(default_factory=list)

    def start(self) -> None:
        keys, mesh = self.mesh.keys, self.mesh
        mesh.subscribe(keys.notice(mesh.me), Notice, self._on_notice)
        mesh.serve(keys.requests(mesh.me), RcAsk, self._on_asked)
        self.token = mesh.alive(Token(mesh.me.host, Role.CLIENT, mesh.me.client, "i1"))

    @property
    def name(self) -> str:
        return str(self.mesh.me)

    def _on_notice(self, _key: str, notice: Notice) -> None:
        self.notices.append(notice)
        self.log.append((self.mesh.me.client, "notice", f"{notice.arc} {notice.state}"))

    def _on_asked(self, query: IncomingQuery[RcAsk]) -> None:
        query.answer(ClientRequests(self.name, self.open))

    async def do(self, operation: Operation) -> Notice:
        """The answer to an operation. Raises Refusal."""
        notice = await answer(self.mesh, self.mesh.keys.schedule(self.mesh.me), operation, Notice)
        self.log.append((self.mesh.me.client, "answer", f"{notice.arc} {notice.state}"))
        return notice

    async def ask(self, arc: str, *needs: str, **more: Any) -> Notice:
        return await self.do(request(arc, *needs, **more))


def request(
    arc: str, *needs: str, priority: int = 0, seconds: float = 60, place: Place | None = None, **more: Any
) -> Ask:
    """An Ask whose id is the ARC's name; needs as `radio/rf0:5`, with a command rate."""
    told = [need.partition(":") for need in needs]
    rates: dict[str, dict[str, Decimal]] = {rc: {"command_rate": Decimal(rate)} if rate else {} for rc, _, rate in told}
    return Ask(arc, arc, rates, priority, Decimal(str(seconds)), place=place, **more)


class FakeFleet(MemoryFleet):
    """`published`: what was published on `rcm/grants`, without heartbeats."""

    def __init__(self, *candidates: str, strategy: str = "priority", closed: bool = False) -> None:
        super().__init__(closed=closed)
        self.fleet: Fleet = msgspec.structs.replace(default_fleet(), candidates=candidates, strategy=strategy)
        self.log: list[tuple[str, str, str]] = []
        self.published: list[Grants] = []
        self.newer: list[Term] = []
        self.watcher.subscribe(self.watcher.keys.grants, Grants, self._on_grants)

    @property
    def revoked(self) -> list[Revocation]:
        return [revoked for grants in self.published for revoked in grants.revoked]

    def _on_grants(self, _key: str, grants: Grants) -> None:
        if grants.rcs or grants.revoked:
            self.published.append(grants)
            self.log.append(("all", "grants", " ".join(sorted(grants.rcs))))

    def _on_newer(self, word: Word) -> Verdict:
        self.newer.append(word.term)
        return BELIEVED

    def rcm(self, counter: int = 1, recovered: RecoveredState | None = None) -> Rcm:
        """A leader without a candidate, on a host of its own."""
        mesh = self.mesh("leader")
        term = Term(counter, "rcm")
        rcm = Rcm(mesh, self.fleet, term, self._on_newer, self.failures.append)
        rcm.start(recovered or RecoveredState())
        return rcm

    def candidate(self, host: str, folder: Path | None = None, **how: Any) -> Candidate:
        candidate = Candidate(self.mesh(host), self.fleet, CandidateParts(folder, **how))
        candidate.start()
        return candidate

    def rc(self, name: str, **how: Any) -> FakeRc:
        rc = FakeRc(self.mesh("devices", name.replace("/", "-")), name, sharable=name.startswith("radio"), **how)
        rc.start()
        return rc

    def client(self, name: str, host: str = "desk") -> FakeClient:
        client = FakeClient(self.mesh(host, name), self.log)
        client.start()
        return client

    async def state(self, **asked: Any) -> RcmState:
        return await answer(self.watcher, self.watcher.keys.rcm_state, StateAsk(**asked), RcmState, timeout=1)

    async def joined(self, *rcs: FakeRc) -> None:
        """Waits until the leader counts these RCs as there."""
        names = {rc.name for rc in rcs}
        async with asyncio.timeout(10):
            while not names <= {view.rc for view in (await self.state()).rcs if view.present}:  # noqa: ASYNC110
                await asyncio.sleep(0.001)


async def fleet_of(*rcs: str) -> tuple[FakeFleet, list[FakeRc]]:
    """A fleet whose leader counts these RCs as there."""
    fleet = FakeFleet()
    fleet.rcm()
    found = [fleet.rc(rc) for rc in rcs]
    await fleet.joined(*found)
    return fleet, found


def there(candidate: Candidate) -> set[str]:
    """The RCs that this leader counts as there; none where it does not lead."""
    return {rc.name for rc in candidate.rcm.core.status().rcs if rc.present} if candidate.rcm is not None else set()


async def sees(mesh: MemoryMesh, rc: str, **wanted: Any) -> RcView:
    """Waits until the leader that is seen from here says so of the RC."""
    view: RcView | None = None
    try:
        async with asyncio.timeout(60):
            while view is None or any(getattr(view, name) != value for name, value in wanted.items()):
                await asyncio.sleep(0.05)
                reply = await mesh.ask_one(mesh.keys.rcm_state, StateAsk(), RcmState, timeout=1)
                views = reply.message.rcs if reply is not None and reply.message is not None else []
                view = next((view for view in views if view.rc == rc), None)
    except TimeoutError:
        raise AssertionError(f"waited in vain for {wanted}; last {view}") from None
    return view


def grant_of(notice: Notice) -> Grant:
    assert notice.state == "running", notice
    assert notice.grant is not None
    return notice.grant

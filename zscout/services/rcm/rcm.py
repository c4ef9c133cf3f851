"""The leading RCM on the mesh: turns messages into stimuli, gives each burst of them to the leader as one step
(`zscout/rcm/leader.py`), and carries out its Outbox in order.

Nothing is decided here."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from itertools import count
from typing import NamedTuple

from msgspec import Struct

from zscout import messages, trace
from zscout.config.fleet import Fleet
from zscout.keyexpr import Role, Token, client_of
from zscout.mesh import Declaration, IncomingQuery, Lane, Mesh, MeshError, Refused, Reply, Tally
from zscout.mesh.sparse_log import SparseLog
from zscout.mesh.supervision import Alarm, StallWatch, Supervisor
from zscout.rcm import steps
from zscout.rcm.admission import Admission
from zscout.rcm.authority import Authority
from zscout.rcm.device_check import DeviceCheck
from zscout.rcm.leader import Leader
from zscout.rcm.places import Places
from zscout.rcm.recovery import RecoveredState
from zscout.rcm.roster import Roster
from zscout.rcm.state_view import MAX_REASON, StateView
from zscout.rcm.steps import BookedDanger, Keep, Question, Ticket
from zscout.rcm.terms import Verdict, Word
from zscout.scheduling.core import Core
from zscout.scheduling.model import Vote, VoteOverdue
from zscout.scheduling.runtimes import RuntimeEstimator
from zscout.scheduling.strategies import STRATEGIES
from zscout.services.bookings.keeper import BookingKeeper
from zscout.services.rcm.booking_sharing import BookingSharing
from zscout.services.rcm.bookings import Bookings, bookings_of
from zscout.services.rcm.digest import HoldDigest, HoldListener
from zscout.services.rcm.inventory import Inventory
from zscout.types import SECOND, HostName, RcName, Term

log = logging.getLogger(__name__)

LATE_VOTE_S = 2.0
"""Seconds within which a late vote still counts."""


class Parts(NamedTuple):
    inventory: Inventory | None = None
    authority: Authority | None = None
    places: Places | None = None
    listeners: Sequence[HoldListener] = ()
    """Notified of holds."""
    tally: Tally | None = None
    """Counts the results of operations."""
    keeper: BookingKeeper | None = None
    kept: Sequence[messages.BookingsKept] = ()
    """The answers of other keepers to the takeover."""
    runtimes: RuntimeEstimator | None = None
    """Observed durations of holds, for forecasts."""
    on_disbelieved: Callable[[RcName, Term], object] = lambda *_: None
    """Called when no RC has joined, and an RC obeys a term so low that it considers this term absurd."""
    on_danger: Callable[[BookedDanger], object] = lambda _: None
    """Called with dangers of bookings that persist."""
    on_drained: Callable[[frozenset[HostName]], object] = lambda _: None
    """Called with the hosts in maintenance when they change."""


class Rcm:
    """One term of an RCM. When a task fails, `on_failure` is called once: the caller must then end the term."""

    def __init__(
        self,
        mesh: Mesh,
        fleet: Fleet,
        term: Term,
        on_newer: Callable[[Word], Verdict],
        on_failure: Callable[[Exception], object],
        parts: Parts | None = None,
    ) -> None:
        self._parts = parts = parts or Parts()
        self.mesh, self.fleet, self._on_newer = mesh, fleet, on_newer
        self.supervisor = Supervisor(f"the RCM of term {term.counter}", on_failure)
        authority = parts.authority or Authority(fleet)
        core = Core(STRATEGIES[fleet.strategy](), authority.bound(fleet.scheduling))
        admission = Admission(authority, parts.places or Places(fleet.name, None, term))
        self.inventory = parts.inventory or Inventory(mesh, fleet)
        devices, me, now = self.inventory.devices, mesh.me.host, mesh.now()
        roster = Roster(mesh.keys, me, fleet, term, devices, admission, core.arc, now)
        device_check = DeviceCheck(devices, roster, now + fleet.timing.hold_lease)
        keeper = parts.keeper or BookingKeeper(mesh)
        bookings = bookings_of(fleet, core, admission, device_check, keeper, parts.kept, parts.runtimes)
        self.sharing = BookingSharing(mesh, term, keeper, bookings, authority, self.supervisor, self._take)
        self.leader = Leader(fleet, core, admission, roster, device_check, bookings, parts.runtimes)
        self._view = StateView(me, core, roster, self.leader.registry, devices, parts.runtimes)
        self._digest = HoldDigest(core, parts.listeners) if parts.listeners else None
        self._grants = mesh.publisher(mesh.keys.grants, messages.Grants)
        self._strange = SparseLog(log, mesh.now)
        self._stall = StallWatch(mesh.now)
        self._stalled = steps.Stalled(0, 0, fresh=False)
        self._coming: list[steps.Stimulus] = []
        """The stimuli of the present burst."""
        self._running = False
        self._open: dict[Ticket, IncomingQuery[messages.Operation]] = {}
        """Operations without an answer yet."""
        self._tickets = count(1)
        self._declared: list[Declaration] = []
        self._alarm = Alarm(mesh.now, self.supervisor, self._on_alarm)

    @property
    def core(self) -> Core:
        return self.leader.core

    @property
    def roster(self) -> Roster:
        return self.leader.roster

    @property
    def term(self) -> Term:
        return self.leader.term

    @property
    def seq(self) -> int:
        """The number of the last publication."""
        return self.leader.seq

    @property
    def bookings(self) -> Bookings:
        return self.sharing.bookings

    async def enter(self) -> None:
        """Give the core all dates before the term begins, in parts between which other tasks run."""
        for part in self.bookings.dates.parts():
            self.core.handle(self.mesh.now(), part)
            await asyncio.sleep(0)

    def start(self, recovered: RecoveredState) -> None:
        """Begin to lead. Only a leader makes the declarations that are made here."""
        keys, mesh, guard = self.mesh.keys, self.mesh, self.supervisor.guard
        if self._parts.inventory is None:
            self.inventory.start(self.supervisor)
        self._stall.start()
        self._take_now(steps.Lead(recovered))
        self._declared = [
            mesh.serve(
                keys.schedule_any,
                messages.Operation,
                guard(self._on_operation),
                limit=self.fleet.limits.max_payload,
                tally=self._parts.tally,
                concerns=self._concerns,
            ),
            *(
                mesh.serve(key, messages.StateAsk, guard(self._on_state_asked), lane=Lane.QUESTION)
                for key in (keys.rcm_state, keys.rcm_state_any)
            ),
            mesh.subscribe(keys.rc_state_any, messages.RcState, guard(self._on_rc_state)),
            mesh.watch(keys.alive_any(Role.CLIENT), guard(self._on_token)),
            mesh.watch(keys.alive_any(Role.RC), guard(self._on_token)),
            mesh.alive(Token(mesh.me.host, Role.RCM, mesh.me.client, self.term.rcm)),
        ]
        self.sharing.start()
        self.supervisor.spawn(self._send_heartbeats())

    def stop(self) -> None:
        """Stop leading. Nothing is revoked: holds and requests remain for the next RCM."""
        if self._digest is not None:
            self._digest.close(self.mesh.now())
        for declared in reversed(self._declared):
            declared.close()
        self._stall.stop()
        self.supervisor.cancel()
        if self._parts.inventory is None:
            self.inventory.stop()
        if text := self.leader.registry.close(self.mesh.now()):
            log.info("%s", text)
        self.sharing.close()
        queries, self._open = self._open, {}
        for query in queries.values():
            query.refuse(Refused("not_leading", "this manager stopped leading; try again").problem)
        self._grants.close()

    def on_reload(self) -> None:
        self._take_now(steps.Reloaded())

    def _note_stall(self) -> None:
        """Report a new stall of this process, before the leader judges tokens and answers."""
        stalled = steps.Stalled(self._stall.length, self._stall.ended, self._stall.fresh())
        if stalled != self._stalled:
            self._stalled = stalled
            self._coming.append(stalled)

    def _take(self, stimulus: steps.Stimulus) -> None:
        first = not self._coming
        if not isinstance(stimulus, steps.OperationAsked):
            self._note_stall()
        self._coming.append(stimulus)
        if first:
            self.mesh.after_burst(self._run)

    def _take_now(self, stimulus: steps.Stimulus) -> None:
        self._coming.append(stimulus)
        self._run()

    def _concerns(self, query: IncomingQuery[messages.Operation]) -> tuple[Lane, str]:
        """Dry runs and slots are questions; operations on another host's request wait behind its surplus."""
        operation, host = query.message, self.mesh.keys.sender_of(query.key).host
        if isinstance(operation, (messages.Foresee, messages.FindSlots)):
            return Lane.QUESTION, host
        owner = operation.client if isinstance(operation, (messages.Cancel, messages.Release)) else None
        return Lane.ASK, host if owner is None else client_of(owner).host

    def _on_operation(self, query: IncomingQuery[messages.Operation]) -> None:
        ticket = next(self._tickets)
        self._open[ticket] = query
        self._take(steps.OperationAsked(ticket, self.mesh.keys.sender_of(query.key), query.message))

    def _on_state_asked(self, query: IncomingQuery[messages.StateAsk]) -> None:
        query.answer(*self._view.answer(query.message, self.seq, self.mesh.now()))

    def _on_rc_state(self, key: str, state: messages.RcState) -> None:
        if self.mesh.keys.rc_of(key) == state.rc:
            self._take(steps.Reported(state))

    def _on_token(self, token: Token, alive: bool) -> None:
        self._take(steps.TokenSeen(token, alive))

    def _on_alarm(self) -> None:
        self._note_stall()
        self._run()

    def _run(self) -> None:
        """Run steps until no stimuli are left."""
        if self._running:
            return  # the running call takes new stimuli once this Outbox is carried out
        self._running = True
        try:
            more = self.supervisor.active
            while more:
                stimuli, self._coming = self._coming, []
                for out in self.leader.step(self.mesh.now(), stimuli):
                    if not self._carry_out(out):
                        return
                    more = out.more or bool(self._coming)
        except Exception as error:  # noqa: BLE001 - it is logged there
            self.supervisor.fail(error)
        finally:
            self._running = False

    def _carry_out(self, out: steps.Outbox) -> bool:
        """Carry out the Outbox's fields in their order. Return False if this leader stepped down."""
        mesh, supervisor = self.mesh, self.supervisor
        self._answer(out.at_once)
        for word, token in out.higher:
            verdict = self._on_newer(word)
            if token is not None and verdict.absent_until:
                self._take(steps.Shunned(token, verdict.absent_until))
        for rc, term in out.disbelieved:
            self._parts.on_disbelieved(rc, term)
        if not supervisor.active:
            return False
        self._answer(out.granted)
        self._notify(out.grant_notices)
        self._trace(out.reopened)
        if out.publication is not None:
            self._publish(out.publication)
        if not out.last:
            return True
        self._notify(out.notices)
        self._answer(out.answers)
        for proposed in out.proposals:
            self._propose(proposed)
        for question in out.questions:
            supervisor.spawn(self._ask(question))
        for sign, so in out.suspicions:
            mesh.suspicions.suspect(sign, so=so)
        self.sharing.share_soon(out.changed)
        for keep in out.keep:
            supervisor.spawn(self._keep(keep))
        for danger in out.dangers:
            state = "has lapsed" if danger.over else "is in danger"
            words = f"{state}: {danger.why}" if danger.why else "is safe again"
            log.warning("booking %s of %s %s", danger.record.name, danger.record.owner, words)
            self._parts.on_danger(danger)
        for drained in out.drained[-1:]:
            self._parts.on_drained(drained)
        for text in out.log:
            log.info("%s", text)
        for subject, text in out.strange:
            self._strange.warning(subject, "%s", text)
        for rc, host in out.duplicates:
            log.warning("duplicate device %s at %s; another host's is used", rc, host)
        if self._digest is not None and (out.effects or out.events):
            # All answers of the instant are sent by now.
            self._digest.take(mesh.now(), out.events, out.effects, self.leader.registry.first_estimates)
        self._trace(out.over)
        self._alarm.set(out.wake)
        return True

    def _answer(self, answers: Iterable[tuple[Ticket, Struct]]) -> None:
        for ticket, message in answers:
            if (query := self._open.pop(ticket, None)) is not None:
                query.end(message)

    def _notify(self, notices: Iterable[messages.Notice]) -> None:
        for notice in notices:
            self.mesh.put(self.mesh.keys.notice(client_of(notice.client)), notice)

    def _publish(self, grants: messages.Grants) -> None:
        if (grants.rcs or grants.revoked) and trace.enabled():
            holders = {
                rc: [
                    (held.grant, f"{held.client}/{held.id}", held.place, held.rcs, held.remaining, held.protected_from)
                    for held in holders
                ]
                for rc, holders in grants.rcs.items()
            }
            ends = [(revoked.grant, revoked.outcome) for revoked in grants.revoked]
            what = {"term": self.term, "seq": grants.seq, "rcs": holders, "instances": grants.instances, "ends": ends}
            trace.write(self.mesh.now(), "publish", **what)
        self._grants.put(grants)

    def _trace(self, did: Iterable[tuple[str, str]]) -> None:
        if did and trace.enabled():
            for what, arc in did:
                trace.write(self.mesh.now(), what, term=self.term, arc=arc)

    async def _ask(self, asked: Question) -> None:
        if asked.kind is None:
            self._take(steps.TokensFound(asked, await self.mesh.living(asked.key, timeout=asked.timeout)))
            return
        reply = await self.mesh.ask_one(asked.key, asked.message, asked.kind, timeout=asked.timeout)
        message, problem = (None, None) if reply is None else (reply.message, reply.problem)
        self._take(steps.QuestionAnswered(asked, message, problem))

    async def _keep(self, keep: Keep) -> None:
        record = self.bookings.record(keep.booking)
        why = await self.sharing.keep(record) if record is not None else ""
        self._take(steps.Kept(keep, why))

    async def _send_heartbeats(self) -> None:
        """Publish a heartbeat whenever nothing was published for its period."""
        while True:
            due = self.leader.published + self.fleet.timing.heartbeat - self.mesh.now()
            if due > 0:
                await asyncio.sleep(due / SECOND)
            else:
                self._publish(self.leader.heartbeat(self.mesh.now()))

    def _propose(self, proposed: steps.Proposed) -> None:
        rc, proposal = proposed
        vote_timeout = self.fleet.timing.vote_timeout / SECOND
        # The vote is overdue before the query ends, and still counts if it arrives before that.
        over = steps.CoreEvents([VoteOverdue(proposal.proposal)])
        overdue = self.supervisor.call_later(vote_timeout, self._take_now, over)
        voted = partial(self.supervisor.guard(self._on_ballot), rc, proposal.proposal, overdue)
        late = max(LATE_VOTE_S, 2 * vote_timeout)
        try:
            self.mesh.ask_then(self.mesh.keys.vote(rc), proposal, messages.Ballot, voted, timeout=late)
        except MeshError as error:
            log.warning("%s", error)

    def _on_ballot(
        self, rc: RcName, proposal: int, overdue: asyncio.TimerHandle, reply: Reply[messages.Ballot] | None
    ) -> None:
        overdue.cancel()
        self.mesh.suspicions.suspect(f"{rc} is seen and does not vote", so=reply is None)
        ballot = reply.message if reply is not None else None
        if ballot is not None and ballot.proposal == proposal:
            self._take(steps.CoreEvents([Vote(proposal, ballot.accept, ballot.reason[:MAX_REASON])]))
            return
        problem = reply.problem if reply is not None else None
        if problem is not None and problem.code == "bad_request":
            # As overdue, one request that the RC can't read would keep all others from the RC.
            self._take(steps.CoreEvents([Vote(proposal, False, problem.message[:MAX_REASON])]))
            return
        if problem is not None:
            log.warning("%s did not vote: %s", rc, problem.message)
        self._take(steps.CoreEvents([VoteOverdue(proposal)]))

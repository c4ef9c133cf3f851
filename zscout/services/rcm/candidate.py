"""A node's candidacy for the RCM: watches for a leader, and takes over when there is none.

Takeover: ask the RCs if they still see a leader; take a term above all known terms; ask all RCs and clients for their
holds and requests, which binds the RCs to the new term; lead with the recovered state. When anything fails, a candidate
withdraws its tokens, so that others take over, and becomes a candidate again after a while."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple, TypeVar

from zscout.config.fleet import Fleet
from zscout.keyexpr import RANDOM, BadName, Role, Sender, Token, client_of, new_instance
from zscout.mesh import Mesh, Reply, Tally
from zscout.mesh.supervision import StallWatch, Supervisor, done_within
from zscout.mesh.terms import LastTerms
from zscout.messages import (
    MAX_COUNTER,
    BookingsKept,
    ClientRequests,
    Grants,
    RcAsk,
    RcState,
    ShareBookings,
    absurd,
    disbelieved,
)
from zscout.rcm.admission import Admission
from zscout.rcm.authority import Authority
from zscout.rcm.places import Places
from zscout.rcm.recovery import aged, take_over
from zscout.rcm.steps import BookedDanger
from zscout.rcm.terms import Source, Terms, Verdict, Word
from zscout.services.bookings.keeper import BookingKeeper
from zscout.services.journal.journal import Journal
from zscout.services.placement.component_placer import ComponentPlacer
from zscout.services.placement.ledger import PlacementLedger
from zscout.services.placement.load_balancer import LoadBalancer
from zscout.services.rcm.booking_sharing import credible
from zscout.services.rcm.digest import HoldListener
from zscout.services.rcm.election import LEADER_WAIT, Election, Setbacks, views
from zscout.services.rcm.inventory import Inventory
from zscout.services.rcm.learned import Learned
from zscout.services.rcm.observed_runtimes import RuntimeObserver
from zscout.services.rcm.rcm import Parts, Rcm
from zscout.services.rcm.term_file import KeptTerm, TermDisk
from zscout.types import NO_TERM, SECOND, HostName, Ns, RcName, Term

log = logging.getLogger(__name__)

R = TypeVar("R")

UNSEEN = "RCs of other hosts see an RCM, and this candidate does not"


class CandidateParts(NamedTuple):
    folder: Path | None = None
    """The folder for facts that outlive a restart."""
    authority: Authority | None = None
    places_key: bytes | None = None
    """The key with which the managers of a fleet seal places."""
    listeners: Sequence[HoldListener] = ()
    """Notified of holds while it leads."""
    journal: Journal | None = None
    """Receives all believed publications."""
    runtimes: RuntimeObserver | None = None
    keeper: BookingKeeper | None = None
    """Stores bookings; without a keeper they are in memory only."""
    disk: TermDisk | None = None
    """Stores the highest term of a fleet with `[security]`."""
    on_danger: Callable[[BookedDanger], object] = lambda _: None
    """Called while it leads, with bookings that may not be kept."""


class _Candidacy(NamedTuple):
    """The time from a start to its failure, or to the end of the node."""

    supervisor: Supervisor
    last_terms: LastTerms
    stall: StallWatch
    declared: ExitStack
    """Undeclares everything that the candidacy declared."""


class Candidate:
    """Waits, leads when there is no leader, steps down when a higher term is seen or anything fails."""

    def __init__(self, mesh: Mesh, fleet: Fleet, parts: CandidateParts | None = None) -> None:
        self._parts = parts = parts or CandidateParts()
        keeper, runtimes = parts.keeper or BookingKeeper(mesh), parts.runtimes or RuntimeObserver()
        self.learned = Learned(keeper, runtimes, parts.journal)
        self._authority = parts.authority or Authority(fleet)
        self.mesh, self.fleet = mesh, fleet
        disk = parts.disk if mesh.keys.closed else None
        self.terms = Terms(secured=mesh.keys.closed, highest=NO_TERM if disk is None else disk.read())
        self._kept = KeptTerm(disk, self.terms)
        self.rcm: Rcm | None = None
        self.balancer: LoadBalancer | None = None
        self.placer: ComponentPlacer | None = None
        """Balancer and placer run beside the RCM, while this node leads."""
        self.terms_led = 0
        self.tally = Tally()
        """Counts the results of operations at its RCMs."""
        self.ledger = PlacementLedger(mesh)
        self._authority.placed = self.ledger.placements
        self.inventory = Inventory(mesh, fleet, parts.folder)
        self._leading = ExitStack()
        """Ends the RCM, load balancer and placer when this node stops leading."""
        self._changed = asyncio.Event()
        self._setbacks = Setbacks()
        self._again: asyncio.TimerHandle | None = None

    @property
    def known(self) -> Term:
        """The highest believed term."""
        return self.terms.highest

    @property
    def _timeout(self) -> float:
        return self.fleet.timing.rebuild / SECOND

    async def stop(self) -> None:
        if self._again is not None:
            self._again.cancel()
        self._withdraw()
        await self._candidacy.supervisor.close()

    def start(self) -> None:
        """Become a candidate, the first time or again: others see its token from now on."""
        keys, mesh = self.mesh.keys, self.mesh
        self._again, now, silence = None, mesh.now(), self.fleet.silence
        self._setbacks.began(now)
        self.election = Election(mesh.me.host, self.fleet.candidates, silence=silence, now=now)
        supervisor, stall, declarations = Supervisor("the candidate", self._failed), StallWatch(mesh.now), ExitStack()
        last_terms = LastTerms(mesh, supervisor, self._learn, timeout=self._timeout)
        self._candidacy = _Candidacy(supervisor, last_terms, stall, declarations)
        guard = supervisor.guard
        try:
            stall.start()
            declarations.callback(stall.stop)
            for service in (self.ledger, self.inventory, self.learned.keeper):
                declarations.callback(service.stop)
                service.start(supervisor)
            for declared in (
                mesh.subscribe(keys.grants, Grants, guard(self._on_grants)),
                mesh.watch(keys.alive_any(Role.RCM), guard(self._on_leader)),
                mesh.watch(keys.alive_any(Role.CANDIDATE), guard(self._on_candidate)),
                mesh.alive(Token(mesh.me.host, Role.CANDIDATE, mesh.me.client, new_instance())),
            ):
                declarations.callback(declared.close)
            supervisor.spawn(self._run())
        except Exception as error:  # noqa: BLE001 - it is logged there
            supervisor.fail(error)

    def on_reload(self, fleet: Fleet) -> None:
        """The rights, limits or devices of the fleet file have changed."""
        self.inventory.devices.declare(fleet.devices)
        if self.rcm is not None:
            self.rcm.on_reload()

    def _failed(self, _: Exception) -> None:
        """Withdraw, and become a candidate again after a while."""
        if self._again is not None:
            return
        delay = self._setbacks.delay(self.mesh.now())
        log.error("this candidate withdraws, and returns in %g s", delay)
        self._again = asyncio.get_running_loop().call_later(delay, self.start)
        self._withdraw()

    def _withdraw(self) -> None:
        self._candidacy.supervisor.cancel()
        with self._candidacy.declared.pop_all():
            self._stop_leading()

    def _stop_leading(self) -> None:
        self.rcm = self.balancer = self.placer = None
        self._leading.close()

    def _on_grants(self, _key: str, grants: Grants) -> None:
        known = grants.term == self.known and (self.rcm is None or self.rcm.term == self.known)
        if known or self._weigh(Word(grants.term, Source.LEADER)).believed:
            self.terms.led(grants.term, self.mesh.now())
            self.election.published(grants.term, self.mesh.now())
            self.learned.hear(self.mesh.now(), grants)

    def _on_leader(self, token: Token, alive: bool) -> None:
        if self.rcm is None or token.instance != self.rcm.term.rcm:
            log.info("%s %s", token.host, "leads" if alive else "does not lead any more")
        if alive:
            self.mesh.suspicions.suspect(UNSEEN, so=False)
        self.election.leader(token.instance, token.host, alive=alive, now=self.mesh.now())
        self._changed.set()

    def _on_candidate(self, token: Token, alive: bool) -> None:
        self.election.candidate(token.host, alive=alive, now=self.mesh.now())
        self._changed.set()

    def _weigh(self, word: Word) -> Verdict:
        """Judge evidence of a term. A leader steps down if it believes a higher term than its own."""
        now, before = self.mesh.now(), self.known
        heard = self.rcm is not None or self.election.heard_within(self.fleet.timing.hold_lease, now)
        verdict = self.terms.weigh(word, now, heard=heard)
        if verdict.last:
            self._candidacy.last_terms.shown(word.term, before)
        if verdict.why:
            log.warning("%s", verdict.why)
        if verdict.believed and self.known > before and self._kept.is_due:
            self._candidacy.supervisor.spawn(self._kept.keep())
        if verdict.believed and self.rcm is not None and word.term > self.rcm.term:
            led = word.source is Source.LEADER or not self.terms.secured
            self._step_down(f"term {word.term.counter} of another RCM is above {self.rcm.term.counter}", led=led)
        return verdict

    def _disbelieved(self, rc: RcName, term: Term) -> None:
        """Step down: the own RCM has no RC, and an RC of another leader considers its term absurd."""
        if self.rcm is not None:
            self._step_down(f"{rc} hears an RCM of term {term.counter}, and does not believe {self.rcm.term.counter}")

    def _step_down(self, why: str, *, led: bool = True) -> None:
        """`led`: the higher term is known to have a leader, or may have one."""
        log.warning("stepping down: %s", why)
        self.election.deposed(self.mesh.now(), RANDOM.get().uniform(0.7, 1.3), led=led)
        self._stop_leading()
        self._changed.set()

    def _learn(self, term: Term) -> None:
        self.terms.highest = max(self.known, term)

    async def _run(self) -> None:
        while True:
            self._changed.clear()
            now = self.mesh.now()
            at = self.election.next_try(now) if self.rcm is None else None
            if at is not None and at <= now:
                if await self._leader_elsewhere() or not await self._take_over():
                    self.election.failed(self.mesh.now())
                continue
            await done_within(None if at is None else (at - now) / SECOND, self._changed.wait())

    async def _leader_elsewhere(self) -> bool:
        """Return True if RCs still see a leader: this candidate is cut off; or if they promised a term to another
        candidate, which may be about to lead."""
        if self._candidacy.stall.fresh():
            self.election.stalled(self.mesh.now())
        keys, tokens = self.mesh.keys, list[Token]()
        asked = self.mesh.ask(keys.rc_state_any, RcAsk(), RcState, timeout=self._timeout)
        if self.terms.secured:
            seen = self.mesh.living(keys.alive_any(Role.RC), timeout=self._timeout)
            replies, tokens = await asyncio.gather(asked, seen)
        else:
            replies = await asked
        states = [state for state, _ in self._credible(replies, lambda state: keys.rc_state(state.rc))]
        before = self.known
        heard = self._weigh_rcs(states, tokens)
        if self.known > before:
            self.election.outbid(self.mesh.now())
            return True
        states, now = [state for _, state in heard], self.mesh.now()
        self.terms.goes_above |= await self._has_absurd_term(states)
        others, own = views(((host, state.leader) for host, state in heard), self.mesh.me.host)
        if self.terms.secured and self._is_disbelieved(others, heard, now):
            others = dict.fromkeys(others, False)
        if self.election.must_wait(others, own, now):
            log.info("%d of %d other hosts still see a leader: waiting", sum(others.values()), len(others))
            if sum(others.values()) * 2 > len(others):
                self.mesh.suspicions.suspect(UNSEEN, patience=LEADER_WAIT / SECOND)
            return True
        return False

    def _is_disbelieved(self, others: Mapping[HostName, bool], heard: list[tuple[HostName, RcState]], now: Ns) -> bool:
        """Return True if only one other host answers, and no other evidence of the leader that it shows appeared."""
        if self.election.waited_in_vain(others, now):
            [host] = others
            if host and not self.terms.doubted_until(host, now):
                log.warning("no longer waiting for a leader: only %s shows one", host)
                self.terms.doubt(host, max(state.term for at, state in heard if at == host), now)
            return True
        return len(others) == 1 and all(self.terms.is_doubted(host, now, self.fleet.silence) for host in others)

    def _weigh_rcs(self, states: list[RcState], tokens: list[Token]) -> list[tuple[HostName, RcState]]:
        """Judge the terms of RCs. Return the RCs that do not count as absent for their terms, with their hosts; with
        `[security]` their tokens' hosts."""
        seen = {(token.host, token.name, token.instance) for token in tokens}
        now, silence = self.mesh.now(), self.fleet.silence
        heard = list[tuple[HostName, RcState]]()
        for state in states:
            proven = state.host if (state.host, state.rc, state.instance) in seen else ""
            absent = self._weigh(Word(state.term, Source.RC, state.rc, proven)).absent_until
            if not absent and not self.terms.is_led_nowhere(state.term, proven, now, silence):
                heard.append((proven if self.terms.secured else state.host, state))
        return heard

    async def _has_absurd_term(self, states: list[RcState]) -> bool:
        """Return True if an RC with a token obeys a term absurd to other RCs: these must be asked to go above it."""
        highest = max(states, key=lambda state: state.term, default=None)
        if highest is None or not any(absurd(highest.term, state.term) for state in states):
            return False
        return bool(await self.mesh.living(self.mesh.keys.alive_rc(highest.rc), timeout=self._timeout))

    async def _take_over(self) -> bool:
        """Make one attempt to lead. If RCs have promised a higher term, its candidate may be about to lead; the next
        attempt goes above it."""
        keys = self.mesh.keys
        if self.election.sees_leader(self.mesh.now()):
            return False
        if self.known.counter == MAX_COUNTER:
            log.error(
                "no term is left: end all nodes and clients, remove term.json from state folders, and start again"
            )
            return False
        term = Term(self.known.counter + 1, new_instance())
        self.terms.tries(term)
        promise_query = RcAsk(promise=term, above=self.mesh.me.host if self.terms.goes_above else None, ordinary=True)
        booked = ShareBookings(term, self.learned.keeper.records.digest())
        rcs, clients, keepers, _ = await asyncio.gather(
            self.mesh.ask(keys.rc_state_any, promise_query, RcState, timeout=self._timeout),
            self.mesh.ask(keys.requests_any, promise_query, ClientRequests, timeout=self._timeout),
            self.mesh.ask(keys.bookings_any, booked, BookingsKept, timeout=self._timeout),
            self._kept.keep(term),
        )
        refusals = [_refusal(reply, term) for reply in rcs]
        await self._weigh_refusals(Source.RC, refusals)
        await self._weigh_refusals(Source.CLIENT, [_refusal(reply, term) for reply in clients])
        open_requests = self._credible(clients, lambda answer: keys.requests(client_of(answer.client)))
        self._weigh_seals(answer for answer, _ in open_requests)
        if self.known > term:
            self.election.outbid(self.mesh.now())
            return False
        # A state of another term is no promise, or was sent before the promise.
        answers = [
            answer for answer in self._credible(rcs, lambda state: keys.rc_state(state.rc)) if answer[0].term == term
        ]
        if not answers and any(refused is not None and disbelieved(term, refused[1]) for refused in refusals):
            log.info("no RC believes term %d while they hear an RCM of another: waiting", term.counter)
            return False
        now = self.mesh.now()
        states = [aged(state, now - arrived) for state, arrived in answers]
        asking = [answer for answer, _ in open_requests if answer.term in (term, NO_TERM)]
        kept = [answer for answer in credible(keepers, keys, now) if self._authority.may_lead(answer.host)]
        return await self._lead(term, states, asking, kept)

    async def _weigh_refusals(self, source: Source, refusals: list[tuple[str, Term] | None]) -> None:
        """Judge the higher terms in refusals of RCs or clients. Query tokens if a verdict needs the host of a key."""
        keys, hosts = self.mesh.keys, dict[str, str]()
        shown = [(key, term) for key, term in filter(None, refusals) if self.terms.is_news(term, source)]
        if any(self.terms.secured or absurd(term, self.known) for _, term in shown):
            seen = await self.mesh.living(keys.alive_any(), timeout=self._timeout)
            hosts = {keys.rc_state(token.name): token.host for token in seen if token.role == Role.RC}
            hosts |= {
                keys.requests(Sender(token.host, token.name)): token.host for token in seen if token.role == Role.CLIENT
            }
        for key, term in shown:
            self._weigh(Word(term, source, key, hosts.get(key, "")))

    def _weigh_seals(self, answers: Iterable[ClientRequests]) -> None:
        """Judge the terms of the listed places that have a valid seal."""
        places = Places(self.fleet.name, self._parts.places_key, NO_TERM)
        for answer in answers if self.terms.secured else ():
            for request in answer.requests:
                place = request.place
                if place is None or place.term <= self.known:
                    continue
                if places.proves(place, answer.client, request.was or request.id, request.seal):
                    self._weigh(Word(place.term, Source.SEAL, answer.client, client_of(answer.client).host))

    def _credible(self, replies: list[Reply[R]], key_of: Callable[[R], str]) -> list[tuple[R, Ns]]:
        """The messages of `replies` whose content names the same sender as their key, each with its arrival."""
        messages = []
        for reply in replies:
            try:
                if reply.message is not None and reply.key == key_of(reply.message):
                    messages.append((reply.message, reply.arrived))
            except BadName as error:
                log.warning("ignored an answer on %.200r: %s", reply.key, error)
        return messages

    async def _lead(
        self, term: Term, states: list[RcState], open_requests: list[ClientRequests], kept: list[BookingsKept]
    ) -> bool:
        places = Places(self.fleet.name, self._parts.places_key, term)
        self.learned.keeper.records.take(record for answer in kept for record in answer.records)
        admission = Admission(self._authority, places)
        home_of, record_of = self.inventory.devices.home_of, self.learned.keeper.records.get
        recovered = take_over(states, open_requests, self.mesh.now(), admission, home_of, record_of)
        for remark in recovered.remarks:
            log.info("%s", remark)
        if (fair := self.fleet.scheduling.fair_shares) is not None:
            recovered.charged = self.learned.charged(self.mesh.now(), fair.half_life)
        recovered.patience = self.learned.patience
        recovered.patient = self.election.links_return(self.mesh.now())
        self.terms.highest = term
        rcm = Rcm(
            self.mesh,
            self.fleet,
            term,
            self._weigh,
            self._failed,
            Parts(
                self.inventory,
                self._authority,
                places,
                self._parts.listeners,
                self.tally,
                self.learned.keeper,
                kept,
                self.learned.runtimes.estimator,
                self._disbelieved,
                self._parts.on_danger,
                self._on_drained,
            ),
        )
        self._leading.callback(rcm.stop)
        await rcm.enter()
        if self.known > term:
            self._leading.close()
            self.election.outbid(self.mesh.now())
            return False
        self.rcm, self.terms.goes_above = rcm, False
        self.terms.led(term, self.mesh.now())
        counts = len(recovered.rcs), len(recovered.holds), len(recovered.waiting)
        log.info("leading in term %d: %d RCs, %d holds, %d waiting", term.counter, *counts)
        self.terms_led += 1
        rcm.start(recovered)
        balancer = self.balancer = LoadBalancer(self.mesh, self._failed)
        inherited = self.ledger.inherited()
        maintained = rcm.bookings.drained
        placer = self.placer = ComponentPlacer(
            self.mesh, self.fleet, term, balancer, inherited, self._failed, self._authority, maintained
        )
        for service in (balancer, placer):
            self._leading.callback(service.stop)
            service.start()
        return True

    def _on_drained(self, hosts: frozenset[HostName]) -> None:
        if self.placer is not None:
            self.placer.maintain(hosts)


def _refusal(reply: Reply[RcState] | Reply[ClientRequests], promise: Term) -> tuple[str, Term] | None:
    """The key of an RC or client that does not promise this term, and its term; None: it promises, or names none."""
    if reply.message is not None:
        return None if reply.message.term in (promise, NO_TERM) else (reply.key, reply.message.term)
    return None if reply.problem is None or reply.problem.term is None else (reply.key, reply.problem.term)

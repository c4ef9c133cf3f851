"""Which clients and RCs are there: liveliness tokens and what RCs report, as events.

An RC may be granted once it has promised to obey this term; a client with requests must have a token within a lease.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Final

from msgspec import Struct

from zscout.config.devices import SETTLE
from zscout.config.fleet import Fleet
from zscout.keyexpr import Role, Token, client_of
from zscout.mesh import Declaration, Mesh
from zscout.mesh.supervision import Supervisor
from zscout.messages import ClientRequests, RcAsk, RcState, disbelieved
from zscout.rcm.terms import BELIEVED, Source, Verdict, Word
from zscout.scheduling.model import Adopted, ArcStatus, ClientLost, Event, RcJoined, RcLost, RcReported
from zscout.services.rcm.absence import Absence, Asked
from zscout.services.rcm.devices import ExpectedDevices
from zscout.services.rcm.recovery import aged, gangs_of, recover
from zscout.types import SECOND, ArcId, ClientId, Grant, HostName, Ns, RcName, Term

log = logging.getLogger(__name__)

SEEK_EVERY: Final = 1.0
"""Seconds."""
SEEK_TIMES: Final = 20
MAX_SOUGHT: Final = 256
"""How often who went without a token is asked, and of whom so many at a time."""
DYING: Final = 0.003
"""Seconds within which all tokens of one link go."""
LEASES_AT_MOST: Final = 3
"""For which a pending RC waits, whoever of its gangs goes on answering."""
MAX_WORDS: Final = 500
"""Characters of what an RC says of its health."""
SHUNNED: Final = "its host alone shows a term in which nobody leads"
NEAR_END: Ns = SECOND // 20
"""A hold with less than this left may have ended at its RC already: clocks differ a little."""


@dataclass(slots=True)
class _Pending:
    """An RC that answered, and does not count yet."""

    state: RcState
    since: Ns
    """When it said so."""
    patient: bool
    """Links may be coming back, one after the other: it waits a lease for its gang, seen or not."""
    waited: float = 0.0
    """For how many seconds, as far as that was measured: for an answer, or for a lease."""


class Membership:
    """Follows the clients and RCs of one fleet for one term."""

    def __init__(
        self,
        mesh: Mesh,
        fleet: Fleet,
        term: Term,
        supervisor: Supervisor,
        emit: Callable[..., None],
        on_reported: Callable[[RcName, RcState], None],
        on_newer: Callable[[Word], Verdict],
        devices: ExpectedDevices,
    ) -> None:
        self.mesh, self.term, self._devices = mesh, term, devices
        self._lease = fleet.mesh.lease
        self._hold_lease = fleet.timing.hold_lease / SECOND
        self._timeout = fleet.timing.rebuild / SECOND
        self._supervisor = supervisor
        self._emit, self._on_reported, self._on_newer = emit, on_reported, on_newer
        self.clients: dict[ClientId, set[str]] = {}
        """Instances alive of each client that has a token."""
        self._unseen: dict[ClientId, asyncio.TimerHandle] = {}
        self._absence = Absence(mesh, fleet.mesh.lease, supervisor, self._is_present)
        self._rc_tokens: dict[RcName, dict[str, Token]] = {}
        self._awaited: dict[ArcId, Ns] = {}
        """What clients hold of RCs of which no token was ever seen: since when that is known."""
        self._blinked: set[str] = set()
        """Instances of RCs that count as there, and whose tokens went as this leader was away."""
        self.shunned: set[str] = set()
        """Instances of RCs that count as absent, for what they show of terms."""
        self._rc_seen: dict[RcName, Ns] = {}
        """When each RC was seen first, of those that have a token."""
        self._joined: dict[RcName, RcState] = {}
        """The RCs that count as there, as they reported themselves last."""
        self._pending: dict[RcName, _Pending] = {}
        """RCs that answered with holds of earlier terms: the other RCs of those gangs may answer too."""
        self.on_settled: Callable[[], None] = lambda: None
        """Called when RCs are not pending any more."""
        self.on_requests: Callable[[ClientId, set[str]], None] = lambda *_: None
        """Called with what a client that was asked says that it asks for: ids."""
        self._asked: set[ClientId] = set()
        self.on_disbelieved: Callable[[RcName, Term], object] = lambda *_: None
        """Called when no RC has joined, and one obeys an RCM of so low a term that this one is none to it."""
        self.on_named: Callable[[RcName], None] = lambda _: None
        """Called when the instances of an RC are to hear which one is meant."""
        self._named: dict[RcName, tuple[str, HostName]] = {}
        """The instance that is meant of each RC, and its host."""
        self._dying: list[Callable[[], None]] = []
        """What is to be judged of tokens that went just now."""
        self._doubted: set[ClientId] = set()
        """Clients that went as it was not known whether this leader was away."""
        self._sought: dict[str, int] = {}
        """By key: how often those whose tokens went without them are still asked."""
        self._missed: set[RcName] = set()
        """Expected devices that this reign has not seen, and has said so."""
        self._departed: dict[RcName, RcState] = {}
        """RCs that went just now: for a hold lease they may still let their holders command, and then settle."""
        self._may_be_at_home = mesh.now() + fleet.timing.hold_lease + SETTLE
        """Until then an RC that this reign has not seen may still be used at the host that the fleet file names."""

    def join(self, rcs: dict[RcName, RcState], pending: Iterable[RcState], *, patient: bool) -> list[Event]:
        """The RCs that promised to obey before the term began; those that are `pending` join later. `patient`: for the
        rest of their gangs they wait for a lease."""
        self._joined.update(rcs)
        states = (*rcs.values(), *pending)
        alone = all(state.host == self.mesh.me.host for state in states)
        for state in states:
            self._named[state.rc] = state.instance, state.host
        for state in pending:
            self._hold_up(state, patient=patient or alone)
        # One that died before its token was watched would never be seen to go.
        self._supervisor.call_later(self._lease, self._drop_unseen)
        self._supervisor.call_later((self._may_be_at_home - self.mesh.now()) / SECOND, self._join_all)
        return [_as_it_is(state) for state in rcs.values()]

    def watch(self) -> list[Declaration]:
        keys, mesh, guard = self.mesh.keys, self.mesh, self._supervisor.guard
        return [
            self._absence.watch(),
            mesh.subscribe(keys.rc_state_any, RcState, guard(self._on_rc_state)),
            mesh.watch(keys.alive_any(Role.CLIENT), guard(self._on_client)),
            mesh.watch(keys.alive_any(Role.RC), guard(self._on_rc_token)),
        ]

    # Clients

    def expect(self, client: ClientId) -> None:
        """A client with requests must live: one that is not among `clients` yet gets a lease to show itself. It is not
        dropped if it answers then, or its session is seen."""
        if client not in self._unseen:
            self._unseen[client] = self._supervisor.call_later(self._lease, self._overdue, client)

    def _overdue(self, client: ClientId) -> None:
        if self._absence.stood_still:
            # It had less than a lease to show itself in.
            self._no_longer_unseen(client)
            self.expect(client)
        else:
            self._supervisor.spawn(self._ask_unseen(client, self._unseen[client]))

    async def _ask_unseen(self, client: ClientId, timer: asyncio.TimerHandle) -> None:
        keys, program = self.mesh.keys, client_of(client)
        key = keys.requests(program)
        lives = await self.mesh.ask_one(key, RcAsk(), ClientRequests, timeout=self._timeout) is not None
        lives = lives or bool(await self.mesh.living(keys.alive_session(program), timeout=self._timeout))
        if self._unseen.get(client) is not timer:
            return  # it has shown itself
        if not lives:
            self._client_lost(client)
        else:
            self.mesh.suspicions.suspect(_sign(key))
            self._no_longer_unseen(client)
            self.expect(client)

    def _no_longer_unseen(self, client: ClientId) -> bool:
        if (timer := self._unseen.pop(client, None)) is not None:
            timer.cancel()
        return timer is not None

    def heard(self, client: ClientId) -> None:
        """A client that says something lives, though its token is not seen."""
        if self._no_longer_unseen(client):
            self.expect(client)
        if self._sought and client not in self.clients:
            key = self.mesh.keys.requests(client_of(client))
            self.mesh.suspicions.suspect(_sign(key), so=key in self._sought)

    def find(self, client: ClientId, then: Callable[[bool], None]) -> None:
        """Calls `then` with whether a client has a token: at once where it was seen, else once the mesh was
        queried, because a new leader does not know all tokens yet."""
        if client in self.clients:
            then(True)
        else:
            self._supervisor.spawn(self._find(client, then))

    async def _find(self, client: ClientId, then: Callable[[bool], None]) -> None:
        tokens = await self.mesh.living(self.mesh.keys.alive_any(Role.CLIENT), timeout=self._timeout)
        then(any(f"{token.host}/{token.name}" == client for token in tokens))

    def _on_client(self, token: Token, alive: bool) -> None:
        client = f"{token.host}/{token.name}"
        instances = self.clients.setdefault(client, set())
        if alive:
            instances.add(token.instance)
            if self._no_longer_unseen(client):
                self.mesh.suspicions.suspect(_sign(self.mesh.keys.requests(client_of(client))), so=False)
            return
        instances.discard(token.instance)
        if not instances:
            del self.clients[client]
            self._dies(partial(self._judge_client, client, token))

    def _dies(self, judge: Callable[[], None]) -> None:
        """The tokens of a host that is lost go one after the other: what that means is judged by all of them."""
        self._dying.append(judge)
        if len(self._dying) == 1:
            self._supervisor.call_later(DYING, self._bury)

    def _bury(self) -> None:
        dying, self._dying = self._dying, []
        for judge in dying:
            judge()

    def ask_requests(self, client: ClientId) -> None:
        """Has a client say what it asks for, as soon as it hears; `on_requests` is told."""
        if client not in self._asked:
            self._asked.add(client)
            self._supervisor.spawn(self._ask_requests(client))

    async def _ask_requests(self, client: ClientId) -> None:
        program = client_of(client)
        key, ask = self.mesh.keys.requests(program), RcAsk(promise=self.term)
        unheard = f"{client} is seen and does not answer"
        while client in self.clients or client in self._unseen:
            reply = await self.mesh.ask_one(key, ask, ClientRequests, timeout=self._timeout)
            if reply is not None and reply.problem is not None and reply.problem.term is not None:
                seen = client in self.clients
                self.see(Word(reply.problem.term, Source.CLIENT, client, program.host if seen else ""))
            if reply is not None and reply.message is not None:
                self.on_requests(client, {request.id for request in reply.message.requests})
                break
            self.mesh.suspicions.suspect(unheard, so=reply is None and client in self.clients)
            await asyncio.sleep(self._timeout)
        self.mesh.suspicions.suspect(unheard, so=False)
        self._asked.discard(client)

    def _judge_client(self, client: ClientId, token: Token) -> None:
        if client in self.clients:
            return
        if self._is_away(token):
            self._doubted.add(client)
            self.expect(client)
        else:
            self._client_lost(client)

    def _is_away(self, token: Token) -> bool:
        """Whether `token` may have gone because this leader was away."""
        if not self._absence.lasts:
            self._doubted.clear()
        self._absence.token_went(token.host, last=not self._sees(token.host), others=self._others)
        return self._absence.lasts

    def _others(self) -> list[Asked]:
        """Where RCs and clients that are seen answer on hosts other than this one: one of each host."""
        keys = self.mesh.keys
        clients = map(client_of, self.clients)
        asked: dict[HostName, Asked] = {one.host: (keys.requests(one), ClientRequests) for one in clients}
        tokens = [token for of_rc in self._rc_tokens.values() for token in of_rc.values()]
        asked |= {one.host: (keys.rc_state(one.name), RcState) for one in tokens}
        return [asked[host] for host in sorted(asked) if host != self.mesh.me.host]

    def _is_present(self) -> None:
        """This leader was not away: what went has gone."""
        doubted, self._doubted = self._doubted, set()
        for client in sorted(doubted):
            if client in self._unseen:
                self._client_lost(client)
        self._drop_unseen()

    def _sees(self, host: HostName) -> bool:
        """Whether any program of a host shows itself."""
        others = (token.host for tokens in self._rc_tokens.values() for token in tokens.values())
        return host in others or any(client.startswith(f"{host}/") for client in self.clients)

    def _client_lost(self, client: ClientId) -> None:
        self._no_longer_unseen(client)
        self._seek(self.mesh.keys.requests(client_of(client)), ClientRequests, lambda: client in self.clients)
        self._emit(ClientLost(client))

    # Contradictions

    def _seek(self, key: str, kind: type[Struct], is_seen: Callable[[], bool]) -> None:
        """Asks for a while whoever went: one that answers without a token is there, and the mesh contradicts itself."""
        fresh = key not in self._sought
        if not fresh or len(self._sought) < MAX_SOUGHT:
            self._sought[key] = SEEK_TIMES
            if fresh:
                self._supervisor.spawn(self._keep_seeking(key, kind, is_seen))

    async def _keep_seeking(self, key: str, kind: type[Struct], is_seen: Callable[[], bool]) -> None:
        sign = _sign(key)
        while self._sought[key] and not is_seen():
            self._sought[key] -= 1
            await asyncio.sleep(SEEK_EVERY)
            reply = await self.mesh.ask_one(key, RcAsk(), kind, timeout=self._timeout)
            if reply is not None and not is_seen():
                self.mesh.suspicions.suspect(sign)
        self.mesh.suspicions.suspect(sign, so=False)
        del self._sought[key]

    # RCs

    def awaits(self, arc: ArcId, rcs: Iterable[RcName]) -> bool:
        """Whether it may soon be known whether `arc` holds one of `rcs`: that is pending; or it has not answered, and
        its token was seen for less than a lease, or this reign has never seen one and was asked for `arc` less than a
        lease ago: links come back one after the other. A lease through which this leader stood still was none."""
        now, lease = self.mesh.now(), round(self._lease * SECOND)
        for rc in rcs:
            if rc in self._pending:
                return True
            since = self._rc_seen.get(rc)
            if since is None and rc not in self._named:
                since = self._asked_since(arc, now, lease)
            if rc not in self._joined and since is not None and (now - since < lease or self._absence.stood_still):
                return True
        return False

    def _asked_since(self, arc: ArcId, now: Ns, lease: Ns) -> Ns | None:
        if arc not in self._awaited and len(self._awaited) >= MAX_SOUGHT:
            self._awaited = {one: since for one, since in self._awaited.items() if now - since < lease}
        if len(self._awaited) < MAX_SOUGHT:
            self._awaited.setdefault(arc, now)
        return self._awaited.get(arc)

    def _on_rc_token(self, token: Token, alive: bool) -> None:
        tokens = self._rc_tokens.get(token.name, {})
        if tokens.get(token.instance, token if alive else None) != token:
            return  # a second host shows this instance, or does so no more: that is the first one's
        self._rc_tokens[token.name] = tokens
        current = self._joined.get(token.name)
        if alive:
            tokens[token.instance] = token
            self._rc_seen.setdefault(token.name, self.mesh.now())
            if self._is_wanted(token):
                if current is not None:
                    self._succeed(token)
                self._supervisor.spawn(self._join(token))
            elif current is not None and current.instance == token.instance:
                if token.instance in self._blinked:
                    self._blinked.discard(token.instance)
                    self._supervisor.spawn(self._greet(token))
            elif current is not None:
                log.warning("%s is offered twice; the one at %s is used", token.name, current.host)
                self.on_named(token.name)
            return
        tokens.pop(token.instance, None)
        if token.name in self._pending and self._pending[token.name].state.instance == token.instance:
            del self._pending[token.name]
        if not tokens:
            del self._rc_tokens[token.name], self._rc_seen[token.name]
            self._settle()
        if current is not None and current.instance == token.instance:
            self._dies(partial(self._judge_rc, token))

    def _judge_rc(self, token: Token) -> None:
        current = self._joined.get(token.name)
        back = token.instance in self._rc_tokens.get(token.name, {})
        if current is None or current.instance != token.instance or back:
            return
        if not current.leaving and self._is_away(token):
            self._blinked.add(token.instance)
            self._supervisor.call_later(self._lease, self._drop_unseen)
        else:
            self._drop(token.name)

    async def _greet(self, token: Token) -> None:
        """Asks an RC whose token has come back, so that it knows to be seen."""
        key, ask = self.mesh.keys.rc_state(token.name), RcAsk(promise=self.term, instance=token.instance)
        for reply in await self.mesh.ask(key, ask, RcState, timeout=self._timeout):
            if reply.message is not None:
                self._on_rc_state(key, reply.message)

    def _succeed(self, token: Token) -> None:
        """A new instance on the same host: the one before is not there any more."""
        del self._joined[token.name]
        self._named[token.name] = token.instance, token.host
        self._emit(RcLost(token.name, "it started anew"))
        self.on_named(token.name)

    def _drop(self, name: RcName, why: str = "") -> None:
        gone = self._departed[name] = self._joined.pop(name)
        self._blinked.discard(gone.instance)
        self._supervisor.call_later(self._hold_lease + (gone.settle or 0), self._free, gone)
        self._seek(self.mesh.keys.rc_state(name), RcState, lambda: name in self._rc_tokens)
        self._emit(RcLost(name, why=why or self._devices.why_gone(name, gone.host)))
        if gone.leaving:
            self._free(gone)
        for other in self._rc_tokens.get(name, {}).values():
            self._supervisor.spawn(self._join(other))

    def _free(self, gone: RcState) -> None:
        """An RC that went lets nobody command any more: another host may offer it."""
        if self._departed.get(gone.rc) is not gone:
            return
        del self._departed[gone.rc]
        others = sorted(self._rc_tokens.get(gone.rc, {}).values())
        if others and gone.rc not in self._joined:
            self._named[gone.rc] = others[0].instance, others[0].host
            self.on_named(gone.rc)
        for other in others:
            self._supervisor.spawn(self._join(other))

    def has_joined(self, rc: RcName) -> bool:
        """Whether this RC counts as there, or did until just now."""
        return rc not in self._pending and (rc in self._joined or rc in self._departed)

    def reported(self, rc: RcName) -> RcState | None:
        """An RC that counts as there, as it reported itself last."""
        return self._joined.get(rc)

    def is_known(self, rc: RcName) -> bool:
        """Whether anybody offers it."""
        return rc in self._joined or rc in self._pending or rc in self._rc_tokens

    def named(self, rcs: Iterable[RcName]) -> dict[RcName, tuple[str, HostName]]:
        """The instance that is meant of each of these RCs, and its host."""
        return {rc: self._named[rc] for rc in rcs if rc in self._named}

    def hosts_of(self, rcs: Iterable[RcName]) -> dict[RcName, HostName]:
        named = self._named
        return {rc: named[rc][1] for rc in rcs if rc in named}

    def _drop_unseen(self) -> None:
        for name, state in list(self._joined.items()):
            if state.instance not in self._rc_tokens.get(name, {}):
                self._drop(name)
        self._miss()

    def _miss(self) -> None:
        """Has who waits for a device that this reign has never seen know why it is not there."""
        there = self._joined.keys() | self._pending.keys() | self._rc_tokens.keys() | self._departed.keys()
        for name in sorted(self._devices.names - there):
            if name not in self._missed and (home := self._devices.latest_home(name)) is not None:
                self._missed.add(name)
                self._emit(RcLost(name, why=self._devices.why_gone(name, home)))

    def _join_all(self) -> None:
        for tokens in self._rc_tokens.values():
            for token in sorted(tokens.values()):
                self._supervisor.spawn(self._join(token))

    async def _join(self, token: Token) -> None:
        """Asks a new RC for its promise to obey this term, until it has joined or is gone."""
        key, ask = self.mesh.keys.rc_state(token.name), RcAsk(promise=self.term, instance=token.instance)
        while self._is_wanted(token):
            for reply in await self.mesh.ask(key, ask, RcState, timeout=self._timeout):
                if reply.problem is not None and reply.problem.term is not None:
                    self._see_rc(token, reply.problem.term)
                    if not (self._joined or self._pending) and disbelieved(self.term, reply.problem.term):
                        self.on_disbelieved(token.name, reply.problem.term)
                match reply.message:
                    # One of a lower term is from before the promise.
                    case RcState(rc=token.name, instance=token.instance, term=term) as state if term >= self.term:
                        if self._is_wanted(token):
                            self._answered(state)
                            return
            # No answer can come at once, and again and again: a token may outlive its RC.
            await asyncio.sleep(self._timeout)

    def _answered(self, state: RcState) -> None:
        """An RC joins at once, if it holds nothing of an earlier term; else with all RCs of its gangs: a hold that all
        of them have goes on."""
        if any(holder.grant.term != self.term for holder in state.holders):
            self._hold_up(state, patient=True)
        else:
            self._admit([state])
        self._settle()

    def _hold_up(self, state: RcState, *, patient: bool) -> None:
        pending = self._pending[state.rc] = _Pending(state, self.mesh.now(), patient)
        for wait in (self._timeout, self._lease, LEASES_AT_MOST * self._lease):
            self._supervisor.call_later(wait, self._wait_over, pending, wait)

    def _wait_over(self, pending: _Pending, wait: float) -> None:
        if self._absence.stood_still:
            # What has come meanwhile is not handled yet.
            self._supervisor.call_later(wait, self._wait_over, pending, wait)
            return
        pending.waited = wait
        self._settle()

    def _settle(self) -> None:
        """Lets in the pending RCs whose gangs have answered. Others wait for a lease, from when the last RC of their
        gangs answered; where nothing shows that one of the gang lives, and all links of this leader stood as it began,
        only as long as for an answer."""
        for rc in list(self._pending):
            if (pending := self._pending.get(rc)) is None:
                continue
            gangs = gangs_of(rc, {one: pending.state for one, pending in self._pending.items()})
            missing = gangs - self._joined.keys() - self._pending.keys()
            together = [self._pending[one] for one in gangs & self._pending.keys()]
            patient = any(one.patient for one in together) or any(one in self._rc_tokens for one in missing)
            # They are let in together: the last of them may be the first whose links came back.
            waited = min(one.waited for one in together)
            over = waited >= (self._lease if patient else self._timeout)
            if not missing or over or pending.waited >= LEASES_AT_MOST * self._lease:
                let_in, now = [self._pending.pop(one) for one in sorted(gangs & self._pending.keys())], self.mesh.now()
                self._admit([aged(one.state, now - one.since) for one in let_in])

    def _admit(self, states: list[RcState]) -> None:
        self._joined.update({state.rc: state for state in states})
        self._named |= {state.rc: (state.instance, state.host) for state in states}
        well = {state.rc: state for state in states if state.health == "ok"}
        held = {(rc, holder.grant) for rc, state in well.items() for holder in state.holders}
        recovered = recover(well.values(), [], self.mesh.now()).holds
        adopted = [
            Adopted(hold)
            for hold in recovered
            if all((rc, hold.grant) in held or rc not in self._joined for rc in hold.rcs)
        ]
        self._emit(*map(_as_it_is, states), *adopted)
        for state in states:
            self._on_reported(state.rc, state)
            if state.duplicate_of or len(self._rc_tokens.get(state.rc, ())) > 1:
                self.on_named(state.rc)
        self.on_settled()

    def _is_wanted(self, token: Token) -> bool:
        """Whether an instance of an RC lives and may join: where none has, or as the successor of one on its own host.
        Once the term is over, no RC is asked any more."""
        if not self._supervisor.active or token.instance not in self._rc_tokens.get(token.name, {}):
            return False
        if token.instance in self.shunned:
            return False
        pending, gone = self._pending.get(token.name), self._departed.get(token.name)
        present = pending.state if pending is not None else self._joined.get(token.name)
        if present is not None:
            return present.host == token.host and present.instance != token.instance
        if gone is not None:
            return gone.host == token.host
        home = self._devices.home_of(token.name)
        return home in (None, token.host) or token.name in self._named or self.mesh.now() >= self._may_be_at_home

    def _on_rc_state(self, key: str, state: RcState) -> None:
        name = self.mesh.keys.rc_of(key)
        if name != state.rc:
            return
        if (token := self._rc_tokens.get(name, {}).get(state.instance)) is not None:
            self._see_rc(token, state.term)
        else:
            self.see(Word(state.term, Source.RC, name))
        if name in self._pending and self._pending[name].state.instance == state.instance:
            self._pending[name].state, self._pending[name].since = state, self.mesh.now()
        known, gone = self._joined.get(name), self._departed.get(name)
        if gone is not None and gone.instance == state.instance and state.leaving:
            self._free(gone)
        elif gone is not None and gone.host != state.host and state.holders and self._supervisor.active:
            # It holds by the word of an RCM of another half, and is not the one that is meant.
            self.on_named(name)
        if known is None or known.instance != state.instance:
            return
        self._joined[name] = state
        if state.leaving and state.instance not in self._rc_tokens.get(name, {}):
            self._drop(name)
            return
        if state.health != "ok":
            if known.health != state.health:
                self._emit(_as_it_is(state))
            return
        if known.health != "ok" or known.sharable != state.sharable:
            self._emit(_as_it_is(state))
        if state.rules != known.rules:
            self._emit(RcReported(name, rules_changed=True))
        self._on_reported(name, state)
        if state.duplicate_of and self._supervisor.active:
            # Whoever told it to stand by: it is the one that is meant.
            self.on_named(name)

    def see(self, word: Word) -> Verdict:
        """A term that somebody has heard of."""
        return self._on_newer(word) if word.term > self.term else BELIEVED

    def _see_rc(self, token: Token, term: Term) -> None:
        """An RC that is seen obeys this term. One that is not believed counts as absent for a while."""
        if token.instance in self.shunned:
            return
        until = self.see(Word(term, Source.RC, token.name, token.host)).absent_until
        if until <= self.mesh.now() or not self._supervisor.active:
            return
        self.shunned.add(token.instance)
        self._supervisor.call_later((until - self.mesh.now()) / SECOND, self._shun_no_more, token)
        if token.name in self._pending and self._pending[token.name].state.instance == token.instance:
            del self._pending[token.name]
        if token.name in self._joined and self._joined[token.name].instance == token.instance:
            self._drop(token.name, SHUNNED)

    def _shun_no_more(self, token: Token) -> None:
        self.shunned.discard(token.instance)
        self._supervisor.spawn(self._join(token))


def _as_it_is(state: RcState) -> RcJoined | RcLost:
    words = state.health[:MAX_WORDS]
    return RcJoined(state.rc, state.sharable) if words == "ok" else RcLost(state.rc, why=words)


def _sign(key: str) -> str:
    return f"{key} answers, and its token is missing"


def discrepancies(
    state: RcState, holders: Iterable[ArcStatus], now: Ns, *, current: bool
) -> tuple[tuple[ArcId, ...], bool]:
    """Compares the holds that an RC reports with its `holders` in the core: which ARCs' holds it has
    ended, and whether it has any that it should not have.

    `current`: it knows all that was published about it, so that what it does not name it does not hold."""
    known = {arc.hold.grant: arc for arc in holders if arc.hold is not None}
    held = {holder.grant for holder in state.holders}
    unknown = not held <= known.keys()
    # One that reports an unknown hold may have read the RCM's state before it received the publication that
    # ends this hold: what it does not hold yet is not lost. Its list, published again, settles both.
    complete = current and not unknown
    timely = {hold.grant for hold in state.ended if hold.why == "time"}
    ended = {hold.grant for hold in state.ended} - timely

    def is_lost(grant: Grant, arc: ArcStatus) -> bool:
        due = arc.hold is not None and not arc.request.keep and arc.hold.end - now < NEAR_END
        return grant in ended or (complete and grant not in held and grant not in timely and not due)

    lost = tuple(arc.id for grant, arc in known.items() if is_lost(grant, arc))
    return lost, current and unknown

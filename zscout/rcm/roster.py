"""The present RCs and clients of one term. Tokens, reports and answers go in, an Outbox comes out. Pure.

An RC may be granted once it has promised to obey this term. A client with requests must show a token within a lease.
A client whose token disappears is lost, and the core ends its ARCs; if this leader was away, the client has a lease.
An RC that reports holds of earlier terms is pending until its gangs have answered (rule 8 of the protocol)."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Final

from msgspec import Struct
from msgspec.structs import replace

from zscout.config.devices import SETTLE
from zscout.config.fleet import Fleet
from zscout.keyexpr import Keys, Role, Token, client_of
from zscout.messages import ClientRequests, Problem, RcAsk, RcState, disbelieved
from zscout.rcm.admission import Admission
from zscout.rcm.deadlines import Deadlines
from zscout.rcm.devices import ExpectedDevices
from zscout.rcm.places import arc_id
from zscout.rcm.recovery import adopted, aged, begin_within, gangs_of, longest_begin
from zscout.rcm.sight import MAX_TOKENS, Sight
from zscout.rcm.steps import ClientFound, ClientListed, Compare, Name, Outbox, Purpose, Question, Resume
from zscout.rcm.terms import Source, Word
from zscout.scheduling.model import ArcStatus, ClientLost, RcBegins, RcJoined, RcLost, RcReported, RcUnwell
from zscout.types import SECOND, ArcId, ClientId, Grant, HostName, Ns, RcName, Term

PROBE_PERIOD: Final[Ns] = SECOND
MAX_PROBES: Final = 20
"""Questions to a client or RC whose token disappeared: an answer shows that the mesh contradicts itself."""
MAX_PROBED: Final = 256
"""Keys that are probed, and ARCs that are awaited, at one time."""
TOKEN_SPREAD: Final[Ns] = 3 * SECOND // 1000
"""The tokens of one lost link disappear within this time."""
MAX_LEASES_PENDING: Final = 3
"""A pending RC waits for its gangs at most this many leases."""
MAX_HEALTH: Final = 500
"""Characters of an RC's health."""
NEAR_END: Final[Ns] = SECOND // 20
"""A hold with less than this left may have ended at its RC: clocks differ a little."""
SHUNNED: Final = "its host alone shows a term without a leader"
PRESENT_PART: Final = 0.05
"""Others answer a leader that is not away within this part of the mesh lease: a later answer may follow its return."""
REGRANT_PAUSES: Final[tuple[Ns, Ns]] = SECOND, 60 * SECOND
"""An RC that did not begin in time is granted again after the first, doubled each time in a row, up to the second."""
MAX_WITNESSES: Final = 3
"""Hosts that are asked to find out if this leader is away."""


class _Due(Enum):
    """The purposes of deadlines, whose values are pairs of purpose and subject."""

    CLIENT_DUE = "a client (and its number) has had a lease to show a token"
    JUDGE = "tokens that disappeared are judged together: the tokens of a lost host disappear one after the other"
    ASK_AGAIN = "a question is asked again"
    PENDING_FOR = "a pending RC has waited so long (ns)"
    DEPARTED_OVER = "a departed RC can have no holders any longer"
    UNLED = "a leader of the term that an RC shows would be seen by now"
    DROP_UNSEEN = "RCs and tokens had a lease to show themselves"
    SHUNNED = "an RC no longer counts as absent for the term that it shows"
    HOME_OVER = "RCs away from home may join"
    BEGIN_DUE = "an RC should have begun for a holder"
    GRANT_AGAIN = "an RC that did not begin may be granted again"


@dataclass(slots=True, eq=False)
class _Pending:
    """An RC that has promised, and is not admitted yet."""

    state: RcState
    since: Ns
    patient: bool
    """True if links may be returning one by one: the RC waits a lease for its gangs, with or without their tokens."""
    waited: Ns = 0


@dataclass(slots=True)
class _Rc:
    tokens: dict[str, Token] = field(default_factory=dict)
    """By instance: the tokens that are seen."""
    seen: Ns | None = None
    """The time since which it has had a token."""
    named: tuple[str, HostName] | None = None
    """The named instance (rule 7), and its host."""
    joined: RcState | None = None
    """Its last report, while it counts as present."""
    pending: _Pending | None = None
    departed: RcState | None = None
    """Its last report, if it disappeared recently: it may serve its holders for a hold lease, and then settle."""
    unseen: bool = False
    """True if it counts as present, but its token disappeared while this leader was away."""
    missed: bool = False
    """True once the core was notified that an expected RC has not been seen in this term."""
    waiting: frozenset[Grant] = frozenset()
    """Holds for which it has not begun, by its last report."""
    overdue: tuple[str, str] | None = None
    """The instance that did not begin in time, and the reason: it counts as lost for a while."""
    failures: int = 0
    """Consecutive failures to begin in time."""


class Roster:
    def __init__(
        self,
        keys: Keys,
        me: HostName,
        fleet: Fleet,
        term: Term,
        devices: ExpectedDevices,
        admission: Admission,
        known: Callable[[ArcId], ArcStatus | None],
        now: Ns,
    ) -> None:
        """`known`: looks up an ARC in the core."""
        self._keys, self.term, self._devices, self._timing = keys, term, devices, fleet.timing
        self._admission, self._known = admission, known
        self.sight = Sight(me, round(fleet.mesh.lease * SECOND))
        self._rcs = defaultdict[RcName, _Rc](_Rc)
        self.clients: dict[ClientId, set[str]] = {}
        """By client: its instances whose tokens are seen."""
        self._token_due: dict[ClientId, Ns] = {}
        """Clients without a token, each with the deadline to show one."""
        self.shunned: set[str] = set()
        """Instances of RCs that count as absent, because they show terms that are not believed."""
        self._asked: set[ClientId] = set()
        self._doubted_clients: set[ClientId] = set()
        """Clients that disappeared while it was unknown whether this leader was away."""
        self._awaited: dict[ArcId, Ns] = {}
        """ARCs whose clients believe in holds of RCs never seen here, each with the time when that was learned."""
        self._probed: dict[str, int] = {}
        """By key: the probes left."""
        self._lost_tokens: list[tuple[ClientId | RcName, Token]] = []
        """Tokens that disappeared just now."""
        self._home_until = now + fleet.timing.hold_lease + SETTLE
        """Before this time an RC unseen in this term may still be in use at its host by the fleet file."""
        self._deadlines: Deadlines[tuple[_Due, Any]] = Deadlines()
        self._now = now
        self._out = Outbox()

    def start(self, now: Ns, rcs: Iterable[RcState], pending: Iterable[RcState], *, patient: bool) -> Outbox:
        """`rcs` promised before the term began. `patient`: the gangs of `pending` RCs have a lease to answer."""
        self._now = now
        joined, waiting = list(rcs), list(pending)
        alone = all(state.host == self.sight.me for state in (*joined, *waiting))
        for state in joined:
            self._rcs[state.rc].joined = state
            self._follow_begin(self._rcs[state.rc], state)
        for state in (*joined, *waiting):
            self._rcs[state.rc].named = state.instance, state.host
        for state in waiting:
            self._add_pending(state, patient=patient or alone)
        # An RC that died before its token was watched would never be seen to disappear.
        self._set(self.sight.lease, _Due.DROP_UNSEEN)
        self._set(self._home_until - now, _Due.HOME_OVER)
        self._out.events += map(_presence, joined)
        return self._take_outbox()

    def client_token(self, now: Ns, token: Token, *, alive: bool) -> Outbox:
        self._now = now
        client = f"{token.host}/{token.name}"
        instances = self.clients.get(client, set())
        if not self._counts(token, alive=alive, known=token.instance in instances):
            return self._take_outbox()
        if alive:
            self.clients.setdefault(client, instances).add(token.instance)
            if self._token_due.pop(client, None) is not None:
                self._suspect_mesh(self._keys.requests(client_of(client)), so=False)
        else:
            instances.discard(token.instance)
            if not instances:
                del self.clients[client]
                self._judge_later(client, token)
        return self._take_outbox()

    def rc_token(self, now: Ns, token: Token, *, alive: bool) -> Outbox:
        self._now = now
        rc = self._rcs[token.name]
        if rc.tokens.get(token.instance, token if alive else None) != token:
            return self._take_outbox()  # a second host shows this instance, or no longer does: it belongs to the first
        if not self._counts(token, alive=alive, known=token.instance in rc.tokens):
            return self._take_outbox()
        if alive:
            self._token_came(rc, token)
        else:
            rc.tokens.pop(token.instance, None)
            if rc.pending is not None and rc.pending.state.instance == token.instance:
                rc.pending = None
            if not rc.tokens:
                rc.seen = None
                self._admit_settled()
            if rc.joined is not None and rc.joined.instance == token.instance:
                self._judge_later(token.name, token)
        return self._take_outbox()

    def rc_state(self, now: Ns, state: RcState) -> Outbox:
        self._now = now
        self._take_report(self._rcs[state.rc], state)
        return self._take_outbox()

    def shun(self, now: Ns, token: Token, until: Ns) -> Outbox:
        """Count an RC with a term not believed as absent until `until`, unless that term's leader soon appears: the RC
        may have promised it to another candidate."""
        self._now = now
        if until > now and token.instance not in self.shunned:
            self.shunned.add(token.instance)
            self._set(until - now, _Due.SHUNNED, token)
            self._set(2 * self._timing.rebuild, _Due.UNLED, token)
        return self._take_outbox()

    def expect(self, now: Ns, client: ClientId) -> None:
        """Give a client with requests a lease to show a token, to answer, or to show its session."""
        if client not in self._token_due and client not in self.clients:
            self._expect(now, client)

    def client_active(self, now: Ns, client: ClientId) -> Outbox:
        """A client sent an operation: it is present, even if its token is not seen."""
        if client in self.clients and not self._probed:
            return Outbox()
        self._now = now
        if client in self._token_due:
            self._expect(now, client)
        if self._probed and client not in self.clients:
            key = self._keys.requests(client_of(client))
            self._suspect_mesh(key, so=key in self._probed)
        return self._take_outbox()

    def find_client(self, now: Ns, client: ClientId, number: int) -> Outbox:
        """Find out if a client has a token that is not seen yet. Leads to a `ClientFound`."""
        self._now = now
        if client in self.clients:
            self._out.then.append(ClientFound(number, there=True))
        else:
            self._ask(Purpose.FIND_CLIENT, self._keys.alive_any(Role.CLIENT), client=client, number=number)
        return self._take_outbox()

    def client_word(self, client: ClientId, term: Term) -> Word:
        return Word(term, Source.CLIENT, client, client_of(client).host if client in self.clients else "")

    def ask_requests(self, now: Ns, client: ClientId) -> Outbox:
        """Repeated until it answers or is lost."""
        self._now = now
        if client not in self._asked:
            self._asked.add(client)
            self._ask_client(client)
        return self._take_outbox()

    def answered(self, now: Ns, asked: Question, message: Any, problem: Problem | None) -> Outbox:
        """Handle the first answer to a question; without `message` and `problem`: no answer in time."""
        self._now = now
        silent = message is None and problem is None
        match asked.purpose:
            case Purpose.PROMISE if asked.token is not None:
                self._promise_answered(asked.token, message, problem)
            case Purpose.RETURN if asked.token is not None and _is_of(message, asked.token):
                self._take_report(self._rcs[message.rc], message)
            case Purpose.REQUESTS:
                self._client_listed(asked.client, message, problem)
            case Purpose.OVERDUE if silent:
                self._ask(
                    asked.purpose,
                    self._keys.alive_session(client_of(asked.client)),
                    client=asked.client,
                    number=asked.number,
                )
            case Purpose.OVERDUE:
                self._answered_late(asked)
            case Purpose.PROBE if not silent and not self._is_seen(asked):
                self._suspect_mesh(asked.key)
            case Purpose.WITNESS if not silent and self.sight.host_answered():
                self._lose_doubted()
        return self._take_outbox()

    def seen(self, now: Ns, asked: Question, tokens: Sequence[Token]) -> Outbox:
        self._now = now
        if asked.purpose is Purpose.FIND_CLIENT:
            found = any(f"{token.host}/{token.name}" == asked.client for token in tokens)
            self._out.then.append(ClientFound(asked.number, found))
        elif tokens:
            self._answered_late(asked)
        elif self._token_due.get(asked.client) == asked.number:
            self._lose_client(asked.client)
        return self._take_outbox()

    def tick(self, now: Ns) -> Outbox:
        self._now = now
        while (due := self._deadlines.pop_due(now)) is not None:
            match due:
                case _Due.CLIENT_DUE, (client, at) if self._token_due.get(client) == at:
                    self._client_overdue(client, at)
                case _Due.JUDGE, _:
                    self._judge_lost_tokens()
                case _Due.ASK_AGAIN, asked:
                    self._ask_again(asked)
                case _Due.PENDING_FOR, (pending, wait):
                    self._wait_over(pending, wait)
                case _Due.DEPARTED_OVER, gone:
                    self._release_departed(gone)
                case _Due.SHUNNED, token:
                    self.shunned.discard(token.instance)
                    self._ask_promise(token)
                case _Due.UNLED, token if token.instance in self.shunned:
                    self._lose_shunned(token)
                case _Due.DROP_UNSEEN, _:
                    self._lose_unseen_rcs()
                case _Due.BEGIN_DUE, (name, grant):
                    self._judge_begin(self._rcs[name], grant)
                case _Due.GRANT_AGAIN, (name, overdue) if self._rcs[name].overdue is overdue:
                    self._grant_again(self._rcs[name])
                case _Due.HOME_OVER, _:
                    for rc in self._rcs.values():
                        self._ask_others(rc)
        return self._take_outbox()

    @property
    def next(self) -> Ns | None:
        return self._deadlines.next

    @property
    def closed(self) -> bool:
        return self._keys.closed

    def has_joined(self, name: RcName) -> bool:
        """Return True if an RC counts as present, or did until it departed recently."""
        rc = self._rcs.get(name, _UNKNOWN)
        return rc.pending is None and (rc.joined or rc.departed) is not None

    def reported(self, name: RcName) -> RcState | None:
        return self._rcs.get(name, _UNKNOWN).joined

    def is_known(self, name: RcName) -> bool:
        """Return True if any host offers this RC."""
        rc = self._rcs.get(name, _UNKNOWN)
        return bool(rc.joined or rc.pending or rc.tokens)

    def named(self, names: Iterable[RcName]) -> dict[RcName, tuple[str, HostName]]:
        return {name: known for name in names if (known := self._rcs.get(name, _UNKNOWN).named) is not None}

    def awaits(self, now: Ns, arc: ArcId, names: Iterable[RcName]) -> bool:
        """Return True if `arc` may still turn out to hold one of these RCs: it is pending; or it has not answered
        within a lease since its token was first seen, or since the ARC was learned of if none is seen. A lease in which
        this leader stalled does not count."""
        self._now = now
        for name in names:
            rc = self._rcs.get(name, _UNKNOWN)
            if rc.pending is not None:
                return True
            since = rc.seen
            if since is None and rc.joined is None:
                since = self._awaited_since(arc)
            if rc.joined is None and since is not None and (now - since < self.sight.lease or self._stalled_recently):
                return True
        return False

    def _expect(self, now: Ns, client: ClientId) -> None:
        at = now + self.sight.lease
        if self._token_due.get(client) != at:
            self._token_due[client] = at
            self._deadlines.set(at, (_Due.CLIENT_DUE, (client, at)))

    def _client_overdue(self, client: ClientId, number: Ns) -> None:
        if self._stalled_recently:
            self._expect(self._now, client)  # the stall left it less than a lease
        else:
            key = self._keys.requests(client_of(client))
            self._ask(Purpose.OVERDUE, key, kind=ClientRequests, client=client, number=number)

    def _answered_late(self, asked: Question) -> None:
        """A client without a token answers, or its session is seen."""
        if self._token_due.get(asked.client) == asked.number:
            self._suspect_mesh(self._keys.requests(client_of(asked.client)))
            self._expect(self._now, asked.client)

    def _client_listed(self, client: ClientId, message: Any, problem: Problem | None) -> None:
        silent = f"{client} is seen and does not answer"
        if problem is not None and problem.term is not None:
            self._note_term(self.client_word(client, problem.term))
        if isinstance(message, ClientRequests) and message.client == client:
            self._asked.discard(client)
            self._out.suspicions.append((silent, False))
            self._out.then.append(ClientListed(message))
            return
        absent = message is None and problem is None
        self._out.suspicions.append((silent, absent and client in self.clients))
        self._set_again(Question(Purpose.REQUESTS, "", 0, client=client), problem)

    def _lose_client(self, client: ClientId) -> None:
        self._token_due.pop(client, None)
        self._probe(self._keys.requests(client_of(client)), ClientRequests, client=client)
        self._out.events.append(ClientLost(client))

    def _judge_later(self, name: str, token: Token) -> None:
        self._lost_tokens.append((name, token))
        if len(self._lost_tokens) == 1:
            self._set(TOKEN_SPREAD, _Due.JUDGE)

    def _judge_lost_tokens(self) -> None:
        judged, self._lost_tokens = self._lost_tokens, []
        for name, token in judged:
            if token.role == Role.CLIENT:
                self._judge_client(name, token)
            else:
                self._judge_rc(self._rcs[name], token)

    def _judge_client(self, client: ClientId, token: Token) -> None:
        if client in self.clients:
            return
        if self._was_away(token):
            self._doubted_clients.add(client)
            if client not in self._token_due:
                self._expect(self._now, client)
        else:
            self._lose_client(client)

    def _judge_rc(self, rc: _Rc, token: Token) -> None:
        if rc.joined is None or rc.joined.instance != token.instance or token.instance in rc.tokens:
            return
        if not rc.joined.leaving and self._was_away(token):
            rc.unseen = True
            self._set(self.sight.lease, _Due.DROP_UNSEEN)
        else:
            self._lose_rc(token.name)

    def _was_away(self, token: Token) -> bool:
        """Return True if `token` may have disappeared because this leader itself was away (rule 9)."""
        if not self.sight.is_away(self._now):
            self._doubted_clients.clear()
        if self.sight.token_lost(self._now, token.host):
            return True
        witnesses = self._witnesses()[:MAX_WITNESSES]
        if witnesses:
            self.sight.doubt(self._now)  # this may be the first of several lost links
        within = PRESENT_PART * self.sight.lease / SECOND
        for key, kind in witnesses:
            self._out.questions.append(Question(Purpose.WITNESS, key, within, kind=kind))
        return bool(witnesses)

    def _lose_doubted(self) -> None:
        doubted, self._doubted_clients = self._doubted_clients, set()
        for client in sorted(doubted):
            if client in self._token_due:
                self._lose_client(client)
        self._lose_unseen_rcs()

    @property
    def _stalled_recently(self) -> bool:
        return self.sight.stalled_recently(self._now)

    def _witnesses(self) -> list[tuple[str, type[Struct]]]:
        clients = map(client_of, self.clients)
        keys: dict[HostName, tuple[str, type[Struct]]] = {
            client.host: (self._keys.requests(client), ClientRequests) for client in clients
        }
        tokens = (token for rc in self._rcs.values() for token in rc.tokens.values())
        keys |= {token.host: (self._keys.rc_state(token.name), RcState) for token in tokens}
        return [keys[host] for host in sorted(keys) if host != self.sight.me]

    def _counts(self, token: Token, *, alive: bool, known: bool) -> bool:
        """Return True if a token's change counts: the token is among the first MAX_TOKENS of its host."""
        if alive is known:
            return alive
        if self.sight.count(token.host, alive=alive):
            return True
        text = f"{token.host} shows more than {MAX_TOKENS} tokens: later ones are ignored"
        self._out.strange.append((token.host, text))
        return False

    def _probe(self, key: str, kind: type[Struct], *, client: ClientId = "", token: Token | None = None) -> None:
        fresh = key not in self._probed
        if not fresh or len(self._probed) < MAX_PROBED:
            self._probed[key] = MAX_PROBES
            if fresh:
                asked = Question(
                    Purpose.PROBE, key, self._timing.rebuild / SECOND, kind=kind, client=client, token=token
                )
                self._set(PROBE_PERIOD, _Due.ASK_AGAIN, asked)

    def _is_seen(self, asked: Question) -> bool:
        return asked.client in self.clients if asked.token is None else bool(self._rcs[asked.token.name].tokens)

    def _token_came(self, rc: _Rc, token: Token) -> None:
        rc.tokens[token.instance] = token
        rc.seen = self._now if rc.seen is None else rc.seen
        if self._may_join(rc, token):
            if rc.joined is not None:
                self._replace_instance(rc, token)
            self._ask_promise(token)
        elif rc.joined is not None and rc.joined.instance == token.instance:
            if rc.unseen:
                rc.unseen = False
                self._ask_rc(Purpose.RETURN, token)
        elif rc.joined is not None:
            self._out.duplicates.append((token.name, token.host))
            self._out.then.append(Name(token.name))

    def _replace_instance(self, rc: _Rc, token: Token) -> None:
        rc.joined, rc.named = None, (token.instance, token.host)
        self._out.events.append(RcLost(token.name, "it restarted"))
        self._out.then.append(Name(token.name))

    def _lose_rc(self, name: RcName, why: str = "") -> None:
        rc = self._rcs[name]
        gone, rc.joined, rc.unseen = rc.joined, None, False
        if gone is None:
            return
        rc.departed = gone
        self._set(self._timing.hold_lease + round((gone.settle or 0) * SECOND), _Due.DEPARTED_OVER, gone)
        self._probe(self._keys.rc_state(name), RcState, token=Token(gone.host, Role.RC, name, gone.instance))
        self._out.events.append(RcLost(name, why=why or self._devices.why_gone(name, gone.host)))
        if gone.leaving:
            self._release_departed(gone)
        self._ask_others(rc)

    def _release_departed(self, gone: RcState) -> None:
        """A departed RC can have no holders any longer: an instance on another host may join."""
        rc = self._rcs[gone.rc]
        if rc.departed is not gone:
            return
        rc.departed = None
        others = sorted(rc.tokens.values())
        if others and rc.joined is None:
            rc.named = others[0].instance, others[0].host
            self._out.then.append(Name(gone.rc))
        self._ask_others(rc)

    def _ask_others(self, rc: _Rc) -> None:
        for token in sorted(rc.tokens.values()):
            self._ask_promise(token)

    def _lose_unseen_rcs(self) -> None:
        for name, rc in list(self._rcs.items()):
            if rc.joined is not None and rc.joined.instance not in rc.tokens:
                self._lose_rc(name)
        # Gives requests for devices unseen in this term the reason for their absence.
        there = {name for name, rc in self._rcs.items() if rc.joined or rc.pending or rc.tokens or rc.departed}
        for name in sorted(self._devices.names - there):
            if not self._rcs[name].missed and (home := self._devices.latest_home(name)) is not None:
                self._rcs[name].missed = True
                self._out.events.append(RcLost(name, why=self._devices.why_gone(name, home)))

    def _awaited_since(self, arc: ArcId) -> Ns | None:
        if arc not in self._awaited and len(self._awaited) >= MAX_PROBED:
            self._awaited = {other: at for other, at in self._awaited.items() if self._now - at < self.sight.lease}
        if len(self._awaited) < MAX_PROBED:
            self._awaited.setdefault(arc, self._now)
        return self._awaited.get(arc)

    def _may_join(self, rc: _Rc, token: Token) -> bool:
        """Return True if an instance may join: the first of its RC, or the successor of one on the same host."""
        if token.instance not in rc.tokens or token.instance in self.shunned:
            return False
        present = rc.pending.state if rc.pending is not None else rc.joined
        if present is not None:
            return present.host == token.host and present.instance != token.instance
        if rc.departed is not None:
            return rc.departed.host == token.host
        home = self._devices.home_of(token.name)
        return home in (None, token.host) or rc.named is not None or self._now >= self._home_until

    def _promise_answered(self, token: Token, state: Any, problem: Problem | None) -> None:
        """An RC that does not promise is asked again."""
        rc = self._rcs[token.name]
        if problem is not None and problem.term is not None:
            self._note_rc_term(rc, token.name, token.instance, problem.term)
            alone = not any(rc.joined or rc.pending for rc in self._rcs.values())
            if alone and disbelieved(self.term, problem.term):
                self._out.disbelieved.append((token.name, problem.term))
        if not self._may_join(rc, token):
            return
        if not _is_of(state, token) or state.term < self.term:  # a report from before the promise
            # Such answers may arrive at once and repeatedly, as a token may outlive its RC: ask again later.
            self._set_again(Question(Purpose.PROMISE, "", 0, token=token), problem)
        elif any(holder.grant.term != self.term for holder in state.holders):
            # A hold continues only if all RCs of its gang report it: they are admitted together.
            self._add_pending(state, patient=True)
            self._admit_settled()
        else:
            self._admit([state])
            self._admit_settled()

    def _add_pending(self, state: RcState, *, patient: bool) -> None:
        pending = self._rcs[state.rc].pending = _Pending(state, self._now, patient)
        for wait in (self._timing.rebuild, self.sight.lease, MAX_LEASES_PENDING * self.sight.lease):
            self._set(wait, _Due.PENDING_FOR, (pending, wait))

    def _wait_over(self, pending: _Pending, wait: Ns) -> None:
        if self._stalled_recently:
            self._set(wait, _Due.PENDING_FOR, (pending, wait))  # answers may not be handled yet
        elif self._rcs[pending.state.rc].pending is pending:
            pending.waited = wait
            self._admit_settled()

    def _admit_settled(self) -> None:
        """Admit pending RCs whose gangs have answered. Others wait a lease after the last answer from their gangs; or
        only `rebuild`, if no missing RC has a token and all links of this leader existed when it began."""
        pending = {name: rc.pending for name, rc in self._rcs.items() if rc.pending is not None}
        settled = bool(pending)
        for name in list(pending):
            if name not in pending:
                continue
            gangs = gangs_of(name, {other: waiting.state for other, waiting in pending.items()})
            joined = {other for other in gangs if self._rcs[other].joined is not None}
            missing = gangs - joined - pending.keys()
            together = [pending[other] for other in gangs & pending.keys()]
            disputed = any(self._is_disputed(waiting.state) for waiting in together)
            patient = disputed or any(waiting.patient for waiting in together)
            patient = patient or any(self._rcs[other].tokens for other in missing)
            # They are admitted together: the last to answer may be the first whose links returned.
            waited = min(waiting.waited for waiting in together)
            over = waited >= (self.sight.lease if patient else self._timing.rebuild)
            if not (missing or disputed) or over or pending[name].waited >= MAX_LEASES_PENDING * self.sight.lease:
                for other in gangs & pending.keys():
                    self._rcs[other].pending = None
                admitted = [pending.pop(other) for other in sorted(gangs & pending.keys())]
                self._admit([aged(waiting.state, self._now - waiting.since) for waiting in admitted])
        if settled:
            self._out.then.append(Resume())

    def _is_disputed(self, state: RcState) -> bool:
        """Return True if the core has another hold, by other RCs, for a reported ARC, and the client has not answered:
        any node may report holds that do not exist."""
        for holder in state.holders:
            known = self._known(arc_id(holder.client, holder.id))
            if known is not None and not known.vouched and known.hold is not None and known.hold.grant != holder.grant:
                return True
        return False

    def _admit(self, states: list[RcState]) -> None:
        """Admit RCs. A hold continues if all present RCs of its gang report its grant."""
        for state in states:
            rc = self._rcs[state.rc]
            rc.joined, rc.named = state, (state.instance, state.host)
            rc.waiting, rc.overdue = frozenset(), None
            self._follow_begin(rc, state)
        joined = {name for name, rc in self._rcs.items() if rc.joined is not None}
        holds, remarks = adopted(states, joined, self._now, self._admission, self._known)
        self._out.events += [*map(_presence, states), *holds]
        self._out.log += remarks
        self._out.then += map(Compare, states)
        for state in states:
            if state.duplicate_of or len(self._rcs[state.rc].tokens) > 1:
                self._out.then.append(Name(state.rc))
        self._out.then.append(Resume())

    def _take_report(self, rc: _Rc, state: RcState) -> None:
        if state.instance in self.shunned:
            return
        self._note_rc_term(rc, state.rc, state.instance, state.term)
        if rc.pending is not None and rc.pending.state.instance == state.instance:
            rc.pending.state, rc.pending.since = state, self._now
        known, gone = rc.joined, rc.departed
        if gone is not None and gone.instance == state.instance and state.leaving:
            self._release_departed(gone)
        elif gone is not None and gone.host != state.host and state.holders:
            # A leader in another half of the mesh granted this instance, which is not the named one here.
            self._out.then.append(Name(state.rc))
        if known is None or known.instance != state.instance:
            return
        self._follow_begin(rc, state)
        if rc.overdue is not None and rc.overdue[0] == state.instance and state.health == "ok":
            state = replace(state, health=rc.overdue[1])
        rc.joined = state
        if state.leaving and state.instance not in rc.tokens:
            self._lose_rc(state.rc)
        elif state.health != "ok":
            if known.health != state.health:
                self._out.events.append(_presence(state))
        else:
            if known.health != "ok" or known.sharable != state.sharable:
                self._out.events.append(_presence(state))
            elif unwell(state) != unwell(known):
                self._out.events.append(RcUnwell(state.rc, unwell(state)))
            if state.begin_within != known.begin_within:
                self._out.events.append(RcBegins(state.rc, begin_within(state)))
            if state.rules != known.rules:
                self._out.events.append(RcReported(state.rc, rules_changed=True))
            self._out.then.append(Compare(state))
            if state.duplicate_of:
                # It withdrew as a duplicate, but is the named instance.
                self._out.then.append(Name(state.rc))

    def _follow_begin(self, rc: _Rc, state: RcState) -> None:
        """Set the deadline of each new holder's begin: the RC's own bound, a hold lease and its `settle`."""
        lease, held = self._timing.hold_lease, {holder.grant for holder in state.holders}
        waits = {holder.grant: holder.waits for holder in state.holders if holder.waits is not None}
        if (rc.waiting - waits.keys()) & held:
            rc.failures = 0
        for grant in sorted(waits.keys() - rc.waiting):
            left = min(round(waits[grant] * SECOND), longest_begin(state, lease))
            self._set(left + lease + round((state.settle or 0) * SECOND), _Due.BEGIN_DUE, (state.rc, grant))
        rc.waiting = frozenset(waits)

    def _judge_begin(self, rc: _Rc, grant: Grant) -> None:
        state = rc.joined
        if state is None or grant not in rc.waiting or rc.overdue is not None:
            return
        rc.overdue = state.instance, f"it did not begin within {state.begin_within or 0:g} s"
        pause = min(REGRANT_PAUSES[0] << min(rc.failures, 16), REGRANT_PAUSES[1])
        rc.failures += 1
        self._set(pause, _Due.GRANT_AGAIN, (state.rc, rc.overdue))
        self._take_report(rc, state)

    def _grant_again(self, rc: _Rc) -> None:
        overdue, rc.overdue = rc.overdue, None
        if rc.joined is not None and overdue is not None and rc.joined.health == overdue[1]:
            self._take_report(rc, replace(rc.joined, health="ok"))

    def _take_outbox(self) -> Outbox:
        out, self._out = self._out, Outbox()
        return out

    def _lose_shunned(self, token: Token) -> None:
        """No leader of its term has appeared: the RC is lost."""
        rc = self._rcs[token.name]
        if rc.pending is not None and rc.pending.state.instance == token.instance:
            rc.pending = None
            self._admit_settled()
        if rc.joined is not None and rc.joined.instance == token.instance:
            self._lose_rc(token.name, SHUNNED)

    def _set(self, delay: Ns, due: _Due, subject: Any = None) -> None:
        self._deadlines.set(self._now + delay, (due, subject))

    def _note_term(self, word: Word, token: Token | None = None) -> None:
        if word.term > self.term:
            self._out.higher.append((word, token))

    def _note_rc_term(self, rc: _Rc, name: RcName, instance: str, term: Term) -> None:
        token = rc.tokens.get(instance)
        self._note_term(Word(term, Source.RC, name, "" if token is None else token.host), token)

    def _suspect_mesh(self, key: str, *, so: bool = True) -> None:
        self._out.suspicions.append((f"{key} answers, and its token is missing", so))

    def _ask(self, purpose: Purpose, key: str, **how: Any) -> None:
        self._out.questions.append(Question(purpose, key, self._timing.rebuild / SECOND, **how))

    def _set_again(self, question: Question, problem: Problem | None) -> None:
        """Ask again after `rebuild`, above its own term if the RC or client refused this term as absurd."""
        refused = None if problem is None else problem.term
        above = self.sight.me if refused is not None and disbelieved(self.term, refused) else None
        self._set(self._timing.rebuild, _Due.ASK_AGAIN, question._replace(message=RcAsk(above=above)))

    def _ask_rc(self, purpose: Purpose, token: Token, *, above: HostName | None = None) -> None:
        message = RcAsk(promise=self.term, instance=token.instance, above=above)
        self._ask(purpose, self._keys.rc_state(token.name), message=message, kind=RcState, token=token)

    def _ask_promise(self, token: Token, *, above: HostName | None = None) -> None:
        if self._may_join(self._rcs[token.name], token):
            self._ask_rc(Purpose.PROMISE, token, above=above)

    def _ask_client(self, client: ClientId, *, above: HostName | None = None) -> None:
        if client in self.clients or client in self._token_due:
            key, message = self._keys.requests(client_of(client)), RcAsk(promise=self.term, above=above)
            self._ask(Purpose.REQUESTS, key, message=message, kind=ClientRequests, client=client)
        else:
            self._asked.discard(client)
            self._out.suspicions.append((f"{client} is seen and does not answer", False))

    def _ask_again(self, asked: Question) -> None:
        if asked.purpose is Purpose.REQUESTS:
            self._ask_client(asked.client, above=asked.message.above)
        elif asked.purpose is Purpose.PROMISE and asked.token is not None:
            self._ask_promise(asked.token, above=asked.message.above)
        elif not self._probed[asked.key] or self._is_seen(asked):
            del self._probed[asked.key]
            self._suspect_mesh(asked.key, so=False)
        else:
            self._probed[asked.key] -= 1
            self._out.questions.append(asked)
            self._set(PROBE_PERIOD, _Due.ASK_AGAIN, asked)


_UNKNOWN: Final = _Rc()


def _is_of(message: Any, token: Token) -> bool:
    return isinstance(message, RcState) and (message.rc, message.instance) == (token.name, token.instance)


def _presence(state: RcState) -> RcJoined | RcLost:
    health = state.health[:MAX_HEALTH]
    if health != "ok":
        return RcLost(state.rc, why=health)
    return RcJoined(state.rc, state.sharable, state.host, begin_within(state), unwell(state))


def unwell(state: RcState) -> str:
    """The reason that a present RC's device does not work; empty: it works."""
    return "" if state.unwell is None else state.unwell.why[:MAX_HEALTH] or "it gives no reason"


def discrepancies(
    state: RcState, holders: Iterable[ArcStatus], now: Ns, *, current: bool
) -> tuple[tuple[ArcId, ...], bool]:
    """Compare the holds that an RC reports with its `holders` in the core. Return the ARCs whose holds it has ended,
    and True if it has holds that it should not have. `current`: it has received all publications about it, so that a
    hold missing from its report is lost."""
    known = {arc.hold.grant: arc for arc in holders if arc.hold is not None}
    held = {holder.grant for holder in state.holders}
    unknown = not held <= known.keys()
    # An RC that reports an unknown hold may have read the leader's state before it received the publication that ends
    # this hold, so holds that it lacks may not have begun yet. Publishing its holders again resolves both.
    complete = current and not unknown
    timely = {hold.grant for hold in state.ended if hold.why == "time"}
    ended = {hold.grant for hold in state.ended} - timely

    def is_lost(grant: Grant, arc: ArcStatus) -> bool:
        due = arc.hold is not None and not arc.request.keep and arc.hold.end - now < NEAR_END
        return grant in ended or (complete and grant not in held and grant not in timely and not due)

    lost = tuple(arc.id for grant, arc in known.items() if is_lost(grant, arc))
    return lost, current and unknown


def beginnings(state: RcState, holders: Iterable[ArcStatus], now: Ns, hold_lease: Ns) -> list[RcBegins]:
    """The event for holds for which an RC has not begun, or has begun since; none if the core knows of no waiting."""
    bound, known = begin_within(state), {arc.hold.grant: arc.hold for arc in holders if arc.hold is not None}
    waits = {holder.grant: holder.waits for holder in state.holders if holder.grant in known}
    if bound is None or all(waits[grant] is None and known[grant].waits is None for grant in waits):
        return []
    most = longest_begin(state, hold_lease)
    until = {grant: None if left is None else now + min(round(left * SECOND), most) for grant, left in waits.items()}
    return [RcBegins(state.rc, bound, until)]

"""A client and resource controllers written from the pages of `docs/protocol` alone, with plain `zenoh` and `json`:
nothing of the project. Quotes name sections of these pages.

    python -m studies.chaos.foreign client|rcs FLEET HOST SEED"""

from __future__ import annotations

import contextlib
import json
import os
import queue
import random
import secrets
import signal
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

# "Joining a fleet": with few receiving threads one host that is cut off stalls every link.
os.environ["ZENOH_RUNTIME"] = (
    "(rx:(worker_threads:16),net:(worker_threads:4),acc:(worker_threads:4),tx:(worker_threads:4),app:(worker_threads:2))"
)

import zenoh

from studies.chaos.work import CAPACITY, CLIENT, JOBS, PULSE, Json, draw, now, rcs_of, say
from tests.live.plain_client import GREATER_CONNECTS, TRY_AGAIN, answers, encoding

SECOND = 1_000_000_000
HOLD_LEASE = 3 * SECOND
LEASE_MS = 1000
STALL = SECOND // 4
QUERY_TIMEOUT = 1.0
AGAIN = ("not_yet", "stale", "busy", "unknown")
NOT_MINE = ("ended", "free", "not_holder", "wrong_client")
MAX_COUNTER, MAX_JUMP = 2**52, 1_000_000
REMEMBERED = 256
PATIENCE, REJOIN = 2 * SECOND, 10 * SECOND

Term = tuple[int, str]
Grant = tuple[Term, int]
NO_TERM: Term = (0, "")


def term_of(value: Any) -> Term:
    return (int(value[0]), str(value[1]))


def grant_of(value: Any) -> Grant:
    return (term_of(value[0]), int(value[1]))


class Refused(Exception):
    def __init__(self, code: str, message: str, term: Term | None = None) -> None:
        super().__init__(message)
        self.problem = {"code": code, "message": message} | ({"term": term} if term is not None else {})


class Peer:
    """The common part of clients and RCs: a session, the leaders, and stalls of this process."""

    def __init__(self, join: Callable[[], zenoh.Session], program: str, fleet: str, host: str, seed: str) -> None:
        self.session, self.host, self.base = join(), host, f"zscout/{fleet}"
        self._join, self._program = join, program
        self._makes: list[Callable[[zenoh.Session], Any]] = []
        self.tokens: set[str] = set()
        self._sessions: dict[str, tuple[str, bool]] = {}
        """By known session: its program, and True while its token lives."""
        self._suspected: dict[str, tuple[int, int]] = {}
        """The first and last time of each contradiction."""
        self._joined, self._pause = 0, REJOIN
        self.rng = random.Random(seed)  # noqa: S311
        self.lock = threading.RLock()
        self.heard = now()
        self.leaders: set[str] = set()
        self._ticked = now()
        self._stall = (0, 0)
        """End and length of the last stall."""
        self.declared: list[Any] = []
        self.declare(lambda session: self.show(session, "session", program, str(session.info.zid())))

    # "Links that come back"

    def declare(self, make: Callable[[zenoh.Session], Any]) -> None:
        self._makes.append(make)
        self.declared.append(make(self.session))

    def suspect(self, what: str, *, so: bool = True) -> None:
        """Note the contradiction `what` while `so`. If it persists, reopen the session."""
        with self.lock:
            at = now()
            first, last = self._suspected.get(what, (at, at))
            first = at if at - last > 30 * SECOND else first
            if not so:
                self._suspected.pop(what, None)
                return
            self._suspected[what] = first, at
            if at - first < PATIENCE or at - self._joined < self._pause:
                return
            self._pause = REJOIN if at - self._joined > 10 * self._pause else 2 * self._pause
            self._joined = at
            self._suspected.clear()
        say("rejoined", why=what)
        threading.Thread(target=self._rejoin, daemon=True).start()

    def _rejoin(self) -> None:
        before, session = self.session, self._join()
        threading.Event().wait(1.0)  # until it has its links
        with self.lock:
            self.session = session
            self.declared, old = [make(session) for make in self._makes], self.declared
        threading.Event().wait(0.5)
        with contextlib.suppress(zenoh.ZError):  # with dead links, closing takes too long
            before.close()  # type: ignore[no-untyped-call]
        old.clear()

    def look(self) -> None:
        """Check the tokens of all peers; call this about once a second."""
        with self.lock:
            for peer in map(str, self.session.info.peers_zid()):
                # A program with another session has left this session, which Zenoh may not close.
                program, alive = self._sessions.get(peer, ("", True))
                other = (program, True) in self._sessions.values()
                self.suspect(f"the token of {peer} is missing", so=not alive and not other)

    def watch(self, on_leader: Callable[[], None]) -> None:
        def on_token(sample: zenoh.Sample) -> None:
            key, alive = str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT
            say("token", token=key.partition("/alive/")[2], alive=alive)
            with self.lock:
                (self.tokens.add if alive else self.tokens.discard)(key)
            if "/session/" in key:
                program, _, session = key.rpartition("/")
                self._sessions[session] = program, alive
            if "/rcm/" in key:
                with self.lock:
                    (self.leaders.add if alive else self.leaders.discard)(key)
                if alive:
                    on_leader()
            if "/rc/" in key:
                self.on_rc("/".join(key.split("/")[-3:-1]), alive)

        self.declare(lambda session: self._watched(session, on_token))

    def on_rc(self, rc: str, alive: bool) -> None:
        """An RC's token has appeared or disappeared."""

    def _watched(self, session: zenoh.Session, on_token: Callable[[zenoh.Sample], None]) -> Any:
        def on_sample(sample: zenoh.Sample) -> None:
            # Samples of an old session, which is being closed, only report its own end.
            if session is self.session:
                on_token(sample)

        return session.liveliness().declare_subscriber(f"{self.base}/alive/**", on_sample, history=True)

    def show(self, session: zenoh.Session, role: str, name: str, instance: str) -> Any:
        return session.liveliness().declare_token(f"{self.base}/alive/{self.host}/{role}/{name}/{instance}")

    def queryable(self, key: str, on_query: Callable[[zenoh.Query], None]) -> None:
        def make(session: zenoh.Session) -> Any:
            def once(query: zenoh.Query) -> None:
                if session is self.session:
                    on_query(query)
                else:
                    query.drop()  # type: ignore[no-untyped-call]

            return session.declare_queryable(f"{self.base}/{key}", once)

        self.declare(make)

    def subscribe(self, key: str, on_sample: Callable[[zenoh.Sample], None]) -> None:
        self.declare(lambda session: session.declare_subscriber(f"{self.base}/{key}", on_sample))

    def tick(self) -> None:
        """Call this often: a long time between two calls is a stall."""
        with self.lock:
            at = now()
            if at - self._ticked > STALL:
                self._stall = (at, at - self._ticked)
            self._ticked = at

    def stalled(self, arrived: int | None = None) -> int:
        """The length in ns of a stall that has just ended, or had just ended at `arrived`; else 0."""
        with self.lock:
            at = now()
            if at - self._ticked > STALL:
                return at - self._ticked
            end, length = self._stall
            return length if (at if arrived is None else arrived) - end < STALL else 0

    def believes(self, term: Term, known: Term, *, always: bool = False) -> bool:
        """ "Order": an absurd term is ignored while an RCM publishes."""
        near = always or now() - self.heard > HOLD_LEASE or term[0] <= known[0] + MAX_JUMP
        return term[0] < MAX_COUNTER and near

    def get(self, key: str, schema: str, message: Json, timeout: float = QUERY_TIMEOUT) -> list[tuple[bool, Json]]:
        """All answers, as (True unless it is a problem, payload). An empty list means unknown."""
        return answers(self.session, f"{self.base}/{key}", schema, message, timeout)

    def serve(self, key: str, answer: Callable[[zenoh.Query], Json], schema: str) -> None:
        def on_query(query: zenoh.Query) -> None:
            respond(query, f"{self.base}/{key}", answer, schema)

        self.queryable(key, on_query)


def payload_of(query: zenoh.Query) -> Json:
    found: Json = json.loads(query.payload.to_bytes()) if query.payload is not None else {}
    return found


def respond(query: zenoh.Query, key: str, answer: Callable[[zenoh.Query], Json], schema: str) -> None:
    with query:
        try:
            query.reply(key, json.dumps(answer(query)), encoding=encoding(schema))
        except Refused as refused:
            query.reply_err(json.dumps(refused.problem), encoding=encoding("Problem"))


# "A resource controller"


@dataclass
class Held:
    holder: Json
    end: int


class Rc:
    """An imaginary device. Its worker carries out commands one at a time."""

    def __init__(self, peer: Peer, name: str) -> None:
        self.peer, self.name, self.capacity = peer, name, CAPACITY.get(name)
        self.instance = secrets.token_hex(6)
        self.term, self.seq = NO_TERM, 0
        self.held: dict[Grant, Held] = {}
        self.ended: OrderedDict[Grant, str] = OrderedDict()
        self.awaited: set[Grant] = set()
        """Grants that a snapshot named while another was held."""
        self.commands: queue.Queue[tuple[int, zenoh.Query]] = queue.Queue(64)
        self.promised = NO_TERM
        self.behind = False
        """True if something was missed and not read yet."""
        self.led: set[str] = set()
        """The visible RCMs at the last look."""

    def begin(self) -> None:
        """ "Beginning", without the subscriptions, which all RCs of the process share."""
        self.read()
        self.peer.serve(f"rc/{self.name}/state", self.on_state, "RcState")
        self.peer.queryable(f"rc/{self.name}/command/*/*", self.on_command)
        if self.capacity is not None:
            self.peer.serve(f"rc/{self.name}/vote", self.on_vote, "Ballot")
        threading.Thread(target=self.work, daemon=True).start()
        self.peer.declare(lambda session: self.peer.show(session, "rc", self.name, self.instance))

    def look(self) -> None:
        """Check that a visible RCM publishes, and asks for a promise."""
        heard = now() - self.peer.heard < HOLD_LEASE // 2
        leaders = {key.rpartition("/")[2] for key in self.peer.leaders}
        if self.promised[1] in self.led - leaders:
            self.promised = NO_TERM
        self.led = leaders
        self.peer.suspect("an RCM is seen and does not publish", so=bool(self.peer.leaders) and not heard)
        self.peer.suspect("an RCM publishes and is not seen", so=heard and not self.peer.leaders)
        self.peer.suspect(f"{self.name} is not asked", so=heard and self.promised != self.term)

    def trace(self, do: str, **what: Any) -> None:
        known = {"rc": self.name, "instance": self.instance, "sharable": self.capacity is not None}
        say(do, **known, term=self.term, seq=self.seq, holds=sorted(self.held), **what)

    def state(self, ended: list[Json] | None = None) -> Json:
        at = now()
        holders = [held.holder | {"remaining": (held.end - at) / SECOND} for held in self.held.values()]
        return {
            "rc": self.name,
            "host": self.peer.host,
            "instance": self.instance,
            "sharable": self.capacity is not None,
            "term": self.term,
            "seq": 0 if self.behind else self.seq,
            "holders": holders,
            "ended": ended or [],
            "leader": bool(self.peer.leaders) and at - self.peer.heard < HOLD_LEASE // 2,
        }

    def publish(self, ended: list[Json] | None = None) -> None:
        self.peer.session.put(
            f"{self.peer.base}/rc/{self.name}/state",
            json.dumps(self.state(ended)),
            encoding=encoding("RcState"),
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.INTERACTIVE_HIGH,
            express=True,
        )

    # "What an RCM says"

    def _accepts(self, said: Json) -> bool:
        term, seq = term_of(said["term"]), int(said["seq"])
        if (term, seq) < (self.term, self.seq) or not self.peer.believes(term, self.term):
            if term < self.term:
                self.publish()
            return False
        self.term, self.seq = term, seq
        return True

    def on_grants(self, said: Json) -> bool:
        """Return True if something was missed, so that `rcm/state` must be read."""
        before, known = (self.term, self.seq), set(self.held)
        if not self._accepts(said):
            return False
        missed = before[0] != self.term or int(said["prev"]) > before[1]
        announce = False
        if self.name in said.get("rcs", {}):
            wanted = {grant_of(holder["grant"]): holder for holder in said["rcs"][self.name]}
            if said.get("instances", {}).get(self.name, self.instance) != self.instance:
                wanted = {}
            elif self.capacity is None and len(wanted) > 1:
                wanted, announce = {max(wanted): wanted[max(wanted)]}, True
            self.awaited.clear()
            for grant in known - wanted.keys():
                self._end(grant, "ended by the RCM")
            for grant, holder in wanted.items():
                announce |= grant in self.ended
                self._begin(grant, holder)
        if before != (self.term, self.seq) or known != self.held.keys():
            self.trace("hear")
        self.behind |= missed
        if announce:
            self.publish()
        return missed

    def _begin(self, grant: Grant, holder: Json) -> None:
        if grant not in self.held and grant not in self.ended:
            self.held[grant] = Held(holder, now() + round(holder["remaining"] * SECOND))

    def _end(self, grant: Grant, why: str) -> None:
        del self.held[grant]
        self.ended[grant] = why
        if len(self.ended) > REMEMBERED:
            self.ended.popitem(last=False)

    def read(self) -> None:
        answers = [said for good, said in self.peer.get("rcm/state", "StateAsk", {"holds_only": True}, 0.5) if good]
        with self.peer.lock:
            believed = [said for said in answers if self.peer.believes(term_of(said["term"]), self.term)]
            said = max(believed, key=lambda state: (term_of(state["term"]), state["seq"]), default=None)
            if said is None or not self._accepts(said):
                return
            self.behind = False
            views = {grant_of(view["grant"]): view for view in said.get("holds", []) if self.name in view["needs"]}
            named = said.get("instances", {}).get(self.name, [self.instance])[0]
            for grant, view in views.items() if named == self.instance else ():
                holder = {name: value for name, value in view.items() if name not in ("needs", "held")}
                holder |= {"rcs": sorted(view["needs"]), "params": view["needs"][self.name]}
                others = [held.holder for other, held in self.held.items() if other != grant]
                if not others or (self.capacity is not None and not self._veto([*others, holder])):
                    self._begin(grant, holder)
                elif grant not in self.held:
                    self.awaited.add(grant)
            self.trace("read")
            if self.held.keys() - views.keys():
                self.publish()

    # "Holds end"

    def expire(self) -> None:
        at, stalled = now(), self.peer.stalled()
        silent = not stalled and at - self.peer.heard >= HOLD_LEASE
        over = {grant for grant, held in self.held.items() if at >= held.end and not held.holder.get("keep", False)}
        gone = [grant for grant in self.held if silent or grant in over]
        if not gone:
            return
        endings = [
            {"id": self.held[grant].holder["id"], "grant": grant, "why": "lease" if silent else "time"}
            for grant in gone
        ]
        for grant in gone:
            self._end(grant, "lease" if silent else "its time is over")
        self.trace("end")
        self.publish(endings)

    # "Checking a command", "Votes", "State"

    def on_command(self, query: zenoh.Query) -> None:
        try:
            self.commands.put_nowait((now(), query))
        except queue.Full:
            with query:
                query.reply_err(json.dumps(Refused("busy", "64 commands wait").problem), encoding=encoding("Problem"))

    def work(self) -> None:
        while True:
            arrived, query = self.commands.get()
            command = payload_of(query)
            if command.get("grant") is not None and self.early(grant_of(command["grant"])):
                self.read()
            respond(query, str(query.key_expr), lambda query: self.obey(query, command, arrived), "Done")  # noqa: B023

    def early(self, grant: Grant) -> bool:
        return self.behind or grant > (self.term, self.seq) or grant in self.awaited

    def obey(self, query: zenoh.Query, command: Json, arrived: int) -> Json:
        with self.peer.lock:
            if now() - arrived + self.peer.stalled(arrived) > command.get("ttl", 1.0) * SECOND:
                raise Refused("stale", "the command waited longer than its ttl")
            if command.get("grant") is None:
                raise Refused("no_grant", "only under a grant")
            grant, sender = grant_of(command["grant"]), "/".join(str(query.key_expr).split("/")[-2:])
            held = self.held.get(grant)
            if held is None:
                codes = (("ended", grant in self.ended), ("not_yet", self.early(grant)), ("free", not self.held))
                raise Refused(
                    next((code for code, so in codes if so), "not_holder"), f"not held under {grant}", self.term
                )
            if held.holder["client"] != sender:
                raise Refused("wrong_client", f"held by {held.holder['client']}", self.term)
            if now() >= held.end and not held.holder.get("keep", False):
                raise Refused("ended", "its time is over", self.term)
            self.trace("command", grant=grant)
            if command["do"]["name"] == "confirm":
                return {}
            if command["do"]["name"] == "echo":
                return {"result": command["do"].get("value")}
            raise Refused("unknown_command", "confirm or echo")

    def _veto(self, holders: list[Json]) -> str:
        amounts = [holder.get("params", {}) for holder in holders]
        if unknown := {name for amount in amounts for name in amount} - {"rate"}:
            raise Refused("bad_request", f"no such parameter: {sorted(unknown)}")
        total = sum(float(amount.get("rate", 0)) for amount in amounts)
        return f"rate {total:g} is more than {self.capacity}" if total > (self.capacity or 0) else ""

    def on_vote(self, query: zenoh.Query) -> Json:
        said = payload_of(query)
        reason = self._veto(said["holders"])
        return {"proposal": said["proposal"], "accept": not reason, "reason": reason}

    def on_state(self, query: zenoh.Query) -> Json:
        with self.peer.lock:
            promise = payload_of(query).get("promise")
            if promise is not None:
                term = term_of(promise)
                if term < self.term or not self.peer.believes(term, self.term):
                    raise Refused("old_term", "a higher term is obeyed", self.term)
                if term != self.term:
                    self.term, self.seq = term, 0
                if payload_of(query).get("instance", self.instance) == self.instance:
                    self.promised = term
                self.trace("promise", promised=term)
            return self.state()


def run_rcs(peer: Peer, over: threading.Event) -> None:
    rcs = [Rc(peer, name) for name in rcs_of(peer.host)]
    missed: queue.SimpleQueue[Rc] = queue.SimpleQueue()

    def on_grants(sample: zenoh.Sample) -> None:
        said = json.loads(sample.payload.to_bytes())
        with peer.lock:
            if any(term_of(said["term"]) >= rc.term and peer.believes(term_of(said["term"]), rc.term) for rc in rcs):
                peer.heard = now()
            for rc in rcs:
                if rc.on_grants(said):
                    missed.put(rc)

    def read() -> None:
        while True:
            missed.get().read()

    peer.subscribe("rcm/grants", on_grants)
    peer.watch(lambda: None)
    for rc in rcs:
        rc.begin()
    threading.Thread(target=read, daemon=True).start()
    say("up")
    looked = now()
    while not over.wait(0.02):
        with peer.lock:
            for rc in rcs:
                rc.expire()
        peer.tick()
        if now() - looked > SECOND:
            looked = now()
            peer.look()
            for rc in rcs:
                rc.look()


# "A client"


@dataclass
class Request:
    """An open request, and its newest notice."""

    asked: Json
    state: str = "asking"
    place: Any = None
    grant: Any = None
    rcs: list[str] = field(default_factory=list)
    unconfirmed: Json = field(default_factory=dict)
    missing: dict[str, bool] = field(default_factory=dict)
    """RCs that did not confirm its last grant; True if the RC is visible."""
    reachable: bool = False
    last: tuple[Term, int] = (NO_TERM, 0)
    end: int = 0
    due: int = 0
    pause: int = SECOND // 20


class Client(Peer):
    """A thread for each of three jobs, each with one request at a time."""

    def __init__(self, join: Callable[[], zenoh.Session], program: str, fleet: str, host: str, seed: str) -> None:
        super().__init__(join, program, fleet, host, seed)
        self.me = f"{host}/{CLIENT}"
        self.term = NO_TERM
        self.requests: dict[str, Request] = {}
        self.news = threading.Condition(self.lock)
        self.unknown: queue.SimpleQueue[str] = queue.SimpleQueue()
        self.instance = ""
        self.shown = 0
        self.ahead = False
        """An RCM of a lower term has answered."""

    def begin(self) -> None:
        self.subscribe(f"client/{self.me}/notice", self.on_notice)
        self.subscribe("rcm/grants", self.on_grants)
        self.watch(self.ask_all)
        self.serve(f"client/{self.me}/requests", self.on_requests, "ClientRequests")
        self.instance, self.shown = secrets.token_hex(6), now()
        self.declare(lambda session: self.show(session, "client", CLIENT, self.instance))

    def renew(self) -> None:
        """Declare a new token before the old token is undeclared, at most twice a second."""
        with self.lock:
            if now() - self.shown > SECOND // 2:
                self.instance, self.shown = secrets.token_hex(6), now()
                before = self.declared[-1]
                self.declared[-1] = self._makes[-1](self.session)
                before.undeclare()

    # Received messages

    def on_notice(self, sample: zenoh.Sample) -> None:
        notice = json.loads(sample.payload.to_bytes())
        # After a link came back, Zenoh may mix up keys: messages for another key arrive here.
        self.suspect("another message arrives as a notice", so="id" not in notice)
        if "id" in notice:
            self.take(notice)

    def take(self, notice: Json) -> None:
        """ "Order", "Asking": the newest notice counts, however it came."""
        with self.news:
            term = term_of(notice["term"])
            if term < self.term or not self.believes(term, self.term):
                return
            self.term = term
            request = self.requests.get(notice["id"])
            if request is None:
                if notice["state"] != "ended":
                    self.unknown.put(notice["id"])
                return
            order = (term, int(notice["step"]))
            if order <= request.last:
                return
            request.last, before = order, request.grant
            place = notice.get("place")
            if place is not None and request.place is not None and grant_of(place) > grant_of(request.place):
                request.due = now()
            elif place is not None:
                request.place = place
            request.state = notice["state"]
            request.grant = notice.get("grant") if request.state == "running" else None
            request.rcs = notice.get("rcs", []) if request.state == "running" else request.rcs
            request.end = now() + round(notice.get("remaining", 0) * SECOND)
            request.unconfirmed = {}
            known = ("place", "grant", "rcs", "outcome", "reason", "term", "step", "ahead")
            say(request.state, id=notice["id"], before=before, **{name: notice.get(name) for name in known})
            if request.state == "ended" and notice.get("outcome") == "client_lost":
                request.state, request.due = "asking", now()
            if request.state == "ended" and notice.get("outcome") == "completed" and before is None:
                self.ask_anew(request)
            self.news.notify_all()

    def on_rc(self, rc: str, alive: bool) -> None:
        """ "Entering": the link to an RC that did not confirm is back."""
        with self.news:
            for request in self.requests.values():
                if rc in request.missing:
                    back, request.missing[rc] = alive and not request.missing[rc], alive
                    if back and all(request.missing.values()):
                        request.reachable, request.due = True, now()
            self.news.notify_all()

    def ask_anew(self, request: Request) -> None:
        """Request again, under a new id: the hold ended before this client learned of its grant."""
        old, new = request.asked["id"], secrets.token_hex(8)
        say("anew", id=old, new=new)
        request.asked["id"], request.last = new, (NO_TERM, 0)
        request.state, request.due = "asking", now()
        self.requests[new] = self.requests.pop(old)

    def on_grants(self, sample: zenoh.Sample) -> None:
        term = term_of(json.loads(sample.payload.to_bytes())["term"])
        with self.lock:
            if term >= self.term and self.believes(term, self.term):
                self.heard = now()

    def ask_all(self) -> None:
        with self.news:
            for request in self.requests.values():
                request.due, request.pause = now(), SECOND // 20
            self.news.notify_all()

    def on_requests(self, query: zenoh.Query) -> Json:
        """List the open requests, and promise the term ("When an RCM takes the lead")."""
        with self.lock:
            promise = payload_of(query).get("promise")
            if promise is not None:
                if term_of(promise) < self.term or not self.believes(term_of(promise), self.term):
                    raise Refused("old_term", "a higher term is known", self.term)
                self.term = term_of(promise)
            return {"client": self.me, "requests": [self.view(request) for request in self.requests.values()]}

    def view(self, request: Request) -> Json:
        view = request.asked | ({"place": request.place} if request.place is not None else {})
        return view | ({"grant": request.grant, "rcs": request.rcs} if request.grant is not None else {})

    def schedule(self, schema: str, message: Json) -> list[tuple[bool, Json]]:
        replies = self.get(f"rcm/schedule/{self.me}", schema, message)
        for good, answer in replies:
            if good:
                self.take(answer)
        heard = now() - self.heard < HOLD_LEASE // 2
        self.suspect("an RCM is seen that does not answer", so=not replies and (heard or bool(self.leaders)))
        return replies

    def ask(self, request: Request) -> None:
        with self.lock:
            message = self.view(request) | request.unconfirmed | {"op": "request"}
            if self.ahead or request.place is not None:
                message["term"] = self.term
            if request.reachable:
                message["reachable"], request.reachable = True, False
            request.due = now() + round(SECOND * 5 * self.rng.uniform(0.8, 1.2))
            dropped = request.last if request.state == "asking" else None
        replies = self.schedule("Ask", message)
        with self.lock:
            self.ahead = any(good and term_of(answer["term"]) < self.term for good, answer in replies)
            if dropped is not None and request.state == "asking" and dropped != request.last:
                self.renew()
            good = any(good and term_of(answer["term"]) >= self.term for good, answer in replies)
            if good:
                request.pause = SECOND // 20
            for bad in [answer for good, answer in replies if not good]:
                if bad["code"] not in (*TRY_AGAIN, "old_term"):
                    say("refused", id=request.asked["id"], **bad)
            if not good:
                request.due = min(request.due, now() + request.pause)
                request.pause = min(SECOND, 2 * request.pause)

    def command(self, rc: str, grant: Any, action: Json, timeout: float = QUERY_TIMEOUT) -> str:
        """Return the code of a refusal, `unknown` without an answer, or "" on success."""
        sent = now()
        replies = self.get(f"rc/{rc}/command/{self.me}", "Command", {"grant": grant, "do": action}, timeout)
        code = "" if replies and replies[0][0] else str(replies[0][1]["code"]) if replies else "unknown"
        say("commanded", rc=rc, grant=grant, sent=sent, code=code)
        return code

    def confirm(self, request: Request, grant: Any) -> bool:
        """Confirm a grant at all its RCs; return True if all have ("Entering")."""
        refused: list[str] = []
        until = now() + SECOND

        def confirm_at(rc: str) -> None:
            pause = 0.05
            while True:
                code = self.command(rc, grant, {"name": "confirm"}, max(0.05, (until - now()) / SECOND))
                if code not in AGAIN or now() >= until or request.grant != grant:
                    break
                threading.Event().wait(min(pause, max(0.0, (until - now()) / SECOND)))
                pause *= 2
            seen = any(f"/rc/{rc}/" in key for key in list(self.tokens))
            self.suspect(f"{rc} is seen and does not answer", so=seen and code == "unknown")
            if code:
                refused.append(rc)

        threads = [threading.Thread(target=confirm_at, args=(rc,)) for rc in request.rcs]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        with self.lock:
            if request.grant != grant or request.state != "running":
                return False
            if refused:
                request.unconfirmed = {"grant": grant, "rcs": request.rcs, "unconfirmed": refused}
                seen = {"/".join(key.split("/")[-3:-1]) for key in self.tokens if "/rc/" in key}
                request.missing = {rc: rc in seen for rc in refused}
                self.lose(request, "not confirmed")
                return False
            say("entered", id=request.asked["id"], grant=grant)
            return True

    def lose(self, request: Request, why: str) -> None:
        """The client judges the hold as lost, and asks again."""
        say("lost", id=request.asked["id"], grant=request.grant, reason=why)
        request.state, request.grant, request.due = "asking", None, now()

    def use(self, request: Request, grant: Any, lasts: float) -> bool:
        """Use the hold. Return True if the request is over with it: its work is done, or its time is over."""
        until = now() + round(lasts * SECOND)
        while True:
            with self.news:
                if request.grant != grant:
                    return False
                if now() >= until:
                    return True
                if now() >= request.end and not request.asked.get("keep", False):
                    return True
            code = self.command(self.rng.choice(request.rcs), grant, {"name": "echo", "value": 1})
            with self.news:
                if code in NOT_MINE:
                    self.news.wait_for(lambda: request.grant != grant, 1.0)
                    if request.grant == grant and now() < request.end:
                        self.lose(request, f"an RC answered {code}")
                    return bool(request.grant == grant)
                self.news.wait_for(lambda: request.grant != grant, 0.05)

    def serve_request(self, asked: Json, lasts: float, over: threading.Event) -> None:
        request = Request(asked, due=now())
        with self.lock:
            self.requests[asked["id"]] = request
        say("asked", id=asked["id"], **{name: value for name, value in asked.items() if name != "id"})
        while not over.is_set():
            with self.news:
                ready = lambda: request.state in ("running", "ended") or now() >= request.due  # noqa: E731
                self.news.wait_for(ready, min(0.5, max(0.0, (request.due - now()) / SECOND)))
                state, grant, due = request.state, request.grant, now() >= request.due
            if state == "ended":
                break
            if due:
                self.ask(request)
            elif state == "running" and self.confirm(request, grant) and self.use(request, grant, lasts):
                break
        with self.lock:
            del self.requests[asked["id"]]
            ended = request.state == "ended"
            say("gave_up", id=asked["id"], grant=request.grant, ended=ended)
        if not ended:
            self.release(asked["id"], over)

    def release(self, request_id: str, over: threading.Event) -> None:
        """ "Ending": repeated until an RCM answers."""
        pause = 0.05
        while not any(good for good, _ in self.schedule("Release", {"op": "release", "id": request_id})):
            if over.wait(pause):
                return
            pause = min(0.5, 2 * pause)
        say("given_up", id=request_id)

    def job(self, name: str, quiet: threading.Event, over: threading.Event) -> None:
        rng = random.Random(f"{self.host} {name} {self.rng.random()}")  # noqa: S311
        while not quiet.wait(PULSE[name] * rng.uniform(0.5, 1.5)):
            self.serve_request(*draw(rng, name, self.host), over)
        say("quiet", job=name)

    def give_back(self, over: threading.Event) -> None:
        while True:
            self.release(self.unknown.get(), over)

    def watch_lease(self) -> None:
        with self.news:
            if self.stalled() or now() - self.heard < HOLD_LEASE:
                return
            for request in self.requests.values():
                if request.grant is not None:
                    self.lose(request, "no RCM published for the hold lease")
            self.news.notify_all()


def run_client(client: Client, quiet: threading.Event, over: threading.Event) -> None:
    client.begin()
    threads = [threading.Thread(target=client.job, args=(job, quiet, over), daemon=True) for job in JOBS]
    threads.append(threading.Thread(target=client.give_back, args=(over,), daemon=True))
    for thread in threads:
        thread.start()
    say("up")
    looked = now()
    while not over.wait(0.05):
        client.watch_lease()
        client.tick()
        if now() - looked > SECOND:
            looked = now()
            client.look()


def main() -> None:
    what, fleet, host, seed = sys.argv[1:]
    quiet, over = threading.Event(), threading.Event()
    signal.signal(signal.SIGUSR1, lambda *_: quiet.set())
    signal.signal(signal.SIGTERM, lambda *_: over.set())
    config = zenoh.Config()
    block = "transport/link/tx/queue/congestion_control/block/wait_before_close"
    for key, value in {
        "mode": "peer",
        "scouting/multicast/interface": "eth0",
        "scouting/delay": 200,
        "scouting/multicast/autoconnect_strategy": GREATER_CONNECTS,
        "scouting/gossip/autoconnect_strategy": GREATER_CONNECTS,
        "transport/link/tx/lease": LEASE_MS,
        block: LEASE_MS * 1000,
        "transport/unicast/open_timeout": 2 * LEASE_MS,
        "transport/link/tx/queue/size/interactive_high": 8,
        "transport/shared_memory/enabled": False,
        "connect/retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 1.5},
    }.items():
        config.insert_json5(key, json.dumps(value))
    program = "program" if what == "client" else "rcs"

    def join() -> zenoh.Session:
        """Open a session with a greater id than earlier sessions ("Joining a fleet")."""
        config.insert_json5("id", f'"1{secrets.token_hex(9)}0{time.time_ns().to_bytes(8, "little").hex()[4:]}"')
        return zenoh.open(config)

    peer = (Client if what == "client" else Peer)(join, program, fleet, host, seed)
    say("imported", modules=sorted(name for name in sys.modules if name.split(".")[0] == "zscout"))
    if isinstance(peer, Client):
        run_client(peer, quiet, over)
    else:
        run_rcs(peer, over)
    with contextlib.suppress(zenoh.ZError):
        for declared in peer.declared:
            declared.undeclare()
        peer.session.close()  # type: ignore[no-untyped-call]


if __name__ == "__main__":
    main()

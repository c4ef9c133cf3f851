"""A client written from `docs/protocol.md` alone, with plain `zenoh` and `json`: nothing of the project.

    python plain_client.py FLEET HOST NAME MULTICAST_ADDRESS LEASE_SECONDS [HOLD_LEASE_SECONDS]

Takes orders as JSON lines on stdin and tells what happens as JSON lines on stdout:

    {"do": "ask", "id": ..., "arc": ..., "needs": {...}, "priority": 1, "min_runtime": 60}
    {"do": "command", "id": ..., "rc": ..., "action": {...}}       {"do": "release" | "cancel", "id": ...}
    {"do": "quit"}

With `KEYS` in its environment, a folder with ca.pem, cert.pem and key.pem, it joins a fleet with `[security]`; HOST is
the certificate's name.

`rc` is an RC, or a pattern of the request: the command goes to the RC that meets it.
"""

from __future__ import annotations

import json
import os
import queue
import random
import secrets
import sys
import threading
import time
from dataclasses import dataclass, field
from typing import Any

# docs/protocol/joining.md: with few receiving threads one cut-off host stalls every link.
os.environ.setdefault("ZENOH_RUNTIME", "(rx:(worker_threads:16),net:(worker_threads:4),tx:(worker_threads:4))")

import zenoh

MAX_COUNTER = 2**52 - 1
MAX_JUMP = 1_000_000
ASK_AGAIN = 5.0
QUERY_TIMEOUT = 5.0
TRY_AGAIN = ("busy", "not_leading", "internal", "queue_full")
GRACE = 0.25
GREATER_CONNECTS = {"peer": {"to_router": "always", "to_peer": "greater-zid"}}
"""How late a look at the clock may come before it means that this program stood still."""

Json = dict[str, Any]
NO_TERM = (0, "")


def encoding(schema: str) -> zenoh.Encoding:
    return zenoh.Encoding.APPLICATION_JSON.with_schema(f"zscout.{schema}.v1")


def answers(
    session: zenoh.Session, key: str, schema: str, message: Json, timeout: float = QUERY_TIMEOUT
) -> list[tuple[bool, Json]]:
    """All answers on `key`, as (whether it is one, payload). None at all means "unknown"."""
    replies = session.get(
        key,
        payload=json.dumps(message),
        encoding=encoding(schema),
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=timeout,
        congestion_control=zenoh.CongestionControl.BLOCK,
        priority=zenoh.Priority.INTERACTIVE_HIGH,
        express=True,
    )
    found = []
    for reply in replies:
        if reply.ok is not None:
            found.append((True, json.loads(reply.ok.payload.to_bytes())))
        elif reply.err is not None and reply.err.payload.to_bytes() != b"Timeout":
            found.append((False, json.loads(reply.err.payload.to_bytes())))
    return found


def term_of(value: Any) -> tuple[int, str]:
    counter, rcm = value
    return (int(counter), str(rcm))


def absurd(term: tuple[int, str], known: tuple[int, str]) -> bool:
    return term[0] > (MAX_COUNTER if known == NO_TERM else min(MAX_COUNTER, known[0] + MAX_JUMP))


def matches(pattern: str, rc: str) -> bool:
    """docs/protocol/keys.md: Zenoh's own rules, without the number behind the pattern."""
    return bool(zenoh.KeyExpr(pattern.partition("#")[0]).includes(zenoh.KeyExpr(rc)))


def meets(needs: Json, notice: Json) -> bool:
    """Whether the RCs of a hold are one for each need, and no others."""
    if notice["state"] != "running":
        return True
    bound = notice.get("bound", {})
    rcs = [bound.get(need) if "*" in need else need for need in needs]
    if None in rcs or sorted(set(rcs)) != sorted(notice["rcs"]) or len(set(rcs)) != len(rcs):
        return False
    return all(matches(need, rc) for need, rc in bound.items())


@dataclass
class OpenRequest:
    """A request that is not over, and the newest word about it."""

    asked: Json
    state: str = "asking"
    place: Any = None
    seal: Any = None
    grant: Any = None
    rcs: tuple[str, ...] = ()
    bound: Json = field(default_factory=dict)
    last: tuple[tuple[int, str], int] = (NO_TERM, 0)


class PlainClient:
    """One client of one fleet. Zenoh's threads and the main one meet under `lock`."""

    def __init__(self, session: zenoh.Session, fleet: str, host: str, name: str, hold_lease: float) -> None:
        self.session = session
        self.base = f"zscout/{fleet}"
        self.host, self.name = host, name
        self.hold_lease = hold_lease
        self.term = NO_TERM
        self.heard = time.monotonic()
        self.requests: dict[str, OpenRequest] = {}
        self.lock = threading.RLock()
        self.work: queue.SimpleQueue[tuple[str, str]] = queue.SimpleQueue()
        self.over = threading.Event()

    def declare(self) -> list[Any]:
        """docs/protocol/client.md: first what hears, then the token that says so."""
        me = f"{self.base}/client/{self.host}/{self.name}"
        subscriber = self.session.liveliness().declare_subscriber
        token = f"{self.base}/alive/{self.host}/client/{self.name}/{secrets.token_hex(6)}"
        return [
            self.session.declare_subscriber(f"{me}/notice", self.on_notice),
            self.session.declare_subscriber(f"{self.base}/rcm/grants", self.on_grants),
            self.session.declare_queryable(f"{me}/requests", self.on_requests),
            subscriber(f"{self.base}/alive/*/rcm/**", self.on_leader, history=True),
            self.session.liveliness().declare_token(token),
        ]

    # What is heard

    def on_notice(self, sample: zenoh.Sample) -> None:
        self.take(json.loads(sample.payload.to_bytes()))

    def take(self, notice: Json) -> None:
        """Believes a notice if it is newer than all that was heard about its request."""
        with self.lock:
            term = term_of(notice["term"])
            if term < self.term or absurd(term, self.term):
                return
            self.term = term
            request = self.requests.get(notice["id"])
            if request is None:
                if notice["state"] == "running":
                    self.work.put(("release", notice["id"]))
                return
            order = (term, int(notice["step"]))
            if order <= request.last or not meets(request.asked["needs"], notice):
                return
            request.last = order
            new = notice["state"], notice.get("grant")
            changed = new != (request.state, request.grant)
            request.state = notice["state"]
            request.place = notice.get("place", request.place)
            request.seal = notice.get("seal", request.seal)
            request.grant = notice.get("grant") if request.state == "running" else None
            if request.state == "running":
                request.rcs, request.bound = tuple(notice["rcs"]), notice.get("bound", {})
            if request.state == "ended":
                del self.requests[notice["id"]]
            elif request.state == "running" and changed:
                self.work.put(("confirm", notice["id"]))
            tell("notice", **notice)

    def on_grants(self, sample: zenoh.Sample) -> None:
        term = term_of(json.loads(sample.payload.to_bytes())["term"])
        with self.lock:
            if term >= self.term and not absurd(term, self.term):
                self.heard = time.monotonic()

    def on_requests(self, query: zenoh.Query) -> None:
        """A new RCM asks what this client has open, and has it promise to believe no lower term again."""
        with query, self.lock:
            asked = json.loads(query.payload.to_bytes() or b"{}") if query.payload is not None else {}
            promise = term_of(asked["promise"]) if asked.get("promise") is not None else None
            if promise is not None and (promise < self.term or absurd(promise, self.term)):
                problem = {"code": "old_term", "message": "a higher term is known", "term": self.term}
                query.reply_err(json.dumps(problem), encoding=encoding("Problem"))
                return
            if promise is not None:
                self.term = promise
            fields = ("id", "arc", "needs", "priority", "min_runtime", "keep")
            requests = []
            for request in self.requests.values():
                told = {field: request.asked[field] for field in fields if field in request.asked}
                told |= {"place": request.place} if request.place is not None else {}
                told |= {"seal": request.seal} if request.seal is not None else {}
                told |= {"grant": request.grant} if request.grant is not None else {}
                requests.append(told)
            answer = {"client": f"{self.host}/{self.name}", "requests": requests}
            key = f"{self.base}/client/{self.host}/{self.name}/requests"
            query.reply(key, json.dumps(answer), encoding=encoding("ClientRequests"))
        tell("asked_by_rcm", promise=promise, answer=answer)

    def on_leader(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            tell("leader", token=str(sample.key_expr))
            self.work.put(("ask_all", ""))

    # What is asked

    def schedule(self, schema: str, message: Json) -> list[tuple[bool, Json]]:
        replies = answers(self.session, f"{self.base}/rcm/schedule/{self.host}/{self.name}", schema, message)
        for good, answer in replies:
            if good:
                self.take(answer)
        return replies

    def ask(self, request_id: str) -> None:
        with self.lock:
            request = self.requests.get(request_id)
            if request is None:
                return
            message = {"op": "request"} | request.asked
            if request.place is not None:
                message["place"] = request.place
            if request.seal is not None:
                message["seal"] = request.seal
        for good, answer in self.schedule("Ask", message):
            if not good and answer["code"] not in TRY_AGAIN:
                with self.lock:
                    self.requests.pop(request_id, None)
                tell("refused", id=request_id, **answer)

    def confirm(self, request_id: str) -> None:
        """Asks all RCs of a grant side by side; enters when all have said yes, gives it back otherwise."""
        with self.lock:
            request = self.requests.get(request_id)
            grant = request.grant if request is not None else None
            rcs, bound = (request.rcs, request.bound) if request is not None else ((), {})
        if request is None or grant is None:
            return
        refusals: list[Json] = []

        def one(rc: str) -> None:
            answer = self.command(rc, grant, {"name": "confirm"})
            if "code" in answer:
                refusals.append(answer)

        threads = [threading.Thread(target=one, args=(rc,)) for rc in rcs]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        with self.lock:
            if request.grant != grant:
                return
        if refusals:
            tell("not_confirmed", id=request_id, refusals=refusals)
            self.end("release", request_id)
        else:
            tell("entered", id=request_id, grant=grant, rcs=rcs, bound=bound)

    def command(self, rc: str, grant: Any, action: Json) -> Json:
        key = f"{self.base}/rc/{rc}/command/{self.host}/{self.name}"
        replies = answers(self.session, key, "Command", {"grant": grant, "do": action, "ttl": 30.0})
        return replies[0][1] if replies else {"code": "unknown", "message": "no answer"}

    def end(self, op: str, request_id: str) -> None:
        """Releases or cancels; an operation that nobody answers is asked again, for it is idempotent."""
        with self.lock:
            self.requests.pop(request_id, None)
        message = {"op": op, "id": request_id}
        for _ in range(3):
            replies = self.schedule("Release" if op == "release" else "Cancel", message)
            if any(good for good, _ in replies):
                tell("given_up", id=request_id, answer=next(answer for good, answer in replies if good))
                return
        tell("given_up", id=request_id, answer=None)

    # The threads

    def carry_out(self) -> None:
        """What notices and leaders give cause to do: queries may not be made in Zenoh's callbacks."""
        while not self.over.is_set():
            try:
                what, request_id = self.work.get(timeout=ASK_AGAIN * random.uniform(0.8, 1.2))  # noqa: S311
            except queue.Empty:
                what, request_id = "ask_all", ""
            if what == "confirm":
                self.confirm(request_id)
            elif what == "release":
                self.end("release", request_id)
            elif what == "ask":
                self.ask(request_id)
            elif what == "ask_all":
                for known in list(self.requests):
                    self.ask(known)

    def watch_lease(self) -> None:
        """A hold ends here as it does at the RCs when no RCM was heard for the hold lease."""
        step = self.hold_lease / 10
        looked = time.monotonic()
        while not self.over.wait(step):
            now = time.monotonic()
            stalled, looked = now - looked > step + GRACE, now
            with self.lock:
                if stalled or now - self.heard < self.hold_lease:
                    continue
                for request in self.requests.values():
                    if request.state == "running":
                        request.state, request.grant = "asking", None
                        tell("lost", id=request.asked["id"])
                        self.work.put(("ask", request.asked["id"]))

    def obey(self, order: Json) -> None:
        do = order.pop("do")
        if do == "ask":
            with self.lock:
                self.requests[order["id"]] = OpenRequest(order)
            self.work.put(("ask", order["id"]))
        elif do == "command":
            with self.lock:
                request = self.requests.get(order["id"])
                grant = order.get("grant") or (request.grant if request is not None else None)
                bound = request.bound if request is not None else {}
            rc = str(bound.get(order["rc"], order["rc"]))
            tell("done", rc=rc, answer=self.command(rc, grant, order["action"]))
        elif do in ("release", "cancel"):
            self.end(do, order["id"])


OUT = threading.Lock()


def tell(what: str, **details: Any) -> None:
    with OUT:
        print(json.dumps({"what": what} | details), flush=True)


def secured(keys: str | None) -> Json:
    if keys is None:
        return {}
    tls: Json = {"root_ca_certificate": f"{keys}/ca.pem", "enable_mtls": True}
    for side in ("listen", "connect"):
        tls |= {f"{side}_certificate": f"{keys}/cert.pem", f"{side}_private_key": f"{keys}/key.pem"}
    tls |= {"verify_name_on_connect": False, "close_link_on_expiration": False}
    listen = {"listen/endpoints": ["tls/0.0.0.0:0"], "transport/link/protocols": ["tls"]}
    return {**listen, "transport/link/tls": tls}


def settings(multicast: str, lease: float) -> zenoh.Config:
    config = zenoh.Config()
    for key, value in {
        "mode": "peer",
        # "Joining": greater than those of sessions that began before.
        "id": f"1{secrets.token_hex(9)}0{time.time_ns().to_bytes(8, 'little').hex()[4:]}",
        "scouting/multicast/enabled": True,
        "scouting/multicast/address": multicast,
        "scouting/multicast/interface": "lo",
        "scouting/delay": 200,
        "scouting/multicast/autoconnect_strategy": GREATER_CONNECTS,
        "scouting/gossip/autoconnect_strategy": GREATER_CONNECTS,
        "transport/link/tx/lease": round(lease * 1000),
        "transport/shared_memory/enabled": False,
        **secured(os.environ.get("KEYS")),
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


def main() -> None:
    fleet, host, name, multicast, lease, *more = sys.argv[1:]
    with zenoh.open(settings(multicast, float(lease))) as session:
        client = PlainClient(session, fleet, host, name, float(more[0]) if more else 3.0)
        declared = client.declare()
        threads = [threading.Thread(target=run, daemon=True) for run in (client.carry_out, client.watch_lease)]
        for thread in threads:
            thread.start()
        tell("ready", imported=sorted(module for module in sys.modules if module.split(".")[0] == "zscout"))
        for line in sys.stdin:
            order = json.loads(line)
            if order["do"] == "quit":
                break
            client.obey(order)
        client.over.set()
        client.work.put(("", ""))
        for thread in threads:
            thread.join()
        declared.clear()


if __name__ == "__main__":
    main()

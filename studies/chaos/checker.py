"""Checks a run against the promises of docs/promises.md, as far as they are visible from outside: from the events that
its programs logged, in order of time. Promises are numbered as on that page."""

from __future__ import annotations

import bisect
import heapq
import json
from collections import defaultdict, deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeAlias

from studies.chaos.faults import LEASE, Fault
from studies.chaos.work import CAPACITY, CLIENT, HOSTS, NODES, Json, host_of

SECOND: Final = 1_000_000_000
HOLD_LEASE: Final = 3 * SECOND
BELIEF: Final = HOLD_LEASE + 2 * SECOND
AFTER: Final = 10 * SECOND
"""A fault may have effects for this time after its end, if the run did not wait until all clients were served."""
CALM: Final = 3 * SECOND
JUST_OVER: Final = SECOND // 5
"""A leader that was away may lose its first link while others come back, within 0.1 s; clients notice that later."""
TERMS, TERMS_WITHIN = 4, 10 * SECOND
KEPT: Final = 4096

Term: TypeAlias = tuple[int, str]
Grant: TypeAlias = tuple[Term, int]


@dataclass(frozen=True, slots=True)
class Apart:
    """Two running hosts without a working link."""

    pair: frozenset[str]
    since: int
    until: int


@dataclass(frozen=True, slots=True)
class Violation:
    at: int
    promise: str
    text: str


@dataclass(slots=True)
class _Instance:
    heard: tuple[Term, int] = ((0, ""), 0)
    holds: frozenset[Grant] = frozenset()
    ended: dict[Grant, None] = field(default_factory=dict)


@dataclass(slots=True)
class _Open:
    asked: Json
    place: Grant | None = None
    worse_since: int | None = None
    granted: bool = False
    held: tuple[Grant, int] | None = None
    """Its last hold and its beginning: a new leader may return a hold that is still in force."""
    outcome: str | None = None
    believed: tuple[Grant, int, list[str]] | None = None
    """The hold that its client believes in, since when, and its RCs."""
    entered: Grant | None = None
    """The last grant that all its RCs have confirmed to the client."""


class Checker:
    """Call `take` for each event, and then `finish`."""

    def __init__(self, faults: Sequence[Fault] = (), apart: Sequence[Apart] = ()) -> None:
        self.faults, self.apart = faults, apart
        self.found: list[Violation] = []
        self._instances: defaultdict[tuple[str, str], _Instance] = defaultdict(_Instance)
        self._obeyed: dict[str, Grant] = {}
        self._done: defaultdict[str, list[tuple[int, Grant]]] = defaultdict(list)
        """By exclusive RC: times of answered commands, with the newest grant until then."""
        self._began: dict[tuple[str, Grant], int] = {}
        self._over: dict[tuple[str, Grant], int] = {}
        self._owner: dict[Grant, str] = {}
        self._needs: dict[str, dict[str, Json]] = {}
        self._open: dict[tuple[str, str], _Open] = {}
        self._given_up: dict[str, int] = {}
        self._too_much: set[tuple[str, frozenset[Grant]]] = set()
        self._terms: dict[Term, int] = {}
        self._led: dict[str, int] = {}
        """The time of each node's last publication."""
        self._recent: deque[int] = deque()
        self.counts: defaultdict[str, int] = defaultdict(int)

    def broken(self, at: int, promise: str, text: str) -> None:
        self.found.append(Violation(at, promise, text))

    def touched(self, hosts: Iterable[str], at: int, since: int = 0) -> bool:
        """Return True if a fault may have affected one of these hosts between `at - since` and `at`."""
        named = set(hosts)
        return any(
            fault.began <= at and at - since <= fault.over(AFTER) and named & set(fault.touched)
            for fault in self.faults
        )

    def unlinked(self, hosts: Iterable[str], at: int) -> bool:
        """Return True if one of these hosts had no link to a leader's host for longer than the lease, and if that ended
        no longer than CALM before `at`."""
        return any(
            gap.until - gap.since > LEASE * SECOND
            and gap.since <= at <= gap.until + CALM
            and any(gap.pair == {host, node} and led >= gap.since for host in hosts for node, led in self._led.items())
            for gap in self.apart
        )

    def excused(self, hosts: Iterable[str], at: int) -> bool:
        """Return True if a fault, or a leader that is just back, may have caused a loss at one of these hosts."""
        back = [fault for fault in self.faults if fault.mended and 0 <= at - fault.mended <= JUST_OVER]
        led = any(self._led.get(host, 0) >= fault.began - LEASE * SECOND for fault in back for host in fault.touched)
        return led or self.touched(hosts, at) or self.unlinked(hosts, at)

    def take(self, host: str, event: Json) -> None:
        self.counts[event["do"]] += 1
        handler = getattr(self, f"on_{event['do']}", None)
        if "instance" in event:
            self._rc(event)
        elif handler is not None:
            handler(host, event)

    def _rc(self, event: Json) -> None:
        rc, at, instance = event["rc"], event["at"], self._instances[event["rc"], event["instance"]]
        heard, holds = (_term(event["term"]), int(event["seq"])), frozenset(map(_grant, event["holds"]))
        if heard < instance.heard and not (event["do"] == "promise" and heard[0] == instance.heard[0]):
            self.broken(at, "5 obeys no older", f"{rc} went from {instance.heard} back to {heard}")
        if not event["sharable"] and len(holds) > 1:
            self.broken(at, "1 one holder", f"{rc} is held under {sorted(holds)}")
        for grant in sorted(holds - instance.holds):
            if grant in instance.ended:
                self.broken(at, "6 no second beginning", f"{rc} begins {grant} again")
            owner = self._owner.get(grant, "")
            # As its links return, a leader that was cut off may grant again before it knows the present leader.
            if at - self._given_up.get(owner, at) > CALM and not self.touched(HOSTS, at, CALM):
                self.broken(at, "15 nothing after giving up", f"{rc} begins {grant} for {owner}")
            self._began.setdefault((rc, grant), at)
        for grant in instance.holds - holds:
            self._over[rc, grant] = at
            instance.ended[grant] = None
            if len(instance.ended) > KEPT:
                instance.ended.pop(next(iter(instance.ended)))
        instance.heard, instance.holds = heard, holds
        if event["do"] == "command":
            self._command(event, holds)
        if event["sharable"] and rc in CAPACITY:
            known = [self._needs.get(self._owner.get(grant, ""), {}).get(rc, {}) for grant in holds]
            total = sum(float(amounts.get("rate", 0)) for amounts in known)
            if total > CAPACITY[rc] and (rc, holds) not in self._too_much:
                self._too_much.add((rc, holds))
                self.broken(at, "4 capacity", f"{rc} carries {total:g} of {CAPACITY[rc]}: {sorted(holds)}")

    def _command(self, event: Json, holds: frozenset[Grant]) -> None:
        rc, grant = event["rc"], _grant(event["grant"])
        if grant not in holds:
            self.broken(event["at"], "3 only holders command", f"{rc} obeys {grant}, held under {sorted(holds)}")
        if not event["sharable"]:
            if grant < (newest := self._obeyed.get(rc, grant)):
                self.broken(event["at"], "2 no older command", f"{rc} obeys {grant} after {newest}")
            self._obeyed[rc] = max(newest, grant)

    def on_killed(self, host: str, event: Json) -> None:
        for (rc, _), instance in self._instances.items():
            if host_of(rc) == host:
                for grant in instance.holds:
                    self._over[rc, grant] = event["at"]
                instance.holds = frozenset()
        for key in [key for key in self._open if key[0] == host]:
            del self._open[key]

    def on_mended(self, host: str, event: Json) -> None:
        """An RC's host was cut off or frozen until now: its holds must have ended after the hold lease."""
        for (rc, _), instance in self._instances.items():
            if host_of(rc) == host:
                for grant in instance.holds:
                    if event["at"] - max(event["since"], self._began.get((rc, grant), 0)) > HOLD_LEASE + SECOND // 2:
                        self.broken(event["at"], "7 silence ends holds", f"{rc} holds {grant} without a leader")

    def on_publish(self, host: str, event: Json) -> None:
        term = _term(event["term"])
        self._led[host] = event["at"]
        for holders in event["rcs"].values():
            for grant, owner, *_ in holders:
                self._owner[_grant(grant)] = owner
        if term in self._terms:
            return
        at = self._terms[term] = event["at"]
        self._recent.append(at)
        while self._recent[0] < at - TERMS_WITHIN:
            self._recent.popleft()
        causes = sum(
            fault.at < at and fault.over(0) > at - TERMS_WITHIN and bool(set(fault.touched) & set(NODES))
            for fault in self.faults
        )
        if len(self._recent) > TERMS + causes:
            self.broken(at, "13 terms", f"{len(self._recent)} terms began within 10 s, with {causes} faults")

    def on_asked(self, host: str, event: Json) -> None:
        self._open[host, event["id"]] = _Open(event)
        self._needs[f"{host}/{CLIENT}/{event['id']}"] = event["needs"]

    def on_anew(self, host: str, event: Json) -> None:
        """The client did not learn of its hold until its time was over, and requests it again under a new id."""
        request = self._open.pop((host, event["id"]), None)
        if request is not None:
            self._open[host, event["new"]] = request
            self._needs[f"{host}/{CLIENT}/{event['new']}"] = request.asked["needs"]

    def on_running(self, host: str, event: Json) -> None:
        request = self._open.get((host, event["id"]))
        if request is None:
            return
        grant = _grant(event["grant"])
        if request.believed is None or request.believed[0] != grant:
            self._disbelieve(host, event["at"], request)
            request.believed = grant, event["at"], event["rcs"]
            if request.held is None or request.held[0] != grant:
                request.held = grant, event["at"]
        request.granted, request.worse_since = True, None

    def on_entered(self, host: str, event: Json) -> None:
        if (request := self._open.get((host, event["id"]))) is not None:
            request.entered = _grant(event["grant"])

    def on_queued(self, host: str, event: Json) -> None:
        request = self._open.get((host, event["id"]))
        if request is None:
            return
        at, place = event["at"], _grant(event["place"]) if event["place"] is not None else None
        if place is not None and request.place is not None and place > request.place:
            request.worse_since = request.worse_since or at
        elif place is not None:
            request.place, request.worse_since = place, None
        self._look(at, host, event["id"], request)
        self.on_lost(host, event)

    def _look(self, at: int, host: str, request_id: str, request: _Open) -> None:
        since = request.worse_since
        if since is not None and at - since > CALM and not self.touched(HOSTS, at, CALM):
            self.broken(at, "11 places", f"{host} {request_id}: worse than {request.place} for 3 s")
            request.worse_since = None

    def on_lost(self, host: str, event: Json) -> None:
        """A hold or wait may be over: by a notice, or by the client's own judgement."""
        request, at = self._open.get((host, event["id"])), event["at"]
        if request is None:
            return
        outcome, held = event.get("outcome"), request.believed
        if outcome == "client_lost" and not self.excused([host], at):
            self.broken(at, "10 living clients are kept", f"{host} {event['id']}: {event['reason']}")
        elif held is not None and (outcome == "lost" or event["do"] == "lost"):
            where = {host, *map(host_of, held[2])}
            if held[0] == request.entered and not self.excused(where, at):
                text = f"{host} {event['id']} lost {held[0]} of {', '.join(held[2])}: {event['reason']}"
                self.broken(at, "10 untouched holds continue", text)
        self._disbelieve(host, at, request)

    def on_ended(self, host: str, event: Json) -> None:
        request = self._open.get((host, event["id"]))
        if request is not None:
            request.outcome = event["outcome"]
            self.on_lost(host, event)

    def on_refused(self, host: str, event: Json) -> None:
        self.broken(event["at"], "9 nothing is thrown away", f"{host} {event['id']} refused: {event['message']}")

    def on_gave_up(self, host: str, event: Json) -> None:
        request = self._open.pop((host, event["id"]), None)
        if request is None:
            return
        self._given_up[f"{host}/{CLIENT}/{event['id']}"] = event["at"]
        self._disbelieve(host, event["at"], request)
        # A hold that may be kept, and had its time, ends when an RC is lost.
        kept = (
            request.outcome == "lost"
            and request.held is not None
            and event["at"] - request.held[1] >= request.asked["min_runtime"] * SECOND
        )
        if event["ended"] and not (request.granted and (request.outcome == "completed" or kept)):
            text = f"{host} {event['id']} ended as {request.outcome}, granted: {request.granted}"
            self.broken(event["at"], "9 nothing is thrown away", text)

    def _disbelieve(self, host: str, at: int, request: _Open) -> None:
        """A client stops believing in a hold: check that all its RCs held it."""
        if request.believed is None:
            return
        grant, since, rcs = request.believed
        request.believed = None
        still = sum(
            max(0, min(fault.over(0), at) - max(fault.at, since))
            for fault in self.faults
            if "freeze" in fault.how and host in fault.hosts
        )
        for rc in rcs:
            began, over = self._began.get((rc, grant), at), self._over.get((rc, grant), at)
            missing = max(began - since, at - over) - still
            if missing > BELIEF:
                text = f"{host} believed in {grant}, and {rc} did not hold it for {missing / SECOND:.1f} s"
                self.broken(at, "8 no half gang", text)

    def on_commanded(self, host: str, event: Json) -> None:
        """A command was answered: no command of an older grant may be obeyed after an answer under a newer grant."""
        rc = event["rc"]
        if event["code"] or rc in CAPACITY:
            return
        grant, done = _grant(event["grant"]), self._done[rc]
        before = bisect.bisect_left(done, (event["sent"],)) - 1
        if before >= 0 and done[before][1] > grant:
            text = f"{rc} obeyed {host} under {grant}, after a command under {done[before][1]}"
            self.broken(event["at"], "2 no older command", text)
        done.append((event["at"], max(grant, done[-1][1] if done else grant)))
        del done[:-KEPT]

    def finish(self, at: int) -> None:
        """Check the end of the run: no request is open, no RC is held."""
        for (host, request), state in sorted(self._open.items()):
            since = (at - state.asked["at"]) / SECOND
            text = f"{host} {request} ({', '.join(state.asked['needs'])}) asked {since:.1f} s ago"
            self.broken(at, "16 all is served", f"{text}, granted once: {state.granted}")
        for (rc, _), instance in sorted(self._instances.items()):
            if instance.holds:
                held = [f"{grant} for {self._owner.get(grant)}" for grant in sorted(instance.holds)]
                self.broken(at, "16 all is forgotten", f"{rc} still has {', '.join(held)}")


def _term(value: Sequence[Any]) -> Term:
    return int(value[0]), str(value[1])


def _grant(value: Sequence[Any]) -> Grant:
    return _term(value[0]), int(value[1])


def events(file: Path) -> Iterator[Json]:
    """The events that a program logged, and its errors."""
    at = 0
    with file.open(errors="replace") as lines:
        for line in lines:
            # The last event of a line: a program that was killed while writing leaves the beginning of another.
            if (start := line.rfind('{"at":')) >= 0 and line.endswith("}\n"):
                event: Json = json.loads(line[start:])
                at = max(at, event["at"])
                yield event
            elif any(word in line for word in (" ERROR ", "Traceback (most", "never retrieved", "panicked")):
                yield {"at": at, "do": "error", "text": line.strip()}


def check(
    folder: Path, faults: Sequence[Fault], marks: Iterable[tuple[str, Json]], end: int, apart: Sequence[Apart] = ()
) -> Checker:
    """Check a whole run: the logs in `folder`, and the faults and marks of the run."""
    checker = Checker(faults, apart)
    streams = [[(event["at"], host, event) for host, event in marks]]
    logs = [_of(host, folder / f"{host}.log") for host in HOSTS if (folder / f"{host}.log").exists()]
    for at, host, event in heapq.merge(*streams, *logs, key=lambda item: item[0]):
        if event["do"] == "error":
            checker.broken(at, "17 no error unseen", f"{host}: {event['text']}")
        elif event["do"] == "imported" and event["modules"]:
            checker.broken(at, "the foreign ones are foreign", f"{host} imported {event['modules']}")
        else:
            checker.take(host, event)
    checker.finish(end)
    return checker


def _of(host: str, file: Path) -> Iterator[tuple[int, str, Json]]:
    """A log's events in order of time. In the file, events of different threads may be slightly out of order."""
    window: list[tuple[int, int, Json]] = []
    for number, event in enumerate(events(file)):
        heapq.heappush(window, (event["at"], number, event))
        if len(window) > KEPT // 16:
            at, _, first = heapq.heappop(window)
            yield at, host, first
    while window:
        at, _, first = heapq.heappop(window)
        yield at, host, first

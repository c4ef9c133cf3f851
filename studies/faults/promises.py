"""Checks of zscout's promises under faults (docs/promises.md), as far as they are visible in a simulated fleet.

`device.py` checks the promises about a device at every event; this module checks the beliefs of clients and leaders.
Some promises hold only after a time of recovery, whose clock restarts with every fault."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from itertools import chain, product
from typing import TYPE_CHECKING, Any, Final, TypeAlias

from zscout.drivers.instances import InstanceState
from zscout.messages import absurd
from zscout.scheduling.model import ArcStatus
from zscout.scheduling.reason import ReasonCode
from zscout.types import NO_TERM, SECOND, ArcId, Grant, Ns, Place, Term

if TYPE_CHECKING:
    from zscout.behaviors.client.client import Client
    from zscout.behaviors.client.request import OpenArc
    from zscout.drivers.resource_controller import ResourceController
    from zscout.services.rcm.rcm import Rcm

HALF_A_GANG: Final = 2.0
"""Seconds beyond the hold lease for which a client may believe in a hold that some of its RCs do not hold."""
COME_RIGHT: Final = 3.0
"""Seconds without any fault within which a leader abandoned by RCs steps down, and clients' places are those that the
leader knows."""
TERMS_OF_A_FAULT: Final = 2
TERMS_WITHIN: Final = 10.0
"""Within these seconds at most TERMS_OF_A_FAULT terms begin for each fault, counting two faults at least."""
IN_AGREEMENT_WITHIN: Final = 1.5
"""Seconds without any fault within which an RC holds the holds that its RCM publishes, in a single instance."""
UNLED: Final = 0.5
"""Seconds beyond the hold lease after which an RC without a publishing RCM has no holder."""
JUST_NOW: Final = 0.1
"""Seconds that two looks of the checker take: a tolerance for events between them."""
LEFT_OVER: Final = 7.0
"""Seconds after the last hold's end within which only its outcome is remembered."""

PROTECTED: Final = 1.0
"""Seconds for which a leader may not know yet that only operators preempt a hold, as published first."""

UNUSED: Final = 0.3
"""Seconds of a hold's time that may pass before its program learns that its devices are ready."""

LOSSES: Final = ("lost", "client_lost")

Rank: TypeAlias = tuple[int, Ns, Place]


class Promises:
    """Receives the events of a run, and calls `broken(text)` for each broken promise. Times are virtual seconds.
    `strict`: the strategy grants in rank order. `thief`: the client that asks at the places of others."""

    def __init__(
        self, broken: Callable[[str], None], now: Callable[[], float], hold_lease: float, *, strict: bool, thief: str
    ) -> None:
        self._broken, self._now, self._strict, self._thief = broken, now, strict, thief
        self._hold_lease, self._half_a_gang = hold_lease, hold_lease + HALF_A_GANG
        self.terms: dict[Term, float] = {}
        """The terms of all leaders, with the time when each was first seen."""
        self.led: dict[str, Term] = {}
        """By node: the highest term in which it led, unless its disk was emptied since."""
        self.unheard = False
        """True if no publication of an RCM arrives, or no token of a new RCM. Then a term begins every few seconds."""
        self._begun: list[float] = []
        """When terms began, except while `unheard`."""
        self._newest: dict[str, tuple[Term, int]] = {}
        """By ARC: (term, step) of the newest notice to its client."""
        self._arc_of: dict[str, str] = {}
        """The ARC of each published grant."""
        self._ended_by: dict[str, set[str]] = {}
        """By term: ARCs that its RCM has ended for good."""
        self._over: set[str] = set()
        """ARCs that their clients have ended."""
        self._granted: dict[str, tuple[str, list[str]]] = {}
        """Grant and RCs of each ARC that runs according to its client."""
        self._had: dict[str, set[str]] = {}
        """By grant: the RCs that have held it."""
        self._taken: set[str] = set()
        """Grants that an RCM has ended other than for a loss."""
        self._taken_away: set[str] = set()
        """Grants of `_taken` that were neither released nor handed over."""
        self._protected: dict[str, tuple[float, float]] = {}
        """By grant: when it was first published, and the time then published from which only operators preempt it.
        (None of these programs is an operator.)"""
        self.delayed = -math.inf
        """The last time at which messages were late: RCs that learned of a hold late end it later, and report that."""
        self._interrupted: set[str] = set()
        """Grants that ended at an RC without the beginning of another grant of the same ARC."""
        self._owner: dict[str, str] = {}
        """By ARC: the client with the last notice that it waits or runs."""
        self._handed: dict[str, tuple[str, str]] = {}
        """By ARC: its old client, and its grant at the hand-over, until the new client has a notice of its state."""
        self._dropped: dict[str, float] = {}
        """ARCs whose clients were taken for gone, and when."""
        self._places: dict[tuple[str, str], Place] = {}
        self._obeyed: dict[str, tuple[Any, int]] = {}
        """By instance of an RC: the newest (term, seq)."""
        self._promised: dict[str, Any] = {}
        self._answers: dict[tuple[str, str], set[str]] = {}
        """By instance and term: the holds that the instance reported when it promised this term."""
        self._held: dict[str, set[str]] = {}
        self._ended: dict[str, set[str]] = {}
        self._since: dict[tuple[object, ...], float] = {}
        """Start of each condition that must not last."""
        self._running: dict[Term, set[Grant]] = {}
        self._queued: dict[Term, dict[ArcId, Rank]] = {}
        self._believed: dict[str, Term] = {}
        """By client: the highest term of a leader that it has received."""
        self._silent: dict[str, Ns] = {}
        """By client: the time without a leader at the last look, because a client that goes back has just found one."""
        self._seen: dict[Term, int] = {}
        """By term: the number of instants that its RCM had decided at the last look."""

    def event(self, what: Mapping[str, Any]) -> None:
        """Check a line of `zscout.trace`: the promises that an RC keeps at every event, whatever it receives."""
        if what["do"] == "publish":
            ended = self._ended_by.setdefault(str(what["term"]), set())
            self._check_preemptions(what)
            self._taken |= {str(grant) for grant, outcome in what["ends"] if outcome not in LOSSES}
            kept = (*LOSSES, "released", "handed_over")
            self._taken_away |= {str(grant) for grant, outcome in what["ends"] if outcome not in kept}
            for rc, holders in what["rcs"].items():
                for grant, arc, *_ in holders:
                    answer = self._answers.get((what["instances"].get(rc), str(what["term"])))
                    if grant[0] != what["term"] and answer is not None and str(grant) not in answer:
                        self._broken(f"{rc} is published to hold {grant} of before, and had answered that it does not")
                    self._arc_of[str(grant)] = arc
                    if arc in ended:
                        self._broken(f"{rc} is held by {arc}, which the same RCM has ended")
            return
        if what["do"] == "over":
            self._ended_by.setdefault(str(what["term"]), set()).add(what["arc"])
            return
        if what["do"] == "reopened":
            # Its time passed while its RCs settled.
            self._ended_by.get(str(what["term"]), set()).discard(what["arc"])
            return
        rc, instance, known = what["rc"], what["instance"], (what["term"], what["seq"])
        before = self._obeyed.get(instance, known)
        if known < before:
            self._broken(f"{rc} went back from {before} to {known}")
        self._obeyed[instance] = max(known, before)
        promised = self._promised.get(instance, known[0])
        if known[0] < promised:
            self._broken(f"{rc} obeys {known[0]}, and has promised {promised}")
        if what["do"] == "promise":
            self._answers.setdefault((instance, str(what["promised"])), set()).update(map(str, what["holds"]))
            self._promised[instance] = max(what["promised"], promised)
        held, ended = {str(grant) for grant in what["holds"]}, self._ended.setdefault(instance, set())
        begins, ends = held - self._held.get(instance, set()), self._held.get(instance, set()) - held
        for grant in begins:
            self._had.setdefault(grant, set()).add(rc)
        continued = {self._request_of(grant) for grant in begins}
        self._interrupted |= {grant for grant in ends if self._request_of(grant) not in continued}
        ended |= ends
        if again := held & ended:
            self._broken(f"{rc} holds {', '.join(sorted(again))} again")
        self._held[instance] = held
        if what["do"] == "command" and str(what["grant"]) not in held:
            self._broken(f"{rc} obeyed a command under {what['grant']}, which it does not hold")

    def _check_preemptions(self, published: Mapping[str, Any]) -> None:
        for grant, outcome in published["ends"]:
            first, protected = self._protected.get(str(grant), (self._now(), math.inf))
            since = self._now() - protected
            if outcome == "preempted" and since > PROTECTED and first > self.delayed:
                self._broken(f"{grant} is preempted, though it was protected {since:.1f} s ago")
        for grant, *_, left, protected in chain.from_iterable(published["rcs"].values()):
            if protected is not None:
                self._protected.setdefault(str(grant), (self._now(), self._now() + left - protected))

    def forget_client(self, name: str) -> None:
        """The client died: its promises ended with its process."""
        self._believed.pop(name, None)
        self._silent.pop(name, None)
        self._places = {key: place for key, place in self._places.items() if key[0] != name}

    def notified(self, name: str, arc: OpenArc, term: Term, *, touched: bool) -> None:
        """A client, which believes no lower term, has news of a request. `touched`: a fault may affect it or the
        RCs."""
        full = f"{name}/{arc.id}"
        known = self._newest.get(full, arc._last)
        if known[0] > term:
            known = arc._last  # this client went back, as it may: see `check_reverted_clients`
        if arc._last != known and arc._last < max(known, (term, 0)):
            self._broken(f"{name} {arc.name} believes {arc._last} after {max(known, (term, 0))}")
        self._newest[full] = max(arc._last, known)
        was_over = full in self._over
        if arc.open:
            self._over.discard(full)
        else:
            self._over.add(full)
        if arc.outcome == "lost" and arc.reason.startswith("the RCM refuses it"):
            self._broken(f"{name} {arc.name} was taken, and then refused: {arc.reason}")
        held, granted = self._granted.pop(full, ("", [])), ""
        if arc.outcome == "completed" and not held[0] and not was_over:
            self._broken(f"{name} {arc.name} had its time, and its client never knew of it")
        if arc.grant is not None:
            granted = _written(arc.grant)
            self._granted[full] = granted, arc.rcs
        self._follow_hand_over(name, arc, held, touched=touched)
        set_aside = arc.state == "queued" and arc.outcome is None
        lost = (arc.outcome in LOSSES or granted not in ("", held[0]) or set_aside) and self._stood(*held)
        # A direct program that has left does not return: its client releases such a grant.
        given_back = arc._unconfirmed is not None or (
            arc.direct and arc.why is not None and arc.why.code == ReasonCode.UNCONFIRMED
        )
        if (lost or arc.outcome == "client_lost") and not given_back and arc._unserved is None and not touched:
            how = f"was granted again {granted}" if granted else arc.outcome or "waits again"
            self._broken(f"{name} {arc.name} {how}, though no fault touched it: {arc.reason}")
        if arc._place is not None:
            before = self._places.setdefault((name, arc.id), arc._place)
            if arc._place > before:
                self._broken(f"the place of {name} {arc.name} got worse: {before}, then {arc._place}")
        if arc.outcome == "client_lost":
            self._dropped[full] = self._now()
        if arc.outcome == "client_lost" and not arc.open:
            self._broken(f"{name} lives, and was dropped")

    def had_its_time(self, name: str, arc: OpenArc, rcs: Sequence[str], ready: Collection[float | None]) -> None:
        """A hold that no fault touched ends after its time. `ready`: when each of its slow devices became usable."""
        since = max((self._now() if at is None else at for at in ready), default=-math.inf)
        had = self._now() - since
        if had < float(arc.min_runtime) - UNUSED:
            asked = f"{had:.1f} of {arc.min_runtime} s"
            self._broken(f"{name} {arc.name} could use {' '.join(rcs)} for {asked}: it lost the rest to their start")

    def _follow_hand_over(self, name: str, arc: OpenArc, held: tuple[str, list[str]], *, touched: bool) -> None:
        """Check that the new client holds what the old client handed over, unless an RCM that knew of it took it."""
        grant, rcs = held
        if arc.state == "moved":
            had = rcs and self._had.get(grant, set()).issuperset(rcs)
            if had and self._owner.get(arc.id) == name and not touched:
                self._handed[arc.id] = name, grant
        elif arc.state in ("queued", "running"):
            self._owner[arc.id] = name
            old, grant = self._handed.pop(arc.id, (name, ""))
            lost = arc.state == "queued" or grant in self._interrupted
            if lost and grant not in self._taken_away and name != old and not touched:
                self._broken(f"{name} {arc.name} was held as it was handed over, and is not: {arc.reason}")

    def _request_of(self, grant: str) -> str:
        """The request id of the grant's ARC, which is the same at any client."""
        return self._arc_of.get(grant, grant).split("/")[-1]

    def _stood(self, grant: str, rcs: Sequence[str]) -> bool:
        """Return True if this hold was in force: all its RCs held it, and no RCM ended it other than for a loss."""
        return bool(rcs) and grant not in self._taken and self._had.get(grant, set()).issuperset(rcs)

    def look(
        self,
        clients: Mapping[str, Client],
        rcs: Mapping[str, ResourceController],
        leaders: Mapping[str, Rcm],
        silence: Mapping[str, Ns],
        *,
        calm: bool,
        lasting: Mapping[tuple[object, ...], float],
    ) -> None:
        """Check the conditions that hold at any time, for processes that are not stopped. `silence`: since each running
        RC last received a publication, by its clock. `calm`: there is no fault now. `lasting`: further conditions that
        must not last, with their longest times."""
        for rcm in leaders.values():
            if self.terms.setdefault(rcm.term, self._now()) == self._now() and not self.unheard:
                self._begun.append(self._now())
            if self._strict:
                self._in_order(rcm)
            given = {*self._places.values()}
            for arc in rcm.core.arcs_of(self._thief):
                if (place := rcm.core.place_of(arc)) in given:
                    self._broken(f"{arc} has a place that was given to another: {place}")
        lasting = {**lasting, **dict.fromkeys(_half_gangs(clients, rcs), self._half_a_gang)}
        lasting |= dict.fromkeys(_unled(rcs, silence), UNLED)
        if calm:
            come_right = (*_left(leaders, rcs), *_worse_places(clients, leaders), *self._given_up(rcs))
            lasting |= dict.fromkeys(come_right, COME_RIGHT)
            lasting |= dict.fromkeys((*_doubles(rcs), *_at_odds(leaders, rcs)), IN_AGREEMENT_WITHIN)
        self._since = {key: self._since.get(key, self._now()) for key in lasting}
        for key, longest in lasting.items():
            if self._now() - self._since[key] > longest:
                self._broken(f"for more than {longest:g} s: {' '.join(map(str, key))}")

    def check_reverted_clients(self, clients: Mapping[str, Client], silence: Mapping[str, Ns]) -> None:
        """A client returns to a lower term only from one that it only promised, or after a hold lease of `silence`."""
        for name, client in clients.items():
            term, before = client.internals.term, self._believed.get(name, NO_TERM)
            self._believed[name] = client.internals.rcm._received_term
            silent, self._silent[name] = self._silent.get(name, 0), silence[name]
            if term < before and silent / SECOND < self._hold_lease - JUST_NOW:
                self._broken(f"{name} went back from {before} to {term}, though that leader published recently")

    def check_leaders_terms(self, leaders: Mapping[str, Rcm]) -> None:
        """A node whose disk was not emptied never leads in a lower term than before."""
        for name, rcm in leaders.items():
            before = self.led.get(name, NO_TERM)
            if rcm.term < before:
                self._broken(f"{name} leads in {rcm.term}, and led in {before}")
            self.led[name] = max(rcm.term, before)

    def _in_order(self, rcm: Rcm) -> None:
        """Of two waiting ARCs the better-ranked is granted first, if it needs no other RCs."""
        if self._seen.get(rcm.term) == rcm.core.batches:
            return
        self._seen[rcm.term] = rcm.core.batches
        running, queued = self._running.get(rcm.term, set()), self._queued.get(rcm.term, {})
        status = rcm.core.status()
        granted = [arc for arc in status.running if arc.hold and arc.hold.grant not in running and arc.id in queued]
        # An ARC whose client was taken for gone has waited only since then.
        waited = [
            arc
            for arc in status.queued
            if queued.get(arc.id) == _rank(arc)
            and _is_next(arc)
            and self._now() - self._dropped.get(arc.id, 0) > JUST_NOW
        ]
        for arc, other in product(granted, waited):
            if _rank(other) < _rank(arc) and other.needs.keys() <= arc.needs.keys():
                self._broken(f"{arc.name} was granted before {other.name}, which ranks before it")
        self._running[rcm.term] = {arc.hold.grant for arc in status.running if arc.hold is not None}
        sharable = {rc.name for rc in status.rcs if rc.sharable}
        self._queued[rcm.term] = {
            arc.id: _rank(arc) for arc in status.queued if not arc.needs.keys() & sharable and _is_next(arc)
        }

    def _given_up(self, rcs: Mapping[str, ResourceController]) -> Iterator[tuple[object, ...]]:
        for rc in rcs.values():
            for grant in rc.holds.held:
                if (arc := self._arc_of.get(_written(grant))) in self._over:
                    yield rc.name, "is held by", arc, "which its client has ended"

    def at_end(
        self,
        clients: Mapping[str, Client],
        leaders: Mapping[str, Rcm],
        faults: Sequence[tuple[float, float]],
        excused: Collection[str] = (),
    ) -> None:
        """Everything was served, and `LEFT_OVER` has passed. `faults`: beginning and end of each; `excused`: clients
        that may still wait."""
        for at in self._begun:
            terms = sum(at <= other < at + TERMS_WITHIN for other in self._begun)
            felt = sum(begin < at + TERMS_WITHIN and end > at for begin, end in faults)
            if terms > TERMS_OF_A_FAULT * max(2, felt):
                self._broken(f"{terms} terms began within {TERMS_WITHIN:g} s")
        for name, client in clients.items():
            if name not in excused and (left := {*client._store.arcs, *client._store.withdrawn}):
                self._broken(f"{name} still keeps {', '.join(sorted(left))}")
        for host, rcm in leaders.items():
            state, waiting = rcm.core.status(), rcm.leader.operations.waiting
            left = {arc.id for arc in (*state.running, *state.queued)} | waiting.keys()
            if left := {arc for arc in left if arc.rpartition("/")[0] not in excused}:
                self._broken(f"the leader on {host} still keeps {', '.join(sorted(left))}")


def _written(grant: Grant) -> str:
    return str([[*grant.term], grant.seq])


def _rank(arc: ArcStatus) -> Rank:
    return (-arc.request.priority, arc.request.min_runtime, arc.place)


def _is_next(arc: ArcStatus) -> bool:
    """Return True if it waits only for RCs that others hold."""
    return arc.reported is None or arc.reported.code is ReasonCode.HELD


def _half_gangs(clients: Mapping[str, Client], rcs: Mapping[str, ResourceController]) -> Iterator[tuple[object, ...]]:
    held = {(rc.name, grant) for rc in rcs.values() for grant in rc.holds.held}
    for name, client in clients.items():
        for arc in client._store.open:
            if arc.grant is not None and not all((rc, arc.grant) in held for rc in arc.rcs):
                yield name, "believes in", arc.grant, "which not all of its RCs hold"


def _at_odds(leaders: Mapping[str, Rcm], rcs: Mapping[str, ResourceController]) -> Iterator[tuple[object, ...]]:
    """RCs whose holds differ from those of the RCM that they obey."""
    for rcm in leaders.values():
        for rc in rcs.values():
            if rc.holds.term == rcm.term and rc.instances.state is InstanceState.SERVES:
                known = {arc.hold.grant for arc in rcm.core.holders(rc.name) if arc.hold is not None}
                for grant in known ^ rc.holds.held.keys():
                    yield rc.name, "holds" if grant in rc.holds.held else "lacks", grant, "unlike its RCM's state"


def _unled(rcs: Mapping[str, ResourceController], silence: Mapping[str, Ns]) -> Iterator[tuple[object, ...]]:
    for key, span in silence.items():
        if rcs[key].holds.held and span > rcs[key].holds.hold_lease:
            yield key, "is held, though no RCM published for the hold lease"


def _doubles(rcs: Mapping[str, ResourceController]) -> Iterator[tuple[object, ...]]:
    held = Counter(rc.name for rc in rcs.values() if rc.holds.held)
    for name, instances in held.items():
        if instances > 1:
            yield name, "has several instances with holders"


def _left(leaders: Mapping[str, Rcm], rcs: Mapping[str, ResourceController]) -> Iterator[tuple[object, ...]]:
    for host, rcm in leaders.items():
        shunned = rcm.roster.shunned
        if any(rc.holds.term > rcm.term and rc.instance not in shunned for rc in rcs.values()):
            yield host, "leads in", rcm.term, "though an RC obeys a higher term"


def _worse_places(clients: Mapping[str, Client], leaders: Mapping[str, Rcm]) -> Iterator[tuple[object, ...]]:
    for name, client in clients.items():
        for arc in client._store.acknowledged:
            for rcm in leaders.values():
                known = rcm.core.arc(f"{name}/{arc.id}")
                if absurd(rcm.term, client.internals.term):
                    continue  # the client does not ask this leader yet
                if known is not None and arc._place is not None and known.place > arc._place:
                    yield name, arc.name, "is at a worse place than its client knows, in", rcm.term

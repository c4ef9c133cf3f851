"""Operations of clients: they become events of the core, and are answered once the core has decided.

What arrives in one burst is one instant: one pass decides it and one publication has it. Operations on one ARC stay in
their order."""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Iterable, Mapping
from typing import TypeAlias

from msgspec.structs import replace

from zscout.config.fleet import Fleet
from zscout.keyexpr import Sender, check_name, client_of
from zscout.mesh import IncomingQuery, Mesh, Refused
from zscout.mesh.sparse_log import SparseLog
from zscout.mesh.supervision import Supervisor
from zscout.messages import (
    Amounts,
    Ask,
    Book,
    Cancel,
    FindSlots,
    Foresee,
    Foresight,
    HandOver,
    Notice,
    Operation,
    Parameters,
    Release,
    Unbook,
)
from zscout.rcm.admission import Admission
from zscout.rcm.devices import ExpectedDevices
from zscout.rcm.door import check_door
from zscout.rcm.places import arc_id, request_id
from zscout.rcm.recovery import Listed, vouched
from zscout.rcm.request_log import RequestLog, party_info, reason_info
from zscout.rcm.roster import Change, Roster
from zscout.rcm.terms import Source, Word
from zscout.scheduling.core import Core
from zscout.scheduling.forecast import forecast
from zscout.scheduling.model import (
    Cancelled,
    Dropped,
    Effect,
    Granted,
    HandedOver,
    Outcome,
    PlaceShown,
    Queued,
    Reachable,
    Released,
    Requested,
    Unconfirmed,
)
from zscout.scheduling.reason import Party, person
from zscout.scheduling.runtimes import RuntimeEstimator
from zscout.services.rcm.bookings import Bookings
from zscout.types import SECOND, ArcId, ClientId, Place, RcName

log = logging.getLogger(__name__)

Query: TypeAlias = IncomingQuery[Operation]

REPLY_SLACK = 0.1
"""Seconds after an overdue vote in which the first answer is given all the same."""
MAX_BATCH = 64
"""Operations that are decided together at most."""


class RequestHandler:
    """Gathers operations, checks them, and keeps the queries that wait for their answer."""

    def __init__(
        self,
        mesh: Mesh,
        fleet: Fleet,
        core: Core,
        registry: RequestLog,
        roster: Roster,
        devices: ExpectedDevices,
        admission: Admission,
        supervisor: Supervisor,
        emit: Callable[..., None],
        follow: Callable[[Change], None],
        runtimes: RuntimeEstimator | None,
    ) -> None:
        self.mesh, self.core, self._devices = mesh, core, devices
        self._admission, self._authority, self._places = admission, admission.authority, admission.places
        self._knows_all = mesh.now() + fleet.timing.hold_lease
        """From when on an RC that was not seen yet is none of this fleet."""
        self._first_answer_timeout = fleet.timing.vote_timeout / SECOND + REPLY_SLACK
        self._registry, self._roster, self._supervisor = registry, roster, supervisor
        self._strange = SparseLog(log, mesh.now)
        self._flush_guarded = supervisor.guard(self.flush)
        self._follow, self._runtimes = follow, runtimes
        self.notices: list[Notice] = []
        """To be sent, once the caller takes them."""
        self._emit = emit
        """Takes the events of one instant."""
        self.bookings: Bookings
        """Those of this term."""
        self.waiting: dict[ArcId, list[Query]] = {}
        """Operations that are not answered yet, by ARC."""
        self.given_up: set[ArcId] = set()
        """ARCs that end in this burst by their own client's will."""
        self.left: set[ArcId] = set()
        """Those whose programs are gone: a client that started anew gives up what its former life may use yet."""
        self._batch: dict[ArcId, Requested | Cancelled | Released] = {}
        """Operations of the present burst that are not decided yet."""
        self._deferred: dict[Query, None] = {}
        """Asked by clients that believe to hold, or handed over by them, while their RCs have not said so."""
        self._lease = fleet.mesh.lease
        self._moving: dict[int, tuple[Query, HandOver, ClientId, ClientId]] = {}
        """Hand-overs that wait until it is known whether their new client is there, by number."""
        self._moved = 0

    def close(self) -> None:
        """Refuses what still waits: another RCM has to be asked."""
        for query in (
            *(moving[0] for moving in self._moving.values()),
            *self._deferred,
            *(query for queries in self.waiting.values() for query in queries),
        ):
            query.refuse(Refused("not_leading", "this manager stopped leading; try again").problem)

    # Operations

    def on_operation(self, query: Query) -> None:
        sender = self.mesh.keys.sender_of(query.key)
        client = str(sender)
        self._follow(self._roster.heard(self.mesh.now(), client))
        operation = query.message
        check_name(operation.id, "id")
        match operation:
            case Ask():
                self._ask(query, operation, sender, client)
            case Cancel() | Release():
                self._end(query, operation, sender)
            case HandOver():
                self._find_new_client(query, operation, client)
            case Foresee():
                self._forecast(query, operation, sender)
            case Book() | Unbook() | FindSlots():
                self.bookings.handler.on_operation(query)

    def _ask(self, query: Query, ask: Ask, sender: Sender, client: ClientId) -> None:
        self._check_term(ask, sender, client)
        arc = arc_id(client, ask.id)
        self._keep_order(arc)
        undecided = self._may_hold(arc, ask) and self._roster.awaits(self.mesh.now(), arc, ask.rcs)
        undecided = undecided or bool(ask.booking and not self.bookings.settled)
        if undecided and len(self._deferred) < MAX_BATCH:
            self._defer(query)
        elif arc in self.waiting:
            self.waiting[arc].append(query)
        elif self.core.is_open(arc):
            self._registry.enter(arc, ask.arc, estimate=ask.estimate)
            place, known = self._own_place(ask, client), self.core.arc(arc)
            if known is not None and not known.vouched:
                own = Listed(self._admission.form(ask, sender), place)
                self._emit(vouched(known, own, self._admission))
            elif place is not None:
                self._emit(PlaceShown(arc, place))
            if ask.grant is not None and ask.unconfirmed:
                self._emit(Unconfirmed(arc, ask.grant, tuple(sorted(ask.unconfirmed))))
            if ask.reachable:
                self._emit(Reachable(arc))
            query.answer(self._standing(arc, ask))
        elif self._registry.ended(arc) and not self._registry.reopens(arc, ask.grant if ask.unserved else None):
            query.answer(self._registry.notice(self.mesh.now(), arc))
        elif self._goes_on_elsewhere(ask):
            query.answer(self._registry.handed_over(arc, ask.arc))
        else:
            self._enter(query, ask, sender, client, arc)

    def _check_term(self, ask: Ask, sender: Sender, client: ClientId) -> None:
        """Raises Refused for one from a later term: this leader steps down, if that counts."""
        place = ask.place
        if (
            place is not None
            and self.mesh.keys.closed
            and place.term > self.core.term
            and self._places.proves(place, client, ask.was or ask.id, ask.seal)
        ):
            self._follow(Change(higher=[(Word(place.term, Source.SEAL, client, sender.host), None)]))
            raise Refused("old_term", "a leader of a later term gave this place; try again", place.term)
        if ask.term is not None and ask.term > self.core.term:
            self._follow(Change(higher=[(self._roster.client_word(client, ask.term), None)]))
            raise Refused("old_term", f"{sender} has promised a higher term", ask.term)

    def _enter(self, query: Query, ask: Ask, sender: Sender, client: ClientId, arc: ArcId) -> None:
        """Takes a new request. This is the way of every grant: nothing is done here that can be done once it is
        answered."""
        request = self._admission.admit(ask, sender, self)
        if ask.booking:
            request = replace(request, booking=self.bookings.handler.take_up(ask, sender))
            request = self.bookings.dates.dated(request)
        place, replaced, since = None, None, None
        if ask.place is not None and (place := self._own_place(ask, client)) is not None:
            since = self.mesh.now() - round(ask.waited * SECOND)
        elif ask.check and ask.place is None and ask.grant is None:
            self.check_door(ask.needs, waits=ask.wait_for_device)
        self._registry.enter(arc, ask.arc, estimate=ask.estimate)
        asked = Requested(request, place, since)
        if self._may_hold(arc, ask):
            # It ends what it began under that grant before anybody is asked for a vote.
            self._emit(asked)
            query.answer(self._standing(arc, ask))
            return
        if ask.was is not None and ask.was != ask.id:
            before = arc_id(client, ask.was)
            self._keep_order(before)
            replaced = before if place is not None and self.core.is_open(before) else None
        self._gather(query, arc, asked, replaced)

    def _own_place(self, ask: Ask, client: ClientId) -> Place | None:
        """The place that a request shows, if it is its client's. Raises Refused for one that can't be."""
        if ask.place is None:
            return None
        self._admission.check_place(ask.place, self.core.could_have_issued)
        seen = client in self._roster.clients
        if self._places.may_claim(ask.place, client, ask.was or ask.id, ask.seal, seen=seen):
            if self._places.takes_the_word_for(ask.place):
                told = "%s shows a place of term %d that is not known here: it has it"
                self._strange.warning(client, told, client, ask.place.term.counter)
            return ask.place
        self._strange.warning(client, "%s shows a place that is not its own: it has none for that", client)
        return None

    def check_door(self, needs: Mapping[str, Amounts], *, waits: bool = False, may_wait: bool = True) -> None:
        """Raises Refused for what can never start."""
        waits = waits or self.mesh.now() < self._knows_all
        check_door(needs, self._devices.names, self._roster.is_known, self._parameters, waits=waits, may_wait=may_wait)

    def _parameters(self, rc: RcName) -> Parameters | None:
        state = self._roster.reported(rc)
        return state.parameters if state is not None else self._devices.parameters(rc)

    def _may_hold(self, arc: ArcId, ask: Ask) -> bool:
        """Whether its client believes in a grant of an earlier RCM of which this one does not know."""
        if ask.grant is None or ask.grant.term >= self.core.term or ask.unconfirmed or ask.unserved:
            return False
        known = self.core.arc(arc)
        return (known is None or known.hold is None) and not self._registry.ended(arc)

    def _standing(self, arc: ArcId, ask: Ask) -> Notice:
        """How an open ARC stands, for a client that may not have heard how its last hold ended."""
        if ask.grant is not None and not ask.unconfirmed and not ask.unserved and self.core.is_queued(arc):
            return self._registry.interrupted(self.mesh.now(), arc, ask.grant)
        return self._registry.notice(self.mesh.now(), arc)

    def _defer(self, query: Query) -> None:
        self._deferred[query] = None
        self._supervisor.call_later(self._lease, self.resume)

    def resume(self) -> None:
        """Looks again at what was asked by clients that believe to hold."""
        deferred, self._deferred = self._deferred, {}
        for query in deferred:
            try:
                self.on_operation(query)
            except Refused as refused:
                query.refuse(refused.problem)

    def _end(self, query: Query, operation: Cancel | Release, sender: Sender) -> None:
        owner = client_of(operation.client) if operation.client is not None else sender
        if owner.host != sender.host:
            self._authority.check_operator(sender, f"end what is {owner}'s")
        arc = arc_id(str(owner), operation.id)
        self._keep_order(arc)
        if owner == sender:
            self.given_up.add(arc)
            if operation.left:
                self.left.add(arc)
            if not self.core.is_open(arc):
                self._registry.give_up(
                    self.mesh.now(), arc, Outcome.CANCELLED if isinstance(operation, Cancel) else Outcome.RELEASED
                )
        event = Cancelled if isinstance(operation, Cancel) else Released
        who = self._authority.known_as(sender, operation.who)
        self._gather(query, arc, event(arc, "" if owner == sender else person(who, str(sender))))

    def _goes_on_elsewhere(self, ask: Ask) -> bool:
        """Whether another client has this ARC: what one RCM handed over, the next knows by its place only."""
        return ask.place is not None and any(request_id(arc) == ask.id for arc in self.core.at_place(ask.place))

    # Open requests, as limits and quotas count them: those of this burst included

    @property
    def waiting_now(self) -> int:
        return self.core.waiting + len(self._coming())

    def of_client(self, client: ClientId) -> int:
        return self.core.count_of(client) + self._coming().count(client)

    def of_owners(self, names: Collection[str], *but: ArcId) -> int:
        owned = sum(map(self.core.count_of_owner, names))
        owned += sum(client.partition("/")[0] in names for client in self._coming())
        return owned - sum(self.core.is_open(arc) and arc.partition("/")[0] in names for arc in but)

    def held_by(self, names: Collection[str], *but: ArcId) -> int:
        """The number of RCs held by these owners."""
        arcs = filter(None, map(self.core.arc, {*self.core.arcs_of_owners(names)} - {*but}))
        return sum(len(arc.needs) for arc in arcs if arc.hold is not None)

    def _coming(self) -> list[ClientId]:
        """The clients of the requests of this burst."""
        return [event.request.client for event in self._batch.values() if isinstance(event, Requested)]

    def _forecast(self, query: Query, asked: Foresee, sender: Sender) -> None:
        self.flush()
        arc = arc_id(str(sender), asked.id)
        if self.core.arc(arc) is not None:
            raise Refused("bad_request", f"{asked.id} is already a request; ask how it stands")
        now = self.mesh.now()
        request = self._admission.admit(asked, sender, self)
        if asked.check:
            self.check_door(asked.needs, waits=asked.wait_for_device)
        expected = forecast(self.core, now, request, self._runtimes)
        start = expected.starts.get(arc)
        victims = [known.request for known in map(self.core.arc, expected.preempts) if known is not None]
        query.answer(
            Foresight(
                id=asked.id,
                arc=asked.arc,
                starts_in=None if start is None else (start - now) / SECOND,
                preempts=[self._registry.name(victim) for victim in expected.preempts],
                reason=str(expected.reason or ""),
                victims=[party_info(Party(one.arc, one.name, one.priority, one.who), now) for one in victims],
                why=reason_info(expected.reason, now),
            )
        )

    # One burst, one instant

    def _gather(
        self, query: Query, arc: ArcId, event: Requested | Cancelled | Released, replaced: ArcId | None = None
    ) -> None:
        self.waiting.setdefault(arc, []).append(query)
        if not self._batch:
            self.mesh.after_burst(self._flush_guarded)
        if replaced is not None:
            self._batch[replaced] = Released(replaced, f"its client, which asks for it as {request_id(arc)}")
        self._batch[arc] = event
        if len(self._batch) >= MAX_BATCH:
            self.flush()

    def _keep_order(self, arc: ArcId) -> None:
        """Operations on one ARC stay in their order: what was gathered of it goes first."""
        if arc in self._batch:
            self.flush()

    def flush(self) -> None:
        """Hands over what was gathered, first what ends, then what was asked, and sees to the answers."""
        batch, self._batch = self._batch, {}
        if not batch:
            return
        asked, ended = list[Requested](), list[Cancelled | Released]()
        for event in batch.values():
            if isinstance(event, Requested):
                asked.append(event)
            else:
                ended.append(event)
        self._emit(*ended, *asked)
        self.given_up.clear()
        self.left.clear()
        self._answer(event.arc for event in ended)
        undecided = [event.request.arc for event in asked if event.request.arc in self.waiting]
        if undecided:
            # Votes are out: they decide the first answer, if they come.
            self._supervisor.call_later(self._first_answer_timeout, self._answer, undecided)

    def answer_grants(self, effects: Iterable[Effect]) -> set[ArcId]:
        """Answers those whose ARCs an instant has granted, before anybody else is told. Returns those ARCs."""
        answered = set[ArcId]()
        for effect in effects:
            if isinstance(effect, Granted) and effect.arc in self.waiting and self.core.is_running(effect.arc):
                self._answer([effect.arc])
                answered.add(effect.arc)
        return answered

    def answer(self, effects: Iterable[Effect]) -> None:
        """Answers the other operations that an instant's effects have decided."""
        for effect in effects:
            match effect:
                case Granted(arc=arc) | Dropped(arc=arc):
                    self._answer([arc])
                case Queued(arc=arc, settled=True) if self.core.is_queued(arc):
                    self._answer([arc])

    def _answer(self, arcs: Iterable[ArcId]) -> None:
        for arc in arcs:
            if queries := self.waiting.pop(arc, None):
                notice = self._registry.notice(self.mesh.now(), arc)
                for query in queries:
                    query.answer(notice)

    # Handing over

    def _find_new_client(self, query: Query, operation: HandOver, sender: ClientId) -> None:
        to = str(client_of(operation.to))
        for other in operation.others:
            check_name(other, "id")
        arcs = [arc_id(sender, one) for one in (operation.id, *operation.others)]
        now = self.mesh.now()
        if any(self._registry.may_be_held(now, arc) for arc in arcs) and len(self._deferred) < MAX_BATCH:
            self._defer(query)
            return
        self.flush()
        own, goal = self.core.arc(arc_id(sender, operation.id)), self.core.arc(arc_id(to, operation.id))
        if sender == to or own is None:
            self._answer_handed_over(query, operation, sender, to)
            return
        if goal is not None and goal.place == own.place:
            # An RCM before this one has carried it out: by the word of RCs the new client holds it, wherever that is.
            self._hand_over(query, operation, sender, to)
            return
        if len(self._moving) >= MAX_BATCH:
            raise Refused("busy", f"{MAX_BATCH} hand-overs already wait here; try again")
        self._moved += 1
        self._moving[self._moved] = query, operation, sender, to
        self._follow(self._roster.seek(self.mesh.now(), to, self._moved))

    def on_new_client(self, number: int, *, found: bool) -> None:
        """It is known whether the new client of a hand-over has a token."""
        query, operation, sender, to = self._moving.pop(number)
        try:
            if not found:
                raise Refused("unknown_client", f"{to} is not on the mesh")
            self._hand_over(query, operation, sender, to)
        except Refused as refused:
            query.refuse(refused.problem)

    def _hand_over(self, query: Query, operation: HandOver, sender: ClientId, to: ClientId) -> None:
        """All in one batch of events, and so in one publication: nobody gets in between."""
        self.flush()
        moves = self._moves(operation, sender, to)
        if not moves or moves[0].arc != arc_id(sender, operation.id):
            self._answer_handed_over(query, operation, sender, to)
            return
        arcs = [arc for move in moves if (arc := self.core.arc(move.arc)) is not None]
        # An ARC that is open at its new client already is replaced by the one that comes.
        replaced = [move.renamed for move in moves if self.core.is_open(move.renamed)]
        self._admission.check_hand_over(client_of(sender), client_of(to), arcs, replaced, self)
        for move in moves:
            self._registry.rename(move.arc, move.renamed)
        places = {move.renamed: place for move in moves if (place := self.core.place_of(move.arc)) is not None}
        shown = [
            PlaceShown(arc, place) for arc, place in places.items() if self.core.place_of(arc) not in (None, place)
        ]
        self._emit(*shown, *moves)
        queued = [move.renamed for move in moves if self.core.is_queued(move.renamed)]
        self.notices += self._registry.present(self.mesh.now(), queued)
        query.answer(self._registry.notice(self.mesh.now(), moves[0].renamed))

    def _moves(self, operation: HandOver, sender: ClientId, to: ClientId) -> list[HandedOver]:
        """What a hand-over comes to: of the ARCs that it names, those that are open at the sender."""
        moves = []
        for name in dict.fromkeys((operation.id, *operation.others)):
            arc = self.core.arc(arc_id(sender, name))
            if arc is None:
                continue
            renamed = arc_id(to, name)
            taken = self.core.arc(renamed)
            if taken is not None and (taken.request.needs != arc.request.needs or taken.place < arc.place):
                # Else it is the same: its new client has asked for it, and could not prove that it has its place.
                raise Refused("bad_request", f"{to} already has a request {name}; use random ids")
            moves.append(HandedOver(arc.id, to, renamed))
        return moves

    def _answer_handed_over(self, query: Query, operation: HandOver, sender: ClientId, to: ClientId) -> None:
        """Answers a hand-over that was done before. Raises Refused if it was not."""
        goal = arc_id(to, operation.id)
        over = self._registry.ended(goal) and self._registry.ended(arc_id(sender, operation.id))
        if self.core.arc(goal) is None and not over:
            raise Refused("not_running", f"{operation.id} is not open at {sender}")
        # The new client may have missed it, where the RCM changed just then.
        arcs = [arc_id(to, one) for one in (operation.id, *operation.others)]
        self.notices += self._registry.present(self.mesh.now(), arcs)
        query.answer(self._registry.notice(self.mesh.now(), goal))

"""Operations of clients: they become events of the core, and are answered once the core has decided. Pure.

All operations of one step are one instant, decided in one pass and published together. Of two operations on one ARC
the second waits for the next step."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from enum import Enum, auto
from typing import Any, Final, NamedTuple

from msgspec.structs import replace

from zscout.config.fleet import Fleet
from zscout.keyexpr import BadName, Sender, check_name, client_of
from zscout.messages import Ask, Cancel, Foresee, Foresight, HandOver, Notice, Problem, Refused, Release
from zscout.rcm.admission import Admission
from zscout.rcm.booked import FleetBookings
from zscout.rcm.deadlines import Deadlines
from zscout.rcm.device_check import DeviceCheck
from zscout.rcm.places import arc_id, request_id
from zscout.rcm.recovery import Listed, vouched
from zscout.rcm.request_log import RequestLog, party_info, reason_info
from zscout.rcm.roster import Roster
from zscout.rcm.steps import Answer, OperationAsked, Outbox, Ticket
from zscout.rcm.terms import Source, Word
from zscout.scheduling import model
from zscout.scheduling.core import Core
from zscout.scheduling.forecast import forecast
from zscout.scheduling.reason import Party, person
from zscout.scheduling.runtimes import RuntimeEstimator
from zscout.types import SECOND, ArcId, ClientId, Ns, Place

REPLY_SLACK: Final[Ns] = SECOND // 10
"""The first answer waits this much longer than votes may take."""
MAX_BATCH = 64
"""Operations in one instant, and operations that are deferred, at most."""


class _Due(Enum):
    FIRST_ANSWER = auto()
    RESUME = auto()


class _StateAsk(NamedTuple):
    """An Ask that is answered with the ARC's state after the instant, even if votes are missing."""

    ticket: Ticket
    arc: ArcId
    ask: Ask


@dataclass(slots=True)
class _Instant:
    touched: set[ArcId] = field(default_factory=set)
    ended: list[model.Cancelled | model.Released] = field(default_factory=list)
    shown: list[model.Event] = field(default_factory=list)
    asked: list[model.Requested] = field(default_factory=list)
    state_asks: list[_StateAsk] = field(default_factory=list)
    moved: tuple[Ticket, list[ArcId]] | None = None
    """A hand-over and the ARCs that it moves: it has an instant to itself."""
    given_up: set[ArcId] = field(default_factory=set)
    """ARCs that their own clients end."""
    left: set[ArcId] = field(default_factory=set)
    """ARCs whose programs have ended as well, which a restarted client can't know about its former programs."""


class Operations:
    def __init__(
        self,
        fleet: Fleet,
        core: Core,
        registry: RequestLog,
        roster: Roster,
        admission: Admission,
        device_check: DeviceCheck,
        bookings: FleetBookings,
        runtimes: RuntimeEstimator | None,
    ) -> None:
        self.core, self._registry, self._roster, self._device_check = core, registry, roster, device_check
        self._admission, self._bookings, self._runtimes = admission, bookings, runtimes
        self._first_answer: Ns = fleet.timing.vote_timeout + REPLY_SLACK
        self._lease: Ns = round(fleet.mesh.lease * SECOND)
        self._now: Ns = 0
        self._out = Outbox()
        self.instant = _Instant()
        self.waiting: dict[ArcId, list[Ticket]] = {}
        """By ARC: operations without an answer yet."""
        self._deferred: list[OperationAsked] = []
        """Operations of clients that believe in holds which RCs may yet report."""
        self._unchecked: set[ArcId] = set()
        """Requests for devices that may have been unseen only because this leader was new."""
        self._hand_overs: dict[int, tuple[Ticket, HandOver, ClientId, ClientId]] = {}
        """By number: hand-overs whose new client is looked for."""
        self._hand_over_count = 0
        self._deadlines: Deadlines[tuple[_Due, Any]] = Deadlines()

    def can_join(self, asked: OperationAsked) -> bool:
        instant, operation = self.instant, asked.operation
        if not instant.touched:
            return True
        if len(instant.touched) >= MAX_BATCH:
            return False
        match operation:
            case Ask(id=name, was=was):
                client = str(asked.sender)
                return arc_id(client, name) not in instant.touched and (
                    was is None or arc_id(client, was) not in instant.touched
                )
            case Cancel() | Release():
                return arc_id(operation.client or str(asked.sender), operation.id) not in instant.touched
        return False

    def take(self, now: Ns, asked: OperationAsked) -> Outbox:
        self._now = now
        ticket, sender, operation = asked
        client = str(sender)
        try:
            check_name(operation.id, "id")
            match operation:
                case Ask():
                    self._ask(asked, operation, sender, client)
                case Cancel() | Release():
                    self._end(ticket, operation, sender)
                case HandOver():
                    self._find_new_client(asked, operation, client)
                case Foresee():
                    self._forecast(ticket, operation, sender)
        except Refused as refused:
            self._out.at_once.append((ticket, refused.problem))
        except BadName as error:
            self._out.at_once.append((ticket, Problem("bad_name", str(error))))
        out, self._out = self._out, Outbox()
        return out

    def events(self) -> list[model.Event]:
        """Ends come first, new requests last."""
        return [*self.instant.ended, *self.instant.shown, *self.instant.asked]

    def resume(self) -> list[OperationAsked]:
        deferred, self._deferred = self._deferred, []
        return deferred

    def new_client_found(self, now: Ns, number: int, *, there: bool) -> Outbox:
        """Carry out a hand-over whose new client is `there`, i.e. has a token; else refuse it."""
        self._now = now
        ticket, operation, sender, to = self._hand_overs.pop(number)
        try:
            if not there:
                raise Refused("unknown_client", f"{to} is not on the mesh; start it first")
            self._hand_over(ticket, operation, sender, to)
        except Refused as refused:
            self._out.at_once.append((ticket, refused.problem))
        out, self._out = self._out, Outbox()
        return out

    @property
    def next(self) -> Ns | None:
        return self._deadlines.next

    def tick(self, now: Ns) -> Outbox:
        out = Outbox()
        while (due := self._deadlines.pop_due(now)) is not None:
            match due:
                case _Due.FIRST_ANSWER, arcs:
                    out.at_once += self.answers(now, arcs)
                case _Due.RESUME, _:
                    out.then += self.resume()
        return out

    def decided(self, now: Ns, effects: Iterable[model.Effect]) -> Outbox:
        """The answers of an instant other than to grants, and notices to the new clients of ARCs handed over."""
        out, arcs = Outbox(), list[ArcId]()
        for effect in effects:
            match effect:
                case model.Granted(arc=arc) | model.Dropped(arc=arc):
                    arcs.append(arc)
                case model.Queued(arc=arc, settled=True) if self.core.is_queued(arc):
                    arcs.append(arc)
        done, self.instant = self.instant, _Instant()
        out.answers = self.answers(now, arcs + [event.arc for event in done.ended])
        out.answers += [(ticket, self._state_of(now, arc, ask)) for ticket, arc, ask in done.state_asks]
        if done.moved is not None:
            ticket, moved = done.moved
            out.notices = self._registry.present(now, filter(self.core.is_queued, moved))
            out.answers.append((ticket, self._registry.notice(now, moved[0])))
        undecided = [event.request.arc for event in done.asked if event.request.arc in self.waiting]
        if undecided:
            # Votes are missing. They decide the first answer if they arrive in time.
            self._deadlines.set(now + self._first_answer, (_Due.FIRST_ANSWER, undecided))
        return out

    def answers(self, now: Ns, arcs: Iterable[ArcId]) -> list[Answer]:
        answers = list[Answer]()
        for arc in arcs:
            if tickets := self.waiting.pop(arc, None):
                notice = self._registry.notice(now, arc)
                answers += [(ticket, notice) for ticket in tickets]
        return answers

    def _ask(self, asked: OperationAsked, ask: Ask, sender: Sender, client: ClientId) -> None:
        self._check_term(ask, sender, client)
        arc, now, answers = arc_id(client, ask.id), self._now, self._out.at_once
        denied = self._denied(arc, ask, sender)
        if denied is not None and ask.grant is not None:
            self._registry.believe(arc, ask.grant, ask.rcs)
            self.instant.touched.add(arc)
            self.instant.shown.append(denied)
        undecided = (denied is not None or self._may_hold(arc, ask)) and self._roster.awaits(now, arc, ask.rcs)
        undecided = undecided or bool(ask.booking and not self._bookings.settled)
        if undecided and len(self._deferred) < MAX_BATCH:
            self._defer(asked)
        elif arc in self.waiting:
            self.waiting[arc].append(asked.ticket)
        elif self.core.is_open(arc):
            self._ask_again(asked.ticket, ask, sender, client, arc)
        elif self._registry.ended(arc) and not self._registry.reopens(arc, ask.grant if ask.unserved else None):
            answers.append((asked.ticket, self._registry.notice(now, arc)))
        elif ask.place is not None and any(request_id(arc) == ask.id for arc in self.core.at_place(ask.place)):
            # An earlier RCM handed it over to another client: this RCM recognises it by its place only.
            answers.append((asked.ticket, self._registry.handed_over(arc, ask.arc)))
        else:
            self._enter(asked.ticket, ask, sender, client, arc)

    def _check_term(self, ask: Ask, sender: Sender, client: ClientId) -> None:
        """Raises Refused if the request shows a later term, for which this leader steps down if it is believed."""
        place = ask.place
        if (
            place is not None
            and self._roster.closed
            and place.term > self.core.term
            and self._admission.places.proves(place, client, ask.was or ask.id, ask.seal)
        ):
            self._out.higher.append((Word(place.term, Source.SEAL, client, sender.host), None))
            raise Refused("old_term", "a leader of a later term gave this place; try again", place.term)
        if ask.term is not None and ask.term > self.core.term:
            self._out.higher.append((self._roster.client_word(client, ask.term), None))
            raise Refused("old_term", f"{sender} has promised a higher term; ask the leader of that term", ask.term)

    def _ask_again(self, ticket: Ticket, ask: Ask, sender: Sender, client: ClientId, arc: ArcId) -> None:
        """Answer for an open ARC with its state, after the instant if its client reports something new."""
        instant = self.instant
        if arc in self._unchecked and self._now >= self._device_check.settles_at:
            self._unchecked.remove(arc)
            if self.core.is_queued(arc):
                # Its client withdraws a request that is refused.
                self._device_check.check(self._now, ask.needs)
        self._registry.enter(arc, ask.arc, estimate=ask.estimate)
        place, known, shown = self._owned_place(ask, client), self.core.arc(arc), list[model.Event]()
        if known is not None and not known.vouched:
            shown.append(vouched(known, Listed(self._admission.form(ask, sender), place), self._admission))
        elif place is not None:
            shown.append(model.PlaceShown(arc, place))
        if ask.grant is not None and ask.unconfirmed:
            shown.append(model.Unconfirmed(arc, ask.grant, tuple(sorted(ask.unconfirmed))))
        if ask.reachable:
            shown.append(model.Reachable(arc))
        if shown:
            instant.touched.add(arc)
            instant.shown += shown
            instant.state_asks.append(_StateAsk(ticket, arc, ask))
        else:
            self._out.at_once.append((ticket, self._state_of(self._now, arc, ask)))

    def _enter(self, ticket: Ticket, ask: Ask, sender: Sender, client: ClientId, arc: ArcId) -> None:
        """Take a new request. All grants pass here, so anything that can follow the answer is left for later."""
        instant, request = self.instant, self._admission.admit(ask, sender, self)
        if ask.booking:
            request = self._bookings.dated(replace(request, booking=self._bookings.take_up(ask, sender)))
        place, since = None, None
        if ask.place is not None and (place := self._owned_place(ask, client)) is not None:
            since = self._now - round(ask.waited * SECOND)
        elif ask.check and ask.place is None and ask.grant is None:
            self._device_check.check(self._now, ask.needs, waits=ask.wait_for_device)
            if self._now < self._device_check.settles_at and not ask.wait_for_device:
                self._unchecked.add(arc)
        self._registry.enter(arc, ask.arc, estimate=ask.estimate)
        instant.touched.add(arc)
        instant.asked.append(model.Requested(request, place, since))
        if self._may_hold(arc, ask):
            # Answered without waiting for votes, so that its client ends what it runs under that grant.
            instant.state_asks.append(_StateAsk(ticket, arc, ask))
            return
        if place is not None and ask.was is not None and ask.was != ask.id:
            before = arc_id(client, ask.was)
            if self.core.is_open(before):
                instant.touched.add(before)
                instant.ended.append(model.Released(before, f"its client, which asks for it as {ask.id}"))
        self.waiting.setdefault(arc, []).append(ticket)

    def _owned_place(self, ask: Ask, client: ClientId) -> Place | None:
        """The place that a request shows, if its client owns it. Raises Refused for an impossible place."""
        if ask.place is None:
            return None
        places = self._admission.places
        self._admission.check_place(ask.place, self.core.could_have_issued)
        seen = client in self._roster.clients
        if places.may_claim(ask.place, client, ask.was or ask.id, ask.seal, seen=seen):
            if places.is_unproven(ask.place):
                text = f"{client} shows an unknown place of term {ask.place.term.counter}: accepted without proof"
                self._out.strange.append((client, text))
            return ask.place
        self._out.strange.append((client, f"{client} shows a place that it does not own: ignored"))
        return None

    def _may_hold(self, arc: ArcId, ask: Ask) -> bool:
        """Return True if it `_believes` in a hold that is unknown here."""
        known = self.core.arc(arc)
        return self._believes(ask) and (known is None or known.hold is None) and not self._registry.ended(arc)

    def _believes(self, ask: Ask) -> bool:
        """Return True if its client believes in a grant of an earlier RCM."""
        return ask.grant is not None and ask.grant.term < self.core.term and not (ask.unconfirmed or ask.unserved)

    def _denied(self, arc: ArcId, ask: Ask, sender: Sender) -> model.Vouched | None:
        """The client's own request, if it denies the hold that an RC reported for another grant of an earlier RCM."""
        known = self.core.arc(arc)
        if known is None or known.vouched or known.hold is None or known.hold.grant == ask.grant:
            return None
        if not self._believes(ask):
            return None
        word = vouched(known, Listed(self._admission.form(ask, sender), None), self._admission)
        return word if word.bound is None else None

    def _state_of(self, now: Ns, arc: ArcId, ask: Ask) -> Notice:
        """The state of an open ARC, with the end of its last hold if its client may have missed that notice."""
        if ask.grant is not None and not ask.unconfirmed and not ask.unserved and self.core.is_queued(arc):
            return self._registry.interrupted(now, arc, ask.grant)
        return self._registry.notice(now, arc)

    def _defer(self, asked: OperationAsked) -> None:
        self._deferred.append(asked)
        self._deadlines.set(self._now + self._lease, (_Due.RESUME, None))

    def _end(self, ticket: Ticket, operation: Cancel | Release, sender: Sender) -> None:
        owner = client_of(operation.client) if operation.client is not None else sender
        authority = self._admission.authority
        if owner.host != sender.host:
            authority.check_operator(sender, f"end a request of {owner}")
        arc, instant = arc_id(str(owner), operation.id), self.instant
        if owner == sender:
            instant.given_up.add(arc)
            if operation.left:
                instant.left.add(arc)
            if not self.core.is_open(arc):
                outcome = model.Outcome.CANCELLED if isinstance(operation, Cancel) else model.Outcome.RELEASED
                self._registry.give_up(self._now, arc, outcome)
        event = model.Cancelled if isinstance(operation, Cancel) else model.Released
        by = "" if owner == sender else person(authority.certified_who(sender, operation.who), str(sender))
        instant.touched.add(arc)
        instant.ended.append(event(arc, by))
        self.waiting.setdefault(arc, []).append(ticket)

    @property
    def waiting_now(self) -> int:
        return self.core.waiting + len(self.instant.asked)

    def of_client(self, client: ClientId) -> int:
        return self.core.count_of(client) + sum(event.request.client == client for event in self.instant.asked)

    def of_owners(self, names: Collection[str], *but: ArcId) -> int:
        owned = sum(map(self.core.count_of_owner, names))
        owned += sum(event.request.owner in names for event in self.instant.asked)
        excluded = filter(None, map(self.core.arc, but))
        return owned - sum(arc.request.owner in names for arc in excluded)

    def held_by(self, names: Collection[str], *but: ArcId) -> int:
        arcs = filter(None, map(self.core.arc, {*self.core.arcs_of_owners(names)} - {*but}))
        return sum(len(arc.needs) for arc in arcs if arc.hold is not None)

    def _forecast(self, ticket: Ticket, asked: Foresee, sender: Sender) -> None:
        arc, now = arc_id(str(sender), asked.id), self._now
        if self.core.arc(arc) is not None:
            raise Refused("bad_request", f"{asked.id} is already a request; ask for its state instead")
        request = self._admission.admit(asked, sender, self)
        if asked.check:
            self._device_check.check(now, asked.needs, waits=asked.wait_for_device)
        expected = forecast(self.core, now, request, self._runtimes)
        start = expected.starts.get(arc)
        victims = [known.request for known in map(self.core.arc, expected.preempts) if known is not None]
        answer = Foresight(
            id=asked.id,
            arc=asked.arc,
            starts_in=None if start is None else (start - now) / SECOND,
            begin_within=expected.begin_within / SECOND,
            preempts=[self._registry.name(victim) for victim in expected.preempts],
            reason=str(expected.reason or ""),
            victims=[party_info(Party(arc.arc, arc.name, arc.priority, arc.who), now) for arc in victims],
            why=reason_info(expected.reason, now),
        )
        self._out.at_once.append((ticket, answer))

    def _find_new_client(self, asked: OperationAsked, operation: HandOver, sender: ClientId) -> None:
        to = str(client_of(operation.to))
        for other in operation.others:
            check_name(other, "id")
        arcs = [arc_id(sender, name) for name in (operation.id, *operation.others)]
        if any(self._registry.may_be_held(self._now, arc) for arc in arcs) and len(self._deferred) < MAX_BATCH:
            self._defer(asked)
            return
        own, goal = self.core.arc(arc_id(sender, operation.id)), self.core.arc(arc_id(to, operation.id))
        if sender == to or own is None:
            self._answer_handed_over(asked.ticket, operation, sender, to)
        elif goal is not None and goal.place == own.place:
            # An earlier RCM carried it out: RCs report that the new client holds it, so it need not be looked for.
            self._hand_over(asked.ticket, operation, sender, to)
        elif len(self._hand_overs) >= MAX_BATCH:
            raise Refused("busy", f"{MAX_BATCH} hand-overs already wait here; try again")
        else:
            self._hand_over_count += 1
            self._hand_overs[self._hand_over_count] = asked.ticket, operation, sender, to
            self._out.merge(self._roster.find_client(self._now, to, self._hand_over_count))

    def _hand_over(self, ticket: Ticket, operation: HandOver, sender: ClientId, to: ClientId) -> None:
        """Hand over all its ARCs in one instant, so that no other request gets them in between."""
        moves = self._arcs_to_move(operation, sender, to)
        if not moves or moves[0].arc != arc_id(sender, operation.id):
            self._answer_handed_over(ticket, operation, sender, to)
            return
        arcs = [arc for move in moves if (arc := self.core.arc(move.arc)) is not None]
        # ARCs that the new client has open under the same ids are replaced.
        replaced = [move.renamed for move in moves if self.core.is_open(move.renamed)]
        self._admission.check_hand_over(client_of(sender), client_of(to), arcs, replaced, self)
        for move in moves:
            self._registry.rename(move.arc, move.renamed)
        places = {move.renamed: place for move in moves if (place := self.core.place_of(move.arc)) is not None}
        shown = [
            model.PlaceShown(arc, place)
            for arc, place in places.items()
            if self.core.place_of(arc) not in (None, place)
        ]
        instant = self.instant
        instant.shown += [*shown, *moves]
        instant.moved = ticket, [move.renamed for move in moves]
        instant.touched |= {move.arc for move in moves}

    def _arcs_to_move(self, operation: HandOver, sender: ClientId, to: ClientId) -> list[model.HandedOver]:
        """The named ARCs that are open at the sender. Raises Refused."""
        moves = []
        for name in dict.fromkeys((operation.id, *operation.others)):
            arc = self.core.arc(arc_id(sender, name))
            if arc is None:
                continue
            renamed = arc_id(to, name)
            taken = self.core.arc(renamed)
            if taken is not None and (taken.request.needs != arc.request.needs or taken.place < arc.place):
                # Otherwise it is the same request: its new client asked for it, but could not prove its place.
                raise Refused("bad_request", f"{to} already has a request {name}; use random ids")
            moves.append(model.HandedOver(arc.id, to, renamed))
        return moves

    def _answer_handed_over(self, ticket: Ticket, operation: HandOver, sender: ClientId, to: ClientId) -> None:
        """Raises Refused if it was never carried out."""
        goal = arc_id(to, operation.id)
        over = self._registry.ended(goal) and self._registry.ended(arc_id(sender, operation.id))
        if self.core.arc(goal) is None and not over:
            raise Refused("not_running", f"{operation.id} is not open at {sender}")
        # The new client may have missed its notices, if the RCM changed meanwhile.
        arcs = [arc_id(to, name) for name in (operation.id, *operation.others)]
        self._out.notices += self._registry.present(self._now, arcs)
        self._out.at_once.append((ticket, self._registry.notice(self._now, goal)))

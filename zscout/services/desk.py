"""The RCM's desk: operations come in, and are answered once they are decided.

What arrives in one burst is one instant: one pass decides it and one publication tells it. Operations on one
ARC stay in their order.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence

from zscout import clock
from zscout.config import Fleet
from zscout.keyexpr import Sender, check_name, client_of
from zscout.mesh import Mesh, Refused, Request
from zscout.messages import Ask, Cancel, Foresee, Foresight, HandOver, Operation, Release
from zscout.scheduling.core import Core
from zscout.scheduling.events import Asked, Cancelled, Event, HandedOver, Released
from zscout.scheduling.forecast import forecast
from zscout.scheduling.model import SECOND, ArcId
from zscout.services import views
from zscout.services.admission import admit
from zscout.services.notices import Notices
from zscout.services.presence import Presence

REPLY_SLACK = 0.1
MAX_GATHERED = 64
"""Operations that are decided together at most."""


class Desk:
    """Takes operations, gathers bursts, keeps the questions that wait for their answer."""

    def __init__(
        self,
        mesh: Mesh,
        fleet: Fleet,
        core: Core,
        notices: Notices,
        presence: Presence,
        decide: Callable[[Sequence[Event]], None],
    ) -> None:
        self.mesh, self.fleet, self.core = mesh, fleet, core
        self.notices, self.presence = notices, presence
        self._carry_out = decide
        self._answers: dict[ArcId, list[Request[Operation]]] = {}
        self._gathered: dict[ArcId, Asked | Cancelled | Released] = {}
        """Operations of the present burst that are not decided yet."""
        self._given_up: set[ArcId] = set()
        """ARCs that end in this burst by their own client's will."""
        self._finding = 0
        """Hand-overs that wait until it is known whether their new client is there."""
        self._closed = False

    def close(self) -> None:
        """Refuses what still waits: another RCM has to be asked."""
        self._closed = True
        for requests in self._answers.values():
            for request in requests:
                request.refuse(Refused("not_leading", "this RCM stopped leading; ask again").problem)

    def waiting(self, arc: ArcId) -> bool:
        """Whether somebody waits for the first word about `arc`."""
        return arc in self._answers

    def given_up(self, arc: ArcId) -> bool:
        """Whether `arc` ends in this burst by its own client's will."""
        return arc in self._given_up

    def _gather(self, arc: ArcId, event: Asked | Cancelled | Released) -> None:
        """What was asked in one burst is one instant: one pass decides it, one publication tells it."""
        if not self._gathered:
            self.mesh.after_burst(self.decide)
        self._gathered[arc] = event
        if len(self._gathered) >= MAX_GATHERED:
            self.decide()

    def decide(self) -> None:
        """Hands over what was gathered: first what ends, then what was asked."""
        gathered, self._gathered = self._gathered, {}
        if not gathered or self._closed:
            return
        asked = [event for event in gathered.values() if isinstance(event, Asked)]
        ended = [event for event in gathered.values() if not isinstance(event, Asked)]
        try:
            self._carry_out((*ended, *asked))
        except Exception:
            problem = Refused("internal", "the request failed here; see this node's log").problem
            for arc in gathered:
                for request in self._answers.pop(arc, ()):
                    request.refuse(problem)
            raise
        finally:
            self._given_up.clear()
        for event in ended:
            self.answer(event.arc)
        waits = [event.request.arc for event in asked if event.request.arc in self._answers]
        if waits:
            # Votes are out: the first word is theirs, if they come.
            patience = self.fleet.timing.vote_timeout / SECOND + REPLY_SLACK
            asyncio.get_running_loop().call_later(patience, self._answer_all, waits)

    def on_operation(self, request: Request[Operation]) -> None:
        sender = self.mesh.keys.sender_of(request.key)
        operation = request.message
        check_name(operation.id, "id")
        match operation:
            case Ask():
                self._ask(request, operation, sender)
            case Cancel() | Release():
                owner = client_of(operation.client) if operation.client is not None else sender
                arc = views.arc_id(str(owner), operation.id)
                self._in_order(arc)
                if owner == sender:
                    self._given_up.add(arc)
                by = "its client" if owner == sender else str(sender)
                self._answers.setdefault(arc, []).append(request)
                self._gather(arc, Cancelled(arc, by) if isinstance(operation, Cancel) else Released(arc, by))
            case HandOver():
                self._on_hand_over(request, operation, sender)
            case Foresee():
                self._foresee(request, operation, sender)

    def _ask(self, request: Request[Operation], ask: Ask, sender: Sender) -> None:
        arc = views.arc_id(str(sender), ask.id)
        self._in_order(arc)
        if arc in self._answers:
            self._answers[arc].append(request)
        elif self.core.floor.arc(arc) is None and not self.notices.ended(arc):
            if self._goes_on_elsewhere(ask):
                request.answer(self.notices.handed_over(arc, str(sender), ask.arc))
                return
            self._check_room(str(sender))
            wanted = admit(ask, sender, arc, self.core, self.fleet.limits)
            self.notices.call(arc, ask.arc)
            self.presence.expect(str(sender))
            self._answers[arc] = [request]
            needs = ", ".join(sorted(ask.needs))
            self.notices.tell(arc, ask.arc, f"asked for {needs} at priority {ask.priority}")
            since = None if ask.place is None else clock.now() - round(ask.waited * SECOND)
            self._gather(arc, Asked(wanted, ask.place, since))
        else:
            request.answer(self.notices.standing(arc, str(sender), ask.id))

    def _goes_on_elsewhere(self, ask: Ask) -> bool:
        """Whether another client has this ARC: what one RCM handed over, the next knows by its place only."""
        if ask.place is None:
            return False
        arcs = (*self.core.floor.running.values(), *self.core.floor.queued.values())
        return any(arc.place == ask.place and views.request_id(arc.id) == ask.id for arc in arcs)

    def _check_room(self, client: str) -> None:
        """Refuses what is too much at once; what this burst has brought already counts."""
        limits = self.fleet.limits
        coming = [event for event in self._gathered.values() if isinstance(event, Asked)]
        if len(self.core.floor.queued) + len(coming) >= limits.max_queued:
            raise Refused("queue_full", f"{limits.max_queued} ARCs wait already; ask again later")
        theirs = sum(1 for event in coming if event.request.client == client)
        if theirs + len(self.core.arcs_of(client)) >= limits.max_requests_per_client:
            raise Refused("too_many", f"{client} has {limits.max_requests_per_client} requests open already")

    def _in_order(self, arc: ArcId) -> None:
        """Operations on one ARC stay in their order: what was gathered of it goes first."""
        if arc in self._gathered:
            self.decide()

    def _on_hand_over(self, request: Request[Operation], operation: HandOver, sender: Sender) -> None:
        to = str(client_of(operation.to))
        for other in operation.others:
            check_name(other, "id")
        self.decide()
        arc = views.arc_id(str(sender), operation.id)
        if str(sender) == to or self.core.floor.arc(arc) is None:
            self._tell_handed_over(request, operation, str(sender), to)
            return
        if self._finding >= MAX_GATHERED:
            raise Refused("busy", f"{MAX_GATHERED} hand-overs wait here already; ask again")
        self._finding += 1

        def found(alive: bool) -> None:
            self._finding -= 1
            try:
                if self._closed:
                    raise Refused("not_leading", "this RCM stopped leading; ask again")
                if not alive:
                    raise Refused("unknown_client", f"{to} is not on the mesh")
                self._hand_over(request, operation, str(sender), to)
            except Refused as refused:
                request.refuse(refused.problem)
            except Exception:
                request.refuse(Refused("internal", "the request failed here; see this node's log").problem)
                raise

        self.presence.find(to, found)

    def _tell_handed_over(
        self, request: Request[Operation], operation: HandOver, sender: str, to: str
    ) -> None:
        """Answers who asks for what was done before. Raises Refused if it was not."""
        goal = views.arc_id(to, operation.id)
        over = self.notices.ended(goal) and self.notices.ended(views.arc_id(sender, operation.id))
        if self.core.floor.arc(goal) is None and not over:
            raise Refused("not_running", f"{operation.id} is not open at {sender}")
        # The new client may have missed it, where the RCM changed just then.
        for request_id in (operation.id, *operation.others):
            self.notices.stands(views.arc_id(to, request_id))
        request.answer(self.notices.standing(goal, to, operation.id))

    def _hand_over(self, request: Request[Operation], operation: HandOver, sender: str, to: str) -> None:
        """All in one batch of events, and so in one publication: nobody gets in between."""
        self.decide()
        moves = self._moves(operation, sender, to)
        if not moves or moves[0].arc != views.arc_id(sender, operation.id):
            self._tell_handed_over(request, operation, sender, to)
            return
        room = self.fleet.limits.max_requests_per_client - len(self.core.arcs_of(to))
        if len(moves) > room:
            raise Refused("too_many", f"{to} has room for {max(0, room)} more requests, not for {len(moves)}")
        for move in moves:
            self.notices.call(move.renamed, self.notices.name(move.arc))
        self.presence.expect(to)
        self._carry_out(moves)
        for move in moves:
            if move.renamed in self.core.floor.queued:
                self.notices.stands(move.renamed)
        request.answer(self.notices.standing(moves[0].renamed, to, operation.id))

    def _moves(self, operation: HandOver, sender: str, to: str) -> list[HandedOver]:
        """What a hand-over comes to: of the ARCs that it names, those that are open at the sender."""
        moves = []
        for request_id in dict.fromkeys((operation.id, *operation.others)):
            arc = self.core.floor.arc(views.arc_id(sender, request_id))
            if arc is None:
                continue
            renamed = views.arc_id(to, request_id)
            taken = self.core.floor.arc(renamed)
            if taken is not None and taken.place != arc.place:
                raise Refused("bad_request", f"{to} has a request {request_id} already; ask under random ids")
            moves.append(HandedOver(arc.id, to, renamed))
        return moves

    def _foresee(self, request: Request[Operation], operation: Foresee, sender: Sender) -> None:
        self.decide()
        arc = views.arc_id(str(sender), operation.id)
        if self.core.floor.arc(arc) is not None:
            raise Refused("bad_request", f"{operation.id} is a request already; ask how it stands")
        wanted = admit(operation, sender, arc, self.core, self.fleet.limits)
        now = clock.now()
        foretold = forecast(self.core, now, wanted)
        start = foretold.starts.get(arc)
        request.answer(
            Foresight(
                id=operation.id,
                arc=operation.arc,
                starts_in=None if start is None else (start - now) / SECOND,
                preempts=[self.notices.name(victim) for victim in foretold.preempts],
                reason=foretold.reason,
            )
        )

    def answer(self, arc_id: ArcId) -> bool:
        """Answers those who asked for this ARC and wait for the first word about it."""
        requests = self._answers.pop(arc_id, None)
        if requests is None:
            return False
        notice = self.notices.standing(arc_id, arc_id.rpartition("/")[0], views.request_id(arc_id))
        for request in requests:
            request.answer(notice)
        return True

    def _answer_all(self, arcs: list[ArcId]) -> None:
        for arc in arcs:
            self.answer(arc)

"""A client that moves: paused, it hands all that it has to another one, which expects it.

The RCM's answer to the hand-over is the commit point. Before it the old client can go on as if nothing had
been; after it only the new one, unless that is gone: then the old one takes back, and asks anew. An RCM that dies as it
answers may take along what it told everybody else: what the new client has not heard of is handed over again.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence

from zscout.behaviors.client.rcm_link import BACKOFF, QUERY_TIMEOUT, TRY_AGAIN, RcmLink
from zscout.behaviors.client.request import OpenArc, RequestRefused, RequestStore
from zscout.config.fleet import Fleet
from zscout.keyexpr import Sender
from zscout.mesh import Mesh
from zscout.mesh.supervision import Supervisor
from zscout.messages import Amounts, ClientRequests, HandOver, Notice, OpenRequest, Problem, RcAsk
from zscout.messages.scheduling import MAX_OTHERS
from zscout.types import SECOND

log = logging.getLogger(__name__)

HAND_OVER = 10.0
"""Seconds within which the outcome of a hand-over must be known."""
FIRST_PAUSE = 0.005
"""Seconds before a hand-over is asked again, doubling: a notice comes about as soon as the answer."""
EXPECT_TIMEOUT = 2.0
"""Seconds for which a request waits for the ARC that is expected in its stead."""
TOKEN_GRACE = 1.0
"""Seconds within which the RCM sees the token of a client that sees the RCM's."""
CLAIM_TIMEOUT = 10.0
"""Seconds after which an ARC that came and that nobody asked for is given back."""


class MovableClient:
    """What a client hands over, and what it expects to be handed over to it."""

    def __init__(self, mesh: Mesh, fleet: Fleet, supervisor: Supervisor) -> None:
        self.mesh, self.fleet, self.supervisor = mesh, fleet, supervisor
        self.store = RequestStore(mesh.now, self._ask_soon)
        self.rcm = RcmLink(mesh, fleet, self.store, supervisor)
        self.expected_came = asyncio.Event()
        """Set at the first notice of an ARC that is expected: from then on it is this client's."""
        self._unclaimed: dict[str, OpenArc] = {}
        """What is expected, come or not, and was not asked for yet."""
        self._may_end = asyncio.Event()
        """Set unless the client is paused, and once it has left."""
        self._may_end.set()

    # The new client

    def expect(self, requests: Sequence[OpenRequest]) -> None:
        """These will be handed to this client: `request` then returns them, by name and needs. They replace
        what was expected before and has not come.

        What has come and was not asked for within 10 s is given back. Raises BadName, and ValueError for more
        than 256 of them, or for one that is open here."""
        if len(requests) > MAX_OTHERS + 1:
            raise ValueError(f"{len(requests)} requests are too many to take over; at most {MAX_OTHERS + 1} are")
        now = self.mesh.now()
        arcs = {request.id: OpenArc._expected(request, now) for request in requests}
        if here := arcs.keys() & self.store.arcs.keys():
            raise ValueError(f"request {min(here)} is already open here; no other client can hand it over")
        for arc in list(self.store.expected.values()):
            self._unclaimed.pop(arc.id, None)
            self.store.forget(arc)
        for arc in arcs.values():
            self.store.expect(arc)
        self._unclaimed |= arcs
        self.expected_came.clear()

    def take_moving(self, notice: Notice) -> bool:
        """Applies a notice of what is expected, or was handed over. False if it is of neither."""
        if (arc := self.store.expected.get(notice.id)) is not None:
            if arc._take_first(notice, self.mesh.now()):
                self.store.adopt(arc)
                self.store.notify(arc)
                self.expected_came.set()
                self.supervisor.spawn(self._give_back_unwanted(arc))
            return True
        arc = self.store.moved.get(notice.id)
        if arc is not None and notice.state == "ended" and notice.outcome != "handed_over":
            # It was over before it could be handed over: there is nothing to take back.
            arc._finish(notice.outcome or "lost", notice.reason, self.mesh.now())
            self.store.notify(arc)
            self.store.forget(arc)
            return True
        return False

    async def claim(self, name: str, needs: dict[str, Amounts]) -> OpenArc | None:
        """The ARC of this name and these needs that is expected, once it has come; None if there is none."""
        unclaimed = self._unclaimed.values()
        arc = next((arc for arc in unclaimed if (arc.name, arc.needs) == (name, needs)), None)
        if arc is None:
            return None
        del self._unclaimed[arc.id]
        try:
            await self._come(arc)
        finally:
            if arc.id in self.store.expected:
                self.store.forget(arc)
        return arc if arc.open else None

    async def _come(self, arc: OpenArc) -> None:
        """Waits for what is expected. What does not come may have been handed over unheard: it is to be asked for,
        under its id, at its place."""
        try:
            async with asyncio.timeout(EXPECT_TIMEOUT):
                while arc.id in self.store.expected:
                    await self.store.changed(arc)
        except TimeoutError:
            log.warning("%s was handed over to here, but not granted for %g s; requesting it", arc.name, EXPECT_TIMEOUT)
            self.store.adopt(arc)

    def _ask_soon(self, arc: OpenArc) -> None:
        self.supervisor.spawn(self._await_again(arc) if arc.state == "awaited" else self.ask_again(arc))

    async def _await_again(self, arc: OpenArc) -> None:
        await self._come(arc)
        if arc.open:
            await self.ask_again(arc)

    async def _give_back_unwanted(self, arc: OpenArc) -> None:
        await asyncio.sleep(CLAIM_TIMEOUT)
        if self._unclaimed.get(arc.id) is arc:
            del self._unclaimed[arc.id]
            if arc.open:
                log.warning("%s was handed over and nobody asked for it: it is given back", arc.name)
                await self.rcm.end(arc)

    # The old client

    def pause(self) -> None:
        """From now on nothing is asked again or ended and no body is entered or interrupted, until `resume`,
        `take_back`, `close` or `leave`. Notices are taken as before."""
        self._may_end.clear()
        self.store.resumed.clear()
        self.store.undecided.clear()
        self.store.reclaimed.clear()
        for arc in [arc for arc in self.store.expected.values() if arc.open]:
            # It may have to be handed on before it has come once more.
            self.store.adopt(arc)
            self.store.notify(arc)

    @property
    def paused(self) -> bool:
        return not self.store.resumed.is_set()

    async def resumed(self) -> None:
        """Waits while the client is paused; without end where it leaves like that."""
        await self.store.resumed.wait()

    def resume(self) -> None:
        """Goes on. All that is open is asked again, and what was withheld happens now."""
        self._may_end.set()
        self.store.resumed.set()
        for arc in self.store.open:
            self.supervisor.spawn(self.ask_again(arc))

    async def ask_again(self, arc: OpenArc) -> None:
        """An acknowledged request is asked once; what was lost or taken back until there is an answer."""
        try:
            if arc.state != "asking":
                await self.rcm.ask(arc)
            await self.rcm.submit(arc)
        except RequestRefused as refused:
            log.warning("%s is not taken back: %s", arc.name, refused)
            self.store.notify(arc)
            self.store.forget(arc)

    def open_requests(self) -> list[OpenRequest]:
        """What an RCM has answered and is not over: what `hand_over_all` would hand over now."""
        now = self.mesh.now()
        return [arc._open_request(now) for arc in self.store.acknowledged]

    async def hand_over_all(self, to: Sender) -> None:
        """Hands all `open_requests` of this paused client to another one, which expects them, in one step. On
        return that is done, and they go on there.

        Raises RequestRefused where the RCM refuses it; with code `unknown` where none could tell within 10 s: call it
        again; or see to it that the other client is gone, which an RCM before may have told all the same, and
        `take_back`."""
        if not self.paused:
            raise RuntimeError("pause() the client before it hands over everything: it would ask for it again")
        arcs = sorted(self.store.acknowledged, key=lambda arc: arc.grant is None)
        if len(arcs) > MAX_OTHERS + 1:
            words = f"{len(arcs)} requests can't be handed over at once; {MAX_OTHERS + 1} can"
            raise RequestRefused(Problem("too_many", words))
        try:
            async with asyncio.timeout(HAND_OVER):
                await self._hand_over(arcs, to)
        except (TimeoutError, RequestRefused) as error:
            self.store.undecided = {arc.id for arc in arcs if arc.open}
            if isinstance(error, RequestRefused):
                raise
            unknown = f"no leader reported within {HAND_OVER:g} s whether {to} took over; try again"
            raise RequestRefused(Problem("unknown", unknown)) from None

    async def _hand_over(self, arcs: list[OpenArc], to: Sender) -> None:
        """Asks until all of `arcs` have moved or are over. Raises RequestRefused."""
        term = self.rcm.term
        pause, longest = FIRST_PAUSE, BACKOFF[1]
        known_by = self.mesh.now() + round(TOKEN_GRACE * SECOND)
        while arcs := [arc for arc in arcs if arc.open]:
            first, *others = arcs
            operation = HandOver(id=first.id, to=str(to), others=[arc.id for arc in others])
            self.rcm.leader_came.clear()
            reply = await self.rcm.query(operation)
            notice, problem = (reply.message, reply.problem) if reply is not None else (None, None)
            awaited = await self._awaited_by(to) if notice is not None else set()
            # Who was promised to meanwhile has been told that they are here.
            if notice is not None and self.rcm.accept(notice.term):
                # An RCM that came in between answers for the first alone: it may not know of the others.
                told = arcs if notice.term == term else [first]
                if notice.state == "ended":
                    awaited.discard(first.id)
                moved = [arc for arc in told if arc.open and arc.id not in awaited]
                for arc in moved:
                    self.store.move(arc, notice)
                if moved:
                    continue
            elif notice is not None or (problem is not None and problem.code == "not_running"):
                # It is over, or an RCM that has just taken the lead does not know it: this settles which. And one of a
                # lower term than was promised hears of that.
                await self.rcm.ask(first)
            elif problem is not None and problem.code == "unknown_client" and self.mesh.now() < known_by:
                # It sees the RCM; the RCM may not have seen its token yet.
                pause = BACKOFF[0]
            elif problem is not None and problem.code not in TRY_AGAIN:
                raise RequestRefused(problem)
            pause = FIRST_PAUSE if await self.rcm.leader_within(pause) else min(longest, pause * 2)

    async def _awaited_by(self, to: Sender) -> set[str]:
        """Ids of what `to` expects and has had no notice of. Where it does not answer, the RCM's word has to do."""
        reply = await self.mesh.ask_one(self.mesh.keys.requests(to), RcAsk(), ClientRequests, timeout=QUERY_TIMEOUT)
        requests = reply.message.requests if reply is not None and reply.message is not None else []
        return {request.id for request in requests if request.place is None}

    def take_back(self) -> None:
        """The client to which all was handed is gone: this one goes on, and asks anew for each, at its place.

        Bodies are interrupted as by any other lost hold. What was not handed over after all, where that was
        unknown, simply stays."""
        for arc in list(self.store.moved.values()):
            self.store.reclaim(arc)
        self.store.reclaimed, self.store.undecided = self.store.undecided, set()
        self.resume()

"""Hand-over of all requests from a paused client to a new client, which expects them.

The RCM's answer to the hand-over is the commit point. Before it, the old client can continue unchanged. After it, only
the new client has the requests; if the new client is gone, the old client takes them back and submits them again. If an
RCM dies while it answers, the new client may never be notified: requests without a notice there are handed over again.
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
"""Seconds before a hand-over is repeated, doubling: the new client's notice arrives about as soon as the answer."""
EXPECT_TIMEOUT = 2.0
"""Seconds for which `claim` waits for an expected ARC."""
TOKEN_GRACE = 1.0
"""Seconds within which the RCM sees the token of a client that sees the RCM's."""
CLAIM_TIMEOUT = 10.0
"""Seconds after which an unclaimed ARC that was handed over is given back."""


class MovableClient:
    def __init__(self, mesh: Mesh, fleet: Fleet, supervisor: Supervisor) -> None:
        self.mesh, self.fleet, self.supervisor = mesh, fleet, supervisor
        self.store = RequestStore(mesh.now, self._ask_soon)
        self.rcm = RcmLink(mesh, fleet, self.store, supervisor)
        self.expected_came = asyncio.Event()
        """Set at the first notice of an expected ARC, which from then on belongs to this client."""
        self._unclaimed: dict[str, OpenArc] = {}
        """Expected requests, handed over or not, that the program has not claimed yet."""
        self._may_end = asyncio.Event()
        """Cleared while the client is paused, until it leaves."""
        self._may_end.set()

    def expect(self, requests: Sequence[OpenRequest]) -> None:
        """Expect another client to hand over `requests`; `request` then returns them, by name and needs. They replace
        those expected before and not yet handed over.

        A request that was handed over and not claimed within 10 s is given back. Raises BadName, and ValueError for
        more than 256 requests, or one that is already open here."""
        if len(requests) > MAX_OTHERS + 1:
            raise ValueError(f"can't take over {len(requests)} requests; the limit is {MAX_OTHERS + 1}")
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
        """Apply a notice of a request that is expected, or was handed over. Return False if it is of neither."""
        if (arc := self.store.expected.get(notice.id)) is not None:
            if arc._take_first(notice, self.mesh.now()):
                self.store.adopt(arc)
                self.store.notify(arc)
                self.expected_came.set()
                self.supervisor.spawn(self._give_back_unwanted(arc))
            return True
        arc = self.store.moved.get(notice.id)
        if arc is not None and notice.state == "ended" and notice.outcome != "handed_over":
            # It ended before it could be handed over: there is nothing to take back.
            arc._finish(notice.outcome or "lost", notice.reason, self.mesh.now())
            self.store.notify(arc)
            self.store.forget(arc)
            return True
        return False

    async def claim(self, name: str, needs: dict[str, Amounts]) -> OpenArc | None:
        """Return the expected ARC with this name and needs once it has been handed over; None if there is none."""
        unclaimed = self._unclaimed.values()
        arc = next((arc for arc in unclaimed if (arc.name, arc.needs) == (name, needs)), None)
        if arc is None:
            return None
        del self._unclaimed[arc.id]
        try:
            await self._await_handover(arc)
        finally:
            if arc.id in self.store.expected:
                self.store.forget(arc)
        return arc if arc.open else None

    async def _await_handover(self, arc: OpenArc) -> None:
        """Wait until an expected ARC is handed over. After EXPECT_TIMEOUT, submit it under its id at its place: the
        notice may be lost."""
        try:
            async with asyncio.timeout(EXPECT_TIMEOUT):
                while arc.id in self.store.expected:
                    await self.store.changed(arc)
        except TimeoutError:
            log.warning("%s was handed over to this client, but not granted within %g s", arc.name, EXPECT_TIMEOUT)
            self.store.adopt(arc)

    def _ask_soon(self, arc: OpenArc) -> None:
        self.supervisor.spawn(self._await_again(arc) if arc.state == "awaited" else self.ask_again(arc))

    async def _await_again(self, arc: OpenArc) -> None:
        await self._await_handover(arc)
        if arc.open:
            await self.ask_again(arc)

    async def _give_back_unwanted(self, arc: OpenArc) -> None:
        await asyncio.sleep(CLAIM_TIMEOUT)
        if self._unclaimed.get(arc.id) is arc:
            del self._unclaimed[arc.id]
            if arc.open:
                log.warning("giving back %s: it was handed over, and not requested here", arc.name)
                await self.rcm.end(arc)

    def pause(self) -> None:
        """Until `resume`, `take_back`, `close` or `leave`, only apply notices: submit, end, interrupt nothing."""
        self._may_end.clear()
        self.store.resumed.clear()
        self.store.undecided.clear()
        self.store.reclaimed.clear()
        for arc in [arc for arc in self.store.expected.values() if arc.open]:
            # It may have to be handed on before its repeated hand-over.
            self.store.adopt(arc)
            self.store.notify(arc)

    @property
    def paused(self) -> bool:
        return not self.store.resumed.is_set()

    async def resumed(self) -> None:
        """Wait while the client is paused; forever if it leaves without resuming."""
        await self.store.resumed.wait()

    def resume(self) -> None:
        """Continue: submit all open requests again, and do all that was withheld."""
        self._may_end.set()
        self.store.resumed.set()
        for arc in self.store.open:
            self.supervisor.spawn(self.ask_again(arc))

    async def ask_again(self, arc: OpenArc) -> None:
        """Submit a request again: once if an RCM has it, until there is an answer if it was lost or taken back."""
        try:
            if arc.state != "asking":
                await self.rcm.ask(arc)
            await self.rcm.submit(arc)
        except RequestRefused as refused:
            log.warning("%s was refused when submitted again: %s", arc.name, refused)
            self.store.notify(arc)
            self.store.forget(arc)

    def open_requests(self) -> list[OpenRequest]:
        now = self.mesh.now()
        return [arc._open_request(now) for arc in self.store.acknowledged]

    async def hand_over_all(self, to: Sender) -> None:
        """Hand over all `open_requests` of this paused client, in one step, to the client `to`, which must expect them.
        On return they continue there.

        Raises RequestRefused if the RCM refuses. With code `unknown` the outcome is unknown after 10 s: call it again,
        or make sure that the other client is gone (an earlier RCM may have notified it) and call `take_back`."""
        if not self.paused:
            raise RuntimeError("pause() the client before hand_over_all(): it would submit the requests again")
        arcs = sorted(self.store.acknowledged, key=lambda arc: arc.grant is None)
        if len(arcs) > MAX_OTHERS + 1:
            words = f"can't hand over {len(arcs)} requests at once; the limit is {MAX_OTHERS + 1}"
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
        """Repeat the hand-over until all of `arcs` have moved or are over. Raises RequestRefused."""
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
            # If this client has promised a higher term meanwhile, that candidate counts the requests as this client's,
            # so `accept` drops the answers of lower terms.
            if notice is not None and self.rcm.accept(notice.term):
                # A leader elected since the start answers for the first request alone: it may not know the others.
                answered = arcs if notice.term == term else [first]
                if notice.state == "ended":
                    awaited.discard(first.id)
                moved = [arc for arc in answered if arc.open and arc.id not in awaited]
                for arc in moved:
                    self.store.move(arc, notice)
                if moved:
                    continue
            elif notice is not None or (problem is not None and problem.code == "not_running"):
                # Either it is over, or a new leader does not know it yet: this query settles that. It also informs an
                # RCM whose term is below the promise.
                await self.rcm.ask(first)
            elif problem is not None and problem.code == "unknown_client" and self.mesh.now() < known_by:
                # The new client sees the RCM; the RCM may not have seen its token yet.
                pause = BACKOFF[0]
            elif problem is not None and problem.code not in TRY_AGAIN:
                raise RequestRefused(problem)
            pause = FIRST_PAUSE if await self.rcm.leader_within(pause) else min(longest, pause * 2)

    async def _awaited_by(self, to: Sender) -> set[str]:
        """The ids that `to` expects without a notice yet; none, trusting the RCM, if `to` does not answer."""
        reply = await self.mesh.ask_one(self.mesh.keys.requests(to), RcAsk(), ClientRequests, timeout=QUERY_TIMEOUT)
        requests = reply.message.requests if reply is not None and reply.message is not None else []
        return {request.id for request in requests if request.place is None}

    def take_back(self) -> None:
        """Submit all requests again, at their places: the client that received them is gone. Bodies are interrupted as
        for any lost hold. If a hand-over of unknown outcome did not happen, its requests stay unchanged."""
        for arc in list(self.store.moved.values()):
            self.store.reclaim(arc)
        self.store.reclaimed, self.store.undecided = self.store.undecided, set()
        self.resume()

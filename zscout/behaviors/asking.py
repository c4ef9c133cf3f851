"""A client's requests on their way to the RCM: asked until it answers, and again and again."""

from __future__ import annotations

import random
from typing import Any, NoReturn

from zscout import clock
from zscout.behaviors.book import Book
from zscout.behaviors.hearing import Hearing
from zscout.behaviors.refusals import RequestRefused
from zscout.behaviors.request import OpenArc
from zscout.mesh import Mesh, Reply
from zscout.messages import Cancel, Notice, Release

QUERY_TIMEOUT = 1.0
ASK_AGAIN = 5.0
"""Seconds between two askings of an open request, give or take a fifth."""
BACKOFF = (0.05, 1.0)
"""Seconds before a question that nobody answered is repeated: first, and at most."""
END_TRIES = 3
TRY_AGAIN = frozenset({"busy", "not_leading", "internal", "queue_full"})


class Asking:
    """Sends what one client asks for and gives back."""

    def __init__(self, mesh: Mesh, book: Book, hearing: Hearing) -> None:
        self.mesh, self.book, self.hearing = mesh, book, hearing
        self.key = mesh.keys.schedule(mesh.me)

    async def submit(self, arc: OpenArc) -> None:
        """Asks until the RCM has answered; not while the client is paused. Raises RequestRefused."""
        pause, longest = BACKOFF
        while arc.state == "asking":
            await self.book.resumed.wait()
            self.hearing.leader_came.clear()
            replies = await self.ask(arc)
            if arc.state != "asking":
                return
            problem = next((reply.problem for reply in replies if reply.problem is not None), None)
            if problem is not None and problem.code not in TRY_AGAIN:
                arc.state, arc.reason = "refused", problem.message
                raise RequestRefused(problem)
            if problem is not None:
                arc.reason = problem.message
            elif self.hearing.leader is None:
                arc.reason = "no RCM is on the mesh; start zscout-node"
            self.book.wake(arc)
            if not await self.hearing.leader_within(pause * random.uniform(0.8, 1.2)):  # noqa: S311
                pause = min(longest, pause * 2)

    async def ask(self, arc: OpenArc) -> list[Reply[Notice]]:
        """Asks once, and takes what is answered."""
        replies = await self.mesh.ask(
            self.key, arc.ask(clock.now()), Notice, timeout=QUERY_TIMEOUT, enough=answered
        )
        for reply in replies:
            if reply.message is not None and self.hearing.believe(reply.message.term):
                self.book.take(arc, reply.message)
        return replies

    async def ask_all(self) -> None:
        """Asks once for all that is open."""
        for arc in self.book.open:
            if arc.open and self.book.resumed.is_set():
                await self.ask(arc)

    async def keep_asking(self) -> NoReturn:
        """Asks open requests again at every change of RCM, and every few seconds."""
        while True:
            self.hearing.leader_came.clear()
            await self.hearing.leader_within(ASK_AGAIN * random.uniform(0.8, 1.2))  # noqa: S311
            await self.ask_all()

    async def end(self, arc: OpenArc) -> None:
        """Gives back a hold, or leaves the queue. Tried a few times; the RCM sees our token die otherwise."""
        operation = Release(id=arc.id) if arc.state == "running" else Cancel(id=arc.id)
        outcome = "released" if arc.state == "running" else "cancelled"
        arc.finish(outcome, "given up by this client", clock.now())
        self.book.wake(arc)
        for _ in range(END_TRIES):
            replies = await self.mesh.ask(self.key, operation, Notice, timeout=QUERY_TIMEOUT, enough=answered)
            if any(reply.message is not None for reply in replies):
                break
            if self.hearing.leader is None:
                break
        self.book.forget(arc)

    async def give_back(self, request_id: str) -> None:
        """Releases what nobody here asked for."""
        await self.mesh.ask(self.key, Release(id=request_id), Notice, timeout=QUERY_TIMEOUT)


def answered(reply: Reply[Any]) -> bool:
    """Whether somebody has answered a question, with a message or a problem."""
    return reply.message is not None or reply.problem is not None

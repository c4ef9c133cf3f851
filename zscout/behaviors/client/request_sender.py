"""A client's requests on their way to the RCM: sent until it answers, and again every few seconds."""

from __future__ import annotations

import random
from typing import Any, NoReturn

from zscout.behaviors.client.leader_tracker import LeaderTracker
from zscout.behaviors.client.request import OpenArc, RequestRefused, RequestStore
from zscout.mesh import Mesh, Reply
from zscout.messages import Cancel, Notice, Release

QUERY_TIMEOUT = 1.0
ASK_AGAIN = 5.0
"""Seconds between two askings of an open request, give or take a fifth."""
BACKOFF = (0.05, 1.0)
"""Seconds before a question that nobody answered is repeated: first, and at most."""
END_TRIES = 3
TRY_AGAIN = frozenset({"busy", "not_leading", "internal", "queue_full"})


class RequestSender:
    """Sends what one client requests and withdraws."""

    def __init__(self, mesh: Mesh, store: RequestStore, tracker: LeaderTracker) -> None:
        self.mesh, self.store, self.tracker = mesh, store, tracker
        self.key = mesh.keys.schedule(mesh.me)

    async def submit(self, arc: OpenArc) -> None:
        """Asks until the RCM has answered; not while the client is paused. Raises RequestRefused."""
        pause, longest = BACKOFF
        while arc.state == "asking":
            await self.store.resumed.wait()
            self.tracker.leader_came.clear()
            replies = await self.ask(arc)
            if arc.state != "asking":
                return
            problem = next((reply.problem for reply in replies if reply.problem is not None), None)
            if problem is not None and problem.code not in TRY_AGAIN:
                arc.state, arc.reason = "refused", problem.message
                raise RequestRefused(problem)
            if problem is not None:
                arc.reason = problem.message
            elif self.tracker.leader is None:
                arc.reason = "no RCM is on the mesh; start zscout-node"
            self.store.notify(arc)
            if not await self.tracker.leader_within(pause * random.uniform(0.8, 1.2)):  # noqa: S311
                pause = min(longest, pause * 2)

    async def ask(self, arc: OpenArc) -> list[Reply[Notice]]:
        """Asks once, and applies the answers."""
        replies = await self.mesh.ask(
            self.key, arc.ask(self.mesh.now()), Notice, timeout=QUERY_TIMEOUT, enough=answered
        )
        for reply in replies:
            if reply.message is not None and self.tracker.accept(reply.message.term):
                self.store.take(arc, reply.message)
        return replies

    async def keep_asking(self) -> NoReturn:
        """Asks for all that is open again, and withdraws what was given up, at every change of RCM and every
        few seconds."""
        while True:
            self.tracker.leader_came.clear()
            await self.tracker.leader_within(ASK_AGAIN * random.uniform(0.8, 1.2))  # noqa: S311
            for arc in self.store.open:
                if arc.open and self.store.resumed.is_set():
                    await self.ask(arc)
            for request_id in list(self.store.withdrawn):
                if not await self._withdraw(request_id):
                    break

    async def end(self, arc: OpenArc) -> None:
        """Gives back a hold, or leaves the queue: returns when that was answered, or was tried a few times.
        `keep_asking` goes on with it then."""
        running = arc.state == "running"
        self.store.withdrawn[arc.id] = Release(id=arc.id) if running else Cancel(id=arc.id)
        arc.finish("released" if running else "cancelled", "given up by this client", self.mesh.now())
        self.store.notify(arc)
        for _ in range(END_TRIES):
            if await self._withdraw(arc.id) or self.tracker.leader is None:
                break
        self.store.forget(arc)

    async def give_back(self, operation: Release | Cancel) -> None:
        """Withdraws what nobody here asks for any more."""
        self.store.withdrawn[operation.id] = operation
        await self._withdraw(operation.id)

    async def _withdraw(self, request_id: str) -> bool:
        """Sends once what is to be withdrawn; whether that was answered."""
        operation = self.store.withdrawn.get(request_id)
        if operation is None:
            return True
        replies = await self.mesh.ask(self.key, operation, Notice, timeout=QUERY_TIMEOUT, enough=answered)
        problems = [reply.problem for reply in replies if reply.problem is not None]
        done = any(reply.message is not None for reply in replies) or any(
            problem.code not in TRY_AGAIN for problem in problems
        )
        if done:
            self.store.withdrawn.pop(request_id, None)
        return done


def answered(reply: Reply[Any]) -> bool:
    """Whether somebody has answered a question, with a message or a problem."""
    return reply.message is not None or reply.problem is not None

"""A resource controller on the mesh: the part that every driver shares.

A driver (`driver.py`) says what its device does; `ResourceController` owns the keys, checks every
command against the hold that stands when it is carried out, votes, and puts the device into its safe state
when its holder is gone.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Coroutine
from typing import Any

from zscout import clock
from zscout.drivers.driver import Driver as Driver
from zscout.drivers.holding import Change, Holding, Refusal
from zscout.drivers.offers import Offers
from zscout.keyexpr import Role, Sender, Token, new_instance
from zscout.mesh import Declared, Mesh, Refused, Reply, Request
from zscout.messages import (
    Ballot,
    Command,
    Done,
    EndedHold,
    Grants,
    Proposal,
    RcAsk,
    RcmState,
    RcState,
    StateAsk,
    absurd,
)
from zscout.scheduling.model import SECOND, Grant, Ns
from zscout.stall import StallWatch

log = logging.getLogger(__name__)

MIN_DELAY = 0.02
MAX_TTL = 60.0
REREAD_TIMEOUT = 0.5
REREADS = 4
"""Readings in a row when publications overtake the answers."""
COMMAND_QUEUE = 64
FIGURES_PERIOD = 1.0
"""Seconds from one look at a driver's figures to the next."""


class ResourceController:
    """One RC: its keys, its holds and its driver."""

    def __init__(
        self, mesh: Mesh, name: str, driver: Driver, *, hold_lease: float, stall: StallWatch
    ) -> None:
        self.mesh = mesh
        self.name = name
        self.driver = driver
        self.holding = Holding(name, hold_lease=round(hold_lease * SECOND))
        self.instance = new_instance()
        self.rules = 0
        self.health = "ok"
        self._leaders: set[Token] = set()
        self._declared: list[Declared] = []
        self._warm_at: Ns = 0
        self._work: asyncio.Queue[tuple[str, Any]] = asyncio.Queue()
        self._tasks: set[asyncio.Task[None]] = set()
        self._reading: asyncio.Task[None] | None = None
        self._missed = False
        """Something was missed that has not been read since."""
        self._timer: asyncio.TimerHandle | None = None
        self._stall = stall
        self.offers = Offers(mesh) if driver.relays else None
        """Which host offers which RC; only of a driver that relays."""

    async def start(self) -> None:
        """Starts empty, and obeys nothing before it has subscribed and then read `rcm/state`."""
        keys, mesh = self.mesh.keys, self.mesh
        self._state = mesh.publisher(keys.rc_state(self.name), RcState)
        self._declared.append(mesh.watch(keys.alive_any(Role.RCM), self._on_leader))
        self._declared.append(mesh.subscribe(keys.grants, Grants, self._on_grants))
        await self._read_state()
        if self.offers is not None:
            self._declared.append(self.offers.watch())
        await self.driver.open(self)
        self._spawn(self._worker())
        self._spawn(self._tell_figures())
        self._declared.append(mesh.serve(keys.rc_state(self.name), RcAsk, self._on_state_asked))
        if self.driver.sharable:
            self._declared.append(mesh.serve(keys.vote(self.name), Proposal, self._on_proposal))
        command = keys.command_any(self.name)
        self._declared.append(mesh.serve(command, Command, self._on_command, depth=COMMAND_QUEUE))
        token = Token(mesh.me.host, Role.RC, self.name, self.instance)
        self._declared.append(mesh.alive(token))

    async def stop(self) -> None:
        """Leaves the mesh and puts the device into its safe state."""
        for declared in reversed(self._declared):
            declared.close()
        if self._timer is not None:
            self._timer.cancel()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await self._guard(self.driver.safe())
        await self._guard(self.driver.close())
        self._state.close()

    def rules_changed(self) -> None:
        """The driver votes by other rules from now on: earlier votes are void."""
        self.rules += 1
        self.publish()

    def fail(self, why: str) -> None:
        """The device can't carry its holders any longer: their holds end, the RC counts as lost."""
        self.health = why
        self._apply(self.holding.fail(why))
        self.publish()

    def recover(self) -> None:
        """The device works again."""
        self.health = "ok"
        self.publish()

    def publish(self, ended: list[EndedHold] | None = None) -> None:
        self._state.put(self._told(ended or []))

    # What is heard

    def _on_leader(self, token: Token, alive: bool) -> None:
        if alive:
            self._leaders.add(token)
        else:
            self._leaders.discard(token)

    def _on_grants(self, _key: str, said: Grants) -> None:
        self._apply(self.holding.hear(said, clock.now(), sharable=self.driver.sharable))
        if self._missed:
            self._spawn(self._read_state())

    def _on_state_asked(self, request: Request[RcAsk]) -> None:
        promise = request.message.promise
        if promise is not None and not self.holding.promise(promise):
            raise Refused(
                "old_term", f"{self.name} obeys term {self.holding.term.counter}", self.holding.term
            )
        request.answer(self._told([]))

    def _told(self, ended: list[EndedHold]) -> RcState:
        return RcState(
            rc=self.name,
            host=self.mesh.me.host,
            instance=self.instance,
            sharable=self.driver.sharable,
            term=self.holding.term,
            seq=self.holding.seq,
            holders=self.holding.holders(clock.now()),
            ended=ended,
            health=self.health,
            rules=self.rules,
            leader=self._sees_leader(),
            capacity=self.driver.capacity(),
            figures=self.driver.figures(),
        )

    def _sees_leader(self) -> bool:
        """A leader counts while it is heard: its token lives on when its program hangs."""
        # Half a hold lease is longer than a heartbeat, and leaves a successor time before holds end.
        return bool(self._leaders) and clock.now() - self.holding.heard < self.holding.hold_lease // 2

    def _on_proposal(self, request: Request[Proposal]) -> None:
        asked = request.message
        try:
            reason = self.driver.vote(asked.holders)
        except ValueError as error:
            raise Refused("bad_request", str(error)) from None
        request.answer(Ballot(proposal=asked.proposal, accept=not reason, reason=reason))

    # Commands

    def _on_command(self, request: Request[Command]) -> None:
        self.mesh.keys.sender_of(request.key)  # a sender without a valid name is refused here
        # What stops a robot is let in where commands are not.
        room = COMMAND_QUEUE if request.message.grant is not None else 2 * COMMAND_QUEUE
        if self._work.qsize() >= room:
            raise Refused("busy", f"{self.name} has {COMMAND_QUEUE} commands waiting; ask again")
        if not 0 < request.message.ttl <= MAX_TTL:
            raise Refused("bad_command", f"ttl must lie between 0 and {MAX_TTL:g} seconds")
        self._work.put_nowait(("command", request))

    async def _carry_out(self, request: Request[Command]) -> Any:
        """What is answered, or a Future of it."""
        command = request.message
        sender = self.mesh.keys.sender_of(request.key)
        waited = self._waited(request)
        if waited > command.ttl * SECOND:
            raise Refused(
                "stale", f"the command waited {waited / SECOND:.2f} s, longer than its ttl {command.ttl:g} s"
            )
        if command.grant is None:
            return await self.driver.command_without_grant(sender, command.do)
        refusal = self._objection(command.grant, sender)
        if refusal is not None and refusal.code == "not_yet":
            await self._read_state()
            refusal = self._objection(command.grant, sender)
        if refusal is not None:
            raise Refused(refusal.code, refusal.message, self.holding.term)
        warming = max(0.0, (self._warm_at - clock.now()) / SECOND)
        if command.do.get("name") == "confirm":
            return Done(warming=warming)
        if warming and not self.driver.usable_cold(command.do):
            raise Refused("warming", f"{self.name} is warming up; {warming:.1f} s are left")
        return await self.driver.command(self.holding.held[command.grant].holder, command.do)

    def _objection(self, grant: Grant, sender: Sender) -> Refusal | None:
        """Why `sender` is not obeyed under `grant`; None: it is."""
        client, held = str(sender), self.holding.held.get(grant)
        if (
            held is not None
            and self.offers is not None
            and self.offers.of_gang(sender, held.holder, self.name)
        ):
            client = held.holder.client
        return self.holding.check(grant, client, clock.now())

    def _waited(self, request: Request[Command]) -> Ns:
        """How long a command may have waited: in our queue, and before it in the network through a stall."""
        return clock.now() - request.arrived + self._stall.waited_through(request.arrived)

    async def _worker(self) -> None:
        """Carries out commands and changes of holders one at a time, in their order."""
        while True:
            what, item = await self._work.get()
            if what == "command":
                await self._answer(item, self._carry_out(item))
            else:
                await self._change(item)

    async def _answer(self, request: Request[Command], work: Awaitable[Any]) -> None:
        try:
            result = await work
            if isinstance(result, asyncio.Future):
                self._spawn(self._answer(request, result))
            else:
                request.answer(result if isinstance(result, Done) else Done(result=result))
        except Refused as refused:
            request.refuse(refused.problem)
        except Exception:
            log.exception("%s: a command failed", self.name)
            request.refuse(Refused("failed", f"{self.name} could not do it; see the log of its node").problem)

    async def _change(self, change: Change) -> None:
        going_on = {holder.place: holder.client for holder in change.began}
        for holder in change.stopped:
            if going_on.get(holder.place, holder.client) == holder.client:
                await self._guard(self.driver.end(holder))
        # A device that still serves others, or goes on in another client, stays as it is.
        if change.stopped and not change.stayed and not _handed_over(change):
            await self._guard(self.driver.safe())
        for holder in change.began:
            await self._guard(self.driver.begin(holder))

    async def _tell_figures(self) -> None:
        told = self.driver.figures()
        while True:
            await asyncio.sleep(FIGURES_PERIOD)
            figures = self.driver.figures()
            if figures != told:
                told = figures
                self.publish()

    async def _guard(self, action: Any) -> None:
        try:
            await action
        except Exception as error:
            log.exception("%s: its driver failed", self.name)
            self.fail(f"its driver failed: {error}")

    # Holds

    def _apply(self, change: Change) -> None:
        if change:
            if change.began and not change.stayed and not _handed_over(change):
                self._warm_at = clock.now() + round(self.driver.activation * SECOND)
            self._work.put_nowait(("change", change))
        if change.outdated or change.present or change.ended:
            self.publish(change.ended)
        self._missed |= change.reread
        self._set_timer()

    async def _read_state(self) -> None:
        """Reads `rcm/state`. Who wants that while it is under way waits for the same reading."""
        if self._reading is None or self._reading.done():
            self._reading = self._spawn(self._read())
        await asyncio.wait({self._reading})

    async def _read(self) -> None:
        for _ in range(REREADS):
            asked = StateAsk(holds_only=True)
            replies = await self.mesh.ask(
                self.mesh.keys.rcm_state, asked, RcmState, timeout=REREAD_TIMEOUT, enough=self._current
            )
            states = [reply.message for reply in replies if reply.message is not None]
            # One absurd answer must not hide the true one.
            states = [state for state in states if not absurd(state.term, self.holding.term)]
            if not states:
                return
            newest = max(states, key=lambda state: (state.term, state.seq))
            overtaken = (newest.term, newest.seq) < (self.holding.term, self.holding.seq)
            self._apply(self.holding.read(newest, clock.now(), sharable=self.driver.sharable))
            # What was published while the answer was on its way may have hidden the very gap it was for.
            if not overtaken:
                self._missed = False
                return

    def _current(self, reply: Reply[RcmState]) -> bool:
        """Whether nobody else needs to be heard: the answer is of an RCM that is obeyed already."""
        state, holding = reply.message, self.holding
        return state is not None and state.term == holding.term and state.seq >= holding.seq

    def _set_timer(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        at = self.holding.next_expiry()
        if at is not None:
            delay = (at - clock.now()) / SECOND if at > clock.now() else MIN_DELAY
            self._timer = asyncio.get_running_loop().call_later(delay, self._expire)

    def _expire(self) -> None:
        # After a stall of our own, what the RCM said meanwhile may still wait in the inbox: it goes first.
        self._apply(self.holding.expire(clock.now(), lease=not self._stall.fresh()))

    def _spawn(self, coroutine: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
        task = asyncio.get_running_loop().create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task


def _handed_over(change: Change) -> bool:
    """Whether somebody who stopped goes on in another client: the same ARC has the same place."""
    before = {holder.place: holder.client for holder in change.stopped}
    return any(before.get(holder.place, holder.client) != holder.client for holder in change.began)

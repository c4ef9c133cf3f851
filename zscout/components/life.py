"""The life of one component in its process: made, standing by, running, held, moved, ended."""

from __future__ import annotations

import asyncio
import traceback
from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import Any, Final

from zscout.behaviors.client import Client
from zscout.components import channel, kinds
from zscout.components.channel import Ends, Job, Order, Stands, Telling
from zscout.components.component import Component, Gate, Stage, is_movable
from zscout.components.memory import limit_allocations
from zscout.components.moving import Move, NotMoved, state_of
from zscout.keyexpr import BadName, Role, Token, incarnation_of, new_instance
from zscout.mesh import Declared, MeshError
from zscout.messages import MAX_ERROR

STAND_BY: Final = 30.0
"""Seconds that one stands by without being restored or activated, and then again until it is activated."""
LINKED: Final = 1.0
"""Seconds in which one that stands by may find the RCM: without a link to it, it can't be handed anything."""
CLOSE: Final = 4.0
"""Seconds for giving back what it holds."""
SUPERSEDED: Final = 0.5
"""Seconds that a superseded one has to clean up."""


class Life:
    """Runs the component of `job`. `tell` sends a word to the node, waited for or not."""

    def __init__(self, job: Job, tell: Callable[[Telling], asyncio.Future[None]]) -> None:
        self._job, self._tell = job, tell
        self._story: asyncio.Task[Ends] | None = None
        self._wanted: Ends | None = None
        """How it is to end, once something wants it to."""
        self._client: Client | None = None
        self._component: Component | None = None
        self._gate = Gate()
        self._holding = asyncio.Lock()
        self._move: Move | None = None
        self._running = False
        self._restored = asyncio.Event()
        self._activated = asyncio.Event()
        self._left = asyncio.Event()
        """It is over here, whatever run() does: another one goes on."""
        self._away: Ends | None = None
        """How, once that is so."""
        self._tasks: set[asyncio.Task[None]] = set()

    async def run(self) -> Ends:
        """Returns how it ended, when all that it held has been given back, or handed over."""
        story = self._story = asyncio.create_task(self._tell_story())
        if self._wanted is not None:
            story.cancel()
        left = asyncio.create_task(self._left.wait())
        await asyncio.wait({story, left}, return_when=asyncio.FIRST_COMPLETED)
        if left.done():
            # run() stays where it is: to unwind it would give up what another one holds now.
            ends = self._away or Ends("moved")
            if self._client is not None:
                await self._client.leave()
            return ends
        left.cancel()
        try:
            ends = story.result()
        except (Exception, asyncio.CancelledError) as error:  # noqa: BLE001 - the author's code
            if self._wanted is None or not isinstance(error, asyncio.CancelledError):
                traceback.print_exception(error)
            ends = self._wanted or Ends("failed", _words(error))
        await self._close(ends)
        return ends

    def order(self, order: Order) -> None:
        """Carries out an order of the node."""
        match order:
            case channel.Stop():
                self.end(Ends("stopped"))
            case channel.Activate():
                self._activated.set()
            case channel.TakeCheckpoint():
                self._spawn(self._take_checkpoint(order))
            case channel.MoveAway():
                self._spawn(self._move_away(order))
            case channel.TakeIn():
                self._spawn(self._take_in(order))

    def end(self, ends: Ends) -> None:
        """Has it end; of several ends that are wanted the first is told. A move that has begun is called off;
        if it is committed, another one goes on and this one is over anyhow."""
        if self._wanted is not None:
            return
        self._wanted = ends
        if self._move is not None:
            self._move.called_off = "it is to end"
        if self._story is not None and (self._move is None or not self._move.began):
            self._story.cancel()

    # What happens to it

    async def _tell_story(self) -> Ends:
        job = self._job
        connecting = asyncio.create_task(
            Client.connect(f"{job.component}.{job.incarnation}", fleet=job.fleet, host=job.host)
        )
        # It joins the mesh in a thread: what follows is done meanwhile.
        await asyncio.sleep(0)
        kind = self._load()
        try:
            client = self._client = await connecting
        except MeshError as error:
            return Ends("failed", str(error))
        made = kind if isinstance(kind, Ends) else self._make(kind)
        if isinstance(made, Ends):
            return made
        self._component = made
        movable = is_movable(made)
        watch = client.mesh.watch(client.mesh.keys.alive_any(Role.COMPONENT), self._on_component)
        try:
            if job.standby:
                await self._linked(client)
                await self._tell(Stands("standby", movable))
                if not await self._called(client):
                    return Ends("stopped", f"it stood by for {STAND_BY:g} s and nothing was handed to it")
            return await self._perform(client, made, movable)
        finally:
            watch.close()

    def _load(self) -> type[Component] | Ends:
        try:
            return kinds.load(self._job.kind, self._job.where)
        except kinds.BadKind as error:
            return Ends("failed", str(error))
        except Exception as error:  # noqa: BLE001 - the author's code
            traceback.print_exc()
            return Ends("failed", f"its kind can't be imported: {_words(error)}")

    def _make(self, kind: type[Component]) -> Component | Ends:
        limit_allocations(self._job.memory)
        try:
            return kind(self._job.params)
        except ValueError as error:
            return Ends("failed", f"these parameters are no good: {_words(error, named=False)}")
        except Exception as error:  # noqa: BLE001 - the author's code
            traceback.print_exc()
            return Ends("failed", f"it can't be made: {_words(error)}")

    async def _linked(self, client: Client) -> None:
        found = asyncio.Event()
        watch = client.mesh.watch(client.mesh.keys.alive_any(Role.RCM), lambda _, alive: found.set())
        try:
            async with asyncio.timeout(LINKED):
                await found.wait()
        except TimeoutError:
            pass  # no RCM leads now; there may be one when it matters
        finally:
            watch.close()

    async def _called(self, client: Client) -> bool:
        """Waits until it is to run: it was activated, or handed an ARC."""
        if await _first(STAND_BY, self._activated, client.expected_came, self._restored):
            return await _first(STAND_BY, self._activated, client.expected_came)
        return False

    async def _perform(self, client: Client, component: Component, movable: bool) -> Ends:
        job = self._job
        instance = f"{job.incarnation}-{new_instance()}"
        token: Declared = client.mesh.alive(Token(job.host, Role.COMPONENT, job.component, instance))
        self._running = True
        try:
            # Not waited for: nothing comes between this and its first step.
            self._tell(Stands("running", movable))
            await component.run(Stage(client, job.component, job.incarnation, self._gate))
        except asyncio.CancelledError:
            if self._wanted is None:
                raise
        except SystemExit as left:
            if left.code:
                return self._wanted or Ends("failed", f"it left with {left.code!r}")
        except Exception as error:
            if self._wanted is None:
                raise
            traceback.print_exception(error)
        finally:
            self._running = False
            token.close()
        return self._wanted or Ends("completed")

    async def _close(self, ends: Ends) -> None:
        for task in list(self._tasks):
            task.cancel()
        if self._client is None:
            return
        with suppress(TimeoutError):
            async with asyncio.timeout(SUPERSEDED if ends.how == "superseded" else CLOSE):
                await self._client.close()

    # What it is asked for

    async def _take_checkpoint(self, order: channel.TakeCheckpoint) -> None:
        component = self._component
        if component is None or not self._running:
            await self._decline(order.number, "bad_request", "it does not run")
            return
        if not is_movable(component):
            await self._decline(order.number, "not_movable", _NOT_MOVABLE)
            return
        async with self._holding:
            if not await self._gate.hold(order.patience):
                words = f"it came to no safe point within {order.patience:g} s"
                await self._decline(order.number, "not_safe", words)
                return
            try:
                state = state_of(component)
            except NotMoved as refused:
                await self._decline(order.number, refused.code, str(refused))
                return
            finally:
                self._gate.release()
        await self._tell(channel.Taken(order.number, state))

    async def _move_away(self, order: channel.MoveAway) -> None:
        component, client = self._component, self._client
        if component is None or client is None or not self._running:
            await self._decline(order.number, "bad_request", "it does not run")
            return
        if not is_movable(component):
            await self._decline(order.number, "not_movable", _NOT_MOVABLE)
            return
        async with self._holding:
            move = Move(client, component, self._gate, self._job.component, order.to, order.incarnation)
            self._move = move
            try:
                dead = await move.carry_out(order.patience)
            except Exception as error:  # noqa: BLE001 - the author's code
                self._move = None
                if self._wanted is not None and self._story is not None:
                    self._story.cancel()
                refused = error if isinstance(error, NotMoved) else NotMoved("move_failed", _words(error))
                if refused is not error:
                    traceback.print_exc()
                await self._decline(order.number, refused.code, str(refused))
                return
            self._away = Ends("moved")
            await self._tell(channel.Gone(order.number, dead))
            self._left.set()

    async def _take_in(self, order: channel.TakeIn) -> None:
        component, client = self._component, self._client
        if component is None or client is None or not self._job.standby or self._running:
            await self._decline(order.number, "bad_request", "it does not stand by")
            return
        if not is_movable(component):
            await self._decline(order.number, "not_movable", _NOT_MOVABLE)
            return
        try:
            component.restore(order.state)
        except Exception as error:  # noqa: BLE001 - the author's code
            traceback.print_exc()
            await self._decline(order.number, "start_failed", f"restore() failed: {_words(error)}")
            self.end(Ends("failed", f"restore() failed: {_words(error)}"))
            return
        try:
            client.expect(order.requests)
        except (BadName, ValueError) as error:
            await self._decline(order.number, "bad_request", _words(error, named=False))
            return
        self._restored.set()
        await self._tell(channel.Done(order.number))

    async def _decline(self, number: int, code: str, message: str) -> None:
        await self._tell(channel.Declined(number, code, message[:MAX_ERROR]))

    def _on_component(self, token: Token, alive: bool) -> None:
        if not alive or token.name != self._job.component:
            return
        try:
            incarnation = incarnation_of(token.instance)
        except BadName:
            return
        if self._move is not None and incarnation == self._move.incarnation:
            self._move.successor_runs.set()
        elif incarnation > self._job.incarnation:
            self._superseded(incarnation, token.host)

    def _superseded(self, incarnation: int, host: str) -> None:
        ends = Ends("superseded", f"incarnation {incarnation} runs on {host}")
        self._away = self._away or ends
        self.end(ends)
        asyncio.get_running_loop().call_later(SUPERSEDED, self._left.set)

    def _spawn(self, coroutine: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(coroutine)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)


_NOT_MOVABLE: Final = "it can't be moved: its kind has no checkpoint() and restore()"


async def _first(timeout: float, *events: asyncio.Event) -> bool:
    """Waits until one of these is set; False if none is within `timeout` seconds."""
    waits = [asyncio.ensure_future(event.wait()) for event in events]
    try:
        done, _ = await asyncio.wait(waits, timeout=timeout, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for wait in waits:
            wait.cancel()
    return bool(done)


def _words(error: BaseException, *, named: bool = True) -> str:
    """An error in one line."""
    text = " ".join(str(error).split())[:MAX_ERROR]
    name = type(error).__name__
    return f"{name}: {text}" if text and named else text or name

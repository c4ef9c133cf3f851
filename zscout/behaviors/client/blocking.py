"""The synchronous form, for scripts and notebooks.

    with zscout.connect() as lab, lab.hold("survey", {"robot/scout33": {}}) as held:
        held.command("robot/scout33", {"name": "echo", "value": 1})

When the hold is taken away, or its time is over, `Revoked` is raised in the body, whatever that is doing: in a
`time.sleep`, a read or a wait for another hold as well. That is done by a signal (`interruption.py`), so only where the
body runs in the main thread, and not before a call of a C library returns that does not mind signals. In other threads,
and with `interrupt=False`, a body looks at `held.active`, waits with `held.wait(...)` or lets `held.check()` raise. An
RC obeys nothing under a hold that is over, whatever the body does.
"""

from __future__ import annotations

import asyncio
import logging
import threading
from collections.abc import Coroutine, Mapping
from concurrent import futures
from contextlib import AbstractContextManager
from types import TracebackType
from typing import Any, Final, Self, TypeVar

import uvloop

from zscout.behaviors.client.arc import Attempt, Held, Revoked, hold
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.interruption import InterruptibleBody, interruptible, uninterrupted
from zscout.behaviors.client.request import HoldEnd, Needs
from zscout.config.fleet import Fleet
from zscout.mesh.supervision import done_within
from zscout.types import SECOND, Grant

T = TypeVar("T")

log = logging.getLogger(__name__)

LOOK_FOR_RCM: Final = 3.0
"""Seconds in which a mesh that has an RCM shows it."""
CLOSED: Final = "this lab is closed; zscout.connect() gives a new one"
LAST_STEPS: Final = 1.0
"""Seconds in which what still runs in the loop hears that its lab is closed."""


class BlockingHeld:
    """A hold in force, as a plain object."""

    def __init__(self, lab: Lab, held: Held) -> None:
        self._lab, self._held = lab, held
        self._body = InterruptibleBody(self._revoked)

    @property
    def grant(self) -> Grant:
        return self._held.grant

    @property
    def active(self) -> bool:
        """Whether the hold is still in force, as far as this client knows."""
        return self._held.active and not self._held.completed

    @property
    def completed(self) -> bool:
        """Whether the hold is over because it had its time: its minimum runtime, and with `keep` somebody waited."""
        return self._held.completed

    @property
    def remaining(self) -> float:
        """Seconds of the minimum runtime that are left: in these only a higher priority takes it."""
        return self._held.remaining

    def check(self) -> None:
        """Raises Revoked once the hold is over."""
        if not self.active:
            self._body.told = True
            raise self._revoked()

    def wait(self, timeout: float | None = None) -> bool:
        """Waits until the hold is over, at most `timeout` seconds. True: it is over, and nothing is raised for it."""
        self._body.waits = True
        try:
            over = self._lab.run(self._over_within(timeout))
            self._body.told |= over
        finally:
            self._body.waits = False
        return over

    @property
    def rcs(self) -> list[str]:
        """All that it holds, sorted."""
        return list(self._held.rcs)

    def rc(self, need: str) -> str:
        """The RC that meets a need, as `arc.Held.rc` has it. Raises KeyError."""
        return self._held.rc(need)

    def command(self, need: str, do: Mapping[str, Any], *, ttl: float = 1.0) -> Any:
        """Has one of the held RCs do something and returns its result: the one of this name, or that meets
        this pattern. Raises CommandRefused, and KeyError for a pattern that was not asked for."""
        return self._lab.run(self._held.command(need, do, ttl=ttl)).result

    async def _over_within(self, timeout: float | None) -> bool:
        return await done_within(timeout, self._held.over())

    def _revoked(self) -> Revoked:
        arc = self._held.arc
        over = HoldEnd("completed", "its minimum runtime is over") if self._held.active else None
        return Revoked(arc, over)


class BlockingAttempt(AbstractContextManager[BlockingHeld, None]):
    """What `Lab.hold` gives: waits for the grant when it is entered, and gives back when it is left."""

    def __init__(self, lab: Lab, attempt: Attempt, *, interrupt: bool) -> None:
        self._lab, self._attempt, self._interrupt = lab, attempt, interrupt
        self._held: BlockingHeld | None = None
        self._entering: asyncio.Task[Any] | None = None
        self._watch: asyncio.Task[None] | None = None

    def __enter__(self) -> BlockingHeld:
        try:
            self._held = BlockingHeld(self._lab, self._lab.run(self._granted()))
            if self._interrupt and interruptible():
                self._held._body.enter()
                self._lab.run(self._watch_over(self._held))
        except BaseException:
            self._leave()
            raise
        return self._held

    @uninterrupted
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        held = self._held
        assert held is not None  # noqa: S101 - entered before left
        unknown = kind is None and not held.active and not held.completed and not held._body.told
        revoked = held._revoked() if unknown else None
        self._leave()
        if revoked is not None:
            raise revoked

    @uninterrupted
    def _leave(self) -> None:
        try:
            if not self._lab.closed:
                self._lab.run(self._end())
        finally:
            if self._held is not None:
                self._held._body.leave()

    # In the loop's thread

    async def _granted(self) -> Held:
        self._entering = asyncio.current_task()
        await self._lab.client.see_rcm(LOOK_FOR_RCM)
        return await self._attempt.granted()

    async def _watch_over(self, held: BlockingHeld) -> None:
        self._watch = asyncio.create_task(self._interrupt_when_over(held))

    async def _interrupt_when_over(self, held: BlockingHeld) -> None:
        direct = self._lab.client.direct_hold(held.grant)
        await held._held.over()
        await held._body.interrupt()
        if direct is not None:
            await asyncio.sleep(max(0, direct.gone_by - held._held.now()) / SECOND)
            log.warning(
                "%s cleans up too long after its hold; interrupting it, the next holder begins", direct.arc.name
            )
            held._body.told = False
            await held._body.interrupt()

    async def _end(self) -> None:
        if self._watch is not None:
            self._watch.cancel()
        if self._entering is not None and not self._entering.done():
            # It was interrupted, and withdraws what it asked for.
            await asyncio.wait([self._entering])
        arc, client = self._attempt.arc, self._lab.client
        if self._held is not None and (direct := client.direct_hold(self._held.grant)) is not None:
            direct.returned()
        if arc is not None and arc.open:
            if self._held is not None and self._held.completed:
                client.complete(arc)
            else:
                await client.end(arc)


class Lab:
    """A client whose event loop runs in a thread of its own."""

    def __init__(self, name: str | None = None, *, fleet: Fleet | None = None, host: str | None = None) -> None:
        self._loop = uvloop.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="zscout", daemon=True)
        self._asking = threading.Lock()
        self._stopped = False
        self._thread.start()
        try:
            self.client = self.run(Client.connect(name, fleet=fleet, host=host))
        except BaseException:
            self._stop()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    @property
    def closed(self) -> bool:
        # No thread: this is a fork of the process that has it.
        return self._stopped or not self._thread.is_alive()

    def run(self, coroutine: Coroutine[Any, Any, T]) -> T:
        """What the coroutine returns, which runs in the loop of the client. Raises RuntimeError where that is closed,
        or is closed meanwhile by another thread."""
        with self._asking:
            if closed := self.closed:
                coroutine.close()
            else:
                future = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
        if closed:
            raise RuntimeError(CLOSED)
        try:
            return future.result()
        except futures.CancelledError:
            raise RuntimeError(CLOSED) from None
        except BaseException:
            future.cancel()
            raise

    @uninterrupted
    def close(self) -> None:
        """Gives back everything and leaves the mesh."""
        if not self.closed:
            try:
                self.run(self.client.close())
            finally:
                self._stop()

    def hold(
        self,
        name: str,
        needs: Needs,
        *,
        priority: int = 0,
        min_runtime: float | None = None,
        keep: bool = True,
        direct: bool = False,
        confirmed: bool = False,
        timeout: float | None = None,
        interrupt: bool = True,
        comment: str = "",
        wait_for_device: bool | None = None,
        booking: str = "",
    ) -> AbstractContextManager[BlockingHeld, None]:
        """When entered it waits for all of `needs`, at most `timeout` seconds; when left it gives them back. Others
        are shown the `comment`.

        The hold is protected for `min_runtime` seconds (default: the fleet's, 60), and goes on until somebody of equal
        or higher priority waits for what it holds; with `keep=False` it ends when they are over. Then, or when it is
        taken away before, `Revoked` is raised in a body in the main thread, unless `interrupt` is false: its `outcome`
        is `completed` where it had its time.

        With `confirmed` it is entered when all RCs have confirmed the grant: until then one may be made ready yet, and
        a command to it waits for as long as its `ttl`.

        A body that touches devices past their RCs says `direct`: they settle until it has been left, in at most nine
        tenths of their `settle`; the next holder waits for that, and Revoked is raised once more in who takes longer.

        What can never start is refused; with `wait_for_device`, not for a need that nobody knows. With a `booking`, by
        its id, it takes that up, whose needs and priority it has, and waits for its next date.

        Entering raises TimeoutError, RequestRefused, Revoked where others ended the request, and NoRcm where none is
        seen within 3 s. Leaving raises Revoked where the hold was taken away and the body has not been told."""
        how: dict[str, Any] = {"priority": priority, "min_runtime": min_runtime, "keep": keep, "timeout": timeout}
        how |= {"comment": comment, "direct": direct, "confirmed": confirmed, "wait_for_device": wait_for_device}
        how["booking"] = booking
        return BlockingAttempt(self, hold(self.client, name, needs, **how), interrupt=interrupt)

    def _stop(self) -> None:
        with self._asking:
            if self._stopped:
                return
            self._stopped = True
        asyncio.run_coroutine_threadsafe(self._cancel_rest(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    async def _cancel_rest(self) -> None:
        """Other threads may wait for something here."""
        rest = asyncio.all_tasks() - {asyncio.current_task()}
        for task in rest:
            task.cancel()
        if rest:
            await asyncio.wait(rest, timeout=LAST_STEPS)


def connect(name: str | None = None, *, fleet: Fleet | None = None, host: str | None = None) -> Lab:
    """Joins the mesh from a plain script. Raises MeshError, BadInput."""
    return Lab(name, fleet=fleet, host=host)

"""A direct hold, as its client sees it: its program touches devices past their RCs, which settle until it is gone.

Once every RC of the grant has confirmed it, it is confirmed again every third of a hold lease at each of them. It may
be relied on until a hold lease after the last confirmation was *sent* that all of them have answered (`sure_until`);
when that is over the hold is, whatever RCMs say. From any end but its client's own release on, the program has less
than `settle`. At such an end the RCs are told `leaving` at once, and `left` when the program is gone.

All times are those of `Mesh.now`: whole ns of CLOCK_BOOTTIME, which all processes of a host share."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any, Final, Protocol

from zscout.behaviors.client.request import CommandRefused, OpenArc
from zscout.config.devices import SETTLE
from zscout.messages import Done
from zscout.types import SECOND, Grant, Ns, RcName

CONFIRMS: Final = 3
"""Confirmations in a hold lease."""
TRY_AGAIN_AFTER: Final = 0.1
"""Seconds after which an RC that did not answer is told again."""
TELL_TIMEOUT: Final = 0.5
"""Seconds that one `leaving` or `left` waits for an answer."""
DEFAULT_SETTLE: Final = SETTLE
"""Where no RC says how long it settles."""
MARGIN: Final = 10
"""The last tenth of `settle` is for the kernel, and for clocks that run apart."""


class CommandSender(Protocol):
    async def __call__(self, rc: str, grant: Grant, do: dict[str, Any], *, timeout: float) -> Done: ...


class DirectHold:
    """One hold of a direct request, from its first confirmation until its program is gone."""

    def __init__(
        self,
        arc: OpenArc,
        grant: Grant,
        command: CommandSender,
        now: Callable[[], Ns],
        spawn: Callable[[Coroutine[Any, Any, None]], asyncio.Task[None]],
        *,
        hold_lease: Ns,
    ) -> None:
        self.arc, self.grant, self.rcs = arc, grant, list(arc.rcs)
        self._command, self._now, self._spawn, self._lease = command, now, spawn, hold_lease
        self._confirmed: dict[RcName, Ns] = {}
        """By RC: when the last confirmation was sent that it has answered."""
        self._settles: dict[RcName, Ns] = {}
        """By RC: how long it settles at most. Foreign ones do not say, and are told nothing."""
        self.ended_at: Ns | None = None
        """When this client heard of its end, or judged so; None: it is in force."""
        self.gone = False
        """Whether its program is."""
        self._watchers: list[Callable[[DirectHold], object]] = []
        self._telling: dict[str, asyncio.Task[None]] = {}
        self._confirming: asyncio.Task[None] | None = None

    # For who runs the program

    @property
    def sure_until(self) -> Ns:
        """Until then the hold may be relied on; it grows with each round of confirmations."""
        confirmed = [self._confirmed.get(rc) for rc in self.rcs]
        return min((0 if sent is None else sent + self._lease for sent in confirmed), default=0)

    @property
    def settle(self) -> Ns:
        """The least that one of its RCs settles: a longer time from SIGTERM to SIGKILL is of no use."""
        return min(self._settles.values(), default=DEFAULT_SETTLE)

    @property
    def never_settle(self) -> list[RcName]:
        """Its RCs that do not know how: foreign ones, and those of v0.1.0."""
        return [rc for rc in self.rcs if rc not in self._settles]

    @property
    def grace(self) -> Ns:
        """The longest time from SIGTERM to SIGKILL for its program."""
        return self.settle - self.settle // MARGIN

    @property
    def gone_by(self) -> Ns:
        """By then the program must have been killed, whatever happens to this client. It grows as `sure_until` does
        while the hold is in force, and is less from its end on."""
        end = self.sure_until if self.ended_at is None else min(self.ended_at, self.sure_until)
        return end + self.grace

    @property
    def over(self) -> bool:
        """Whether the hold has ended: the program is to end now, and by `gone_by` at the latest."""
        return self.ended_at is not None

    def watch(self, watcher: Callable[[DirectHold], object]) -> None:
        """Calls `watcher(hold)` whenever `gone_by` has changed or the hold is over: at an end before its RCs are told
        that the program is leaving. It must not block."""
        self._watchers.append(watcher)

    def returned(self) -> None:
        """The program is gone, all of it: the RCs need not settle any longer. Once, however often it is called."""
        if not self.gone:
            self.gone = True
            self._stop_confirming()
            self._tell("left")

    @property
    def telling(self) -> list[asyncio.Task[None]]:
        """What is being told to its RCs, as long as that makes a difference to them."""
        return [task for task in self._telling.values() if not task.done()]

    # For the client

    def confirmed(self, rc: RcName, sent: Ns, done: Done) -> None:
        """`rc` has answered the confirmation that was sent then."""
        self._confirmed[rc] = max(sent, self._confirmed.get(rc, 0))
        if done.settle is not None:
            self._settles[rc] = round(done.settle * SECOND)
        self._notify()

    def unanswered(self, since: Ns) -> list[RcName]:
        """The RCs that have answered no confirmation sent after that."""
        return [rc for rc in self.rcs if self._confirmed.get(rc, since) <= since]

    def keep_confirming(self, on_unsure: Callable[[DirectHold], object]) -> None:
        """From now on it is confirmed again and again. `on_unsure(self)`: an RC has not answered for a hold lease."""
        if self._confirming is None and not (self.over or self.gone):
            self._confirming = self._spawn(self._keep_confirming(on_unsure))

    def end(self, *, released: bool = False) -> None:
        """The hold is over; `released`: as its own client gives it back, whose program is gone."""
        if not self.over:
            self.ended_at, self.arc._left = self._now(), self.grant
            self._stop_confirming()
            self._notify()
        if released:
            self.returned()
        elif not self.gone:
            self._tell("leaving")

    def _notify(self) -> None:
        for watcher in self._watchers:
            watcher(self)

    def _stop_confirming(self) -> None:
        if self._confirming is not None and self._confirming is not asyncio.current_task():
            self._confirming.cancel()

    async def _keep_confirming(self, on_unsure: Callable[[DirectHold], object]) -> None:
        due = self._now()
        while not (self.over or self.gone):
            now = self._now()
            if now >= self.sure_until:
                on_unsure(self)
                return
            if self.arc._is_over(now):
                self.end()
                return
            if now >= due:
                due = now + self._lease // CONFIRMS
                for rc in self.rcs:
                    self._spawn(self._confirm(rc))
            ends = [due, self.sure_until, *([] if self.arc.keep or self.arc.ready is not None else [self.arc.end])]
            await asyncio.sleep(max(0.001, (min(ends) - self._now()) / SECOND))

    async def _confirm(self, rc: RcName) -> None:
        sent = self._now()
        try:
            done = await self._command(rc, self.grant, {"name": "confirm"}, timeout=self._lease / SECOND)
        except CommandRefused:
            return
        if not (self.over or self.gone):
            self.confirmed(rc, sent, done)

    def _tell(self, what: str) -> None:
        if what not in self._telling and self._settles:
            if what == "left" and "leaving" in self._telling:
                self._telling["leaving"].cancel()
            # Not the supervisor's: this is also told as the client closes.
            self._telling[what] = asyncio.create_task(self._tell_all(what))

    async def _tell_all(self, what: str) -> None:
        await asyncio.gather(*(self._tell_one(rc, what) for rc in self._settles))

    async def _tell_one(self, rc: RcName, what: str) -> None:
        """Until it has answered, or has settled anyway."""
        until = self._now() + self._settles[rc]
        while self._now() < until:
            try:
                await self._command(rc, self.grant, {"name": what}, timeout=TELL_TIMEOUT)
            except CommandRefused as refused:
                if refused.code not in ("unknown", "busy", "stale"):
                    return  # it knows nothing of this hold any more
            else:
                return
            await asyncio.sleep(TRY_AGAIN_AFTER)

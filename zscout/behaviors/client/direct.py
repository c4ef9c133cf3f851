"""A direct hold on the side of its client: its program also reaches devices past their RCs, which settle until it is
gone.

Once every RC has confirmed the grant, each confirms it again every third of a hold lease. An RC's confirmation is good
for a hold lease from the moment at which the query for it was *sent*. The hold is safe while all are good (until
`sure_until`); then it ends, even if the RCM publishes it. After any end but the client's own release, the program has
less than `settle` to end. The client sends `leaving` to the RCs at such an end, and `left` once the program is gone.

All times are in ns by `Mesh.now`: CLOCK_BOOTTIME, which all processes of a host share."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any, Final, Protocol

from zscout.behaviors.client.request import CommandRefused, OpenArc
from zscout.config.devices import SETTLE
from zscout.messages import Done
from zscout.types import SECOND, Grant, Ns, RcName

CONFIRMS: Final = 3
"""Confirmations per hold lease."""
TRY_AGAIN_AFTER: Final = 0.1
"""Seconds after which an unanswered report is sent again."""
REPORT_TIMEOUT: Final = 0.5
"""Seconds to wait for the answer to `leaving` or `left`."""
DEFAULT_SETTLE: Final = SETTLE
"""Used if no RC reports how long it settles, in ns."""
MARGIN: Final = 10
"""One part in MARGIN of `settle` is reserved for the kernel, and for the drift of clocks."""


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
        """By RC: when the last answered confirmation was sent."""
        self._settles: dict[RcName, Ns] = {}
        """By RC: how long it settles at most. Foreign RCs don't report that, and get no reports."""
        self.ended_at: Ns | None = None
        """When this client learned of the hold's end, or ended it; None while it is in force."""
        self.gone = False
        """True once its program has ended."""
        self._watchers: list[Callable[[DirectHold], object]] = []
        self._reports: dict[str, asyncio.Task[None]] = {}
        self._confirming: asyncio.Task[None] | None = None

    @property
    def sure_until(self) -> Ns:
        """Time until which the hold is safe; it grows with each round of confirmations."""
        confirmed = [self._confirmed.get(rc) for rc in self.rcs]
        return min((0 if sent is None else sent + self._lease for sent in confirmed), default=0)

    @property
    def settle(self) -> Ns:
        """Shortest settling time of its RCs, and so the limit for the time from SIGTERM to SIGKILL."""
        return min(self._settles.values(), default=DEFAULT_SETTLE)

    @property
    def never_settle(self) -> list[RcName]:
        """Its RCs that can't settle: foreign RCs, and RCs of v0.1.0."""
        return [rc for rc in self.rcs if rc not in self._settles]

    @property
    def grace(self) -> Ns:
        """The longest time from SIGTERM to SIGKILL for its program."""
        return self.settle - self.settle // MARGIN

    @property
    def gone_by(self) -> Ns:
        """When the program is killed at the latest. It grows with `sure_until`, and may shrink at the hold's end."""
        end = self.sure_until if self.ended_at is None else min(self.ended_at, self.sure_until)
        return end + self.grace

    @property
    def over(self) -> bool:
        return self.ended_at is not None

    def watch(self, watcher: Callable[[DirectHold], object]) -> None:
        """Call `watcher(hold)` when `gone_by` changes, and at the end before `leaving` is sent. Must not block."""
        self._watchers.append(watcher)

    def returned(self) -> None:
        """Report that the whole program has ended, so that the RCs stop settling. May be repeated."""
        if not self.gone:
            self.gone = True
            self._stop_confirming()
            self._report("left")

    @property
    def reporting(self) -> list[asyncio.Task[None]]:
        return [task for task in self._reports.values() if not task.done()]

    def confirmed(self, rc: RcName, sent: Ns, done: Done) -> None:
        """Take the answer `done` of `rc` to a confirmation sent at `sent`."""
        self._confirmed[rc] = max(sent, self._confirmed.get(rc, 0))
        if done.settle is not None:
            self._settles[rc] = round(done.settle * SECOND)
        self._notify()

    def unanswered(self, since: Ns) -> list[RcName]:
        """Return the RCs that have answered no confirmation sent after `since`."""
        return [rc for rc in self.rcs if self._confirmed.get(rc, since) <= since]

    def keep_confirming(self, on_unsure: Callable[[DirectHold], object]) -> None:
        """Calls `on_unsure(self)` if an RC has not answered for a hold lease."""
        if self._confirming is None and not (self.over or self.gone):
            self._confirming = self._spawn(self._keep_confirming(on_unsure))

    def end(self, *, released: bool = False) -> None:
        """End the hold. `released`: its program has ended, and the client gives the hold back."""
        if not self.over:
            self.ended_at, self.arc._grant_left = self._now(), self.grant
            self._stop_confirming()
            self._notify()
        if released:
            self.returned()
        elif not self.gone:
            self._report("leaving")

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

    def _report(self, what: str) -> None:
        if what not in self._reports and self._settles:
            if what == "left" and "leaving" in self._reports:
                self._reports["leaving"].cancel()
            # A task outside the supervisor, as this is also sent while the client closes.
            self._reports[what] = asyncio.create_task(self._report_to_all(what))

    async def _report_to_all(self, what: str) -> None:
        await asyncio.gather(*(self._report_to(rc, what) for rc in self._settles))

    async def _report_to(self, rc: RcName, what: str) -> None:
        """Repeat a report until the RC has answered it, or has settled without it."""
        until = self._now() + self._settles[rc]
        while self._now() < until:
            try:
                await self._command(rc, self.grant, {"name": what}, timeout=REPORT_TIMEOUT)
            except CommandRefused as refused:
                if refused.code not in ("unknown", "busy", "stale"):
                    return  # the RC does not have this hold any more
            else:
                return
            await asyncio.sleep(TRY_AGAIN_AFTER)

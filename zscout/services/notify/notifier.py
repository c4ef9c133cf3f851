"""Notifies people by Apprise while this node leads. Notifications are sent in a thread of their own, so that a hanging
service delays only other notifications. Failures are logged sparsely, and without the URL."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Iterable, Sequence
from typing import Final

from zscout.config.apprise_process import NoAnswer, send
from zscout.config.notify import Address, NotifyConfig
from zscout.mesh.sparse_log import SparseLog
from zscout.mesh.supervision import Supervisor, clock
from zscout.messages import LoadReport
from zscout.rcm.steps import BookedDanger
from zscout.services.notify.notices import CertificateNotices, HoldNotices, Notification, booking_notice
from zscout.services.notify.rate_limit import RateLimit
from zscout.types import SECOND, Ns

log = logging.getLogger(__name__)

QUEUE: Final = 100
"""Waiting notifications; further ones are dropped."""
PAUSES: Final = (1.0, 5.0)
"""Seconds before each further attempt."""
REST: Final[Ns] = 60 * SECOND
"""After its last attempt failed, a URL is skipped for so long, so that it does not delay others."""
LOOK: Final = 60.0
"""Seconds between two checks of certificates."""


class Notifier:
    """`holds`: a HoldListener; `reports`: the newest load reports of all hosts while this node leads, else none."""

    def __init__(
        self,
        fleet: str,
        config: NotifyConfig,
        reports: Callable[[], Iterable[LoadReport]],
        *,
        pauses: Sequence[float] = PAUSES,
        look: float = LOOK,
    ) -> None:
        self._fleet, self.holds = fleet, HoldNotices(fleet, config.after, self.notify)
        self._config, self._reports, self._pauses, self._look_every = config, reports, pauses, look
        self._certificates = CertificateNotices(fleet)
        self._waiting: queue.Queue[Notification] = queue.Queue(QUEUE)
        self._stopping = threading.Event()
        # The first is used by the event loop, the second by the thread.
        self._full, self._unsent = SparseLog(log, clock.now), SparseLog(log, clock.now)
        self._supervisor = Supervisor("the notifier", lambda _error: None)
        self._limits: dict[Address, RateLimit] = {}
        self._resting: dict[Address, Ns] = {}
        """End of the pause of each address."""

    def start(self) -> None:
        # A daemon: a stopping node does not wait for a hanging service.
        threading.Thread(target=self._run, name="notifies", daemon=True).start()
        self._supervisor.call_later(self._look_every, self._look)

    def stop(self) -> None:
        self._stopping.set()
        self._supervisor.cancel()

    def notify(self, notification: Notification) -> None:
        """Never blocks."""
        if not self._addresses(notification):
            return
        try:
            self._waiting.put_nowait(notification)
        except queue.Full:
            self._full.warning("", "%d notifications are waiting: dropped another", QUEUE)

    def on_danger(self, danger: BookedDanger) -> None:
        self.notify(booking_notice(self._fleet, danger))

    def _addresses(self, about: Notification) -> tuple[Address, ...]:
        shared = self._config.urls if about.event in self._config.events else ()
        # Each URL once.
        return tuple({to.url: to for to in (*shared, *self._config.users.get(about.user, ()))}.values())

    def _look(self) -> None:
        for expiry in self._certificates.look(self._reports()):
            self.notify(expiry)
        self._supervisor.call_later(self._look_every, self._look)

    def _run(self) -> None:
        while not self._stopping.is_set():
            try:
                notification = self._waiting.get(timeout=1.0)
            except queue.Empty:
                continue
            for address in self._addresses(notification):
                self._send(address, notification)
            self._waiting.task_done()

    def _send(self, address: Address, notification: Notification) -> None:
        if clock.now() < self._resting.get(address, 0):
            self._unsent.warning(address.at, "%s can't be reached: dropped a notification", address.at)
            return
        limit = self._limits.setdefault(address, RateLimit(self._config.per_minute))
        if not limit.allows(clock.now()):
            many = self._config.per_minute
            self._unsent.warning(address.at, "%s: more than %d a minute; dropping the rest", address.at, many)
            return
        why = self._attempt(address, notification)
        for pause in self._pauses:
            if not why or self._stopping.wait(pause):
                break
            why = self._attempt(address, notification)
        if why and not self._stopping.is_set():
            self._resting[address] = clock.now() + REST
            times = 1 + len(self._pauses)
            self._unsent.warning(address.at, "%s was not notified in %d attempts: %s", address.at, times, why)

    def _attempt(self, address: Address, notification: Notification) -> str:
        """Send once; return the reason of a failure, else an empty text."""
        try:
            taken = send(address.url, notification.title, notification.body)
        except NoAnswer as error:
            return str(error)
        return "" if taken else "the service refused it"

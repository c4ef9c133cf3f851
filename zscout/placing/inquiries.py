"""What hosts are to be asked, until they tell: of a token that nobody knows, and, after a host was believed
gone, of all that it had.
"""

from __future__ import annotations

from itertools import islice
from typing import Final

from zscout.balancing.model import ComponentId, HostName
from zscout.placing.ground import ANSWER, MAX_COMPONENTS, Ground

KIND: Final = "inquiry"
"""Of their timers."""
AT_ONCE: Final = 200
"""Questions to one host; the next follow when these are answered, or time is up."""


class Inquiries:
    def __init__(self, ground: Ground) -> None:
        self._ground = ground
        self._open: dict[HostName, dict[ComponentId, None]] = {}
        self._tries: dict[HostName, int] = {}
        self._count = 0

    def add(self, host: HostName, component: ComponentId) -> None:
        """At once if the host is there, else when it is."""
        if self._count >= MAX_COMPONENTS:
            # The oldest are of hosts that will not come back.
            self._drop(next(iter(self._open)))
        found = self._open.setdefault(host, {})
        if component not in found:
            found[component] = None
            self._count += 1
            if host in self._ground.alive:
                self._ground.look(component, host)
                self._tries.setdefault(host, 0)
                self._ground.timers.set((KIND, host), self._ground.now + ANSWER)

    def open(self, host: HostName, component: ComponentId) -> bool:
        return component in self._open.get(host, {})

    def answered(self, host: HostName, component: ComponentId | None) -> list[ComponentId]:
        """A host has told of this component, or of all. Returns those of which it was to tell."""
        found = self._open.get(host, {})
        told = list(found) if component is None else [component] if component in found else []
        for one in told:
            del found[one]
        self._count -= len(told)
        if not found:
            self._drop(host)
        return told

    def seen(self, host: HostName) -> None:
        """It is there: it is asked at once."""
        if host in self._open:
            self._tries[host] = 0
            self.woke(host)

    def woke(self, host: HostName) -> None:
        ground = self._ground
        if host not in ground.alive:
            return
        for component in islice(self._open.get(host, {}), AT_ONCE):
            ground.look(component, host)
        self._tries[host] = tries = self._tries.get(host, 0) + 1
        ground.timers.set((KIND, host), ground.now + max(ANSWER, ground.pause(tries)))

    def _drop(self, host: HostName) -> None:
        self._count -= len(self._open.pop(host, {}))
        self._tries.pop(host, None)
        self._ground.timers.set((KIND, host), None)

"""Strays: incarnations that must not live. Each is told to stop until its host says that it has ended, or is
gone itself.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from zscout.balancing.model import SECOND, ComponentId, HostName, Ns
from zscout.placing.events import Incarnation
from zscout.placing.ground import STOP_ANSWER, Ground

MAX_STRAYS: Final = 100
"""Of one component."""


@dataclass(slots=True)
class Stray:
    host: HostName
    start_until: Ns | None
    """Until then its start may still be on the way, and a stop that came first has stopped nothing."""
    token: bool = False
    """It is alive: whoever says that it was stopped said so before it began."""
    stopped: bool = False
    tries: int = 0
    due: Ns = 0


class Strays:
    def __init__(self, ground: Ground) -> None:
        self._ground = ground
        self._of: dict[ComponentId, dict[Incarnation, Stray]] = {}

    def any(self, component: ComponentId) -> bool:
        return component in self._of

    def has(self, component: ComponentId, incarnation: Incarnation) -> bool:
        return incarnation in self._of.get(component, {})

    def add(
        self,
        component: ComponentId,
        incarnation: Incarnation,
        host: HostName,
        start_until: Ns | None = None,
        *,
        token: bool = False,
    ) -> None:
        """This incarnation must end. Where its host is gone it has."""
        strays = self._of.setdefault(component, {})
        if host in self._ground.alive and incarnation not in strays and len(strays) < MAX_STRAYS:
            strays[incarnation] = Stray(host, start_until, token)
            self._stop(component, incarnation, strays[incarnation])
        self._set(component)

    def start_answered(self, component: ComponentId, incarnation: Incarnation) -> bool:
        """Whether it is a stray. It is told once more: the first time may have been before its start."""
        stray = self._of.get(component, {}).get(incarnation)
        if stray is None:
            return False
        if stray.start_until is not None:
            stray.start_until = None
            self._stop(component, incarnation, stray)
            self._set(component)
        return True

    def stop_answered(self, component: ComponentId, incarnation: Incarnation, *, done: bool) -> None:
        stray = self._of.get(component, {}).get(incarnation)
        if stray is None:
            return
        stray.stopped = done
        if done and stray.start_until is None and not stray.token:
            self.over(component, incarnation)
        elif not done:
            stray.tries += 1
            stray.due = self._ground.now + self._ground.pause(stray.tries)
        else:
            stray.due = self._ground.now + SECOND
        self._set(component)

    def token(self, component: ComponentId, incarnation: Incarnation, *, alive: bool) -> None:
        """Its token came or went."""
        stray = self._of.get(component, {}).get(incarnation)
        if stray is not None:
            stray.token = alive
            if alive:
                stray.start_until = None
            elif stray.stopped:
                self.over(component, incarnation)

    def over(self, component: ComponentId, incarnation: Incarnation) -> None:
        if self._of.get(component, {}).pop(incarnation, None) is not None:
            entry = self._ground.entries.get(component)
            if entry is not None:
                entry.over.append(incarnation)
        self._set(component)

    def woke(self, component: ComponentId) -> None:
        for incarnation, stray in self._of.get(component, {}).items():
            if stray.due <= self._ground.now:
                if stray.start_until is not None and stray.start_until <= self._ground.now:
                    stray.start_until = None
                self._stop(component, incarnation, stray)
        self._set(component)

    def lost(self, host: HostName) -> list[ComponentId]:
        """A host is gone, and all that was to end there. Returns whose that was."""
        found = []
        for component, strays in list(self._of.items()):
            there = [incarnation for incarnation, stray in strays.items() if stray.host == host]
            for incarnation in there:
                del strays[incarnation]
            if there:
                found.append(component)
            self._set(component)
        return found

    def _stop(self, component: ComponentId, incarnation: Incarnation, stray: Stray) -> None:
        stray.due = self._ground.now + STOP_ANSWER
        self._ground.stop(component, incarnation, stray.host)

    def _set(self, component: ComponentId) -> None:
        strays = self._of.get(component)
        if not strays:
            self._of.pop(component, None)
        due = min((stray.due for stray in strays.values()), default=None) if strays else None
        self._ground.timers.set(("strays", component), due)

"""Commands repeated until a host answers: stops of surplus incarnations, and probes."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from typing import Final

from zscout.messages import Incarnation
from zscout.placement.state import MAX_COMPONENTS, PROBE_TIMEOUT, STOP_TIMEOUT, PlacementState, TimerKind
from zscout.types import SECOND, ComponentId, HostName, Ns

MAX_SURPLUS: Final = 100
"""Surplus incarnations of one component."""
PROBES_AT_ONCE: Final = 200
"""Probes to one host at a time; the next follow after the answers or a timeout."""


@dataclass(slots=True)
class _Surplus:
    host: HostName
    start_until: Ns | None  # until then its start may still be on the way, and an earlier stop had no effect
    token: bool = False  # alive: a report of its stop is older than its start
    stop_confirmed: bool = False
    tries: int = 0
    due: Ns = 0


class SurplusIncarnations:
    """Incarnations that must not live. Each is stopped until its host reports its end, or is lost."""

    def __init__(self, state: PlacementState) -> None:
        self._state = state
        self._of: dict[ComponentId, dict[Incarnation, _Surplus]] = {}

    def any(self, component: ComponentId) -> bool:
        return component in self._of

    def has(self, component: ComponentId, incarnation: Incarnation) -> bool:
        return self._get(component, incarnation) is not None

    def _get(self, component: ComponentId, incarnation: Incarnation) -> _Surplus | None:
        return self._of.get(component, {}).get(incarnation)

    def add(
        self,
        component: ComponentId,
        incarnation: Incarnation,
        host: HostName,
        start_until: Ns | None = None,
        *,
        token: bool = False,
    ) -> None:
        """End this incarnation; without its host it has ended."""
        known = self._of.setdefault(component, {})
        if host in self._state.alive and incarnation not in known and len(known) < MAX_SURPLUS:
            known[incarnation] = surplus = _Surplus(host, start_until, token)
            self._stop(component, incarnation, surplus)
        self._set_timer(component)

    def start_answered(self, component: ComponentId, incarnation: Incarnation, *, may_run: bool) -> bool:
        """Return True if it is surplus, and stop it again: the first stop may have come before its start."""
        surplus = self._get(component, incarnation)
        if surplus is not None and not may_run:
            self.ended(component, incarnation)
        elif surplus is not None and surplus.start_until is not None:
            surplus.start_until = None
            self._stop(component, incarnation, surplus)
            self._set_timer(component)
        return surplus is not None

    def stop_answered(self, component: ComponentId, incarnation: Incarnation, *, done: bool) -> None:
        surplus = self._get(component, incarnation)
        if surplus is None:
            return
        surplus.stop_confirmed = done
        if not done:
            surplus.tries += 1
            surplus.due = self._state.now + self._state.back_off_time(surplus.tries)
        elif surplus.start_until is None and not surplus.token:
            self.ended(component, incarnation)
        else:
            surplus.due = self._state.now + SECOND
        self._set_timer(component)

    def token(self, component: ComponentId, incarnation: Incarnation, *, alive: bool) -> None:
        surplus = self._get(component, incarnation)
        if surplus is not None:
            surplus.token = alive
            if alive:
                surplus.start_until = None
            elif surplus.stop_confirmed:
                self.ended(component, incarnation)

    def ended(self, component: ComponentId, incarnation: Incarnation) -> None:
        if self._of.get(component, {}).pop(incarnation, None) is not None:
            record = self._state.components.get(component)
            if record is not None:
                record.ended_incarnations.append(incarnation)
        self._set_timer(component)

    def host_lost(self, host: HostName) -> list[ComponentId]:
        found = []
        for component, known in list(self._of.items()):
            left = {incarnation: surplus for incarnation, surplus in known.items() if surplus.host != host}
            if len(left) < len(known):
                self._of[component] = left
                self._set_timer(component)
                found.append(component)
        return found

    def timer(self, component: ComponentId) -> None:
        now = self._state.now
        for incarnation, surplus in self._of.get(component, {}).items():
            if surplus.due <= now:
                if surplus.start_until is not None and surplus.start_until <= now:
                    surplus.start_until = None
                self._stop(component, incarnation, surplus)
        self._set_timer(component)

    def _stop(self, component: ComponentId, incarnation: Incarnation, surplus: _Surplus) -> None:
        surplus.due = self._state.now + STOP_TIMEOUT
        self._state.stop(component, incarnation, surplus.host)

    def _set_timer(self, component: ComponentId) -> None:
        known = self._of.get(component, {})
        if not known:
            self._of.pop(component, None)
        due = min((surplus.due for surplus in known.values()), default=None)
        self._state.timers.set(TimerKind.SURPLUS, component, due)


class Probes:
    """With unexpected tokens, or on a host when it was lost; asked about until it answers."""

    def __init__(self, state: PlacementState) -> None:
        self._state = state
        self._open: dict[HostName, dict[ComponentId, None]] = {}
        self._tries: dict[HostName, int] = {}
        self._count = 0

    def add(self, host: HostName, component: ComponentId) -> None:
        if self._count >= MAX_COMPONENTS:
            # The oldest belong to hosts unlikely to return.
            self._drop(next(iter(self._open)))
        probes = self._open.setdefault(host, {})
        if component not in probes:
            probes[component] = None
            self._count += 1
            if host in self._state.alive:
                self._state.probe(component, host)
                self._tries.setdefault(host, 0)
                self._state.timers.set(TimerKind.PROBES, host, self._state.now + PROBE_TIMEOUT)

    def has(self, host: HostName, component: ComponentId) -> bool:
        return component in self._open.get(host, {})

    def answered(self, host: HostName, component: ComponentId | None) -> list[ComponentId]:
        """A host listed this component, or (None) all. Returns the probed ones."""
        probes = self._open.get(host, {})
        found = list(probes) if component is None else [component] if component in probes else []
        for name in found:
            del probes[name]
        self._count -= len(found)
        if not probes:
            self._drop(host)
        return found

    def host_joined(self, host: HostName) -> None:
        if host in self._open:
            self._tries[host] = 0
            self.timer(host)

    def timer(self, host: HostName) -> None:
        state = self._state
        if host not in state.alive:
            return
        for component in islice(self._open.get(host, {}), PROBES_AT_ONCE):
            state.probe(component, host)
        self._tries[host] = tries = self._tries.get(host, 0) + 1
        pause = max(PROBE_TIMEOUT, state.back_off_time(tries))
        state.timers.set(TimerKind.PROBES, host, state.now + pause)

    def _drop(self, host: HostName) -> None:
        self._count -= len(self._open.pop(host, {}))
        self._tries.pop(host, None)
        self._state.timers.set(TimerKind.PROBES, host, None)

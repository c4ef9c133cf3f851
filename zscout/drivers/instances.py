"""Decides which instance of an RC serves, as two nodes may offer devices under the same name.

An instance is on standby if it finds another instance on the mesh, or if the RCM names another: it holds nothing,
answers nothing and keeps its token. When the serving instance has been gone for the hold lease, after which it holds
nothing, plus the settling time, this instance offers itself, and serves once an RCM names it."""

from __future__ import annotations

import asyncio
import enum
import logging
from collections.abc import Callable

from zscout.keyexpr import Token
from zscout.mesh import Declaration, Mesh, Supervisor
from zscout.types import HostName

log = logging.getLogger(__name__)


class InstanceState(enum.Enum):
    SERVES = "serves"
    OFFERED = "offered"
    """It answers queries for its state, so that an RCM can name it."""
    STANDS_BY = "stands by"


class Instances:
    """Instances of `rc`. `patience`: seconds after which no program can use a vanished instance's device."""

    def __init__(
        self,
        mesh: Mesh,
        rc: str,
        instance: str,
        supervisor: Supervisor,
        on_change: Callable[[], object],
        *,
        patience: float,
    ) -> None:
        self._mesh, self._rc, self.instance, self._patience = mesh, rc, instance, patience
        self._supervisor, self._on_change = supervisor, on_change
        self.state = InstanceState.SERVES
        self._serves = instance
        """The instance that serves, as far as known here."""
        self._host: HostName | None = None
        """The host of the serving instance, if known."""
        self._others: dict[str, Token] = {}
        """Tokens of the other instances."""
        self._waiting: asyncio.TimerHandle | None = None

    @property
    def duplicate_of(self) -> str:
        """The serving instance as text, such as `robot/arm1 at bellows`; "" if `instance` serves."""
        if self.state is InstanceState.SERVES:
            return ""
        return f"{self._rc} at {self._host}" if self._host is not None else f"{self._rc} elsewhere"

    def watch(self) -> Declaration:
        return self._mesh.watch(self._mesh.keys.alive_rc(self._rc), self._supervisor.guard(self._on_token))

    def begin(self) -> None:
        """Begin on standby if another host offers the RC. An instance on the same host is a predecessor."""
        elsewhere = [token for token in self._others.values() if token.host != self._mesh.me.host]
        if elsewhere and self.state is InstanceState.SERVES:
            self.take(min(elsewhere).instance)

    def take(self, named: str, host: HostName | None = None) -> None:
        if named == self.instance:
            self._become(InstanceState.SERVES)
        elif (self._others[named].host if named in self._others else host) != self._mesh.me.host:
            other = self._others.get(named)
            self._serves = named
            self._is_at(other.host if other is not None else host)
            if named not in self._others:
                self._wait()
            self._become(InstanceState.STANDS_BY)

    def _is_at(self, host: HostName | None) -> None:
        before, self._host = self._host, host
        if self.state is InstanceState.STANDS_BY and before != host:
            log.warning("%s is on standby: duplicate of %s", self._rc, self.duplicate_of)
            self._on_change()

    def _on_token(self, token: Token, alive: bool) -> None:
        if token.instance == self.instance:
            return
        if alive:
            self._others[token.instance] = token
            if token.instance == self._serves:
                self._is_at(token.host)
                self._cancel()
        else:
            self._others.pop(token.instance, None)
            if token.instance == self._serves:
                self._wait()

    def _wait(self) -> None:
        self._cancel()
        self._waiting = self._supervisor.call_later(self._patience, self._offer)

    def _cancel(self) -> None:
        if self._waiting is not None:
            self._waiting.cancel()

    def _offer(self) -> None:
        if self.state is InstanceState.STANDS_BY:
            self._become(InstanceState.OFFERED)

    def _become(self, state: InstanceState) -> None:
        if state is self.state:
            return
        self.state = state
        if state is InstanceState.STANDS_BY:
            log.warning("%s is on standby: duplicate of %s", self._rc, self.duplicate_of)
        else:
            log.info("%s %s", self._rc, state.value)
        self._on_change()

"""What a subcommand sees of its fleet: who is alive, how loaded the hosts are, what the RCM knows."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

from zscout.cli import common
from zscout.keyexpr import Role, Sender, Token
from zscout.mesh import clock
from zscout.messages import ListPlacements, LoadReport, Placements, RcmState, absurd
from zscout.types import (
    NO_TERM,
    SECOND,
    Ns,
    Term,
)

if TYPE_CHECKING:
    from zscout.behaviors.client.client import Client
    from zscout.mesh import Declaration

ASK_PLACER: Final = 1.0
FIND_LOADS: Final = 1.2
"""Seconds to wait for load reports: they come once a second."""
STALE: Final = 3 * SECOND
"""Age in ns past which a load report says little."""
GONE: Final = 60 * SECOND
"""How long, in ns, a host that went away is remembered."""


@dataclass(slots=True)
class Host:
    """A host as the mesh shows it. `load` is None until a report came, `reported` when the last one did."""

    tokens: set[Token] = field(default_factory=set)
    load: LoadReport | None = None
    reported: Ns = 0
    gone: Ns | None = None
    """When its last token went."""

    def has(self, role: str) -> bool:
        return any(token.role == role for token in self.tokens)

    @property
    def components(self) -> list[str]:
        """Names of those that run there."""
        return sorted({token.name for token in self.tokens if token.role == Role.COMPONENT})


class FleetView:
    """What a client sees of its fleet from now on: who is alive, loads, and the RCM's state when asked."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.hosts: dict[str, Host] = {}
        self.cordoned: frozenset[str] = frozenset()
        """Hosts on which nothing is placed, as of the last `ask_cordons` or what was published since."""
        self.changed = asyncio.Event()
        self._settled = False
        self._placer: Term = NO_TERM
        keys, mesh = client.mesh.keys, client.mesh
        self._declared: list[Declaration] = [
            mesh.watch(keys.alive_any(), self._on_token),
            mesh.subscribe(keys.load_any, LoadReport, self._on_load),
            mesh.subscribe(keys.placements, Placements, self._on_placements),
        ]

    def close(self) -> None:
        for declared in self._declared:
            declared.close()

    def _on_token(self, token: Token, alive: bool) -> None:
        if Sender(token.host, token.name) == self.client.mesh.me:
            return
        host = self.hosts.setdefault(token.host, Host())
        (host.tokens.add if alive else host.tokens.discard)(token)
        host.gone = None if host.tokens else clock.now()
        self.changed.set()

    def _on_load(self, key: str, load: LoadReport) -> None:
        host = self.hosts.get(self.client.mesh.keys.host_of(key))
        if host is not None:
            host.load, host.reported = load, clock.now()
            self.changed.set()

    def _on_placements(self, _key: str, placements: Placements) -> None:
        if placements.term >= self._placer and not absurd(placements.term, self._placer):
            self._placer, self.cordoned = placements.term, frozenset(placements.cordoned)

    async def ask_cordons(self) -> None:
        """Asks the placer; without an answer all stays as it was."""
        # No component has this name: the answer is short.
        asked = ListPlacements(component="*")
        reply = await self.client.mesh.ask_one(
            self.client.mesh.keys.placer, asked, Placements, timeout=ASK_PLACER
        )
        if reply is not None and reply.message is not None:
            self._on_placements("", reply.message)

    def forget_gone(self) -> None:
        now = clock.now()
        self.hosts = {
            name: host for name, host in self.hosts.items() if host.gone is None or now - host.gone < GONE
        }

    def all_hosts(self) -> dict[str, Host]:
        """All hosts, with the fleet's candidates that are not there: they should be."""
        missing = {name: Host() for name in self.client.fleet.candidates if name not in self.hosts}
        return dict(sorted((missing | self.hosts).items()))

    def tokens(self, role: str) -> list[Token]:
        return sorted(token for host in self.hosts.values() for token in host.tokens if token.role == role)

    def stale(self, host: Host) -> bool:
        """Whether a host that should report its load has not done so lately."""
        if not host.has(Role.LOAD) or (host.load is None and not self._settled):
            return False
        return host.load is None or clock.now() - host.reported > STALE

    async def until(self, true: Callable[[], bool], seconds: float) -> bool:
        """Waits until `true()`, at most so long; returns which."""
        with suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                while not true():
                    self.changed.clear()
                    await self.changed.wait()
        return true()

    async def settled(self, *, loads: bool = True) -> RcmState:
        """The RCM's state, once its RCs are seen, and the hosts with their `loads`. Raises NobodyThere."""
        await common.see_rcm(self.client)
        state = await common.state_of(self.client)
        rcs = {view.rc for view in state.rcs if view.present}
        clients = {hold.client for hold in state.holds}

        def complete() -> bool:
            silent = any(host.load is None for host in self.hosts.values() if host.has(Role.LOAD))
            seen = rcs <= {token.name for token in self.tokens(Role.RC)}
            seen &= clients <= {f"{token.host}/{token.name}" for token in self.tokens(Role.CLIENT)}
            if loads:
                # Without this a candidate whose token comes last would be shown as missing.
                seen &= all(host.tokens for host in self.all_hosts().values())
            return seen and not (loads and silent)

        await self.until(complete, FIND_LOADS)
        self._settled = loads
        if loads:
            await self.ask_cordons()
        return (await self.client.state(forecast=True) if loads else None) or state

"""The wider `RcHandle` of drivers that come with zscout: the mesh, the RC's holds, and the hosts of other RCs."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Final, Protocol, cast

from zscout.drivers.driver import RcHandle
from zscout.drivers.holds import HoldTable
from zscout.drivers.instances import Instances
from zscout.keyexpr import Role, Sender, Token
from zscout.mesh import Declaration, Mesh
from zscout.messages import Holder
from zscout.types import SECOND, Ns

NODE: Final = "node"
"""The client name of a node."""
DEPARTED_RC_GRACE: Final[Ns] = 10 * SECOND
"""Time in which a node may still act for an RC whose token has gone: a node that ends sends its last commands then."""


class OwnRcHandle(RcHandle, Protocol):
    """The RC as seen by zscout's own drivers."""

    mesh: Mesh
    holds: HoldTable
    instances: Instances
    """Decides whether this instance of the RC serves, or is on standby for another host's."""
    directory: RcDirectory | None
    """None if the driver does not relay."""

    informed: asyncio.Event
    """Set once this RC knows whether another host's instance serves, or has found no leader. Until then the driver must
    not touch its device."""


def own(rc: RcHandle) -> OwnRcHandle:
    return cast("OwnRcHandle", rc)


class RcDirectory:
    """The hosts of all RCs by their liveliness tokens, updated after `watch`. Only an RC's node may act for it."""

    def __init__(self, mesh: Mesh, on_change: Callable[[], object] = lambda: None) -> None:
        self._mesh = mesh
        self._tokens: dict[str, set[Token]] = {}
        self._recent: dict[tuple[str, str], Ns] = {}
        """By (host, RC) of a departed token: until when that node may still act for the RC."""
        self._on_change = on_change

    def watch(self) -> Declaration:
        return self._mesh.watch(self._mesh.keys.alive_any(Role.RC), self.on_token)

    def on_token(self, token: Token, alive: bool) -> None:
        if alive:
            self._tokens.setdefault(token.name, set()).add(token)
        else:
            living = self._tokens.get(token.name, set())
            living.discard(token)
            if not living:
                self._tokens.pop(token.name, None)
            now = self._mesh.now()
            self._recent = {key: until for key, until in self._recent.items() if until > now}
            self._recent[token.host, token.name] = now + DEPARTED_RC_GRACE
        self._on_change()

    def hosts(self, rc: str) -> set[str]:
        return {token.host for token in self._tokens.get(rc, ())}

    def is_node_of_gang(self, sender: Sender, holder: Holder, but: str) -> bool:
        """Return True if `sender` is the node of an RC in this holder's gang other than `but`."""
        return sender.client == NODE and any(sender.host in self.hosts(rc) for rc in holder.rcs if rc != but)

    def is_node_of(self, sender: Sender, rc: str) -> bool:
        """Return True if `sender` is the node that offers this RC, or did within DEPARTED_RC_GRACE."""
        offered = sender.host in self.hosts(rc) or self._recent.get((sender.host, rc), 0) > self._mesh.now()
        return sender.client == NODE and offered

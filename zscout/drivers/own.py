"""What drivers that come with zscout are given beside an `RcHandle`: the mesh, its holds, and who offers other RCs."""

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
"""A node that ends sends its last command for an RC after the token of that RC has gone."""


class OwnRcHandle(RcHandle, Protocol):
    """The RC as zscout's own drivers see it."""

    mesh: Mesh
    holds: HoldTable
    instances: Instances
    """Whether this one serves, or stands by for another host's."""
    directory: RcDirectory | None
    """Only of a driver that relays."""

    informed: asyncio.Event
    """Set once this RC has read whether another host's serves, or has heard no leader for a while. Its device is left
    alone until then."""


def own(rc: RcHandle) -> OwnRcHandle:
    """The same, for a driver that comes with zscout."""
    return cast("OwnRcHandle", rc)


class RcDirectory:
    """Which host offers which RC, by the liveliness tokens, from `watch` on: its node may act for an RC, and
    no other."""

    def __init__(self, mesh: Mesh, on_change: Callable[[], object] = lambda: None) -> None:
        self._mesh = mesh
        self._tokens: dict[str, set[Token]] = {}
        self._recent: dict[tuple[str, str], Ns] = {}
        """(host, RC): until when its node may still act for it."""
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
        """The hosts that offer this RC now: one, unless two nodes are at odds."""
        return {token.host for token in self._tokens.get(rc, ())}

    def is_node_of_gang(self, sender: Sender, holder: Holder, but: str) -> bool:
        """Whether `sender` is the node of an RC of this holder's gang, `but` aside."""
        return sender.client == NODE and any(sender.host in self.hosts(rc) for rc in holder.rcs if rc != but)

    def is_node_of(self, sender: Sender, rc: str) -> bool:
        """Whether `sender` is the node that offers this RC, or did so until a moment ago."""
        offered = sender.host in self.hosts(rc) or self._recent.get((sender.host, rc), 0) > self._mesh.now()
        return sender.client == NODE and offered

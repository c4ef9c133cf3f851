"""Which host offers which RC, by the liveliness tokens: its node may speak for an RC, and nobody else."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from zscout.keyexpr import Role, Sender, Token
from zscout.mesh import Declaration, Mesh
from zscout.messages import Holder
from zscout.types import SECOND, Ns

NODE: Final = "node"
"""The client name of a node."""
LATELY: Final[Ns] = 10 * SECOND
"""A node that ends sends its last command for an RC after the token of that RC has gone."""


class RcDirectory:
    """The RCs of a fleet and their hosts, from `watch` on."""

    def __init__(self, mesh: Mesh, on_change: Callable[[], None] | None = None) -> None:
        self._mesh = mesh
        self._tokens: dict[str, set[Token]] = {}
        self._recent: dict[tuple[str, str], Ns] = {}
        """(host, RC): until when its node may still speak for it."""
        self._on_change = on_change

    def watch(self) -> Declaration:
        return self._mesh.watch(self._mesh.keys.alive_any(Role.RC), self.on_token)

    def on_token(self, token: Token, alive: bool) -> None:
        """A token has come or gone."""
        if alive:
            self._tokens.setdefault(token.name, set()).add(token)
        else:
            living = self._tokens.get(token.name, set())
            living.discard(token)
            if not living:
                self._tokens.pop(token.name, None)
            now = self._mesh.now()
            self._recent = {key: until for key, until in self._recent.items() if until > now}
            self._recent[token.host, token.name] = now + LATELY
        if self._on_change is not None:
            self._on_change()

    def hosts(self, rc: str) -> set[str]:
        """The hosts that offer this RC now: one, unless two nodes are at odds."""
        return {token.host for token in self._tokens.get(rc, ())}

    def is_node_of_gang(self, sender: Sender, holder: Holder, but: str) -> bool:
        """Whether `sender` is the node of an RC of this holder's gang, `but` aside."""
        return sender.client == NODE and any(sender.host in self.hosts(rc) for rc in holder.rcs if rc != but)

    def is_node_of(self, sender: Sender, rc: str) -> bool:
        """Whether `sender` is the node that offers this RC, or did so until a moment ago."""
        if sender.client != NODE:
            return False
        return sender.host in self.hosts(rc) or self._recent.get((sender.host, rc), 0) > self._mesh.now()

"""What a driver does for its device, and what its RC gives it. `resource_controller.py` has that RC.

All that the author of a driver needs can be imported from here; docs/how-to/write-a-driver.md tells how."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Final, Protocol, Self

from msgspec import Struct

from zscout.config.strict import quoted
from zscout.drivers.holds import HoldTable
from zscout.drivers.instances import Instances
from zscout.keyexpr import Role, Sender, Token
from zscout.mesh import Declaration, Mesh, Refused, Supervisor
from zscout.messages import Amounts, Figures, Holder, Parameter, ProposedHolder
from zscout.types import SECOND, Grant, Ns

__all__ = ["Driver", "Figures", "Holder", "Parameter", "ProposedHolder", "RcDirectory", "RcHandle", "Refused"]

NODE: Final = "node"
"""The client name of a node."""
DEPARTED_RC_GRACE: Final[Ns] = 10 * SECOND
"""A node that ends sends its last command for an RC after the token of that RC has gone."""


class RcHandle(Protocol):
    """The RC as its driver sees it."""

    mesh: Mesh
    name: str
    holds: HoldTable
    instances: Instances
    """Whether this one serves, or stands by for another host's."""
    directory: RcDirectory | None
    """Only of a driver that relays."""
    supervisor: Supervisor
    """Of tasks, timers and handlers of the driver: closed before `safe` and `close` at the end. What fails
    there fails the RC."""
    health: str
    """`ok`, or in words why the device can't carry a holder."""

    def fail(self, why: str) -> None:
        """The device can't carry its holders any longer: their holds end, the RC counts as lost."""

    def recover(self) -> None:
        """The device works again."""

    def rules_changed(self) -> None:
        """The driver votes by other rules from now on: earlier votes are void."""

    def used(self, grant: Grant) -> None:
        """The device has just done something under a hold, beside its commands, which are counted without this: it
        published a picture, say. From any one thread."""


class NoOptions(Struct, frozen=True):
    """Of a driver that is told nothing."""


class Driver:
    """What a device does. The defaults are those of an exclusive device without commands of its own.

    Everything runs in the node's event loop, one call at a time; nothing may block."""

    Options: ClassVar[type] = NoOptions
    """What its table in the node file holds besides what every RC has: a msgspec struct or a dataclass. A key that is
    not in it, a wrong type and a missing value end the node before it begins, in one line."""
    sharable = False
    """Whether it takes several holders, by its vote."""
    relays = False
    """Whether, besides a holder's client, the nodes of other RCs of its gang may command under the grant: a
    robot's does so at its radio."""
    activation: float = 0.0
    """Seconds after a grant until the device has its full use, like a camera that warms up."""

    def __init__(self, options: Any = None) -> None:
        """`options`, of the type `Options`. Raise ValueError, with one line that says what to mend, for bad ones; the
        device itself is opened in `open`."""
        self.options = options

    @classmethod
    def configured(cls, options: Any) -> Self:
        """The driver of a device that has these `Options`."""
        return cls(options)

    async def open(self, rc: RcHandle) -> None:
        """The RC is about to be offered. A device that is not there is no error: call `rc.fail`, go on
        trying, and `rc.recover`."""

    async def close(self) -> None:
        """The RC has left the mesh, and `safe` has been called."""

    async def begin(self, holder: Holder) -> None:
        """Somebody begins to hold the device. What takes longer than an instant is spawned: see `begins_for`."""

    def begins_for(self) -> float:
        """Seconds, at most, that what `begin` has spawned still takes. Until 0 its holder does not enter, and what it
        commands, other than `stop` and `halt`, is refused as `settling`."""
        return 0.0

    async def carry_on(self, before: Holder, after: Holder) -> None:
        """What `before` held goes on in `after`, with no safe state between: in another client, or in another ARC of
        the same one. Unless a driver has it otherwise, `after` begins; a sharable one that keeps something for each
        holder lets go of what it has for `before`, unless both have one place."""
        await self.begin(after)

    async def end(self, holder: Holder) -> None:
        """Somebody ceases to hold the device; `safe` follows if nobody else does. Not called for a hold that goes
        on in another."""

    async def safe(self) -> None:
        """Nobody holds the device any more: motors stopped, transmitter off. Must not raise."""

    async def command(self, holder: Holder, do: Mapping[str, Any]) -> Any:
        """Carries out `do` and returns what is answered. Raises Refused for what can't be done.

        Returns a Future where the answer takes its time: what comes next does not wait for it."""
        raise Refused("unknown_command", f"unknown command {quoted(str(do.get('name'))[:64])}")

    async def command_without_grant(self, sender: Sender, do: Mapping[str, Any]) -> Any:
        """Carries out what needs no hold. Raises Refused, by default always."""
        raise Refused("no_grant", "this device obeys only under a grant; request it")

    def vote(self, holders: list[ProposedHolder]) -> str:
        """Why a sharable device can't carry these holders; empty if it can, and any subset of them."""
        return ""

    def parameters(self) -> list[Parameter] | None:
        """The bandwidth parameters that it knows: who asks for another one, or for more than the bound of one, is
        refused at once. None: it does not say, and votes on whatever comes."""
        return None

    def capacity(self) -> Amounts:
        """Bounds to show to people, by bandwidth parameter."""
        return {}

    def figures(self) -> Figures:
        """Rates, drops, latency and the like, by name; published when they change, once a second at most."""
        return {}

    def usable_cold(self, do: Mapping[str, Any]) -> bool:
        """Whether this command can be carried out while the device still warms up."""
        return False


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

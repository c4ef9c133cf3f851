"""What a driver has to say for its device; `base.py` has the RC around it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from zscout.keyexpr import Sender
from zscout.mesh import Refused
from zscout.messages import Amounts, Figures, Holder, ProposedHolder

if TYPE_CHECKING:
    from zscout.drivers.base import ResourceController


class Driver:
    """What a device does. The defaults are those of an exclusive device without commands of its own.

    Everything runs in the node's event loop, one call at a time; nothing may block.
    """

    sharable = False
    relays = False
    """Whether, besides a holder's client, the nodes of other RCs of its gang may command under the grant: a
    robot speaks through its radio."""
    activation: float = 0.0
    """Seconds after a grant until the device has its full use, like a camera that warms up."""

    async def open(self, rc: ResourceController) -> None:
        """The RC is about to be offered: the time to take what is needed of `rc.mesh`. A device that is not
        there is no error: call `rc.fail`, go on trying, and `rc.recover`."""

    async def close(self) -> None:
        """The RC has left the mesh, and `safe` has been called."""

    async def begin(self, holder: Holder) -> None:
        """Somebody begins to hold the device."""

    async def end(self, holder: Holder) -> None:
        """Somebody ceases to hold the device; `safe` follows if nobody else does. Not told of a hold that was
        handed over: it goes on."""

    async def safe(self) -> None:
        """Nobody holds the device any more: motors stopped, transmitter off. Must not raise."""

    async def command(self, holder: Holder, do: Mapping[str, Any]) -> Any:
        """Carries out `do` and returns what is answered. Raises Refused for what can't be done.

        Returns a Future where the answer takes its time: what comes next does not wait for it."""
        raise Refused("unknown_command", f"this device does not know {str(do.get('name'))[:64]!r}")

    async def command_without_grant(self, sender: Sender, do: Mapping[str, Any]) -> Any:
        """Carries out what needs no hold. Raises Refused, as for anything of the sort by default."""
        raise Refused("no_grant", "this RC does nothing without a grant; ask the RCM for it")

    def vote(self, holders: list[ProposedHolder]) -> str:
        """Why a sharable device can't carry these holders; empty if it can, and any subset of them."""
        return ""

    def capacity(self) -> Amounts:
        """Bounds that people may like to see, by bandwidth parameter."""
        return {}

    def figures(self) -> Figures:
        """Rates, drops, latency and the like, by name; told when they change, once a second at most."""
        return {}

    def usable_cold(self, do: Mapping[str, Any]) -> bool:
        """Whether this command can be carried out while the device still warms up."""
        return False

"""What a driver does for its device. `resource_controller.py` has the RC around it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from zscout.drivers.holds import HoldTable
from zscout.drivers.rc_directory import RcDirectory
from zscout.keyexpr import Sender
from zscout.mesh import Mesh, Refused, Supervisor
from zscout.messages import Amounts, Figures, Holder, ProposedHolder


class RcHandle(Protocol):
    """The RC as its driver sees it."""

    @property
    def mesh(self) -> Mesh: ...
    @property
    def name(self) -> str: ...
    @property
    def holds(self) -> HoldTable: ...
    @property
    def directory(self) -> RcDirectory | None:
        """Which host offers which RC; only of a driver that relays."""

    @property
    def supervisor(self) -> Supervisor:
        """Of tasks, timers and handlers of the driver: at the end it is closed before `safe` and `close` are
        called. What fails there fails the RC."""

    @property
    def health(self) -> str:
        """`ok`, or in words why the device can't carry a holder."""

    def fail(self, why: str) -> None:
        """The device can't carry its holders any longer: their holds end, the RC counts as lost."""

    def recover(self) -> None:
        """The device works again."""

    def rules_changed(self) -> None:
        """The driver votes by other rules from now on: earlier votes are void."""


class Driver:
    """What a device does. The defaults are those of an exclusive device without commands of its own.

    Everything runs in the node's event loop, one call at a time; nothing may block.
    """

    sharable = False
    relays = False
    """Whether, besides a holder's client, the nodes of other RCs of its gang may command under the grant: a
    robot's does so at its radio."""
    activation: float = 0.0
    """Seconds after a grant until the device has its full use, like a camera that warms up."""

    async def open(self, rc: RcHandle) -> None:
        """The RC is about to be offered. A device that is not there is no error: call `rc.fail`, go on
        trying, and `rc.recover`."""

    async def close(self) -> None:
        """The RC has left the mesh, and `safe` has been called."""

    async def begin(self, holder: Holder) -> None:
        """Somebody begins to hold the device."""

    async def end(self, holder: Holder) -> None:
        """Somebody ceases to hold the device; `safe` follows if nobody else does. Not called for a hold
        that was handed over."""

    async def safe(self) -> None:
        """Nobody holds the device any more: motors stopped, transmitter off. Must not raise."""

    async def command(self, holder: Holder, do: Mapping[str, Any]) -> Any:
        """Carries out `do` and returns what is answered. Raises Refused for what can't be done.

        Returns a Future where the answer takes its time: what comes next does not wait for it."""
        raise Refused("unknown_command", f"this device does not know {str(do.get('name'))[:64]!r}")

    async def command_without_grant(self, sender: Sender, do: Mapping[str, Any]) -> Any:
        """Carries out what needs no hold. Raises Refused, by default always."""
        raise Refused("no_grant", "this RC does nothing without a grant; ask the RCM for it")

    def vote(self, holders: list[ProposedHolder]) -> str:
        """Why a sharable device can't carry these holders; empty if it can, and any subset of them."""
        return ""

    def capacity(self) -> Amounts:
        """Bounds to show to people, by bandwidth parameter."""
        return {}

    def figures(self) -> Figures:
        """Rates, drops, latency and the like, by name; published when they change, once a second at most."""
        return {}

    def usable_cold(self, do: Mapping[str, Any]) -> bool:
        """Whether this command can be carried out while the device still warms up."""
        return False

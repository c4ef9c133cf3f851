"""What a driver does for its device, and what its RC gives it. `resource_controller.py` has that RC.

All that the author of a driver needs can be imported from here; docs/how-to/write-a-driver.md tells how."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self

from msgspec import Struct

from zscout.keyexpr import Sender
from zscout.mesh import Refused, Supervisor
from zscout.messages import Amounts, Figures, FrameHead, Holder, Parameter, ProposedHolder
from zscout.types import Grant, Ns

if TYPE_CHECKING:
    from zscout.mesh.frames import FramePublisher

__all__ = ["Driver", "Figures", "FrameHead", "Holder", "Parameter", "ProposedHolder", "RcHandle", "Refused", "Sender"]


class RcHandle(Protocol):
    """The RC around a driver, as the driver sees it: `Driver.open` is given it."""

    name: str
    """Of the device: `kind/name`."""
    health: str
    """`ok`, or in words why the device can't carry a holder."""
    supervisor: Supervisor
    """Runs the driver's tasks, by `spawn`, and its timers, by `call_later`. They end before `safe` and `close` are
    called at the end. One that raises fails the RC."""

    def now(self) -> Ns:
        """The time in ns, by the clock of this host that counts from its start and goes on while it sleeps."""

    def holders(self) -> list[Holder]:
        """Who holds the device now."""

    def fail(self, why: str) -> None:
        """The device can't carry its holders any longer: their holds end, and the RC counts as lost. `why`: one line."""

    def recover(self) -> None:
        """The device works again."""

    def rules_changed(self) -> None:
        """The driver votes by other rules from now on: earlier votes are void."""

    def used(self, grant: Grant) -> None:
        """The device has just done something under a hold, beside its commands, which are counted without this: it
        published a picture, say. From any one thread."""

    def frame_publisher(self) -> FramePublisher:
        """Publishes pictures of the device, under its own name: `put(FrameHead(...), jpeg)`. `close` it in the driver's
        `close`."""


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
        raise Refused("unknown_command", f"this device does not know {str(do.get('name'))[:64]!r}")

    async def command_without_grant(self, sender: Sender, do: Mapping[str, Any]) -> Any:
        """Carries out what needs no hold. Raises Refused, by default always."""
        raise Refused("no_grant", "this RC does nothing without a grant; ask the RCM for it")

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

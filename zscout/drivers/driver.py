"""The interface between a driver and its device's resource controller (`resource_controller.py`).

Authors of drivers import everything from here: see docs/how-to/write-a-driver.md."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, Self

from msgspec import Struct

from zscout.config.strict import quoted
from zscout.keyexpr import Sender
from zscout.mesh import Refused, Supervisor
from zscout.messages import Amounts, Figures, FrameHead, Holder, Parameter, ProposedHolder
from zscout.types import Grant, Ns

if TYPE_CHECKING:
    from zscout.mesh.frames import FramePublisher

__all__ = ["Driver", "Figures", "FrameHead", "Holder", "Parameter", "ProposedHolder", "RcHandle", "Refused", "Sender"]


class RcHandle(Protocol):
    """A driver's view of its device on the mesh: the argument of `Driver.open`."""

    name: str
    """The device's name: `kind/name`."""
    health: str
    """`ok`, or why the device can't serve a holder, in one line."""
    supervisor: Supervisor
    """Runs the driver's tasks (`spawn`) and timers (`call_later`). They are stopped before the last `safe` and `close`.
    If one raises, the device is lost."""

    def now(self) -> Ns:
        """The time in ns by this host's clock, which counts from its start and continues while it is suspended."""

    def holders(self) -> list[Holder]:
        """The current holders of the device."""

    def fail(self, why: str) -> None:
        """Report that the device can't serve its holders: their holds end, and the device is lost. `why`: one line
        for people."""

    def unwell(self, why: str) -> None:
        """Report that the device does not work at present, as when a test reboots it. Its holders keep it, and it is
        granted to operators only. If it does not `recover` within the time that its table tolerates, it is lost."""

    def recover(self) -> None:
        """Report that the device works again."""

    def rules_changed(self) -> None:
        """Make earlier votes void, because the driver votes by other rules from now on."""

    def used(self, grant: Grant) -> None:
        """Count a use of the device under a hold, such as a published picture. Commands are counted without this
        call. Can be called from any one thread."""

    def frame_publisher(self) -> FramePublisher:
        """Return a publisher of the device's pictures: `put(FrameHead(...), jpeg)`. Close it in the driver's
        `close`."""


class NoOptions(Struct, frozen=True):
    """The options of a driver without options."""


class Driver:
    """Base class of drivers: one instance for each device. Its defaults are those of an exclusive device without
    commands. All methods run in the node's event loop, one call at a time, and must not block."""

    Options: ClassVar[type] = NoOptions
    """A msgspec struct or a dataclass: the keys of its table in the node file, besides those of every device. For an
    unknown key, a wrong type or a missing value the node exits with one line."""
    sharable = False
    """True if several holders can share the device, subject to `vote`."""
    relays = False
    """True if nodes with other devices of the same hold may command the device under its grant. A radio is commanded by
    the node of a robot, for example."""
    activation: float = 0.0
    """Seconds after a grant until the device is fully usable, such as the warm-up time of a camera. The holder's
    runtime passes meanwhile."""
    begin_within: float = 0.0
    """The longest time in seconds that `begins_for` returns for a hold that begins."""

    tolerate: float = 0.0
    """Seconds for which a holder keeps the device while it is `unwell`. 0: it is lost at once."""
    tolerate_max: float = 0.0
    """The longest outage in seconds that a holder can announce."""

    def __init__(self, options: Any = None) -> None:
        """Keep `options`, an instance of `Options`. Raise ValueError with one line if they are bad. Open the device
        in `open`, not here."""
        self.options = options

    @classmethod
    def configured(cls, options: Any) -> Self:
        """Return the driver of a device with these `Options`."""
        return cls(options)

    async def open(self, rc: RcHandle) -> None:
        """Called before the device is offered. If the device is not there, do not raise: call `rc.fail`, keep
        trying, and call `rc.recover`."""

    async def close(self) -> None:
        """Called when the device has left the mesh, after `safe`."""

    async def begin(self, holder: Holder) -> None:
        """A hold begins. Spawn what takes time, and return its duration from `begins_for`."""

    def begins_for(self) -> float:
        """Seconds, at most, until the device is ready for the hold that began. Until 0 the holder waits, its runtime
        does not pass, and commands other than `stop` and `halt` are refused as `settling`."""
        return 0.0

    async def carry_on(self, before: Holder, after: Holder) -> None:
        """The hold `before` continues as `after`, without a safe state in between: in another client, or in another
        request of the same client. Calls `begin(after)` by default. A sharable driver that keeps state for each holder
        drops the state of `before`, unless both have the same `place`."""
        await self.begin(after)

    async def end(self, holder: Holder) -> None:
        """A hold ends. `safe` follows if it was the last one. Not called for a hold that continues as another."""

    async def safe(self) -> None:
        """The last hold has ended: stop motors, switch transmitters off. Must not raise."""

    async def command(self, holder: Holder, do: Mapping[str, Any]) -> Any:
        """Carry out the command `do` and return its result. Raise Refused if it can't be done. Return a Future if the
        result takes time: other calls do not wait for it."""
        raise Refused("unknown_command", f"unknown command {quoted(str(do.get('name'))[:64])}")

    async def command_without_grant(self, sender: Sender, do: Mapping[str, Any]) -> Any:
        """Carry out a command that needs no hold. Raises Refused by default."""
        raise Refused("no_grant", "this device takes commands only under a grant; request the device first")

    def vote(self, holders: list[ProposedHolder]) -> str:
        """Return why a sharable device can't serve these holders together, or an empty string if it can serve them
        and any subset of them. A ValueError refuses them as well."""
        return ""

    def parameters(self) -> list[Parameter] | None:
        """The parameters of the device. Requests with other parameters, or beyond a bound, are refused at once.
        None: any parameter, subject to `vote`."""
        return None

    def capacity(self) -> Amounts:
        """Upper bounds for people to see, by parameter."""
        return {}

    def figures(self) -> Figures:
        """Rates, drops, latencies and the like, by name; published on change, at most once a second."""
        return {}

    def usable_cold(self, do: Mapping[str, Any]) -> bool:
        """Return True if the command `do` works while the device still warms up."""
        return False

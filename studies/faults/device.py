"""A simulated device, which no fault touches: it knows its drivers, holders and commands.

The promises about a device are checked here, at the device, and not by the beliefs of services."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Any, Final

from zscout.drivers.generic import CapacityDriver, ExclusiveDriver
from zscout.messages import Holder, exact_amounts
from zscout.testing.virtual_time import PROCESS, Process
from zscout.types import NO_TERM, Grant

NO_GRANT: Final = Grant(NO_TERM, 0)


@dataclass(slots=True)
class Device:
    """A device. It calls `broken(text)` for each broken promise."""

    name: str
    capacity: Mapping[str, Fraction] | None
    """None if it is exclusive."""
    broken: Callable[[str], None]
    log: Callable[[str], None]
    holders: dict[Grant, tuple[Process, Holder]] = field(default_factory=dict)
    """Its holders, each with the process of the driver that admitted it."""
    programs: dict[Grant, str] = field(default_factory=dict)
    """Clients of the programs that use it past its driver, by grant."""
    now: Callable[[], float] = lambda: 0.0
    """Virtual time, which no process can read."""
    starts: float = 0.0
    """Seconds from the beginning of a hold until it is ready."""
    ready: dict[Grant, float] = field(default_factory=dict)
    """By grant: when it became usable for its holder, in virtual time."""
    done: set[str] = field(default_factory=set)
    """The commands of programs that it has carried out."""
    newest: tuple[Process, Grant] | None = None
    """The newest grant of its commands, and the process of the driver. A restarted driver knows no grants, and obeys
    the RCM that it finds."""

    def begin(self, process: Process, holder: Holder) -> None:
        self.log(f"{self.name} begins for {holder.client} {holder.arc} {number(holder.grant)}")
        self._forget_dead()
        # The same ARC in another client was handed over.
        arc = holder.id, holder.place
        self.holders = {grant: held for grant, held in self.holders.items() if (held[1].id, held[1].place) != arc}
        if self.capacity is None and self.holders:
            other = next(current for _, current in self.holders.values())
            self.broken(f"two holders of {self.name}: {other.client} and {holder.client}")
        self._is_alone(holder.grant, holder.client)
        self.holders[holder.grant] = process, holder
        if self.capacity is not None:
            for parameter, most in self.capacity.items():
                total = sum(exact_amounts(held.params).get(parameter, Fraction()) for _, held in self.holders.values())
                if total > most:
                    self.broken(f"{self.name} carries {float(total):g} of {parameter}, and can carry {float(most):g}")

    def end(self, holder: Holder) -> None:
        self.log(f"{self.name} ends for {holder.client} {holder.arc} {number(holder.grant)}")
        self.holders.pop(holder.grant, None)

    def safe(self, process: Process) -> None:
        """All holders that this driver admitted are gone."""
        self.log(f"{self.name} is safe")
        self.holders = {grant: held for grant, held in self.holders.items() if held[0] is not process}

    def command(self, process: Process, holder: Holder, value: object) -> None:
        """Commands of programs have unique strings as values; components may repeat values."""
        if isinstance(value, str):
            if value in self.done:
                self.broken(f"{self.name} carries out a command of {holder.client} twice")
            self.done.add(value)
        self._forget_dead()
        newest = self.newest[1] if self.newest is not None else NO_GRANT
        if self.capacity is None and holder.grant < newest:
            self.broken(f"{self.name} obeyed {number(holder.grant)} after {number(newest)}")
        if holder.grant not in self.holders:
            self.broken(f"{self.name} obeyed {holder.client}, which does not hold it")
        if holder.grant >= newest:
            self.newest = process, holder.grant

    def touch(self, grant: Grant, client: str) -> None:
        """A program begins to use the device past its driver."""
        self.log(f"{self.name} is touched by a program of {client} {number(grant)}")
        self._is_alone(grant, client)
        self.programs[grant] = client

    def leave(self, grant: Grant) -> None:
        """A program that used the device past its driver is gone."""
        if self.programs.pop(grant, None) is not None:
            self.log(f"{self.name} is left by a program {number(grant)}")

    def _is_alone(self, grant: Grant, client: str) -> None:
        if self.capacity is None:
            for other, of in self.programs.items():
                if other != grant:
                    self.broken(f"two programs at {self.name}: one of {of} {number(other)}, and one of {client}")

    def _forget_dead(self) -> None:
        # Holders that a killed driver admitted no longer drive: their commands went through it.
        self.holders = {grant: held for grant, held in self.holders.items() if not held[0].dead}
        if self.newest is not None and self.newest[0].dead:
            self.newest = None


def number(grant: Grant) -> str:
    return f"{grant.term.counter}.{grant.seq}"


class _Watched:
    """The part of a driver that reports to its device."""

    device: Device

    async def begin(self, holder: Holder) -> None:
        self.device.begin(_here(), holder)

    async def end(self, holder: Holder) -> None:
        self.device.end(holder)

    async def safe(self) -> None:
        self.device.safe(_here())

    async def command(self, holder: Holder, do: Mapping[str, Any]) -> Any:
        self.device.command(_here(), holder, do["value"])
        return await super().command(holder, do)  # type: ignore[misc]


class WatchedExclusive(_Watched, ExclusiveDriver):
    def __init__(self, device: Device) -> None:
        super().__init__()
        self.device = device
        self.begin_within = 1.5 * device.starts
        self._ready_at = 0.0

    async def begin(self, holder: Holder) -> None:
        self._ready_at = asyncio.get_running_loop().time() + self.device.starts
        self.device.ready[holder.grant] = self.device.now() + self.device.starts
        await super().begin(holder)

    def begins_for(self) -> float:
        return max(0.0, self._ready_at - asyncio.get_running_loop().time())

    async def carry_on(self, before: Holder, after: Holder) -> None:
        if (ready := self.device.ready.get(before.grant)) is not None:
            self.device.ready[after.grant] = ready
        await super().begin(after)

    async def safe(self) -> None:
        self._ready_at = 0.0
        await super().safe()


class WatchedCapacity(_Watched, CapacityDriver):
    def __init__(self, device: Device) -> None:
        super().__init__(device.capacity or {})
        self.device = device


def _here() -> Process:
    process = PROCESS.get()
    assert process is not None
    return process

"""A radio: one serial line shared by several ARCs, each with the packet rate that it requested.

Robots acknowledge nothing, so an answer means that a packet is in the queue, and gives the time until it is sent.
Packets are written only as fast as the line carries them (`transmit_queue`): at most two wait in system buffers, and a
halt is sent at once."""

from __future__ import annotations

import asyncio
from collections import Counter, deque
from collections.abc import Mapping
from decimal import Decimal
from fractions import Fraction
from typing import Any, Final, Self

from zscout.config.devices import RadioRc
from zscout.drivers.airtime import Share, default_rate, line_rate, objection, room, share_of
from zscout.drivers.commands import RadioHalt, RadioStop, radio_command
from zscout.drivers.driver import Driver, RcHandle
from zscout.drivers.own import own
from zscout.drivers.packets import MAX_PACKET, HaltPacket, StopPacket, encode
from zscout.drivers.serial_line import CLOSE_TIMEOUT, DEPTH, SerialLine
from zscout.drivers.serial_port import TIMEOUT, SerialPort
from zscout.drivers.transmit_queue import TransmitQueue
from zscout.keyexpr import RANDOM, Sender
from zscout.mesh import Refused, Supervisor
from zscout.mesh.supervision import done_within
from zscout.messages import Amounts, Figures, Holder, Parameter, ProposedHolder
from zscout.types import SECOND, Grant, Place

RECENT: Final = 64
"""Packets over which the longest wait is measured."""
OPENING: Final = 1.0
"""Seconds that a node waits for the line before it offers the RC as lost."""
LONGEST_SLEEP: Final = 60.0


class RadioDriver(Driver):
    """The RC of a radio. It sends stops and halts for the node of any robot, other packets for its holders only."""

    Options = RadioRc
    sharable = True
    relays = True

    def __init__(self, port: str, *, baud: int, bound: float, dtr: bool | None = None, rts: bool | None = None) -> None:
        """`port`, `dtr`, `rts` as in `SerialPort`; `bound` in seconds: the delay bound of a packet."""
        self._port = SerialPort(port, baud, dtr=dtr, rts=rts)
        self._rate = line_rate(baud)
        self._default = default_rate(self._rate)
        self._bound = Fraction(str(bound))
        # A random first number, because an earlier radio of these robots may have ended at any number.
        stale = round(max(TIMEOUT, bound) * SECOND)
        self._air = TransmitQueue(self._rate, first_number=RANDOM.get().randrange(256), stale=stale)
        self._robots: dict[int, str] = {}
        """The robot RC by robot id: the first RC that commanded the id, while it is offered."""
        self._down = "its line is not open yet"
        """Why no packet can be sent; empty while the line is open."""
        self._known = asyncio.Event()
        """Set once the line was opened or found missing."""
        self._quiet = asyncio.Event()
        self._outstanding = 0
        self._timer: asyncio.TimerHandle | None = None
        self._losses = 0
        self._counts = Counter(packets=0, bytes=0, repeats=0, halts=0)
        self._waits: deque[Fraction] = deque(maxlen=RECENT)

    @classmethod
    def configured(cls, options: Any) -> Self:
        bound = options.bound / SECOND
        return cls(options.port, baud=options.baud, bound=bound, dtr=options.dtr, rts=options.rts)

    async def open(self, rc: RcHandle) -> None:
        self._rc = own(rc)
        # A separate supervisor: halts are still sent after the RC has closed its own.
        self._supervisor = Supervisor(f"the line of {rc.name}", rc.supervisor.fail)
        self._line = SerialLine(self._port, up=self._line_up, down=self._line_down, wrote=self._line_wrote)
        if not await done_within(OPENING, self._known.wait()):
            rc.fail(self._down)

    async def close(self) -> None:
        """Send the waiting halts first, if the line works."""
        if not self._down and self._air.urgent:
            self._quiet.clear()
            await done_within(CLOSE_TIMEOUT, self._quiet.wait())
        await self._supervisor.close()
        await self._line.stop()

    def vote(self, holders: list[ProposedHolder]) -> str:
        shares: list[Share] = []
        for holder in holders:
            try:
                shares.append(share_of(holder.params, self._default))
            except ValueError as error:
                return f"{holder.arc}: {error}"
        return objection(self._rate, self._bound, shares)

    def capacity(self) -> Amounts:
        """`command_rate`: packets of the full size a second, all holders together."""
        most = room(self._rate)
        return {"command_rate": _decimal(most / MAX_PACKET), "bytes_per_second": _decimal(most)}

    def parameters(self) -> list[Parameter]:
        most = room(self._rate) / MAX_PACKET
        size = Decimal(MAX_PACKET)
        return [
            # With shorter packets a higher rate fits.
            Parameter("command_rate", "packets/s", _decimal(most), _decimal(self._default), unless=["packet_size"]),
            Parameter("packet_size", "bytes", default=size),
        ]

    async def begin(self, holder: Holder) -> None:
        self._air.join(holder.place, self._share_of(holder), self._rc.now())

    async def carry_on(self, before: Holder, after: Holder) -> None:
        self._air.pass_on(before.place, after.place, self._share_of(after), self._rc.now())

    def _share_of(self, holder: Holder) -> Share:
        try:
            return share_of(holder.params, self._default)
        except ValueError:  # it was never voted for
            return Share(Fraction(0), Fraction(MAX_PACKET))

    async def end(self, holder: Holder) -> None:
        """Drop the holder's waiting packets, and halt the robots that it commanded, in case their own RCs are gone."""
        self._leave(holder.place)

    async def safe(self) -> None:
        for place in list(self._air.members):
            self._leave(place)

    def _leave(self, place: Place) -> None:
        for robot in self._air.leave(place):
            self._send_urgent(RadioHalt(robot))

    async def command(self, holder: Holder, do: Mapping[str, Any]) -> Any:
        order = radio_command(do)
        owner = self._robots.get(order.robot)
        if owner is not None and owner not in holder.rcs and self._is_offered(owner):
            raise Refused("not_yours", f"robot {order.robot} is {owner}, which is not held; request it as well")
        if self._down:
            raise Refused("down", self._down)
        if isinstance(order, RadioStop | RadioHalt):
            return self._send_urgent(order)
        after = self._air.offer(holder.place, holder.grant, order, self._rc.now())
        self._pump()
        return {"after": after / SECOND}

    async def command_without_grant(self, sender: Sender, do: Mapping[str, Any]) -> Any:
        """Send a stop or a halt from the node of a robot's RC, whatever is held."""
        if do.get("name") not in ("stop", "halt"):
            return await super().command_without_grant(sender, do)
        order = radio_command(do)
        assert isinstance(order, RadioStop | RadioHalt)  # noqa: S101 - by their names
        directory = self._rc.directory
        if order.rc is None or directory is None or not directory.is_node_of(sender, order.rc):
            raise Refused("no_grant", f"{sender} does not offer the robot {order.rc}, so it can't stop it")
        # A halt is harmless, but the robot stays with the first RC that claimed it while that RC is offered.
        owner = self._robots.get(order.robot)
        if owner is None or not self._is_offered(owner):
            self._robots[order.robot] = order.rc
        if self._down:
            raise Refused("down", self._down)
        return self._send_urgent(order)

    def _is_offered(self, rc: str) -> bool:
        return self._rc.directory is not None and bool(self._rc.directory.hosts(rc))

    def _send_urgent(self, order: RadioStop | RadioHalt) -> dict[str, float]:
        halts = isinstance(order, RadioHalt)
        self._counts["halts"] += halts
        kind = HaltPacket if halts else StopPacket
        after = self._air.send_urgent(order.robot, kind, self._rc.now())
        self._pump()
        return {"after": after / SECOND}

    def _pump(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        if self._down:
            return
        while self._outstanding < DEPTH:
            outgoing = self._air.next(self._rc.now(), self._is_in_force)
            if outgoing is None:
                break
            data = encode(outgoing.packet)
            if self._line.write(data, outgoing.until):
                self._outstanding += 1
            self._counts.update(packets=1, bytes=len(data), repeats=outgoing.repeat)
            if not outgoing.repeat:
                self._waits.append(outgoing.sent_by - outgoing.entered)
        if not self._air.urgent:
            self._quiet.set()
        at = self._air.wake(self._rc.now())
        if at is not None and self._outstanding < DEPTH:
            delay = min(max(0.0, (at - self._rc.now()) / SECOND), LONGEST_SLEEP)
            self._timer = self._supervisor.call_later(delay, self._pump)

    def _is_in_force(self, grant: Grant) -> bool:
        held, holds = self._rc.holds.held.get(grant), self._rc.holds
        return held is not None and holds.check(grant, held.holder.client, self._rc.now()) is None

    def _line_up(self) -> None:
        was, self._down, self._outstanding = self._down, "", 0
        self._known.set()
        if was:
            self._rc.recover()
        self._pump()

    def _line_down(self, why: str) -> None:
        self._losses += not self._down
        self._down = why
        self._known.set()
        self._quiet.set()
        self._rc.unwell(why)

    def _line_wrote(self) -> None:
        self._outstanding = max(0, self._outstanding - 1)
        self._pump()

    def figures(self) -> Figures:
        counts = {name: float(count) for name, count in self._counts.items()}
        waits = {name: float(getattr(self._air, name)) for name in ("replaced", "dropped", "waiting")}
        longest = round(float(max(self._waits, default=Fraction(0)) / SECOND * 1000), 1)
        return counts | waits | {"longest_wait_ms": longest, "unplugged": float(self._losses)}


def _decimal(value: Fraction) -> Decimal:
    return Decimal(repr(float(value)))

"""What waits for a radio's line, and in which order it goes out. Pure: times are whole ns, passed in.

First halts and stops, at once; then what is to be repeated, as far as the reserve reaches; then drive and
camera packets, each holder's through its token bucket (`airtime`), first come first served. A drive packet
that waits is replaced by the holder's next one for the same robot: the newest command is the true one.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from typing import Final, TypeAlias

from zscout.drivers.airtime import RESERVE, Bucket, Share, urgent_burst
from zscout.drivers.commands import RadioCamera, RadioDrive
from zscout.drivers.packets import (
    MAX_PACKET,
    OVERHEAD,
    CameraPacket,
    DrivePacket,
    HaltPacket,
    Packet,
    StopPacket,
    encode,
)
from zscout.drivers.retransmit import Retransmission, RetransmitSchedule
from zscout.types import (
    SECOND,
    Grant,
    Ns,
    Place,
)

MAX_WAITING: Final = 64
"""Packets of one holder that wait; one replaced by a newer does not count."""
DRIVE_SIZE: Final = MAX_PACKET
CAMERA_SIZE: Final = OVERHEAD + 1

_Kind: TypeAlias = type[RadioDrive] | type[RadioCamera]


class QueueFull(Exception):
    """A holder has too much waiting."""


@dataclass(slots=True)
class QueuedPacket:
    """A holder's packet that has not gone out. `entered`: when its bucket let it into the queue."""

    place: Place
    grant: Grant
    order: RadioDrive | RadioCamera
    arrived: Ns
    entered: Fraction = Fraction(0)
    queued: bool = False

    @property
    def size(self) -> int:
        return DRIVE_SIZE if isinstance(self.order, RadioDrive) else CAMERA_SIZE


@dataclass(frozen=True, slots=True)
class OutgoingPacket:
    """A packet to be written now. `through`: when the line has carried it; `entered`: when it stood in the
    queue, its bucket passed; `arrived`: when it was asked for. Of a repeat, both are when it was due."""

    packet: Packet
    arrived: Ns
    entered: Fraction
    through: Fraction
    repeat: bool = False


class _Member:
    """A holder: its bucket, what waits for it, and the robots that it has made do something."""

    def __init__(self, share: Share, now: Ns, *, full: bool) -> None:
        self.share = share
        self.bucket = Bucket(share.size, share.bytes_per_second, now, full=full) if share.rate else None
        self.earning = not full
        self.waiting: dict[tuple[int, _Kind], QueuedPacket] = {}
        self.robots: set[int] = set()

    def enters_at(self) -> Fraction | None:
        """When what waits first may enter the queue."""
        if self.bucket is None or not self.waiting:
            return None
        first = next(iter(self.waiting.values()))
        return max(Fraction(first.arrived), self.bucket.ready(first.size))

    def enter(self, now: Ns) -> Iterator[QueuedPacket]:
        """What enters the queue up to now."""
        while self.bucket is not None and (at := self.enters_at()) is not None and at <= now:
            first = self.waiting.pop(next(iter(self.waiting)))
            self.bucket.take(first.size, at)
            first.entered, first.queued = at, True
            yield first


class TransmitQueue:
    """All that waits for one line of `rate` bytes a second."""

    def __init__(self, rate: Fraction, *, first_number: int = 0) -> None:
        self._ns_per_byte = SECOND / rate
        self._rate = rate
        self._first_number = first_number
        self._ahead = MAX_PACKET * self._ns_per_byte
        """How much earlier than the line is free the next packet is written: one waits in the kernel."""
        self._free_at = Fraction(0)
        self._members: dict[Place, _Member] = {}
        self._queue: deque[QueuedPacket] = deque()
        self._urgent: dict[int, tuple[type[StopPacket] | type[HaltPacket], Ns]] = {}
        self._schedules: dict[int, RetransmitSchedule] = {}
        self._reserve = Bucket(Fraction(urgent_burst(0)), rate * RESERVE, 0)
        self.replaced = 0
        """Drive and camera packets that a newer command made void before they went out."""
        self.dropped = 0
        """Packets whose hold was over before they went out."""

    # Holders

    def join(self, place: Place, share: Share, now: Ns) -> None:
        """A holder begins. On a busy line it earns its first packet, so that the bound holds for all."""
        if place not in self._members:
            self._members[place] = _Member(share, now, full=not self._queue and not self._urgent)
            self._fit_reserve()

    def leave(self, place: Place) -> set[int]:
        """A holder is gone, and what waits for it. Returns the robots that it made do something."""
        member = self._members.pop(place, None)
        if member is None:
            return set()
        self._fit_reserve()
        self.dropped += len(member.waiting) + self._remove(lambda waiting: waiting.place == place)
        return member.robots

    def places(self) -> list[Place]:
        """Who has joined and not left."""
        return list(self._members)

    # What is to be sent

    def offer(self, place: Place, grant: Grant, order: RadioDrive | RadioCamera, now: Ns) -> Ns:
        """A drive or camera packet of a holder that has joined. Returns in about how many ns it is through.

        Raises Full, and ValueError with a reason in words where the holder's share has no room for it."""
        member = self._members[place]
        waiting = QueuedPacket(place, grant, order, now)
        if member.bucket is None:
            raise ValueError("this ARC asked for command_rate 0: only stops and halts go out")
        if waiting.size > member.share.size:
            raise ValueError(
                f"this packet has {waiting.size} bytes, and this ARC asked for {float(member.share.size):g}; "
                f"ask for packet_size = {MAX_PACKET}"
            )
        self._release(now)
        if isinstance(order, RadioDrive):
            # Driven under a newer hold: the end of an older one that is learned of late halts it no more.
            for other in self._members.values():
                other.robots.discard(order.robot)
        member.robots.add(order.robot)
        for queued in self._queue:
            if queued.place == place and _same(queued.order, order):
                queued.order, queued.grant = order, grant
                self.replaced += 1
                return self._through_queue(queued, now)
        key = (order.robot, type(order))
        earlier = member.waiting.get(key)
        if earlier is not None:
            earlier.order, earlier.grant = order, grant
            self.replaced += 1
            waiting = earlier
        elif len(member.waiting) >= MAX_WAITING:
            raise QueueFull
        else:
            member.waiting[key] = waiting
        self._release(now)
        if waiting.queued:
            return self._through_queue(waiting, now)
        begins = max(member.bucket.ready(waiting.size), self._free_at, Fraction(now))
        return round(begins - now + waiting.size * self._ns_per_byte)

    def send_urgent(self, robot: int, kind: type[StopPacket] | type[HaltPacket], now: Ns) -> Ns:
        """A stop or a halt, ahead of all that waits. Drive packets that wait for this robot are void, with a
        halt camera packets too. Returns in about how many ns it is through."""
        voided = (RadioDrive, RadioCamera) if kind is HaltPacket else (RadioDrive,)
        self.replaced += self._remove(
            lambda waiting: waiting.order.robot == robot and isinstance(waiting.order, voided)
        )
        for member in self._members.values():
            for what in voided:
                self.replaced += member.waiting.pop((robot, what), None) is not None
        earlier = self._urgent.get(robot)
        if earlier is None or (kind is HaltPacket and earlier[0] is StopPacket):
            self._urgent[robot] = (kind, now if earlier is None else earlier[1])
        place = list(self._urgent).index(robot) + 1
        return self._carried(place * OVERHEAD, now)

    # Going out

    def next(self, now: Ns, stands: Callable[[Grant], bool]) -> OutgoingPacket | None:
        """The packet to be written now, if there is one and the line has room. `stands` is whether the
        hold behind a packet is still in force: that is what counts when it goes out."""
        if self._free_at - now > self._ahead:
            return None
        self._release(now)
        if self._urgent:
            robot = next(iter(self._urgent))
            kind, arrived = self._urgent.pop(robot)
            return self._transmit(
                kind(robot, self._schedule_of(robot).number()), arrived, Fraction(arrived), now
            )
        repeat = self._due(now)
        if repeat is not None:
            schedule, again = repeat
            due = again.due
            return self._transmit(schedule.retransmit(again, now), due, Fraction(due), now, repeat=True)
        while self._queue:
            waiting = self._queue.popleft()
            if not stands(waiting.grant):
                self.dropped += 1
                continue
            order, schedule = waiting.order, self._schedule_of(waiting.order.robot)
            packet: Packet
            if isinstance(order, RadioDrive):
                packet = DrivePacket(order.robot, schedule.number(), order.left, order.right, order.lasts)
            else:
                packet = CameraPacket(order.robot, schedule.number(), order.channel)
            return self._transmit(packet, waiting.arrived, waiting.entered, now)
        for member in self._members.values():
            # Nothing waits: whoever joined while something did may have its packet now.
            if member.earning and member.bucket is not None:
                member.earning = False
                member.bucket.fill(now)
        return None

    def wake(self, now: Ns) -> Ns | None:
        """When to call `next` again; None: not before something else happens."""
        times = [Fraction(now)] if self._urgent or self._queue else []
        for schedule in self._schedules.values():
            repeat = schedule.next_due()
            if repeat is not None:
                times.append(self._repeat_at(repeat))
        times += [at for member in self._members.values() if (at := member.enters_at()) is not None]
        if not times:
            return None
        return math.ceil(max(self._free_at - self._ahead, min(times)))

    @property
    def urgent(self) -> int:
        """Halts and stops that have not gone out once."""
        return len(self._urgent)

    @property
    def waiting(self) -> int:
        """Drive and camera packets that have not gone out."""
        return len(self._queue) + sum(len(member.waiting) for member in self._members.values())

    # Within

    def _release(self, now: Ns) -> None:
        """Lets into the queue what the buckets let through up to now, in the order of its times."""
        entering = [waiting for member in self._members.values() for waiting in member.enter(now)]
        entering.sort(key=lambda waiting: waiting.entered)
        self._queue.extend(entering)

    def _due(self, now: Ns) -> tuple[RetransmitSchedule, Retransmission] | None:
        """What is to be repeated now, where the reserve has room for it."""
        due = [
            (schedule, repeat)
            for schedule in self._schedules.values()
            if (repeat := schedule.next_due()) is not None and self._repeat_at(repeat) <= now
        ]
        return min(due, key=lambda item: item[1].due, default=None)

    def _repeat_at(self, repeat: Retransmission) -> Fraction:
        """When a repeat may go out."""
        return max(Fraction(repeat.due), self._reserve.ready(len(encode(repeat.packet))))

    def _transmit(
        self, packet: Packet, arrived: Ns, entered: Fraction, now: Ns, *, repeat: bool = False
    ) -> OutgoingPacket:
        size = len(encode(packet))
        if repeat or isinstance(packet, StopPacket | HaltPacket):
            self._reserve.take(size, now)
        if not repeat:
            self._schedule_of(packet.robot).sent(packet, now)
        self._free_at = max(self._free_at, Fraction(now)) + size * self._ns_per_byte
        return OutgoingPacket(packet, arrived, entered, self._free_at, repeat)

    def _schedule_of(self, robot: int) -> RetransmitSchedule:
        return self._schedules.setdefault(robot, RetransmitSchedule(self._first_number))

    def _through_queue(self, last: QueuedPacket, now: Ns) -> Ns:
        ahead = len(self._urgent) * OVERHEAD
        for waiting in self._queue:
            ahead += waiting.size
            if waiting is last:
                break
        return self._carried(ahead, now)

    def _carried(self, size: int, now: Ns) -> Ns:
        """In how many ns `size` bytes more are through."""
        return round(max(self._free_at - now, Fraction(0)) + size * self._ns_per_byte)

    def _remove(self, gone: Callable[[QueuedPacket], bool]) -> int:
        """Takes out of the queue what is `gone`; returns how much that was."""
        before = len(self._queue)
        self._queue = deque(waiting for waiting in self._queue if not gone(waiting))
        return before - len(self._queue)

    def _fit_reserve(self) -> None:
        self._reserve.size = Fraction(urgent_burst(len(self._members)))


def _same(one: RadioDrive | RadioCamera, other: RadioDrive | RadioCamera) -> bool:
    return type(one) is type(other) and one.robot == other.robot

"""The packets that wait for a radio's line, and their order. Pure: times are whole ns, passed in.

Halts and stops go first, at once; then repeats, within the reserve; then drive and camera packets, first come first
served, each holder's through its token bucket (`airtime`). A newer drive packet of a holder replaces its waiting drive
packet for the same robot.

Stop, camera and halt packets are sent several times, because robots acknowledge nothing. A repeat has the number of its
original, and the robot obeys once. If another packet went to the robot in between, the repeat gets a new number.
The parts of a packet that a newer packet overrides are not repeated: after a drive command, only "transmitter off"
remains of a halt."""

from __future__ import annotations

import math
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import chain, islice
from typing import Final

from zscout.drivers.airtime import RESERVE, Bucket, Share, urgent_burst
from zscout.drivers.commands import RadioCamera, RadioDrive
from zscout.drivers.packets import MAX_PACKET, OVERHEAD, CameraPacket, DrivePacket, HaltPacket, Packet, StopPacket
from zscout.mesh import Refused
from zscout.types import SECOND, Grant, Ns, Place

MAX_WAITING: Final = 64
"""Waiting packets of one holder. A replaced packet does not count."""
TRANSMISSIONS: Final = 3
"""How often a repeated packet is sent in all."""
SPACING: Final[Ns] = SECOND // 20
"""Between repeats: longer than most bursts of interference, and hardly noticeable for people."""


@dataclass(slots=True, eq=False)
class QueuedPacket:
    """A packet not sent yet. `arrived`: when the first command for it came; `given`: when the present one came, which
    may have replaced the first; `entered`: when its bucket admitted it."""

    place: Place
    grant: Grant
    command: RadioDrive | RadioCamera
    arrived: Ns
    given: Ns
    entered: Fraction = Fraction(0)

    @property
    def ready(self) -> Fraction:
        """The earliest time at which it could have been sent."""
        return max(self.entered, Fraction(self.given))

    @property
    def size(self) -> int:
        return MAX_PACKET if isinstance(self.command, RadioDrive) else OVERHEAD + 1


@dataclass(frozen=True, slots=True)
class OutgoingPacket:
    """A packet to write now. `entered`: when its bucket admitted it, or a repeat was due. `sent_by`: when the line has
    carried it. `until`: do not write it later; None for stops and halts."""

    packet: Packet
    entered: Fraction
    sent_by: Fraction
    repeat: bool
    until: Ns | None


@dataclass(slots=True)
class _Repeat:
    """A packet to send `left` more times, next at `due`."""

    packet: Packet
    left: int
    due: Ns


class _Robot:
    def __init__(self, first_number: int) -> None:
        self._next = first_number
        self._last: Packet | None = None
        self._count = 0
        self.repeats: list[_Repeat] = []

    def number(self) -> int:
        self._next, number = (self._next + 1) % 256, self._next
        return number

    def sent(self, packet: Packet, now: Ns) -> None:
        """Note a sent `packet` that is not a repeat: cancel the repeats that it overrides."""
        self.repeats = [kept for repeat in self.repeats if (kept := _remainder(repeat, packet)) is not None]
        if not isinstance(packet, DrivePacket):
            self.repeats.append(_Repeat(packet, TRANSMISSIONS - 1, now + SPACING))
        self._last = packet
        self._count += 1

    def repeat(self, repeat: _Repeat, now: Ns) -> Packet:
        # The robot may have ignored the very first number, if an earlier radio used it last: repeat with another.
        if repeat.packet is not self._last or self._count == 1:
            repeat.packet = replace(repeat.packet, number=self.number())
        self._last = repeat.packet
        self._count += 1
        repeat.left -= 1
        repeat.due = now + SPACING
        if not repeat.left:
            self.repeats.remove(repeat)
        return repeat.packet


def _remainder(repeat: _Repeat, newer: Packet) -> _Repeat | None:
    """The part of `repeat` that still applies after `newer`, if any."""
    match repeat.packet, newer:
        case (_, HaltPacket()) | (StopPacket(), DrivePacket() | StopPacket()) | (CameraPacket(), CameraPacket()):
            return None
        case HaltPacket() as halt, DrivePacket() | StopPacket():
            return _Repeat(CameraPacket(halt.robot, halt.number, 0), repeat.left, repeat.due)
        case HaltPacket() as halt, CameraPacket():
            return _Repeat(StopPacket(halt.robot, halt.number), repeat.left, repeat.due)
    return repeat


class _HolderQueue:
    def __init__(self, share: Share, now: Ns, *, full: bool) -> None:
        self.share = share
        self.bucket = Bucket(share.size, share.bytes_per_second, now, full=full) if share.rate else None
        self.earning = not full
        self.waiting: deque[QueuedPacket] = deque()
        self.robots: set[int] = set()

    def enters_at(self) -> Fraction | None:
        """When the first waiting packet may enter the queue, or None."""
        if self.bucket is None or not self.waiting:
            return None
        return max(Fraction(self.waiting[0].arrived), self.bucket.ready(self.waiting[0].size))

    def enter(self, now: Ns) -> Iterator[QueuedPacket]:
        """Yield the packets that enter the queue up to now."""
        while self.bucket is not None and (at := self.enters_at()) is not None and at <= now:
            first = self.waiting.popleft()
            self.bucket.take(first.size, at)
            first.entered = at
            yield first


class TransmitQueue:
    """The queue of a line with `rate` bytes a second. Packets held up for more than `stale`, as the line was down or
    this process stalled, are dropped; stops and halts never."""

    def __init__(self, rate: Fraction, *, first_number: int = 0, stale: Ns = SECOND) -> None:
        self._ns_per_byte, self._stale = SECOND / rate, stale
        self._ahead = MAX_PACKET * self._ns_per_byte
        """How long before the line is free the next packet is written, so that a packet waits in the kernel."""
        self._free_at = Fraction(0)
        self.members: dict[Place, _HolderQueue] = {}
        self._queue: deque[QueuedPacket] = deque()
        self._urgent: dict[int, tuple[type[StopPacket] | type[HaltPacket], Ns]] = {}
        self._robots: defaultdict[int, _Robot] = defaultdict(lambda: _Robot(first_number))
        self._reserve = Bucket(Fraction(urgent_burst(0)), rate * RESERVE, 0)
        self.replaced = 0
        """Unsent drive and camera packets that a newer command made void."""
        self.dropped = 0
        """Unsent packets that became stale, or whose hold ended."""

    def join(self, place: Place, share: Share, now: Ns) -> None:
        """A holder begins. On a busy line its bucket starts empty, so that the delay bound holds for all."""
        if place not in self.members:
            self.members[place] = _HolderQueue(share, now, full=not self._queue and not self._urgent)
            self._reserve.size = Fraction(urgent_burst(len(self.members)))

    def pass_on(self, before: Place, after: Place, share: Share, now: Ns) -> None:
        """The hold `before` continues as `after`, with its robots. Its waiting packets are dropped."""
        robots = self.leave(before) if before != after else set()
        self.join(after, share, now)
        self.members[after].robots |= robots

    def leave(self, place: Place) -> set[int]:
        """Remove a holder and its waiting packets. Return the robots that it commanded."""
        if place not in self.members:
            return set()
        self.dropped += self._remove(lambda waiting: waiting.place == place)
        member = self.members.pop(place)
        self._reserve.size = Fraction(urgent_burst(len(self.members)))
        return member.robots

    def offer(self, place: Place, grant: Grant, command: RadioDrive | RadioCamera, now: Ns) -> Ns:
        """Queue a drive or camera packet of a joined holder. Return about how many ns remain until it is sent. Raises
        Refused if too many of its packets wait, or if its share has no room for this packet."""
        member = self.members[place]
        waiting = QueuedPacket(place, grant, command, now, now)
        if member.bucket is None:
            raise Refused("bad_command", "this request has command_rate 0: only stops and halts are sent; request more")
        if waiting.size > member.share.size:
            sizes = f"{waiting.size} bytes, and this request has {float(member.share.size):g}"
            raise Refused("bad_command", f"this packet has {sizes}; request packet_size = {MAX_PACKET}")
        self._release(now)
        if isinstance(command, RadioDrive):
            # The robot is driven under a newer hold now: a late end of an older hold must not halt it.
            for other in self.members.values():
                other.robots.discard(command.robot)
        member.robots.add(command.robot)
        for earlier in chain(self._queue, member.waiting):
            same = earlier.place == place and earlier.command.robot == command.robot
            if same and type(earlier.command) is type(command):
                earlier.command, earlier.grant, earlier.given = command, grant, now
                self.replaced += 1
                waiting = earlier
                break
        else:
            if len(member.waiting) >= MAX_WAITING:
                raise Refused("busy", "too many packets of this request wait; send fewer")
            member.waiting.append(waiting)
            self._release(now)
        if waiting in self._queue:
            up_to_it = islice(self._queue, self._queue.index(waiting) + 1)
            return self._time_for(len(self._urgent) * OVERHEAD + sum(queued.size for queued in up_to_it), now)
        begins = max(member.bucket.ready(waiting.size), self._free_at, Fraction(now))
        return round(begins - now + waiting.size * self._ns_per_byte)

    def send_urgent(self, robot: int, kind: type[StopPacket] | type[HaltPacket], now: Ns) -> Ns:
        """Queue a stop or halt ahead of all packets, and drop its waiting drive packets; for a halt also camera
        packets. Return about how many ns remain until it is sent."""
        void = (RadioDrive,) if kind is StopPacket else (RadioDrive, RadioCamera)
        self.replaced += self._remove(lambda packet: packet.command.robot == robot and isinstance(packet.command, void))
        first, since = self._urgent.get(robot, (kind, now))
        self._urgent[robot] = (HaltPacket if HaltPacket in (first, kind) else StopPacket, since)
        return self._time_for((list(self._urgent).index(robot) + 1) * OVERHEAD, now)

    def _remove(self, gone: Callable[[QueuedPacket], bool]) -> int:
        """Return how many were removed."""
        before = self.waiting
        self._queue = deque(waiting for waiting in self._queue if not gone(waiting))
        for member in self.members.values():
            member.waiting = deque(waiting for waiting in member.waiting if not gone(waiting))
        return before - self.waiting

    def _time_for(self, size: int, now: Ns) -> Ns:
        return round(max(self._free_at - now, Fraction(0)) + size * self._ns_per_byte)

    def next(self, now: Ns, in_force: Callable[[Grant], bool]) -> OutgoingPacket | None:
        """The packet to write now, if any and the line has room. Packets of holds not `in_force` are dropped."""
        if self._free_at - now > self._ahead:
            return None
        self._release(now)
        if self._urgent:
            number = next(iter(self._urgent))
            kind, since = self._urgent.pop(number)
            robot = self._robots[number]
            return self._transmit(kind(number, robot.number()), Fraction(since), now)
        due = [(repeat.due, robot, repeat) for robot, repeat in self._repeats() if self._may_repeat(repeat) <= now]
        if due:
            at, robot, repeat = min(due, key=lambda item: item[0])
            return self._transmit(robot.repeat(repeat, now), Fraction(at), now, repeat=True)
        while self._queue:
            waiting = self._queue.popleft()
            if now - waiting.ready > self._stale or not in_force(waiting.grant):
                self.dropped += 1
                continue
            command, number = waiting.command, self._robots[waiting.command.robot].number()
            packet: Packet
            if isinstance(command, RadioDrive):
                packet = DrivePacket(command.robot, number, command.left, command.right, command.lasts)
            else:
                packet = CameraPacket(command.robot, number, command.channel)
            outgoing = self._transmit(packet, waiting.entered, now)
            return replace(outgoing, until=math.ceil(waiting.ready) + self._stale)
        for member in self.members.values():
            # Nothing waits: holders that joined while the line was busy may send their first packet now.
            if member.earning and member.bucket is not None:
                member.earning = False
                member.bucket.fill(now)
        return None

    def wake(self, now: Ns) -> Ns | None:
        """When to call `next` again; None: only after another event."""
        times = [Fraction(now)] if self._urgent or self._queue else []
        times += [self._may_repeat(repeat) for _, repeat in self._repeats()]
        times += [at for member in self.members.values() if (at := member.enters_at()) is not None]
        return math.ceil(max(self._free_at - self._ahead, min(times))) if times else None

    @property
    def urgent(self) -> int:
        return len(self._urgent)

    @property
    def waiting(self) -> int:
        return len(self._queue) + sum(len(member.waiting) for member in self.members.values())

    def _release(self, now: Ns) -> None:
        """Move the packets that the buckets admit up to now into the queue, in the order of their times."""
        entering = [waiting for member in self.members.values() for waiting in member.enter(now)]
        self._queue.extend(sorted(entering, key=lambda waiting: waiting.entered))

    def _repeats(self) -> Iterator[tuple[_Robot, _Repeat]]:
        for robot in self._robots.values():
            if robot.repeats:
                yield robot, min(robot.repeats, key=lambda repeat: repeat.due)

    def _may_repeat(self, repeat: _Repeat) -> Fraction:
        """When a repeat may be sent: it is due, and the reserve has room for it."""
        return max(Fraction(repeat.due), self._reserve.ready(repeat.packet.size))

    def _transmit(self, packet: Packet, entered: Fraction, now: Ns, *, repeat: bool = False) -> OutgoingPacket:
        if repeat or isinstance(packet, StopPacket | HaltPacket):
            self._reserve.take(packet.size, now)
        if not repeat:
            self._robots[packet.robot].sent(packet, now)
        self._free_at = max(self._free_at, Fraction(now)) + packet.size * self._ns_per_byte
        until = None if isinstance(packet, StopPacket | HaltPacket) else math.ceil(entered) + self._stale
        return OutgoingPacket(packet, entered, self._free_at, repeat, until)

"""What waits for a radio's line, and in which order it goes out. Pure: times are whole ns, passed in.

First halts and stops, at once; then repeats, as far as the reserve reaches; then drive and camera packets,
each holder's through its token bucket (`airtime`), first come first served. A drive packet that waits is
replaced by the holder's next one for the same robot: the newest command is the true one.

Stop, camera and halt packets go out several times, since nobody acknowledges. A repeat has the number of its original,
so that the robot obeys once. Where something else went to the robot in between, it gets a number of its own: it then
repeats what still applies. What a newer packet has overtaken is not repeated: after a drive command nothing of a halt
is left but "transmitter off"."""

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
"""Packets of one holder that wait; one replaced by a newer does not count."""
TIMES: Final = 3
"""How often a packet that is repeated goes out in all."""
SPACING: Final[Ns] = SECOND // 20
"""From one to the next: longer than most bursts of interference, short against a person's patience."""


@dataclass(slots=True, eq=False)
class QueuedPacket:
    """A holder's packet that has not gone out. `arrived`: when a packet was first asked for here, `given`: when this
    command was; `entered`: when its bucket let it into the queue."""

    place: Place
    grant: Grant
    command: RadioDrive | RadioCamera
    arrived: Ns
    given: Ns
    entered: Fraction = Fraction(0)

    @property
    def ready(self) -> Fraction:
        """From when on it could have gone out."""
        return max(self.entered, Fraction(self.given))

    @property
    def size(self) -> int:
        return MAX_PACKET if isinstance(self.command, RadioDrive) else OVERHEAD + 1


@dataclass(frozen=True, slots=True)
class OutgoingPacket:
    """A packet to be written now. `sent_by`: when the line has carried it; `entered`: when it stood in the
    queue, its bucket passed; of a repeat, when it was due. `until`: later it is not to be written; a stop or a halt
    always is."""

    packet: Packet
    entered: Fraction
    sent_by: Fraction
    repeat: bool
    until: Ns | None


@dataclass(slots=True)
class _Repeat:
    """A packet that goes out `left` times more, next at `due`."""

    packet: Packet
    left: int
    due: Ns


class _Robot:
    """What was sent to one robot: its numbers, and what of it is to be repeated."""

    def __init__(self, first_number: int) -> None:
        self._next = first_number
        self._last: Packet | None = None
        self._count = 0
        self.repeats: list[_Repeat] = []

    def number(self) -> int:
        """The number for the next packet that is no repeat."""
        self._next, number = (self._next + 1) % 256, self._next
        return number

    def sent(self, packet: Packet, now: Ns) -> None:
        """`packet`, no repeat, went out: what it overtakes is not repeated."""
        self.repeats = [kept for repeat in self.repeats if (kept := _remainder(repeat, packet)) is not None]
        if not isinstance(packet, DrivePacket):
            self.repeats.append(_Repeat(packet, TIMES - 1, now + SPACING))
        self._last = packet
        self._count += 1

    def repeat(self, repeat: _Repeat, now: Ns) -> Packet:
        """The packet that goes out now for `repeat`."""
        # The very first number may by chance be the last that an earlier radio used: the robot then ignores
        # it, and must be sent another.
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
    """What of `repeat` still applies once `newer` was sent."""
    match repeat.packet, newer:
        case (_, HaltPacket()) | (StopPacket(), DrivePacket() | StopPacket()) | (CameraPacket(), CameraPacket()):
            return None
        case HaltPacket() as halt, DrivePacket() | StopPacket():
            return _Repeat(CameraPacket(halt.robot, halt.number, 0), repeat.left, repeat.due)
        case HaltPacket() as halt, CameraPacket():
            return _Repeat(StopPacket(halt.robot, halt.number), repeat.left, repeat.due)
    return repeat


class _HolderQueue:
    """A holder: its bucket, what waits for it, and the robots that it has made do something."""

    def __init__(self, share: Share, now: Ns, *, full: bool) -> None:
        self.share = share
        self.bucket = Bucket(share.size, share.bytes_per_second, now, full=full) if share.rate else None
        self.earning = not full
        self.waiting: deque[QueuedPacket] = deque()
        self.robots: set[int] = set()

    def enters_at(self) -> Fraction | None:
        """When what waits first may enter the queue."""
        if self.bucket is None or not self.waiting:
            return None
        return max(Fraction(self.waiting[0].arrived), self.bucket.ready(self.waiting[0].size))

    def enter(self, now: Ns) -> Iterator[QueuedPacket]:
        """What enters the queue up to now."""
        while self.bucket is not None and (at := self.enters_at()) is not None and at <= now:
            first = self.waiting.popleft()
            self.bucket.take(first.size, at)
            first.entered = at
            yield first


class TransmitQueue:
    """All that waits for one line of `rate` bytes a second. What could have gone out more than `stale` ago and did not,
    as the line was not there or this process stood still, is dropped: only stops and halts go out however late."""

    def __init__(self, rate: Fraction, *, first_number: int = 0, stale: Ns = SECOND) -> None:
        self._ns_per_byte, self._stale = SECOND / rate, stale
        self._ahead = MAX_PACKET * self._ns_per_byte
        """How much earlier than the line is free the next packet is written: one waits in the kernel."""
        self._free_at = Fraction(0)
        self.members: dict[Place, _HolderQueue] = {}
        self._queue: deque[QueuedPacket] = deque()
        self._urgent: dict[int, tuple[type[StopPacket] | type[HaltPacket], Ns]] = {}
        self._robots: defaultdict[int, _Robot] = defaultdict(lambda: _Robot(first_number))
        self._reserve = Bucket(Fraction(urgent_burst(0)), rate * RESERVE, 0)
        self.replaced = 0
        """Drive and camera packets that a newer command made void before they went out."""
        self.dropped = 0
        """Packets whose hold was over, or that were stale, before they went out."""

    # Holders

    def join(self, place: Place, share: Share, now: Ns) -> None:
        """A holder begins. On a busy line it earns its first packet, so that the bound holds for all."""
        if place not in self.members:
            self.members[place] = _HolderQueue(share, now, full=not self._queue and not self._urgent)
            self._reserve.size = Fraction(urgent_burst(len(self.members)))

    def pass_on(self, before: Place, after: Place, share: Share, now: Ns) -> None:
        """What a holder made robots do goes on under another one; what waits for the first is dropped."""
        robots = self.leave(before) if before != after else set()
        self.join(after, share, now)
        self.members[after].robots |= robots

    def leave(self, place: Place) -> set[int]:
        """A holder is gone, and what waits for it. Returns the robots that it made do something."""
        if place not in self.members:
            return set()
        self.dropped += self._remove(lambda waiting: waiting.place == place)
        member = self.members.pop(place)
        self._reserve.size = Fraction(urgent_burst(len(self.members)))
        return member.robots

    # What is to be sent

    def offer(self, place: Place, grant: Grant, command: RadioDrive | RadioCamera, now: Ns) -> Ns:
        """A drive or camera packet of a holder that has joined. Returns in about how many ns it is through.

        Raises Refused where too much of the holder waits, or its share has no room for such a packet."""
        member = self.members[place]
        waiting = QueuedPacket(place, grant, command, now, now)
        if member.bucket is None:
            raise Refused("bad_command", "this request has command_rate 0: only stops and halts are sent; request more")
        if waiting.size > member.share.size:
            sizes = f"{waiting.size} bytes, and this request has {float(member.share.size):g}"
            raise Refused("bad_command", f"this packet has {sizes}; request packet_size = {MAX_PACKET}")
        self._release(now)
        if isinstance(command, RadioDrive):
            # Driven under a newer hold: the end of an older one that is learned of late halts it no more.
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
            return self._carried(len(self._urgent) * OVERHEAD + sum(queued.size for queued in up_to_it), now)
        begins = max(member.bucket.ready(waiting.size), self._free_at, Fraction(now))
        return round(begins - now + waiting.size * self._ns_per_byte)

    def send_urgent(self, robot: int, kind: type[StopPacket] | type[HaltPacket], now: Ns) -> Ns:
        """A stop or a halt, ahead of all that waits. Drive packets that wait for this robot are void, with a
        halt camera packets too. Returns in about how many ns it is through."""
        void = (RadioDrive,) if kind is StopPacket else (RadioDrive, RadioCamera)
        self.replaced += self._remove(lambda one: one.command.robot == robot and isinstance(one.command, void))
        first, since = self._urgent.get(robot, (kind, now))
        self._urgent[robot] = (HaltPacket if HaltPacket in (first, kind) else StopPacket, since)
        return self._carried((list(self._urgent).index(robot) + 1) * OVERHEAD, now)

    def _remove(self, gone: Callable[[QueuedPacket], bool]) -> int:
        """Takes out what is `gone` of all that waits; returns how much that was."""
        before = self.waiting
        self._queue = deque(waiting for waiting in self._queue if not gone(waiting))
        for member in self.members.values():
            member.waiting = deque(waiting for waiting in member.waiting if not gone(waiting))
        return before - self.waiting

    def _carried(self, size: int, now: Ns) -> Ns:
        """In how many ns `size` bytes more are through."""
        return round(max(self._free_at - now, Fraction(0)) + size * self._ns_per_byte)

    # Going out

    def next(self, now: Ns, in_force: Callable[[Grant], bool]) -> OutgoingPacket | None:
        """The packet to be written now, if there is one and the line has room. `in_force` is whether the
        hold behind a packet is still in force: that is what counts when it goes out."""
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
            # Nothing waits: whoever joined while something did may have its packet now.
            if member.earning and member.bucket is not None:
                member.earning = False
                member.bucket.fill(now)
        return None

    def wake(self, now: Ns) -> Ns | None:
        """When to call `next` again; None: not before something else happens."""
        times = [Fraction(now)] if self._urgent or self._queue else []
        times += [self._may_repeat(repeat) for _, repeat in self._repeats()]
        times += [at for member in self.members.values() if (at := member.enters_at()) is not None]
        return math.ceil(max(self._free_at - self._ahead, min(times))) if times else None

    @property
    def urgent(self) -> int:
        """Halts and stops that have not gone out once."""
        return len(self._urgent)

    @property
    def waiting(self) -> int:
        """Drive and camera packets that have not gone out."""
        return len(self._queue) + sum(len(member.waiting) for member in self.members.values())

    def _release(self, now: Ns) -> None:
        """Lets into the queue what the buckets let through up to now, in the order of its times."""
        entering = [waiting for member in self.members.values() for waiting in member.enter(now)]
        self._queue.extend(sorted(entering, key=lambda waiting: waiting.entered))

    def _repeats(self) -> Iterator[tuple[_Robot, _Repeat]]:
        """What is to be repeated next of each robot."""
        for robot in self._robots.values():
            if robot.repeats:
                yield robot, min(robot.repeats, key=lambda repeat: repeat.due)

    def _may_repeat(self, repeat: _Repeat) -> Fraction:
        """When a repeat may go out: where it is due, and the reserve has room for it."""
        return max(Fraction(repeat.due), self._reserve.ready(repeat.packet.size))

    def _transmit(self, packet: Packet, entered: Fraction, now: Ns, *, repeat: bool = False) -> OutgoingPacket:
        if repeat or isinstance(packet, StopPacket | HaltPacket):
            self._reserve.take(packet.size, now)
        if not repeat:
            self._robots[packet.robot].sent(packet, now)
        self._free_at = max(self._free_at, Fraction(now)) + packet.size * self._ns_per_byte
        until = None if isinstance(packet, StopPacket | HaltPacket) else math.ceil(entered) + self._stale
        return OutgoingPacket(packet, entered, self._free_at, repeat, until)

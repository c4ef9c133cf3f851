"""A radio's vote, and its queue under the worst that holders may do, in virtual time."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from decimal import Decimal
from fractions import Fraction
from functools import partial
from typing import TypeAlias

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.thorough import times
from zscout.drivers.airtime import (
    DEFAULT_RATE,
    MAX_RATE,
    Bucket,
    Share,
    line_rate,
    longest_wait,
    objection,
    share_of,
    urgent_burst,
)
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
from zscout.drivers.transmit_queue import MAX_WAITING, OutgoingPacket, TransmitQueue
from zscout.mesh import Refused
from zscout.types import NO_TERM, SECOND, Grant, Ns, Place

BOUND = Fraction(1, 4)


def place(number: int) -> Place:
    return Place(NO_TERM, number)


def grant(number: int) -> Grant:
    return Grant(NO_TERM, number)


def drive(robot: int, left: float = 1) -> RadioDrive:
    return RadioDrive(robot, left, 1, 0.5)


rates = st.builds(Fraction, st.integers(0, 400), st.integers(1, 20))
sizes = st.sampled_from([Fraction(10), Fraction(10), Fraction(25, 2), Fraction(20)])
shares = st.lists(st.builds(Share, rates, sizes), min_size=1, max_size=12)
bauds = st.sampled_from([1200, 2400, 9600, 19_200, 115_200])


def filled(baud: int, holders: int) -> TransmitQueue:
    """So many holders, each with a packet for its own robot, at time 0."""
    queue = TransmitQueue(line_rate(baud))
    for number in range(holders):
        queue.join(place(number), Share(Fraction(1), Fraction(10)), 0)
    for number in range(holders):
        queue.offer(place(number), grant(number), drive(number), 0)
    return queue


# The vote


def test_what_a_holder_must_say() -> None:
    assert share_of({"command_rate": Decimal(5)}) == Share(Fraction(5), Fraction(MAX_PACKET))
    assert share_of({"command_rate": Decimal("0.1"), "packet_size": Decimal(8)}).bytes_per_second == Fraction(4, 5)
    assert share_of({}) == Share(DEFAULT_RATE, Fraction(MAX_PACKET))
    assert share_of({}, Fraction(7)) == Share(Fraction(7), Fraction(MAX_PACKET))
    for params, word in (
        ({"command_rate": Decimal(5), "packet_size": Decimal(6)}, "packet_size is 6"),
        ({"command_rate": Decimal("NaN")}, "command_rate must be a number"),
        ({"command_rate": Decimal(-1)}, "must not be negative"),
    ):
        with pytest.raises(ValueError, match=word):
            share_of(params)


def test_a_line_is_filled_and_one_more_is_refused_in_figures() -> None:
    rate, robots = line_rate(9600), [Share(Fraction(8), Fraction(10))] * 10
    # 10 robots: 800 of 864 bytes/s, and (10 + 100 + 70) / 864 s.
    assert objection(rate, BOUND, robots) == ""
    more = [*robots, Share(Fraction(8), Fraction(10))]
    assert objection(rate, BOUND, more) == "its holders would send 88 of 86.4 packets/s of 10 bytes"
    slow = [Share(Fraction(1), Fraction(10))] * 13
    assert objection(rate, BOUND, slow) == "a packet could wait 0.267 s, the bound is 0.25 s"
    assert objection(rate, BOUND, slow[:-1]) == ""
    mixed = [*robots, Share(Fraction(4), Fraction(20))]
    assert objection(rate, BOUND, mixed) == "its holders would send 880 of 864 bytes/s"
    assert (objection(rate, BOUND, []), line_rate(1_000_000)) == ("", MAX_RATE)


def test_sums_are_exact() -> None:
    rate = Fraction(1000, 9)  # of which 100 are for commands
    third = Share(Fraction(10, 3), Fraction(10))
    assert objection(rate, Fraction(10), [third] * 3) == ""
    hair = Share(Fraction(10, 3) + Fraction(1, 10**18), Fraction(10))
    assert "would send" in objection(rate, Fraction(10), [third, third, hair])


@settings(max_examples=times(100))
@given(shares, bauds, st.data())
def test_what_is_accepted_is_accepted_of_every_part(wanted: list[Share], baud: int, data: st.DataObject) -> None:
    rate = line_rate(baud)
    while wanted and objection(rate, BOUND, wanted):
        wanted = wanted[:-1]
    kept = data.draw(st.lists(st.booleans(), min_size=len(wanted), max_size=len(wanted)))
    part = [share for share, keep in zip(wanted, kept, strict=True) if keep]
    assert objection(rate, BOUND, part) == ""
    assert longest_wait(rate, part) <= longest_wait(rate, wanted)


# The bucket


@given(rates.filter(bool), sizes, st.lists(st.integers(0, 10**9), min_size=2, max_size=30))
def test_a_bucket_lets_no_more_through_than_its_curve(rate: Fraction, size: Fraction, gaps: list[Ns]) -> None:
    bucket = Bucket(size, rate * size, 0)
    now, through = 0, []
    for gap in gaps:
        now += gap
        at = max(Fraction(now), bucket.ready(10))
        bucket.take(10, at)
        through.append(at)
    for begin in range(len(through)):
        for end in range(begin, len(through)):
            carried = 10 * (end - begin + 1)
            assert carried <= size + rate * size * (through[end] - through[begin]) / SECOND


# The queue


Action: TypeAlias = tuple[Ns, Callable[[], object]]


@dataclass
class Told:
    """What one run of a queue brought."""

    outgoing: list[OutgoingPacket]
    written: list[Ns]

    @property
    def packets(self) -> list[Packet]:
        return [outgoing.packet for outgoing in self.outgoing]


def run(queue: TransmitQueue, until: Ns, actions: Iterable[Action] = (), begin: Ns = 0) -> Told:
    """Runs a queue from `begin` to `until`, and calls each action at its time."""
    told, now, events = Told([], []), begin, iter(actions)
    event = next(events, None)
    while True:
        wake = queue.wake(now)
        times = [at for at in (wake, event[0] if event else None) if at is not None]
        now = max(now, min(times, default=until + 1))
        if now > until:
            return told
        while event is not None and event[0] <= now:
            event[1]()
            event = next(events, None)
        while (out := queue.next(now, lambda _: True)) is not None:
            told.outgoing.append(out)
            told.written.append(now)


@settings(max_examples=times(30))
@given(shares, bauds, st.integers(0, 2**32), st.booleans())
def test_no_packet_waits_longer_than_the_bound_however_holders_time_it(
    wanted: list[Share], baud: int, seed: int, greedy: bool
) -> None:
    rate = line_rate(baud)
    bound = max(BOUND, longest_wait(rate, wanted[:1]))
    while objection(rate, bound, wanted):
        wanted = wanted[:-1]
    rng = random.Random(seed)  # noqa: S311
    queue, seconds = TransmitQueue(rate), 1
    actions: list[Action] = []

    def send(number: int, at: Fraction) -> None:
        robot = number if rng.random() < 0.9 else number + 100
        order = RadioCamera(robot, 1) if rng.random() < 0.2 else drive(robot)
        queue.offer(place(number), grant(number), order, int(at))

    for number, share in enumerate(wanted):
        queue.join(place(number), share, 0)
        if share.rate == 0:
            continue
        gap = SECOND / share.rate

        at = Fraction(0) if greedy else Fraction(rng.randrange(SECOND))
        while at < seconds * SECOND:
            actions.append((int(at), partial(send, number, at)))
            # Greedy: all together, as fast as their rate; else with pauses, and faster than they may.
            at += gap if greedy else gap * Fraction(rng.choice([1, 1, 2, 8]), 2)
    # As many halts as the bound counts with, at the worst moments, and no more than the reserve carries.
    halts, at = Bucket(Fraction(urgent_burst(len(wanted))), rate / 10, 0), Fraction(0)
    while at < seconds * SECOND:
        for robot in range(len(wanted)):
            if halts.ready(OVERHEAD) <= at:
                halts.take(OVERHEAD, int(at))
                kind: type[StopPacket] | type[HaltPacket] = StopPacket if rng.random() < 0.5 else HaltPacket
                actions.append((int(at), partial(queue.send_urgent, robot + 200, kind, int(at))))
        at += SECOND if greedy else rng.randrange(SECOND)
    actions.sort(key=lambda action: action[0])
    told = run(queue, 20 * SECOND, actions)
    commands = [out for out in told.outgoing if isinstance(out.packet, DrivePacket | CameraPacket) and not out.repeat]
    assert queue.waiting == 0
    if any(share.rate for share in wanted):
        assert commands
    worst = max((out.sent_by - out.entered for out in commands), default=Fraction(0))
    assert worst / SECOND <= longest_wait(rate, wanted) <= bound
    # And the line is never given more than it carries, one packet ahead.
    free = Fraction(0)
    for out, written in zip(told.outgoing, told.written, strict=True):
        assert free - written <= MAX_PACKET * SECOND / rate
        free = max(free, Fraction(written)) + len(encode(out.packet)) * SECOND / rate
        assert free == out.sent_by


def test_one_more_than_accepted_would_break_the_bound() -> None:
    """The vote is not timid: with the refused set the simulated wait comes near the bound, and past it."""
    rate, slow = line_rate(9600), [Share(Fraction(60, 13), Fraction(10))] * 13
    assert "wait" in objection(rate, BOUND, slow)
    queue = TransmitQueue(rate)
    for number, share in enumerate(slow):
        queue.join(place(number), share, 0)
    for number in range(13):
        queue.send_urgent(200 + number, HaltPacket, 0)
        queue.offer(place(number), grant(number), drive(number), 0)
    told = run(queue, SECOND)
    commands = [out for out in told.outgoing if isinstance(out.packet, DrivePacket)]
    assert len(commands) == 13
    assert max(out.sent_by - out.entered for out in commands) / SECOND > Fraction(9, 10) * BOUND


def test_a_faster_holder_replaces_its_own_waiting_packet_and_nobody_elses() -> None:
    queue = TransmitQueue(line_rate(9600))
    queue.join(place(1), Share(Fraction(5), Fraction(10)), 0)
    queue.join(place(2), Share(Fraction(5), Fraction(10)), 0)
    actions: list[Action] = []
    for step in range(50):
        now, left = step * SECOND // 50, step / 50
        actions.append((now, partial(queue.offer, place(1), grant(1), drive(1, left), now)))
        if step % 10 == 5:
            actions.append((now, partial(queue.offer, place(2), grant(2), drive(2), now)))
    told = run(queue, 3 * SECOND, actions)
    count = Counter(packet.robot for packet in told.packets)
    assert (count, queue.replaced) == ({1: 6, 2: 5}, 50 - 6)
    # What goes out is the newest of its moment, and the last word is the last command.
    lefts = [packet.left for packet in told.packets if isinstance(packet, DrivePacket) and packet.robot == 1]
    assert (lefts, lefts[-1]) == (sorted(lefts), 49 / 50)


def test_what_a_holder_made_robots_do_is_passed_on_and_what_waits_for_it_is_not() -> None:
    queue, share = TransmitQueue(line_rate(9600)), Share(Fraction(5), Fraction(10))
    for number in (1, 2):
        queue.join(place(number), share, 0)
    queue.offer(place(1), grant(1), RadioCamera(1, 3), 0)
    sent = queue.next(0, lambda _: True)
    assert sent is not None
    queue.offer(place(1), grant(1), drive(1), 0)
    queue.pass_on(place(1), place(3), share, SECOND)
    assert (set(queue.members), queue.waiting, queue.dropped) == ({place(2), place(3)}, 0, 1)
    assert queue.leave(place(1)) == set()
    # To another client that is all one holder, and nothing of it is dropped.
    queue.offer(place(3), grant(3), drive(1), SECOND)
    queue.pass_on(place(3), place(3), share, SECOND)
    assert (queue.waiting, queue.dropped) == (1, 1)
    # Whom another drives since then is not halted with the first.
    queue.offer(place(2), grant(2), drive(2), SECOND)
    queue.pass_on(place(3), place(2), share, SECOND)
    assert queue.leave(place(2)) == {1, 2}


def test_halts_and_stops_go_first_and_void_what_waits_for_their_robot() -> None:
    queue, told = filled(1200, 4), []
    while (out := queue.next(0, lambda _: True)) is not None:
        told.append(out.packet)
    assert [packet.robot for packet in told] == [0, 1]  # one under way and one in the kernel
    after = queue.send_urgent(3, HaltPacket, 1)
    queue.send_urgent(2, StopPacket, 2)
    queue.send_urgent(2, HaltPacket, 3)
    assert (queue.replaced, after) == (2, round(Fraction((2 * 10 + 7) * SECOND, 120) - 1))
    rest = run(queue, 5 * SECOND, begin=3)
    kinds = [(type(packet), packet.robot) for packet in rest.packets]
    assert kinds[:2] == [(HaltPacket, 3), (HaltPacket, 2)]
    assert Counter(kinds) == {(HaltPacket, 3): 3, (HaltPacket, 2): 3}


def test_what_is_said_again_stays_true() -> None:
    """Halt, then a drive, then the camera on: whatever gets through, the robot does what was sent last."""
    queue = TransmitQueue(line_rate(9600), first_number=7)
    queue.join(place(1), Share(Fraction(50), Fraction(10)), 0)
    actions: list[Action] = [
        (0, lambda: queue.send_urgent(1, HaltPacket, 0)),
        (20_000_000, lambda: queue.offer(place(1), grant(1), drive(1), 20_000_000)),
    ]
    told = run(queue, SECOND, actions)
    assert [type(packet) for packet in told.packets] == [HaltPacket, DrivePacket, CameraPacket, CameraPacket]
    assert [packet.channel for packet in told.packets if isinstance(packet, CameraPacket)] == [0, 0]
    # A number comes twice only for the same packet, sent again with nothing in between.
    assert [packet.number for packet in told.packets] == [7, 8, 9, 9]

    now = 2 * SECOND
    queue.send_urgent(1, HaltPacket, now)
    told = run(queue, now + 10_000_000, begin=now)
    queue.offer(place(1), grant(1), RadioCamera(1, 3), now + 20_000_000)
    told = run(queue, now + SECOND, begin=now + 20_000_000)
    assert [type(packet) for packet in told.packets].count(HaltPacket) == 0
    assert Counter(type(packet) for packet in told.packets) == {CameraPacket: 3, StopPacket: 2}
    assert {packet.channel for packet in told.packets if isinstance(packet, CameraPacket)} == {3}


def test_what_is_said_again_keeps_to_the_reserve() -> None:
    queue = TransmitQueue(line_rate(9600))
    for robot in range(20):
        queue.send_urgent(robot, HaltPacket, 0)
    told = run(queue, 60 * SECOND)
    # All are sent once before any is sent again, however much that is at once.
    assert [out.packet.robot for out in told.outgoing[:20]] == list(range(20))
    assert not any(out.repeat for out in told.outgoing[:20])
    assert Counter(out.packet.robot for out in told.outgoing) == dict.fromkeys(range(20), 3)
    # And then at a tenth of the line, what went out at once paid back first.
    reserve = line_rate(9600) / 10
    assert told.written[-1] / SECOND >= (len(told.outgoing) * OVERHEAD - urgent_burst(0)) / reserve


def test_the_first_packet_ever_is_said_again_under_a_new_number() -> None:
    queue = TransmitQueue(line_rate(9600), first_number=255)
    queue.send_urgent(1, HaltPacket, 0)
    assert [packet.number for packet in run(queue, SECOND).packets] == [255, 0, 0]
    queue.send_urgent(1, HaltPacket, 2 * SECOND)
    assert [packet.number for packet in run(queue, 3 * SECOND, begin=2 * SECOND).packets] == [1, 1, 1]


def test_a_packet_whose_hold_is_over_does_not_go_out() -> None:
    queue = filled(300, 4)
    first = queue.next(0, lambda _: True)
    assert first is not None
    assert (first.packet.robot, queue.leave(place(3))) == (0, {3})
    second = queue.next(0, lambda held: held != grant(1))
    assert second is not None
    assert (second.packet.robot, queue.dropped, queue.waiting) == (2, 2, 0)


def test_what_a_line_could_not_take_in_time_is_dropped_but_for_stops_and_halts() -> None:
    queue = filled(9600, 2)
    queue.send_urgent(5, HaltPacket, 0)
    # In the place of an old one: what is newly asked for is new.
    queue.offer(place(0), grant(0), drive(0), 2 * SECOND)
    sent = [queue.next(at * SECOND // 100, lambda _: True) for at in range(200, 240, 4)]
    told = [(out.packet.robot, out.until) for out in sent if out is not None and not out.repeat]
    assert told == [(5, None), (0, 3 * SECOND)]
    assert (queue.waiting, queue.dropped, queue.replaced) == (0, 1, 1)


def test_a_robot_is_halted_at_the_end_of_the_hold_under_which_it_was_last_driven() -> None:
    queue = filled(9600, 2)
    queue.offer(place(1), grant(1), RadioCamera(0, 0), 0)  # which leaves the wheels as they are
    queue.offer(place(0), grant(0), drive(1), 0)
    assert (queue.leave(place(1)), queue.leave(place(0))) == ({0}, {0, 1})


def test_what_a_share_has_no_room_for_is_refused_in_words() -> None:
    queue = TransmitQueue(line_rate(9600))
    queue.join(place(1), Share(Fraction(0), Fraction(10)), 0)
    with pytest.raises(Refused, match="command_rate 0"):
        queue.offer(place(1), grant(1), drive(1), 0)
    queue.join(place(2), Share(Fraction(1), Fraction(8)), 0)
    queue.offer(place(2), grant(2), RadioCamera(1, 1), 0)
    with pytest.raises(Refused, match="packet_size = 10"):
        queue.offer(place(2), grant(2), drive(1), 0)
    queue.join(place(3), Share(Fraction(1), Fraction(10)), 0)
    for robot in range(MAX_WAITING):
        queue.offer(place(3), grant(3), drive(robot), 0)
    with pytest.raises(Refused, match="too many packets"):
        queue.offer(place(3), grant(3), drive(200), 0)
    queue.offer(place(3), grant(3), drive(1, 0.5), 0)  # it takes the place of its own


def test_who_joins_a_busy_line_earns_its_first_packet() -> None:
    queue = filled(1200, 4)
    queue.join(place(9), Share(Fraction(1), Fraction(10)), 0)
    queue.offer(place(9), grant(9), drive(9), 0)
    told = run(queue, SECOND)
    at = {out.packet.robot: out.entered for out in told.outgoing}
    # The queue is empty once the fourth is handed over: from then on nobody is kept waiting by it.
    assert at[9] >= told.written[3] > 0
    assert [out.packet.robot for out in told.outgoing] == [0, 1, 2, 3, 9]

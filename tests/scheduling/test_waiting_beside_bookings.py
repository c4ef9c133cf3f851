"""What is promised to those who wait, beside bookings and maintenance: reckoned from what was asked alone."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass

import pytest
from msgspec import structs

from tests.scheduling.seeds import in_parts
from tests.scheduling.test_bookings import PATIENCE, RADIO, ROBOTS, Fleet, needs
from tests.thorough import times
from zscout.scheduling.booking import Booked, Booking
from zscout.scheduling.model import ArcRequest, Event, RcJoined, Requested, Tick
from zscout.types import Ns, Params

LONGEST = 20


@dataclass
class Asked:
    request: ArcRequest
    at: Ns
    start: Ns = 0
    missed: Ns = 0
    """The end of the booking that it had taken up and not been given: it waits on as anybody does."""

    @property
    def order(self) -> tuple[Ns, str]:
        return self.at, self.request.arc


@dataclass
class Run:
    """What was asked in a random run, and which bookings and maintenance were made."""

    asked: dict[str, Asked]
    made: list[Booking]
    missed: list[Asked]
    """Who had taken up a booking, but had not started by its end."""

    def free_from(self, one: Asked, time: Ns) -> Ns:
        """From `time` on, when its RCs are free of maintenance, and of bookings that were made before it was owed
        anything, for as long as it needs."""
        end = time + one.request.min_runtime
        for other in self.made:
            before = other.maintenance or other.since <= one.at + PATIENCE // 2
            if before and other.needs.keys() & one.request.needs.keys() and other.start < end and other.end > time:
                return self.free_from(one, other.end)
        return time

    def latest(self, one: Asked) -> Ns:
        """When it starts at the latest: after those who had asked before it, still wait when it begins to be owed, and
        need one of its RCs."""
        owed = one.at + PATIENCE // 2
        time = max(one.at + PATIENCE, max(owed, one.missed) + LONGEST)
        for other in (*self.asked.values(), *self.missed):
            before = other.order < one.order and other.start >= owed
            if before and other.request.needs.keys() & one.request.needs.keys():
                time = max(time, self.latest(other) + other.request.min_runtime)
        return self.free_from(one, time)


def play(seed: int) -> Run:
    """A busy stream of one priority; some of it is booked ahead, and taken up or not; now and then maintenance."""
    draw = random.Random(f"beside {seed}")  # noqa: S311
    fleet, run = Fleet(), Run({}, [], [])
    fleet.send(*(RcJoined(rc, sharable=False) for rc in ROBOTS), RcJoined(RADIO, sharable=True))
    taking: list[tuple[Booking, Asked]] = []
    for number in range(28):
        fleet.until(fleet.now + draw.randint(0, 8))
        what, runtime = draw.random(), draw.randint(1, LONGEST)
        events: list[Event] = [Tick()]
        if what < 0.5 and len(run.asked) < 16:
            wanted = needs(draw) if draw.random() < 0.8 else {rc: {} for rc in ROBOTS}
            request = ArcRequest(f"a{number}", f"h/{number}", wanted, 1, runtime, draw.random() < 0.3)
            run.asked[request.arc] = Asked(request, fleet.now)
            events = [Requested(request)]
        elif what < 0.75:
            one = Booking(f"b{number}", needs(draw), 1, fleet.now + draw.randint(0, 40), runtime, 10, fleet.now)
            if found := fleet.slots(one, one.start + 60, 1):
                run.made.append(structs.replace(one, start=found[0].start))
                events = [Booked(run.made[-1])]
        elif what < 0.82:
            closed: dict[str, Params] = {rc: {} for rc in draw.sample(ROBOTS, draw.randint(1, 2))}
            start = fleet.now + draw.randint(0, 30)
            run.made.append(Booking(f"m{number}", closed, 1, start, runtime, 0, fleet.now, maintenance=True))
            events = [Booked(run.made[-1])]
        fleet.send(*events)
        for one, taken in fleet.core.bookings():
            if taken is None and not one.maintenance and one.start <= fleet.now + 2 and draw.random() < 0.5:
                request = ArcRequest(f"t{one.id}", f"h/{one.id}", one.needs, 1, one.runtime, booking=one.id)
                taking.append((one, Asked(request, fleet.now)))
                fleet.send(Requested(request))
    fleet.until(fleet.now + 2_000)
    for asked in (*run.asked.values(), *(asked for _, asked in taking)):
        asked.start = fleet.served[asked.request.arc][1]
    for one, asked in taking:
        if asked.start >= one.end:
            asked.missed = one.end
            run.missed.append(asked)
    return run


@pytest.mark.parametrize("seeds", in_parts(range(times(1_000)), quick=50, size=475))
def test_nobody_waits_longer_than_promised_beside_bookings(seeds: Sequence[int]) -> None:
    patient = delayed = 0
    for seed in seeds:
        run = play(seed)
        for arc, one in run.asked.items():
            latest = run.latest(one)
            assert one.start <= latest, (seed, arc, one, latest)
            patient += one.start > one.at + PATIENCE
            delayed += latest > max(one.at + PATIENCE, one.at + PATIENCE // 2 + LONGEST)
    assert patient > len(seeds), "hardly anybody had to wait for his patience: these runs prove nothing"
    assert delayed > len(seeds)

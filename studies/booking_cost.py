"""The cost of a booking, compared with a bare query: `python -m studies booking-cost`.

Two candidates with disks: a booking is acknowledged once the other candidate has it on its disk. Then the cost of 1,000
booked dates for a leader of 100 RCs: a request and its release, with and without them. Last, in processor time of the
core, 1,000 dates on voting RCs, each overlapping the next: a takeover with all votes, and the cost of a booking, a
request or a ballot."""

from __future__ import annotations

import argparse
import gc
import tempfile
import time
from collections.abc import Awaitable, Callable
from datetime import UTC, datetime, timedelta
from fractions import Fraction
from pathlib import Path
from typing import Final

from msgspec.structs import replace

from benchmarks.latency import ANSWER, bare_query, hot
from benchmarks.loop import run
from benchmarks.stats import Row, Samples, of_latency, table
from tests.live.lab import Lab
from zscout.behaviors.client.bookings import BookingsClient
from zscout.messages import BookingView
from zscout.scheduling.adaptive import Adaptive
from zscout.scheduling.booking import Booked, Booking, Dates
from zscout.scheduling.core import Core
from zscout.scheduling.model import (
    ArcRequest,
    Effect,
    Event,
    LeadTaken,
    Propose,
    RcJoined,
    Released,
    Requested,
    Tick,
    Vote,
    WakeAt,
)
from zscout.types import SECOND, Params, Term

HOSTS: Final = ("lead", "other")
BOOKED: Final = 100
"""Other bookings during the measurement."""
RCS: Final = 100
DATES: Final = 1_000
WARM_UP: Final = 5


async def on_the_mesh(folder: Path, rounds: int) -> list[Row]:
    async with Lab(folder, candidates=HOSTS) as lab:
        lab.node(HOSTS[0], "robot/a", "robot/b")
        lab.node(HOSTS[1])
        client = await lab.client("bench")
        await lab.ready(client, "robot/a", "robot/b")
        await lab.candidates(client, *HOSTS)
        bookings = BookingsClient(client)
        day = datetime.now(UTC) + timedelta(days=1)
        for number in range(BOOKED - 1):
            await bookings.book({"robot/a": {}}, day + timedelta(hours=number), 3600, name=f"b{number}")
        made: list[BookingView] = []

        async def book() -> object:
            made.append(await bookings.book({"robot/b": {}}, day, 3600, name="measured"))
            return made[-1]

        async def unbook() -> object:
            return await bookings.unbook(made.pop().id)

        async def slots() -> object:
            return await bookings.slots({"robot/a": {}, "robot/b": {}}, 3600, 7 * 86_400)

        async def listed() -> object:
            return await bookings.list()

        once: dict[str, Callable[[], Awaitable[object]]] = {
            "book, on another host's disk": book,
            "unbook, on another host's disk": unbook,
        }
        often = {f"slots beside {BOOKED} bookings": slots, f"a list of {BOOKED} bookings": listed}
        samples, bare_samples = {name: Samples() for name in (*once, *often)}, Samples()
        (folder / "bare").mkdir()
        with bare_query(folder / "bare", ANSWER) as query:
            for number in range(-WARM_UP, rounds):
                for name, ask in (once | often).items():
                    reference = query.hot()
                    began = time.perf_counter()
                    took = await hot(ask) if name in often else None
                    if took is None:
                        await ask()
                        took = time.perf_counter() - began
                    if number >= 0:
                        samples[name].add(took)
                        bare_samples.add(reference)
    rows = [of_latency("bare query", bare_samples, bare_samples)]
    return rows + [of_latency(name, found, bare_samples) for name, found in samples.items()]


def in_the_core(rounds: int) -> list[Row]:
    """A request and its release, in cores without and with bookings."""
    samples = {}
    for dates in (0, DATES):
        core = Core(Adaptive())
        joined = [RcJoined(f"robot/r{number}", sharable=False) for number in range(RCS)]
        hour = 3600 * SECOND
        booked = [
            Booked(
                Booking(f"b@{n}", {f"robot/r{n % RCS}": {}}, 0, (24 + 2 * (n // RCS)) * hour, hour, hour, 0, owner="h")
            )
            for n in range(dates)
        ]
        core.handle(0, *joined, *booked, LeadTaken(Term(1, "bench")))
        found = samples[dates] = Samples()
        for number in range(-WARM_UP, rounds):
            request = ArcRequest(f"h/c/{number}", "h/c", {f"robot/r{number % RCS}": {}}, 0, 60 * SECOND)
            now = (number + WARM_UP + 1) * SECOND
            began = time.perf_counter()
            core.handle(now, Requested(request))
            core.handle(now, Released(request.arc))
            if number >= 0:
                found.add(time.perf_counter() - began)
    without, among = f"request and release in the core, {RCS} RCs", f"the same, {DATES} dates booked"
    return [
        of_latency(without, samples[0], samples[0], against="without bookings"),
        of_latency(among, samples[DATES], samples[0], against="without bookings"),
    ]


def on_shared_rcs(rounds: int, rcs: int, need: str = "") -> list[Row]:
    """1,000 dates on this many voting RCs. `need`: a pattern; each date has an RC bound to it."""
    half_hour, day = 1800 * SECOND, 86_400 * SECOND
    params: Params = {"seats": Fraction(1)}
    names = [f"room/r{number}" for number in range(rcs)]

    def date(number: int, name: str) -> Booking:
        rc = names[number % rcs]
        bound = {need: rc} if need else {}
        start = day + 2 * (number // rcs) * half_hour
        return Booking(name, {need or rc: params}, 0, start, 3 * half_hour, half_hour, 0, bound, owner="h")

    core, now = Core(Adaptive()), 0
    longest = spent = 0.0

    def instant(*events: Event) -> list[Effect]:
        nonlocal longest, spent
        began = time.process_time()
        effects = core.handle(now, *events)
        took = time.process_time() - began
        longest, spent = max(longest, took), spent + took
        return effects

    def settle(effects: list[Effect]) -> None:
        """Each ballot has an instant of its own."""
        asked = list[Propose]()
        while True:
            asked += [effect for effect in effects if isinstance(effect, Propose)]
            if asked:
                ballots.append(-spent)
                effects = instant(Vote(asked.pop(0).proposal, accept=True))
                ballots[-1] += spent
            elif WakeAt(now) in effects:
                effects = instant(Tick())
            else:
                return

    ballots = list[float]()
    gc.collect()
    gc.freeze()  # garbage of earlier parts must not count
    dates = tuple(date(number, f"d{number}@0") for number in range(DATES))
    for at in range(0, DATES, 100):
        instant(Dates(dates[at : at + 100], more=True))
    led = instant(*(RcJoined(rc, sharable=True) for rc in names), Dates(dates), LeadTaken(Term(1, "bench")))
    leads, entered = spent, longest
    settle(led)
    on = f"{DATES} dates on {rcs} voting RC{'s' * (rcs > 1)}{' by pattern' * bool(need)}"
    rows = [
        Row(f"takeover, {on}: until it leads", 1e3 * leads, "ms", aim=50),
        Row("its longest instant", 1e3 * entered, "ms", aim=20),
        Row(f"the same, with its {len(ballots)} ballots", 1e3 * spent, "ms"),
    ]
    votes = Samples()
    for ballot in ballots:
        votes.add(ballot)
    rows.append(Row(f"one ballot, {on}", 1e3 * votes.median, "ms", p99=1e3 * votes.p99, aim=5, rounds=len(ballots)))
    samples = {name: Samples() for name in ("booking", "unbooking", "a request and its release")}
    for number in range(rounds):
        added = replace(date(number, f"a{number}@0"), start=day + number * half_hour // 7)
        request = ArcRequest(f"h/c/{number}", "h/c", {names[0]: params}, 0, 60 * SECOND)
        events: dict[str, list[Event]] = {
            "booking": [Dates((*dates, added))],
            "unbooking": [Dates(dates)],
            "a request and its release": [Requested(request), Released(request.arc)],
        }
        for name, in_turn in events.items():
            now, spent = now + SECOND, 0.0
            for event in in_turn:
                settle(instant(event))
            samples[name].add(spent)
    for name, found in samples.items():
        rows.append(Row(f"{name}, {on}", 1e3 * found.median, "ms", p99=1e3 * found.p99, aim=5, rounds=rounds))
    return [*rows, Row("the longest instant of all", 1e3 * longest, "ms", aim=20)]


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m studies booking-cost", description=__doc__)
    parser.add_argument("--rounds", type=int, default=100)
    rounds = parser.parse_args().rounds
    with tempfile.TemporaryDirectory(prefix="zscout-bench-") as name:
        rows = run(on_the_mesh(Path(name), rounds))
    shared = [*on_shared_rcs(rounds, 1), *on_shared_rcs(rounds, 10), *on_shared_rcs(rounds, 10, "room/*")]
    print(table(rows + in_the_core(10 * rounds) + shared))

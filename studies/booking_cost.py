"""What a booking costs, beside a bare query: `python -m studies booking-cost`.

Two candidates with disks: a booking is told once the other one has it on its disk. Then what a leader of 100 RCs pays
for 1,000 dates that are booked: a request that is granted at once, and one that a booking keeps out."""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Awaitable, Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

from benchmarks.latency import ANSWER, bare_query, hot
from benchmarks.loop import run
from benchmarks.stats import Row, Samples, of_latency, table
from tests.live.lab import Lab
from zscout.behaviors.client.bookings import BookingsClient
from zscout.messages import BookingView
from zscout.scheduling.adaptive import Adaptive
from zscout.scheduling.booking import Booked, Booking
from zscout.scheduling.core import Core
from zscout.scheduling.model import ArcRequest, LeadTaken, RcJoined, Released, Requested
from zscout.types import SECOND, Term

HOSTS: Final = ("lead", "other")
BOOKED: Final = 100
"""Bookings that stand beside those that are measured."""
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
            "unbook, likewise": unbook,
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
    return rows + [of_latency(name, one, bare_samples) for name, one in samples.items()]


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


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m studies booking-cost", description=__doc__)
    parser.add_argument("--rounds", type=int, default=100)
    rounds = parser.parse_args().rounds
    with tempfile.TemporaryDirectory(prefix="zscout-bench-") as name:
        rows = run(on_the_mesh(Path(name), rounds))
    print(table(rows + in_the_core(10 * rounds)))

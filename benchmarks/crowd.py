"""Twenty behaviors that contend for ten RCs, compared with the same programs querying an empty queryable.

The behaviors run in a few programs of equal size, each with a session on either mesh. The same client code uses both:
request, wait for the grant, give back; a cycle counts once it is granted. Each program is `python -m benchmarks.crowd`,
a child process (see child.py) that takes orders as JSON lines.
"""

from __future__ import annotations

import asyncio
import json
import random
import statistics
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from benchmarks.child import child, ready
from benchmarks.loop import run
from benchmarks.programs import EXCLUSIVE, HOLD, running
from benchmarks.stats import Row
from tests.live.lab import Lab
from zscout import messages
from zscout.behaviors.client.client import Client
from zscout.config.fleet import load_fleet
from zscout.keyexpr import Keys
from zscout.messages import Notice
from zscout.types import Grant, Place, Term

BEHAVIORS = 20
PROGRAMS = 4
SEED = 2002
WARM_UP = 1.0
MOST = 5
"""RCs in one request."""
TERM = Term(1, "0123456789ab")
GRANTED = Notice(
    id="0123456789ab",
    arc="crowd",
    client="test/crowd-0",
    state="running",
    term=TERM,
    step=1,
    place=Place(TERM, 1),
    grant=Grant(TERM, 1),
    rcs=EXCLUSIVE[:3],
    remaining=HOLD,
)
"""The empty queryable's answer to any query."""


async def crowd(
    lab: Lab, folder: Path, rounds: int, seconds: float, progress: Callable[[str], None], programs: int = PROGRAMS
) -> list[Row]:
    """Return the rows of the grants per second, as a share of the empty queryable's answers."""
    empty = Lab(folder)
    answer = messages.encode(GRANTED).decode()
    key = Keys(empty.fleet.name).schedule_any
    rates: dict[str, list[float]] = {"rcm": [], "empty": []}
    with ExitStack() as stack:
        stack.enter_context(child("bare", empty.fleet.mesh.multicast_address, key, "--answer", answer))
        files = str(lab.fleet_file), str(empty.fleet_file)
        size = str(BEHAVIORS // programs)
        members = [stack.enter_context(child("crowd", *files, str(n), size)) for n in range(programs)]
        for number in range(-1, rounds):
            for which, rate in rates.items():
                for member in members:
                    member.order({"which": which, "seconds": seconds if number >= 0 else WARM_UP})
                counts = [await asyncio.to_thread(member.report) for member in members]
                if number >= 0:
                    rate.append(sum(counts) / seconds)
            progress(f"crowd: round {max(number + 1, 0)} of {rounds}")
    granted, answered = statistics.median(rates["rcm"]), statistics.median(rates["empty"])
    name = f"{BEHAVIORS} behaviors, {len(EXCLUSIVE)} RCs, {programs} programs"
    return [
        Row(f"{name}: empty queryable", answered, "cycles/s", rounds=rounds),
        Row(
            f"{name}: grants",
            granted,
            "grants/s",
            ratio=granted / answered,
            against="empty queryable",
            aim=0.6,
            at_least=True,
            rounds=rounds,
        ),
    ]


async def behave(client: Client, rng: random.Random, until: float, which: str) -> int:
    """Run one behavior: request one to five RCs (of the empty queryable always those of its answer), give them back
    once granted, and repeat. Return the number of grants."""
    cycles = 0
    while time.monotonic() < until:
        rcs = GRANTED.rcs if which == "empty" else rng.sample(EXCLUSIVE, rng.randint(1, MOST))
        needs = {rc: {} for rc in rcs}  # type: ignore[var-annotated]
        arc = await client.request("crowd", needs, min_runtime=HOLD)
        await running(client, arc)
        cycles += time.monotonic() < until
        await client.end(arc)
    return cycles


async def program(fleet_file: Path, empty_file: Path, number: int, behaviors: int) -> None:
    clients = {
        which: await Client.connect(f"crowd-{number}", fleet=load_fleet(file), host="test")
        for which, file in (("rcm", fleet_file), ("empty", empty_file))
    }
    rngs = [random.Random(SEED + number * behaviors + which) for which in range(behaviors)]  # noqa: S311
    for which, client in clients.items():
        # An answer shows that the client is linked.
        rcs = GRANTED.rcs if which == "empty" else EXCLUSIVE[number : number + 1]
        await client.end(await client.request("hello", {rc: {} for rc in rcs}, min_runtime=HOLD))
    ready()
    while line := await asyncio.to_thread(sys.stdin.readline):
        order = json.loads(line)
        until = time.monotonic() + order["seconds"]
        client = clients[order["which"]]
        cycles = await asyncio.gather(*(behave(client, rng, until, order["which"]) for rng in rngs))
        print(json.dumps(sum(cycles)), flush=True)
    for client in clients.values():
        await client.close()


if __name__ == "__main__":
    run(program(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])))

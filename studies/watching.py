"""`python -m studies watching`: the quality of the motion detector, in simulated buildings and on real recordings with
manually determined truth.

A robot hides in a random dark place of each building, facing the light. People walk by, and the detector gets its
receiver's pictures, at 5 a second and three levels of noise.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import sys
from collections.abc import Iterator
from contextlib import aclosing
from dataclasses import asdict
from typing import Any

import numpy as np

from benchmarks.stats import Row, table
from studies.process_pool import answers
from studies.robots.watch import DRAWN, Watched, cases, watch_case
from tests.behaviors.perception.recordings import EMPTY_LAWN, GARDEN, HAND, PASSERS_BY, PEOPLE, covered, pictures
from zscout.behaviors.perception.motion import MotionDetector
from zscout.simulation.building.plan_file import shipped_plans

AIM = 95.0
"""Percent of the crossings alerted within a second."""
FALSE_AIM = 1.0
"""False alarms in ten minutes of empty room."""
LEARNED = 10
"""Pictures of PASSERS_BY until the background is learned."""


def simulated(buildings: list[str], seeds: int, seconds: float, processes: int) -> dict[tuple[str, float], Watched]:
    """By building and level of noise."""
    todo = cases(buildings, seeds=seeds, seconds=seconds)
    sums: dict[tuple[str, float], Watched] = {}

    async def carry_out() -> None:
        async with aclosing(answers(watch_case, todo, processes)) as found:
            number = 0
            async for watched in found:
                case = todo[number]
                number += 1
                sums.setdefault((case.building, case.noise), Watched()).add(watched)
                print(f"{number} of {len(todo)}", end="\r", file=sys.stderr, flush=True)

    asyncio.run(carry_out())
    return dict(sorted(sums.items()))


def rows_of(sums: dict[tuple[str, float], Watched]) -> Iterator[Row]:
    whole = Watched()
    for (building, noise), watched in sums.items():
        whole.add(watched)
        yield from _rows(f"{building}, noise {noise:g}", watched)
    yield from _rows("all", whole)


def _rows(name: str, watched: Watched) -> Iterator[Row]:
    if watched.crossings:
        share = 100 * watched.alerted / watched.crossings
        yield Row(f"{name}: alerted within 1 s", share, "%", aim=AIM, at_least=True, rounds=watched.crossings)
    if watched.empty:
        alarms = watched.false_alarms / (watched.empty / 600)
        minutes = round(watched.empty / 60)
        yield Row(f"{name}: false alarms", alarms, "in 10 min", aim=FALSE_AIM, rounds=minutes)


def recorded() -> Iterator[Row]:
    """Rows of the real recordings; none if opencv-doc is not installed."""
    if not (PASSERS_BY.exists() and GARDEN.exists()):
        print("no real recordings: install Debian's opencv-doc", file=sys.stderr)
        return
    whole, lawn = MotionDetector(), MotionDetector()
    rows, columns, until = EMPTY_LAWN
    found = people = boxes = empty = moving = count = on_lawn = lawn_count = 0
    for number, (time, picture) in enumerate(pictures(PASSERS_BY)):
        seen = whole.see(time, picture)
        if time < until:
            on_lawn += lawn.see(time, np.ascontiguousarray(picture[rows, columns])).moving
            lawn_count += 1
        if number >= LEARNED:
            moving += seen.moving
            count += 1
        if number in PEOPLE:
            there = PEOPLE[number]
            people += len(there)
            found += sum(max((covered(person, box) for box in seen.boxes), default=0) >= 0.5 for person in there)
            boxes += len(seen.boxes)
            empty += sum(not any(covered(person, box) >= 0.25 for person in there) for box in seen.boxes)
    yield Row("passers-by: pictures with motion", 100 * moving / count, "%", rounds=count)
    yield Row("passers-by: people in a box", 100 * found / people, "%", rounds=people)
    yield Row("passers-by: boxes without people", 100 * empty / boxes, "%", rounds=boxes)
    yield Row("empty lawn: pictures with motion", 100 * on_lawn / lawn_count, "%", rounds=lawn_count)
    detector = MotionDetector()
    garden = [(time, detector.see(time, picture).moving) for time, picture in pictures(GARDEN)]
    before = [moves for time, moves in garden if time < HAND]
    after = [moves for time, moves in garden if time >= HAND]
    yield Row("tree in the wind: pictures with motion", 100 * sum(before) / len(before), "%", rounds=len(before))
    yield Row("hand before it: pictures with motion", 100 * sum(after) / len(after), "%", rounds=len(after))


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m studies watching", description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    parser.add_argument("--seeds", type=int, default=20, help="of each building and noise (default: 20)")
    parser.add_argument("--seconds", type=float, default=60.0, help="of each watch (default: 60)")
    parser.add_argument("--jobs", type=int, default=1, help="processes (default: 1)")
    parser.add_argument("--building", action="append", help=f"a shipped building or {DRAWN!r} (default: all)")
    args = parser.parse_args()
    known = [*shipped_plans(), DRAWN]
    buildings = args.building or known
    if not set(buildings) <= set(known):
        parser.error(f"buildings are {', '.join(known)}")
    if args.seeds < 0 or args.jobs < 1 or args.seconds <= 0:
        parser.error("give at least 0 seeds (0: only the recordings), at least 1 job, and more than 0 seconds")
    # Set before the processes start, because they inherit it.
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sums = simulated(buildings, args.seeds, args.seconds, args.jobs)
    rows = [*rows_of(sums), *recorded()]
    if args.json:
        simulations: list[Any] = [
            {"building": building, "noise": noise, **asdict(watched)} for (building, noise), watched in sums.items()
        ]
        print(json.dumps({"rows": [row.as_json() for row in rows], "simulated": simulations}))
    else:
        print(table(rows))

"""Scenarios of the study of placement: the paper's Figure 3, and a mixed batch on unlike machines."""

from __future__ import annotations

from random import Random
from typing import Final

from studies.placement.simulation import Machine, SimulatedJob
from zscout.types import SECOND, HostName, Ns

GIGABYTE: Final = 1_000_000_000
NETS: Final = 3
NET_SIZE: Final = 4
"""Components of a Place Sensor Net: one for each of its Scouts."""
STAGGER: Final[Ns] = 60 * SECOND
"""From one Place Sensor Net to the next in scenario (b)."""
WATCHED: Final[Ns] = 300 * SECOND
"""How long the load curves of the sensor nets are recorded."""
BATCH_SPAN: Final[Ns] = 120 * SECOND
"""The jobs of the mixed batch start at random times within this span."""
SPEEDS: Final = (1.0, 2.0, 4.0)
MEMORIES: Final = (1 * GIGABYTE, 4 * GIGABYTE, 2 * GIGABYTE)


def workstations() -> list[Machine]:
    """Three identical idle machines."""
    return [Machine(f"workstation{number}") for number in range(1, NETS + 1)]


def sensor_nets(stagger: Ns = 0) -> list[SimulatedJob]:
    """Three Place Sensor Nets that start at intervals of `stagger` ns. Their components do not end."""
    return [
        SimulatedJob(f"net{net}-{number}", "place_sensor_net", SECOND + net * stagger, cpu=0.5)
        for net in range(NETS)
        for number in range(NET_SIZE)
    ]


def unlike_machines(seed: int) -> list[Machine]:
    """Speeds 1, 2, 4 with 1, 4, 2 GB. The seed assigns names, because ties are broken by name."""
    names: list[HostName] = ["ash", "birch", "cedar"]
    Random(seed).shuffle(names)  # noqa: S311 - a simulation
    return [
        Machine(name, speed=speed, memory=memory) for name, speed, memory in zip(names, SPEEDS, MEMORIES, strict=True)
    ]


def mixed_batch(seed: int) -> list[SimulatedJob]:
    """12 jobs that compute, 6 that also fill the memory, and 12 light jobs, at random times within two minutes."""
    rng = Random(seed)  # noqa: S311 - a simulation

    def at() -> Ns:
        return rng.randrange(BATCH_SPAN // SECOND) * SECOND

    heavy = [
        SimulatedJob(f"heavy{number}", "heavy", at(), cpu=1, memory=60_000_000, work=60, greedy=True)
        for number in range(12)
    ]
    large = [
        SimulatedJob(f"large{number}", "large", at(), cpu=1, memory=700_000_000, work=30, greedy=True)
        for number in range(6)
    ]
    light = [SimulatedJob(f"light{number}", "light", at(), cpu=0.1, memory=40_000_000, work=3) for number in range(12)]
    return heavy + large + light


FLEETS: Final = ("processor_speed", "load_average", "available_memory")
"""Fleets of unlike machines in which this figure alone decides how well a component runs."""


def deciding_fleet(decides: str, seed: int) -> tuple[list[Machine], list[SimulatedJob]]:
    """Eight machines that differ in load and memory, and 60 jobs that start within ten minutes. `decides` is in
    `FLEETS`. Speed decides if speeds differ, processors and memory are plentiful, and the load average misleads because
    it counts processes that wait for a disk. Load decides if speeds are equal and processors few. Memory decides if
    jobs depend on cached files, which no profile shows, and everything else is plentiful."""
    rng = Random(seed)  # noqa: S311 - a simulation
    speed, load, memory = (decides == figure for figure in FLEETS)
    machines = [
        Machine(
            f"host{number}",
            cores=2 if load else 32,
            speed=rng.choice(SPEEDS) if speed else 1.0,
            memory=rng.randrange(1, 6) * GIGABYTE * (1 if memory else 10),
            others=rng.random() * (6 if load else 20),
            blocked=32 + rng.random() * 100 if speed else 0,
        )
        for number in range(8)
    ]
    at = [rng.randrange(600) * SECOND for _ in range(60)]
    jobs = [
        SimulatedJob(
            f"job{number}",
            "reader" if memory else "heavy",
            start,
            cpu=1,
            memory=60_000_000,
            work=60,
            greedy=True,
            cache=900_000_000 if memory else 0,
        )
        for number, start in enumerate(at)
    ]
    return machines, jobs

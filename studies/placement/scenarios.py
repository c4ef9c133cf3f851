"""What the study of placement plays: the paper's Figure 3, and a mixed batch on unlike machines."""

from __future__ import annotations

from random import Random
from typing import Final

from studies.placement.simulation import Machine, SimulatedJob
from zscout.types import SECOND, HostName, Ns

GIGABYTE: Final = 1_000_000_000
NETS: Final = 3
NET_SIZE: Final = 4
"""Components of one Place Sensor Net: as many as Scouts in it."""
STAGGER: Final[Ns] = 60 * SECOND
"""From one Place Sensor Net to the next in scenario (b)."""
WATCHED: Final[Ns] = 300 * SECOND
"""How long the load curves of the sensor nets are followed."""
BATCH_SPAN: Final[Ns] = 120 * SECOND
"""The jobs of the mixed batch come at random within it."""
SPEEDS: Final = (1.0, 2.0, 4.0)
MEMORIES: Final = (1 * GIGABYTE, 4 * GIGABYTE, 2 * GIGABYTE)


def workstations() -> list[Machine]:
    """Three of a kind, with nothing to do."""
    return [Machine(f"workstation{number}") for number in range(1, NETS + 1)]


def sensor_nets(stagger: Ns = 0) -> list[SimulatedJob]:
    """Three Place Sensor Nets, each `stagger` ns after the one before; their components run on."""
    return [
        SimulatedJob(f"net{net}-{number}", "place_sensor_net", SECOND + net * stagger, cpu=0.5)
        for net in range(NETS)
        for number in range(NET_SIZE)
    ]


def unlike_machines(seed: int) -> list[Machine]:
    """Speeds 1, 2, 4 with 1, 4, 2 GB. The seed deals out names, so that ties, broken by name, favour none."""
    names: list[HostName] = ["ash", "birch", "cedar"]
    Random(seed).shuffle(names)  # noqa: S311 - a simulation
    return [
        Machine(name, speed=speed, memory=memory) for name, speed, memory in zip(names, SPEEDS, MEMORIES, strict=True)
    ]


def mixed_batch(seed: int) -> list[SimulatedJob]:
    """12 that compute, 6 that fill the memory besides, 12 light ones; they come at random in two minutes."""
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
"""Fleets of unlike machines in which this one figure decides how well a component runs."""


def deciding_fleet(decides: str, seed: int) -> tuple[list[Machine], list[SimulatedJob]]:
    """Eight machines that differ in load and memory, and 60 jobs that come and go within ten minutes.

    `decides`: one of `FLEETS`. Speed decides where speeds differ, processors and memory are plenty, and the load
    average misleads: it is of processes that wait for a disk. Load decides where speeds are equal and processors few.
    Memory decides where jobs live by files in the cache, which no profile shows, and all else is plenty."""
    rng = Random(seed)  # noqa: S311 - a simulation
    speed, load, memory = (decides == one for one in FLEETS)
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

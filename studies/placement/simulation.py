"""Simulated machines under the real balancer, for the study of placement and its tests.

A machine shares its processors evenly among its components, reports once a second, each at its own moment, and has a
one-minute load average by the kernel's formula. If its memory is too small for its components, all of them slow down.
Time advances in steps of a tenth of a second.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from random import Random
from typing import Final

from zscout.messages import ComponentUse, LoadReport
from zscout.placement.balancer import LOAD_TIME, Balancer
from zscout.placement.model import REPORT_EVERY, THRASHING, RankQuery
from zscout.types import SECOND, ComponentId, HostName, Kind, Metric, Ns, Policy

STEP: Final[Ns] = SECOND // 10
GAIN: Final = 1 - math.exp(-STEP / LOAD_TIME)
"""Weight of the present demand in the load average after one step."""
START_TIME: Final[Ns] = SECOND // 2
"""From the order to start a component until it wants a processor, in ns."""
LONGEST: Final[Ns] = 24 * 3600 * SECOND


@dataclass(frozen=True, slots=True)
class Machine:
    """`memory` in bytes; `others`: other load, in cores; `blocked` processes wait for a disk: they count in the load
    average, as on Linux, and use no processor."""

    name: HostName
    cores: float = 1.0
    speed: float = 1.0
    memory: int = 4_000_000_000
    others: float = 0.0
    blocked: float = 0.0


@dataclass(frozen=True, slots=True)
class SimulatedJob:
    """A component that starts at `at` ns and needs `memory` bytes. It reads `cache` bytes of files repeatedly; they are
    not its own memory, but it is slow where they do not fit into the file cache. It works at a constant pace and wants
    `cpu` cores of speed 1.0, so fewer on a faster machine. If `greedy`, it computes all the time in `cpu` threads, and
    does more on a faster machine. It ends after `work` core-seconds at speed 1.0; None: never."""

    component: ComponentId
    kind: Kind
    at: Ns
    cpu: float
    memory: int = 64_000_000
    work: float | None = None
    greedy: bool = False
    cache: int = 0

    def wants(self, speed: float) -> float:
        return self.cpu if self.greedy else self.cpu / speed


@dataclass(slots=True)
class PlacementOutcome:
    """The host and end of each component, and each machine's load average once a second."""

    placed: dict[ComponentId, HostName] = field(default_factory=dict)
    placed_at: dict[ComponentId, Ns] = field(default_factory=dict)
    ends: dict[ComponentId, Ns] = field(default_factory=dict)
    curves: dict[HostName, list[tuple[Ns, float]]] = field(default_factory=dict)
    metrics: list[Metric] = field(default_factory=list)
    """The metric that each placement used, in order."""

    def spread(self) -> int:
        """Difference between the largest and the smallest number of components on a host."""
        counts = self.counts()
        return max(counts) - min(counts)

    def counts(self) -> list[int]:
        """Number of components placed on each host, in the order of `curves`."""
        return [list(self.placed.values()).count(host) for host in self.curves]

    def apart(self) -> float:
        """Distance of the load curves: highest minus lowest load average, mean over the run."""
        moments = list(zip(*(curve for curve in self.curves.values()), strict=True))
        gaps = [max(load for _, load in now) - min(load for _, load in now) for now in moments]
        return sum(gaps) / len(gaps) if gaps else 0.0


@dataclass(slots=True)
class _Running:
    job: SimulatedJob
    begins: Ns
    done: float = 0.0


@dataclass(slots=True)
class _Host:
    machine: Machine
    phase: Ns
    """When in each second it reports."""
    running: list[_Running] = field(default_factory=list)
    load: float = 0.0
    number: int = 0

    def step(self, now: Ns) -> list[_Running]:
        """Advance by one step. Return the components that ended in it."""
        speed = self.machine.speed
        share, wanting = self.share(now)
        self.load += (wanting + self.machine.blocked - self.load) * GAIN
        ended = []
        for component in self.running:
            if component.begins <= now:
                component.done += component.job.wants(speed) * speed * share * STEP / SECOND
                if component.job.work is not None and component.done >= component.job.work:
                    ended.append(component)
        for component in ended:
            self.running.remove(component)
        return ended

    def share(self, now: Ns) -> tuple[float, float]:
        """The part of its demand that each component gets, and the demand of all in cores."""
        active = [component.job for component in self.running if component.begins <= now]
        wanting = self.machine.others + sum(job.wants(self.machine.speed) for job in active)
        memory = sum(job.memory + job.cache for job in active)
        fits = 1.0 if memory <= self.machine.memory else max(THRASHING, (self.machine.memory / memory) ** 2)
        return min(1.0, self.machine.cores / wanting if wanting else 1.0) * fits, wanting

    def report(self, now: Ns) -> LoadReport:
        machine = self.machine
        share, wanting = self.share(now)
        self.number += 1
        active = [component.job for component in self.running if component.begins <= now]
        return LoadReport(
            host=machine.name,
            number=self.number,
            cores=machine.cores,
            load_average=(self.load, self.load, self.load),
            cpu=100 * min(1.0, wanting / machine.cores),
            memory_available=max(0, machine.memory - sum(job.memory for job in active)),
            memory_total=machine.memory,
            speed=machine.speed,
            components=tuple(
                ComponentUse(job.component, job.kind, 1, job.wants(machine.speed) * share, job.memory, served=share)
                for job in active
            ),
        )


def simulate(
    machines: Sequence[Machine],
    jobs: Sequence[SimulatedJob],
    *,
    metric: Metric = "composite",
    policy: Policy = "pending",
    seed: int = 0,
    until: Ns | None = None,
    balancer: Balancer | None = None,
) -> PlacementOutcome:
    """Start the jobs at their times, each on the host that the balancer ranks first, and run until `until`, or until
    the last has ended. `balancer` may have learnt in an earlier run; it has no reports yet. Raises ValueError if the
    run would never end, or has not ended after a day."""
    if until is None and any(job.work is None for job in jobs):
        raise ValueError("a job without an end needs `until`")
    rng = Random(seed)  # noqa: S311 - a simulation
    balancer = balancer or Balancer(rng)
    hosts = {
        machine.name: _Host(machine, rng.randrange(REPORT_EVERY // STEP) * STEP, load=machine.others + machine.blocked)
        for machine in machines
    }
    outcome = PlacementOutcome(curves={name: [] for name in hosts})
    for host in hosts.values():
        balancer.reported(0, host.report(0))
    waiting = sorted(jobs, key=lambda job: job.at, reverse=True)
    now: Ns = 0
    while until is None or now < until:
        if now > LONGEST:
            raise ValueError("the jobs have not ended after a day")
        for host in hosts.values():
            if now % REPORT_EVERY == host.phase:
                balancer.reported(now, host.report(now))
            if now % SECOND == 0:
                outcome.curves[host.machine.name].append((now, host.load))
        due: dict[ComponentId, SimulatedJob] = {}
        while waiting and waiting[-1].at <= now:
            job = waiting.pop()
            due[job.component] = job
        for component in balancer.heaviest_first((job.component, job.kind) for job in due.values()):
            job = due[component]
            ranking = balancer.rank(now, RankQuery(job.kind, metric, policy))
            chosen = ranking.hosts[0].host
            balancer.placed(now, component, job.kind, chosen)
            hosts[chosen].running.append(_Running(job, now + START_TIME))
            outcome.placed[component] = chosen
            outcome.placed_at[component] = now
            outcome.metrics.append(ranking.metric)
        for host in hosts.values():
            for ended in host.step(now):
                outcome.ends[ended.job.component] = now + STEP
                balancer.gone(ended.job.component)
        now += STEP
        if until is None and not waiting and not any(host.running for host in hosts.values()):
            break
    return outcome

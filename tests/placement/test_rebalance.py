"""Rebalancing evens out what is uneven, and then leaves it alone, whatever the noise."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from random import Random

import pytest
from msgspec.structs import replace

from studies.placement.simulation import Machine, SimulatedJob, _Host, _Running
from zscout.config.fleet import PlacementPolicy
from zscout.messages import ComponentSpec, ComponentView, DrainHost, MoveComponent, StartComponent, StopComponent
from zscout.placement.balancer import LOAD_TIME, Balancer
from zscout.placement.events import (
    ComponentsListed,
    HostCommand,
    HostJoined,
    MoveAnswered,
    PlacerEffect,
    PlacerEvent,
    PlacerWakeAt,
    StartAnswered,
    StopAnswered,
    TokenAppeared,
    TokenVanished,
)
from zscout.placement.model import REPORT_EVERY, Profile
from zscout.placement.placer import Placer
from zscout.types import SECOND, ComponentId, HostName, Ns

RULES = PlacementPolicy(rebalance=True)
FULL = Profile(1.0, 64_000_000, 9)
"""It computes all the time, in one thread."""
SHOWN = 1 - math.exp(-REPORT_EVERY / LOAD_TIME)
"""Of what wants a processor, how much one report more brings into the load average."""
Moved = tuple[Ns, ComponentId, HostName, HostName]


class Fleet:
    """Simulated machines under the placer. What runs on each at first has run there for long.

    `noise`: by which share at most each load average is told wrong."""

    def __init__(
        self,
        machines: Sequence[Machine],
        running: Mapping[HostName, Sequence[str]],
        *,
        rules: PlacementPolicy = RULES,
        noise: float = 0.0,
        seed: int = 0,
        movable: bool = True,
        labels: tuple[str, ...] = (),
    ) -> None:
        """A component's kind is its name up to the first digit; its profile is in `profiles`."""
        self.rng, self.noise = Random(seed), noise  # noqa: S311
        self.balancer = Balancer(Random(seed))  # noqa: S311
        self.placer = Placer(self.balancer, 1, rules)
        self.hosts = {one.name: _Host(one, 0) for one in machines}
        self.labels = {one.name: (one.name,) for one in machines}
        self.now: Ns = 0
        self.wake: Ns | None = None
        self.moves: list[Moved] = []
        self.where: dict[ComponentId, HostName] = {}
        self.balancer.profiles |= {"full": FULL, "light": Profile(0.1, 64_000_000, 9)}
        events: list[PlacerEvent] = []
        for name, components in running.items():
            host = self.hosts[name]
            seen = []
            for component in components:
                kind = component.rstrip("0123456789")
                profile = self.balancer.profile(kind)
                job = SimulatedJob(component, kind, 0, profile.cpu, profile.memory, greedy=True)
                host.running.append(_Running(job, 0))
                self.where[component] = name
                spec = ComponentSpec(kind, labels=list(labels))
                seen.append(ComponentView(component, 1001, name, spec, "running", movable))
                events.append(TokenAppeared(component, 1001, name))
            host.load = host.share(0)[1]
            events.insert(0, ComponentsListed(name, tuple(seen)))
        self.report()
        self.send(*(HostJoined(name) for name in self.hosts), *events)

    def report(self) -> None:
        for name, host in self.hosts.items():
            report = host.report(self.now)
            load = report.load_average[0] * (1 + self.noise * (2 * self.rng.random() - 1))
            told = replace(report, load_average=(load, load, load), labels=self.labels[name])
            self.balancer.reported(self.now, told)

    def send(self, *events: PlacerEvent) -> None:
        for effect in self.placer.handle(self.now, *events):
            self.carry_out(effect)

    def carry_out(self, effect: PlacerEffect) -> None:
        match effect:
            case HostCommand(host, StartComponent(component, incarnation, _, standby)):
                assert standby
                self.send(StartAnswered(component, incarnation, host, "ok", movable=True))
            case HostCommand(host, MoveComponent(component, incarnation, to, to_incarnation)):
                [one] = [one for one in self.hosts[host].running if one.job.component == component]
                self.hosts[host].running.remove(one)
                self.hosts[to].running.append(one)
                self.where[component] = to
                self.moves.append((self.now, component, host, to))
                answer = MoveAnswered(component, incarnation, host, "moved", dead=1e-9)
                appeared = TokenAppeared(component, to_incarnation, to)
                self.send(answer, appeared, TokenVanished(component, incarnation, host))
            case HostCommand(host, StopComponent(component, incarnation)):
                self.send(StopAnswered(component, incarnation or 0, host, done=True))
            case PlacerWakeAt(at):
                self.wake = at
            case _:
                pass

    def run(self, until: Ns) -> None:
        while self.now < until:
            self.now += REPORT_EVERY
            for host in self.hosts.values():
                host.load += (host.share(self.now)[1] - host.load) * SHOWN
            self.report()
            if self.wake is not None and self.wake <= self.now:
                self.wake = None
                self.send()

    def counts(self) -> list[int]:
        return [list(self.where.values()).count(host) for host in self.hosts]


def equal(count: int, cores: float = 1.0) -> list[Machine]:
    return [Machine(f"h{number}", cores=cores) for number in range(count)]


def names(kind: str, count: int, first: int = 0) -> list[ComponentId]:
    return [f"{kind}{number}" for number in range(first, first + count)]


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_all_on_one_of_three_equal_hosts_evens_out_and_stays_quiet(noise: float, seed: int) -> None:
    fleet = Fleet(equal(3), {"h0": names("full", 6)}, noise=noise, seed=seed)
    fleet.run(900 * SECOND)
    assert fleet.counts() == [2, 2, 2]
    assert len({component for _, component, _, _ in fleet.moves}) == len(fleet.moves) == 4
    for (at, _, *hosts), (next_at, _, *next_hosts) in pairwise(fleet.moves):
        assert next_at > at
        if set(hosts) & set(next_hosts):
            assert next_at - at >= RULES.rest + RULES.steady
    fleet.run(1800 * SECOND)
    assert len(fleet.moves) == 4


@pytest.mark.parametrize("seed", range(2))
def test_figures_that_are_far_from_true_keep_components_where_they_are_rather_than_move_them_to_and_fro(
    seed: int,
) -> None:
    fleet = Fleet(equal(3), {"h0": names("full", 6)}, noise=0.3, seed=seed)
    fleet.run(1800 * SECOND)
    assert 1 <= len(fleet.moves) <= 4
    assert all(source == "h0" for _, _, source, _ in fleet.moves)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("start", [(1, 1), (2, 1), (5, 5), (3, 3, 3), (7, 6, 6)])
def test_hosts_that_are_even_are_left_alone_whatever_the_noise(start: tuple[int, ...], seed: int) -> None:
    running, first = {}, 0
    for number, count in enumerate(start):
        running[f"h{number}"] = names("full", count, first)
        first += count
    fleet = Fleet(equal(len(start)), running, noise=0.2, seed=seed)
    fleet.run(400 * SECOND)
    assert fleet.moves == []


def test_who_computes_moves_to_the_faster_host_once_that_is_free() -> None:
    machines = [Machine("slow"), Machine("fast", speed=4.0)]
    fleet = Fleet(machines, {"slow": names("full", 2)}, noise=0.1)
    fleet.run(900 * SECOND)
    # On the fast one each has 2.0, even with both there.
    assert fleet.counts() == [0, 2]
    assert len(fleet.moves) == 2


@pytest.mark.parametrize(("speed", "moves"), [(1.2, 0), (1.4, 1)])
def test_a_small_gain_is_not_worth_a_move(speed: float, moves: int) -> None:
    fleet = Fleet([Machine("h0"), Machine("h1", speed=speed)], {"h0": names("full", 1)})
    fleet.run(300 * SECOND)
    assert len(fleet.moves) == moves


def test_nobody_moves_where_more_is_lost_than_won() -> None:
    # It would have a half of h1 instead of a third of h0, and ten light ones there would have half of theirs.
    running = {"h0": names("full", 3), "h1": names("light", 10)}
    fleet = Fleet(equal(2), running)
    fleet.run(600 * SECOND)
    assert fleet.moves == []
    alone = Fleet(equal(2), {"h0": names("full", 3), "h1": names("light", 1)})
    alone.run(600 * SECOND)
    assert len(alone.moves) == 1


@pytest.mark.parametrize("why", ["off", "not movable", "label", "drained", "settled in lately"])
def test_nothing_moves_that_may_not(why: str) -> None:
    fleet = Fleet(
        equal(2),
        {"h0": names("full", 4)},
        rules=PlacementPolicy(rebalance=why != "off"),
        movable=why != "not movable",
        labels=("h0",) if why == "label" else (),
    )
    if why == "drained":
        fleet.send(DrainHost("h1"))
    fleet.run((RULES.rest if why == "settled in lately" else 300 * SECOND) - SECOND)
    assert fleet.moves == []


def test_a_moment_of_load_moves_nobody() -> None:
    fleet = Fleet(equal(2), {"h0": names("full", 1), "h1": []})
    fleet.run(100 * SECOND)
    host = fleet.hosts["h0"]
    for _ in range(10):
        host.load = 3.0
        fleet.run(fleet.now + RULES.steady - 2 * SECOND)
        host.load = 1.0
        fleet.run(fleet.now + 2 * SECOND)
    assert fleet.moves == []
    for _ in range(15):
        host.load = 3.0
        fleet.run(fleet.now + SECOND)
    assert len(fleet.moves) == 1

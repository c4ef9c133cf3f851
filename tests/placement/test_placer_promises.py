"""What the placer promises, in a world in which everything goes wrong that can; then all comes to rest."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from random import Random

import pytest
from msgspec.structs import replace

from tests.placement.placer_hosts import STANDS_BY
from tests.placement.placer_world import RULES, World
from tests.scheduling.seeds import in_parts
from tests.thorough import times
from zscout.messages import (
    ComponentSpec,
    DrainHost,
    EndComponent,
    MigrateComponent,
    PlaceComponent,
    Restart,
    UncordonHost,
)
from zscout.types import SECOND, HostName

NAMES = ("a", "b", "c", "d")
OPS = (
    *["time"] * 10, *["move"] * 6, *["place"] * 2, *["crash"] * 2, "stop", "complete", "drain", *["uncordon"] * 3,
    *["dies", "is cut off", "freezes"], *["is back"] * 3, "leader",
)  # fmt: skip
POLICIES: tuple[Restart, ...] = ("never", *("on_failure", "always") * 3)
SETTLING = 60 * SECOND
"""Longer than any back-off, grace, look or time to stand by."""
TRIES = 1_000
"""Starts in a row, in runs that are to give nothing up."""
FINAL = {"running", "waiting", "ended", "given_up"}


class Chaos:
    """A run of operations, and what must hold when all has come to rest."""

    def __init__(self, seed: int) -> None:
        self.rng = Random(seed)  # noqa: S311
        self.patient = seed % 2 == 0
        rules = replace(RULES, restarts=TRIES) if self.patient else RULES
        self.world = World(seed, self.rng.choice([1, 2, 3, 3, 4]), rules)
        self.world.slow = self.rng.choice([SECOND // 20, SECOND // 4, SECOND, 3 * SECOND])
        self.world.loss = self.rng.choice([0, 0, 0.05, 0.3])
        self.asked: dict[str, bool] = {}
        """Whether each component is to run, by what was asked for last and not refused."""

    def do(self, op: str) -> None:
        world, rng = self.world, self.rng
        name = rng.choice(NAMES)
        host = world.hosts[rng.choice(list(world.hosts))]
        running = [(there, one) for each in NAMES for there, one in world.live(each) if one.token]
        if op == "move" and running:
            name = rng.choice(running)[1].component
        match op:
            case "place":
                self.place(name)
            case "stop":
                world.send(EndComponent(name))
                self.asked[name] = False
            case "move":
                world.send(MigrateComponent(name, rng.choice([None, None, host.name])))
            case "drain":
                world.send(DrainHost(host.name))
            case "uncordon":
                world.send(UncordonHost(host.name))
            case "crash" | "complete" if running:
                there, one = rng.choice(running)
                world.end(there, one, "failed" if op == "crash" else "completed")
            case "dies" | "is cut off" | "freezes":
                world.go(host, op)
            case "is back":
                world.come(host)
            case "leader":
                world.new_leader()
            case _:
                world.run(world.now + rng.randrange(4 * SECOND))

    def place(self, name: str) -> None:
        policy: Restart = self.rng.choice(POLICIES)
        some = self.rng.sample(list(self.world.hosts), 1)
        hosts: list[HostName] | None = self.rng.choice([*[None] * 6, some])
        refused = len(self.world.refusals)
        self.world.send(PlaceComponent(name, ComponentSpec("job", restart=policy, hosts=hosts)))
        if len(self.world.refusals) == refused:
            self.asked[name] = True

    def settle(self) -> None:
        """Nothing fails any more; some hosts stay away."""
        world = self.world
        world.loss = world.failing = 0
        for host in world.hosts.values():
            if host.up or self.rng.random() < 0.7:
                world.come(host)
        world.run(world.now + SETTLING + STANDS_BY)

    def check(self) -> None:
        world = self.world
        records = world.placer.components
        assert records == world.published
        assert world.alive == {host.name for host in world.hosts.values() if host.there}
        for name in NAMES:
            record, live = records.get(name), world.live(name)
            found = [(host.name, one.incarnation, one.phase) for host, one in live]
            assert len(live) <= 1, f"{name} lives {found}"
            if record is None:
                assert not live
                continue
            assert record.state in FINAL, record
            assert record.wanted == self.asked.get(name, record.wanted), record
            assert record.to is None
            assert bool(record.host) == (record.state == "running"), record
            if record.state == "running":
                assert found == [(record.host, record.incarnation, "running")], record
                assert record.wanted, record
                continue
            assert not live, (found, record)
            fit = world.alive - world.balancer.cordoned
            fit &= set(record.spec.hosts) if record.spec.hosts is not None else fit
            if record.state == "waiting":
                assert not fit, record
            elif record.wanted and record.state == "given_up":
                assert record.spec.restart == "never" or not self.patient, record
            elif record.wanted:
                assert record.spec.restart != "always", record
        self.check_drained()

    def check_drained(self) -> None:
        """What could leave a drained host has left it."""
        world = self.world
        usable = world.alive - world.balancer.cordoned
        for record in world.placer.components.values():
            if record.host in world.balancer.cordoned:
                assert not (usable & set(record.spec.hosts or usable)), record


def run(seed: int) -> World:
    chaos = Chaos(seed)
    for name in NAMES:
        chaos.place(name)
    chaos.do("time")
    for _ in range(chaos.rng.randint(5, 50)):
        chaos.do(chaos.rng.choice(OPS))
    chaos.settle()
    chaos.check()
    return chaos.world


@pytest.mark.parametrize("seeds", in_parts(range(times(400)), quick=100, size=300))
def test_whatever_happens_one_incarnation_of_each_component_runs_in_the_end(seeds: Sequence[int]) -> None:
    for seed in seeds:
        try:
            run(seed)
        except Exception as error:
            raise AssertionError(f"seed {seed}: {error}") from error


def test_in_these_runs_everything_does_happen() -> None:
    heard: Counter[str] = Counter()
    for seed in range(100):
        heard += run(seed).heard
    for result in ("ok", "refused", "failed", "unknown"):
        assert heard[f"StartAnswered {result}"] > 50, heard
    for result in ("moved", "refused", "unknown"):
        assert heard[f"MoveAnswered {result}"] > 10, heard
    for event in ("TokenVanished", "HostLost", "ComponentsListed", "Inherited", "DrainHost"):
        assert heard[event] > 50, heard

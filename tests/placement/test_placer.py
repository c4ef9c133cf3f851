"""The placer's limits, and what it makes of nonsense."""

from __future__ import annotations

from random import Random
from typing import Final

import pytest

from tests.placement.test_balancer import report
from tests.thorough import times
from zscout.messages import (
    ComponentSpec,
    ComponentView,
    DrainHost,
    EndComponent,
    MigrateComponent,
    PlaceComponent,
    Placement,
    Restart,
    StartComponent,
    UncordonHost,
)
from zscout.placement import state
from zscout.placement.balancer import Balancer, RankingCache
from zscout.placement.events import (
    ComponentChanged,
    ComponentsListed,
    HostCommand,
    HostJoined,
    HostLost,
    Inherited,
    MoveAnswered,
    PlacementRefused,
    PlacerEffect,
    PlacerEvent,
    PlacerWakeAt,
    StartAnswered,
    StopAnswered,
    TokenAppeared,
    TokenVanished,
)
from zscout.placement.lifecycle import AT_ONCE
from zscout.placement.model import RankQuery
from zscout.placement.placer import Placer
from zscout.placement.state import RETENTION
from zscout.types import SECOND, Policy

RESTARTS: Final[tuple[Restart, ...]] = ("never", "on_failure", "always")


def fleet(hosts: int = 2, counter: int = 1) -> tuple[Placer, Balancer]:
    """Hosts h0, h1 and so on, of speed 1, 2 and so on, which are there and have reported."""
    balancer = Balancer(Random(0))  # noqa: S311
    for number in range(hosts):
        balancer.reported(0, report(f"h{number}", speed=float(number + 1)))
    placer = Placer(balancer, counter)
    placer.handle(0, *(HostJoined(f"h{number}") for number in range(hosts)))
    return placer, balancer


def starts(effects: list[PlacerEffect]) -> list[tuple[str, StartComponent]]:
    return [
        (one.host, one.operation)
        for one in effects
        if isinstance(one, HostCommand) and isinstance(one.operation, StartComponent)
    ]


def changes(effects: list[PlacerEffect]) -> list[tuple[str, str]]:
    return [
        (one.component, one.placement.state if one.placement is not None else "forgotten")
        for one in effects
        if isinstance(one, ComponentChanged)
    ]


def test_what_has_ended_is_forgotten_after_a_while_and_its_incarnations_are_not_used_again() -> None:
    (placer, balancer), spec = fleet(), ComponentSpec("job")
    [(host, first)] = starts(placer.handle(0, PlaceComponent("a", spec)))
    ended = ComponentsListed(host, (ComponentView("a", first.incarnation, host, spec, "ended", ended="completed"),))
    assert changes(placer.handle(SECOND, ended)) == [("a", "ended")]
    assert ("a", "forgotten") not in changes(placer.handle(RETENTION))
    assert placer.handle(SECOND + RETENTION) == [ComponentChanged("a", None), PlacerWakeAt(None)]
    assert placer.components == {}
    now = SECOND + RETENTION
    balancer.reported(now, report("h0", 2))
    again = starts(placer.handle(now, PlaceComponent("a", spec), PlaceComponent("b", spec)))
    assert {one.incarnation for _, one in again} == {first.incarnation + 1}


def test_limits_hold_and_what_has_ended_makes_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state, "MAX_COMPONENTS", 4)
    monkeypatch.setattr(state, "MAX_ENDED", 2)
    (placer, _), spec = fleet(), ComponentSpec("job", hosts=["nowhere"])
    placer.handle(0, *(PlaceComponent(name, spec) for name in "abcd"))
    assert [type(one) for one in placer.handle(0, PlaceComponent("e", spec))] == [PlacementRefused]
    # Three end, two of them are remembered; and those two make room for others.
    effects = placer.handle(1, *(EndComponent(name) for name in "abc"))
    assert changes(effects) == [("a", "forgotten"), ("b", "ended"), ("c", "ended")]
    effects = placer.handle(2, *(PlaceComponent(name, spec) for name in "xyz"))
    assert changes(effects)[:3] == [("x", "waiting"), ("b", "forgotten"), ("y", "waiting")]
    assert set(placer.components) == {"d", "x", "y", "z"}


def test_many_are_placed_a_part_at_a_time_and_all_of_them() -> None:
    (placer, _), count = fleet(5), 2 * AT_ONCE + 10
    asked = [PlaceComponent(f"c{number}", ComponentSpec("job")) for number in range(count)]
    effects, found, now = placer.handle(0, *asked), [], 0
    while now < SECOND:
        batch = starts(effects)
        assert len(batch) <= AT_ONCE
        found += batch
        [wake] = [one.at for one in effects if isinstance(one, PlacerWakeAt)]
        assert wake is not None
        now = wake
        effects = placer.handle(now)
    assert len({one.component for _, one in found}) == len(found) == count


def test_time_does_not_go_backwards() -> None:
    placer, _ = fleet()
    placer.handle(SECOND)
    with pytest.raises(ValueError, match="time went backwards"):
        placer.handle(0)


@pytest.mark.parametrize("policy", ["least_loaded", "pending"])
@pytest.mark.parametrize("memory", [0, 7_500_000_000])
def test_rankings_that_are_mended_are_those_of_the_balancer(policy: Policy, memory: int) -> None:
    balancer, rng = Balancer(Random(0)), Random(1)  # noqa: S311
    for number in range(20):
        balancer.reported(0, report(f"h{number}", load=rng.random(), memory_available=8_000_000_000))
    balancer.cordoned.add("h3")
    ranks = RankingCache(balancer)
    some = frozenset(f"h{number}" for number in range(10))
    questions = [RankQuery("job", "composite", policy, memory=memory, hosts=hosts) for hosts in (None, some)]
    for number in range(200):
        name, host = f"c{rng.randrange(30)}", f"h{rng.randrange(20)}"
        before = next((there for there, one in placed(balancer) if one == name), None)
        if rng.random() < 0.7:
            balancer.placed(0, name, "job", host)
            ranks.invalidate(host)
        else:
            balancer.gone(name)
        ranks.invalidate(before) if before is not None else None
        asked = questions[number % 2]
        assert ranks.rank(asked) == balancer.rank(0, asked)


def placed(balancer: Balancer) -> list[tuple[str, str]]:
    return [(one.host, name) for name, one in balancer._placed.items()]


def test_what_nobody_would_send_does_no_harm() -> None:
    """Events at random, of a world that makes no sense: nothing is raised, and what is gone is not asked."""
    for seed in range(times(80)):
        rng = Random(seed)  # noqa: S311
        (placer, balancer), now, alive = fleet(3, counter=rng.randint(1, 3)), 0, {"h0", "h1", "h2"}
        for _ in range(60):
            now += rng.choice([0, 0, SECOND // 10, SECOND, 20 * SECOND])
            for host in rng.sample(["h0", "h1", "h2"], 2):
                balancer.reported(now, report(host, now + 1))
            event = nonsense(rng)
            if isinstance(event, HostJoined):
                alive.add(event.host)
            elif isinstance(event, HostLost):
                alive.discard(event.host)
            effects = placer.handle(now, event)
            for effect in effects:
                if isinstance(effect, HostCommand):
                    assert effect.host in alive, (seed, effect)
            for record in placer.components.values():
                assert (record.to is not None) == (record.state == "moving")


def nonsense(rng: Random) -> PlacerEvent:
    name, host = rng.choice("ab"), rng.choice(["h0", "h1", "h2", "h9"])
    spec = ComponentSpec("job", restart=rng.choice(RESTARTS))
    number = rng.choice([1001, 1002, 1003, 2001, 10**15])
    lives = {"phase": rng.choice(["running", "starting", "standby"])}
    over = {"phase": "ended", "ended": rng.choice(["completed", "failed", "moved", "superseded", "stopped"])}
    seen = ComponentView(name, number, host, spec, movable=True, **rng.choice([lives, over]))  # type: ignore[arg-type]
    result = rng.choice(["ok", "ok", "refused", "failed", "unknown"])
    moved = rng.choice(["moved", "refused", "unknown"])
    state = rng.choice(["waiting", "starting", "running", "moving", "backing_off", "stopping", "ended"])
    wanted = rng.random() < 0.5
    record = Placement(name, spec, state, number, rng.choice([host, None]), wanted=wanted)  # type: ignore[arg-type]
    events: list[PlacerEvent] = [
        PlaceComponent(name, spec),
        EndComponent(name),
        MigrateComponent(name, rng.choice([host, None])),
        DrainHost(host),
        UncordonHost(host),
        StartAnswered(name, number, host, result, movable=True, again=rng.random() < 0.5),  # type: ignore[arg-type]
        StopAnswered(name, number, host, done=rng.random() < 0.5),
        MoveAnswered(name, number, host, moved),  # type: ignore[arg-type]
        TokenAppeared(name, number, host),
        TokenVanished(name, number, host),
        ComponentsListed(host, (seen,), rng.choice([name, None])),
        ComponentsListed(host, (), rng.choice([name, None])),
        HostJoined(host),
        HostLost(host),
        Inherited((record,), frozenset({host})),
    ]
    return rng.choice(events)

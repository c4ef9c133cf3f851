"""The placer's limits, and what it makes of nonsense."""

from __future__ import annotations

from random import Random
from typing import Final

import pytest

from tests.balancing.test_balancer import report
from tests.thorough import times
from zscout.balancing.balancer import Balancer
from zscout.balancing.model import SECOND, Policy, Question, Requirements
from zscout.placing import ground
from zscout.placing.choosing import AT_ONCE
from zscout.placing.events import (
    Appeared,
    Changed,
    DrainAsked,
    Effect,
    Event,
    Forgotten,
    HostLost,
    HostSeen,
    HostTold,
    Inherited,
    Look,
    Move,
    MoveAnswered,
    MoveAsked,
    PlaceAsked,
    Record,
    Refused,
    Restart,
    Seen,
    Spec,
    Start,
    StartAnswered,
    Stop,
    StopAnswered,
    StopAsked,
    Tick,
    UncordonAsked,
    Vanished,
    WakeAt,
)
from zscout.placing.ground import REMEMBERED
from zscout.placing.placer import Placer
from zscout.placing.ranks import Ranks

RESTARTS: Final[tuple[Restart, ...]] = ("never", "on_failure", "always")


def fleet(hosts: int = 2, counter: int = 1) -> Placer:
    """Hosts h0, h1 and so on, of speed 1, 2 and so on, which are there and have reported."""
    balancer = Balancer(Random(0))  # noqa: S311
    for number in range(hosts):
        balancer.reported(0, report(f"h{number}", speed=float(number + 1)))
    placer = Placer(balancer, counter)
    placer.handle(0, *(HostSeen(f"h{number}") for number in range(hosts)))
    return placer


def starts(effects: list[Effect]) -> list[Start]:
    return [one for one in effects if isinstance(one, Start)]


def test_what_has_ended_is_forgotten_after_a_while_and_its_incarnations_are_not_used_again() -> None:
    placer, spec = fleet(), Spec("job")
    [first] = starts(placer.handle(0, PlaceAsked("a", spec)))
    ended = HostTold(first.host, (Seen("a", first.incarnation, spec, running=False, ended="completed"),))
    assert placer.handle(SECOND, ended)[0] == Changed("a")
    assert Forgotten("a") not in placer.handle(REMEMBERED, Tick())
    assert placer.handle(SECOND + REMEMBERED, Tick()) == [Forgotten("a"), WakeAt(None)]
    assert placer.records == {}
    now = SECOND + REMEMBERED
    placer.balancer.reported(now, report("h0", 2))
    again = starts(placer.handle(now, PlaceAsked("a", spec), PlaceAsked("b", spec)))
    assert {one.incarnation for one in again} == {first.incarnation + 1}


def test_limits_hold_and_what_has_ended_makes_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ground, "MAX_COMPONENTS", 4)
    monkeypatch.setattr(ground, "MAX_ENDED", 2)
    placer, spec = fleet(), Spec("job", hosts=frozenset({"nowhere"}))
    placer.handle(0, *(PlaceAsked(name, spec) for name in "abcd"))
    assert [type(one) for one in placer.handle(0, PlaceAsked("e", spec))] == [Refused]
    # Three end, two of them are remembered; and those two make room for others.
    effects = placer.handle(1, *(StopAsked(name) for name in "abc"))
    assert effects[:3] == [Forgotten("a"), Changed("b"), Changed("c")]
    assert placer.handle(2, *(PlaceAsked(name, spec) for name in "xyz"))[:3] == [
        Changed("x"),
        Forgotten("b"),
        Changed("y"),
    ]
    assert set(placer.records) == {"d", "x", "y", "z"}


def test_many_are_placed_a_part_at_a_time_and_all_of_them() -> None:
    placer, count = fleet(5), 2 * AT_ONCE + 10
    asked = [PlaceAsked(f"c{number}", Spec("job")) for number in range(count)]
    effects, found, now = placer.handle(0, *asked), [], 0
    while now < SECOND:
        batch = starts(effects)
        assert len(batch) <= AT_ONCE
        found += batch
        [wake] = [one.at for one in effects if isinstance(one, WakeAt)]
        assert wake is not None
        now = wake
        effects = placer.handle(now, Tick())
    assert len({one.component for one in found}) == len(found) == count


def test_time_does_not_go_backwards() -> None:
    placer = fleet()
    placer.handle(SECOND, Tick())
    with pytest.raises(ValueError, match="time went backwards"):
        placer.handle(0, Tick())


@pytest.mark.parametrize("policy", ["least_loaded", "pending"])
@pytest.mark.parametrize("memory", [0, 7_500_000_000])
def test_rankings_that_are_mended_are_those_of_the_balancer(policy: Policy, memory: int) -> None:
    balancer, rng = Balancer(Random(0)), Random(1)  # noqa: S311
    for number in range(20):
        balancer.reported(0, report(f"h{number}", load=rng.random(), memory_available=8_000_000_000))
    balancer.cordoned.add("h3")
    ranks = Ranks(balancer)
    some = frozenset(f"h{number}" for number in range(10))
    questions = [
        Question("job", "composite", policy, Requirements(memory=memory), hosts) for hosts in (None, some)
    ]
    for number in range(200):
        name, host = f"c{rng.randrange(30)}", f"h{rng.randrange(20)}"
        before = next((there for there, one in placed(balancer) if one == name), None)
        if rng.random() < 0.7:
            balancer.placed(0, name, "job", host)
            ranks.changed(host)
        else:
            balancer.gone(name)
        ranks.changed(before)
        asked = questions[number % 2]
        assert ranks.of(asked) == balancer.rank(0, asked)


def placed(balancer: Balancer) -> list[tuple[str, str]]:
    return [(one.host, name) for name, one in balancer._placed.items()]


def test_what_nobody_would_send_does_no_harm() -> None:
    """Events at random, of a world that makes no sense: nothing is raised, and what is gone is not asked."""
    for seed in range(times(80)):
        rng = Random(seed)  # noqa: S311
        placer, now, alive = fleet(3, counter=rng.randint(1, 3)), 0, {"h0", "h1", "h2"}
        for _ in range(60):
            now += rng.choice([0, 0, SECOND // 10, SECOND, 20 * SECOND])
            for host in rng.sample(["h0", "h1", "h2"], 2):
                placer.balancer.reported(now, report(host, now + 1))
            event = nonsense(rng)
            if isinstance(event, HostSeen):
                alive.add(event.host)
            elif isinstance(event, HostLost):
                alive.discard(event.host)
            effects = placer.handle(now, event)
            for effect in effects:
                if isinstance(effect, Start | Stop | Move | Look):
                    assert effect.host in alive, (seed, effect)
            for record in placer.records.values():
                assert (record.to is not None) == (record.state == "moving")


def nonsense(rng: Random) -> Event:
    name, host, spec = (
        rng.choice("ab"),
        rng.choice(["h0", "h1", "h2", "h9"]),
        Spec("job", rng.choice(RESTARTS)),
    )
    number = rng.choice([1001, 1002, 1003, 2001, 10**15])
    lives = rng.choice([{"running": True}, {"running": False}, {"running": False, "standby": True}])
    over = {"running": False, "ended": rng.choice(["completed", "failed", "moved", "superseded", "stopped"])}
    seen = Seen(name, number, spec, movable=True, **rng.choice([lives, over]))  # type: ignore[arg-type]
    result = rng.choice(["ok", "ok", "refused", "failed", "unknown"])
    moved = rng.choice(["moved", "refused", "unknown"])
    state = rng.choice(["waiting", "starting", "running", "moving", "backing_off", "stopping", "ended"])
    record = Record(name, spec, state, number, rng.choice([host, None]), wanted=rng.random() < 0.5)  # type: ignore[arg-type]
    events: list[Event] = [
        PlaceAsked(name, spec),
        StopAsked(name),
        MoveAsked(name, rng.choice([host, None])),
        DrainAsked(host),
        UncordonAsked(host),
        StartAnswered(name, number, host, result, movable=True, again=rng.random() < 0.5),  # type: ignore[arg-type]
        StopAnswered(name, number, host, done=rng.random() < 0.5),
        MoveAnswered(name, number, host, moved),  # type: ignore[arg-type]
        Appeared(name, number, host),
        Vanished(name, number, host),
        HostTold(host, (seen,), rng.choice([name, None])),
        HostTold(host, (), rng.choice([name, None])),
        HostSeen(host),
        HostLost(host),
        Inherited((record,), frozenset({host})),
        Tick(),
    ]
    return rng.choice(events)

"""Replay runs as the live core does, which ticks each second; and a radio is kept only for those who are there then."""

from __future__ import annotations

import itertools
import random
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

import pytest
from msgspec import structs

from tests.scheduling.seeds import in_parts
from tests.scheduling.test_patterns import workload as by_pattern
from tests.scheduling.test_waiting import POLICY, changed, workload
from tests.scheduling.workloads import voter
from tests.thorough import times
from zscout.config.scheduling_policy import FairShares, SchedulingPolicy, StrategyName
from zscout.scheduling.core import Core
from zscout.scheduling.forecast import play_instant
from zscout.scheduling.model import ArcRequest, Event, Granted, HoldEnded, RcJoined, Requested, Tick, WakeAt
from zscout.scheduling.strategies import STRATEGIES
from zscout.simulation.replay import replay
from zscout.simulation.workload import Arrival, Workload, WorkloadRc
from zscout.types import SECOND, ArcId, Ns, Params, RcName

Span = tuple[ArcId, Ns, Ns, tuple[RcName, ...]]


def live(work: Workload, strategy: StrategyName, policy: SchedulingPolicy) -> list[Span]:
    """The holds where the core is driven by its own `WakeAt`."""
    core, granted, found = Core(STRATEGIES[strategy](), policy), dict[ArcId, Granted](), list[Span]()
    left, now, wake = sorted(work.arrivals, key=lambda one: one.at), 0, None
    events: list[Event] = [RcJoined(rc.name, rc.sharable) for rc in work.rcs]
    while events:
        for effect in itertools.chain.from_iterable(play_instant(core, now, events, voter(work))):
            match effect:
                case WakeAt(at):
                    wake = at
                case Granted(arc=arc):
                    granted[arc] = effect
                case HoldEnded(arc=arc, rcs=rcs):
                    found.append((arc, granted.pop(arc).start, now, rcs))
        times = [*(arrival.at for arrival in left[:1]), *([wake] if wake is not None else [])]
        if not (left or granted) or not times:
            break
        now = min(times)
        events = [Requested(arrival.request) for arrival in left if arrival.at == now] or [Tick()]
        left = [arrival for arrival in left if arrival.at > now]
    return sorted(found)


def replayed(work: Workload, strategy: StrategyName, policy: SchedulingPolicy) -> list[Span]:
    played = replay(work, strategy=STRATEGIES[strategy](), policy=policy)
    return sorted((hold.arc, hold.start, hold.end, hold.rcs) for hold in played.holds)


def test_a_radio_is_not_kept_for_those_who_come_later() -> None:
    """`short` is over before `second` is there, and `first`, which comes meanwhile, leaves it room."""

    def asks(at: int, name: str, seconds: int, rate: int | None, *robots: str) -> Arrival:
        needs: dict[RcName, Params] = {rc: {} for rc in robots}
        if rate is not None:
            needs["radio/0"] = {"rate": Fraction(rate)}
        return Arrival(at * SECOND, ArcRequest(name, "h/c", needs, 1, seconds * SECOND))

    rcs = (WorkloadRc("dev/0"), WorkloadRc("radio/0", sharable=True, capacity={"rate": Fraction(6)}))
    work = Workload(
        rcs,
        (
            asks(0, "holds", 170, None, "dev/0"),
            asks(1, "first", 90, 0, "dev/0"),
            asks(1, "second", 100, 2, "dev/0"),
            asks(100, "short", 80, 5),
        ),
    )
    for run in (live, replayed):
        starts = {arc: start // SECOND for arc, start, _, _ in run(work, "adaptive", SchedulingPolicy())}
        assert starts == {"holds": 0, "short": 100, "first": 170, "second": 260}


@pytest.mark.parametrize("seeds", in_parts(range(times(300)), quick=25, size=300))
def test_replay_gives_the_holds_of_the_live_core(seeds: Sequence[int]) -> None:
    for seed in seeds:
        draw = random.Random(seed)  # noqa: S311
        work = by_pattern(seed) if seed % 4 == 0 else workload(seed)
        if seed % 3 == 0:
            work = changed(work, lambda one, draw=draw: structs.replace(one, priority=draw.randint(1, 3)))  # type: ignore[misc]
        fair = None
        if seed % 5 == 0:
            work = changed(work, lambda one, draw=draw: structs.replace(one, client=f"h{draw.randint(1, 3)}/c"))  # type: ignore[misc]
            fair = FairShares(half_life=60 * SECOND, patience=20 * SECOND)
        policy = replace(POLICY, fair_shares=fair)
        for strategy in STRATEGIES:
            assert live(work, strategy, policy) == replayed(work, strategy, policy), (seed, strategy)

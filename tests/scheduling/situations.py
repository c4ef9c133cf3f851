"""Random situations of one instant: what runs, what waits and what is asked at once, by name and by pattern."""

from __future__ import annotations

import random
from collections.abc import Iterable
from dataclasses import dataclass, field
from fractions import Fraction

from msgspec import structs

from zscout.config.scheduling_policy import DEFAULT, SchedulingPolicy, StrategyName
from zscout.scheduling.capacity import excess
from zscout.scheduling.conflict_groups import density
from zscout.scheduling.core import Core
from zscout.scheduling.forecast import play_instant
from zscout.scheduling.model import (
    ArcRequest,
    Effect,
    Event,
    Granted,
    HoldEnded,
    LeadTaken,
    Propose,
    RcJoined,
    RecoveredHold,
    Requested,
    Tick,
    Vote,
)
from zscout.scheduling.strategies import STRATEGIES
from zscout.simulation.workload import Arrival, Workload, WorkloadRc
from zscout.types import SECOND, Grant, Need, Params, Place, RcName, Term

OLD, NEW = Term(1, "rcm/a"), Term(2, "rcm/b")
NOW = 50 * SECOND


@dataclass
class Situation:
    exclusive: list[RcName]
    capacity: dict[RcName, Params] = field(default_factory=dict)
    """Of the sharable RCs."""
    running: list[tuple[ArcRequest, dict[Need, RcName], int]] = field(default_factory=list)
    """Each with the RCs of its patterns and its start in seconds."""
    asked: list[ArcRequest] = field(default_factory=list)
    policy: SchedulingPolicy = DEFAULT


@dataclass
class Decided:
    core: Core
    effects: list[Effect]

    @property
    def held(self) -> dict[str, set[RcName]]:
        return {arc.id: set(arc.needs) for arc in self.core.status().running}

    @property
    def flickered(self) -> set[str]:
        """ARCs that were granted and ended."""
        granted = {effect.arc for effect in self.effects if isinstance(effect, Granted)}
        ended = [effect for effect in self.effects if isinstance(effect, HoldEnded)]
        return {effect.arc for at, effect in enumerate(ended) if effect.grant.term == NEW and effect.arc in granted}

    def worth(self, strategy: StrategyName) -> dict[int, int]:
        """(ARC, RC) pairs by priority, as the strategy weighs them; what was protected counts as the highest priority
        that can't end it."""
        pairs: dict[int, int] = {}
        for arc in self.core._state.running.values():
            assert arc.hold is not None
            if not arc.past_min_runtime(NOW):
                below = arc.protected_below(NOW) if arc.hold.grant.term == OLD else None
                level = arc.priority if below is None else max(arc.priority, below - 1)
                each = density(arc.request.min_runtime) if strategy == "adaptive" else 1
                pairs[level] = pairs.get(level, 0) + each * len(arc.needs)
        return pairs


def decide(situation: Situation, strategy: StrategyName) -> Decided:
    """The state after the instant, in which every vote is answered at once."""
    core = Core(STRATEGIES[strategy](), situation.policy)

    def vote(asked: Propose) -> Vote:
        reason = excess(situation.capacity[asked.rc], asked.holders.items())
        return Vote(asked.proposal, accept=not reason, reason=reason)

    def instant(now: int, events: Iterable[Event]) -> list[Effect]:
        return [effect for effects in play_instant(core, now, events, vote) for effect in effects]

    joined: list[Event] = [RcJoined(rc, sharable=False) for rc in situation.exclusive]
    joined += [RcJoined(rc, sharable=True) for rc in situation.capacity]
    holds = tuple(
        RecoveredHold(
            request, Place(OLD, number), Grant(OLD, number), start * SECOND, start * SECOND + request.min_runtime, bound
        )
        for number, (request, bound, start) in enumerate(situation.running, 1)
    )
    instant(NOW - 1, [*joined, LeadTaken(NEW, holds)])
    effects = instant(NOW, [*map(Requested, situation.asked)] or [Tick()])
    return Decided(core, effects)


def less(worth: dict[int, int], least: dict[int, int]) -> bool:
    levels = sorted({*worth, *least}, reverse=True)
    return [worth.get(level, 0) for level in levels] < [least.get(level, 0) for level in levels]


PATTERNS = (("dev/*",), ("dev/*", "dev/*#2"), ("dev/a$*",), ("cam/*",), ("cam/*", "dev/*"), ("dev/a$*", "dev/*"))


def random_situation(seed: int, *, patterns: bool = True, asks: tuple[int, int] = (1, 7)) -> Situation:
    """`asks`: the least and most ARCs that are asked."""
    draw = random.Random(seed)  # noqa: S311
    exclusive = [f"dev/{letter}{number}" for letter in "ab" for number in range(draw.randint(1, 2))]
    exclusive += [f"cam/{number}" for number in range(draw.randint(0, 2))]
    radios = [f"radio/{number}" for number in range(draw.choice((0, 0, 1, 2)))]
    found = Situation(exclusive, {radio: {"rate": Fraction(draw.randint(3, 8))} for radio in radios})
    found.policy = SchedulingPolicy(
        preempt=draw.choice(("always", "always", "after_min_runtime")), patience=draw.choice((None, 10 * SECOND))
    )

    def request(name: str) -> ArcRequest:
        needs: list[str] = draw.sample(exclusive, draw.choice((0, 1, 1, 2)))
        if patterns and draw.random() < 0.6:
            needs = [*needs[: draw.randint(0, 1)], *draw.choice(PATTERNS)]
        if radios and draw.random() < 0.5:
            needs.append(draw.choice([*radios, "radio/*"] if patterns else radios))
        rate: Params = {"rate": Fraction(draw.randint(0, 5))}
        wanted: dict[str, Params] = {need: rate if need.startswith("radio") else {} for need in needs or [exclusive[0]]}
        priority = draw.choice((0, 1, 1, 2, 2, 10))
        return ArcRequest(name, "h/c", wanted, priority, draw.randint(1, 99) * SECOND, draw.random() < 0.3)

    free, used = set(exclusive), {radio: Fraction(0) for radio in radios}
    for number in range(draw.randint(0, 4)):
        asked, start = request(f"runs{number}"), draw.randint(0, 49)
        bound: dict[Need, RcName] = {}
        taken: set[RcName] = set()
        for need, params in asked.needs.items():
            kind = need.split("#")[0].removesuffix("$*").removesuffix("*")
            fit = [rc for rc in sorted(free - taken) if rc == need or ("*" in need and rc.startswith(kind))]
            fit += [
                rc
                for rc in radios
                if (rc == need or ("*" in need and rc.startswith(kind)))
                and used[rc] + params.get("rate", 0) <= found.capacity[rc]["rate"]
            ]
            if not fit:
                break
            rc = draw.choice(fit)
            taken.add(rc)
            if "*" in need:
                bound[need] = rc
        else:
            if asked.keep or start * SECOND + asked.min_runtime > NOW:
                free -= taken
                for rc in taken & used.keys():
                    used[rc] += next(iter(p for n, p in asked.needs.items() if n.startswith("radio"))).get("rate", 0)
                found.running.append((asked, bound, start))
    found.asked = [request(f"asks{number}") for number in range(draw.randint(*asks))]
    return found


def random_stream(seed: int) -> tuple[Workload, SchedulingPolicy]:
    """ARCs of three hosts one after the other, in half of the streams by pattern."""
    draw = random.Random(f"stream {seed}")  # noqa: S311
    found = random_situation(seed, patterns=seed % 2 == 0, asks=(10, 40))
    rcs = [WorkloadRc(rc) for rc in found.exclusive]
    rcs += [WorkloadRc(rc, sharable=True, capacity=capacity) for rc, capacity in found.capacity.items()]
    at, arrivals = 0, []
    for asked in found.asked:
        at += draw.choice((0, 0, 1, 3, 9, 20)) * SECOND
        arrivals.append(Arrival(at, structs.replace(asked, client=f"h{draw.randint(0, 2)}/c")))
    return Workload(tuple(rcs), tuple(arrivals)), found.policy

"""A pass that looks only where something has changed comes out as one over the whole queue."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from fractions import Fraction
from random import Random

import pytest

from tests.scheduling.plain_pass import PlainPriority
from tests.scheduling.validate import validate
from tests.thorough import times
from zscout.config.scheduling_policy import DEFAULT, FairShares, SchedulingPolicy, StrategyName
from zscout.scheduling import fair_shares, patterns, priority
from zscout.scheduling.admission import AdmissionCheck
from zscout.scheduling.capacity import excess
from zscout.scheduling.core import Core
from zscout.scheduling.model import (
    Arc,
    ArcRequest,
    ArcState,
    ArcStatus,
    Cancelled,
    ClientLost,
    Effect,
    Event,
    Granted,
    HandedOver,
    HoldEnded,
    Propose,
    Queued,
    Rc,
    RcJoined,
    RcLost,
    RcReported,
    Released,
    Requested,
    Tick,
    Vote,
    VoteOverdue,
)
from zscout.scheduling.queue_index import QueueIndex
from zscout.scheduling.state import SchedulerState
from zscout.scheduling.strategies import STRATEGIES
from zscout.types import SECOND, Params


@dataclass(frozen=True)
class Size:
    """How big a random run is; `wait_for_votes` is the chance that a vote stays out for one more event."""

    rcs: int
    sharable: int
    arcs: int
    clients: int
    events: int
    validate_every: int
    wait_for_votes: float
    patterns: float = 0.0  # the chance that a need is a pattern


SIZES = {
    "few, crowded": Size(5, 3, 25, 4, 1200, 2, 0.5),
    "few, exclusive": Size(6, 0, 40, 6, 1200, 2, 0.0),
    "many, slow votes": Size(20, 6, 250, 10, 400, 10, 0.6),
    "few, by pattern": Size(8, 2, 12, 4, 320, 8, 0.5, 0.6),
    "large": Size(100, 10, times(700), 50, 40, 20, 0.05),
}


PATTERNS = (
    ("rc/*",),
    ("rc/*", "rc/*#2"),
    ("rc/*", "rc/*#2", "rc/*#3"),
    ("rc/$*2", "rc/*"),
    ("rc/$*3", "radio/*"),
    ("radio/*",),
)


class Twins:
    """The indexed core and the plain one, fed with the same random events; they must say the same."""

    def __init__(self, size: Size, seed: int, policy: SchedulingPolicy = DEFAULT) -> None:
        self.size, self.rng = size, Random(seed)  # noqa: S311
        self.indexed, self.plain = Core(policy=policy), Core(PlainPriority(), policy)
        self.now = 0
        self.number = 0
        shared, kind = range(size.sharable), "radio" if size.patterns else "rc"
        self.sharable = {
            f"{kind if number in shared else 'rc'}/{number}": number in shared for number in range(size.rcs)
        }
        self.capacity = {rc: Fraction(self.rng.randint(2, 9)) for rc in self.sharable}
        self.present = set(self.sharable)
        self.out: dict[int, Propose] = {}
        self.grants = self.preemptions = self.vetoes = 0
        self.send(*[RcJoined(rc, sharable) for rc, sharable in self.sharable.items()])
        self.send(*[self.ask() for _ in range(size.arcs)])

    def ask(self) -> Event:
        rng, self.number = self.rng, self.number + 1
        names = rng.sample(sorted(self.sharable), min(rng.choice((1, 1, 2, 3, 4)), self.size.rcs))
        needs: dict[str, Params] = {
            rc: {"rate": Fraction(rng.randint(0, 6))} if self.sharable[rc] else {} for rc in names
        }
        if rng.random() < self.size.patterns:
            rate, both = {"rate": Fraction(rng.randint(0, 6))}, rng.choice(PATTERNS)
            named = {} if rng.random() < 0.6 else dict(list(needs.items())[:1])
            needs = named | {need: rate if need.startswith("radio") else {} for need in both}
        client = client_of(rng.randrange(self.size.clients))
        runtime = rng.randint(1, 6) * SECOND // 2
        return Requested(ArcRequest(f"a{self.number}", client, needs, rng.randrange(4), runtime, rng.random() < 0.2))

    def send(self, *events: Event) -> bool:
        """False if nothing was decided."""
        effects = self.indexed.handle(self.now, *events)
        plain = self.plain.handle(self.now, *events)
        assert decisions(effects) == decisions(plain), f"after {events[:3]} at {self.now}"
        for effect in effects:
            if isinstance(effect, Propose):
                self.out[effect.proposal] = effect
            elif isinstance(effect, Granted | HoldEnded):
                self.grants += isinstance(effect, Granted)
                self.preemptions += isinstance(effect, HoldEnded) and effect.by is not None
        return bool(decisions(effects))

    def play(self) -> None:
        for number in range(self.size.events):
            self.step()
            if number % self.size.validate_every == 0:
                self.compare()
        self.compare()
        assert self.grants > self.size.events / 5

    def step(self) -> None:
        rng = self.rng
        self.now += rng.choice((0, 0, 1, SECOND // 4, SECOND // 2))
        for proposal in list(self.out):
            if rng.random() >= self.size.wait_for_votes:
                self.send(self.answer(self.out.pop(proposal)))
        self.send(*[self.event() for _ in range(rng.choice((1, 1, 1, 3)))])

    def answer(self, question: Propose) -> Event:
        if self.rng.random() < 0.05:
            # Overdue; it may yet be answered, late or never.
            if self.rng.random() < 0.5:
                self.out[question.proposal] = question
            return VoteOverdue(question.proposal)
        reason = excess({"rate": self.capacity[question.rc]}, question.holders.items())
        self.vetoes += bool(reason)
        return Vote(question.proposal, accept=not reason, reason=reason)

    def event(self) -> Event:
        rng, state = self.rng, self.indexed._state
        running, queued = sorted(state.running), sorted(state.queued)
        some_rc = rng.choice(sorted(self.sharable))
        doings: list[tuple[float, Callable[[], Event]]] = [
            (5.0 if len(queued) < self.size.arcs else 0.5, self.ask),
            (3.0 if running else 0.0, lambda: Released(rng.choice(running))),
            (1.0 if queued else 0.0, lambda: Cancelled(rng.choice(queued))),
            (0.3 if running else 0.0, lambda: self.hand_over(rng.choice([*running, *queued]))),
            (2.0, Tick),
            (0.2, lambda: ClientLost(client_of(rng.randrange(self.size.clients)))),
            (0.5, lambda: self.come_or_go(some_rc)),
            (0.4, lambda: self.new_rules(some_rc)),
        ]
        weights = [weight for weight, _ in doings]
        return rng.choices([make for _, make in doings], weights)[0]()

    def hand_over(self, arc: str) -> Event:
        self.number += 1
        return HandedOver(arc, client_of(self.rng.randrange(9)), f"{arc.partition('.')[0]}.{self.number}")

    def come_or_go(self, rc: str) -> Event:
        self.void(rc)
        if rc in self.present and self.rng.random() < 0.7:
            self.present.discard(rc)
            return RcLost(rc)
        self.present.add(rc)
        return RcJoined(rc, self.sharable[rc])

    def new_rules(self, rc: str) -> Event:
        self.void(rc)
        self.capacity[rc] = Fraction(self.rng.randint(2, 9))
        return RcReported(rc, rules_changed=True)

    def void(self, rc: str) -> None:
        self.out = {number: question for number, question in self.out.items() if question.rc != rc}

    def compare(self) -> None:
        """All state, the words for who asks, and the clients' ARCs; slow."""
        # What the plain core said of an ARC is older than what it did for those below: one more pass.
        calm = not self.send(Tick()) and not self.indexed._votes.proposals
        validate(self.indexed)
        one, two = self.indexed._state, self.plain._state
        assert list(one.queued) == list(two.queued)
        assert list(one.running) == list(two.running)
        ranked = sorted(one.queued.values(), key=lambda arc: arc.rank)
        for ahead, arc in enumerate(ranked):
            assert one.index.ahead(arc) == ahead
            if calm and arc.state is ArcState.WATCHING:
                status = self.indexed.arc(arc.id)
                assert status is not None
                reason, plain = status.reason, two.queued[arc.id].reason
                assert reason is not None
                assert plain is not None
                if arc.patterns and arc.named_mask:
                    assert reason.code == plain.code  # which choices are shown first may differ
                elif arc.patterns:
                    assert str(reason) == str(plain)
                else:
                    assert reason == plain
        for client in {arc.request.client for arc in one.running.values()}:
            theirs: list[Arc] = [*one.queued.values(), *one.running.values()]
            assert self.indexed.arcs_of(client) == [arc.id for arc in theirs if arc.request.client == client]


def client_of(number: int) -> str:
    return f"host{number % 3}/{number}"


def decisions(effects: list[Effect]) -> list[Effect]:
    """All but the words for those who wait: they are told later than they change."""
    return [effect for effect in effects if not isinstance(effect, Queued)]


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_an_indexed_pass_is_a_full_pass(size: Size, seed: int) -> None:
    twins = Twins(size, seed)
    twins.play()
    assert twins.preemptions > 10
    assert bool(twins.vetoes) == bool(size.sharable)


@pytest.mark.parametrize("size", SIZES.values(), ids=SIZES)
def test_so_it_is_where_the_order_of_groups_changes(size: Size, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fair_shares, "NEAR_RC_SECONDS", 0.1)
    sort, sorted_anew = QueueIndex.sort, [0]

    def counted(index: QueueIndex, queued: Mapping[str, Arc], rcs: Iterable[Rc]) -> None:
        sorted_anew[0] += 1
        sort(index, queued, rcs)

    monkeypatch.setattr(QueueIndex, "sort", counted)
    Twins(size, 3, SchedulingPolicy(fair_shares=FairShares(20 * SECOND))).play()
    assert sorted_anew[0] > min(10, size.events // 20)


def test_what_a_release_looks_at_does_not_grow_with_the_queue(monkeypatch: pytest.MonkeyPatch) -> None:
    """Counted in visits, not in seconds: 4,000 ARCs that wait for other RCs are nobody's business."""
    looked_at: list[str] = []

    class Counted(AdmissionCheck):
        def __init__(self, state: SchedulerState, arc: Arc) -> None:
            looked_at.append(arc.id)
            super().__init__(state, arc)

    monkeypatch.setattr(priority, "AdmissionCheck", Counted)
    core = Core()
    core.handle(0, *[RcJoined(f"robot/{number}", sharable=False) for number in range(50)])
    asked = [
        Requested(ArcRequest(f"a{number}", "host/c", {f"robot/{number % 50}": {}}, 0, (1 + number) * SECOND))
        for number in range(4000)
    ]
    core.handle(0, *asked)
    assert len(looked_at) == 4000
    looked_at.clear()
    granted = [effect for effect in core.handle(1, Released("a7")) if isinstance(effect, Granted)]
    assert [grant.arc for grant in granted] == ["a57"], "the next in line for robot/7"
    assert looked_at == ["a57"]
    # What others wait for now is looked at when somebody reads it.
    following = [f"a{107 + 50 * step}" for step in range(priority.MAX_REPORTED)]
    assert [effect.arc for effect in core.report_reasons() if isinstance(effect, Queued)] == following
    assert looked_at == ["a57", *following]
    assert not core.reasons_changed


@pytest.mark.parametrize("strategy", ["priority", "adaptive"])
def test_those_who_wait_by_one_pattern_are_checked_as_one(
    strategy: StrategyName, monkeypatch: pytest.MonkeyPatch
) -> None:
    """1,000 ARCs that wait for any 2 of 8, counted in checks and in searches for a binding."""
    checks, searches = [0], [0]
    check, search = priority.Pass._check, patterns.Choices._bind

    def counted_check(one_pass: priority.Pass, arc: Arc) -> None:
        checks[0] += 1
        check(one_pass, arc)

    def counted_search(choices: patterns.Choices, without: int, claimed: int) -> Mapping[str, str] | None:
        searches[0] += 1
        return search(choices, without, claimed)

    monkeypatch.setattr(priority.Pass, "_check", counted_check)
    monkeypatch.setattr(patterns.Choices, "_bind", counted_search)

    def work(core: Core, now: int, *events: Event) -> tuple[int, int]:
        checks[0] = searches[0] = 0
        core.handle(now, *events)
        return checks[0], searches[0]

    def ask(name: str, *needs: str, priority: int = 1, seconds: int = 99) -> Event:
        return Requested(ArcRequest(name, "h/c", {need: {} for need in needs}, priority, seconds * SECOND))

    core = Core(STRATEGIES[strategy]())
    core.handle(0, *[RcJoined(f"dev/{number}", sharable=False) for number in range(8)])
    core.handle(0, *[ask(f"holds{number}", f"dev/{number}", f"dev/{number + 1}") for number in (0, 2, 4, 6)])
    assert work(core, 1, *[ask(f"w{n}", "dev/*", "dev/*#2", seconds=100 + n) for n in range(1000)]) == (1000, 1)
    assert work(core, 2, Tick()) == (0, 0)
    assert work(core, 3, ask("new", "dev/*", "dev/*#2", seconds=2000)) == (1, 0)
    assert work(core, 4, ask("other", "dev/*", seconds=2000)) == (1, 1)
    for now, gone in enumerate(("holds0", "w0", "w1", "w2"), 5):
        checked, searched = work(core, now, Released(gone))
        assert checked <= 3
        assert searched <= 6
        assert f"w{now - 5}" in core._state.running
        validate(core)
    assert work(core, 9, RcLost("dev/7"))[0] <= 3
    # The best of them preempts at a higher priority, and its victim waits with the others.
    assert work(core, 10, ask("high", "dev/*", "dev/*#2", priority=2))[0] <= 4
    assert "high" in core._state.running
    validate(core)


def test_the_words_for_who_asks_are_those_of_now() -> None:
    core = Core()
    core.handle(0, RcJoined("robot/a", sharable=False))
    core.handle(0, *[Requested(ArcRequest(f"a{number}", "h/c", {"robot/a": {}}, 0, SECOND)) for number in range(20)])
    assert reason_of(core) == str(last_of(core).reported) == "waits for a0: robot/a"
    core.handle(1, Released("a0"))
    assert reason_of(core) == "waits for a1: robot/a"
    assert last_of(core).ahead == 17
    core.handle(2, RcLost("robot/a"))
    assert reason_of(core) == str(last_of(core).reported) == "robot/a not on the mesh"


def reason_of(core: Core) -> str:
    return str(last_of(core).reason)


def last_of(core: Core) -> ArcStatus:
    return core.status().queued[-1]


def test_one_asleep_hears_in_the_next_pass_of_what_was_done_below_it() -> None:
    cores = (Core(), Core(PlainPriority()))

    def both(*events: Event) -> list[Effect]:
        effects, plain = (core.handle(1, *events) for core in cores)
        assert decisions(effects) == decisions(plain)
        return effects

    def proposed(effects: list[Effect]) -> int:
        return next(effect.proposal for effect in effects if isinstance(effect, Propose))

    both(RcJoined("radio/s", sharable=True), RcJoined("robot/x", sharable=False))
    asked = both(Requested(ArcRequest("low", "h/c", {"radio/s": {}, "robot/x": {}}, 0, SECOND)))
    both(Vote(proposed(asked), accept=True))
    alone = both(Requested(ArcRequest("high", "h/c", {"radio/s": {}}, 2, SECOND)))
    beside_low = both(Vote(proposed(alone), accept=True))
    both(VoteOverdue(proposed(beside_low)))
    taken = both(Requested(ArcRequest("middle", "h/c", {"robot/x": {}}, 1, SECOND)))
    assert [effect.arc for effect in taken if isinstance(effect, Granted)] == ["middle"]
    assert [effect.arc for effect in both(Tick()) if isinstance(effect, Granted)] == ["high"]

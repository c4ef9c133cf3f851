"""A sensor net in a building under virtual time: many robots, few framegrabbers and channels, one radio.

Everything that decides is what decides live: the scheduling core, the radio's and the channels' votes, each
robot's `Scout`. Only the mesh between them is left out. One run gives when each robot was placed, and how
much of what moved was seen.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final

import numpy as np

from zscout.behaviors.sensor_net.place_robot import Slots
from zscout.behaviors.sensor_net.scout import Scout, Step
from zscout.drivers.airtime import Share, line_rate, objection
from zscout.packets import MAX_PACKET
from zscout.scheduling.adaptive import Adaptive
from zscout.scheduling.core import Core
from zscout.scheduling.effects import Effect, Granted, Outcome, Propose, Revoked, WakeAt
from zscout.scheduling.events import Asked, Event, RcJoined, Released, Tick, Vote
from zscout.scheduling.model import SECOND, ArcId, Ns, Request
from zscout.simulation.air import Air
from zscout.simulation.plan import Plan
from zscout.simulation.world import World

STEP: Final = 0.05
"""Seconds of one step of the building."""
LATENCY: Final = 0.1
"""Seconds from a picture to the wheels: transmission, thinking, radio."""
BOUND: Final = Fraction(1, 4)
"""Seconds that a packet may wait at the radio."""
SETTLED: Final = 120.0
"""Seconds in which all should be placed: walks that begin later count in any case."""
NOTICED: Final = 1.0
"""Seconds within which motion in view is to be alerted."""


@dataclass(frozen=True, slots=True)
class Field:
    """What there is to work with."""

    robots: int = 4
    channels: int = 2
    """Video channels, and as many framegrabbers."""
    baud: int = 9_600
    command_rate: float = 5.0
    frame_rate: float = 5.0
    """Pictures a second that a framegrabber gives."""
    loss: float = 0.02
    """Share of radio packets that are lost."""
    slots: Slots = field(default_factory=Slots)


@dataclass(slots=True)
class Outcomes:
    """What came of one run."""

    placed: dict[str, float | None] = field(default_factory=dict)
    """By robot: when it said that it was hidden, seconds, and None for never."""
    truly: dict[str, bool] = field(default_factory=dict)
    """By robot: whether it then stood in a truly dark place."""
    walks: int = 0
    """Walks of people through the room, once all that would be placed were."""
    noticed: int = 0
    """Of these: during which some robot alerted."""
    in_view: int = 0
    """Crossings of a watching robot's picture."""
    alerted: int = 0
    """Of these: alerted within a second."""
    false_alarms: int = 0
    watched: float = 0.0
    """Seconds of watching, all robots together."""
    preemptions: int = 0
    moved_unheld: float = 0.0
    """Seconds that any robot's wheels turned while nobody held it: the time to stop, at most one drive."""
    seconds: float = 0.0


class _Player:
    """One robot's side of the queue."""

    def __init__(self, name: str, seed: int) -> None:
        self.name, self.scout = name, Scout(seed=seed)
        self.asked: ArcId | None = None
        self.held: Granted | None = None
        self.turns = 0
        self.next_picture = 0.0
        self.crossing_since: float | None = None
        self.crossing_done = False

    def rc(self, kind: str) -> str:
        if self.held is None:
            raise RuntimeError(f"{self.name} holds nothing")
        return next(rc for rc in self.held.rcs if rc.startswith(f"{kind}/"))


class FieldRun:
    """One net in one building. `run` it once."""

    def __init__(self, plan: Plan, field: Field, *, seed: int = 0) -> None:
        """Uses the plan's first `field.robots` robots; raises ValueError where it has fewer."""
        names = [robot.name for robot in plan.robots][: field.robots]
        if len(names) < field.robots:
            raise ValueError(f"{plan.name} has {len(names)} robots, fewer than {field.robots}")
        self.field = field
        rng = np.random.default_rng(seed)
        self.world = World(plan, seed=seed)
        for name in names:
            self.world.bodies[name].place(*self.world.random_start(rng))
        self.air = Air(seed=seed)
        self._rng = rng
        self._core = Core(Adaptive())
        self._players = {name: _Player(name, seed * 100 + number) for number, name in enumerate(names)}
        self._by_arc: dict[ArcId, _Player] = {}
        self._on_the_way: deque[tuple[float, Callable[[], None]]] = deque()
        self._walks: dict[int, bool] = {}
        """By person who walks now: whether that was noticed, or doesn't count."""
        self.outcomes = Outcomes(placed=dict.fromkeys(names), truly=dict.fromkeys(names, False))
        self._handle(
            *(RcJoined(f"robot/{name}", sharable=False) for name in names),
            *(RcJoined(f"framegrabber/f{n + 1}", sharable=False) for n in range(field.channels)),
            *(RcJoined(f"video/ch{n + 1}", sharable=True) for n in range(field.channels)),
            RcJoined("radio/rf0", sharable=True),
        )

    def run(self, seconds: float, *, watch: Callable[[FieldRun], None] | None = None) -> Outcomes:
        """Plays so many seconds of the building. `watch` is called after each step."""
        for player in self._players.values():
            self._ask(player)
        while self.world.time < seconds:
            self.world.step(STEP)
            while self._on_the_way and self._on_the_way[0][0] <= self.world.time:
                self._on_the_way.popleft()[1]()
            self._handle(Tick())
            for player in self._players.values():
                self._turn(player)
            self._follow_walks()
            if watch is not None:
                watch(self)
        self.outcomes.seconds = self.world.time
        return self.outcomes

    # The queue

    def _ask(self, player: _Player) -> None:
        player.turns += 1
        player.asked = f"{player.name}-{player.scout.task}.{player.turns}"
        self._by_arc[player.asked] = player
        priority, slot = self.field.slots.of(player.scout.task)
        needs = {
            f"robot/{player.name}": {},
            "radio/rf0": {
                "command_rate": Fraction(str(self.field.command_rate)),
                "packet_size": Fraction(MAX_PACKET),
            },
            "video/*": {"transmitters": Fraction(1)},
            "framegrabber/*": {},
        }
        request = Request(player.asked, player.name, needs, priority, round(slot * SECOND), keep=True)
        self._handle(Asked(request))

    def _handle(self, *events: Event) -> None:
        """One instant at the RCM, with every vote that it takes."""
        batch: list[Event] = list(events)
        now: Ns = round(self.world.time * SECOND)
        over: list[_Player] = []
        while batch:
            votes: list[Event] = []
            again = False
            for effect in self._core.handle(now, *batch):
                again |= isinstance(effect, WakeAt) and effect.at == now
                if isinstance(effect, Propose):
                    votes.append(self._vote(effect))
                else:
                    over += self._heed(effect)
            batch = votes or ([Tick()] if again else [])
        for player in over:
            # Its hold had its time: whoever wants more asks anew, behind those who wait.
            self._ask(player)

    def _vote(self, asked: Propose) -> Vote:
        holders = asked.holders.values()
        if asked.rc.startswith("video/"):
            reason = "" if sum(params["transmitters"] for params in holders) <= 1 else "two would jam"
        else:
            shares = [Share(params["command_rate"], params["packet_size"]) for params in holders]
            reason = objection(line_rate(self.field.baud), BOUND, shares)
        return Vote(asked.proposal, accept=not reason, reason=reason)

    def _heed(self, effect: Effect) -> list[_Player]:
        """Carries out a grant or its end; who has to ask anew."""
        match effect:
            case Granted(arc=arc):
                player = self._by_arc[arc]
                player.held = effect
                player.next_picture = self.world.time
                player.scout.held(self.world.time)
                channel = int(player.rc("video").removeprefix("video/ch"))
                body = self.world.bodies[player.name]
                self._send(player, lambda: body.transmit(channel, self.world.time), sure=True)
            case Revoked(arc=arc, outcome=outcome, requeued=requeued):
                player = self._by_arc[arc]
                player.held = None
                player.crossing_since = None
                player.scout.released(self.world.time)
                self._halt(player)
                self.outcomes.preemptions += outcome is Outcome.PREEMPTED
                if not requeued:
                    del self._by_arc[arc]
                    player.asked = None
                    return [player]
            case _:
                pass
        return []

    # The robot

    def _turn(self, player: _Player) -> None:
        body = self.world.bodies[player.name]
        if player.held is None:
            self.outcomes.moved_unheld += 0.0 if body.still else STEP
            return
        if self.world.time < player.next_picture:
            return
        player.next_picture += 1 / self.field.frame_rate
        channel = int(player.rc("video").removeprefix("video/ch"))
        picture = self.air.receive(self.world, channel)
        step = player.scout.see(self.world.time, picture, f"video/ch{channel}")
        now = self.world.time
        self._send(player, lambda: body.command(step.left, step.right, step.lasts, self.world.time))
        if player.scout.task == "watch" and self.outcomes.placed[player.name] is None:
            self.outcomes.placed[player.name] = now
            self.outcomes.truly[player.name] = self.world.is_dark(player.name)
        self._judge(player, step)
        if (step.over or step.blind) and player.asked is not None:
            self._handle(Released(player.asked))

    def _judge(self, player: _Player, step: Step) -> None:
        """Compares a look of a watching robot with what truly was in its view."""
        if step.doing not in ("watch", "alert"):
            player.crossing_since = None
            return
        now, out = self.world.time, self.outcomes
        out.watched += 1 / self.field.frame_rate
        crossing = self.world.crossing(player.name)
        if crossing and player.crossing_since is None:
            player.crossing_since, player.crossing_done = now, False
            out.in_view += 1
        elif not crossing:
            player.crossing_since = None
        since = player.crossing_since
        if step.doing == "alert" and since is not None and not player.crossing_done:
            player.crossing_done = True
            out.alerted += now - since <= NOTICED
        out.false_alarms += step.alert and since is None

    def _follow_walks(self) -> None:
        """Counts the walks that began once all were placed, or had time enough for it."""
        out = self.outcomes
        ready = self.world.time >= SETTLED or all(at is not None for at in out.placed.values())
        alarm = any(player.scout.alerts.moving and player.held for player in self._players.values())
        for number, walker in enumerate(self.world.walkers):
            if not walker.here:
                self._walks.pop(number, None)
                continue
            if number not in self._walks:
                self._walks[number] = not ready
                out.walks += ready
            if alarm and not self._walks[number]:
                self._walks[number] = True
                out.noticed += 1

    def _halt(self, player: _Player) -> None:
        body = self.world.bodies[player.name]

        def halt() -> None:
            # Unless it has been held anew meanwhile.
            if player.held is None:
                body.command(0, 0, 0, self.world.time)
                body.transmit(None, self.world.time)

        self._send(player, halt, sure=True)

    def _send(self, player: _Player, act: Callable[[], None], *, sure: bool = False) -> None:
        """Does something at the robot when it arrives there; `sure`: it is sent until it does."""
        if sure or self._rng.random() >= self.field.loss:
            self._on_the_way.append((self.world.time + LATENCY, act))

"""A sensor net in a building under virtual time: many robots, few framegrabbers and channels, one radio.

All decisions are made by the real code: the scheduling core, the votes of the radio and the channels, each robot's
`Scout`. Only the mesh is left out: a command takes LATENCY and its time on the radio's line. The outcome of a run is
when each robot was placed, and how much of the motion was seen.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final

import msgspec
import numpy as np

from studies.robots.field_figures import Judge, Outcomes
from zscout.behaviors.sensor_net.place_robot import BRIEF, GIVEN_UP, RETRY_AFTER, WARM_AHEAD, WARM_SLACK, Slots
from zscout.behaviors.sensor_net.scout import Scout, Step
from zscout.drivers.airtime import BITS_PER_BYTE, Share, line_rate, objection
from zscout.drivers.packets import MAX_PACKET, OVERHEAD
from zscout.scheduling.adaptive import Adaptive
from zscout.scheduling.core import Core
from zscout.scheduling.forecast import forecast
from zscout.scheduling.model import (
    ArcRequest,
    Cancelled,
    Effect,
    Event,
    Granted,
    HoldEnded,
    Outcome,
    Propose,
    RcJoined,
    Released,
    Requested,
    Tick,
    Vote,
    WakeAt,
)
from zscout.simulation.building.air import Air
from zscout.simulation.building.drawn import with_robots
from zscout.simulation.building.plan import MAX_ROBOTS, Plan
from zscout.simulation.building.world import MAX_STEP, World
from zscout.types import SECOND, ArcId, Ns, Params

MAX_CHANNELS: Final = 16
LATENCY: Final = 0.1
"""Seconds from a picture to the arrival of its command at the radio: transmission, computation, the mesh."""
REPEAT: Final = 0.2
"""Seconds after which a lost stop, halt or camera command is sent again."""
BOUND: Final = Fraction(1, 4)
"""Seconds that a packet may wait at the radio, or the time of BOUND_BYTES if that is longer."""
BOUND_BYTES: Final = 60
"""The same as in the node file of `zscout simulate`."""
RADIO: Final = "radio/rf0"
_SOON: Final = 1e-6
"""Seconds below which times are equal."""


@dataclass(frozen=True, slots=True)
class Field:
    """The equipment of a run. Raises ValueError for impossible numbers."""

    robots: int = 4
    channels: int = 2
    """Video channels."""
    framegrabbers: int = 0
    """0: one for each channel."""
    baud: int = 9_600
    command_rate: float = 5.0
    """Drive packets a second that each robot's behavior requests."""
    frame_rate: float = 4.0
    """Pictures a second of a framegrabber: few, because they take most of the computing time."""
    loss: float = 0.02
    """Share of radio packets that are lost."""
    slots: Slots = field(default_factory=Slots)

    def __post_init__(self) -> None:
        if not 1 <= self.robots <= MAX_ROBOTS or not 1 <= self.channels <= MAX_CHANNELS:
            raise ValueError(f"give 1 to {MAX_ROBOTS} robots and 1 to {MAX_CHANNELS} channels")
        if not 0 <= self.framegrabbers <= self.channels:
            raise ValueError(f"give 1 to {self.channels} framegrabbers, or 0 for one per channel")
        if self.baud < 1 or self.command_rate <= 0 or self.frame_rate <= 0 or not 0 <= self.loss < 1:
            raise ValueError("rates must be above 0, the loss at least 0 and below 1")

    @property
    def receivers(self) -> int:
        """Number of framegrabbers."""
        return self.framegrabbers or self.channels

    @property
    def bound(self) -> Fraction:
        """Seconds that a packet may wait at the radio."""
        return max(BOUND, Fraction(BOUND_BYTES * BITS_PER_BYTE, self.baud))


def crewed(plan: Plan, robots: int, *, seed: int = 0) -> Plan:
    """The same building with this number of robots: the plan's first, or drawn by `with_robots`."""
    if robots <= len(plan.robots):
        return msgspec.structs.replace(plan, robots=plan.robots[:robots])
    return with_robots(plan, robots, seed=seed)


class Player:
    def __init__(self, name: str, seed: int) -> None:
        self.name, self.scout = name, Scout(seed=seed)
        self.asked: ArcId | None = None
        self.held: Granted | None = None
        self.warm: ArcId | None = None
        """The request for warming up its camera before its turn."""
        self.warmed: Granted | None = None
        """The hold of `warm`, while it lasts."""
        self.transmits: Granted | None = None
        """The last hold whose command to transmit the robot has received."""
        self.video: str | None = None
        """The channel that it requested by name."""
        self.turns = 0
        self.asks_at: float | None = 0.0
        """When it requests again; None while it waits or holds."""
        self.warms_at: float | None = None
        """When its camera starts to warm up."""
        self.next_picture = 0.0
        self.next_drive = 0.0
        self.stood = False
        """True if the last command of this hold was a stop."""

    @property
    def channel(self) -> int:
        """The number of the held video channel. Raises RuntimeError without a hold."""
        if self.held is None:
            raise RuntimeError(f"{self.name} holds nothing")
        return _channel(self.held)


def _channel(hold: Granted) -> int:
    return next(int(rc.removeprefix("video/ch")) for rc in hold.rcs if rc.startswith("video/"))


class FieldRun:
    """A net in a building. Can `run` only once."""

    def __init__(self, plan: Plan, field: Field, *, seed: int = 0) -> None:
        """Put the plan's robots on random places. Raises ValueError if their number is not `field.robots`."""
        names = [robot.name for robot in plan.robots]
        if len(names) != field.robots:
            raise ValueError(f"{plan.name} has {len(names)} robots, not {field.robots}: see crewed()")
        self.field = field
        self.world = World(plan, seed=seed)
        self._rng = np.random.default_rng((seed, 0xF1E))
        for name in names:
            self.world.bodies[name].place(*self.world.random_start(self._rng))
        self._air = Air(seed=seed)
        self._core = Core(Adaptive())
        self.players = {name: Player(name, seed * 100 + number) for number, name in enumerate(names)}
        self._by_arc: dict[ArcId, Player] = {}
        self._under_way: list[tuple[float, int, Callable[[], None]]] = []
        """Commands on their way: a heap by the time of their arrival."""
        self._numbers = itertools.count()
        self._line_free = 0.0
        self._wake: Ns = 0
        self.channels = [f"video/ch{number + 1}" for number in range(field.channels)]
        self.outcomes = Outcomes(placed=dict.fromkeys(names))
        self._judge = Judge(self.world, self.outcomes)
        self._handle(
            *(RcJoined(f"robot/{name}", sharable=False) for name in names),
            *(RcJoined(f"framegrabber/f{number + 1}", sharable=False) for number in range(field.receivers)),
            *(RcJoined(channel, sharable=True) for channel in self.channels),
            RcJoined(RADIO, sharable=True),
        )

    def run(self, seconds: float, *, watch: Callable[[FieldRun], None] | None = None) -> Outcomes:
        """Play for `seconds` of virtual time. `watch` is called after each step."""
        while self.world.time < seconds - _SOON:
            now = self.world.time
            dt = min(self._next() - now, MAX_STEP, seconds - now)
            if dt > _SOON:
                self.world.step(dt)
            else:
                dt = 0.0
            self._play()
            alarm = any(player.scout.alerts.moving and player.held for player in self.players.values())
            self._judge.stepped(dt, alarm=alarm)
            if watch is not None:
                watch(self)
        self.outcomes.seconds = self.world.time
        return self.outcomes

    def _next(self) -> float:
        """The time of the next event outside the building."""
        times = [self._wake / SECOND]
        times += [self._under_way[0][0]] if self._under_way else []
        for player in self.players.values():
            if player.held is not None:
                times.append(player.next_picture)
            else:
                times += [at for at in (player.asks_at, player.warms_at) if at is not None]
        return min(times)

    def _play(self) -> None:
        now = self.world.time
        while self._under_way and self._under_way[0][0] <= now + _SOON:
            heapq.heappop(self._under_way)[2]()
        for player in self.players.values():
            if player.asks_at is not None and player.asks_at <= now + _SOON:
                self._ask(player)
            if player.warms_at is not None and player.warms_at <= now + _SOON:
                self._warm_up(player)
        if self._wake / SECOND <= now + _SOON:
            self._handle(Tick())
        for player in self.players.values():
            if player.held is not None and player.next_picture <= now + _SOON:
                player.next_picture += 1 / self.field.frame_rate
                self._look(player)

    def _ask(self, player: Player) -> None:
        player.turns += 1
        player.asks_at = None
        task = player.scout.task
        player.asked = f"{player.name}-{task}.{player.turns}"
        self._by_arc[player.asked] = player
        player.video = player.scout.blindness.choose(self.world.time, self.channels)
        priority, slot = self.field.slots.of(task, sooner=player.scout.saw_somebody)
        needs = self._needs(player) | {"framegrabber/*": {}}
        warm = f"{player.name}-warm.{player.turns}" if task == "watch" else ""
        seconds = round(slot * SECOND)
        request = ArcRequest(player.asked, player.name, needs, priority, seconds, keep=True, continues=warm)
        self._handle(Requested(request))

    def _needs(self, player: Player) -> dict[str, Params]:
        """The needs of a robot that transmits."""
        return {
            f"robot/{player.name}": {},
            RADIO: {"command_rate": Fraction(str(self.field.command_rate)), "packet_size": Fraction(MAX_PACKET)},
            player.video or "video/*": {"transmitters": Fraction(1)},
        }

    def _warm_up(self, player: Player) -> None:
        """Request the robot for warming up its camera before its turn."""
        player.warms_at, player.warm = None, f"{player.name}-warm.{player.turns}"
        self._by_arc[player.warm] = player
        priority, runtime = self.field.slots.warm_priority, round(BRIEF * SECOND)
        request = ArcRequest(player.warm, player.name, self._needs(player), priority, runtime, keep=True)
        self._handle(Requested(request))

    def _schedule_warm_ups(self) -> list[Event]:
        """Set when cameras start to warm up, by a forecast of turns as in `place_robot`. Return the ends of warm-ups
        whose turns have moved away."""
        now = self.world.time
        waiting = [
            player
            for player in self.players.values()
            if player.held is None and player.asked and player.asks_at is None
        ]
        waiting = [player for player in waiting if player.scout.task == "watch"]
        starts = forecast(self._core, round(now * SECOND)).starts if waiting else {}
        over: list[Event] = []
        for player in waiting:
            start = starts.get(player.asked or "")
            ahead = math.inf if start is None else start / SECOND - now
            if player.warm is None:
                player.warms_at = None if start is None else now + max(0.0, ahead - WARM_AHEAD)
            elif ahead > WARM_AHEAD + WARM_SLACK:
                over.append(Released(player.warm) if player.warmed else Cancelled(player.warm))
                if player.warmed is None:
                    del self._by_arc[player.warm]
                    player.warm = None
        return over

    def _handle(self, *events: Event) -> None:
        """Handle events at the RCM, and the events that follow from them."""
        left = self._instant(*events)
        while left:
            left = self._instant(*left)
        if self.field.receivers < self.field.channels and (over := self._schedule_warm_ups()):
            self._handle(*over)

    def _instant(self, *events: Event) -> list[Event]:
        """Handle an instant at the RCM with all its votes. Return the clients' cancellations that follow."""
        batch: list[Event] = list(events)
        warmed = [player for player in self.players.values() if player.warmed is not None]
        now: Ns = round(self.world.time * SECOND)
        while batch:
            votes: list[Event] = []
            again = False
            for effect in self._core.handle(now, *batch):
                match effect:
                    case Propose():
                        votes.append(self._vote(effect))
                    case WakeAt(at=at):
                        # No wake-up is needed: a day from now.
                        self._wake = now + 86_400 * SECOND if at is None else at
                        again = at is not None and at <= now
                    case _:
                        self._heed(effect)
            batch = votes or ([Tick()] if again else [])
        given_up: list[Event] = []
        for player in self.players.values():
            if player in warmed and player.held is None and player.warmed is None:
                self._halt(player)
            if player.warm is not None and player.held is not None:
                # Its turn came before the camera was warm.
                given_up.append(Cancelled(player.warm))
                del self._by_arc[player.warm]
                player.warm = None
        return given_up

    def _vote(self, asked: Propose) -> Vote:
        holders = asked.holders.values()
        if asked.rc.startswith("video/"):
            reason = "" if sum(params["transmitters"] for params in holders) <= 1 else "two would jam"
        else:
            shares = [Share(params["command_rate"], params["packet_size"]) for params in holders]
            reason = objection(line_rate(self.field.baud), self.field.bound, shares)
        return Vote(asked.proposal, accept=not reason, reason=reason)

    def _heed(self, effect: Effect) -> None:
        now = self.world.time
        match effect:
            case Granted(arc=arc):
                player = self._by_arc[arc]
                if arc == player.warm:
                    player.warmed = effect
                    self._transmit(player, effect)
                    return
                player.held = effect
                player.next_picture, player.next_drive, player.stood = now, now, False
                player.scout.held(now)
                self._judge.held(player.name)
                self._transmit(player, effect)
            case HoldEnded(arc=arc, outcome=outcome, requeued=requeued):
                player = self._by_arc[arc]
                if arc == player.warm:
                    player.warmed = None
                    if not requeued:
                        del self._by_arc[arc]
                        player.warm = None
                    return
                player.held = None
                player.scout.released(now)
                self._judge.ended(player.name, preempted=outcome is Outcome.PREEMPTED)
                self._halt(player)
                if not requeued:
                    # Its time is over, or it released: it requests again, behind the waiting requests.
                    del self._by_arc[arc]
                    player.asks_at = now
            case _:
                pass

    def _look(self, player: Player) -> None:
        picture = self._air.receive(self.world, player.channel)
        now = self.world.time
        step = player.scout.see(now, picture, f"video/ch{player.channel}")
        if player.scout.task == "watch":
            self._judge.placed(player.name)
        self._judge.looked(player.name, step, 1 / self.field.frame_rate)
        if step.blind:
            self.outcomes.blind += 1
        else:
            self._drive(player, step)
        if (step.over or step.blind) and player.asked is not None:
            self._handle(Released(player.asked))
            if step.blind:
                player.asks_at = now + (GIVEN_UP if player.scout.blindness.dead else RETRY_AFTER)

    def _drive(self, player: Player, step: Step) -> None:
        """Send drive commands at the requested rate. Wheels are stopped once."""
        body, now = self.world.bodies[player.name], self.world.time
        if step.left == 0 and step.right == 0:
            if not player.stood:
                player.stood = True
                self.send(OVERHEAD, lambda: body.command(0, 0, 0, self.world.time), sure=True)
        elif now >= player.next_drive - _SOON:
            player.next_drive = max(player.next_drive + 1 / self.field.command_rate, now)
            player.stood = False
            self.send(MAX_PACKET, lambda: body.command(step.left, step.right, step.lasts, self.world.time))

    def _transmit(self, player: Player, hold: Granted) -> None:
        channel = _channel(hold)

        def switch() -> None:
            if hold in (player.held, player.warmed):
                player.transmits = hold
                self.world.bodies[player.name].transmit(channel, self.world.time)

        self.send(OVERHEAD + 1, switch, sure=True)

    def _halt(self, player: Player) -> None:
        def halt() -> None:
            # A newer command to the same robot ends the repeats of older commands.
            current = player.held or player.warmed
            if current is None or player.transmits is not current:
                body = self.world.bodies[player.name]
                body.command(0, 0, 0, self.world.time)
                body.transmit(None, self.world.time)

        self.send(OVERHEAD, halt, sure=True)

    def send(self, size: int, act: Callable[[], None], *, sure: bool = False) -> None:
        """Call `act` when the packet arrives at the robot. `sure`: it is repeated until it arrives."""
        begins = max(self.world.time + LATENCY, self._line_free)
        self._line_free = at = begins + size * BITS_PER_BYTE / self.field.baud
        while self._rng.random() < self.field.loss:
            if not sure:
                return
            at += REPEAT
        heapq.heappush(self._under_way, (at, next(self._numbers), act))

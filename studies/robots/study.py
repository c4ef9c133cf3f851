"""The benefit of more robots, video channels and radio bandwidth: many runs of nets in buildings, and their figures.

`field` runs a net, and `hide` a start of one robot. This module computes figures: percentiles over runs, and sums of
rare events.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Final, TypeAlias

import cv2
import numpy as np

from studies.robots import hide
from studies.robots.crossings import FATES, CrossingsOf, Fate
from studies.robots.field import Field, FieldRun, crewed
from studies.robots.field_figures import Outcomes
from zscout.behaviors.sensor_net.place_robot import Slots
from zscout.config.strict import BadInput, quoted
from zscout.simulation.building.drawn import drawn_plan
from zscout.simulation.building.plan import Plan
from zscout.simulation.building.plan_file import load_plan, shipped_plans

DRAWN: Final = "drawn"
"""Name of a building that is drawn at random for each seed."""
ROBOTS: Final = (1, 2, 4, 6, 8)
CHANNELS: Final = (1, 2, 3, 4)
BAUDS: Final = (300, 600, 1_200, 2_400, 9_600)
FRAMEGRABBERS: Final = (1, 2, 3, 4)
COMMAND_RATES: Final = (5.0, 2.5)
RADIO_ROBOTS: Final = 4
RADIO_CHANNELS: Final = 4
SLOTS: Final = (30, 60, 90)
"""Seconds of the slot in which a robot hides; 60 is the default of `place_robot`."""
SLOT_ROBOTS: Final = 4
SLOT_CHANNELS: Final = 1
SECONDS: Final = 180.0
ENOUGH_BAUD: Final = 9_600
TURNS: Final = 2
FEW: Final = 20
"""Least number of crossings of a robot's place for its share in time."""


@dataclass(frozen=True, slots=True)
class RobotsJob:
    """A run of a net, or if `field` is None a start of one robot."""

    building: str
    seed: int
    field: Field | None
    seconds: float = SECONDS


@dataclass(frozen=True, slots=True)
class RobotsTrial:
    job: RobotsJob
    outcomes: Outcomes | hide.HideOutcome


def buildings() -> list[str]:
    """Names for `plan_of`: the shipped buildings, and DRAWN."""
    return [*shipped_plans(), DRAWN]


@lru_cache(maxsize=8)
def plan_of(building: str, seed: int) -> Plan:
    """By name, or from its file. Raises BadInput if it does not exist, ValueError if none can be drawn."""
    if building == DRAWN:
        return drawn_plan(seed)
    shipped = shipped_plans()
    if building in shipped:
        return load_plan(shipped[building])
    if not building.endswith(".toml"):
        raise BadInput(
            f"--building {quoted(building)} is unknown; give {', '.join(buildings())}, or a file that ends in .toml"
        )
    return load_plan(Path(building))


def run(job: RobotsJob) -> RobotsTrial:
    """Run a job, in any process. Raises BadInput if the building has no room for its robots."""
    # Each process uses one processor: more threads would slow the other processes down.
    cv2.setNumThreads(1)
    try:
        plan = plan_of(job.building, job.seed)
        crew = plan if job.field is None else crewed(plan, job.field.robots, seed=job.seed)
    except ValueError as problem:
        raise BadInput(f"--building {job.building}, seed {job.seed}: {problem}") from None
    if job.field is None:
        outcome = hide.run(hide.HideJob(plan, job.seed))
        # The path is large, and not needed here.
        return RobotsTrial(job, replace(outcome, path=()))
    return RobotsTrial(job, FieldRun(crew, job.field, seed=job.seed).run(job.seconds))


def grid(robots: Iterable[int], channels: Iterable[int], baud: int = ENOUGH_BAUD) -> list[Field]:
    """All pairs. More channels than robots change nothing: they are left out, unless no pair would remain."""
    channels = sorted(set(channels))
    fields = []
    for count in sorted(set(robots)):
        useful = [number for number in channels if number <= count] or channels[:1]
        fields += [Field(robots=count, channels=number, baud=baud) for number in useful]
    return fields


def radio(bauds: Iterable[int]) -> list[Field]:
    """Radios with different rates, and behaviors with lower packet rates; everything else is plentiful."""
    return [
        Field(robots=RADIO_ROBOTS, channels=RADIO_CHANNELS, baud=baud, command_rate=rate)
        for rate in COMMAND_RATES
        for baud in sorted(set(bauds))
    ]


def receivers(framegrabbers: Iterable[int]) -> list[Field]:
    """Four robots with a channel each, and fewer framegrabbers: the next camera can warm up."""
    return [
        Field(robots=RADIO_ROBOTS, channels=RADIO_CHANNELS, framegrabbers=count % RADIO_CHANNELS)
        for count in sorted(set(framegrabbers))
        if count <= RADIO_CHANNELS
    ]


def turns(slots: Iterable[int]) -> list[Field]:
    """Four robots that take turns on one channel, with longer and shorter slots to hide in."""
    return [
        Field(robots=SLOT_ROBOTS, channels=SLOT_CHANNELS, slots=Slots(hide=float(slot))) for slot in sorted(set(slots))
    ]


@dataclass(frozen=True, slots=True)
class Quantiles:
    """10, 50 and 90 % of the runs are at or below; infinite if fewer runs got there."""

    low: float
    median: float
    high: float


@dataclass(frozen=True, slots=True)
class FieldFigures:
    """Figures of all runs with the same field."""

    robots: int
    channels: int
    framegrabbers: int
    baud: int
    command_rate: float
    slot: float
    """Seconds of the slot to hide in."""
    runs: int
    all_placed: Quantiles
    """Seconds until the last robot was placed."""
    placed: float
    """Share of the robots that were placed within the run."""
    dark: float
    """Share of placed robots in a truly dark place. This and the shares below are NaN without any."""
    facing: float
    """Share of placed robots that truly face the light."""
    walks: int
    noticed: float
    """Share of the walks."""
    noticed_spread: Quantiles
    """Spread of the shares over single runs with walks."""
    crossings: int
    alerted: float
    """Share of the crossings of a watching robot's picture that were alerted within a second."""
    account: dict[Fate, int]
    """All crossings of placed robots' places, held or not, by their fate."""
    in_time: float
    """Share of these crossings alerted in time."""
    best: float
    """Share of these crossings that could be in time: the robot was on the air, and its camera warm."""
    of_best: float
    """Share in time among crossings that could be."""
    least: float
    """The lowest share in time of a robot, divided by the mean of all robots; among robots with FEW or more crossings.
    Robots of different runs with the same number are one robot."""
    least_watch: float
    """The shortest watching time of a robot after all were placed, divided by the mean of its run; the minimum over the
    runs in which each robot could have had TURNS turns."""
    resumed: Quantiles
    """Seconds from a turn's warm camera until the robot could report motion, if it had not moved since it hid."""
    watched: float
    """Hours of watching, all robots of all runs."""
    false_alarms: float
    """Per hour of watching."""
    robot_alarms: float
    """Alerts caused by another robot that drove, per hour of watching."""
    shadow_alarms: float
    """Alerts caused by a person's shadow, per hour of watching."""
    preemptions: float
    """Per run."""
    blind: float
    """Holds released for lack of pictures, per run."""
    turned_unheld: float
    """Seconds per run that wheels turned without a hold."""
    longest_stop: float
    """Seconds, the worst of all runs."""


@dataclass(frozen=True, slots=True)
class StartFigures:
    """Figures of one robot's random starts in one building."""

    building: str
    starts: int
    dark: int
    """Starts that ended hidden in a truly dark place within the limit."""
    good: int
    """Of these, starts that ended facing the light."""
    seconds: Quantiles
    """Seconds until hidden, of the good starts."""
    bumped: float
    """Mean seconds of pushing against something."""


Figures: TypeAlias = FieldFigures | StartFigures


def field_figures(trials: Iterable[RobotsTrial]) -> dict[Field, FieldFigures]:
    """Figures of runs of nets, by field."""
    by_field: dict[Field, list[Outcomes]] = {}
    for trial in trials:
        if trial.job.field is not None and isinstance(trial.outcomes, Outcomes):
            by_field.setdefault(trial.job.field, []).append(trial.outcomes)
    return {field: _summed(field, runs) for field, runs in by_field.items()}


def _summed(field: Field, runs: Sequence[Outcomes]) -> FieldFigures:
    placed = [robot for run in runs for robot, at in run.placed.items() if at is not None]
    hours = sum(run.watched for run in runs) / 3600
    walks, crossings = sum(run.walks for run in runs), sum(run.crossings for run in runs)
    whole, of_robots = _account(runs)
    return FieldFigures(
        robots=field.robots,
        channels=field.channels,
        framegrabbers=field.receivers,
        baud=field.baud,
        command_rate=field.command_rate,
        slot=field.slots.hide,
        runs=len(runs),
        all_placed=quantiles_of([run.all_placed for run in runs]),
        placed=len(placed) / (field.robots * len(runs)),
        dark=_share(sum(sum(run.dark.values()) for run in runs), len(placed)),
        facing=_share(sum(sum(run.facing.values()) for run in runs), len(placed)),
        walks=walks,
        noticed=_share(sum(run.noticed for run in runs), walks),
        noticed_spread=quantiles_of([run.noticed / run.walks for run in runs if run.walks]),
        crossings=crossings,
        alerted=_share(sum(run.alerted for run in runs), crossings),
        account={fate: whole.fates[fate] for fate in FATES},
        in_time=whole.in_time,
        best=_share(whole.could, whole.all),
        of_best=_share(whole.told, whole.could),
        least=min((_share(robot.in_time, whole.in_time) for robot in of_robots), default=math.nan),
        least_watch=min((_least_watch(run, field) for run in runs), default=math.nan),
        resumed=quantiles_of([seconds for run in runs for seconds in run.resumed]),
        watched=hours,
        false_alarms=_share(sum(run.false_alarms for run in runs), hours),
        robot_alarms=_share(sum(run.robot_alarms for run in runs), hours),
        shadow_alarms=_share(sum(run.shadow_alarms for run in runs), hours),
        preemptions=sum(run.preemptions for run in runs) / len(runs),
        blind=sum(run.blind for run in runs) / len(runs),
        turned_unheld=sum(run.turned_unheld for run in runs) / len(runs),
        longest_stop=max(run.longest_stop for run in runs),
    )


def _account(runs: Sequence[Outcomes]) -> tuple[CrossingsOf, list[CrossingsOf]]:
    """Crossings of all runs together, and of each robot number that has FEW crossings or more in all runs."""
    whole, of_robots = CrossingsOf(), dict[int, CrossingsOf]()
    for run in runs:
        # By number, because buildings name their robots differently.
        for number, crossings in enumerate(run.account.values()):
            whole.add(crossings)
            of_robots.setdefault(number, CrossingsOf()).add(crossings)
    return whole, [crossings for crossings in of_robots.values() if crossings.all >= FEW]


def _least_watch(run: Outcomes, field: Field) -> float:
    """See `FieldFigures.least_watch`. Infinite if there was no time for TURNS turns of each."""
    turns = TURNS * field.slots.watch * field.robots / field.receivers
    if run.seconds - run.all_placed < turns:
        return math.inf
    watches = [run.watches.get(robot, 0.0) for robot in run.placed]
    return min(watches) / float(np.mean(watches)) if any(watches) else math.inf


def start_figures(trials: Iterable[RobotsTrial]) -> list[StartFigures]:
    """Figures of the starts of one robot by building, in the order of their first starts."""
    by_building: dict[str, list[hide.HideOutcome]] = {}
    for trial in trials:
        if isinstance(trial.outcomes, hide.HideOutcome):
            by_building.setdefault(trial.job.building, []).append(trial.outcomes)
    return [
        StartFigures(
            building=building,
            starts=len(those),
            dark=sum(start.hidden_at is not None and start.dark for start in those),
            good=sum(start.good for start in those),
            seconds=quantiles_of([start.hidden_at for start in those if start.good and start.hidden_at is not None]),
            bumped=float(np.mean([start.bumped for start in those])),
        )
        for building, those in by_building.items()
    ]


@dataclass(frozen=True, slots=True)
class RobotsReport:
    """Figures by robots and channels, by framegrabbers, by radio, by the length of turns, and of single robots."""

    grid: list[FieldFigures]
    receivers: list[FieldFigures]
    radio: list[FieldFigures]
    turns: list[FieldFigures]
    starts: list[StartFigures]


@dataclass(frozen=True, slots=True)
class StudyPlan:
    """Fields to try; without any, random starts of one robot."""

    grid: Sequence[Field] = ()
    receivers: Sequence[Field] = ()
    radio: Sequence[Field] = ()
    turns: Sequence[Field] = ()

    @staticmethod
    def of(
        robots: Sequence[int],
        channels: Sequence[int],
        framegrabbers: Sequence[int],
        bauds: Sequence[int],
        slots: Sequence[int],
    ) -> StudyPlan:
        """Fields for the given numbers only; without any numbers, all defaults."""
        everything = not (robots or channels or framegrabbers or bauds or slots)
        return StudyPlan(
            grid(robots or ROBOTS, channels or CHANNELS) if robots or channels or everything else (),
            receivers(framegrabbers or FRAMEGRABBERS) if framegrabbers or everything else (),
            radio(bauds or BAUDS) if bauds or everything else (),
            turns(slots or SLOTS) if slots or everything else (),
        )

    def jobs(self, names: Sequence[str], seeds: Iterable[int], seconds: float) -> list[RobotsJob]:
        """Every field in every building with every seed; duplicate fields run once."""
        fields = list(dict.fromkeys([*self.grid, *self.receivers, *self.radio, *self.turns]))
        # Seed by seed, so that a study that is stopped early is complete for its first seeds.
        places = [(name, seed) for seed in seeds for name in names]
        if not fields:
            return [RobotsJob(name, seed, None) for name, seed in places]
        return [RobotsJob(name, seed, field, seconds) for name, seed in places for field in fields]

    def report(self, trials: Sequence[RobotsTrial]) -> RobotsReport:
        by_field = field_figures(trials)
        return RobotsReport(
            grid=[by_field[field] for field in self.grid],
            receivers=[by_field[field] for field in self.receivers],
            radio=[by_field[field] for field in self.radio],
            turns=[by_field[field] for field in self.turns],
            starts=start_figures(trials),
        )


def quantiles_of(values: Sequence[float]) -> Quantiles:
    """Quantiles by nearest rank: without interpolation, so values may be infinite. NaN without values."""
    if not values:
        return Quantiles(math.nan, math.nan, math.nan)
    ranked = sorted(values)
    low, median, high = (ranked[max(0, math.ceil(share * len(ranked)) - 1)] for share in (0.1, 0.5, 0.9))
    return Quantiles(low, median, high)


def _share(part: float, whole: float) -> float:
    return part / whole if whole else math.nan

"""What more robots, video channels and radio bring: nets in buildings by the dozen, and what came of them.

A run of a net is `field`'s, a start of one robot is `hide`'s. Everything here is figures: percentiles over
runs, sums over what happened rarely.
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
"""As a building: another one for each seed."""
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
"""Crossings of a robot's place from which its share in time is told."""


@dataclass(frozen=True, slots=True)
class RobotsJob:
    """One run of a net, or with `field` None one start of one robot."""

    building: str
    seed: int
    field: Field | None
    seconds: float = SECONDS


@dataclass(frozen=True, slots=True)
class RobotsTrial:
    """A job, and what came of it."""

    job: RobotsJob
    outcomes: Outcomes | hide.HideOutcome


def buildings() -> list[str]:
    """Names that `plan_of` knows: those shipped, and DRAWN."""
    return [*shipped_plans(), DRAWN]


@lru_cache(maxsize=8)
def plan_of(building: str, seed: int) -> Plan:
    """A building by its name, or from its file. Raises BadInput for one that is not there, ValueError where
    none can be drawn."""
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
    """Carries out one job, in whatever process. Raises BadInput where the building has no room for it."""
    # One process, one processor: more threads would only get into the others' way.
    cv2.setNumThreads(1)
    try:
        plan = plan_of(job.building, job.seed)
        crew = plan if job.field is None else crewed(plan, job.field.robots, seed=job.seed)
    except ValueError as problem:
        raise BadInput(f"--building {job.building}, seed {job.seed}: {problem}") from None
    if job.field is None:
        outcome = hide.run(hide.HideJob(plan, job.seed))
        # Where it drove is of no use to the sums, and large.
        return RobotsTrial(job, replace(outcome, path=()))
    return RobotsTrial(job, FieldRun(crew, job.field, seed=job.seed).run(job.seconds))


def grid(robots: Iterable[int], channels: Iterable[int], baud: int = ENOUGH_BAUD) -> list[Field]:
    """Numbers of robots and channels in every pair; more channels than robots change nothing and are left
    out, unless that were all."""
    channels = sorted(set(channels))
    fields = []
    for count in sorted(set(robots)):
        useful = [one for one in channels if one <= count] or channels[:1]
        fields += [Field(robots=count, channels=one, baud=baud) for one in useful]
    return fields


def radio(bauds: Iterable[int]) -> list[Field]:
    """Radios of other rates, and behaviors that ask for fewer packets, with everything else plentiful."""
    return [
        Field(robots=RADIO_ROBOTS, channels=RADIO_CHANNELS, baud=baud, command_rate=rate)
        for rate in COMMAND_RATES
        for baud in sorted(set(bauds))
    ]


def receivers(framegrabbers: Iterable[int]) -> list[Field]:
    """Four robots with a channel each, and fewer framegrabbers: the next camera can warm up."""
    return [
        Field(robots=RADIO_ROBOTS, channels=RADIO_CHANNELS, framegrabbers=one % RADIO_CHANNELS)
        for one in sorted(set(framegrabbers))
        if one <= RADIO_CHANNELS
    ]


def turns(slots: Iterable[int]) -> list[Field]:
    """Four robots that take turns on one channel, with longer and shorter slots to hide in."""
    return [
        Field(robots=SLOT_ROBOTS, channels=SLOT_CHANNELS, slots=Slots(hide=float(slot))) for slot in sorted(set(slots))
    ]


@dataclass(frozen=True, slots=True)
class Quantiles:
    """10, 50 and 90 % of the runs are at or below; infinite where so many never came to it."""

    low: float
    median: float
    high: float


@dataclass(frozen=True, slots=True)
class FieldFigures:
    """Of all runs with the same means."""

    robots: int
    channels: int
    framegrabbers: int
    baud: int
    command_rate: float
    slot: float
    """Seconds of the slot to hide in."""
    runs: int
    all_placed: Quantiles
    """Seconds until the last of them was placed."""
    placed: float
    """Share of the robots that were placed within the run."""
    dark: float
    """Of these: in a truly dark place; NaN where none was placed. So are the shares below."""
    facing: float
    """Of these: truly facing the light."""
    walks: int
    noticed: float
    """Share of the walks."""
    noticed_spread: Quantiles
    """Of the runs' own shares, those with walks."""
    crossings: int
    alerted: float
    """Share of the crossings of a watching robot's picture that were alerted within a second."""
    account: dict[Fate, int]
    """All crossings of placed robots' places, held or not, by what became of them."""
    in_time: float
    """Share of them."""
    best: float
    """Share of them that could have been in time, as the robot was on the air, and its camera warm."""
    of_best: float
    """Share in time of those."""
    least: float
    """Share in time of the robot with the least, as a part of the mean of all robots; over those with FEW or more. A
    robot is its number, over all runs."""
    least_watch: float
    """By run, since all were placed: the time for which the robot watched that did so least, as a part of the mean of
    all. The least of the runs in which each could have had TURNS turns."""
    resumed: Quantiles
    """Seconds from a turn's warm camera until the robot could tell of motion, where it still stood as it had hidden."""
    watched: float
    """Hours of watching, all robots of all runs."""
    false_alarms: float
    """By hour of watching."""
    robot_alarms: float
    """Alerts at another robot that drove, by hour of watching."""
    shadow_alarms: float
    """Alerts at somebody's shadow, by hour of watching."""
    preemptions: float
    """By run."""
    blind: float
    """Holds given back for want of a picture, by run."""
    turned_unheld: float
    """Seconds by run that wheels turned without a hold."""
    longest_stop: float
    """Seconds, the worst of all runs."""


@dataclass(frozen=True, slots=True)
class StartFigures:
    """Of one robot's random starts in one building."""

    building: str
    starts: int
    dark: int
    """Hidden in a truly dark place within the limit."""
    good: int
    """And facing the light."""
    seconds: Quantiles
    """Until hidden, of the good ones."""
    bumped: float
    """Mean seconds of pushing against something."""


Figures: TypeAlias = FieldFigures | StartFigures


def field_figures(trials: Iterable[RobotsTrial]) -> dict[Field, FieldFigures]:
    """Sums up runs of nets by what they had to work with."""
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
        least=min((_share(one.in_time, whole.in_time) for one in of_robots), default=math.nan),
        least_watch=min((_least_watch(run, field) for run in runs), default=math.nan),
        resumed=quantiles_of([one for run in runs for one in run.resumed]),
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
    """Of all runs together, and of each robot over all of them, if it has FEW or more."""
    whole, of_robots = CrossingsOf(), dict[int, CrossingsOf]()
    for run in runs:
        # Buildings have names of their own for their robots.
        for number, one in enumerate(run.account.values()):
            whole.add(one)
            of_robots.setdefault(number, CrossingsOf()).add(one)
    return whole, [one for one in of_robots.values() if one.all >= FEW]


def _least_watch(run: Outcomes, field: Field) -> float:
    """Infinite where there was no time for TURNS turns of each."""
    turns = TURNS * field.slots.watch * field.robots / field.receivers
    if run.seconds - run.all_placed < turns:
        return math.inf
    watches = [run.watches.get(robot, 0.0) for robot in run.placed]
    return min(watches) / float(np.mean(watches)) if any(watches) else math.inf


def start_figures(trials: Iterable[RobotsTrial]) -> list[StartFigures]:
    """Sums up the starts of one robot by building, in the order in which they first come."""
    by_building: dict[str, list[hide.HideOutcome]] = {}
    for trial in trials:
        if isinstance(trial.outcomes, hide.HideOutcome):
            by_building.setdefault(trial.job.building, []).append(trial.outcomes)
    return [
        StartFigures(
            building=building,
            starts=len(those),
            dark=sum(one.hidden_at is not None and one.dark for one in those),
            good=sum(one.good for one in those),
            seconds=quantiles_of([one.hidden_at for one in those if one.good and one.hidden_at is not None]),
            bumped=float(np.mean([one.bumped for one in those])),
        )
        for building, those in by_building.items()
    ]


@dataclass(frozen=True, slots=True)
class RobotsReport:
    """What a study found: by robots and channels, by framegrabbers, by radio, by the length of turns, and of single
    robots."""

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
        """Only what is given is tried; without anything, all."""
        everything = not (robots or channels or framegrabbers or bauds or slots)
        return StudyPlan(
            grid(robots or ROBOTS, channels or CHANNELS) if robots or channels or everything else (),
            receivers(framegrabbers or FRAMEGRABBERS) if framegrabbers or everything else (),
            radio(bauds or BAUDS) if bauds or everything else (),
            turns(slots or SLOTS) if slots or everything else (),
        )

    def jobs(self, names: Sequence[str], seeds: Iterable[int], seconds: float) -> list[RobotsJob]:
        """Every field in every building with every seed; a field that comes twice is run once."""
        fields = list(dict.fromkeys([*self.grid, *self.receivers, *self.radio, *self.turns]))
        # Seed by seed, so that what is there when somebody stops early is a whole study of fewer seeds.
        places = [(name, seed) for seed in seeds for name in names]
        if not fields:
            return [RobotsJob(name, seed, None) for name, seed in places]
        return [RobotsJob(name, seed, one, seconds) for name, seed in places for one in fields]

    def report(self, trials: Sequence[RobotsTrial]) -> RobotsReport:
        by_field = field_figures(trials)
        return RobotsReport(
            grid=[by_field[one] for one in self.grid],
            receivers=[by_field[one] for one in self.receivers],
            radio=[by_field[one] for one in self.radio],
            turns=[by_field[one] for one in self.turns],
            starts=start_figures(trials),
        )


def quantiles_of(values: Sequence[float]) -> Quantiles:
    """By nearest rank: no value is made up between two, and infinite ones do no harm. NaN of nothing."""
    if not values:
        return Quantiles(math.nan, math.nan, math.nan)
    ranked = sorted(values)
    low, median, high = (ranked[max(0, math.ceil(share * len(ranked)) - 1)] for share in (0.1, 0.5, 0.9))
    return Quantiles(low, median, high)


def _share(part: float, whole: float) -> float:
    return part / whole if whole else math.nan

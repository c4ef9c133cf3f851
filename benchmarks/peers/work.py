"""The work: a contender's programs and their orders, zscout's in turn with a peer's."""

from __future__ import annotations

import itertools
import os
import random
import signal
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from benchmarks.bare import BareQuery
from benchmarks.child import Child
from benchmarks.peers.peer import LEASE, RCS
from benchmarks.peers.report import Figure
from benchmarks.stats import Samples

PROGRAMS = 4
BEHAVIORS = 20
MOST = 5
SEED = 2002
HOT = 3
"""Consecutive runs of each measurement, of which the last counts: as in benchmarks/latency.py."""
LEAST_ROUNDS = 5
WARM_UP = 10
"""One part in WARM_UP of the rounds, or of the seconds, is the warm-up."""
SLOW = 0.25
"""Seconds above which warm caches don't matter: a single run is enough."""
CHECK = 1.0
CHECK_HOLD = 0.005
"""The crowd's first round, of CHECK seconds, only checks for double holds: each behavior keeps its RCs for CHECK_HOLD
seconds. In the rounds that count, it gives them back at once."""
KILLS = 3
NEVER = 15.0
"""Seconds after which a killed holder's RCs count as never freed."""

Progress = Callable[[str], None]


class DoubleBooked(Exception):
    """Two behaviors held one RC at once: the contender is no lock."""


@dataclass(frozen=True, slots=True)
class Team:
    """A contender's programs."""

    key: str
    address: str
    folder: Path
    programs: list[Child]

    def arguments(self, name: str) -> tuple[str, ...]:
        return "peers.program", self.key, self.address, name, str(self.folder / f"{name}.log")


@contextmanager
def team(key: str, address: str, folder: Path) -> Iterator[Team]:
    with ExitStack() as stack:
        made = Team(key, address, folder, [])
        for number in range(PROGRAMS):
            program = Child.of(*made.arguments(f"p{number}"))
            stack.callback(program.close)
            made.programs.append(program)
        for program in made.programs:
            program.report()
        yield made


@dataclass(slots=True)
class Taken:
    """Samples of one kind of work."""

    home: Samples
    away: Samples
    bare: Samples

    def figure(self, work: str, who: str, *, away: bool) -> Figure:
        taken = self.away if away else self.home
        return Figure(
            work,
            who,
            taken.median * 1e6,
            taken.p99 * 1e6,
            taken.median / self.home.median if away else 1.0,
            taken.median / self.bare.median,
            len(taken.values),
        )


def uncontended(team: Team, rcs: list[str]) -> float:
    program = team.programs[0]
    program.order({"do": "time", "rcs": rcs, "times": HOT})
    return float(program.report())


def next_waiter(team: Team, rcs: list[str]) -> float:
    """Return the seconds from one program's release to another program's grant."""
    holder, waiter = team.programs[:2]
    took = 0.0
    for _ in range(HOT):
        holder.order({"do": "hold_on", "rcs": rcs})
        assert holder.report() == "holds"
        waiter.order({"do": "wait", "rcs": rcs, "seconds": NEVER})
        assert waiter.report() == "waits"
        holder.order({"do": "let_go"})
        start, end = holder.report(), waiter.report()
        assert end is not None, "a release did not reach the waiter"
        took = end - start
        if took > SLOW:
            break
    return took


def latencies(
    home: Team, away: Team, bare: BareQuery, rounds: int, seconds: float, progress: Progress
) -> dict[str, Taken]:
    """Measure zscout (`home`), a peer (`away`) and the bare query in turn, for `rounds`, or at most `seconds`."""
    measures: dict[str, Callable[[Team], float]] = {
        "one": lambda team: uncontended(team, RCS[:1]),
        "five": lambda team: uncontended(team, RCS[:5]),
        "next": lambda team: next_waiter(team, RCS[:5]),
    }
    taken = {name: Taken(Samples(), Samples(), Samples()) for name in measures}
    warm = time.monotonic() + seconds / WARM_UP
    end = time.monotonic() + seconds
    for number in range(-rounds // WARM_UP, rounds):
        if number < 0 and time.monotonic() > warm:
            continue
        if time.monotonic() > end and number >= LEAST_ROUNDS:
            progress(f"  {number} rounds in {seconds:g} s")
            break
        for name, measure in measures.items():
            for _ in range(HOT):
                reference = bare.once()
            ours, theirs = measure(home), measure(away)
            if number >= 0:
                taken[name].bare.add(reference)
                taken[name].home.add(ours)
                taken[name].away.add(theirs)
    return taken


def sets() -> list[list[str]]:
    """Return the RCs that each behavior needs: the same for every contender and in every round."""
    rng = random.Random(SEED)  # noqa: S311
    return [rng.sample(RCS, rng.randint(1, MOST)) for _ in range(BEHAVIORS)]


@dataclass(slots=True)
class Crowd:
    """Grants per second in each round, and the number of grants of each behavior."""

    rates: list[float]
    served: list[int]

    @property
    def rate(self) -> float:
        return statistics.median(self.rates)

    @property
    def least(self) -> float:
        return min(self.served) / statistics.fmean(self.served)


def crowds(teams: list[Team], rounds: int, seconds: float) -> list[Crowd]:
    """Run the teams in turn, each after a check for double holds. Raises DoubleBooked."""
    found = [Crowd([], [0] * BEHAVIORS) for _ in teams]
    for number in range(-1, rounds):
        for team, crowd in zip(teams, found, strict=True):
            counts = _crowd(team, seconds, 0.0) if number >= 0 else _crowd(team, CHECK, CHECK_HOLD)
            if number >= 0:
                crowd.rates.append(sum(counts) / seconds)
                crowd.served = [before + now for before, now in zip(crowd.served, counts, strict=True)]
    return found


def _crowd(team: Team, seconds: float, hold: float) -> list[int]:
    """Return the number of grants of each behavior, which keeps its RCs for `hold` seconds."""
    needs = sets()
    share = BEHAVIORS // PROGRAMS
    for number, program in enumerate(team.programs):
        part = needs[number * share : (number + 1) * share]
        program.order({"do": "crowd", "sets": part, "seconds": seconds, "hold": hold})
    reports = [program.report() for program in team.programs]
    held = [spans for report in reports for spans in report["held"]]
    for rc in RCS:
        spans = sorted(span for rcs, spans in zip(needs, held, strict=True) if rc in rcs for span in spans)
        for (_, end), (start, _) in itertools.pairwise(spans):
            if start < end:
                raise DoubleBooked(f"{rc} was held twice at once")
    # Grants after the end of the time don't count.
    return [sum(start < report["until"] for start, _ in spans) for report in reports for spans in report["held"]]


def killed(team: Team, progress: Progress) -> Figure:
    """Measure the seconds from a holder's death to the waiter's grant; the caller sets `who`."""
    rcs, waiter = RCS[:5], team.programs[1]
    took: list[float] = []
    for number in range(KILLS):
        name = f"victim{number}"
        holder = Child.of(*team.arguments(name))
        try:
            pid = holder.report()
            holder.order({"do": "hold_on", "rcs": rcs})
            assert holder.report() == "holds"
            waiter.order({"do": "wait", "rcs": rcs, "seconds": NEVER})
            assert waiter.report() == "waits"
            start = time.monotonic()
            os.kill(pid, signal.SIGKILL)
        finally:
            holder.close()
        end = waiter.report()
        if end is None:
            progress(f"  never within {NEVER:g} s")
            return Figure("killed", "", None, rounds=1, note=f"never within {NEVER:g} s")
        took.append(end - start)
    return Figure("killed", "", statistics.median(took), rounds=KILLS, note=f"lease {LEASE} s")

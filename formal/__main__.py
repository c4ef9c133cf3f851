"""`make model`: what TLC says of `ownership.tla`, `entering.tla` and `settling.tla`. Each guard of the protocol is
taken out in turn as well, and must break something.

`python -m formal traces FILE...` and `--simulated COUNT`: whether what a fleet did is a behaviour of the model."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from formal.tlc import ENTERING, GUARDS, SETTLING, Instance, NoTlc, Outcome, check, check_entering, check_settling, jar
from formal.traces import Behaviour, accept
from studies.faults.simulation import simulate
from zscout import terminal

INSTANCES = (
    Instance("safety", terms=3, steps=3, joins=3),
    Instance("safety, more reigns", terms=4, steps=2, joins=2),
    Instance("progress", terms=3, steps=2, joins=3, losses=False, fair=True),
    Instance("progress, longer reigns", terms=2, steps=3, joins=4, losses=False, fair=True),
)
WITHOUT = tuple(
    Instance(f"without {guard}", terms=2, steps=3, joins=3, guards=tuple(one for one in GUARDS if one != guard))
    for guard in GUARDS
)

HOLDS = 4
"""Of one RC, in `settling.tla`."""


@dataclass(frozen=True, slots=True)
class Check:
    """One question to TLC, and whether something is to break."""

    name: str
    bounds: str
    ask: Callable[[], Outcome]
    breaks: bool


def checks() -> Iterator[Check]:
    for instance in (*WITHOUT, *INSTANCES):
        bounds = f"{instance.terms} terms of {instance.joins} steps"
        yield Check(instance.name, bounds, partial(check, instance), instance in WITHOUT)
    for without in (*ENTERING, ""):
        name = f"entering without {without}" if without else "entering"
        terms, numbers = (2, 3) if without else (3, 3)
        ask = partial(check_entering, without, terms=terms, numbers=numbers)
        yield Check(name, f"{terms} terms of {numbers} numbers", ask, bool(without))
    for without in (*SETTLING, ""):
        name = f"settling without {without}" if without else "settling"
        yield Check(name, f"{HOLDS} holds", partial(check_settling, without, holds=HOLDS), bool(without))


def main(words: list[str]) -> int:
    try:
        jar()
    except NoTlc as error:
        terminal.print_line(f"skipped: {error}")
        return 0
    return traces(words[1:]) if words[:1] == ["traces"] else model(words)


def model(names: list[str]) -> int:
    rows, failed = [], False
    for one in checks():
        if names and one.name not in names:
            continue
        terminal.print_line(f"{one.name} ...")
        outcome = one.ask()
        unexpected = (outcome.violated is not None) != one.breaks
        failed |= unexpected
        said = f"breaks {outcome.violated}" if outcome.violated else "holds"
        rows.append([one.name, one.bounds, f"{outcome.states:,}", f"{outcome.took:.0f} s", said])
        if unexpected:
            terminal.print_line(outcome.text)
    terminal.print_table(["model", "bounds", "states", "took", "outcome"], rows)
    return 1 if failed else 0


def traces(words: list[str]) -> int:
    options = argparse.ArgumentParser(prog="python -m formal traces", description=__doc__)
    options.add_argument(
        "files", nargs="*", type=Path, metavar="FILE", help="lines of zscout.trace, in the order of time"
    )
    options.add_argument("--simulated", type=int, default=0, metavar="COUNT", help="so many runs of the simulator")
    options.add_argument("--seed", type=int, default=0, help="of the first of them (0)")
    asked = options.parse_args(words)
    seeds = range(asked.seed, asked.seed + asked.simulated)
    names = [*map(str, asked.files), *(f"seed {seed}" for seed in seeds)]
    began = time.monotonic()
    behaviours = [Behaviour(file.read_text().splitlines()) for file in asked.files]
    behaviours += [Behaviour(simulate(seed, traced=True).trace) for seed in seeds]
    read = time.monotonic() - began
    verdict = accept(behaviours)
    for number, where in verdict.refused.items():
        terminal.print_line(f"{names[number]} is no behaviour of the model: {where}")
    pieces, actions = (
        sum(counts) for counts in zip(*((len(one.pieces), one.actions) for one in behaviours), strict=True)
    )
    terminal.print_line(
        f"{len(behaviours):,} traces in {pieces:,} pieces, {actions:,} actions: {len(verdict.refused)} refused; "
        f"{verdict.states:,} states, TLC took {verdict.took:.0f} s, reading {read:.0f} s"
    )
    return 1 if verdict.refused else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

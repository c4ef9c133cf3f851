"""`python -m studies NAME`: experiments that back the figures of the docs. Without a name: the list."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Final, NamedTuple

import click

from zscout.cli.main import run_command
from zscout.terminal import print_table


class Study(NamedTuple):
    entry: str
    """Module below `studies`, and its click command or function."""
    question: str
    takes: str
    """Estimated duration on two cores."""


STUDIES: Final[dict[str, Study]] = {
    "schedule": Study("scheduling.commands:schedule", "Which strategy uses devices best, and who waits?", "4 min"),
    "bookings": Study("scheduling.commands:bookings", "What do bookings cost, and what do their owners gain?", "2 min"),
    "forecasts": Study("scheduling.commands:forecasts", "How close are predicted start times?", "2 min"),
    "shares": Study("scheduling.commands:shares", "Are two groups treated equally, and can one cheat?", "3 min"),
    "traces": Study("scheduling.commands:traces", "How long do the jobs of a real trace wait?", "20 min, a trace"),
    "clairvoyant": Study(
        "scheduling.clairvoyant:clairvoyant", "How much longer than the least do requests wait?", "8 min"
    ),
    "strategies": Study("strategies:main", "How far is each strategy from the best set?", "5 min"),
    "placement": Study("placement.commands:placement", "Which policy places components best?", "15 s"),
    "robots": Study("robots.commands:robots", "How soon are robots hidden, and what do they then see?", "30 min"),
    "watching": Study("watching:main", "How many passers-by does the motion detector report?", "20 min"),
    "cdnet": Study("cdnet:main", "How does the motion detector compare with MOG2 and KNN on CDnet 2014?", "1 min"),
    "detectors": Study("detectors:main", "Where does the motion detector fail, and do MOG2 and KNN?", "1 min"),
    "faults": Study("faults.commands:faults", "Are all promises kept under faults, in virtual time?", "3 min"),
    "chaos": Study("chaos.__main__:main", "Are all promises kept in a real fleet under faults?", "20 min, root"),
    "soak": Study("chaos.soak:main", "What does a fleet use after hours?", "8 h, root"),
    "overlap": Study("overlap:main", "Do two programs ever run at one exclusive device?", "10 min, root"),
    "sites": Study("sites:main", "Is nothing lost when the relay between two sites fails?", "15 min, root"),
    "interfaces": Study("interfaces:main", "Which holds feel that interfaces come and go?", "20 min, root"),
    "guards": Study("suite:guards", "Which guards of the protocol does the quick tier of tests notice?", "30 min"),
    "coverage": Study("suite:coverage", "What do slow tests alone reach?", "40 min"),
    "booking-cost": Study("booking_cost:main", "What does a booking cost beside a bare query?", "1 min"),
    "building": Study("building:main", "What does serving a simulated building cost?", "1 min"),
    "doors": Study("doors:main", "What do certificates cost, and what does a stranger do to an open fleet?", "5 min"),
    "frames": Study("frames:main", "How long from a robot's picture to the motor command that follows?", "3 min"),
    "hosts": Study("hosts:main", "How many hosts can one load balancer rank?", "5 min"),
    "journal": Study("journal:main", "What does a journal of 100,000 holds cost?", "1 min"),
    "leader": Study("leader:main", "How large is the leader, what does a grant cost it, what stops it?", "3 min"),
    "metrics": Study("metrics:main", "What do Prometheus figures cost a node?", "1 min"),
    "publication": Study("publication:main", "What does a publication cost its leader, by listeners?", "2 min"),
    "viewer": Study("viewer:main", "How soon does a browser show a whole recording?", "5 min"),
}


def main(arguments: Sequence[str]) -> int:
    """Run the study that the first argument names; return an exit code."""
    name, *rest = arguments or [""]
    if name in ("", "-h", "--help"):
        print_table(["name", "question", "takes about"], [[known, *found[1:]] for known, found in STUDIES.items()])
        return 0
    study = STUDIES.get(name)
    if study is None:
        print(f"studies: unknown study {name!r}; write one of: {', '.join(STUDIES)}", file=sys.stderr)
        return 2
    module, _, entry = study.entry.partition(":")
    run = getattr(import_module(f"studies.{module}"), entry)
    program = f"python -m studies {name}"
    if isinstance(run, click.Command):
        code = run_command(lambda: run.main(rest, program, standalone_mode=False), "studies")
        return code if isinstance(code, int) else 0
    sys.argv = [program, *rest]
    return run() or 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))

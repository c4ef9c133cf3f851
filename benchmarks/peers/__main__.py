"""`make bench-peers`: the same work done by zscout and by its peers, as ratios of one run."""

from __future__ import annotations

import argparse
import json
import os
import platform
import random
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import zenoh

from benchmarks import bare, face
from benchmarks.child import child
from benchmarks.loop import run
from benchmarks.peers import work
from benchmarks.peers.peer import NAMES, Missing, Peer, last_line, load
from benchmarks.peers.report import Figure, Report
from benchmarks.stats import Samples
from zscout import messages
from zscout.messages import Ask

HOME = NAMES[0]


def progress(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


@contextmanager
def bare_query() -> Iterator[bare.BareQuery]:
    """Prepare the bare query of `python -m benchmarks`, with the sizes of a request for one RC and of its grant."""
    ask = len(messages.encode(Ask("0123456789ab", "bench", {"robot/r0": {}}, 0, 60)))  # type: ignore[arg-type]
    address = f"224.0.0.225:{random.randint(20_000, 60_000)}"  # noqa: S311
    size = str(len(messages.encode(face.NOTICE)))
    with child("bare", address, bare.KEY, "--bytes", size), zenoh.open(bare.settings(address)) as session:
        query = bare.BareQuery(b"x" * ask)
        query.choose(session)
        yield query


class Bench:
    """Compares each peer with zscout's own team."""

    def __init__(self, query: bare.BareQuery, home: work.Team, args: argparse.Namespace) -> None:
        self._query, self._home, self._args = query, home, args
        self.report = Report()
        self._ours = {name: work.Taken(Samples(), Samples(), Samples()) for name in ("one", "five", "next")}
        self._our_crowd = work.Crowd([], [0] * work.BEHAVIORS)

    async def contender(self, name: str, folder: Path) -> None:
        """Measure all work of one peer, or record why it can't be measured."""
        who = name
        try:
            peer = load(name)
            who = peer.name
            self.report.versions[who] = peer.version()
            progress(f"{who}: starting")
            await self._measure(peer, name, folder)
        except Missing as missing:
            self.report.versions.pop(who, None)
            self.report.missing[who] = str(missing)
        except (AssertionError, work.DoubleBooked) as failed:
            self.report.missing[who] = f"it failed: {failed}; {_said(folder)}; {_said(self._home.folder)}"
        if who in self.report.missing:
            progress(f"{who}: {self.report.missing[who]}")

    async def _measure(self, peer: Peer, name: str, folder: Path) -> None:
        args, figures = self._args, []
        async with peer.serve(folder) as address:
            with work.team(name, address, folder) as away:
                progress(f"{peer.name}: latencies")
                taken = work.latencies(self._home, away, self._query, args.rounds, args.seconds, progress)
                for kind, samples in taken.items():
                    figures.append(samples.figure(kind, peer.name, away=True))
                    for mine, new in ((self._ours[kind].home, samples.home), (self._ours[kind].bare, samples.bare)):
                        mine.values += new.values
                progress(f"{peer.name}: 20 behaviors")
                ours, theirs = work.crowds([self._home, away], args.crowds, 2.0)
                figures += self._crowd(peer.name, theirs, ours, taken["one"].bare.median)
                self._our_crowd.rates += ours.rates
                served = zip(self._our_crowd.served, ours.served, strict=True)
                self._our_crowd.served = [before + now for before, now in served]
                progress(f"{peer.name}: a killed holder")
                figures.append(replace(work.killed(away, progress), who=peer.name))
        self.report.figures += figures
        self.report.lacks[peer.name] = peer.lacks

    @staticmethod
    def _crowd(who: str, crowd: work.Crowd, ours: work.Crowd, query: float) -> list[Figure]:
        to_bare, rounds = 1 / crowd.rate / query, len(crowd.rates)
        return [
            Figure("crowd", who, crowd.rate, None, crowd.rate / ours.rate, to_bare, rounds),
            Figure("least", who, crowd.least, rounds=rounds),
        ]

    def finish(self) -> None:
        """Add zscout's own rows, from all pairs of this run, before all others."""
        if not self._our_crowd.rates:
            return
        figures = [taken.figure(kind, HOME, away=False) for kind, taken in self._ours.items()]
        query = self._ours["one"].bare.median
        figures += self._crowd(HOME, self._our_crowd, self._our_crowd, query)
        progress(f"{HOME}: a killed holder")
        figures.append(replace(work.killed(self._home, progress), who=HOME))
        ours = next(figure.value for figure in figures if figure.work == "killed")
        asked = self._ours["one"].bare
        bare_row = Figure("one", "bare query", query * 1e6, asked.p99 * 1e6, None, 1.0, len(asked.values))
        self.report.figures = [bare_row, *figures, *self.report.figures]
        self.report.figures = [
            replace(figure, to_zscout=figure.value / ours)
            if figure.work == "killed" and figure.value and ours
            else figure
            for figure in self.report.figures
        ]


def _made(folder: Path) -> Path:
    folder.mkdir()
    return folder


def _said(folder: Path) -> str:
    """Return the last log line of each program whose log is in `folder`."""
    said = [f"{log.stem}: {last_line(log)}" for log in sorted(folder.glob("p?.log")) if log.stat().st_size]
    return "; ".join(said) or "its programs logged nothing"


async def measure(args: argparse.Namespace) -> Report:
    with tempfile.TemporaryDirectory(prefix="zsp-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        progress(f"{HOME}: starting")
        zscout = load(HOME)
        async with zscout.serve(_made(folder / "home")) as address:
            with bare_query() as query, work.team(HOME, address, folder / "home") as home:
                bench = Bench(query, home, args)
                bench.report.versions[zscout.name] = zscout.version()
                for peer in args.peers:
                    await bench.contender(peer, _made(folder / peer))
                bench.finish()
                return bench.report


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.peers", description=__doc__)
    parser.add_argument("peers", nargs="*", metavar="PEER", help=f"of {', '.join(NAMES[1:])} (default: all)")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of tables")
    parser.add_argument("--rounds", type=int, default=150, help="rounds of each latency (default: 150)")
    parser.add_argument(
        "--seconds", type=float, default=20.0, help="most seconds for the latencies of one peer (default: 20)"
    )
    parser.add_argument("--crowds", type=int, default=3, help="rounds of the 20 behaviors (default: 3)")
    args = parser.parse_args()
    unknown = set(args.peers) - set(NAMES[1:])
    if unknown:
        parser.error(f"no peer named {', '.join(sorted(unknown))}; there are {', '.join(NAMES[1:])}")
    if args.rounds < work.LEAST_ROUNDS or not 1 <= args.seconds <= 600 or not 1 <= args.crowds <= 100:
        parser.error(f"at least {work.LEAST_ROUNDS} rounds, 1 to 600 seconds, 1 to 100 crowds")
    args.peers = args.peers or list(NAMES[1:])
    start, load_before = time.monotonic(), os.getloadavg()[0]
    report = run(measure(args))
    report.machine = {
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "load_average_at_start": round(load_before, 2),
        "load_average_at_end": round(os.getloadavg()[0], 2),
        "seconds": round(time.monotonic() - start),
    }
    if args.json:
        print(json.dumps(report.as_json(), indent=2))
        return
    print(report.text())
    machine = report.machine
    loads = f"{machine['load_average_at_start']} before, {machine['load_average_at_end']} after"
    print(
        f"{machine['cores']} cores, Python {machine['python']}; {machine['seconds']} s; load average {loads} "
        "(the benchmark's own work included).\n"
        "Medians. A peer's ratios are to zscout and to the bare query in turn with it, A B A B."
    )


if __name__ == "__main__":
    main()

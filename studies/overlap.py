"""Does `exclusive` mean exclusive? Successive `zscout request` commands run a program that ignores SIGTERM, holds a
lock file and leaves a child with the same lock in a session of its own. Does the next program ever run beside it, and
how long does it wait?

    python -m studies overlap --times 20 --cut 5 --kill 5        (needs root, network namespaces, iproute2)

Some holds end because the program's host is cut off, some by `kill -9` of their `zscout request`, some by freezing it;
the others by preemption. Exit code 0: no program ran beside another, or waited for longer than the rule allows; 1: one
did; 2: it can't run here."""

from __future__ import annotations

import argparse
import itertools
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from statistics import median
from typing import Any, Final, Literal, NamedTuple, Self

from studies.chaos import net
from studies.chaos.net import Net
from zscout.behaviors.client.direct import DEFAULT_SETTLE
from zscout.config.fleet import default_fleet
from zscout.mesh import clock
from zscout.types import SECOND, Ns

How = Literal["preempted", "cut off", "killed", "frozen"]

RC: Final = "robot/x"
LEADER, DEVICE, LEFT, RIGHT = "lead", "device", "left", "right"
LOOK: Final = 0.02
WITHIN: Final = 600.0
"""Longest wait for any condition, in seconds."""
FOREVER: Final = "1h"
SLACK: Final = 2.0
"""Seconds in addition to the rule: from a client's query whether its RC has settled to its program's first line, on a
busy machine."""

PROGRAM: Final = """
import fcntl, os, signal, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
folder, number = sys.argv[1:]
lock = open(f"{folder}/lock", "a")
try:
    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    word = "alone"
except OSError:
    word = "beside"
with open(f"{folder}/programs", "a") as told:
    told.write(f"{number} {word} {time.clock_gettime_ns(time.CLOCK_BOOTTIME)}\\n")
if os.fork() == 0:
    os.setsid()
    if os.fork():
        os._exit(0)
time.sleep(3600)
"""
"""For `python -S -c`. Both its processes share its lock, which is free when the last of them is gone."""


class NeverCame(Exception):
    """A condition was not met in time."""


class Begun(NamedTuple):
    """The start of a program: `alone` if no other program ran, and when."""

    alone: bool
    at: Ns


class Programs:
    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def command(self, number: int) -> list[str]:
        return [sys.executable, "-S", "-c", PROGRAM, str(self.folder), str(number)]

    def begun(self) -> dict[int, Begun]:
        with suppress(FileNotFoundError):
            lines = (self.folder / "programs").read_text().splitlines()
            return {int(number): Begun(word == "alone", int(at)) for number, word, at in map(str.split, lines)}
        return {}


class Taken(NamedTuple):
    """A program that followed another. Times in ns of this host's clock."""

    how: How
    ended: Ns
    """When the former hold was ended: by a fault, or by the grant."""
    begun: Begun

    @property
    def waited(self) -> float:
        return (self.begun.at - self.ended) / SECOND

    @property
    def allowed(self) -> float:
        """Seconds by rule 2: `settle` from the client's `leaving`, or a hold lease and `settle` from the last
        confirmation."""
        lease = 0 if self.how == "preempted" else default_fleet().timing.hold_lease
        return (lease + DEFAULT_SETTLE) / SECOND


class Request:
    """A `zscout request` on a host, and the times of its events."""

    def __init__(self, host: str, command: list[str], env: dict[str, str], log: Path) -> None:
        self.host, self._log = host, log
        self.process = subprocess.Popen(
            command, env=env, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        self.events: dict[str, Ns] = {}
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self) -> None:
        assert self.process.stderr is not None
        with self._log.open("a") as log:
            for line in self.process.stderr:
                log.write(line)
                with suppress(ValueError):
                    self.events.setdefault(json.loads(line)["event"], clock.now())


class Rounds:
    """A fleet in its own namespaces: a leader, a device, and two hosts whose programs follow each other."""

    def __init__(self, folder: Path) -> None:
        self.net = Net((LEADER, DEVICE, LEFT, RIGHT))
        self.folder, self.programs = folder, Programs(folder)
        self._started: list[subprocess.Popen[Any]] = []
        self._requests: list[Request] = []
        self._env = {name: value for name, value in os.environ.items() if not name.startswith("ZSCOUT_")}

    def __enter__(self) -> Self:
        try:
            self.net.open()
            (self.folder / "fleet.toml").write_text(
                f'[fleet]\nname = "overlap-{self.net.mark}"\n'
                '[mesh]\nmulticast_address = "224.0.0.224:7446"\ninterface = "eth0"\n'
            )
            device = f'candidate = false\n[[rc]]\nname = "{RC}"\ndriver = "exclusive"\n'
            for host, text in ((LEADER, ""), (DEVICE, device)):
                file = self.folder / f"{host}.toml"
                file.write_text(f'[node]\nhost = "{host}"\nfleet = "fleet.toml"\n{text}')
                with (self.folder / f"{host}.log").open("ab") as log:
                    node = [*self._in(host), "-m", "zscout.node", str(file)]
                    self._started.append(subprocess.Popen(node, env=self._env, stdout=log, stderr=log))
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *exc: object) -> None:
        processes = [*(request.process for request in self._requests), *self._started]
        for process in processes:
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.terminate()
        for process in processes:
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self.net.close()

    def _in(self, host: str) -> list[str]:
        return ["ip", "netns", "exec", self.net.space(host), sys.executable]

    def request(self, number: int, priority: int) -> Request:
        host = (LEFT, RIGHT)[number % 2]
        how = ["--name", f"p{number}", "--priority", str(priority), "--min-runtime", FOREVER, "--json"]
        command = [*self._in(host), "-m", "zscout.cli.main", "request", RC, *how, "--", *self.programs.command(number)]
        env = self._env | {"ZSCOUT_FLEET": str(self.folder / "fleet.toml"), "ZSCOUT_HOST": host}
        self._requests.append(Request(host, command, env, self.folder / f"{host}.log"))
        return self._requests[-1]

    def run(self, hows: list[How], report: Callable[[Taken], None]) -> list[Taken]:
        """Raises NeverCame."""
        priority = 0
        former = self._first()
        taken: list[Taken] = []
        for number, how in enumerate(hows, start=1):
            priority += how == "preempted"
            following = self.request(number, priority)
            taken.append(self._follow(how, former, following, number))
            report(taken[-1])
            self._restore(former)
            former = following
        return taken

    def _first(self) -> Request:
        """The first request, as soon as a leader sees the device."""
        first = self.request(0, 0)

        def runs() -> bool:
            nonlocal first
            if first.process.poll() is not None:
                first = self.request(0, 0)
            return 0 in self.programs.begun()

        self._until("the first program runs", runs)
        return first

    def _follow(self, how: How, former: Request, following: Request, number: int) -> Taken:
        if how == "preempted":
            self._until("it preempts", lambda: following.events.keys() & {"settling", "granted"}, following)
            ended = min(at for event, at in following.events.items() if event in ("settling", "granted"))
        else:
            self._until("it waits", lambda: "waits" in following.events, following)
            ended = clock.now()
            self._strike(how, former)
        self._until("the next program runs", lambda: number in self.programs.begun(), following)
        return Taken(how, ended, self.programs.begun()[number])

    def _strike(self, how: How, request: Request) -> None:
        if how == "cut off":
            others = [host for host in self.net.hosts if host != request.host]
            self.net.cut({way for host in others for way in ((host, request.host), (request.host, host))})
        else:
            request.process.send_signal(signal.SIGKILL if how == "killed" else signal.SIGSTOP)

    def _restore(self, request: Request) -> None:
        """Restore the host of the former request, and wait until its client has ended."""
        self.net.cut(())
        request.process.send_signal(signal.SIGCONT)
        request.process.terminate()
        self._until("the former request has ended", lambda: request.process.poll() is not None)

    def _until(self, what: str, done: Callable[[], object], of: Request | None = None) -> None:
        """Raises NeverCame if it takes too long, or if the request `of` has ended."""
        deadline = time.monotonic() + WITHIN
        while not done():
            ended = of is not None and of.process.poll() is not None
            if ended or time.monotonic() > deadline:
                why = "its request ended" if ended else f"not within {WITHIN:g} s"
                raise NeverCame(f"{why}: {what}; see the logs in {self.folder}")
            time.sleep(LOOK)


def main() -> int:
    options = argparse.ArgumentParser(prog="python -m studies overlap", description=__doc__.partition("\n\n")[0])
    options.add_argument("--times", type=int, default=20, help="number of ended holds (20)")
    options.add_argument("--cut", type=int, default=5, help="of these, by cutting the program's host off (5)")
    options.add_argument("--kill", type=int, default=5, help="of these, by kill -9 of its zscout request (5)")
    options.add_argument("--freeze", type=int, default=0, help="of these, by SIGSTOP of its zscout request (0)")
    options.add_argument("--seed", type=int, default=1, help="seed of their order (1)")
    options.add_argument("--slack", type=float, default=SLACK, help=f"seconds in addition to the rule ({SLACK:g})")
    asked = options.parse_args()
    faults: dict[How, int] = {"cut off": asked.cut, "killed": asked.kill, "frozen": asked.freeze}
    faults["preempted"] = asked.times - sum(faults.values())
    hows = [how for how, times in faults.items() for _ in range(times)]
    random.Random(asked.seed).shuffle(hows)  # noqa: S311
    try:
        net.check()
    except net.NoNamespaces as error:
        print(f"overlap: {error}", file=sys.stderr)
        return 2
    net.end_on_signals()
    folder = Path(tempfile.mkdtemp(prefix="zscout-overlap-"))
    numbers = itertools.count(1)

    def report(follow: Taken) -> None:
        beside = "" if follow.begun.alone else "  RAN BESIDE THE FORMER PROGRAM"
        wait = f"the next program ran {follow.waited:5.2f} s later, {follow.allowed:g} allowed"
        print(f"{next(numbers):3}  {follow.how:9}  {wait}{beside}", flush=True)

    try:
        with Rounds(folder) as rounds:
            taken = rounds.run(hows, report)
    except NeverCame as error:
        print(f"overlap: {error}", file=sys.stderr)
        return 1
    beside = sum(not follow.begun.alone for follow in taken)
    late = [follow for follow in taken if follow.waited > follow.allowed + asked.slack]
    print(f"{len(taken)} ends of a hold, {beside} programs ran beside the former program, {len(late)} waited too long")
    for how in dict.fromkeys(hows):
        waits = [follow.waited for follow in taken if follow.how == how]
        print(f"{how:9}  {len(waits)} times: median {median(waits):.2f} s, at most {max(waits):.2f} s")
    if beside or late:
        print(f"logs are in {folder}", file=sys.stderr)
        return 1
    shutil.rmtree(folder, ignore_errors=True)
    return 0

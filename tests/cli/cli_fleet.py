"""A real fleet for tests of the `zscout` command, driven from plain functions."""

from __future__ import annotations

import asyncio
import subprocess
import time
from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from click.testing import CliRunner

from tests.cli import tools
from tests.hang import HANG
from tests.live.lab import PATIENT, Lab
from zscout.behaviors.client.blocking import connect
from zscout.cli import common
from zscout.cli.main import main
from zscout.messages import MAX_RANKED, HostRanking, RankAsk, RcmState

NOBODY_THERE = common.NobodyThere.exit_code


def patient_timing(hold_lease: float | None = None) -> str:
    """The table [timing] of a fleet with the lease PATIENT, whose RCs vote, though they stand still for a second or
    two."""
    lease = 3 * PATIENT if hold_lease is None else hold_lease
    return f"[timing]\nhold_lease = {lease}\nrebuild = {PATIENT / 5}\nvote_timeout = 2"


def in_lab(**options: Any) -> Callable[[Callable[[Lab], Coroutine[Any, Any, None]]], Callable[[Path], None]]:
    """Makes a test of what happens in a `Lab` of these options, in the test's own folder."""

    def decorate(story: Callable[[Lab], Coroutine[Any, Any, None]]) -> Callable[[Path], None]:
        async def run(folder: Path) -> None:
            async with Lab(folder, **options) as lab:
                await story(lab)

        def test(tmp_path: Path) -> None:
            asyncio.run(run(tmp_path))

        test.__name__, test.__doc__ = story.__name__, story.__doc__
        return test

    return decorate


class CliFleet:
    """One node with RCs, and `zscout` processes that use it."""

    def __init__(self, folder: Path, hold_lease: float | None = None, candidates: Sequence[str] = ()) -> None:
        self.lab = Lab(folder, lease=PATIENT, candidates=candidates, extra=patient_timing(hold_lease))
        self.folder = folder
        self._started: list[subprocess.Popen[str]] = []
        self._eye = connect("eye", fleet=self.lab.fleet, host="test")

    def zscout(self, *args: str, stdin: str = "") -> subprocess.CompletedProcess[str]:
        """Runs a command to its end, away from any terminal; again where it saw no RCM in its two seconds, though one
        is there: nothing was done then."""
        return self.until(lambda done: done.returncode != NOBODY_THERE, *args, stdin=stdin)

    def shown(self, *args: str, until: Callable[[str], object]) -> str:
        """What a command prints as soon as it is so: run again until then."""
        return self.until(lambda done: done.returncode != NOBODY_THERE and until(done.stdout), *args).stdout

    def until(
        self,
        condition: Callable[[subprocess.CompletedProcess[str]], object],
        *args: str,
        stdin: str = "",
        env: Mapping[str, str] | None = None,
    ) -> subprocess.CompletedProcess[str]:
        """Runs a command again until what came of it is so. One that asks for devices has a process of its own: signals
        are for it, and its children write to its streams. All others run here: a process takes 0.3 s to begin."""
        if {"request", "take", "acquire", "run"} & {*args} and "--dry-run" not in args:
            return tools.zscout_until(condition, *args, env=self.lab.env, stdin=stdin)
        began = time.monotonic()
        while True:
            runner = CliRunner(env={**self.lab.env, **(env or {})})
            done = runner.invoke(main, args, input=stdin, catch_exceptions=False)
            told = subprocess.CompletedProcess(args, done.exit_code, done.stdout, done.stderr)
            if condition(told):
                return told
            assert time.monotonic() - began < HANG, told

    def start(self, *args: str) -> subprocess.Popen[str]:
        """Starts a command; stdout and stderr come out of `.stdout`."""
        process = subprocess.Popen(
            [*tools.COMMAND, *args],
            env=self.lab.env,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            bufsize=1,
        )
        self._started.append(process)
        return process

    def holder(self, name: str, *args: str) -> subprocess.Popen[str]:
        """A request that holds already when this returns."""
        process, _ = self.begun(f"{name} holds", "request", "--name", name, *args)
        return process

    def begun(self, words: str, *args: str) -> tuple[subprocess.Popen[str], list[str]]:
        """A command that has said that, and its lines so far; started again where it saw no RCM."""
        while True:
            process, lines = self.start(*args), list[str]()
            for line in tools.out_of(process):
                lines.append(line.rstrip("\n"))
                if words in line:
                    return process, lines
            assert process.wait(HANG) == NOBODY_THERE, lines

    def waits(self, name: str, *args: str, until: Callable[[str], object] = bool) -> str:
        """What a request prints first, by which it says that it waits; it is ended then. Asked again until that is so:
        who is in the way is told by an RCM that answers within a second."""
        began = time.monotonic()
        while True:
            process = self.start("request", "--name", name, *args)
            first = tools.out_of(process).readline().rstrip("\n")
            tools.end(process)
            if process.returncode != NOBODY_THERE and until(first):
                return first
            assert time.monotonic() - began < HANG, first

    def state(self, until: Callable[[RcmState], bool]) -> RcmState:
        """The RCM's state as soon as `until` holds of it."""
        return self._eye.run(self.lab.state(self._eye.client, until))

    def balanced(self, *hosts: str) -> None:
        """Waits until components can be placed on these hosts: who leads has heard of their loads."""

        async def heard() -> None:
            mesh, ranked = self._eye.client.mesh, set[str]()
            async with asyncio.timeout(HANG):
                while not ranked.issuperset(hosts):
                    asked = RankAsk(at_most=MAX_RANKED, reports=True)
                    reply = await mesh.ask_one(mesh.keys.ask_rank(mesh.me), asked, HostRanking, timeout=1)
                    told = reply.message.reports if reply is not None and reply.message is not None else None
                    ranked = {one.report.host for one in told or ()}

        self._eye.run(heard())

    def idle(self, *rcs: str) -> bool:
        """Returns when nobody holds or waits for these RCs."""

        def nobody(state: RcmState) -> bool:
            needed = [view.needs for view in state.holds] + [view.needs for view in state.queue]
            return not any(rc in needs for rc in rcs for needs in needed)

        self.state(nobody)
        return True

    def terminal(self, *args: str) -> tools.Terminal:
        """A command at a terminal of its own. Use as a context manager."""
        return tools.Terminal(*args, env=self.lab.env)

    def end_started(self) -> None:
        """End the commands that were started, and forget them."""
        while self._started:
            tools.end(self._started.pop())

    def close(self) -> None:
        self.end_started()
        self._eye.close()
        asyncio.run(self.lab.__aexit__(None, None, None))


@contextmanager
def fleet_of(
    folder: Path, *rcs: str, env: Mapping[str, str] | None = None, hold_lease: float | None = None
) -> Iterator[CliFleet]:
    """A fleet of one node with these RCs, ready; `env` beside the environment of this process, `hold_lease` in
    seconds."""
    # Named, so that it knows at once that no other host has bookings.
    fleet = CliFleet(folder, hold_lease, candidates=("anvil",))
    fleet.lab.env |= env or {}
    try:
        fleet.lab.node("anvil", *rcs)
        wanted = {rc.partition(":")[0] for rc in rcs}
        fleet.state(lambda state: wanted <= {view.rc for view in state.rcs if view.present})
        yield fleet
    finally:
        fleet.close()

"""`exclusive` means exclusive: the program of the next `zscout request` never runs beside the former one, which ignores
SIGTERM, holds a lock file and has a child in a session of its own that holds it too. (`overlap.py` cuts hosts off.)"""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from studies.overlap import Programs
from tests.cli.cli_fleet import CliFleet, fleet_of
from tests.cli.tools import end, read_until
from tests.hang import HANG
from tests.thorough import times

pytestmark = pytest.mark.live

ROUNDS = times(2)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory, fleet_kind: str) -> Iterator[CliFleet]:
    with fleet_of(tmp_path_factory.mktemp("overlap"), "robot/x") as fleet:
        yield fleet


class Chain:
    """Requests whose programs follow each other."""

    def __init__(self, fleet: CliFleet, folder: Path) -> None:
        self._fleet, self._programs, self._number = fleet, Programs(folder), 0

    def request(self, *options: str) -> subprocess.Popen[str]:
        self._number += 1
        how = ["--name", f"p{self._number}", "--min-runtime", "1h", *options]
        return self._fleet.start("request", "robot/x", *how, "--", *self._programs.command(self._number))

    def runs_alone(self) -> bool:
        """Whether the program of the last request does, as soon as it runs."""
        before = time.monotonic()
        while self._number not in (begun := self._programs.begun()):
            assert time.monotonic() - before < HANG, begun
            time.sleep(0.02)
        return begun[self._number].alone


@pytest.mark.slow
def test_a_preempted_program_that_ignores_sigterm_is_gone_before_the_next_one_begins(
    fleet: CliFleet, tmp_path: Path
) -> None:
    chain = Chain(fleet, tmp_path)
    former = chain.request("--grace", "500ms")
    assert chain.runs_alone()
    for priority in range(1, ROUNDS + 1):
        following = chain.request("--grace", "500ms", "--priority", str(priority))
        assert chain.runs_alone()
        assert former.wait(HANG) == 75
        former = following
    end(former)


@pytest.mark.slow
def test_the_guardian_of_a_client_that_was_killed_tells_that_its_program_is_gone(tmp_path: Path) -> None:
    """Without its word the next one would wait for the hold lease."""
    with fleet_of(tmp_path, "robot/x", hold_lease=2 * HANG) as fleet:
        chain = Chain(fleet, tmp_path)
        former = chain.request("--grace", "200ms")
        assert chain.runs_alone()
        following = chain.request("--priority", "1")
        former.kill()
        assert chain.runs_alone()
        end(following)


@pytest.mark.slow
@pytest.mark.parametrize(
    "strike", [lambda process: process.kill(), lambda process: process.send_signal(signal.SIGSTOP)], ids=["-9", "STOP"]
)
def test_a_program_whose_client_is_killed_or_frozen_is_gone_before_the_next_one_begins(
    fleet: CliFleet, tmp_path: Path, strike: Callable[[subprocess.Popen[str]], None]
) -> None:
    chain = Chain(fleet, tmp_path)
    former = chain.request()
    assert chain.runs_alone()
    following = chain.request("--priority", "1")
    strike(former)
    read_until(following, "p2 holds")
    assert chain.runs_alone()
    if former.poll() is None:  # frozen: it finds its program gone
        former.send_signal(signal.SIGCONT)
        assert former.wait(HANG) == 75
    end(following)

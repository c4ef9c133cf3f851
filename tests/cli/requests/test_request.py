"""`zscout request` with real processes: what the command is given, when it is ended, what is left behind."""

from __future__ import annotations

import asyncio
import io
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from decimal import Decimal
from pathlib import Path

import pytest

from tests.cli.cli_fleet import CliFleet, fleet_of
from tests.cli.tools import CLOCK, COMMAND, course, end, events, gone, held_by, out_of, own, read_until
from tests.hang import HANG
from tests.live.bench import until
from zscout.behaviors.client.client import QUERY_TIMEOUT, Client
from zscout.behaviors.client.request import OpenArc
from zscout.cli.requests.request import REFRESH_INTERVAL_S, Report, _yours
from zscout.mesh import clock
from zscout.messages import RcmState
from zscout.types import SECOND

pytestmark = pytest.mark.live

STUBBORN = "trap '' TERM; sleep 1000 & echo pid $$ $!; wait; wait"


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory, fleet_kind: str) -> Iterator[CliFleet]:
    with fleet_of(tmp_path_factory.mktemp("request"), "robot/a", "robot/b", "radio/rf0:rate=10") as fleet:
        yield fleet


def test_a_command_gets_its_grant_and_gives_its_exit_code(fleet: CliFleet) -> None:
    script = 'echo "$ZSCOUT_ARC|$ZSCOUT_RCS|$ZSCOUT_GRANT|$ZSCOUT_CLIENT|$ZSCOUT_REMAINING|$ZSCOUT_FLEET"; exit 7'
    done = fleet.zscout("request", "robot/a", "radio/rf0:rate=2.5", "--name", "survey", "--", "sh", "-c", script)
    assert done.returncode == 7, done.stderr
    arc, rcs, grant, client, remaining, file = done.stdout.strip().split("|")
    assert (arc, rcs, file) == ("survey", "radio/rf0 robot/a", str(fleet.lab.fleet_file))
    assert grant.startswith("[[")
    assert "/request-" in client
    assert 3590 < float(remaining) <= 3600
    yours = rf"yours for 1 h \(until {CLOCK}\), then until a request of priority 0 or more waits for it"
    assert re.search(rf"survey holds radio/rf0, robot/a: {yours}", done.stderr)
    assert fleet.idle("robot/a", "radio/rf0")


def test_a_command_ended_by_a_signal_gives_128_and_its_number(fleet: CliFleet) -> None:
    assert fleet.zscout("request", "robot/a", "--", "sh", "-c", "kill -KILL $$").returncode == 137


@pytest.mark.slow
def test_without_a_command_it_holds_for_its_time(fleet: CliFleet) -> None:
    # Long enough to be granted and confirmed within, though one of the processes stands still.
    done = fleet.zscout("request", "robot/a", "--release-after", "8s", "--json")
    assert done.returncode == 0
    granted, ended = course(done.stdout)
    assert (granted["event"], granted["rcs"], granted["keep"]) == ("granted", ["robot/a"], False)
    assert 0 < granted["remaining"] <= 8
    assert (ended["event"], ended["outcome"]) == ("ended", "completed")


def test_in_a_pipe_it_says_once_who_is_in_the_way(fleet: CliFleet) -> None:
    blocker = fleet.holder("slow", "robot/a")
    who = own("slow")
    line = fleet.waits("next", "robot/a", "--", "true")
    start = rf"starts at {CLOCK} \(in (\d\d s|1 min)\)"
    assert re.fullmatch(rf"next waits for {who}: robot/a, until {CLOCK} at the latest; {start}", line)
    waiting, _ = fleet.begun("next waits", "request", "robot/a", "--name", "next", "--", "true")
    end(blocker)
    read_until(waiting, "next holds robot/a")
    assert waiting.wait(HANG) == 0


def test_a_start_that_nobody_can_foretell_is_said_to_be_so(fleet: CliFleet) -> None:
    never = ("never", "robot/nowhere", "--wait-for-device")
    assert fleet.waits(*never) == "never waits: robot/nowhere not on the mesh; no start can be estimated"
    (waits,) = events(fleet.waits(*never, "--json"))
    assert (waits["event"], waits["starts_in"]) == ("waits", None)


class Noting(Client):
    """A client that notes each time that it asks for the state, and whether with a forecast; it waits for the
    answer."""

    looks: list[bool]

    async def state(
        self, arc: str | None = None, *, forecast: bool = False, timeout: float = QUERY_TIMEOUT
    ) -> RcmState | None:
        self.looks.append(forecast)
        return await super().state(arc, forecast=forecast, timeout=HANG)


def test_an_estimate_that_ticks_down_prints_nothing_and_asks_for_nothing(fleet: CliFleet) -> None:
    blocker = fleet.holder("blocker", "robot/a")
    out = io.StringIO()

    async def wait_in_a_crowd_of_news() -> list[bool]:
        async with await Noting.connect("noting", fleet=fleet.lab.fleet, host="test") as client:
            client.looks = []
            with Report("next", client, as_json=False, stream=out) as report:
                client.internals.watch(report.news)
                arc = await client.request("next", {"robot/a": {}}, estimate=True)
                telling = asyncio.ensure_future(report.follow_wait())
                await until(lambda: bool(out.getvalue()))
                end_of_news = clock.now() + 2 * REFRESH_INTERVAL_S * SECOND
                while clock.now() < end_of_news:
                    report.news(arc)
                    await asyncio.sleep(0.01)
                telling.cancel()
            return client.looks

    assert asyncio.run(wait_in_a_crowd_of_news()) == [False]
    (line,) = out.getvalue().splitlines()
    assert "; starts at " in line
    end(blocker)


def test_a_command_is_ended_when_its_grant_is_taken(fleet: CliFleet) -> None:
    script = "trap 'echo told; exit 3' TERM; echo pid $$; while :; do sleep 0.05; done"
    victim, _ = fleet.begun("pid", "request", "robot/a", "--name", "victim", "--", "sh", "-c", script)
    taker = fleet.zscout("request", "robot/a", "--priority", "5", "--name", "boss", "--", "true")
    assert taker.returncode == 0
    lines = out_of(victim).read()
    assert victim.wait(HANG) == 75
    assert "told" in lines
    assert f"victim lost its grant: preempted by {held_by('boss')}, priority 5" in lines
    assert fleet.idle("robot/a")


@pytest.mark.slow
def test_a_command_whose_time_is_over_is_ended(fleet: CliFleet) -> None:
    # Long enough to be granted, confirmed and begun within, though one of the processes stands still.
    done = fleet.zscout("request", "robot/a", "--release-after", "8s", "--json", "--", "sleep", "1000")
    assert (done.returncode, done.stdout) == (124, "")
    assert [event["event"] for event in course(done.stderr)] == ["granted", "stopping", "ended"]
    assert fleet.idle("robot/a")


def test_a_command_goes_on_past_its_minimum_runtime_until_an_equal_waits(fleet: CliFleet) -> None:
    script = "trap 'echo told; exit 3' TERM; echo pid $$; while :; do sleep 0.05; done"
    kept, first = fleet.begun(
        "pid", "request", "robot/a", "--name", "kept", "--min-runtime", "300ms", "--", "sh", "-c", script
    )
    assert re.fullmatch(
        rf"kept holds robot/a: yours for 0\.\d s \(until {CLOCK}\), then until a request of priority 0 or more waits "
        "for it",
        first[0],
    )
    fleet.state(lambda state: [hold.remaining < -0.5 for hold in state.holds] == [True])
    assert kept.poll() is None
    # Lower priority does not end it.
    assert fleet.zscout("request", "robot/a", "--priority", "-1", "--timeout", "300ms").returncode == 1
    assert kept.poll() is None
    assert fleet.zscout("request", "robot/a", "--name", "next", "--", "true").returncode == 0
    lines = out_of(kept).read()
    assert kept.wait(HANG) == 124
    assert "told" in lines
    why = f"its minimum runtime is over, and {held_by('next')}, priority 0, needs it"
    assert f"the time of kept is over: {why}\n" in lines
    assert fleet.idle("robot/a")


def test_again_asks_anew_for_what_was_kept_and_ended_for_another(fleet: CliFleet, tmp_path: Path) -> None:
    script = f"if mkdir {tmp_path}/first; then echo run $$; sleep 1000; fi; echo run $$; exit 4"
    options = ["--again", "--name", "kept", "--min-runtime", "300ms"]
    kept, said_first = fleet.begun("run ", "request", "robot/b", *options, "--", "sh", "-c", script)
    first = said_first[-1]
    assert fleet.zscout("request", "robot/b", "--", "true").returncode == 0
    lines = read_until(kept, "run ")
    assert any(line.endswith("; asking again") for line in lines)
    assert lines[-1] != first
    assert kept.wait(HANG) == 4


def test_what_an_operator_releases_is_not_asked_for_again(fleet: CliFleet) -> None:
    options = ["--again", "--name", "kept", "--min-runtime", "100ms"]
    kept, _ = fleet.begun("run", "request", "robot/b", *options, "--", "sh", "-c", "echo run; sleep 1000")
    fleet.state(lambda state: [hold.remaining < 0 for hold in state.holds] == [True])
    assert fleet.zscout("release", "kept").returncode == 0
    assert kept.wait(HANG) == 124
    assert "run\n" not in out_of(kept).read()


def test_without_a_command_what_is_kept_ends_in_order(fleet: CliFleet) -> None:
    kept, _ = fleet.begun('"granted"', "request", "robot/b", "--name", "kept", "--min-runtime", "100ms", "--json")
    assert fleet.zscout("request", "robot/b", "--", "true").returncode == 0
    (ended,) = events(out_of(kept).read())
    assert (ended["event"], ended["outcome"], ended["again"]) == ("ended", "completed", False)
    assert kept.wait(HANG) == 0


def test_what_ignores_sigterm_is_killed_after_the_grace_with_its_children(fleet: CliFleet) -> None:
    options = ["--name", "victim", "--grace", "300ms"]
    victim, said_first = fleet.begun("pid", "request", "robot/a", *options, "--", "sh", "-c", STUBBORN)
    pids = [int(pid) for pid in said_first[-1].split()[1:]]
    assert fleet.zscout("release", "victim").returncode == 0
    assert victim.wait(HANG) == 75
    assert len(pids) == 2
    assert all(gone(pid) for pid in pids)


def test_again_runs_the_command_again_after_a_preemption(fleet: CliFleet, tmp_path: Path) -> None:
    script = f"if mkdir {tmp_path}/first; then echo run $$; sleep 1000; fi; echo run $$; exit 4"
    victim, said_first = fleet.begun(
        "run", "request", "robot/b", "--again", "--name", "victim", "--", "sh", "-c", script
    )
    first = said_first[-1]
    assert fleet.zscout("request", "robot/b", "--priority", "5", "--", "true").returncode == 0
    lines = read_until(victim, "run")
    assert any("waiting again" in line for line in lines)
    assert lines[-1] != first
    assert victim.wait(HANG) == 4


def test_what_a_command_leaves_running_is_ended(fleet: CliFleet) -> None:
    left, said_first = fleet.begun("pid", "request", "robot/a", "--", "sh", "-c", "sleep 1000 & echo pid $!")
    pid = int(said_first[-1].split()[1])
    assert left.wait(HANG) == 0
    assert gone(pid)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_while_it_waits_leaves_nothing(fleet: CliFleet, number: signal.Signals) -> None:
    blocker = fleet.holder("blocker", "robot/a", "robot/b")
    waiting, _ = fleet.begun("waiting waits", "request", "robot/a", "--name", "waiting", "--", "true")
    waiting.send_signal(number)
    assert "Traceback" not in out_of(waiting).read()
    assert waiting.wait(HANG) == 128 + number
    fleet.state(lambda state: not state.queue)
    end(blocker)


def test_a_signal_ends_the_command_and_gives_back(fleet: CliFleet) -> None:
    running, said_first = fleet.begun("pid", "request", "robot/a", "--", "sh", "-c", "echo pid $$; sleep 1000")
    pid = int(said_first[-1].split()[1])
    running.send_signal(signal.SIGTERM)
    assert running.wait(HANG) == 143
    assert gone(pid)
    assert fleet.idle("robot/a")


def test_a_second_signal_does_not_wait_for_a_stubborn_command(fleet: CliFleet) -> None:
    running = fleet.start(
        "request", "robot/a", "--grace", "10m", "--", "sh", "-c", f"trap 'echo no' TERM; {STUBBORN[13:]}"
    )
    pids = [int(pid) for pid in read_until(running, "pid")[-1].split()[1:]]
    running.send_signal(signal.SIGINT)
    read_until(running, "no")
    running.send_signal(signal.SIGINT)
    assert running.wait(HANG) == 130
    assert all(gone(pid) for pid in pids)


def test_a_command_does_not_outlive_zscout(fleet: CliFleet) -> None:
    running, said_first = fleet.begun("pid", "request", "robot/a", "--", "sh", "-c", "echo pid $$; exec sleep 1000")
    pid = int(said_first[-1].split()[1])
    running.kill()
    assert gone(pid)
    assert fleet.idle("robot/a")


@pytest.mark.slow
def test_a_timeout_ends_the_wait(fleet: CliFleet) -> None:
    # A name of its own: nothing is known of how long it takes.
    blocker = fleet.holder("patient", "robot/a", "--min-runtime", "10m")
    # Long enough to hear whom it waits for, though the RCM stands still.
    late = ("request", "robot/a", "--name", "late", "--timeout", "6s", "--json")
    done = fleet.until(lambda done: '"holders"' in done.stdout, *late)
    assert done.returncode == 1
    waits, ended = events(done.stdout)
    assert waits["needs"][0]["holders"][0]["arc"] == "patient"
    assert 500 < waits["starts_in"] < 600
    # Both go by this process's clock, from when it heard of them: one of the two may have been long under way.
    assert waits["starts_in"] == pytest.approx(waits["needs"][0]["holders"][0]["remaining"], abs=5)
    assert (ended["event"], ended["outcome"]) == ("ended", "timeout")
    assert done.stderr.count("\n") == 1
    assert "late was not granted within 6.0 s" in done.stderr
    fleet.state(lambda state: not state.queue)
    end(blocker)


def test_what_can_not_run_is_said_before_anybody_waits(fleet: CliFleet, tmp_path: Path) -> None:
    plain = tmp_path / "plain"
    plain.write_text("no program")
    missing = fleet.zscout("request", "robot/a", "--", "no-such-program")
    assert (missing.returncode, missing.stdout) == (127, "")
    assert missing.stderr == "zscout: no-such-program: there is no such command; check the name and $PATH\n"
    assert fleet.zscout("request", "robot/a", "--", str(plain)).returncode == 126


def test_what_can_never_start_is_refused_at_once_with_code_2(fleet: CliFleet) -> None:
    for command in (("request",), ("request", "--dry-run"), ("take", "--yes")):
        much = fleet.zscout(*command, "radio/rf0:rate=50")
        assert (much.returncode, much.stdout) == (2, "")
        assert much.stderr == "zscout: can never start: rate 50 of 10 at radio/rf0; request less\n"
    typo = fleet.zscout("request", "--dry-run", "radio/rf0:rat=5")
    assert (typo.returncode, typo.stderr) == (2, "zscout: radio/rf0 has no parameter rat; did you mean rate?\n")
    none = fleet.zscout("request", "robot/a:speed=1", "--", "true")
    assert none.returncode == 2
    assert none.stderr == "zscout: robot/a has no parameter speed; it has none\n"
    fleet.state(lambda state: not state.queue and not state.holds)


def test_the_live_line_shows_and_ctrl_c_ends_the_wait(fleet: CliFleet) -> None:
    blocker = fleet.holder("blocker", "robot/a")
    with fleet.terminal("request", "robot/a", "--name", "seen") as terminal:
        terminal.until(f"seen waits for {own('blocker')}: robot/a, until ")
        since = terminal.until("(in ")
        assert re.search(rf"waits since {CLOCK} \(\d+(\.\d)? s\), starts at {CLOCK} ", since)
        terminal.until(f"robot/a: {own('blocker')}, priority 0, ")
        terminal.until("seen waits ")  # drawn anew
        terminal.press("\x03")
        terminal.until("seen is cancelled")
        assert terminal.code() == 130
    fleet.state(lambda state: not state.queue)
    end(blocker)


def test_a_command_has_the_terminal(fleet: CliFleet) -> None:
    # Python forgets a signal that comes just before a blocking read: the script waits for the signal itself.
    script = (
        "import os, signal, sys\n"
        "signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])\n"
        "print('front', os.getpgrp() == os.tcgetpgrp(0), flush=True)\n"
        "print('got', input(), flush=True)\n"
        "print('interrupted', signal.sigwait([signal.SIGINT]) == signal.SIGINT, flush=True)\n"
        "input(); sys.exit(9)\n"
    )
    with fleet.terminal("request", "robot/a", "--", sys.executable, "-c", script) as terminal:
        terminal.until("front True")
        terminal.press("hello\n")
        terminal.until("got hello")
        terminal.press("\x03")
        terminal.until("interrupted True")
        terminal.press("\x1a")
        terminal.until("not suspended")
        terminal.press("\n")
        terminal.until("gave back")
        assert terminal.code() == 9


def test_a_hold_without_a_command_is_not_suspended_either(fleet: CliFleet) -> None:
    with fleet.terminal("request", "robot/a") as terminal:
        terminal.until("Ctrl-C gives back")
        terminal.press("\x1a")
        terminal.until("not suspended")
        terminal.press("\x03")
        terminal.until("gave back")
        assert terminal.code() == 130


def test_where_nothing_can_be_said_a_command_runs_all_the_same(fleet: CliFleet, tmp_path: Path) -> None:
    ran = tmp_path / "ran"
    command = shlex.join([*COMMAND, "request", "robot/a", "--", "sh", "-c", f"sleep 0.1; : > {ran}; exit 7"])
    done = subprocess.run(["sh", "-c", f"exec {command} 2>/dev/full"], env=fleet.lab.env, timeout=HANG)
    assert (done.returncode, ran.exists()) == (7, True)


@pytest.mark.parametrize(
    ("keep", "longest", "then"),
    [
        (True, None, "until a request of priority 0 or more waits for it"),
        (True, 120 * SECOND, "until a request of priority 0 or more waits for it, 2 min in all at most"),
        (True, 60 * SECOND, "given back"),
        (False, None, "given back"),
    ],
)
def test_how_long_it_may_go_on_is_said_beforehand(keep: bool, longest: int | None, then: str) -> None:
    arc = OpenArc("id", "survey", {"robot/a": {}}, 0, Decimal(60), keep)
    assert _yours(arc, 60.0, longest).endswith(f"), then {then}")

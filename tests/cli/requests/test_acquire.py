"""`zscout acquire`, `run`, `renew` and `release TOKEN` with real processes."""

from __future__ import annotations

import json
import os
import signal
import socket
import stat
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.cli.cli_fleet import CliFleet, fleet_of
from tests.cli.tools import COMMAND, end, events, gone, out_of, read_until
from tests.hang import HANG
from zscout.cli.requests import token_files

pytestmark = pytest.mark.live

STUBBORN = "trap 'echo told' TERM; echo pid $$; while :; do sleep 0.05; done"
POLITE = "trap 'echo told; exit 3' TERM; echo pid $$; while :; do sleep 0.05; done"


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory, fleet_kind: str) -> Iterator[CliFleet]:
    folder = tmp_path_factory.mktemp("tokens")
    # Longer than a socket's path may be.
    runtime = folder / ("runtime-" + "x" * 100)
    runtime.mkdir(mode=0o700)
    with fleet_of(folder, "robot/a", "robot/b", env={"XDG_RUNTIME_DIR": str(runtime)}) as fleet:
        yield fleet


@pytest.fixture(autouse=True)
def released(fleet: CliFleet) -> Iterator[None]:
    yield
    fleet.end_started()
    for path in files(fleet):
        fleet.zscout("release", path.stem)
    fleet.state(lambda state: not state.holds and not state.queue)


def files(fleet: CliFleet) -> list[Path]:
    return sorted((Path(fleet.lab.env["XDG_RUNTIME_DIR"]) / "zscout").glob("*.json"))


def acquired(fleet: CliFleet, *args: str, span: str = "10m") -> str:
    done = fleet.zscout("acquire", "robot/a", "--for", span, *args)
    assert done.returncode == 0, done
    (token,) = done.stdout.splitlines()
    return token


def noted(fleet: CliFleet, token: str) -> dict[str, Any]:
    (path,) = [path for path in files(fleet) if path.stem == token]
    content: dict[str, Any] = json.loads(path.read_bytes())
    return content


def until(true: Callable[[], object]) -> None:
    began = time.monotonic()
    while not true():
        assert time.monotonic() - began < HANG
        time.sleep(0.02)


def test_a_token_holds_over_several_commands(fleet: CliFleet) -> None:
    done = fleet.zscout("acquire", "robot/a", "--for", "10m", "--name", "bench")
    token = done.stdout.removesuffix("\n")
    assert token.startswith("bench-")
    assert "bench holds robot/a: yours for 10 min" in done.stderr
    (path,) = files(fleet)
    assert path.stem == token
    sock = path.with_suffix(".sock")
    assert [stat.S_IMODE(one.stat().st_mode) for one in (path, sock, path.parent)] == [0o600, 0o600, 0o700]

    script = 'echo "$ZSCOUT_ARC|$ZSCOUT_RCS|$ZSCOUT_GRANT|$ZSCOUT_CLIENT|$ZSCOUT_REMAINING"; exit 7'
    first, second = (fleet.zscout("run", token, "--", "sh", "-c", script) for _ in range(2))
    assert (first.returncode, second.returncode) == (7, 7)
    arc, rcs, grant, client, remaining = first.stdout.strip().split("|")
    assert (arc, rcs) == ("bench", "robot/a")
    assert second.stdout.split("|")[2] == grant  # one hold
    assert "/acquire-" in client
    assert 500 < float(remaining) <= 600

    renewed = fleet.zscout("renew", token, "--for", "20m")
    assert renewed.returncode == 0
    assert "bench is yours for 20 min" in renewed.stdout
    assert "then unless another request waits" in renewed.stdout

    gave_back = fleet.zscout("release", token)
    assert gave_back.returncode == 0
    assert gave_back.stdout.startswith("bench (")
    assert gave_back.stdout.endswith(" was running: released\n")
    assert fleet.idle("robot/a")
    assert files(fleet) == []
    unknown = fleet.zscout("run", token, "--", "true")
    assert unknown.returncode == 2
    assert "unknown token" in unknown.stderr


def test_the_json_of_acquire_has_the_token_and_the_hold(fleet: CliFleet) -> None:
    path = fleet.folder / "acquire.json"
    done = fleet.zscout("acquire", "robot/*", "--for", "1h", "--json", "--json-file", str(path))
    told = json.loads(done.stdout)
    assert (told["arc"], told["bound"]) == ("acquire", {"robot/*": told["rcs"][0]})
    assert fleet.zscout("release", told["token"], "--json").returncode == 0
    kinds = [event["event"] for event in events(path.read_text())]
    assert [kind for kind in kinds if kind != "waits"] == ["granted", "ended"]


def test_a_token_can_be_used_as_soon_as_it_is_told(fleet: CliFleet) -> None:
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    command = [*COMMAND, "acquire", "robot/a", "--for", "1h", "--starter", str(theirs.fileno())]
    # The sockets are closed first, which ends the process.
    with subprocess.Popen(command, env=fleet.lab.env, pass_fds=(theirs.fileno(),)) as holder, ours, theirs:
        token = json.loads(ours.recv(1 << 16))["token"]
        (path,) = [path for path in files(fleet) if path.stem == token]
        user = token_files.connect(path)
        assert user is not None
        user.close()
    assert holder.returncode == 0


def test_what_cannot_be_acquired_has_the_codes_of_request(fleet: CliFleet) -> None:
    blocker = fleet.holder("blocker", "robot/a", "--priority", "7")
    once = fleet.zscout("acquire", "robot/a", "--for", "1h", "--timeout", "0")
    assert (once.returncode, once.stdout) == (1, "")
    assert "acquire was not granted at once" in once.stderr
    assert fleet.zscout("acquire", "robot/a", "--for", "1h", "--timeout", "0", "--infra-exit", "99").returncode == 99
    end(blocker)


def test_what_can_never_be_acquired_has_code_2(fleet: CliFleet) -> None:
    never = fleet.zscout("acquire", "robot/a:speed=1", "--for", "1h")
    assert (never.returncode, never.stdout) == (2, "")
    assert never.stderr == "zscout: robot/a has no parameter speed; it has none\n"
    assert fleet.zscout("acquire", "robot/a", "--for", "1h", "--follow", "4194304").returncode == 2
    assert files(fleet) == []
    fleet.state(lambda state: not state.queue and not state.holds)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_an_acquire_that_ends_while_it_waits_leaves_nothing(fleet: CliFleet, number: signal.Signals) -> None:
    blocker = fleet.holder("blocker", "robot/a", "--priority", "7")
    waiting, _ = fleet.begun("next waits", "acquire", "robot/a", "--for", "1h", "--name", "next")
    waiting.send_signal(number)
    assert "Traceback" not in out_of(waiting).read()
    assert waiting.wait(HANG) == (130 if number == signal.SIGINT else -signal.SIGKILL)
    fleet.state(lambda state: not state.queue)
    end(blocker)


def test_a_hold_that_is_taken_away_ends_the_command_with_75(fleet: CliFleet) -> None:
    token = acquired(fleet)
    running, _ = fleet.begun("pid", "run", token, "--", "sh", "-c", POLITE)
    assert fleet.zscout("request", "robot/a", "--priority", "5", "--name", "boss", "--", "true").returncode == 0
    lines = out_of(running).read()
    assert running.wait(HANG) == 75
    assert "told" in lines
    assert "acquire has ended: preempted by boss" in lines
    until(lambda: noted(fleet, token)["ended"])
    later = fleet.zscout("run", token, "--infra-exit", "98", "--", "true")
    assert later.returncode == 98
    assert "acquire has ended: preempted by boss" in later.stderr
    assert fleet.zscout("run", token, "--", "true").returncode == 75
    over = fleet.zscout("release", token)
    assert over.returncode == 0
    assert "has ended: preempted by boss" in over.stdout
    assert files(fleet) == []


def test_a_release_ends_commands_with_all_their_processes_before_it_gives_back(fleet: CliFleet) -> None:
    token = acquired(fleet)
    runs = [fleet.begun("pid", "run", token, "--grace", "300ms", "--", "sh", "-c", STUBBORN) for _ in range(2)]
    pids = [int(lines[-1].split()[1]) for _, lines in runs]
    assert fleet.zscout("release", token).returncode == 0
    assert all(not Path(f"/proc/{pid}").exists() or gone(pid) for pid in pids)
    assert [process.wait(HANG) for process, _ in runs] == [75, 75]
    assert fleet.idle("robot/a")


@pytest.mark.slow
def test_a_token_whose_time_is_over_gives_back(fleet: CliFleet) -> None:
    token = acquired(fleet, span="3s")
    running = fleet.start("run", token, "--", "sh", "-c", POLITE)
    assert running.wait(HANG) == 124
    until(lambda: noted(fleet, token)["ended"] == "its time is over")
    assert fleet.zscout("run", token, "--", "true").returncode == 124
    assert fleet.idle("robot/a")


def test_a_holder_process_that_is_ended_gives_back_in_order(fleet: CliFleet) -> None:
    token = acquired(fleet)
    running, lines = fleet.begun("pid", "run", token, "--", "sh", "-c", POLITE)
    os.kill(noted(fleet, token)["pid"], signal.SIGTERM)
    assert running.wait(HANG) == 75
    assert gone(int(lines[-1].split()[1]))
    assert fleet.idle("robot/a")
    assert fleet.zscout("request", "robot/a", "--", "true").returncode == 0
    assert fleet.zscout("run", token, "--", "true").returncode == 75


def test_a_run_that_is_killed_takes_its_command_along_and_no_other(fleet: CliFleet) -> None:
    token = acquired(fleet)
    killed, lines = fleet.begun("pid", "run", token, "--", "sh", "-c", POLITE)
    killed.kill()
    assert gone(int(lines[-1].split()[1]))
    # What another one runs is not touched by that, and the devices stay held.
    assert fleet.zscout("run", token, "--", "sh", "-c", "exit 4").returncode == 4


def test_who_follows_a_process_gives_back_with_it(fleet: CliFleet) -> None:
    shell = subprocess.Popen(["sleep", "1000"])
    token = acquired(fleet, "--follow", str(shell.pid))
    shell.kill()
    shell.wait()
    assert fleet.idle("robot/a")
    until(lambda: "follows" in noted(fleet, token)["ended"])


def test_in_a_gitlab_job_it_follows_the_shell_of_the_job(fleet: CliFleet) -> None:
    script = f"token=$({' '.join(COMMAND)} acquire robot/a --for 1h) && echo token $token && read line"
    job = subprocess.Popen(
        ["sh", "-c", script],
        env=fleet.lab.env | {"GITLAB_CI": "true"},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        process_group=0,
    )
    read_until(job, "token acquire-")
    fleet.state(lambda state: len(state.holds) == 1)
    os.killpg(job.pid, signal.SIGKILL)  # what GitLab's runner does at last
    job.communicate()
    assert fleet.idle("robot/a")


def test_a_token_file_that_is_removed_gives_back(fleet: CliFleet) -> None:
    token = acquired(fleet)
    (path,) = [path for path in files(fleet) if path.stem == token]
    path.unlink()
    assert fleet.idle("robot/a")


def test_a_hold_of_a_token_outlives_its_starter_and_a_closed_pipe(fleet: CliFleet) -> None:
    """Who reads stdout and stderr of acquire sees their end, though the holder process lives."""
    starting = fleet.start("acquire", "robot/a", "--for", "1h")
    text = out_of(starting).read()
    assert starting.wait(HANG) == 0
    assert fleet.zscout("run", text.splitlines()[-1], "--", "true").returncode == 0


@pytest.mark.slow
def test_what_is_renewed_lasts_until_another_request_waits(fleet: CliFleet) -> None:
    token = acquired(fleet, span="2s")
    assert fleet.zscout("renew", token, "--for", "1h").returncode == 0
    running, _ = fleet.begun("pid", "run", token, "--", "sh", "-c", POLITE)
    fleet.state(lambda state: [hold.remaining < -0.5 for hold in state.holds] == [True])
    assert running.poll() is None
    assert fleet.zscout("request", "robot/a", "--name", "next", "--", "true").returncode == 0
    assert running.wait(HANG) == 124
    assert "next" in out_of(running).read()
    until(lambda: noted(fleet, token)["ended"])
    assert fleet.zscout("run", token, "--", "true").returncode == 124

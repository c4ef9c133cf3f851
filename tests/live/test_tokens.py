"""Tokens of `zscout acquire` where the leader changes, and where the process that holds is killed or frozen."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import subprocess
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import psutil
import pytest

from tests.cli.tools import COMMAND, end, gone, read_until
from tests.hang import HANG
from tests.live.lab import Lab, LeaderWatch, awaited

pytestmark = [pytest.mark.live, pytest.mark.slow]

POLITE = "trap 'echo told; exit 3' TERM; echo pid $$; while :; do sleep 0.05; done"


class Bench:
    """A fleet with a token for robot/x, and a command that runs under it."""

    def __init__(self, lab: Lab) -> None:
        self.lab = lab
        self.token, self.command = "", 0
        self.running: subprocess.Popen[str] | None = None

    async def begin(self) -> None:
        done = await self.lab.zscout("acquire", "robot/x", "--for", "1h")
        assert done.returncode == 0, done
        self.token = done.stdout.strip()
        self.running = started(self.lab, "run", self.token, "--", "sh", "-c", POLITE)
        lines = await asyncio.to_thread(read_until, self.running, "pid")
        self.command = int(lines[-1].split()[1])

    @property
    def holder(self) -> int:
        """The process that holds."""
        (path,) = (Path(self.lab.env["XDG_RUNTIME_DIR"]) / "zscout").glob("*.json")
        pid: int = json.loads(path.read_bytes())["pid"]
        return pid

    def kill_holder(self) -> None:
        for path in (Path(self.lab.env["XDG_RUNTIME_DIR"]) / "zscout").glob("*.json"):
            pid = json.loads(path.read_bytes())["pid"]
            if psutil.pid_exists(pid) and "acquire" in psutil.Process(pid).cmdline():
                os.kill(pid, signal.SIGKILL)

    async def ended(self) -> tuple[int, str]:
        """The exit code of the run, and what it said."""
        assert self.running is not None
        said, _ = await asyncio.to_thread(self.running.communicate, timeout=HANG)
        return self.running.returncode, said


@asynccontextmanager
async def bench(folder: Path, **options: Any) -> AsyncIterator[Bench]:
    async with Lab(folder, **options) as lab:
        lab.env["XDG_RUNTIME_DIR"] = str(folder)
        found = Bench(lab)
        try:
            yield found
        finally:
            if found.running is not None:
                end(found.running)
            found.kill_holder()


def started(lab: Lab, *args: str) -> subprocess.Popen[str]:
    return subprocess.Popen([*COMMAND, *args], env=lab.env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


def linked(pid: int, other: int) -> bool:
    ends = {one.raddr for one in psutil.Process(other).net_connections("tcp")}
    return any(one.laddr in ends for one in psutil.Process(pid).net_connections("tcp"))


async def test_a_token_is_good_over_a_change_of_leader(tmp_path: Path) -> None:
    async with bench(tmp_path, candidates=("a", "b")) as found:
        lab = found.lab
        lab.node("c", "robot/x", extra="candidate = false")
        lab.node("a")
        client = await lab.begun()
        lab.node("b")
        leaders = LeaderWatch(client)
        await found.begin()
        (hold,) = (await lab.state(client, lambda state: len(state.holds) == 1)).holds
        await lab.candidates(client, "b")

        async def is_linked() -> bool:
            return linked(found.holder, lab.nodes["b"].pid)

        await awaited(is_linked, bool)
        lab.signal("a", signal.SIGKILL)
        await leaders.lost("a")
        after = await lab.state(client, lambda state: state.host == "b" and len(state.holds) == 1)
        assert after.holds[0].grant == hold.grant
        assert found.running is not None
        assert found.running.poll() is None
        done = await lab.zscout("run", found.token, "--", "sh", "-c", "echo $ZSCOUT_GRANT; exit 5")
        assert (done.returncode, done.stdout.count("[[")) == (5, 1)

        assert (await lab.zscout("release", found.token)).returncode == 0
        code, said = await found.ended()
        assert (code, "told" in said, gone(found.command)) == (75, True, True)
        await lab.state(client, lambda state: not state.holds)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
async def test_no_command_outlives_a_holder_process_that_is_killed_or_frozen(
    tmp_path: Path, number: signal.Signals
) -> None:
    async with bench(tmp_path, lease=3.0) as found:
        lab = found.lab
        lab.node("a", "robot/x")
        client = await lab.begun()
        await found.begin()
        # What the next holder's command sees: the former one must be gone.
        script = f"kill -0 {found.command} || echo alone"
        next_one = started(lab, "request", "robot/x", "--name", "next", "--", "sh", "-c", script)
        await lab.state(client, lambda state: [wait.arc for wait in state.queue] == ["next"])
        os.kill(found.holder, number)
        said, _ = await asyncio.to_thread(next_one.communicate, timeout=HANG)
        assert "alone" in said
        code, _ = await found.ended()
        assert (code, gone(found.command)) == (75, True)


async def test_a_run_that_is_frozen_is_ended_by_its_guardian_with_the_hold(tmp_path: Path) -> None:
    async with bench(tmp_path, lease=3.0) as found:
        lab = found.lab
        lab.node("a", "robot/x")
        await lab.begun()
        await found.begin()
        assert found.running is not None
        found.running.send_signal(signal.SIGSTOP)
        assert gone(found.command), "its guardian had no later deadline from it"
        # The hold lasts: what else runs under it is not touched, and a release does not wait for what is frozen.
        assert (await lab.zscout("run", found.token, "--", "true")).returncode == 0
        assert (await lab.zscout("release", found.token)).returncode == 0
        found.running.send_signal(signal.SIGCONT)
        assert (await found.ended())[0] == 75

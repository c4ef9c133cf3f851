"""Holds in programs that run the author's code in a loop of their own: notebooks, web servers, test runners, pools.

A hold that is taken away ends none of them. The packages are those of `make programs`."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
import time
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.cli.cli_fleet import CliFleet, fleet_of
from tests.cli.tools import end, out_of, read_until
from tests.hang import HANG
from tests.ports import free_port

pytestmark = [pytest.mark.live, pytest.mark.slow]

TIMES = int(os.environ.get("ZSCOUT_PREEMPTIONS", "3"))
"""How often a hold is taken away in each program."""
NEEDS = "is not installed: make programs"


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory, fleet_kind: str) -> Iterator[CliFleet]:
    with fleet_of(tmp_path_factory.mktemp("hosts"), "robot/a", "robot/b") as fleet:
        yield fleet


def take(fleet: CliFleet, *rcs: str) -> None:
    done = fleet.zscout("request", *rcs, "--name", "taker", "--priority", "5", "--", "true")
    assert done.returncode == 0, done.stderr


def until(condition: Callable[[], object]) -> None:
    """Fails if it is not so within HANG seconds."""
    limit = time.monotonic() + HANG
    while not condition():
        assert time.monotonic() < limit, "it did not come about"
        time.sleep(0.05)


class Notebook:
    """A kernel, one cell after the other."""

    def __init__(self, fleet: CliFleet, monkeypatch: pytest.MonkeyPatch) -> None:
        nbclient = pytest.importorskip("nbclient", reason=f"nbclient {NEEDS}")
        pytest.importorskip("ipykernel", reason=f"ipykernel {NEEDS}")
        from nbformat.v4 import new_notebook

        for name, value in fleet.lab.env.items():
            monkeypatch.setenv(name, value)
        self._client: Any = nbclient.NotebookClient(new_notebook(), kernel_name="python3", timeout=3 * HANG)
        self._number = 0

    def cell(self, text: str) -> str:
        """What it prints. Raises what the cell raised, or DeadKernelError."""
        from nbformat.v4 import new_code_cell

        cell = new_code_cell(textwrap.dedent(text))
        self._client.nb.cells.append(cell)
        done = self._client.execute_cell(cell, self._number)
        self._number += 1
        return "".join(one["text"] for one in done.outputs if one["output_type"] == "stream").strip()

    def restart(self) -> None:
        from nbclient.util import run_sync

        run_sync(self._client.km.restart_kernel)(now=True)

    def __enter__(self) -> Notebook:
        self._opened = self._client.setup_kernel()
        self._opened.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        self._opened.__exit__(*error)


def test_a_notebook_keeps_its_variables_and_a_restart_gives_back(
    fleet: CliFleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Notebook(fleet, monkeypatch) as notebook:
        notebook.cell("import zscout; lab = zscout.connect(); kept, told = 42, []")
        for number in range(1, TIMES + 1):
            assert fleet.idle("robot/a", "robot/b")
            notebook.cell("""
                held = lab.acquire("survey", {"robot/a": {}})
                held.on_lost(lambda: told.append("lost"))
                entered = lab.hold("entered", {"robot/b": {}}).__enter__()  # and kept, as a `with` over cells would
            """)
            take(fleet, "robot/a", "robot/b")
            said = notebook.cell("""
                print(held.wait(60), entered.wait(60), kept, len(told), end=" ")
                for one in (held, entered):
                    try:
                        one.check()
                    except zscout.Revoked as revoked:
                        print(revoked.outcome, end=" ")
            """)
            assert said == f"True True 42 {number} preempted preempted"
        assert notebook.cell("""print(lab.acquire("again", {"robot/a": {}}).rcs)""") == "['robot/a']"
        notebook.restart()
        assert fleet.idle("robot/a")


APP = """
import zscout

class App:
    async def __call__(self, scope, receive, send):
        if scope["type"] == "lifespan":
            await receive()
            with zscout.connect() as lab, lab.hold("serve", {"robot/a": {}}) as held:
                self.lab, self.held = lab, held
                await send({"type": "lifespan.startup.complete"})
                await receive()
                held.release()
            await send({"type": "lifespan.shutdown.complete"})
            return
        if self.held.lost and scope["path"] == "/again":
            self.held.release()
            self.held = self.lab.acquire("serve", {"robot/a": {}})
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b"lost" if self.held.lost else b"held"})

app = App()
"""


@pytest.mark.parametrize("loop", ["asyncio", "uvloop"])
def test_a_web_server_serves_on_and_says_that_its_hold_is_lost(fleet: CliFleet, tmp_path: Path, loop: str) -> None:
    pytest.importorskip("uvicorn", reason=f"uvicorn {NEEDS}")
    (tmp_path / "app.py").write_text(APP)
    port = free_port()
    server = subprocess.Popen(
        [sys.executable, "-m", "uvicorn", "app:app", "--loop", loop, "--port", str(port)],
        cwd=tmp_path,
        env=fleet.lab.env,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        bufsize=1,
    )

    def get(path: str = "/") -> str:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=HANG) as answer:
            text: str = answer.read().decode()
            return text

    try:
        read_until(server, "Uvicorn running")
        for _ in range(TIMES):
            assert get("/again") == "held"
            take(fleet, "robot/a")
            until(lambda: get() == "lost")
        assert get("/again") == "held"
        server.send_signal(signal.SIGTERM)
        with out_of(server) as out:
            said = out.read()
        assert server.wait(HANG) in (0, -signal.SIGTERM), said
        assert "Traceback" not in said, said
        assert fleet.idle("robot/a")
    finally:
        end(server)


CONFTEST = """
import pytest, zscout

@pytest.fixture(scope="session")
def lab():
    with zscout.connect() as lab:
        yield lab

@pytest.fixture
def robot(lab):
    with lab.hold("test", {"robot/*": {}}) as held:
        yield held
"""


def test_test_runners_side_by_side_have_a_device_each(fleet: CliFleet, tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text(CONFTEST)
    test = 'def test_{}(robot):\n    assert robot.command("robot/*", {{"name": "echo", "value": 1}}) == 1\n'
    (tmp_path / "test_robots.py").write_text("".join(map(test.format, range(6))))
    command = [sys.executable, "-m", "pytest", "-q", "-n", "2", "-p", "no:cacheprovider", str(tmp_path)]
    done = subprocess.run(command, cwd=tmp_path, env=fleet.lab.env, capture_output=True, text=True, timeout=3 * HANG)
    assert done.returncode == 0, done.stdout
    assert "6 passed" in done.stdout
    assert fleet.idle("robot/a", "robot/b")


POOLS = """
import json, multiprocessing, sys
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
import zscout

def work(number, lab=None):
    own = lab or zscout.connect()
    try:
        for _ in range({times}):
            with own.hold(f"job{{number}}", {{"robot/*": {{}}}}) as held:
                if held.command("robot/*", {{"name": "echo", "value": number}}) != number:
                    return "other"
        return "done"
    finally:
        if lab is None:
            own.close()

if __name__ == "__main__":
    with zscout.connect() as lab, ThreadPoolExecutor(4) as threads:
        said = [*threads.map(lambda number: work(number, lab), range(4))]
    for how in ("spawn", "forkserver"):
        with ProcessPoolExecutor(2, mp_context=multiprocessing.get_context(how)) as processes:
            said += processes.map(work, range(2))
    print(json.dumps(said))
"""


def test_pools_of_threads_and_processes_take_turns(fleet: CliFleet, tmp_path: Path) -> None:
    (tmp_path / "pools.py").write_text(POOLS.format(times=TIMES))
    command = [sys.executable, str(tmp_path / "pools.py")]
    done = subprocess.run(command, env=fleet.lab.env, capture_output=True, text=True, timeout=3 * HANG)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == ["done"] * 8
    assert fleet.idle("robot/a", "robot/b")

"""Programs that somebody started badly, on a real mesh: standard streams closed, a terminal that lacks characters."""

from __future__ import annotations

import asyncio
import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.tools import COMMAND
from tests.hang import HANG
from tests.live.lab import Lab

pytestmark = pytest.mark.live

CLOSED = ["sh", "-c", 'exec <&- >&- 2>&-; exec "$@"', "sh"]
DEVICE = """
[[rc]]
name = "psu/one"
driver = "command"
safe = ["sh", "-c", 'echo "$ZSCOUT_DO" >> "%(told)s"']
start = ["sh", "-c", 'echo "$ZSCOUT_DO" >> "%(told)s"']
stop = ["sh", "-c", 'echo "$ZSCOUT_DO" >> "%(told)s"']
timeout = 100
"""
WORDS = "größe 日本 → 5 V"


@pytest.mark.slow
async def test_with_all_streams_closed_a_device_is_made_safe_and_a_command_runs(tmp_path: Path, lab: Lab) -> None:
    told, ran = tmp_path / "told", tmp_path / "ran"
    security = lab.security_of("small")
    file = lab.folder / "small.toml"
    file.write_text(f'[node]\nhost = "small"\nfleet = "fleet.toml"\n{security}{DEVICE % {"told": told}}')
    node = lab.nodes["small"] = lab.spawn([*CLOSED, sys.executable, "-m", "zscout.node", str(file)], log="small.log")
    client = await lab.client("crew")
    await lab.ready(client, "psu/one")
    request = [*CLOSED, *COMMAND, "request", "psu/one", "--", "sh", "-c", f"echo hi > {ran}; cat; echo hi"]
    running = lab.spawn(request, log="request.log")
    assert await asyncio.to_thread(running.wait, HANG) == 0
    assert ran.read_text() == "hi\n"
    node.send_signal(signal.SIGTERM)
    assert await asyncio.to_thread(node.wait, HANG) == 0
    said = told.read_text().split()
    assert said.count("start") == said.count("stop") == 1
    assert said[0] == said[-1] == "safe"


@pytest.mark.slow
async def test_a_comment_reaches_every_terminal(lab: Lab) -> None:
    lab.node("small", "dut/b1")
    client = await lab.client("crew")
    await lab.ready(client, "dut/b1")
    await client.request("survey", {"dut/b1": {}}, min_runtime=600, comment=WORDS)
    await lab.state(client, lambda state: len(state.holds) == 1)
    for encoding in ("ascii", "latin-1"):
        env = lab.env | {"PYTHONIOENCODING": encoding}
        for words in (["status"], ["status", "--json"], ["why", "survey"]):
            done = await asyncio.to_thread(subprocess.run, [*COMMAND, *words], env=env, capture_output=True)
            assert (done.returncode, done.stderr) == (0, b"")
            if "--json" in words:
                assert WORDS in json.dumps(json.loads(done.stdout.decode("ascii")), ensure_ascii=False)

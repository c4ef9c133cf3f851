"""The chaos itself, for a few seconds, where there are network namespaces."""

from __future__ import annotations

import json
import re
import subprocess
import sys

import pytest

from studies.chaos import net
from studies.chaos.__main__ import main
from tests.hang import HANG

try:
    net.check()
    why_not = ""
except net.NoNamespaces as error:
    why_not = str(error)

NEVER = range(1, 7)
"""Promises that no time is in."""
pytestmark = pytest.mark.live


@pytest.mark.slow
@pytest.mark.skipif(bool(why_not), reason=why_not)
def test_a_leader_is_killed_and_nothing_is_left() -> None:
    command = [sys.executable, "-m", "studies", "chaos", "--count", "1", "--only", "leader killed", "--json"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    told, _ = process.communicate(timeout=5 * HANG)
    found = json.loads(told)
    # On a busy machine what is promised within a time may come late; what may never be may not be there either.
    assert not [text for text in found["violations"] if int(re.findall(r"\[(\d+) ", text)[0]) in NEVER]
    assert process.returncode == (1 if found["violations"] else 0)
    assert found["figures"]["leader killed"]["next_grant"]["n"] == 1
    assert f"{net.PREFIX}{process.pid}" not in net.ip("netns", "list") + net.ip("link")


@pytest.mark.slow
@pytest.mark.skipif(bool(why_not), reason=why_not)
def test_a_net_that_was_closed_is_gone_at_once() -> None:
    for _ in range(5):
        closed = net.Net([f"h{number}" for number in range(10)])
        closed.open()
        closed.close()
        assert closed.mark not in net.ip("netns", "list") + net.ip("link")


def test_where_it_can_t_run_it_says_so(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    assert main([]) == 2
    assert capsys.readouterr().err == "chaos: network namespaces need root\n"

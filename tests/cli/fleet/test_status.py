"""`zscout status` on a real mesh: what it shows in a pipe, at a terminal, and to programs."""

from __future__ import annotations

import asyncio
import itertools
import json
import re
import signal
import subprocess
import termios
from typing import Any

import pytest

from tests.cli.cli_fleet import in_lab, patient_timing
from tests.cli.tools import CLOCK, COMMAND, Terminal, mine, ours, zscout_soon_until
from tests.hang import HANG
from tests.live.lab import PATIENT, Lab
from zscout.cli.fleet.status import differing

pytestmark = pytest.mark.live


def section(text: str, title: str) -> list[list[str]]:
    """The rows of one table of the plain output, without its heads; cells are two spaces or more apart; none where
    there is no such table."""
    lines = text.partition(f"\n{title}\n")[2].split("\n\n", 1)[0].splitlines()
    return [[cell.strip() for cell in line.split("  ") if cell.strip()] for line in lines[1:]]


@pytest.mark.slow
@in_lab(lease=PATIENT, extra=patient_timing())
async def test_the_fleet_is_shown_to_people_and_programs(lab: Lab) -> None:
    lab.node("anvil", "robot/a", "radio/rf0:rate=10")
    # One alone may lead: of two that begin together each may for a while.
    lab.node("bellows", "robot/b", extra="candidate = false")
    client, other = await lab.client("program"), await lab.client("other")
    await lab.ready(client, "robot/a", "robot/b", "radio/rf0")
    needs = {"robot/a": {}, "radio/rf0": {"rate": 4}}
    survey = await client.request("survey", needs, priority=1, min_runtime=600)
    take = await other.request("take", {"robot/b": {}}, priority=10, min_runtime=600, keep=True)
    await other.request("second", {"robot/b": {}}, priority=1, min_runtime=60)
    await client.request("first", {"robot/b": {}}, priority=2, min_runtime=60)
    await client.request("ghost", {"robot/nowhere": {}}, priority=0, min_runtime=60, wait_for_device=True)
    state = await lab.state(client, lambda state: len(state.queue) == 3 and len(state.holds) == 2)

    def all_seen(done: subprocess.CompletedProcess[str]) -> bool:
        """Whether all hosts show all that they have, and their loads."""
        if done.returncode:
            return False
        seen = {row[0]: row for row in section(done.stdout, "Hosts")}
        loads = [" of " in seen[host][2] for host in ("anvil", "bellows") if host in seen]
        whole = {"anvil": "node, 2 devices", "bellows": "node, 1 device", "test": "2 clients"}
        return {host: row[-1] for host, row in seen.items()} == whole and loads == [True, True]

    plain = await zscout_soon_until(all_seen, "status", env=lab.env)
    assert (plain.returncode, plain.stderr) == (0, "")
    assert f"Fleet {lab.fleet.name}: {state.host} leads, term {state.term.counter}" in plain.stdout
    assert section(plain.stdout, "Devices") == [
        ["radio/rf0", "shared", "held", "anvil", f"{mine('survey')} (rate=4)"],
        ["robot/a", "exclusive", "held", "anvil", mine("survey")],
        ["robot/b", "exclusive", "held", "bellows", mine("take")],
    ]
    running = section(plain.stdout, "Running")
    assert [(*row[:3], *row[-2:]) for row in running] == [
        ("take", ours(), "10", "robot/b", "test/other"),
        ("survey", ours(), "1", "radio/rf0 robot/a", "test/program"),
    ]
    assert re.fullmatch(rf"{CLOCK} \(\d+(\.\d)? s\)", running[0][3])
    assert re.fullmatch(rf"{CLOCK} \(.*\), keeps", running[0][4])
    waiting = section(plain.stdout, "Waiting")
    assert [(*row[:2], row[3]) for row in waiting] == [("1", "first", "2"), ("2", "second", "1"), ("3", "ghost", "0")]
    assert waiting[0][2] == ours()
    # It is kept by a higher rank: nobody knows for how long.
    assert waiting[0][-2:] == [f"waits for {mine('take')}: robot/b", "test/program"]
    assert waiting[2][-2] == "robot/nowhere not on the mesh"
    hosts = {row[0]: row for row in section(plain.stdout, "Hosts")}
    assert set(hosts) == {"anvil", "bellows", "test"}
    assert hosts[state.host][1] == "leads"
    assert " of " in hosts["anvil"][2]
    assert hosts["anvil"][-1] == "node, 2 devices"
    assert hosts["test"][1:] == ["no node", "-", "-", "-", "2 clients"]
    assert "\x1b" not in plain.stdout

    def told(done: subprocess.CompletedProcess[str]) -> bool:
        hosts = json.loads(done.stdout)["hosts"] if done.returncode == 0 else []
        loads = {host["host"]: host["load"] for host in hosts}
        return None not in (loads.get("anvil"), loads.get("bellows"))

    shown = json.loads((await zscout_soon_until(told, "status", "--json", env=lab.env)).stdout)
    assert shown["rcm"]["host"] == state.host
    assert [(rc["rc"], rc["present"], rc["sharable"], rc["host"]) for rc in shown["rcs"]] == [
        ("radio/rf0", True, True, "anvil"),
        ("robot/a", True, False, "anvil"),
        ("robot/b", True, False, "bellows"),
    ]
    assert shown["rcs"][0]["holders"] == [
        {"arc": "survey", "id": survey.id, "client": "test/program", "who": shown["holds"][1]["who"]}
    ]
    assert "{user}@{host} ({command})".format(**shown["holds"][1]["who"]) == ours()
    kept = next(hold for hold in shown["holds"] if hold["id"] == take.id)
    assert (kept["keep"], kept["priority"], kept["needs"]) == (True, 10, {"robot/b": {}})
    assert 0 < kept["remaining"] <= 600
    assert [wait["arc"] for wait in shown["queue"]] == ["first", "second", "ghost"]
    loads = {host["host"]: host["load"] for host in shown["hosts"]}
    assert loads["anvil"]["cores"] >= 1
    assert loads["test"] is None


@pytest.mark.slow
@in_lab(candidates=("anvil", "bellows"))
async def test_a_candidate_that_died_is_shown(lab: Lab) -> None:
    lab.node("anvil", "robot/a")
    client = await lab.client("program")
    await lab.ready(client, "robot/a")
    lab.node("bellows", "robot/b")
    await lab.ready(client, "robot/a", "robot/b")
    # One leads alone, and knows of what the other has: that may be the second, if it saw no leader at first.
    leaders: list[str] = []

    def one_leads(hosts: list[str]) -> bool:
        leaders[:] = hosts
        return len(hosts) == 1

    while (await lab.state(client, lambda state: len(state.rcs) == 2)).host not in leaders[:1]:
        await lab.living(client, "rcm", one_leads)
    (leader,) = leaders
    (other,) = {"anvil", "bellows"} - {leader}

    async def is_shown(as_it_is: str) -> None:
        def seen(done: subprocess.CompletedProcess[str]) -> bool:
            hosts = {row[0]: row[1] for row in section(done.stdout, "Hosts")}
            return done.returncode == 0 and hosts.get(other) == as_it_is

        await zscout_soon_until(seen, "status", env=lab.env)

    await is_shown("alive")
    lab.nodes[other].kill()
    await lab.state(client, lambda state: not all(rc.present for rc in state.rcs))
    await lab.living(client, "rcm", lambda hosts: hosts == [leader])
    await is_shown("not there")

    def told(done: subprocess.CompletedProcess[str]) -> bool:
        hosts = json.loads(done.stdout)["hosts"] if done.returncode == 0 else []
        alive = {host["host"]: host["alive"] for host in hosts}
        return alive == {leader: True, other: False, "test": True}

    await zscout_soon_until(told, "status", "--json", env=lab.env)


@pytest.mark.slow
@in_lab()
async def test_watching_in_a_pipe_prints_a_block_when_something_happens(lab: Lab) -> None:
    lab.node("anvil", "robot/a")
    # Whoever leads knows of both devices: it must not be this one that dies.
    bellows = lab.node("bellows", "robot/b", extra="candidate = false")
    client = await lab.client("program")
    await lab.ready(client, "robot/a", "robot/b")
    watcher = await asyncio.create_subprocess_exec(*COMMAND, "status", "--watch", env=lab.env, stdout=subprocess.PIPE)
    stdout = watcher.stdout
    assert stdout is not None
    blocks: list[str] = []

    async def block_with(*words: str) -> str:
        text = ""
        async with asyncio.timeout(HANG):
            while True:
                line = (await stdout.readline()).decode()
                assert line
                if line.startswith("Fleet "):
                    blocks.append(text)
                    text = ""
                text += line
                if all(word in text for word in words):
                    return text

    await block_with("robot/a  exclusive  free", "bellows")
    arc = await client.request("survey", {"robot/a": {}}, min_runtime=600)
    await block_with(f"robot/a  exclusive  held   anvil    {mine('survey')}")
    await client.end(arc)
    await block_with("robot/a  exclusive  free")
    bellows.kill()
    await block_with("robot/b  exclusive  absent", "gone since ")
    watcher.send_signal(signal.SIGINT)
    assert await watcher.wait() == 130
    # Loads and spans of time make no block: what is left without them differs from block to block.
    passing = re.compile(rf"{CLOCK}|\d+\.\d+|\d+ %|\(\d+ s\)|\d+ links?|\s+")
    lasting = [passing.sub(" ", block) for block in blocks]
    assert len(lasting) >= 4
    assert all(one != other for one, other in itertools.pairwise(lasting))


@in_lab()
async def test_watching_as_json_prints_a_line_each_time(lab: Lab) -> None:
    lab.node("anvil", "robot/a")
    client = await lab.client("program")
    await lab.ready(client, "robot/a")
    watcher = await asyncio.create_subprocess_exec(
        *COMMAND, "status", "--watch", "--json", env=lab.env, stdout=subprocess.PIPE
    )
    stdout = watcher.stdout
    assert stdout is not None

    async def holders() -> Any:
        async with asyncio.timeout(HANG):
            # It may begin before it sees who leads.
            while not (rcs := json.loads(await stdout.readline())["rcs"]):
                pass
            return rcs[0]["holders"]

    assert await holders() == []
    await client.request("survey", {"robot/a": {}}, min_runtime=600)
    while not (held := await holders()):
        pass
    assert held[0]["arc"] == "survey"
    watcher.terminate()
    assert await watcher.wait() == 128 + signal.SIGTERM


@pytest.mark.slow
@in_lab()
async def test_watching_at_a_terminal_draws_in_place_until_q(lab: Lab) -> None:
    lab.node("anvil", "robot/a")
    client = await lab.client("program")
    await lab.ready(client, "robot/a")

    with Terminal("status", "--watch", env=lab.env) as terminal:
        before = terminal.modes
        await asyncio.to_thread(terminal.until, "q or Ctrl-C ends")
        modes = terminal.modes[3]
        assert isinstance(modes, int)
        assert not modes & termios.ICANON
        await client.request("survey", {"robot/a": {}}, priority=10, min_runtime=600)
        await asyncio.to_thread(terminal.until, "RUNNING")
        assert "\x1b[1A" in terminal.raw, "the picture is drawn over the last"
        assert "\x1b[1;31m" in terminal.raw, "an operator's hold is red"
        terminal.press("q")
        assert await asyncio.to_thread(terminal.code) == 0
        assert terminal.modes == before
    with Terminal("status", "--watch", env=lab.env) as terminal:
        before = terminal.modes
        await asyncio.to_thread(terminal.until, "q or Ctrl-C ends")
        terminal.process.send_signal(signal.SIGINT)
        assert await asyncio.to_thread(terminal.code) == 130
        assert terminal.modes == before
        assert "Traceback" not in terminal.text


@in_lab()
async def test_without_an_rcm_it_shows_what_is_there_and_says_so(lab: Lab) -> None:
    lab.node("anvil", "robot/a", extra="candidate = false")
    client = await lab.client("program")
    there = asyncio.Event()
    client.mesh.watch(client.mesh.keys.alive_any("load"), lambda _token, _alive: there.set())
    async with asyncio.timeout(HANG):
        await there.wait()

    def all_seen(done: subprocess.CompletedProcess[str]) -> bool:
        return ["anvil", "node, 1 device"] in [[row[0], row[-1]] for row in section(done.stdout, "Hosts")]

    shown = await zscout_soon_until(all_seen, "status", env=lab.env)
    assert shown.returncode == 3
    assert "no leader" in shown.stdout
    assert shown.stderr.startswith(f"zscout: no leader is on the mesh of fleet {lab.fleet.name}")
    assert len(shown.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("own", "rights", "said"),
    [
        ("", {}, []),
        ("a", {"a": ["anvil", "cart"]}, []),
        ("a", {"b": ["anvil", "cart"]}, ["all hosts enforce other roles than this fleet file; take theirs, or "]),
        ("a", {"a": ["anvil"], "b": ["cart"]}, ["cart: enforces other roles than this fleet file; "]),
    ],
)
def test_hosts_whose_roles_differ_are_named(own: str, rights: dict[str, list[str]], said: list[str]) -> None:
    copy = "copy the fleet file to all hosts, and reload their nodes (SIGHUP)"
    assert differing(own, rights) == [words + copy for words in said]

"""Two nodes offer one RC: one of them obeys. Over a change of leader, and through a partition and its merge."""

from __future__ import annotations

import itertools
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from studies.chaos.net import Net, NoNamespaces, Processes, check
from tests.cli.fleet.test_status import section
from tests.hang import HANG
from tests.live.bench import granted
from tests.live.lab import TTL, Lab
from zscout import trace
from zscout.behaviors.client.client import Client
from zscout.config.fleet import default_fleet
from zscout.mesh import clock
from zscout.messages import Command, Done
from zscout.types import Grant, Ns

pytestmark = [pytest.mark.live, pytest.mark.slow]
RC = "robot/arm"


async def answers(client: Client, grant: Grant) -> list[Any]:
    """All that answer a command to the RC."""
    mesh = client.mesh
    command = Command(grant=grant, do={"name": "echo", "value": 1}, ttl=TTL)
    replies = await mesh.ask(mesh.keys.command(RC, mesh.me), command, Done, timeout=HANG)
    return [reply.message.result if reply.message is not None else reply.problem for reply in replies]


async def test_the_one_that_is_not_named_obeys_nothing_and_says_so(tmp_path: Path) -> None:
    async with Lab(tmp_path, candidates=("boss", "heir")) as lab:
        lab.node("boss")
        lab.node("heir")
        # Not the lesser name: it is meant because it came first, not by its host.
        lab.node("ws2", RC, extra="candidate = false")
        client = await lab.begun()
        lab.node("ws1", RC, extra="candidate = false")
        await lab.logged("ws1", "robot/arm is on standby: duplicate of robot/arm at ws2")
        arc = await client.request("work", {RC: {}}, min_runtime=600)
        grant = await granted(client, arc, confirmed=True)
        assert [await answers(client, grant) for _ in range(20)] == [[1]] * 20

        await lab.state(client, lambda state: [view.duplicates for view in state.rcs] == [["ws1"]])
        plain = await lab.zscout("status")
        (row,) = section(plain.stdout, "Devices")
        assert row[:4] == [RC, "exclusive", "held", "ws2"]
        assert [row[:2] for row in section(plain.stdout, "Health")] == [[RC, "at ws1: duplicate of robot/arm at ws2"]]

        # Who leads next has a link to both.
        await lab.candidates(client, "boss", "heir")
        before = await lab.state(client, lambda _: True)
        lab.nodes[before.host].kill()
        owners = [("ws2", ["ws1"])]
        await lab.state(
            client,
            lambda state: (
                state.term > before.term
                and bool(state.holds)
                and [(view.host, view.duplicates) for view in state.rcs] == owners
            ),
        )
        assert await answers(client, grant) == [1]


HALVES = (("lead1", "ws1", "desk1"), ("lead2", "ws2", "desk2"))
"""Each has a candidate, a node that offers the RC, and a program that commands it."""
COMMANDS = 30
"""That tell that it goes on."""
PROGRAM = f"""
import sys, time, zscout
from pathlib import Path
from zscout.config.fleet import load_fleet
with zscout.connect("program", fleet=load_fleet(Path(sys.argv[1])), host=sys.argv[2]) as lab:
    while True:
        try:
            with lab.hold("work", {{"{RC}": {{}}}}, min_runtime=0.5, wait_for_device=True, interrupt=False) as held:
                while held.active:
                    held.command("{RC}", {{"name": "echo", "value": 1}})
                    time.sleep(0.01)
        except (zscout.Revoked, zscout.CommandRefused, zscout.RequestRefused, zscout.NoRcm):
            time.sleep(0.05)
"""


class Obeyed(NamedTuple):
    at: Ns
    instance: str
    term: tuple[Any, ...]


def events(folder: Path, host: str, do: str) -> list[Any]:
    """What a host's log tells."""
    # The last line may be half written yet.
    log = (folder / f"{host}.log").read_text().rpartition("\n")[0]
    return [event for event in trace.lines(log.splitlines()) if event["do"] == do]


def obeyed(folder: Path) -> list[Obeyed]:
    """Every command that one of both has carried out, in the order of time."""
    found = [event for host in ("ws1", "ws2") for event in events(folder, host, "command")]
    return sorted(Obeyed(event["at"], event["instance"], tuple(event["term"])) for event in found)


def stood_by(folder: Path) -> int:
    """How often either has said that it stands by."""
    return sum((folder / f"{host}.log").read_text().count("is on standby: duplicate of") for host in ("ws1", "ws2"))


def test_of_two_nodes_with_one_rc_never_two_obey_one_reign(tmp_path: Path) -> None:
    """Through a partition, a merge and two changes of leader, all the time under commands from both sides."""
    try:
        check()
    except NoNamespaces as why:
        pytest.skip(str(why))
    net = Net([host for half in HALVES for host in half])
    processes = Processes(net, tmp_path)

    def until(what: str, holds: Callable[[list[Obeyed]], bool]) -> None:
        deadline = time.monotonic() + HANG
        while not holds(obeyed(tmp_path)):
            assert time.monotonic() < deadline, what
            time.sleep(0.2)

    def goes_on(commands: list[Obeyed], since: Ns) -> bool:
        return sum(one.at > since for one in commands) > COMMANDS

    try:
        net.open()
        fleet = tmp_path / "fleet.toml"
        fleet.write_text(f'[fleet]\nname = "{net.mark}"\ncandidates = ["lead1", "lead2"]\n[mesh]\ninterface = "eth0"\n')
        for lead, device, desk in HALVES:
            for host, more in ((lead, ""), (device, f'[[rc]]\nname = "{RC}"\ndriver = "exclusive"\n')):
                file = tmp_path / f"{host}.toml"
                file.write_text(f'[node]\nhost = "{host}"\nfleet = "fleet.toml"\n{more}')
                processes.start(host, [sys.executable, "-m", "zscout.node", str(file), "--log-level", "debug"])
            processes.start(desk, [sys.executable, "-c", PROGRAM, str(fleet), desk])
        until("somebody commands it", lambda commands: goes_on(commands, 0))

        ways = itertools.product(HALVES[0], HALVES[1])
        net.cut([way for one, other in ways for way in ((one, other), (other, one))])
        apart = clock.now()
        until(
            "both halves go on",
            lambda commands: (
                all(
                    goes_on([one for one in commands if one.instance == instance], apart)
                    for instance in {one.instance for one in commands}
                )
                and len({one.instance for one in commands}) == 2
            ),
        )
        before_merge = stood_by(tmp_path)
        net.cut([])
        # How long it takes until links are there again is nobody's promise: one of both says that it stands by.
        until("one of both stands by", lambda _: stood_by(tmp_path) > before_merge)
        alone = clock.now() + default_fleet().timing.hold_lease
        until("it goes on after the merge", lambda commands: goes_on(commands, alone))

        before = max(one.term for one in obeyed(tmp_path))
        # Halves that led before they met have terms of one number: the log names the whole term.
        (leader,) = {
            lead for lead, *_ in HALVES for event in events(tmp_path, lead, "publish") if tuple(event["term"]) == before
        }
        processes.kill(leader)
        until("it goes on with another leader", lambda commands: goes_on([c for c in commands if c.term > before], 0))
    finally:
        processes.close()
        net.close()

    reigns = defaultdict[tuple[Any, ...], dict[str, list[Ns]]](lambda: defaultdict(list))
    for one in obeyed(tmp_path):
        reigns[one.term][one.instance].append(one.at)
    assert len(reigns) >= 3
    for instances in reigns.values():
        spans = sorted((min(times), max(times)) for times in instances.values())
        assert all(first[1] < second[0] for first, second in itertools.pairwise(spans)), spans
    assert len({one.instance for one in obeyed(tmp_path) if one.at > alone}) == 1

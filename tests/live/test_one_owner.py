"""Two nodes offer one RC: one of them obeys. Over a change of leader, and through a partition and its merge."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.chaos.net import Net, NoNamespaces, Processes, check
from tests.cli.fleet.test_status import section
from tests.cli.tools import COMMAND, zscout_soon
from tests.hang import HANG
from tests.live.lab import Lab
from zscout.behaviors.client.client import Client
from zscout.messages import Command, Done
from zscout.types import Grant

pytestmark = pytest.mark.live
RC = "robot/arm"
SHORT = "[timing]\nhold_lease = 6\nrebuild = 0.4"


async def answers(client: Client, grant: Grant) -> list[Any]:
    """All that answer a command to the RC."""
    mesh = client.mesh
    command = Command(grant=grant, do={"name": "echo", "value": 1})
    replies = await mesh.ask(mesh.keys.command(RC, mesh.me), command, Done, timeout=1)
    return [reply.message.result if reply.message is not None else reply.problem for reply in replies]


def test_the_one_that_is_not_named_obeys_nothing_and_says_so(tmp_path: Path) -> None:
    async def story() -> None:
        async with Lab(tmp_path, lease=2, candidates=("boss", "heir"), extra=SHORT) as lab:
            lab.node("boss")
            lab.node("heir")
            # Not the lesser name: it is meant because it came first, not by its host.
            lab.node("ws2", RC, extra="candidate = false")
            client = await lab.client()
            await lab.ready(client, RC)
            lab.node("ws1", RC, extra="candidate = false")
            await lab.logged("ws1", "robot/arm stands by: duplicate of robot/arm at ws2")
            arc = await client.request("work", {RC: {}}, min_runtime=600)
            grant = await client.granted(arc)
            assert grant is not None
            assert [await answers(client, grant) for _ in range(20)] == [[1]] * 20

            await lab.state(client, lambda state: [view.duplicates for view in state.rcs] == [["ws1"]])
            plain = await zscout_soon("status", env=lab.env)
            (row,) = section(plain.stdout, "RCs")
            assert row[:4] == [RC, "exclusive", "held", "ws2"]
            assert [row[:2] for row in section(plain.stdout, "Devices")] == [
                [RC, "at ws1: duplicate of robot/arm at ws2"]
            ]

            before = await lab.state(client, lambda _: True)
            lab.nodes[before.host].kill()
            after = await lab.state(client, lambda state: state.term > before.term and bool(state.holds))
            assert [(view.host, view.duplicates) for view in after.rcs] == [("ws2", ["ws1"])]
            assert await answers(client, grant) == [1]

    asyncio.run(story())


class Halves:
    """Two hosts in network namespaces of their own; each may lead, and each offers the RC."""

    HOSTS = ("ws1", "ws2")

    def __init__(self, folder: Path) -> None:
        self.folder, self.net = folder, Net(self.HOSTS)
        self.processes = Processes(self.net, folder)
        self.fleet = folder / "fleet.toml"

    def start(self) -> None:
        connect = ", ".join(f'"tcp/{self.net.address(host)}:7447"' for host in self.HOSTS)
        self.fleet.write_text(
            '[fleet]\nname = "halves"\ncandidates = ["ws1", "ws2"]\n'
            f"[mesh]\nlease = 1\nmulticast = false\nconnect = [{connect}]\n"
        )
        for host in self.HOSTS:
            node = self.folder / f"{host}.toml"
            node.write_text(
                f'[node]\nhost = "{host}"\nfleet = "fleet.toml"\n[mesh]\nlisten = ["tcp/0.0.0.0:7447"]\n'
                f'[[rc]]\nname = "{RC}"\ndriver = "exclusive"\n'
            )
            self.processes.start(host, [sys.executable, "-m", "zscout.node", str(node)])

    def log(self, host: str) -> str:
        return (self.folder / f"{host}.log").read_text()

    async def status(self, host: str) -> dict[str, Any]:
        """What `zscout status` says of the RC on this host; empty where nobody leads."""
        command = [
            "ip",
            "netns",
            "exec",
            self.net.space(host),
            *COMMAND,
            "--fleet",
            str(self.fleet),
            "status",
            "--json",
        ]
        env = os.environ | {"ZSCOUT_HOST": f"eye-{host}"}
        done = await asyncio.to_thread(subprocess.run, command, env=env, capture_output=True, timeout=HANG, check=False)
        rcs = json.loads(done.stdout)["rcs"] if done.returncode == 0 else []
        return next((rc for rc in rcs if rc["rc"] == RC), {})

    async def says(self, at: str, /, **wanted: Any) -> dict[str, Any]:
        seen: dict[str, Any] = {}
        try:
            async with asyncio.timeout(HANG):
                while True:
                    seen = await self.status(at)
                    known = seen | {"unseen": sorted(seen.get("unseen", ()))}
                    if wanted.items() <= known.items():
                        return seen
        except TimeoutError:
            logs = "\n".join(f"--- {one}\n{self.log(one)}" for one in self.HOSTS)
            raise AssertionError(f"{at} never said {wanted}; last {seen}\n{logs}") from None


def test_each_half_of_a_partition_says_that_the_other_owner_is_not_seen_and_after_it_there_is_one(
    tmp_path: Path,
) -> None:
    try:
        check()
    except NoNamespaces as why:
        pytest.skip(str(why))
    halves = Halves(tmp_path)

    async def story() -> None:
        halves.net.open()
        halves.start()
        one = await halves.says("ws1", present=True, unseen=[])
        if not one["duplicates"]:
            one = await halves.says("ws1", present=True, duplicates=[{"ws1": "ws2", "ws2": "ws1"}[one["host"]]])
        halves.net.cut([("ws1", "ws2"), ("ws2", "ws1")])
        await asyncio.gather(
            halves.says("ws1", host="ws1", present=True, duplicates=[], unseen=["ws2"]),
            halves.says("ws2", host="ws2", present=True, duplicates=[], unseen=["ws1"]),
        )
        halves.net.cut([])
        found = await halves.says("ws1", present=True, unseen=[])
        while not found["duplicates"]:
            found = await halves.says("ws1", present=True, unseen=[])
        other = found["duplicates"][0]
        assert {found["host"], other} == {"ws1", "ws2"}
        assert (await halves.says("ws2", present=True, duplicates=[other]))["host"] == found["host"]
        assert f"robot/arm stands by: duplicate of robot/arm at {found['host']}" in halves.log(other)

    try:
        asyncio.run(story())
    finally:
        halves.processes.close()
        halves.net.close()

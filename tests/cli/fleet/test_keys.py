"""`zscout keys`: what it lists is there, and answers where it says so."""

from __future__ import annotations

import asyncio
import json
import subprocess

import msgspec
import pytest

from tests.cli.cli_fleet import in_lab
from tests.cli.tools import Terminal, zscout_soon, zscout_soon_until
from tests.hang import HANG
from tests.live.lab import Lab
from tests.live.rights import Present
from zscout.messages import (
    BookingsAsk,
    BookingsTold,
    ComponentList,
    HostRanking,
    ListComponents,
    ListPlacements,
    Placements,
    RankAsk,
    RcAsk,
    RcmState,
    RcState,
    StateAsk,
)

pytestmark = pytest.mark.live


@in_lab()
async def test_what_is_listed_lives_and_answers(lab: Lab) -> None:
    lab.node("anvil", "robot/a", "radio/rf0:rate=10")
    client = await lab.client("program")
    state = await lab.ready(client, "robot/a", "radio/rf0")
    everybody = {
        ("anvil", "node", "node"), ("anvil", "candidate", "node"), ("anvil", "rcm", "node"),
        ("anvil", "load", "node"), ("anvil", "rc", "robot/a"), ("anvil", "rc", "radio/rf0"),
        ("test", "client", "program"), ("anvil", "session", "node"), ("test", "session", "program"),
    }  # fmt: skip

    def all_seen(done: subprocess.CompletedProcess[str]) -> bool:
        alive = json.loads(done.stdout)["alive"] if done.returncode == 0 else []
        seen = {(one["host"], one["role"], one["name"]): one["keys"] for one in alive}
        # That one RC does not vote is known from the RCM.
        known = {len(keys) for (_, role, _), keys in seen.items() if role == "rc"} == {4, 5}
        return seen.keys() == everybody and known

    shown = json.loads((await zscout_soon_until(all_seen, "keys", "--json", env=lab.env)).stdout)
    base = f"zscout/{lab.fleet.name}"
    assert (shown["fleet"], shown["base"]) == (lab.fleet.name, base)
    assert shown["links"] >= 1
    alive = {(one["host"], one["role"], one["name"]): one for one in shown["alive"]}
    assert alive.keys() == everybody
    rcm = alive["anvil", "rcm", "node"]
    assert rcm["token"] == f"{base}/alive/anvil/rcm/node/{state.term.rcm}"
    queries = [key["key"].removeprefix(f"{base}/") for key in rcm["keys"] if key["how"] == "query"]
    named = "/*/*" if Present.secured else ""
    schedule, placer = "rcm/schedule/*/*", "placer/component/*/*"
    assert queries == [schedule, *(f"{key}{named}" for key in ("rcm/state", "rcm/bookings", "balancer/rank")), placer]

    async def answers(key: str, question: msgspec.Struct, kind: type[msgspec.Struct]) -> bool:
        asked = key.replace("/*/*", f"/{client.mesh.me}")
        reply = await client.mesh.ask_one(f"{base}/{asked}", question, kind, timeout=HANG)
        return reply is not None and reply.message is not None

    assert await answers(queries[1], StateAsk(), RcmState)
    assert await answers(queries[2], BookingsAsk(), BookingsTold)
    assert await answers(queries[3], RankAsk(), HostRanking)
    assert await answers(placer, ListPlacements(), Placements)
    (host,) = [key["key"].removeprefix(f"{base}/") for key in alive["anvil", "node", "node"]["keys"]]
    assert await answers(host, ListComponents(), ComponentList)
    for rc in ("robot/a", "radio/rf0"):
        served = {key["key"] for key in alive["anvil", "rc", rc]["keys"] if key["how"] == "query"}
        assert (f"{base}/rc/{rc}/vote" in served) == (rc == "radio/rf0")
        key = f"rc/{rc}/state{named}"
        assert f"{base}/{key}" in served
        assert await answers(key, RcAsk(), RcState)

    def the_same(done: subprocess.CompletedProcess[str]) -> bool:
        lines = [line.split() for line in done.stdout.splitlines()[3:]]
        listed = {(host, role, name, how, f"{base}/{key}") for host, role, name, how, key, *_ in lines}
        return {line for line in listed if line[3] != "-"} == {
            (*who, key["how"], key["key"]) for who, one in alive.items() for key in one["keys"]
        }

    plain = await zscout_soon_until(the_same, "keys", env=lab.env)
    assert plain.returncode == 0


@in_lab()
async def test_at_a_narrow_terminal_every_key_can_be_copied(lab: Lab) -> None:
    lab.node("anvil", "robot/a-rather-long-name-for-a-robot")
    client = await lab.client("program")
    await lab.ready(client, "robot/a-rather-long-name-for-a-robot")
    keys = ""
    async with asyncio.timeout(HANG):
        # It lists what its session sees in a second or two.
        while "rc/robot/a-rather-long-name-for-a-robot/command/*/*" not in keys:
            with Terminal("doctor", "--keys", env=lab.env, columns=80) as terminal:
                if await asyncio.to_thread(terminal.code):
                    continue
            lines = terminal.text.splitlines()[1:]
            assert max(map(len, lines)) <= 80
            assert "…" not in terminal.text
            begin = next(line for line in lines if line.startswith("HOST")).index("KEY")
            keys = "".join(line[begin:].strip() for line in lines if "HOST" not in line)


@pytest.mark.slow
@in_lab()
async def test_where_nobody_is_it_says_so(lab: Lab) -> None:
    shown = await zscout_soon("keys", env=lab.env)
    assert (shown.returncode, shown.stdout) == (3, "")
    assert "no other program either" in shown.stderr
    assert len(shown.stderr.splitlines()) == 1

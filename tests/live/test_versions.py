"""Nodes and programs of the first version, v0.1.0, and of this one in one fleet: what an upgrade host by host meets."""

from __future__ import annotations

import asyncio
import functools
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Awaitable, Callable
from decimal import Decimal
from pathlib import Path
from typing import Any, cast

import pytest

from tests.behaviors.components.kit import Hosts, counts, counts_on
from tests.cli.fleet.test_status import section
from tests.cli.tools import COMMAND
from tests.hang import HANG
from tests.live import message_samples
from tests.live.bench import comes_to, ended, granted, running, until
from tests.live.crew import Crew, Stand
from tests.live.former import MixedLab, environment, unpack
from tests.live.lab import PATIENT, HolderProcess, awaited
from tests.live.placing import LONGEST, Placing
from zscout import messages
from zscout.behaviors.client.placer_client import PlacerClient
from zscout.behaviors.client.request import RequestRefused
from zscout.mesh import Reply, clock, exchange
from zscout.messages import Ask, ComponentSpec, Grants, MigrateComponent, Output, PlaceComponent, Placement, ReadOutput
from zscout.services.placement.node_client import NodeClient
from zscout.types import SECOND, VERSION

pytestmark = pytest.mark.live

ECHO = {"name": "echo", "value": 7}
OTHER = {"old": "new", "new": "old"}
TELLS = {"old": "", "new": VERSION}
"""What each says of its version."""
leaders = pytest.mark.parametrize("leads", ["old", "new"])


@pytest.fixture(scope="module")
def former(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return unpack(tmp_path_factory.mktemp("v0.1.0"))


async def enters(holder: HolderProcess, arc: str, needs: dict[str, Any], *, priority: int = 0) -> dict[str, Any]:
    """Has it ask until it has entered: one of the first version gives up where a link to an RC is not there yet, and
    where an RC does not answer within a second."""
    while True:
        await holder.order("ask", arc=arc, needs=needs, priority=priority, min_runtime=600)
        event = await holder.event("entered", "not_entered", "refused")
        if event["event"] == "entered":
            return event
        assert event["code"] in ("unknown", "stale"), event


async def commands(holder: HolderProcess, *rcs: str) -> None:
    for rc in rcs:
        while True:
            await holder.order("command", rc=rc, do=ECHO, ttl=PATIENT)
            event = await holder.event("command")
            if event["code"] not in ("unknown", "stale"):  # on a busy machine: asked again
                break
        assert event.get("result") == ECHO["value"], event


@pytest.mark.slow
@leaders
async def test_a_gang_over_nodes_of_both_versions(tmp_path: Path, former: Path, leads: str) -> None:
    async with MixedLab(tmp_path, former, candidates=("a",)) as lab:
        with lab.at(leads):
            lab.node("a", "robot/a")
        with lab.at(OTHER[leads]):
            lab.node("b", "robot/b", "camera/b", "radio/b:rate=10")
        client = await lab.client()
        rcs = "robot/a", "robot/b", "camera/b", "radio/b"
        state = await lab.ready(client, *rcs)
        assert (state.host, state.version) == ("a", TELLS[leads])
        assert (await lab.rc(client, "robot/b")).version == TELLS[OTHER[leads]]
        with lab.at("old"):
            old = await lab.holder("old")
        needs: dict[str, Any] = {"robot/a": {}, "robot/b": {}, "camera/*": {}, "radio/b": {"rate": 6}}
        await enters(old, "first", needs)
        await commands(old, *rcs)

        second = await client.request("second", needs, min_runtime=600)
        assert (second.state, second.ahead) == ("queued", 0)
        await old.order("end")
        grant = await granted(client, second, confirmed=True)
        for rc in rcs:
            assert (await client.command(rc, grant, ECHO)).result == ECHO["value"]

        # A higher priority takes it, from either version; and what was taken comes back at its place.
        await enters(old, "boss", {"robot/a": {}}, priority=9)
        await lab.state(client, lambda state: [one.arc for one in state.queue] == ["second"])
        await comes_to(second, "queued")
        assert ended(second) == "preempted"
        old.kill()
        assert await client.granted(second) is not None
        await lab.held_by(client, "radio/b", "second")


@pytest.mark.slow
@leaders
async def test_a_leader_is_killed_and_one_of_the_other_version_goes_on(
    tmp_path: Path, former: Path, leads: str
) -> None:
    async with MixedLab(tmp_path, former, candidates=("a", "b")) as lab:
        apart = "candidate = false"
        with lab.at("old"):
            lab.node("c", "robot/c", "robot/old", extra=apart)
        with lab.at("new"):
            lab.node("d", "robot/d", "robot/free", extra=apart)
        with lab.at(leads):
            lab.node("a")
        client = await lab.begun("asker")
        with lab.at(OTHER[leads]):
            lab.node("b")
        crew = Crew()
        await crew.assemble(lab, ["robot/c", "robot/d"], waiting=4)
        with lab.at("old"):
            holds, waits = await asyncio.gather(lab.holder("holds"), lab.holder("waits"))
        await enters(holds, "holds", {"robot/old": {}})
        await waits.order("ask", arc="waits", needs={"robot/old": {}}, min_runtime=600)
        before = await lab.state(client, lambda state: len(state.queue) == 5)
        stood = Stand(before)
        assert (before.host, len(stood.holds)) == ("a", 3)
        await lab.candidates(client, "b")

        lab.signal("a", signal.SIGKILL)
        _, free = await running(client, "free", "robot/free")
        assert free.term > stood.term
        stood.went_on(await lab.state(client, lambda state: len(state.holds) == 4), "free")
        after = await crew.checked(lab, client, stood, since=clock.now())
        assert after.host == "b"
        await commands(holds, "robot/old")
        await holds.order("end")
        await waits.event("entered")
        await commands(waits, "robot/old")
        await asyncio.gather(*(body.finish() for body in crew.bodies))


@pytest.mark.slow
@leaders
async def test_a_component_moves_between_the_versions_with_its_hold(tmp_path: Path, former: Path, leads: str) -> None:
    async with MixedLab(tmp_path, former, candidates=("r",)) as lab:
        for version in ("old", "new"):
            with lab.at(version):
                lab.node(version)
        with lab.at(leads):
            lab.node("r", "robot/x", extra="[components]\nallow = false\n")
        client = await lab.client()
        placing, hosts = Placing(client), Hosts(await lab.manager(client))
        await lab.ready(client, "robot/x")
        await placing.hosts(3)
        said: list[Grants] = []
        client.mesh.subscribe(client.mesh.keys.grants, Grants, lambda _, grants: said.append(grants))
        spec = ComponentSpec("counter", {"period": 0.02, "rc": "robot/x"}, hosts=["old", "new"])
        await placing.get(PlaceComponent("c", spec), Placement)
        placed = await placing.until("c", lambda one: one.state == "running" and one.movable)
        at = placed.host
        assert at is not None
        for _ in range(2):
            await counts_on(hosts, at)
            moved = await placing.get(MigrateComponent("c", OTHER[at], wait=LONGEST), Placement)
            assert (moved.state, moved.host) == ("running", OTHER[at]), moved
            await counts_on(hosts, OTHER[at])
            # When it has ended there, all that it counted has been read.
            await hosts.ended(at, "c")
            assert (await counts(hosts, OTHER[at]))[0] == (await counts(hosts, at))[-1] + 1
            assert "lost" not in (await hosts.get(OTHER[at], ReadOutput("c"), Output)).text
            at = OTHER[at]
        # All that is published comes to this client later than to the RC.
        await until(lambda: sum(len(grants.revoked) for grants in said) >= 2)
        assert {one.outcome for grants in said for one in grants.revoked} == {"handed_over"}
        (holder,) = (await lab.rc(client, "robot/x")).holders
        assert (holder.arc, holder.client.partition("/")[0]) == ("c", at)


@pytest.mark.slow
@leaders
async def test_a_component_is_started_by_either_versions_program(tmp_path: Path, former: Path, leads: str) -> None:
    async with MixedLab(tmp_path, former, candidates=("a",)) as lab:
        with lab.at(leads):
            lab.node("a", extra="[components]\nallow = false\n")
        with lab.at(OTHER[leads]):
            lab.node("b")
        client = await lab.begun()
        # Before the balancer knows the other host, the one that takes no components would be asked, and refuse.
        await Placing(client).hosts(2)
        for version in ("old", "new"):
            with lab.at(version):
                start = "start", "spin", "--name", version, "--set", "cpu=0.01"
                program = lab.spawn([*COMMAND, *start], log=f"start-{version}.log")
            assert await asyncio.to_thread(program.wait, HANG) == 0, lab.log(f"start-{version}")
            assert (await Placing(client).placement(version)).host == "b"


def of_the_next_version(monkeypatch: pytest.MonkeyPatch) -> None:
    """This process, from now on."""
    monkeypatch.setattr(exchange, "VERSION", "0.4.0")


async def refusal(ask: Callable[[], Awaitable[Reply[Any] | None]]) -> messages.Problem:
    """Of the answer, which comes: a node that stands still for a second has not given it yet."""
    reply = await awaited(ask, lambda reply: reply is not None)
    assert reply is not None
    assert reply.problem is not None
    return reply.problem


class Book(messages.Message, frozen=True, tag_field="op", tag="book"):
    """An operation of a version to come."""

    id: str


@pytest.mark.slow
@leaders
async def test_what_the_other_side_does_not_know_is_refused_naming_both_versions(
    tmp_path: Path, former: Path, leads: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with MixedLab(tmp_path, former, candidates=("a",)) as lab:
        with lab.at(leads):
            lab.node("a", "robot/a")
        client = await lab.begun()
        link, operation = client._rcm, cast("Any", Book("b"))
        # What this version should not have sent is its own fault.
        assert ("upgrade" in (await refusal(lambda: link.query(operation))).message) == (leads == "old")

        of_the_next_version(monkeypatch)
        theirs = "older than 0.2.0" if leads == "old" else f"version {VERSION}"
        says = f"at a is {theirs}, this is 0.4.0: upgrade the older one"
        ask = Ask("x", "x", {"robot/{a,b}": {}}, 0, Decimal(1))
        for sent, code in ((operation, "malformed"), (ask, "bad_request")):
            problem = await refusal(functools.partial(link.query, sent))
            assert problem.code == code
            assert f"the leader {says}" in problem.message
        with pytest.raises(RequestRefused, match=f"the component placer {re.escape(says)}"):
            await PlacerClient(client.mesh).request(operation, Placement)
        node = NodeClient(client.mesh, round(HANG * SECOND))
        problem = await refusal(lambda: node._ask("a", operation, Placement, HANG))
        assert f"the node {says}" in problem.message


@pytest.mark.slow
async def test_status_names_who_runs_which_version_where_they_differ(tmp_path: Path, former: Path) -> None:
    async with MixedLab(tmp_path, former, candidates=("a",)) as lab:
        lab.node("a", "robot/a")
        client = await lab.begun()
        alone = await lab.zscout("status")
        assert "they differ" not in alone.stdout
        with lab.at("old"):
            lab.node("b", "robot/b")
        await lab.ready(client, "robot/a", "robot/b")
        words = f"they differ: older than 0.2.0 on b; version {VERSION} on a; this zscout is {VERSION}"
        # The link of a command that has just come to one of the nodes may be too young for what that one tells.
        mixed = await awaited(lambda: lab.zscout("status"), lambda done: words in done.stdout)
        assert section(mixed.stdout, "Warnings") == [["versions", words]]
        shown = json.loads((await lab.zscout("status", "--json")).stdout)
        assert shown["version"] == VERSION
        assert shown["versions"] == [{"version": None, "hosts": ["b"]}, {"version": VERSION, "hosts": ["a"]}]


@pytest.mark.slow
@leaders
async def test_a_command_is_told_that_nobody_waits_for_it(tmp_path: Path, former: Path, leads: str) -> None:
    who = [f"the leader at a (older than 0.2.0, this is {VERSION})"] * (leads == "old") + ["robot/old"]
    async with MixedLab(tmp_path, former, candidates=("a",)) as lab:
        with lab.at(leads):
            lab.node("a")
        for version in ("old", "new"):
            with lab.at(version):
                lab.node(version, f"robot/{version}")
        client = await lab.client()
        await lab.ready(client, "robot/old", "robot/new")
        request = "request", "robot/old", "robot/new", "--json", "--", "sleep", "600"
        lab.spawn([*COMMAND, *request], log="request.log")
        await lab.logged("request", "not_settling")
        # The line may be half written yet.
        await until(lambda: lab.log("request").partition("not_settling")[2].find("\n") >= 0)
        told = map(json.loads, lab.log("request").rpartition("\n")[0].splitlines())
        assert [one["who"] for one in told if one["event"] == "not_settling"] == [who]


def test_each_version_takes_every_message_of_the_other(former: Path) -> None:
    def old(what: str, told: str = "") -> Any:
        command = [sys.executable, message_samples.__file__, what]
        env = environment(former, os.environ)
        ran = subprocess.run(command, env=env, input=told, capture_output=True, text=True, timeout=HANG, check=True)
        return json.loads(ran.stdout)

    written = old("write")
    assert len(written) > 40
    assert message_samples.read(written) == []
    assert old("read", json.dumps(message_samples.write())) == []

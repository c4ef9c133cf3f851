"""Components on a real node: started, watched, limited, ended; and none outlives its node."""

from __future__ import annotations

import asyncio
import re
import signal
from decimal import Decimal
from pathlib import Path

import psutil
import pytest

from tests.behaviors.components.kit import ComponentLab, Hosts, gone, lives
from tests.behaviors.components.odd import TOO_LARGE
from tests.hang import HANG
from zscout.keyexpr import Role, Sender, Token
from zscout.mesh import ZenohMesh
from zscout.messages import (
    MAX_OUTPUT,
    MAX_PARAMS_SIZE,
    ActivateComponent,
    Checkpoint,
    CheckpointComponent,
    ComponentList,
    ComponentSpec,
    ComponentView,
    ListComponents,
    LoadReport,
    MoveComponent,
    OpenRequest,
    Output,
    ReadOutput,
    RestoreComponent,
    StartComponent,
    StopComponent,
)
from zscout.types import Grant, Term

pytestmark = pytest.mark.live

COUNTER = ComponentSpec("counter", {"period": 0.02}, restart="never")


@pytest.mark.slow
async def test_a_component_is_started_once_listed_read_checkpointed_and_stopped(lab: ComponentLab) -> None:
    lab.node("a")
    client = await lab.client()
    hosts = Hosts(await lab.manager(client))
    loads: asyncio.Queue[LoadReport] = asyncio.Queue()
    client.mesh.subscribe(client.mesh.keys.load_any, LoadReport, lambda _, load: loads.put_nowait(load))
    # Asked for twice at once, and again: there is one process.
    start = StartComponent("c", 7, COUNTER)
    first, second = await asyncio.gather(hosts.get("a", start, ComponentView), hosts.get("a", start, ComponentView))
    again = await hosts.get("a", start, ComponentView)
    assert first.pid is not None
    assert first.pid == second.pid == again.pid
    assert (again.phase, again.movable, again.host, again.reason) == ("running", True, "a", "")
    assert (again.component, again.incarnation, again.spec) == ("c", 7, COUNTER)
    # The link to a process that has just come may be younger than its node's word.
    await lab.living(client, Role.COMPONENT, bool)
    tokens = await client.mesh.living(client.mesh.keys.alive_any(Role.COMPONENT), timeout=HANG)
    assert [(token.host, token.name, token.instance[:2]) for token in tokens] == [("a", "c", "7-")]

    text = await hosts.output("a", "c", lambda text: "\n5\n" in text)
    assert numbers_in(text)[:5] == [1, 2, 3, 4, 5]
    at = text.index("\n2\n") + 1
    later = await hosts.get("a", ReadOutput("c", start=at), Output)
    assert (later.start, later.text[:2], later.over) == (at, "2\n", False)
    assert later.end == at + len(later.text)
    checkpoint = await hosts.get("a", CheckpointComponent("c"), Checkpoint)
    taken = re.fullmatch(rb'{"count": (\d+)}', checkpoint.state)
    assert taken is not None
    assert int(taken[1]) >= 5
    await hosts.output("a", "c", lambda text: f"\n{int(taken[1]) + 5}\n" in text)

    async with asyncio.timeout(HANG):
        while not (load := await loads.get()).components:
            pass
    assert [(use.component, use.kind, use.incarnation) for use in load.components] == [("c", "counter", 7)]
    assert load.components[0].memory > 10_000_000
    listed = await hosts.get("a", ListComponents(), ComponentList)
    assert [(view.component, view.phase) for view in listed.components] == [("c", "running")]
    assert {"counter", "spin", "still"} <= set(listed.kinds or ())
    assert (await hosts.get("a", ListComponents("d"), ComponentList)).components == []

    ended = await hosts.stop("a", "c")
    assert (ended.phase, ended.ended, ended.reason, ended.pid) == ("ended", "stopped", "", None)
    await gone(first.pid)
    assert (await hosts.stop("a", "c")).ended == "stopped"
    assert (await hosts.get("a", start, ComponentView)).phase == "ended"
    last = await hosts.get("a", ReadOutput("c"), Output)
    assert last.over
    assert last.text.startswith(text)
    # The link to it goes when it goes.
    await lab.living(client, Role.COMPONENT, lambda found: not found)
    anew = await hosts.start("a", "c", "counter", incarnation=8)
    # To the placer beside the leading RCM "c" is over: it may have it stopped at once.
    assert (anew.incarnation, anew.ended) in ((8, None), (8, "stopped"))


@pytest.mark.slow
async def test_what_a_node_does_not_do_it_refuses_with_the_reason(lab: ComponentLab) -> None:
    lab.node("a", extra="[components]\nmax = 2\n")
    lab.node("b", extra='[components]\nkinds = ["counter"]\n')
    lab.node("c", extra="[components]\nallow = false\n")
    hosts = Hosts(await lab.manager(await lab.client()))

    def start(name: str, incarnation: int, kind: str = "still") -> StartComponent:
        return StartComponent(name, incarnation, ComponentSpec(kind, restart="never"))

    assert await hosts.refused("a", start("x", 1, "nothing")) == "unknown_kind"
    assert await hosts.refused("a", start("x y", 1)) == "bad_request"
    large = ComponentSpec("still", {"text": "x" * MAX_PARAMS_SIZE})
    assert await hosts.refused("a", StartComponent("x", 1, large)) == "too_large"
    assert await hosts.refused("b", start("x", 1)) == "not_allowed"
    assert await hosts.refused("c", start("x", 1, "counter")) == "not_allowed"
    assert (await hosts.get("b", ListComponents(), ComponentList)).kinds == ["counter"]
    assert (await hosts.get("c", ListComponents(), ComponentList)).kinds == []
    for operation in (StopComponent("x"), CheckpointComponent("x"), ReadOutput("x")):
        assert await hosts.refused("a", operation) == "unknown_component"

    views = await asyncio.gather(hosts.start("a", "x", "still", incarnation=5), hosts.start("a", "y", "restless"))
    assert [view.phase for view in views] == ["running", "running"]
    assert await hosts.refused("a", start("x", 4)) == "old_incarnation"
    assert await hosts.refused("a", start("x", 6)) == "runs_already"
    assert await hosts.refused("a", start("z", 1)) == "too_many"
    assert await hosts.refused("a", StopComponent("x", 6)) == "unknown_component"
    assert await hosts.refused("a", CheckpointComponent("x")) == "not_movable"
    assert await hosts.refused("a", MoveComponent("x", 5, "b", 6)) == "not_movable"
    assert await hosts.refused("a", MoveComponent("x", 5, "a", 6)) == "bad_request"
    assert await hosts.refused("a", MoveComponent("y", 1, "b", 2, patience=0.2)) == "not_safe"
    assert await hosts.refused("a", RestoreComponent("y", 1, b"")) == "move_failed"
    await hosts.stop("a", "x")
    assert await hosts.refused("a", start("x", 5 - 1)) == "old_incarnation"
    assert await hosts.refused("a", MoveComponent("x", 5, "b", 6)) == "bad_request"
    # A state that is too large: it goes on. Another name: to the placer "x" is over, which may have it stopped.
    big = await hosts.start("a", "z", "restless", {"size": TOO_LARGE})
    assert await hosts.refused("a", CheckpointComponent("z")) == "too_large"
    assert (await hosts.get("a", ListComponents("z"), ComponentList)).components[0].pid == big.pid


@pytest.mark.slow
async def test_one_that_does_not_get_ready_is_killed(tmp_path: Path) -> None:
    # Alone: what else begins at that moment has the same limit, and may need longer beside other work.
    async with ComponentLab(tmp_path, start_timeout=20) as lab:
        lab.node("a")
        never = await Hosts(await lab.manager(await lab.client())).start("a", "never", "never")
        assert (never.ended, quiet(never.tail)) == ("failed", "warming up\n")
        assert never.reason == "it was killed: it did not get ready within 20 s"


@pytest.mark.slow
async def test_how_one_ended_is_told_as_it_was(lab: ComponentLab) -> None:
    lab.node("a")
    hosts = Hosts(await lab.manager(await lab.client()))

    ways = ("raise", "exit", "vanish", "abort", "children")
    for way in ways:
        await hosts.start("a", way, "brief", {"how": way})
    ends = {way: await hosts.ended("a", way) for way in ways}
    assert {way: view.ended for way, view in ends.items()} == dict.fromkeys(ways, "failed") | {"children": "completed"}
    assert ends["raise"].reason == "RuntimeError: the camera fell off"
    assert quiet(ends["raise"].tail).startswith("last words\nTraceback")
    assert ends["raise"].tail.endswith("RuntimeError: the camera fell off\n")
    assert "exited with 3" in ends["exit"].reason
    assert "without a report" in ends["vanish"].reason
    assert ends["abort"].reason == "killed by SIGABRT"
    assert quiet(ends["abort"].tail) == "last words\n"

    bad = await hosts.start("a", "bad", "spin", {"cpu": "much"})
    assert (bad.ended, quiet(bad.tail)) == ("failed", "")
    assert 'bad parameters: cpu: is the text "much"; write a number' in bad.reason
    for kind, words in (("no-component", "not a subclass of"), ("missing", "can't be imported")):
        wrong = await hosts.start("a", kind, kind)
        assert (wrong.phase, wrong.ended) == ("ended", "failed")
        assert words in wrong.reason

    deaf = await hosts.start("a", "deaf", "deaf")
    ended = await hosts.stop("a", "deaf", grace=0.3)
    assert ended.ended == "stopped"
    assert "killed: it had not ended 0.3 s after" in ended.reason
    assert deaf.pid is not None
    await gone(deaf.pid)

    await hosts.start("a", "flood", "flood")
    await hosts.output("a", "flood", lambda text: len(text) == MAX_OUTPUT)
    told = await hosts.get("a", ReadOutput("flood"), Output)
    assert told.end - told.start == MAX_OUTPUT
    assert told.text.count("\ufffd") == told.text.count("\n") == MAX_OUTPUT // 64
    # Nobody else waits for that.
    assert (await hosts.start("a", "calm", "still")).phase == "running"


@pytest.mark.slow
async def test_limits_hold_for_the_component_alone(lab: ComponentLab) -> None:
    lab.node("a")
    hosts = Hosts(await lab.manager(await lab.client()))
    calm = await hosts.start("a", "calm", "still", memory_limit=200_000_000)
    spin = await hosts.start("a", "spin", "spin", {"cpu": 1.0}, cpu_limit=0.4)
    assert calm.pid is not None
    assert spin.pid is not None
    before = psutil.Process(spin.pid).cpu_times()
    await hosts.start("a", "eater", "eater", {"memory": 400}, memory_limit=150_000_000)
    eater = await hosts.ended("a", "eater")
    after = psutil.Process(spin.pid).cpu_times()
    if "control groups" in calm.reason:
        # This host lets us make none: each process limits itself, and says so.
        assert "MemoryError" in eater.reason
        assert "cpu_limit can't be set" in spin.reason
    else:
        assert eater.reason == "killed: used more memory than its limit of 150000000 bytes"
        again = await hosts.get("a", ListComponents("spin"), ComponentList)
        used = after.user + after.system - before.user - before.system
        assert used <= 0.4 * (again.components[0].uptime - spin.uptime) + 0.2
    listed = await hosts.get("a", ListComponents(), ComponentList)
    phases = {view.component: view.phase for view in listed.components}
    assert phases == {"calm": "running", "spin": "running", "eater": "ended"}
    assert lives(calm.pid)


def quiet(text: str) -> str:
    """A component's output without warnings that its process stood still."""
    return "".join(line for line in text.splitlines(keepends=True) if not line.startswith("WARNING"))


def numbers_in(text: str) -> list[int]:
    """Those in a component's output."""
    return [int(word) for word in quiet(text).split()]


async def test_nothing_outlives_a_node_that_is_killed(lab: ComponentLab) -> None:
    lab.node("a")
    hosts = Hosts(await lab.manager(await lab.client()))
    kinds = {"free": {}, "busy": {"busy": True}, "frozen": {}}
    pids: list[int] = []
    for name, params in kinds.items():
        view = await hosts.start("a", name, "parent", params)
        text = await hosts.output("a", name, lambda text: len(numbers_in(text)) == 3)
        assert view.pid is not None
        family = [view.pid, *numbers_in(text)]
        assert all(map(lives, family))
        pids += family
        if name == "frozen":
            psutil.Process(view.pid).send_signal(signal.SIGSTOP)
    lab.signal("a", signal.SIGKILL)
    await gone(*pids)


@pytest.mark.slow
async def test_a_node_that_stops_ends_its_components_and_what_they_started(lab: ComponentLab) -> None:
    node = lab.node("a", "robot/x")
    client = await lab.client()
    hosts = Hosts(await lab.manager(client))
    await lab.ready(client, "robot/x")
    views = [
        await hosts.start("a", "count", "counter", {"rc": "robot/x", "period": 0.02}),
        await hosts.start("a", "parent", "parent"),
        await hosts.start("a", "deaf", "deaf"),
    ]
    text = await hosts.output("a", "parent", lambda text: len(numbers_in(text)) == 3)
    await hosts.output("a", "count", lambda text: "3\n" in text)
    pids = [view.pid for view in views if view.pid is not None]
    lab.signal("a", signal.SIGTERM)
    await gone(*pids, *numbers_in(text))
    await asyncio.to_thread(node.wait, HANG)
    assert "count released" in lab.log("a")
    assert "Traceback" not in lab.log("a")


@pytest.mark.slow
async def test_who_sees_a_higher_incarnation_ends_itself(lab: ComponentLab) -> None:
    lab.node("a")
    client = await lab.client()
    hosts = Hosts(await lab.manager(client))
    await hosts.start("a", "c", "still", incarnation=7)
    await hosts.start("a", "deaf", "deaf", incarnation=7)
    await hosts.start("a", "d", "still", incarnation=7)
    async with await ZenohMesh.open(lab.fleet_of("b"), Sender("b", "node")) as mesh:
        shown = (("c", "6-x"), ("c", "x"), ("c", "8-x"), ("deaf", "9-x"))
        # A token lives as long as its declaration is kept.
        tokens = [mesh.alive(Token("b", Role.COMPONENT, name, instance)) for name, instance in shown]
        for name in ("c", "deaf"):
            await hosts.ended("a", name)
        for token in tokens:
            token.close()
    listed = await hosts.get("a", ListComponents(), ComponentList)
    ends = {view.component: (view.ended, view.reason) for view in listed.components}
    assert ends == {
        "c": ("superseded", "incarnation 8 runs on b"),
        "deaf": ("superseded", "incarnation 9 runs on b"),
        "d": (None, ""),
    }


@pytest.mark.slow
async def test_one_that_does_not_reach_a_device_takes_over_no_hold_of_it(lab: ComponentLab) -> None:
    """It would have to give back at once what it was handed over, to whoever waits for it."""
    lab.node("a", "robot/x")
    client = await lab.client()
    hosts = Hosts(await lab.manager(client))
    await hosts.start("a", "c", "counter", {"period": 0.02, "rc": "robot/x"}, standby=True)

    def held(rc: str) -> RestoreComponent:
        request = OpenRequest("r1", "c", {rc: {}}, 0, Decimal(60), grant=Grant(Term(1, "x"), 1))
        return RestoreComponent("c", 1, b'{"count": 41}', [request])

    assert await hosts.refused("a", held("robot/elsewhere")) == "start_failed"
    view = await hosts.get("a", held("robot/x"), ComponentView)
    assert view.phase == "standby"


@pytest.mark.slow
async def test_one_that_stands_by_runs_when_it_is_activated(lab: ComponentLab) -> None:
    lab.node("a")
    client = await lab.client()
    hosts = Hosts(await lab.manager(client))
    view = await hosts.start("a", "c", "counter", {"period": 0.02}, standby=True)
    assert view.phase == "standby"
    assert await client.mesh.living(client.mesh.keys.alive_any(Role.COMPONENT), timeout=1) == []
    assert await hosts.refused("a", CheckpointComponent("c")) == "bad_request"
    view = await hosts.get("a", RestoreComponent("c", 1, b'{"count": 41}'), ComponentView)
    assert view.phase == "standby"
    view = await hosts.get("a", ActivateComponent("c", 1), ComponentView)
    assert view.phase == "running"
    # A line comes in two pieces, and not before warnings of a process that stood still.
    text = await hosts.output("a", "c", lambda text: "\n43\n" in text)
    assert "42" in text.splitlines()
    assert "41" not in text.splitlines()
    assert (await hosts.get("a", ActivateComponent("c", 1), ComponentView)).phase == "running"
    assert await hosts.refused("a", RestoreComponent("c", 1, b"")) == "move_failed"

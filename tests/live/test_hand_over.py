"""All that a client has goes on in another one, in one step, whoever dies: or in none, and the old one has it."""

from __future__ import annotations

import asyncio
import re
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from tests.hang import HANG
from tests.live.bench import ECHO, Bench, SharedBench, Stand, answer, granted, running, until
from tests.live.crew import Body
from tests.live.handing_over import NEEDS, claimed, holding, me, patiently, settle_down
from tests.live.lab import Lab
from tests.live.stranger import Stranger, beside_a_node, good_ask
from tests.thorough import times
from zscout.behaviors.client import handover
from zscout.behaviors.client.arc import Held, holds
from zscout.behaviors.client.client import Client, RequestRefused
from zscout.keyexpr import Sender
from zscout.messages import Grants, OpenRequest, RcState
from zscout.types import Grant

pytestmark = pytest.mark.live

ROUNDS = times(20)


# Who was the owner, and is no longer


@pytest.fixture
def stranger(tmp_path: Path) -> Iterator[Stranger]:
    yield from beside_a_node(tmp_path)


def test_the_old_id_of_what_was_handed_over_does_nothing(stranger: Stranger) -> None:
    token = stranger.token("t/client/next/1")
    runs = good_ask(id="runs", needs={"robot/a": {}}, min_runtime=60)
    waits = good_ask(id="waits", needs={"robot/a": {}}, min_runtime=60)
    for asked in (runs, waits):
        stranger.ask("rcm/schedule/t/good", asked)
    place = stranger.ask("rcm/schedule/t/good", waits)["place"]
    over = {"op": "hand_over", "id": "runs", "to": "t/next", "others": ["waits", "nothing"]}
    moved = stranger.ask("rcm/schedule/t/good", over)
    assert (moved["client"], moved["state"]) == ("t/next", "running")
    for asked in (runs, waits):
        for operation in ({"op": "cancel", "id": asked["id"]}, {"op": "release", "id": asked["id"]}, asked):
            told = stranger.ask("rcm/schedule/t/good", operation)
            assert (told["state"], told["outcome"]) == ("ended", "handed_over")
    # A leader that knows nothing of it knows the ARC by its place.
    known = stranger.ask("rcm/schedule/t/other", waits | {"place": place})
    assert (known["state"], known["outcome"]) == ("ended", "handed_over")
    # Doing it again changes nothing.
    assert stranger.ask("rcm/schedule/t/good", over)["grant"] == moved["grant"]
    stranger.ask("rc/robot/a/command/t/next", {"grant": moved["grant"], "do": {"name": "confirm"}})
    still = stranger.ask("rcm/schedule/t/next", waits)
    assert (still["state"], still["place"]) == ("queued", place)
    stranger.ask("rcm/schedule/t/next", {"op": "release", "id": "runs"})
    assert stranger.ask("rcm/schedule/t/next", waits)["state"] == "running"
    stranger.ask("rcm/schedule/t/next", {"op": "release", "id": "waits"})
    again = stranger.ask("rcm/schedule/t/good", over)
    assert (again["state"], again["outcome"]) == ("ended", "released")
    token.undeclare()
    stranger.serves()


def test_a_hand_over_takes_no_other_request_of_that_name(stranger: Stranger) -> None:
    token = stranger.token("t/client/next/1")
    for client, rc in (("good", "robot/a"), ("next", "radio/a")):
        stranger.ask(f"rcm/schedule/t/{client}", good_ask(id="same", needs={rc: {}}, min_runtime=60))
    message = b'{"op": "hand_over", "id": "same", "to": "t/next"}'
    [(kind, answer_)] = stranger.get("rcm/schedule/t/good", message)
    assert (kind, answer_["code"]) == ("err", "bad_request")
    holders = {view["client"]: list(view["needs"]) for view in stranger.state()["holds"]}
    assert holders == {"t/good": ["robot/a"], "t/next": ["radio/a"]}
    for client in ("good", "next"):
        stranger.ask(f"rcm/schedule/t/{client}", {"op": "release", "id": "same"})
    token.undeclare()
    stranger.serves()


# All at once


class Record:
    """What the RCM, after its publication number `since`, and the RCs published about holders."""

    def __init__(self, client: Client, *, since: int) -> None:
        self._since = since
        self.said: list[Grants] = []
        self.held: set[tuple[str, tuple[str, ...]]] = set()
        mesh = client.mesh
        mesh.subscribe(mesh.keys.grants, Grants, self._on_grants)
        mesh.subscribe(mesh.keys.rc_state_any, RcState, self._on_state)

    def _on_grants(self, _key: str, said: Grants) -> None:
        # One that was made before may arrive now.
        if said.rcs and said.seq > self._since:
            self.said.append(said)

    def _on_state(self, _key: str, state: RcState) -> None:
        self.held.add((state.rc, tuple(holder.arc for holder in state.holders)))


@pytest.mark.essential
async def test_all_goes_over_in_one_step_and_nobody_gets_in_between(
    lab: Lab, stand: Stand, monkeypatch: pytest.MonkeyPatch
) -> None:
    patiently(monkeypatch)
    lab.node("a")
    robot, radio = Bench(), SharedBench()
    await stand.rc("robot/x", robot)
    await stand.rc("radio/f", radio)
    old, new, other = await lab.client("old"), await lab.client("new"), await lab.client("rival")
    await lab.ready(old, "robot/x", "radio/f")
    before = await claimed(old, list(NEEDS))
    assert [arc.state for arc in before.values()] == ["running", "running", "queued"]
    for name in ("drive", "talk"):
        assert await old.granted(before[name], confirmed=True) is not None
    grants = {name: arc.grant for name, arc in before.items()}
    rival = await other.request("rival", {"robot/x": {}}, min_runtime=600)
    stands = await lab.state(other, lambda state: len(state.holds) == len(state.queue) == 2)
    robot.calls.clear()
    radio.calls.clear()
    record = Record(other, since=stands.seq)

    old.internals.pause()
    told = old.internals.open_requests()
    new.internals.expect(told)
    # Who asks too early is given what is expected, as soon as it comes.
    early = asyncio.create_task(new.request("drive", NEEDS["drive"], min_runtime=1))
    await asyncio.sleep(0)
    assert not new.internals.expected_came.is_set()
    await old.internals.hand_over_all(me(new))
    await asyncio.wait_for(new.internals.expected_came.wait(), HANG)
    drive = await early
    after = {"drive": drive} | await claimed(new, ["talk", "later"])

    assert [after[name].id for name in NEEDS] == [before[name].id for name in NEEDS]
    assert [after[name]._place for name in NEEDS] == [before[name]._place for name in NEEDS]
    assert [arc.state for arc in before.values()] == ["moved"] * 3
    for name in ("drive", "talk"):
        old_grant, new_grant = grants[name], await new.granted(after[name])
        assert old_grant is not None
        assert new_grant is not None
        assert new_grant > old_grant
        rc = min(NEEDS[name])
        assert await answer(new.command(rc, new_grant, ECHO)) == "done"
        assert await answer(old.command(rc, old_grant, ECHO)) == "ended"
    assert after["later"].state == rival.state == "queued"
    # One publication told of both holds, and none of anything else.
    await until(lambda: bool(record.said))
    [said] = record.said
    assert {rc: [(one.arc, one.client) for one in found] for rc, found in said.rcs.items()} == {
        "robot/x": [("drive", "test/new")],
        "radio/f": [("talk", "test/new")],
    }
    assert {gone.outcome for gone in said.revoked} == {"handed_over"}
    # An RC tells as well how long it was used, whenever that is: under nobody else.
    assert record.held <= {("robot/x", ("drive",)), ("radio/f", ("talk",))}
    assert (robot.calls, radio.calls) == (["begin drive"], ["begin talk"])

    # The old client leaves: that touches nobody. What waited is next, at its old place.
    await old.internals.leave()
    await lab.living(new, "client", lambda hosts: len(hosts) == 2)
    await new.end(drive)
    await until(lambda: after["later"].state == "running")
    assert rival.state == "queued"
    assert new.internals.open_requests()[0].arc == "talk"


@pytest.mark.slow
async def test_back_and_forth_without_end(lab: Lab, stand: Stand, monkeypatch: pytest.MonkeyPatch) -> None:
    patiently(monkeypatch)
    lab.node("a")
    robot = Bench()
    await stand.rc("robot/x", robot)
    await stand.rc("radio/f", SharedBench())
    here, there = await lab.client("here"), await lab.client("there")
    other = await lab.client("rival")
    await lab.ready(here, "robot/x", "radio/f")
    arcs = await claimed(here, list(NEEDS))
    rival = await other.request("rival", {"robot/x": {}}, min_runtime=600)
    assert await here.granted(arcs["drive"], confirmed=True) is not None
    stands = await lab.state(other, lambda state: len(state.holds) == len(state.queue) == 2)
    record = Record(other, since=stands.seq)
    seen: list[Grant | None] = [arcs["drive"].grant]
    for _ in range(ROUNDS):
        arcs = await settle_down(here, there, list(NEEDS))
        seen.append(arcs["drive"].grant)
        here.internals.resume()
        here, there = there, here
    assert None not in seen
    assert seen == sorted(set(seen), key=seen.index)
    assert len(set(seen)) == ROUNDS + 1
    await until(lambda: len(record.said) >= ROUNDS)
    assert len(record.said) == ROUNDS
    assert {tuple(one.arc for one in said.rcs["robot/x"]) for said in record.said} == {("drive",)}
    assert "safe" not in robot.calls
    grant = await granted(here, arcs["drive"])
    assert await answer(here.command("robot/x", grant, ECHO)) == "done"
    assert rival.state == arcs["later"].state == "queued"


@pytest.mark.slow
async def test_bodies_go_on_after_a_hand_over_that_was_refused(lab: Lab) -> None:
    lab.node("a", "robot/x")
    client, other = await lab.client("old"), await lab.client("rival")
    await lab.ready(client, "robot/x")
    body = Body(client, "drive", "robot/x")
    await body.entered()
    await body.beats_on(0)
    client.internals.pause()
    with pytest.raises(RequestRefused, match="no/body is not on the mesh") as refused:
        await client.internals.hand_over_all(Sender("no", "body"))
    assert refused.value.code == "unknown_client"
    client.internals.resume()
    await body.beats_on(body.beats[-1])
    # What happens to a hold while the client is paused is told when it is not any more.
    client.internals.pause()
    taker, _ = await running(other, "operator", "robot/x", priority=9)
    # It has been told so.
    await until(lambda: not client.internals.open_requests() or client.internals.open_requests()[0].grant is None)
    await asyncio.sleep(0.1)
    interrupted = not body.task.done() and body.task.cancelling()
    assert not interrupted
    assert client.internals.open_requests()[0].grant is None
    client.internals.resume()
    await asyncio.wait({body.task}, timeout=HANG)
    assert re.search(r"preempted by \S+ \(\S+@\S+\), priority 9$", str(body.task.exception()))
    await other.end(taker)


@pytest.mark.slow
async def test_what_was_handed_to_one_who_died_is_taken_back(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    patiently(monkeypatch)
    lab.node("a", "robot/x", "radio/f:rate=5")
    old, new, other = await lab.client("old"), await lab.client("new"), await lab.client("rival")
    await lab.ready(old, "robot/x", "radio/f")
    entered: list[Held] = []
    done = asyncio.Event()

    async def drive() -> None:
        async for attempt in holds(old, "drive", NEEDS["drive"], min_runtime=600):
            async with attempt as held:
                entered.append(held)
                await done.wait()

    body = asyncio.create_task(drive())
    await until(lambda: bool(entered))
    later = await old.request("later", NEEDS["later"], min_runtime=600)
    rival = await other.request("rival", {"robot/x": {}}, min_runtime=600)
    places, ids = (entered[0].arc._place, later._place), (entered[0].arc.id, later.id)
    old.internals.pause()
    new.internals.expect(old.internals.open_requests())
    await old.internals.hand_over_all(me(new))
    assert (entered[0].arc.state, later.state, len(entered)) == ("moved", "moved", 1)
    assert not entered[0].active
    await new.internals.leave()
    old.internals.take_back()
    await until(lambda: rival.state == "running" or len(entered) == 2)
    # Where the rival was quicker, the places decide once it ends.
    await other.end(rival)
    await until(lambda: len(entered) == 2 and entered[1].active and later.state == "queued")
    assert (entered[1].arc._place, later._place) == places
    assert not {entered[1].arc.id, later.id} & set(ids)
    done.set()
    await asyncio.wait_for(body, HANG)
    await until(lambda: later.state == "running")


@pytest.mark.slow
@pytest.mark.parametrize("done", [False, True])
async def test_after_an_unknown_outcome_all_is_the_old_client_s_again(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, done: bool
) -> None:
    monkeypatch.setattr(handover, "HAND_OVER", 0.0)
    lab.node("a", "robot/x", "radio/f:rate=5")
    old, new = await lab.client("old"), await lab.client("new")
    await lab.ready(old, "robot/x", "radio/f")
    arcs = await claimed(old, list(NEEDS))
    places, ids = [arc._place for arc in arcs.values()], [arc.id for arc in arcs.values()]
    grant = arcs["drive"].grant
    old.internals.pause()
    new.internals.expect(old.internals.open_requests())
    if done:
        for arc in arcs.values():
            await old.hand_over(arc, me(new))
    with pytest.raises(RequestRefused) as refused:
        await old.internals.hand_over_all(me(new))
    assert refused.value.code == "unknown"
    await new.internals.leave()
    await lab.living(old, "client", lambda hosts: len(hosts) == 1)
    old.internals.take_back()
    old.internals.resume()
    await until(lambda: not done or not {arc.id for arc in arcs.values()} & set(ids))
    # What was asked without waiting for an answer may have been done as well: then it is asked for anew.
    await lab.state(
        old,
        lambda state: (
            {view.id for view in state.holds} == {arcs["drive"].id, arcs["talk"].id} and len(state.queue) == 1
        ),
    )
    await until(lambda: [arc.state for arc in arcs.values()] == ["running", "running", "queued"])
    assert [arc._place for arc in arcs.values()] == places
    assert (arcs["drive"].grant == grant) is (arcs["drive"].id == ids[0])


async def test_what_comes_and_nobody_wants_or_does_not_come(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(handover, "CLAIM_TIMEOUT", 0.2)
    monkeypatch.setattr(handover, "EXPECT_TIMEOUT", 0.2)

    async def ghost() -> list[OpenRequest]:
        asked = {"id": "ghost", "arc": "talk", "needs": NEEDS["talk"], "priority": 0, "min_runtime": 600}
        return [msgspec.convert(asked, OpenRequest, strict=False)]

    lab.node("a", "robot/x", "radio/f:rate=5")
    old, new = await lab.client("old"), await lab.client("new")
    await lab.ready(old, "robot/x", "radio/f")
    arcs = await claimed(old, ["drive"])
    old.internals.pause()
    new.internals.expect([*old.internals.open_requests(), *(await ghost())])
    await old.internals.hand_over_all(me(new))
    # It was wanted by nobody: given back. What did not come is asked for.
    await lab.state(new, lambda state: not state.holds and not state.queue)
    asked = await new.request("talk", NEEDS["talk"], min_runtime=600)
    assert (asked.id, asked.state) == ("ghost", "running")
    assert arcs["drive"].state == "moved"
    with pytest.raises(ValueError, match="request ghost is already open here; no other client can hand it over"):
        new.internals.expect(new.internals.open_requests())
    with pytest.raises(RuntimeError, match="pause"):
        await new.internals.hand_over_all(me(old))


ENCODER = msgspec.json.Encoder(decimal_format="number")


@pytest.mark.slow
async def test_the_leader_dies_around_a_hand_over(tmp_path: Path) -> None:
    async with Lab(tmp_path, candidates=("a", "b", "c")) as lab:
        lab.node("rcs", "robot/x", "radio/f:rate=5", extra="candidate = false")
        lab.node("a")
        old, new = await lab.client("old"), await lab.client("new")
        await lab.ready(old, "robot/x", "radio/f")
        for host in ("b", "c"):
            lab.node(host)
        await lab.candidates(old, "b", "c")
        before = await claimed(old, list(NEEDS))

        place = before["later"]._place

        # Right after it: the next leader has it from the new client and the RCs.
        after = await settle_down(old, new, list(NEEDS))
        lab.signal("a", signal.SIGKILL)
        state = await lab.state(
            new, lambda state: state.host != "a" and len(state.holds) == 2 and len(state.queue) == 1
        )
        second, third = ("b", "c") if state.host == "b" else ("c", "b")  # on a busy machine either may be first
        stood = {name: ("test/new", after[name].grant) for name in ("drive", "talk")}
        assert holding(state) == stood
        assert [(view.client, view.place) for view in state.queue] == [("test/new", place)]
        grant = after["drive"].grant
        assert grant is not None
        assert await answer(new.command("robot/x", grant, ECHO)) == "done"

        # Right before it, and again in the middle: it ends at one of both.
        old.internals.resume()
        await lab.candidates(old, third)
        lab.signal(second, signal.SIGKILL)
        back = await settle_down(new, old, list(NEEDS))
        state = await lab.state(
            old, lambda state: state.host == third and len(state.holds) == 2 and len(state.queue) == 1
        )
        assert {client for client, _ in holding(state).values()} == {"test/old"}
        assert [(view.client, view.place) for view in state.queue] == [("test/old", place)]
        assert [arc._place for arc in back.values()] == [arc._place for arc in before.values()]


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0.003, *(pytest.param(delay, marks=pytest.mark.slow) for delay in (0.0, 0.001))])
async def test_the_leader_dies_in_a_hand_over(tmp_path: Path, delay: float) -> None:
    """Whenever that is: all is at one of both, once, and the other knows."""
    async with Lab(tmp_path, candidates=("a", "b")) as lab:
        lab.node("rcs", "robot/x", "radio/f:rate=5", extra="candidate = false")
        lab.node("a")
        old, new = await lab.client("old"), await lab.client("new")
        await lab.ready(old, "robot/x", "radio/f")
        lab.node("b")
        await lab.candidates(old, "b")
        before = await claimed(old, list(NEEDS))
        old.internals.pause()
        new.internals.expect(old.internals.open_requests())
        moving_ = asyncio.create_task(old.internals.hand_over_all(me(new)))
        await asyncio.sleep(delay)
        lab.signal("a", signal.SIGKILL)
        await moving_
        after = await claimed(new, list(NEEDS))
        assert [arc.id for arc in after.values()] == [arc.id for arc in before.values()]
        await asyncio.wait_for(new.granted(after["drive"]), HANG)
        await asyncio.wait_for(new.granted(after["talk"]), HANG)
        state = await lab.state(
            new, lambda state: state.host == "b" and len(state.holds) == 2 and len(state.queue) == 1
        )
        clients = [*(view.client for view in state.holds), *(view.client for view in state.queue)]
        assert clients == ["test/new"] * 3
        assert [view.place for view in state.queue] == [before["later"]._place]


async def test_the_old_process_dies_right_after_it(lab: Lab) -> None:
    lab.node("a", "robot/x", "radio/f:rate=5")
    old = await lab.begun("old")
    await claimed(old, list(NEEDS))
    grants = holding(await lab.state(old, lambda state: len(state.holds) == 2))
    heir = await asyncio.create_subprocess_exec(
        sys.executable,
        *("-m", "tests.live.heir", "new"),
        env=lab.env,
        stdin=asyncio.subprocess.PIPE,
        stdout=asyncio.subprocess.PIPE,
    )
    try:
        assert heir.stdin is not None
        assert heir.stdout is not None
        old.internals.pause()
        heir.stdin.write(ENCODER.encode(old.internals.open_requests()) + b"\n")
        assert await asyncio.wait_for(heir.stdout.readline(), HANG) == b"ready\n"
        await old.internals.hand_over_all(Sender("test", "new"))
        await old.internals.leave()
        line = await asyncio.wait_for(heir.stdout.readline(), HANG)
        told = msgspec.json.decode(line, type=dict[str, Grant])
        watcher = await lab.client("watcher")
        await lab.living(watcher, "client", lambda hosts: len(hosts) == 2)
        state = await lab.state(watcher, lambda state: len(state.holds) == 2)
        assert {client for client, _ in holding(state).values()} == {"test/new"}
        for name, (_, grant) in holding(state).items():
            assert grant > grants[name][1]
            assert grant == told[name]
        assert [view.arc for view in state.queue] == ["later"]
    finally:
        heir.kill()
        await heir.wait()

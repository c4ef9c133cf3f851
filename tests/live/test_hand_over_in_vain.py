"""Hand-overs that come to nothing: refused, of unknown outcome, to one who dies or does not want it."""

from __future__ import annotations

import asyncio
import re

import msgspec
import pytest

from tests.hang import HANG
from tests.live.bench import running, until
from tests.live.crew import Body
from tests.live.handing_over import NEEDS, claimed, me, patiently
from tests.live.lab import Lab
from zscout.behaviors.client import handover
from zscout.behaviors.client.arc import Held, holds
from zscout.behaviors.client.client import RequestRefused
from zscout.keyexpr import Sender
from zscout.messages import OpenRequest

pytestmark = pytest.mark.live


async def test_bodies_go_on_after_a_hand_over_that_was_refused(lab: Lab) -> None:
    lab.node("a", "robot/x")
    client, other = await lab.client("old"), await lab.client("rival")
    await lab.ready(client, "robot/x")
    body = Body(client, "drive", "robot/x")
    await body.entered()
    await body.beats_on(0)
    client.pause()
    with pytest.raises(RequestRefused, match="no/body is not on the mesh") as refused:
        await client.hand_over_all(Sender("no", "body"))
    assert refused.value.code == "unknown_client"
    client.resume()
    await body.beats_on(body.beats[-1])
    # What happens to a hold while the client is paused is told when it is not any more.
    client.pause()
    taker, _ = await running(other, "operator", "robot/x", priority=9)
    # It has been told so.
    await until(lambda: not client.open_requests() or client.open_requests()[0].grant is None)
    await asyncio.sleep(0.1)
    interrupted = not body.task.done() and body.task.cancelling()
    assert not interrupted
    assert client.open_requests()[0].grant is None
    client.resume()
    await asyncio.wait({body.task}, timeout=HANG)
    assert re.search(r"preempted by \S+@\S+ \(.+\), priority 9$", str(body.task.exception()))
    await other.end(taker)


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
    places, ids = (entered[0].arc.place, later.place), (entered[0].arc.id, later.id)
    old.pause()
    new.expect(old.open_requests())
    await old.hand_over_all(me(new))
    assert (entered[0].arc.state, later.state, len(entered)) == ("moved", "moved", 1)
    assert not entered[0].active
    await new.leave()
    old.take_back()
    await until(lambda: rival.state == "running" or len(entered) == 2)
    # Where the rival was quicker, the places decide once it ends.
    await other.end(rival)
    await until(lambda: len(entered) == 2 and entered[1].active and later.state == "queued")
    assert (entered[1].arc.place, later.place) == places
    assert not {entered[1].arc.id, later.id} & set(ids)
    done.set()
    await asyncio.wait_for(body, HANG)
    await until(lambda: later.state == "running")


@pytest.mark.parametrize("done", [False, True])
async def test_after_an_unknown_outcome_all_is_the_old_client_s_again(
    lab: Lab, monkeypatch: pytest.MonkeyPatch, done: bool
) -> None:
    monkeypatch.setattr(handover, "HAND_OVER", 0.0)
    lab.node("a", "robot/x", "radio/f:rate=5")
    old, new = await lab.client("old"), await lab.client("new")
    await lab.ready(old, "robot/x", "radio/f")
    arcs = await claimed(old, list(NEEDS))
    places, ids = [arc.place for arc in arcs.values()], [arc.id for arc in arcs.values()]
    grant = arcs["drive"].grant
    old.pause()
    new.expect(old.open_requests())
    if done:
        for arc in arcs.values():
            await old.hand_over(arc, me(new))
    with pytest.raises(RequestRefused) as refused:
        await old.hand_over_all(me(new))
    assert refused.value.code == "unknown"
    await new.leave()
    await lab.living(old, "client", lambda hosts: len(hosts) == 1)
    old.take_back()
    old.resume()
    await until(lambda: not done or not {arc.id for arc in arcs.values()} & set(ids))
    # What was asked without waiting for an answer may have been done as well: then it is asked for anew.
    await lab.state(
        old,
        lambda state: (
            {view.id for view in state.holds} == {arcs["drive"].id, arcs["talk"].id} and len(state.queue) == 1
        ),
    )
    await until(lambda: [arc.state for arc in arcs.values()] == ["running", "running", "queued"])
    assert [arc.place for arc in arcs.values()] == places
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
    old.pause()
    new.expect([*old.open_requests(), *(await ghost())])
    await old.hand_over_all(me(new))
    # It was wanted by nobody: given back. What did not come is asked for.
    await lab.state(new, lambda state: not state.holds and not state.queue)
    asked = await new.request("talk", NEEDS["talk"], min_runtime=600)
    assert (asked.id, asked.state) == ("ghost", "running")
    assert arcs["drive"].state == "moved"
    with pytest.raises(ValueError, match="is open here already"):
        new.expect(new.open_requests())
    with pytest.raises(RuntimeError, match="pause"):
        await new.hand_over_all(me(old))

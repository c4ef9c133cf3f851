"""Needs by pattern, live: any free RC that matches, told to client and RCs alike, over every change."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.hang import HANG
from tests.live.bench import Bench, Stand, comes_to, ended, granted, running
from tests.live.lab import TTL, Lab
from tests.live.stranger import Stranger, beside_a_node, command, good_ask
from tests.live.test_protocol import PlainProcess
from zscout.behaviors.client import blocking
from zscout.behaviors.client.arc import Held, hold
from zscout.behaviors.client.client import CommandRefused
from zscout.messages import RcmState

pytestmark = pytest.mark.live

ANY, MORE = "framegrabber/*", "framegrabber/*#2"
BOTH = ["framegrabber/f1", "framegrabber/f2"]
APART = "candidate = false"


async def echo(held: Held, need: str) -> object:
    return (await held.command(need, {"name": "echo", "value": need}, ttl=TTL)).result


def waits_for(state: RcmState) -> list[tuple[str, list[str]]]:
    return [(view.arc, sorted(view.needs)) for view in state.queue]


async def test_each_gets_a_free_one_and_who_waits_the_first_that_is_given_back(lab: Lab) -> None:
    lab.node("a", *BOTH, "robot/x")
    client, other, third = [await lab.client(name) for name in ("one", "two", "three")]
    await lab.ready(client, *BOTH, "robot/x")
    async with hold(client, "one", {ANY: {}, "robot/x": {}}, min_runtime=600) as one:
        (mine,) = set(BOTH) & set(one.rcs)
        assert (one.rc(ANY), one.rcs) == (mine, [mine, "robot/x"])
        assert [await echo(one, need) for need in (ANY, mine, "robot/x")] == [ANY, mine, "robot/x"]
        with pytest.raises(KeyError, match="is not a need of one; it requested framegrabber/"):
            await one.command(MORE, {"name": "echo", "value": 1})
        (told,) = (await lab.rc(client, mine)).holders
        assert (told.rcs, told.bound) == (one.rcs, {ANY: mine})

        second, grant = await running(other, "two", ANY)
        two = Held(other, second, grant)
        assert {one.rc(ANY), two.rc(ANY)} == set(BOTH)
        assert await echo(two, ANY) == ANY
        with pytest.raises(CommandRefused, match=mine):
            await two.command(mine, {"name": "echo", "value": 1})

        late = await third.request("three", {ANY: {}}, min_runtime=600)
        await comes_to(late, "queued", "waits for one of framegrabber/")
        state = await lab.state(client, lambda state: waits_for(state) == [("three", [ANY])])
        assert {view.arc: (sorted(view.needs), view.bound) for view in state.holds} == {
            "one": (one.rcs, {ANY: mine}),
            "two": (two.rcs, {ANY: two.rc(ANY)}),
        }
        await other.end(second)
        given = await granted(third, late)
        three = Held(third, late, given)
        assert three.rc(ANY) == two.rc(ANY)
        assert await echo(three, ANY) == ANY
        assert await echo(one, ANY) == ANY


@pytest.mark.slow
async def test_a_hold_keeps_its_rcs_over_a_change_of_rcm_and_gets_another_after_a_loss(tmp_path: Path) -> None:
    async with Lab(tmp_path, candidates=("a", "b")) as lab:
        lab.node("c", *BOTH, extra=APART)
        lab.node("a")
        client = await lab.begun("asker")
        lab.node("b")
        async with Stand(lab) as stand:
            rc = await stand.rc("framegrabber/f3", Bench())
            blockers = [(await running(client, f"block-{name[-1]}", name))[0] for name in BOTH]
            await lab.ready(client, "framegrabber/f3")
            arc, grant = await running(client, "any", ANY)
            assert arc.bound == {ANY: "framegrabber/f3"}
            waiting = await client.request("waits", {ANY: {}, MORE: {}}, min_runtime=600)
            # Both free ones match, but the hold keeps its own.
            await client.end(blockers[0])
            before = await lab.state(client, lambda state: bool(state.queue))
            await lab.candidates(client, "a", "b")

            lab.signal(before.host, signal.SIGKILL)
            after = await lab.state(client, lambda state: state.term > before.term and bool(state.queue))
            assert waits_for(after) == [("waits", [ANY, MORE])]
            (view,) = [view for view in after.holds if view.arc == "any"]
            assert (view.grant, view.bound, list(view.needs)) == (grant, arc.bound, ["framegrabber/f3"])
            held = Held(client, arc, grant)
            assert held.active
            assert await echo(held, ANY) == ANY

            # What it lost is made up for by another that matches: it ranks first.
            await rc.stop()
            stand.rcs.remove(rc)
            async with asyncio.timeout(HANG):
                while arc.grant in (None, grant):
                    await client.changed(arc)
            again = await granted(client, arc)
            found = Held(client, arc, again)
            assert (found.rc(ANY), held.rc(ANY)) == ("framegrabber/f1", "framegrabber/f3")
            assert await echo(found, ANY) == ANY
            assert ended(arc) == "lost"

            await client.end(blockers[1])
            await client.end(arc)
            await granted(client, waiting)
            assert sorted(waiting.bound) == [ANY, MORE]
            assert sorted(waiting.bound.values()) == waiting.rcs == BOTH


@pytest.mark.slow
async def test_the_one_that_was_given_is_asked_whether_it_knows(tmp_path: Path) -> None:
    # With so long a lease nobody takes the frozen node for gone while this lasts.
    async with Lab(tmp_path, lease=30, extra="[timing]\nhold_lease = 60\n") as lab:
        lab.node("a")
        lab.node("v", BOTH[0], extra=APART)
        client = await lab.begun()
        lab.signal("v", signal.SIGSTOP)
        arc = await client.request("any", {ANY: {}}, min_runtime=600)
        entered = asyncio.create_task(client.granted(arc, confirmed=True))
        why = f"{BOTH[0]} did not confirm"
        await lab.state(
            client, lambda state: not state.holds and [one.reason[: len(why)] for one in state.queue] == [why]
        )
        assert not entered.done()
        lab.signal("v", signal.SIGCONT)
        async with asyncio.timeout(HANG):
            assert await entered is not None
        assert arc.bound == {ANY: BOTH[0]}


async def test_a_plain_script_commands_by_need(lab: Lab) -> None:
    def script(lab: Lab) -> None:
        with (
            blocking.connect("plain", fleet=lab.fleet, host="test") as mesh,
            mesh.hold("stereo", {ANY: {}, MORE: {}}, min_runtime=600) as held,
        ):
            assert sorted([held.rc(ANY), held.rc(MORE)]) == held.rcs == BOTH
            for need in (ANY, MORE, *BOTH):
                assert held.command(need, {"name": "echo", "value": need}) == need

    lab.node("a", *BOTH)
    await lab.begun("eye")
    await asyncio.to_thread(script, lab)


async def test_a_client_written_from_the_document_asks_by_pattern(lab: Lab) -> None:
    async def live(lab: Lab, plain: PlainProcess) -> None:
        assert (await plain.told_of("ready"))["imported"] == []
        client = lab.clients[0]
        needs: dict[str, dict[str, int]] = {ANY: {}, "robot/r": {}}
        first, _ = await running(client, "first", BOTH[0], priority=1)
        await plain.order("ask", id="q1", arc="plain", needs=needs, priority=1, min_runtime=600)
        entered = await plain.told_of("entered", id="q1")
        assert (entered["rcs"], entered["bound"]) == ([BOTH[1], "robot/r"], {ANY: BOTH[1]})
        assert await plain.command("q1", ANY, {"name": "echo", "value": 42}) == {"result": 42}
        # An operator takes what it has: it waits for either, and gets the one that is given back.
        await running(client, "operator", BOTH[1], priority=10)
        queued = await plain.told_of("notice", id="q1", state="queued", ahead=0)
        assert (queued["rcs"], "bound" in queued) == (["robot/r"], False)
        assert queued["reason"].startswith(f"waits for one of {BOTH[0]} (held by ")
        await client.end(first)
        again = await plain.told_of("entered", id="q1")
        assert (again["rcs"], again["bound"]) == ([BOTH[0], "robot/r"], {ANY: BOTH[0]})
        assert await plain.command("q1", ANY, {"name": "echo", "value": 1}) == {"result": 1}
        assert await plain.end() == 0

    lab.node("a", *BOTH, "robot/r")
    await lab.begun("rival")
    plain = await PlainProcess.start(lab, "plain")
    try:
        await live(lab, plain)
    finally:
        plain.kill()


@pytest.fixture
def stranger(tmp_path: Path) -> Iterator[Stranger]:
    yield from beside_a_node(tmp_path)


def test_what_is_handed_over_keeps_what_meets_its_patterns(stranger: Stranger) -> None:
    token = stranger.token("t/client/next/1")
    asked = good_ask(id="moving", needs={"robot/*": {}, "radio/*": {"rate": 2}}, min_runtime=60)
    bound = {"robot/*": "robot/a", "radio/*": "radio/a"}
    before = stranger.ask("rcm/schedule/t/good", asked)
    moved = stranger.ask("rcm/schedule/t/good", {"op": "hand_over", "id": "moving", "to": "t/next"})
    assert (moved["client"], moved["rcs"], moved["bound"]) == ("t/next", ["radio/a", "robot/a"], bound)
    assert moved["grant"] > before["grant"]
    stranger.ask("rc/robot/a/command/t/next", {"grant": moved["grant"], "do": {"name": "confirm"}})
    for rc, params in (("robot/a", None), ("radio/a", {"rate": 2})):
        [holder] = stranger.ask(f"rc/{rc}/state", {})["holders"]
        assert (holder["client"], holder["bound"], holder.get("params")) == ("t/next", bound, params)
    [(kind, answer)] = stranger.get("rc/robot/a/command/t/good", command(grant=before["grant"]))
    assert (kind, answer["code"]) == ("err", "ended")
    stranger.ask("rcm/schedule/t/next", {"op": "release", "id": "moving"})
    token.undeclare()
    stranger.serves()

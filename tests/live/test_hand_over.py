"""All that a client has goes on in another one, in one step, and nobody gets in between."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.hang import HANG
from tests.live.bench import ECHO, Bench, SharedBench, Stand, answer, until
from tests.live.handing_over import NEEDS, claimed, me, patiently, settle_down
from tests.live.lab import Lab
from tests.live.stranger import Stranger, beside_a_node, good_ask
from tests.thorough import times
from zscout.behaviors.client.client import Client
from zscout.messages import Grants, RcState
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

    old.pause()
    told = old.open_requests()
    new.expect(told)
    # Who asks too early is given what is expected, as soon as it comes.
    early = asyncio.create_task(new.request("drive", NEEDS["drive"], min_runtime=1))
    await asyncio.sleep(0)
    assert not new.expected_came.is_set()
    await old.hand_over_all(me(new))
    await asyncio.wait_for(new.expected_came.wait(), HANG)
    drive = await early
    after = {"drive": drive} | await claimed(new, ["talk", "later"])

    assert [after[name].id for name in NEEDS] == [before[name].id for name in NEEDS]
    assert [after[name].place for name in NEEDS] == [before[name].place for name in NEEDS]
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
    await old.leave()
    await lab.living(new, "client", lambda hosts: len(hosts) == 2)
    await new.end(drive)
    await until(lambda: after["later"].state == "running")
    assert rival.state == "queued"
    assert new.open_requests()[0].arc == "talk"


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
        here.resume()
        here, there = there, here
    assert None not in seen
    assert seen == sorted(set(seen), key=seen.index)
    assert len(set(seen)) == ROUNDS + 1
    await until(lambda: len(record.said) >= ROUNDS)
    assert len(record.said) == ROUNDS
    assert {tuple(one.arc for one in said.rcs["robot/x"]) for said in record.said} == {("drive",)}
    assert "safe" not in robot.calls
    grant = await here.granted(arcs["drive"])
    assert grant is not None
    assert await answer(here.command("robot/x", grant, ECHO)) == "done"
    assert rival.state == arcs["later"].state == "queued"

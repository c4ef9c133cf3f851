"""What strangers may publish or pretend: nobody falls for it; what might be so costs an election."""

from __future__ import annotations

import asyncio
import json
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from tests.live.lab import TTL, Lab
from tests.live.stranger import HIGH, Stranger, beside_a_node, grants, held, rc_state
from zscout.behaviors.client.arc import hold

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def stranger(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stranger]:
    yield from beside_a_node(tmp_path_factory.mktemp("fleet"))


endless = grants(term=[1, "~"], rcs={"robot/a": [held(remaining=1e300)]})
PUBLICATIONS: list[tuple[str, str, bytes]] = [
    ("grants: empty", "rcm/grants", b""),
    ("grants: not JSON", "rcm/grants", b"{{{{"),
    ("grants: 1 MB", "rcm/grants", b"[" * 1_000_000),
    ("grants: wrong types", "rcm/grants", json.dumps(grants(rcs=[])).encode()),
    ("grants: an absurd term", "rcm/grants", json.dumps(grants()).encode()),
    ("grants: an absurd heartbeat", "rcm/grants", json.dumps(grants(rcs={})).encode()),
    ("grants: a negative term", "rcm/grants", json.dumps(grants(term=[-1, ""])).encode()),
    ("grants: time without end", "rcm/grants", json.dumps(endless).encode()),
    ("RC state: not JSON", "rc/robot/a/state", b"no"),
    ("RC state: an absurd term", "rc/robot/a/state", json.dumps(rc_state()).encode()),
    ("RC state: no name", "rc/robot/a b/state", json.dumps(rc_state(term=[1, ""])).encode()),
    ("RC state: of no RC", "rc/robot/zzz/state", json.dumps(rc_state(term=[1, ""])).encode()),
    ("load: not JSON", "host/n/load", b"9"),
    ("load: 1 MB", "host/n/load", b"9" * 1_000_000),
    ("notice: not JSON", "client/t/good/notice", b"\xff"),
]  # fmt: skip


@pytest.mark.parametrize(
    ("key", "payload"), [said[1:] for said in PUBLICATIONS], ids=[said[0] for said in PUBLICATIONS]
)
def test_nobody_falls_for_a_bad_publication(stranger: Stranger, key: str, payload: bytes) -> None:
    before = stranger.state()["term"]
    stranger.put(key, payload)
    rc = stranger.ask("rc/robot/a/state", {})
    assert rc["term"] == before
    assert "holders" not in rc
    stranger.serves()
    assert stranger.state()["term"] == before


@pytest.mark.parametrize(
    "tail", ["t", "t/rc/robot/1", "t/client/a b/1", "t/rc/robot/a/b/c", "t/client/x/1/2", "t/rcm/" + "x" * 300 + "/1"]
)
def test_a_malformed_token_is_nobody(stranger: Stranger, tail: str) -> None:
    token = stranger.token(tail)
    stranger.serves()
    assert {rc["rc"] for rc in stranger.state()["rcs"] if rc["present"]} == {"robot/a", "radio/a"}
    token.undeclare()


def test_an_exclusive_rc_obeys_one_of_two_forged_holders(stranger: Stranger) -> None:
    now = stranger.state()
    forged = [held(grant=[now["term"], seq], place=[now["term"], seq]) for seq in (901, 902)]
    stranger.put("rcm/grants", json.dumps(grants(term=now["term"], seq=now["seq"], rcs={"robot/a": forged})).encode())
    assert len(stranger.ask("rc/robot/a/state", {}).get("holders", [])) <= 1
    stranger.await_("the RCM has set it right", lambda: "holders" not in stranger.ask("rc/robot/a/state", {}))
    stranger.serves()


@pytest.mark.slow
def test_a_forged_term_that_can_be_believed_costs_one_election(stranger: Stranger) -> None:
    counter = stranger.state()["term"][0] + 7
    stranger.put("rcm/grants", json.dumps(grants(term=[counter, "~"], seq=3, rcs={})).encode())
    stranger.await_("a higher term leads", lambda: stranger.state()["term"][0] > counter)
    stranger.ready()
    stranger.serves()


@pytest.mark.slow
def test_a_token_of_an_rc_that_never_answers_is_asked_now_and_then(stranger: Stranger) -> None:
    asked: list[float] = []

    def on_query(query: zenoh.Query) -> None:
        with query:
            asked.append(time.monotonic())
            query.reply_err(b'{"code":"no","message":"no"}')

    queryable = stranger.session.declare_queryable(f"{stranger.base}/rc/robot/mute/state", on_query)
    token = stranger.token("t/rc/robot/mute/1")
    stranger.await_("it is asked five times", lambda: len(asked) >= 5)
    assert asked[4] - asked[0] > 0.5
    token.undeclare()
    queryable.undeclare()  # type: ignore[no-untyped-call]
    stranger.serves()


@pytest.mark.slow
async def test_a_client_does_not_fall_for_forged_notices(lab: Lab) -> None:
    lab.node("n", "robot/a", "radio/a:rate=10")
    client = await lab.begun("victim")
    stranger = await asyncio.to_thread(Stranger, lab)
    try:
        async with hold(client, "victim", {"robot/a": {}}, min_runtime=60) as held:
            notice = {
                "id": held.arc.id, "arc": "victim", "client": "test/victim", "state": "ended",
                "term": [HIGH, "f"], "step": 1, "outcome": "preempted",
            }  # fmt: skip
            said = [b"", b"\xff", b"[]", json.dumps(notice).encode(), b"{" * 1_000_000]
            said.append(json.dumps(notice | {"term": [0, ""]}).encode())
            said.append(json.dumps(notice | {"remaining": 1e300, "term": [2, ""]}).encode())
            said.append(json.dumps(notice | {"state": "stolen", "term": [2, ""]}).encode())
            for payload in said:
                await asyncio.to_thread(stranger.put, "client/test/victim/notice", payload)
            requests = "client/test/victim/requests"
            for promise in (b'{"promise":[%d,"f"]}' % HIGH, b'{"promise":[0,"f"]}'):
                [(kind, answer)] = await asyncio.to_thread(stranger.get, requests, promise)
                assert (kind, answer["code"]) == ("err", "old_term")
            [(kind, answer)] = await asyncio.to_thread(stranger.get, requests, b"?")
            assert (kind, answer["code"]) == ("err", "malformed")
            answer = await asyncio.to_thread(stranger.ask, requests, {})
            assert [told["id"] for told in answer["requests"]] == [held.arc.id]
            assert client.internals.term.counter < 100
            assert held.active
            assert (await held.command("robot/a", {"name": "echo", "value": 1}, ttl=TTL)).result == 1
    finally:
        await asyncio.to_thread(stranger.close)


@pytest.mark.slow
async def test_a_token_that_only_claims_to_lead_stops_no_takeover(tmp_path: Path) -> None:
    async with Lab(tmp_path, lease=1.0, candidates=("a", "b")) as lab:
        lab.node("c", "robot/a", "radio/a:rate=10", extra="candidate = false")
        lab.node("a")
        lab.node("b")
        client = await lab.client()
        before = await lab.ready(client, "robot/a", "radio/a")
        stranger = await asyncio.to_thread(Stranger, lab)
        token = await asyncio.to_thread(stranger.token, "t/rcm/node/forged")
        try:
            lab.nodes[before.host].send_signal(signal.SIGKILL)
            after = await lab.state(client, lambda state: state.term > before.term)
            assert after.host != before.host
        finally:
            token.undeclare()
            await asyncio.to_thread(stranger.close)

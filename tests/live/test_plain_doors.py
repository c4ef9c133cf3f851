"""What a stranger on a mesh without certificates can not do any more: real nodes, and raw sessions beside them."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import NoReturn

import psutil
import pytest
import zenoh

from tests.live.lab import Lab
from tests.live.stranger import Stranger, beside_a_node, good_ask
from zscout.mesh.zenoh_mesh import zenoh_config
from zscout.messages import Grants, RcmState, encode
from zscout.types import Term

pytestmark = pytest.mark.live

HUGE = 400_000_000
MIB = 1 << 20
FAR = Term(10**12, "mad")


@pytest.fixture(scope="module")
def stranger(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Stranger]:
    yield from beside_a_node(tmp_path_factory.mktemp("node"))


def peak(pid: int) -> int:
    """Bytes of memory that a process has had at most."""
    [line] = [one for one in Path(f"/proc/{pid}/status").read_text().splitlines() if one.startswith("VmHWM")]
    return int(line.split()[1]) * 1024


def test_a_huge_message_is_not_read_to_its_end(stranger: Stranger) -> None:
    node = psutil.Process(stranger.lab.nodes["n"].pid)
    before = peak(node.pid)
    with zenoh.open(zenoh_config(stranger.lab.fleet.mesh)) as other:
        base = f"zscout/{stranger.lab.fleet.name}"
        stranger.await_("it is linked", lambda: any(other.get(f"{base}/rcm/state", payload=b"{}", timeout=1.0)))
        other.put(f"{base}/rcm/grants", bytes(HUGE), congestion_control=zenoh.CongestionControl.BLOCK)
        # It has been read, or given up: what is put later on the same link, or a new one, is answered.
        stranger.await_("it is linked", lambda: any(other.get(f"{base}/rcm/state", payload=b"{}", timeout=1.0)))
    stranger.serves()
    assert peak(node.pid) - before < 20 * MIB


def test_anothers_place_is_not_had_under_another_name(stranger: Stranger) -> None:
    tokens = [stranger.token(f"t/client/{name}/1") for name in ("holder", "victim", "other", "thief")]
    for name in ("holder", "victim", "other"):
        notice = stranger.ask(f"rcm/schedule/t/{name}", good_ask(id=name, min_runtime=60))
    [seen] = [one for one in stranger.state()["queue"] if one["id"] == "victim"]
    stolen = stranger.ask("rcm/schedule/t/thief", good_ask(id="thief", min_runtime=60, place=seen["place"]))
    assert (stolen["state"], stolen["ahead"]) == ("queued", 2)
    assert stolen["place"] > notice["place"]
    for name, token in zip(("thief", "other", "victim", "holder"), reversed(tokens), strict=True):
        stranger.ask(f"rcm/schedule/t/{name}", {"op": "cancel", "id": name})
        token.undeclare()
    stranger.serves()


def test_what_is_commanded_twice_is_done_once(stranger: Stranger) -> None:
    notice = stranger.ask("rcm/schedule/t/good", good_ask(id="twice", min_runtime=60))
    told = [
        stranger.ask(
            "rc/robot/a/command/t/good", {"grant": notice["grant"], "do": {"name": "echo", "value": number}, "id": id_}
        )
        for number, id_ in enumerate(("a", "a", "b"))
    ]
    assert told == [{"result": 0}, {"result": 0}, {"result": 2}]
    stranger.ask("rcm/schedule/t/good", {"op": "release", "id": "twice"})


@asynccontextmanager
async def mad_leader(lab: Lab) -> AsyncIterator[None]:
    """Somebody who leads in a term that no election leads to: shows itself, publishes and answers."""
    base = f"zscout/{lab.fleet.name}"
    state, heartbeat = encode(RcmState(FAR, 1, "mad")), encode(Grants(FAR, 1, 1, 0.5))

    async def beat() -> NoReturn:
        while True:
            session.put(f"{base}/rcm/grants", heartbeat, congestion_control=zenoh.CongestionControl.BLOCK)
            await asyncio.sleep(0.1)

    with zenoh.open(zenoh_config(lab.fleet.mesh)) as session:
        _token = session.liveliness().declare_token(f"{base}/alive/mad/rcm/node/{FAR.rcm}")
        _asked = session.declare_queryable(f"{base}/rcm/state", lambda query: query.reply(f"{base}/rcm/state", state))
        beating = asyncio.create_task(beat())
        yield
        beating.cancel()


@pytest.mark.slow
async def test_a_fleet_that_began_beside_a_mad_leader_goes_on_once_that_has_left(tmp_path: Path) -> None:
    """RCs and RCMs that start then know no better than to believe it."""
    async with Lab(tmp_path, lease=1.0) as lab:
        async with mad_leader(lab):
            lab.node("a", "robot/a")
            lab.node("b", "robot/b")
            client = await lab.client()
            await lab.candidates(client, "a", "b")
            await lab.living(client, "rc", lambda found: {"a", "b"} <= set(found))
            lab.nodes["a"].kill()
            lab.node("a", "robot/a")
            await lab.candidates(client, "a", "b")
        arc = await client.request("survey", {"robot/a": {}, "robot/b": {}}, wait_for_device=True)
        assert await client.granted(arc)

"""Processes of one host find each other by loopback, without a network and without multicast."""

from __future__ import annotations

import asyncio
import json
import re
import socket
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import partial
from types import SimpleNamespace

import pytest
from msgspec.structs import replace

from tests.hang import HANG
from tests.mesh.kit import until
from zscout.config.fleet import Fleet, MeshConfig, beside, default_fleet
from zscout.keyexpr import Sender, new_instance
from zscout.mesh import ZenohMesh, neighbours
from zscout.mesh.links import Socket, ends
from zscout.mesh.neighbours import MAX_NEIGHBOURS, Meeting
from zscout.mesh.zenoh_mesh import increasing_id, zenoh_config
from zscout.types import SECOND

pytestmark = [pytest.mark.real_time, pytest.mark.skipif(sys.platform != "linux", reason="abstract sockets are Linux's")]


@pytest.fixture
def fleet() -> Iterator[Fleet]:
    """One whose only other host is nowhere."""
    with socket.socket() as nowhere:
        nowhere.bind(("127.0.0.1", 0))  # held, and not listened on
        port = nowhere.getsockname()[1]
        mesh = MeshConfig(multicast=False, connect=(f"tcp/127.0.0.1:{port}",))
        yield replace(default_fleet(), name=f"test-{new_instance()}", mesh=mesh)


async def test_they_meet_by_loopback_and_again_when_a_session_is_renewed(fleet: Fleet) -> None:
    async with (
        await ZenohMesh.open(fleet, Sender("a", "node")) as node,
        await ZenohMesh.open(replace(fleet, mesh=beside(fleet.mesh)), Sender("a", "program")) as program,
    ):
        await until(lambda: node.links() == program.links() == 1)
        (link,) = program._transport.current._session.info.links()  # type: ignore[attr-defined]
        assert "127.0.0.1" in link.dst
        before = node._transport.id()
        node._transport.renew()
        await until(lambda: node._transport._renewing is None)
        assert node._transport.id() != before
        await until(lambda: program._transport.peers() == [node._transport.id()])


async def test_two_that_begin_at_one_time_meet(fleet: Fleet) -> None:
    both = await asyncio.gather(*(ZenohMesh.open(fleet, Sender("a", name)) for name in ("x", "y")))
    await until(lambda: all(mesh.links() == 1 for mesh in both))
    for mesh in both:
        await mesh.close()


@pytest.mark.slow
async def test_sessions_of_one_moment_are_linked_by_loopback(fleet: Fleet) -> None:
    """As those of a node and its programs, which all reopen theirs when their host has a new address."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as port:
        port.bind(("127.0.0.1", 0))  # held, so that no other test on this machine is given its number
        wide = replace(fleet, mesh=MeshConfig(multicast_address=f"224.0.0.224:{port.getsockname()[1]}"))
        for _ in range(4):
            opened = await asyncio.gather(*(ZenohMesh.open(wide, Sender("a", name)) for name in "wxyz"))
            await until(partial(_all_linked_by_loopback, opened))
            for mesh in opened:
                await mesh.close()


def _all_linked_by_loopback(opened: Sequence[ZenohMesh]) -> bool:
    links = [link for mesh in opened for link in mesh._transport.current._session.info.links()]  # type: ignore[attr-defined]
    ends = [re.fullmatch(r"tcp/(?:127\.0\.0\.1|\[::1\]|\[::ffff:127\.0\.0\.1\]):\d+", link.dst) for link in links]
    return all(ends) and len(ends) == len(opened) * (len(opened) - 1)


def test_the_session_that_makes_the_links_has_the_greater_id(fleet: Fleet) -> None:
    older, newer = (Meeting(fleet.name, fleet.mesh, "tcp") for _ in range(2))
    ids = [json.loads(zenoh_config(fleet.mesh, None, met).get_json("id")) for met in (newer, older)]
    older.close()
    newer.close()
    # Zenoh compares from the last byte on.
    assert bytes.fromhex(ids[0])[::-1] > bytes.fromhex(ids[1])[::-1]


def test_a_new_session_waits_until_a_neighbour_of_the_same_moment_listens(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(neighbours, "LISTEN_TIMEOUT_S", HANG)
    older = Meeting(fleet.name, fleet.mesh, "tcp")
    newer = Meeting(fleet.name, fleet.mesh, "tcp")
    with socket.socket() as zenohs, ThreadPoolExecutor(1) as pool:
        zenohs.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        zenohs.bind(("127.0.0.1", int(older.endpoint.rpartition(":")[2])))
        waiting = pool.submit(newer.wait_for_others)
        assert not wait([waiting], timeout=3 * neighbours.POLL_S).done
        zenohs.listen()
        waiting.result()
        assert older.endpoint in newer.others[0]
    older.close()
    newer.close()


def link(here: str, there: str, peer: str) -> SimpleNamespace:
    return SimpleNamespace(src=f"tcp/{here}:1", dst=f"tcp/{there}:2", zid=peer)


def test_a_new_session_ends_its_links_to_neighbours_by_a_network_until_they_have_one_by_loopback(
    fleet: Fleet, monkeypatch: pytest.MonkeyPatch
) -> None:
    older, newer = (Meeting(fleet.name, fleet.mesh, "tcp") for _ in range(2))
    peer = increasing_id(older.at)
    temporary = link("192.0.2.2", "192.0.2.2", increasing_id(newer.at + SECOND))
    other_host = link("192.0.2.2", "192.0.2.3", increasing_id())
    wrong, right = link("192.0.2.2", "192.0.2.2", peer), link("::1", "::1", peer)
    looks = iter([[temporary], [temporary, other_host, wrong], [temporary, other_host], [temporary, other_host, right]])
    chosen: list[list[bool]] = []
    monkeypatch.setattr(neighbours, "RELINK_TIMEOUT_S", HANG)
    sockets = [Socket(number, number, ends(known)) for number, known in enumerate((right, other_host, wrong))]
    monkeypatch.setattr(neighbours, "shut", lambda goes: chosen.append([goes(known) for known in sockets]))
    newer.relink(lambda: next(looks))
    assert chosen == [[False, False, True]]
    assert not list(looks)
    older.close()
    newer.close()


def test_a_neighbour_that_ended_is_not_waited_for(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(neighbours, "RELINK_TIMEOUT_S", HANG)
    older, newer = (Meeting(fleet.name, fleet.mesh, "tcp") for _ in range(2))
    older.close()
    newer.relink(list)
    newer.close()


def test_a_neighbour_is_known_by_its_id_while_it_lives(fleet: Fleet) -> None:
    older, newer = (Meeting(fleet.name, fleet.mesh, "tcp") for _ in range(2))
    both = increasing_id(older.at), increasing_id(newer.at)
    assert newer.is_neighbour(both[0])
    assert older.is_neighbour(both[1])
    assert not newer.is_neighbour(increasing_id(newer.at + SECOND))
    older.close()
    assert not newer.is_neighbour(both[0])
    newer.close()


async def test_other_meshes_are_no_neighbours(fleet: Fleet) -> None:
    others = replace(fleet, name=f"{fleet.name}-b"), replace(fleet, mesh=replace(fleet.mesh, connect=("tcp/anvil:1",)))
    met = [Meeting(one.name, one.mesh, "tcp") for one in (fleet, *others)]
    tls, own = Meeting(fleet.name, fleet.mesh, "tls"), Meeting(fleet.name, fleet.mesh, "tcp")
    assert not tls.others
    assert [at.partition("#")[0] for at in own.others] == [met[0].endpoint]
    for one in (*met, tls, own):
        one.close()
    gone = Meeting(fleet.name, fleet.mesh, "tcp")
    gone.close()
    assert not gone.others


def test_nobody_else_is_given_the_port_until_zenoh_has_it(fleet: Fleet) -> None:
    met = Meeting(fleet.name, fleet.mesh, "tcp")
    port = int(met.endpoint.rpartition(":")[2])
    with socket.socket() as other, pytest.raises(OSError, match="in use"):
        other.bind(("127.0.0.1", port))
    with socket.socket() as zenohs:
        zenohs.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        zenohs.bind(("127.0.0.1", port))
        zenohs.listen()
        met.close()


def test_names_that_are_none_and_too_many_are_left_out(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    met = Meeting(fleet.name, fleet.mesh, "tcp")
    names = neighbours._NAMES.read_text()
    own = next(line for line in names.splitlines() if met.endpoint.rpartition(":")[2] in line.rpartition("@")[2])
    head = own.rpartition("-tcp-")[0]
    met.close()
    lines = [f"{head}-tcp-{1_000 + number}-{number}" for number in range(1, 100)]
    bad = [f"{head}-tcp-99999-1", f"{head}-tcp-0-1", f"{head}-tcp-1-x", f"{head}-tcp-1-{10**19}", f"{head}-udp-1-1"]
    monkeypatch.setattr(neighbours, "_NAMES", SimpleNamespace(read_text=lambda **_: "\n".join(bad + lines)))
    met = Meeting(fleet.name, fleet.mesh, "tcp")
    met.close()
    assert len(met.others) == MAX_NEIGHBOURS
    assert met.others[0].startswith("tcp/127.0.0.1:1001#")


def test_where_names_can_t_be_read_nobody_is_found(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(**_: object) -> str:
        raise PermissionError

    monkeypatch.setattr(neighbours, "_NAMES", SimpleNamespace(read_text=fails))
    met = Meeting(fleet.name, fleet.mesh, "tcp")
    met.close()
    assert met.others == []

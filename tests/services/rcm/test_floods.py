"""Floods that roles allow: an honest client waits for a share of each host's questions, not for all of them."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable
from decimal import Decimal
from typing import Any

import pytest

from tests.mesh.kit import until
from tests.services.rcm.kit import FakeFleet, there
from zscout.mesh import IncomingQuery, Mesh
from zscout.mesh.session import SHARE
from zscout.messages import (
    Ask,
    BookingsAsk,
    BookingsTold,
    Foresee,
    Foresight,
    HostRanking,
    Notice,
    RankAsk,
    RcmState,
    StateAsk,
)

OUTSTANDING = 40


async def test_before_an_honest_client_at_most_a_share_of_each_host_is_served(monkeypatch: pytest.MonkeyPatch) -> None:
    handled: list[str] = []
    """The host of each."""
    serve = Mesh.serve

    def noting(mesh: Mesh, key: str, kind: Any, handler: Callable[[IncomingQuery[Any]], None], **how: Any) -> object:
        def handle(query: IncomingQuery[Any]) -> None:
            handled.append(query.key.rsplit("/", 2)[-2])
            handler(query)

        return serve(mesh, key, kind, handle, **how)

    monkeypatch.setattr(Mesh, "serve", noting)
    fleet = FakeFleet("h1", closed=True)
    for name in ("robot/a", "robot/b"):
        fleet.rc(name)
    candidate = fleet.candidate("h1")
    await until(lambda: there(candidate) >= {"robot/a", "robot/b"})
    wall, bob, eve, ada = [fleet.client("one", host) for host in ("wall", "bob", "eve", "ada")]
    for number in range(OUTSTANDING):
        await eve.ask(f"q{number}", "robot/a")
    keys, needs = fleet.watcher.keys, {"robot/a": dict[str, Decimal]()}
    floods: list[tuple[Any, str, Any, Any]] = [
        (wall.mesh, keys.ask_state(wall.mesh.me), StateAsk(arc="q1", forecast=True), RcmState),
        (wall.mesh, keys.ask_bookings(wall.mesh.me), BookingsAsk(), BookingsTold),
        (wall.mesh, keys.ask_rank(wall.mesh.me), RankAsk(reports=True), HostRanking),
        (bob.mesh, keys.schedule(bob.mesh.me), Foresee("dry", "dry", needs, 0, Decimal(60)), Foresight),
        (eve.mesh, keys.schedule(eve.mesh.me), Ask("q1", "q1", needs, 0, Decimal(60)), Notice),
    ]
    replies: list[Any] = []
    handled.clear()
    fleet.network.freeze(candidate.mesh)
    for _ in range(OUTSTANDING):
        for mesh, key, message, kind in floods:
            mesh.ask_then(key, message, kind, replies.append, timeout=5)
    asking = asyncio.create_task(ada.ask("honest", "robot/b"))
    await asyncio.sleep(0.01)
    # All have come, and ada's is the last.
    fleet.network.thaw(candidate.mesh)
    assert (await asking).state == "running"
    await until(lambda: len(replies) == OUTSTANDING * len(floods))
    assert all(reply is not None and reply.message is not None for reply in replies)
    before = Counter(handled[: handled.index("ada")])
    assert before.keys() <= {"wall", "bob", "eve"}
    assert max(before.values()) <= SHARE < OUTSTANDING

"""An RC that has missed a publication finds its hold all the same, however the answers come.

The RCM here is the test itself, so that it can speak out of order: RC and mesh are real.
"""

from __future__ import annotations

import asyncio
from decimal import Decimal

import pytest

from tests.hang import HANG
from tests.live.bench import ECHO, Bench, Stand, answer, until
from tests.live.lab import Lab
from zscout.drivers import resource_controller
from zscout.keyexpr import Role, Token
from zscout.mesh import IncomingQuery
from zscout.messages import Grants, HoldView, RcmState, StateAsk
from zscout.types import Grant, Place, Term

pytestmark = pytest.mark.live

TERM = Term(1, "test")


def view(client: str, seq: int) -> HoldView:
    return HoldView(
        id="one",
        arc="one",
        client=client,
        priority=0,
        grant=Grant(TERM, seq),
        place=Place(TERM, 1),
        needs={"robot/x": {}},
        min_runtime=Decimal(60),
        held=0,
        remaining=60,
    )


def said(seq: int, prev: int) -> Grants:
    return Grants(term=TERM, seq=seq, prev=prev, every=0.5, rcs={"robot/other": []})


async def test_a_snapshot_that_was_overtaken_is_read_again(
    lab: Lab, stand: Stand, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resource_controller, "REREAD_TIMEOUT", HANG)
    client = await lab.client()
    mesh, keys = client.mesh, client.mesh.keys
    waiting: list[IncomingQuery[StateAsk]] = []
    seq = 3

    def on_asked(request: IncomingQuery[StateAsk]) -> None:
        if not waiting:
            # The first answer is held back until more has been published.
            waiting.append(request)
        else:
            request.answer(RcmState(TERM, seq, "test", [view(str(mesh.me), 5)]))

    rc = await stand.rc("robot/x", Bench())
    mesh.serve(keys.rcm_state, StateAsk, on_asked)
    publisher = mesh.publisher(keys.grants, Grants)
    mesh.alive(Token(mesh.me.host, Role.RCM, mesh.me.client, TERM.rcm))
    while rc.holds.seq != 3:
        publisher.put(said(3, 0))
        await asyncio.sleep(0.02)
    await until(lambda: bool(waiting))
    # Its new term made it read; the grant with number 5 is published and gets lost, 7 arrives.
    seq = 7
    publisher.put(said(7, 6))
    await until(lambda: rc.holds.seq == 7)
    waiting[0].answer(RcmState(TERM, 3, "test"))
    await until(lambda: set(rc.holds.held) == {Grant(TERM, 5)})
    assert await answer(client.command("robot/x", Grant(TERM, 5), ECHO)) == "done"

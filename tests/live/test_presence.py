"""Who counts as there for a new RCM: what answered it must also be seen alive."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.live.bench import ECHO, Bench, Stand, answer, running, until
from tests.live.lab import Lab
from zscout.keyexpr import Sender
from zscout.mesh import ZenohMesh
from zscout.messages import RcState
from zscout.services.rcm.rcm import Rcm
from zscout.services.rcm.recovery import RecoveredState
from zscout.types import Term

pytestmark = [pytest.mark.live, pytest.mark.slow]


async def test_an_rc_that_died_while_the_lead_was_taken_is_lost_within_a_lease(tmp_path: Path) -> None:
    async with Lab(tmp_path, lease=4) as lab, Stand(lab) as stand:
        rc = await stand.rc("robot/real", Bench())
        client = await lab.client()
        leader = await ZenohMesh.open(lab.fleet, Sender("leader", "node"))
        rcm = Rcm(leader, lab.fleet, Term(1, "test"), lambda _term, _rc: None, lambda _: None)
        try:
            # Both answered when they were asked; then one of them died, and nobody saw its token go.
            ghost = RcState(rc="robot/ghost", host="h", instance="gone", sharable=False)
            real = await lab.rc(client, "robot/real")
            rcm.start(RecoveredState(rcs={"robot/real": real, "robot/ghost": ghost}))
            _, grant = await running(client, "real", "robot/real")
            lost = await client.request("ghost", {"robot/ghost": {}}, min_runtime=600, wait_for_device=True)
            await until(lambda: lost.reason == "robot/ghost is lost: h is gone")
            assert lost.state == "queued"
            assert await answer(client.command("robot/real", grant, ECHO)) == "done"
            assert set(rc.holds.held) == {grant}
        finally:
            rcm.stop()
            await leader.close()

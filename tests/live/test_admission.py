"""Forged lists of a client, states of an RC and records of a keeper, on a secured fleet of real nodes whose leader is
killed."""

from __future__ import annotations

import signal
import time
from decimal import Decimal
from pathlib import Path
from typing import Any

import pytest

from tests.hang import HANG
from tests.live.closed import ROLES, ClosedLab
from tests.live.lab import answered, awaited
from tests.services.rcm.kit import FakeClient, FakeRc
from zscout.behaviors.client.arc import hold
from zscout.keyexpr import Role, Sender, Token
from zscout.mesh import Supervisor, ZenohMesh
from zscout.messages import (
    Book,
    BookingRecord,
    BookingsAsk,
    BookingsTold,
    BookingView,
    Grants,
    Holder,
    OpenRequest,
    Who,
)
from zscout.services.bookings.keeper import BookingKeeper
from zscout.types import Grant, Place, Term

pytestmark = pytest.mark.live

OLD = Term(1, "0")
ACCESS = '[access]\n"robot/arm" = ["ada"]\n'


def listed(name: str, *needs: str, priority: int = 0, booking: str = "", who: Who | None = None) -> OpenRequest:
    wanted: dict[str, dict[str, Decimal]] = {need: {} for need in needs}
    return OpenRequest(name, name, wanted, priority, Decimal(60), place=Place(OLD, 1), booking=booking, who=who)


def forged(seq: int, client: str) -> Holder:
    told: dict[str, Any] = {
        "place": Place(OLD, 1),
        "priority": 1_000_000,
        "keep": True,
        "bound": {"radio/*": "radio/a"},
    }
    return Holder("q", "q", client, Grant(OLD, seq), rcs=["radio/a"], min_runtime=Decimal(600), remaining=600.0, **told)


@pytest.mark.slow
async def test_nobody_is_believed_more_than_its_role_allows(tmp_path: Path) -> None:
    async with ClosedLab(tmp_path, roles=ROLES + ACCESS) as lab:
        lab.node("bench")
        ada, bob = await lab.person("ada"), await lab.person("bob")
        await lab.ready(bob)
        lab.node("anvil", "robot/a", "robot/b", "robot/arm")
        before = await lab.ready(bob, "robot/a", "robot/b", "robot/arm")
        assert before.host == "bench"
        start = round(time.time()) + 5_000
        mine = Book("hers", "hers", {"robot/b": {}}, 0, start, Decimal(60), Decimal(60))
        await answered(lambda: ada.mesh.ask_one(ada.mesh.keys.schedule(ada.mesh.me), mine, BookingView, timeout=HANG))
        eves, carts = [
            await ZenohMesh.open(lab.fleet_of(name), Sender(name, "forger")) for name in ("eve", "cart")
        ]  # fmt: skip
        eve, robot, revoked = FakeClient(eves, []), FakeRc(carts, "radio/a"), list[tuple[Term, str, Grant]]()
        eve.open = [
            listed("high", "robot/a", priority=1_000_000),
            listed("barred", "robot/arm"),
            listed("theirs", "robot/b", booking=f"hers@{start}"),
            listed("posing", "robot/arm", "robot/a", who=Who("ada")),
            *(listed(f"flood{number}", "robot/a") for number in range(1_000)),
            listed("last", "robot/a"),
        ]
        robot.holders = [forged(7, "bob/gone"), forged(8, "wall/c1")]
        robot.sharable = True
        keeper = BookingKeeper(carts, candidate=True, wall=lambda: time.time() + 86_400)
        record = {name: getattr(mine, name) for name in Book.__struct_fields__ if name not in ("id", "name")}
        keeper.records.take([BookingRecord("forged", "forged", owner="ada", **record)])
        keeper.start(Supervisor("cart", lambda error: pytest.fail(str(error))))

        def hear(_: str, grants: Grants) -> None:
            revoked.extend((grants.term, item.client, item.grant) for item in grants.revoked)

        ada.mesh.subscribe(ada.mesh.keys.grants, Grants, hear)
        token = carts.alive(Token("cart", Role.NODE, "node", "1"))
        eve.start()
        robot.start()
        await lab.ready(bob, "radio/a")
        robot.holders = [forged(7, "bob/gone"), forged(8, "wall/c1")]
        try:
            # A grant that its RCs have not heard of yet is lost with its leader (rule 5).
            async with hold(bob, "honest", {"robot/a": {}}, min_runtime=600, confirmed=True) as held:
                lab.nodes["bench"].send_signal(signal.SIGKILL)
                after = await lab.state(ada, lambda state: state.term > before.term)
                async with hold(bob, "next", {"robot/b": {}}, min_runtime=1):
                    pass
                assert held.active
                assert after.host == "anvil"

                async def refusals() -> dict[str, str]:
                    return {item.id: item.problem.code for item in eve.notices if item.problem is not None}

                named = ("high", "barred", "theirs", "posing")
                refused = await awaited(refusals, lambda found: set(named) <= found.keys())
                assert {refused[name] for name in named} == {"not_allowed"}
                state = await lab.state(ada, lambda state: not state.more)
                assert len([item for item in state.queue if item.client == "eve/forger"]) <= 256
                assert max(item.priority for item in state.queue) < 10
                assert max(item.priority for item in state.holds) < 10
                assert {item.grant for item in state.holds if item.client == "wall/c1"} == set()
            assert (after.term, "wall/c1", Grant(OLD, 8)) in revoked
            key = ada.mesh.keys.ask_bookings(ada.mesh.me)
            told = await answered(lambda: ada.mesh.ask_one(key, BookingsAsk(), BookingsTold, timeout=HANG))
            assert [view.id for view in told.bookings] == ["hers"]
            assert abs(told.time - time.time()) < 60
        finally:
            token.close()
            for mesh in (eves, carts):
                await mesh.close()

"""An RC that settles: what a direct hold leaves behind keeps the next holder away, and nobody else."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from tests.drivers.rcs import (
    ECHO,
    LEASE,
    TERM,
    Device,
    Rcm,
    answer,
    close,
    grant,
    holder,
    rc_state,
    started,
    states_published,
)
from tests.mesh.kit import until
from zscout.drivers.last_holder import LastHolder, LastHolderFile, UnknownLastHolder
from zscout.drivers.resource_controller import SETTLE, ResourceController
from zscout.keyexpr import Sender
from zscout.mesh import Mesh
from zscout.messages import Command, Done, Grants, Holder, Problem, Revocation
from zscout.testing.memory import MemoryNetwork
from zscout.types import SECOND

CONFIRM: Mapping[str, Any] = {"name": "confirm"}
LEAVING: Mapping[str, Any] = {"name": "leaving"}
LEFT: Mapping[str, Any] = {"name": "left"}
NEXT = "next"


def direct(number: int, arc: str = "one", client: str = "h/client") -> Holder:
    return replace(holder(number, arc, client), direct=True)


def own(one: Holder) -> Revocation:
    return Revocation(one.id, one.arc, one.client, one.grant, one.rcs, "released", "released by its client", own=True)


class Place:
    """An RCM, an RC that `client` holds directly under grant 1, and another client."""

    def __init__(self, network: MemoryNetwork, rcm: Rcm, rc: ResourceController, device: Device) -> None:
        self.network, self.rcm, self.rc, self.device = network, rcm, rc, device
        self.client = network.open("f", Sender("h", "client"))
        self.other = network.open("f", Sender("h", "other"))
        self.begin_heartbeat()

    def begin_heartbeat(self) -> None:
        self.heartbeat = asyncio.create_task(self._keep_alive())

    async def close(self) -> None:
        self.heartbeat.cancel()
        await close(self.rc, self.rcm.mesh, self.client, self.other)

    def next_holder(self, number: int = 2, **how: Any) -> None:
        self.rcm.publish(replace(holder(number, NEXT, "h/other"), **how))

    def publish(self, *holders: Holder, revoked: Revocation) -> None:
        seq = self.rcm.seq = self.rcm.seq + 1
        self.rcm._publisher.put(Grants(TERM, seq, seq - 1, 0.5, {"robot/x": [*holders]}, [revoked]))

    async def word(self, mesh: Mesh, number: int, do: Mapping[str, Any] = CONFIRM) -> str:
        return await answer(mesh, grant(number), do)

    async def refusal(self, number: int) -> Problem:
        key = self.other.keys.command("robot/x", self.other.me)
        reply = await self.other.ask_one(key, Command(do=dict(CONFIRM), grant=grant(number)), Done, timeout=5)
        assert reply is not None
        assert reply.problem is not None
        return reply.problem

    async def settled_after(self, number: int = 2) -> float:
        """Seconds until the other client's confirmation is taken."""
        began = self.rc.mesh.now()
        while (word := await self.word(self.other, number)) == "settling":  # noqa: ASYNC110 - as a client asks
            await asyncio.sleep(0.01)
        assert word == "done"
        return (self.rc.mesh.now() - began) / SECOND

    async def _keep_alive(self) -> None:
        """An RCM goes on to publish that nothing has changed."""
        while True:
            seq = self.rcm.seq
            self.rcm._publisher.put(Grants(TERM, seq, seq, 0.5))
            await asyncio.sleep(0.5)


@asynccontextmanager
async def play(first: Holder | None = None, *, confirmed: bool = True, **how: Any) -> AsyncIterator[Place]:
    network = MemoryNetwork()
    rcm, device = Rcm(network), how.pop("device", None) or Device()
    place = Place(network, rcm, await started(network, device, **how), device)
    rcm.publish(first or direct(1))
    await until(lambda: place.rc.holds.held)
    assert not confirmed or await place.word(place.client, 1) == "done"
    try:
        yield place
    finally:
        await place.close()


async def test_the_next_holder_waits_until_the_program_of_a_direct_hold_has_left() -> None:
    async with play() as at:
        at.next_holder()
        refused = await at.refusal(2)
        assert refused.code == "settling"
        assert refused.left == pytest.approx(LEASE + SETTLE, abs=0.1)
        assert await at.word(at.other, 2, ECHO) == "settling"
        assert at.device.calls == ["begin one", "end one", "safe"]
        assert (await at.word(at.client, 1, LEFT), await at.word(at.other, 2)) == ("done", "done")
        # What the program did to the device past its RC since is undone before the next holder begins.
        assert at.device.calls == ["begin one", "end one", "safe", "safe", "begin next"]


async def test_it_settles_for_settle_from_leaving_on() -> None:
    async with play() as at:
        at.next_holder()
        await asyncio.sleep(1)
        assert await at.word(at.client, 1, LEAVING) == "done"
        assert await at.settled_after() == pytest.approx(SETTLE, abs=0.1)


async def test_who_says_nothing_has_a_hold_lease_and_settle_from_its_last_confirmation_on() -> None:
    async with play() as at:
        await asyncio.sleep(20)
        assert await at.word(at.client, 1) == "done"
        await asyncio.sleep(2)
        at.next_holder()
        assert await at.settled_after() == pytest.approx(LEASE + SETTLE - 2, abs=0.1)


async def test_the_word_may_come_before_the_end_is_heard() -> None:
    async with play() as at:
        assert await at.word(at.client, 1, LEAVING) == "done"
        await asyncio.sleep(1)
        at.next_holder()
        assert await at.settled_after() == pytest.approx(SETTLE - 1, abs=0.1)


async def test_left_before_the_end_settles_nothing_unless_it_is_confirmed_again() -> None:
    async with play() as at:
        assert await at.word(at.client, 1, LEFT) == "done"
        at.next_holder()
        assert await at.settled_after() < 0.1
        at.rcm.publish(direct(3))
        assert (await at.word(at.client, 3), await at.word(at.client, 3, LEFT)) == ("done", "done")
        assert await at.word(at.client, 3) == "done"
        at.next_holder(4)
        assert await at.settled_after(4) > LEASE


async def test_nobody_else_says_that_a_program_has_left() -> None:
    async with play() as at:
        assert await at.word(at.other, 1, LEFT) == "wrong_client"
        at.next_holder()
        assert await at.word(at.other, 1, LEFT) == "ended"
        assert await at.word(at.other, 2) == "settling"


@pytest.mark.parametrize("released", ["with the next grant", "alone", "after its time"])
async def test_what_its_own_client_gives_back_does_not_settle(released: str) -> None:
    async with play() as at:
        following = [holder(2, NEXT, "h/other")] if released == "with the next grant" else []
        if released == "after its time":
            at.next_holder()
            assert await at.word(at.other, 2) == "settling"
            following = [holder(2, NEXT, "h/other")]
        at.publish(*following, revoked=own(direct(1)))
        if not following:
            at.next_holder(3)
        assert await at.settled_after(2 if following else 3) < 0.1


@pytest.mark.parametrize(
    ("end", "first"),
    [
        pytest.param(lambda at: at.next_holder(), direct(1), id="taken"),
        pytest.param(lambda at: at.rc.fail("smoke"), direct(1), id="the device failed"),
        pytest.param(lambda _: None, replace(direct(1), remaining=2.0), id="its time is over"),
    ],
)
async def test_any_other_end_settles(end: Callable[[Place], object], first: Holder) -> None:
    async with play(first) as at:
        end(at)
        await until(lambda: grant(1) not in at.rc.holds.held)
        at.rc.recover()
        at.next_holder(5)
        assert await at.word(at.other, 5) == "settling"


async def test_an_end_for_want_of_an_rcm_settles() -> None:
    async with play() as at:
        at.heartbeat.cancel()
        await until(lambda: not at.rc.holds.held)
        at.begin_heartbeat()
        at.next_holder()
        # It confirmed it a hold lease ago.
        assert await at.settled_after() == pytest.approx(SETTLE, abs=0.2)


async def test_a_hold_that_was_never_confirmed_has_no_program() -> None:
    async with play(confirmed=False) as at:
        at.next_holder()
        assert await at.settled_after() < 0.1


async def test_a_hold_that_is_not_direct_does_not_settle() -> None:
    async with play(holder(1)) as at:
        at.next_holder()
        assert await at.settled_after() < 0.1
        assert at.device.calls == ["begin one", "end one", "safe", "begin next"]


async def test_a_hand_over_does_not_settle_and_who_took_over_does() -> None:
    async with play() as at:
        at.rcm.publish(replace(direct(2, client="h/other"), place=direct(1).place))
        assert await at.settled_after() < 0.1
        at.rcm.publish(holder(3, NEXT, "h/client"))
        assert await at.word(at.client, 3) == "settling"
        assert (await at.word(at.other, 2, LEFT), await at.word(at.client, 3)) == ("done", "done")
        assert at.device.calls == ["begin one", "begin one", "end one", "safe", "safe", "begin next"]


class Shared(Device):
    sharable = True


async def test_who_held_before_goes_on_and_only_who_began_after_waits() -> None:
    async with play(device=Shared(), confirmed=False) as at:
        at.rcm.publish(direct(1), holder(2, "two", "h/other"))
        assert await at.word(at.client, 1) == "done"
        at.rcm.publish(holder(2, "two", "h/other"), holder(3, NEXT, "h/client"))
        assert (await at.word(at.other, 2), await at.word(at.other, 2, ECHO)) == ("done", "done")
        assert await at.word(at.client, 3) == "settling"
        assert (await at.word(at.client, 1, LEFT), await at.word(at.client, 3)) == ("done", "done")
        assert "safe" not in at.device.calls


@pytest.mark.parametrize("name", ["stop", "halt"])
async def test_stop_and_halt_are_never_held_back(name: str) -> None:
    async with play() as at:
        at.next_holder()
        assert (await at.word(at.other, 2, {"name": name}), at.device.calls[-1]) == ("done", name)


async def test_a_next_holder_that_has_ended_by_then_is_left_out_at_the_device() -> None:
    async with play() as at:
        at.next_holder()
        await until(lambda: grant(2) in at.rc.holds.held)
        await asyncio.sleep(2)
        at.rcm.publish()
        await until(lambda: not at.rc.holds.held)
        at.rcm.publish(holder(3, "third", "h/other"))
        assert await at.settled_after(3) == pytest.approx(LEASE + SETTLE - 2, abs=0.2)
        assert at.device.calls == ["begin one", "end one", "safe", "safe", "begin third"]


class Oven(Device):
    """Heats up for 4 s once somebody begins to hold it."""

    warm_at = 0.0

    async def begin(self, holder: Holder) -> None:
        await super().begin(holder)
        self.warm_at = asyncio.get_running_loop().time() + 4

    def begins_for(self) -> float:
        return max(0.0, self.warm_at - asyncio.get_running_loop().time())


async def test_whom_a_device_begins_for_does_not_enter_before_it_has_begun() -> None:
    async with play(device=Oven(), confirmed=False) as at:
        at.next_holder()
        await until(lambda: "begin next" in at.device.calls)
        refused = await at.refusal(2)
        assert refused.code == "settling"
        assert refused.left == pytest.approx(4, abs=0.1)
        assert refused.message == "robot/x is starting, ready in about 4 s"
        assert await at.word(at.other, 2, ECHO) == "settling"
        assert await at.word(at.other, 2, {"name": "stop"}) == "done"
        assert await at.word(at.client, 1) == "ended"
        assert await at.settled_after() == pytest.approx(4, abs=0.1)
        assert await at.word(at.other, 2, ECHO) == "done"


class Arm(Device):
    """Parks itself for `seconds`."""

    activation = 3.0

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self.seconds = seconds

    def usable_cold(self, do: Mapping[str, Any]) -> bool:
        return bool(do["name"] == "stop")

    async def safe(self) -> None:
        await super().safe()
        await asyncio.sleep(self.seconds)
        self.calls.append("parked")


async def test_a_device_that_parks_itself_takes_its_time_before_the_next_holder() -> None:
    async with play(holder(1), device=Arm(2.0), confirmed=False) as at:
        at.next_holder()
        began = at.rc.mesh.now()
        refused = await at.refusal(2)
        assert (refused.code, 3 < (refused.left or 0) <= SETTLE) == ("settling", True)
        assert await at.word(at.other, 2, {"name": "stop"}) == "done"
        assert await at.settled_after() == pytest.approx(2, abs=0.2)
        # It warms up from then on.
        assert await at.word(at.other, 2, ECHO) == "warming"
        await asyncio.sleep(3)
        assert (at.rc.mesh.now() - began) / SECOND == pytest.approx(5, abs=0.2)
        assert await at.word(at.other, 2, ECHO) == "done"
        assert at.device.calls == ["begin one", "end one", "safe", "stop", "parked", "begin next", "echo 1"]


async def test_holds_end_while_a_device_parks_itself() -> None:
    async with play(holder(1), device=Arm(2.0), confirmed=False) as at:
        at.next_holder()
        assert await at.word(at.other, 2) == "settling"
        at.rcm.publish(holder(3, "third", "h/other"))
        assert await at.word(at.other, 2) == "ended"
        assert await at.settled_after(3) == pytest.approx(2, abs=0.2)
        assert at.device.calls == ["begin one", "end one", "safe", "parked", "begin third"]


async def test_a_device_that_is_not_safe_within_settle_counts_as_lost() -> None:
    async with play(holder(1), device=Arm(600.0), confirmed=False) as at:
        at.next_holder()
        await until(lambda: at.rc.health != "ok")
        assert f"not safe after {SETTLE:g} s" in at.rc.health
        assert not at.rc.holds.held
        assert "begin next" not in at.device.calls


# Over restarts


async def restarted(last: Callable[[], LastHolder]) -> AsyncIterator[Place]:
    """An RC of which nobody holds anything; then it is killed and starts again, held under grant 7."""
    network = MemoryNetwork()
    rcm, device = Rcm(network), Device()
    at = Place(network, rcm, await started(network, device, last_holder=last()), device)
    yield at
    network.kill(at.rc.mesh)
    at.rc.stall.stop()
    await at.rc.supervisor.close()
    at.rc = await started(network, device, last_holder=last())
    at.next_holder(7)
    await until(lambda: grant(7) in at.rc.holds.held)
    yield at
    await at.close()


async def test_an_rc_that_starts_anew_settles_where_its_last_holder_may_have_been_direct(tmp_path: Path) -> None:
    kept, lives = tmp_path / "direct" / "robot" / "x", restarted(lambda: LastHolderFile(tmp_path, "robot/x"))
    at = await anext(lives)
    at.rcm.publish(direct(1))
    assert await at.word(at.client, 1) == "done"
    assert kept.exists()
    async for at in lives:
        assert await at.settled_after(7) == pytest.approx(LEASE + SETTLE, abs=0.3)
        await until(lambda: not kept.exists())
        assert at.rc.health == "ok"


async def test_an_rc_that_starts_anew_does_not_settle_where_it_had_no_direct_holder(tmp_path: Path) -> None:
    kept, lives = tmp_path / "direct" / "robot" / "x", restarted(lambda: LastHolderFile(tmp_path, "robot/x"))
    at = await anext(lives)
    at.rcm.publish(direct(1))
    assert await at.word(at.client, 1) == "done"
    at.publish(revoked=own(direct(1)))
    at.rcm.publish(holder(3))
    assert await at.word(at.client, 3) == "done"
    await until(lambda: not kept.exists())
    async for at in lives:
        assert at.rc.holds.settling == {}
        assert await at.settled_after(7) < 0.1


async def test_an_rc_that_can_keep_nothing_settles_after_each_start() -> None:
    lives = restarted(UnknownLastHolder)
    await anext(lives)
    async for at in lives:
        assert await at.settled_after(7) == pytest.approx(LEASE + SETTLE, abs=0.3)


async def test_a_direct_hold_that_can_not_be_noted_is_not_confirmed(tmp_path: Path) -> None:
    (tmp_path / "direct").write_text("in the way of a folder")

    async with play(last_holder=LastHolderFile(tmp_path, "robot/x"), confirmed=False) as at:
        assert await at.word(at.client, 1) == "failed"
        at.rcm.publish(holder(2))
        assert await at.word(at.client, 2) == "done"


@pytest.mark.parametrize(("first", "leaving"), [(direct(1), False), (holder(1), True)])
async def test_an_rc_that_ends_while_a_program_may_touch_its_device_leaves_it_to_no_other_at_once(
    first: Holder, leaving: bool
) -> None:
    async with play(first) as at:
        said = states_published(at.client)
        await at.rc.stop()
        await until(lambda: bool(said))
        assert (said[-1].leaving, said[-1].settle) == (leaving, SETTLE)


async def test_a_direct_hold_is_used_from_when_it_could_begin() -> None:
    """While a program of before may touch the device, nobody else does."""
    async with play() as place:
        await asyncio.sleep(5)
        place.next_holder(direct=True)
        waited = await place.settled_after()
        await asyncio.sleep(4)
        first, second = (await rc_state(place.client)).used
        assert first.seconds == pytest.approx(5, abs=0.1)
        assert waited > 1
        assert second.seconds == pytest.approx(4, abs=0.1)


async def test_a_direct_hold_that_was_handed_over_is_used_by_its_new_client() -> None:
    async with play(confirmed=False) as place:
        place.rcm.publish(replace(direct(2, client="h/other"), place=direct(1).place))
        await asyncio.sleep(2)
        assert [use.seconds for use in (await rc_state(place.client)).used][1:] == [pytest.approx(2, abs=0.1)]

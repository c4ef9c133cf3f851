"""A component that moves on a real mesh: nothing is lost or doubled, and nobody gets in between."""

from __future__ import annotations

import asyncio
import functools
import signal
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path

import psutil
import pytest

from tests.hang import HANG
from tests.live.bench import until
from tests.live.lab import Lab
from tests.live.placing import LONGEST, Placing, WitnessRc, register, three
from tests.thorough import times
from zscout.behaviors.client.client import Client
from zscout.behaviors.client.request import OpenArc
from zscout.messages import DrainHost, EndComponent, Grants, MigrateComponent, Placement, Placements, RcState
from zscout.types import Grant

pytestmark = [pytest.mark.live, pytest.mark.slow]

RC = "robot/scout33"
MOVES = times(20)
ARC = "tally"


class Rival:
    """Somebody who wants the same RC at the same priority, and all that was published of its holders."""

    def __init__(self, client: Client, arc: OpenArc) -> None:
        self.client, self.arc = client, arc
        self.states: set[str] = {arc.state}
        self.holders: list[tuple[str, ...]] = []
        client.watch(lambda arc: self.states.add(arc.state))
        client.mesh.subscribe(client.mesh.keys.grants, Grants, self._on_grants)
        client.mesh.subscribe(client.mesh.keys.rc_state(RC), RcState, self._on_state)

    def _on_grants(self, _key: str, said: Grants) -> None:
        if RC in said.rcs:
            self.holders.append(tuple(holder.arc for holder in said.rcs[RC]))

    def _on_state(self, _key: str, state: RcState) -> None:
        self.holders.append(tuple(holder.arc for holder in state.holders))

    def check(self) -> None:
        """It waited all the while, and the RC was never anybody's but the component's."""
        assert self.states == {"queued"}, self.arc
        assert set(self.holders) <= {(ARC,)}, set(self.holders)


async def rival_of(lab: Lab) -> Rival:
    client = await lab.client("rival")
    return Rival(client, await client.request("rival", {RC: {}}, min_runtime=1))


async def test_a_component_that_moves_keeps_its_count_and_its_hold(tmp_path: Path) -> None:
    async with Lab(tmp_path, candidates=["h0"]) as lab, WitnessRc(lab, RC) as rc:
        register(lab)
        placing = await three(lab, RC)
        placed = await placing.place(ARC, "tally", {"rc": RC, "period": 0.005}, hosts=["h1", "h2"])
        assert placed.state == "running"
        # It may be seen to run before its node has told what it can.
        await placing.until(ARC, lambda one: one.movable)
        await rc.witness.more()
        rival = await rival_of(lab)
        grants = set[Grant]()
        for number in range(MOVES):
            to = "h1" if placed.host == "h2" else "h2"
            placed = await placing.get(MigrateComponent(ARC, to, wait=LONGEST), Placement)
            assert (placed.state, placed.host, placed.moves) == ("running", to, number + 1), placed
            assert placed.dead is not None
            await rc.witness.more()
            grants.update(holder.grant for holder in (await lab.rc(placing.client, RC)).holders)
        rival.check()
        rc.witness.check()
        assert len(grants) == MOVES
        assert rc.witness.released == 0


# Each step at which the target may die: how the move is held there.
STEPS = ("starting", "standing by", "restoring", "restored", "handed over", "running")


@pytest.mark.parametrize("step", STEPS)
def test_the_target_s_host_dies_and_it_lives_in_exactly_one_place(tmp_path: Path, step: str) -> None:
    asyncio.run(_target_dies(tmp_path, "node", [step]))


def test_the_target_dies_and_it_lives_in_exactly_one_place(tmp_path: Path) -> None:
    """At every step of a move, one after the other in one fleet."""
    asyncio.run(_target_dies(tmp_path, "component", STEPS))


def let_go(folder: Path) -> None:
    """Holds up nothing any more."""
    for held in folder.glob("hold-*"):
        held.unlink()


async def _target_dies(folder: Path, victim: str, steps: Sequence[str]) -> None:
    async with Lab(folder, candidates=["h0"]) as lab, WitnessRc(lab, RC) as rc:
        register(lab)
        placing = await three(lab, RC)
        for step in steps:
            made = folder / step.replace(" ", "-")
            made.mkdir()
            try:
                await _dies_at(step, made, lab, placing, rc, victim)
            except Exception as error:
                raise AssertionError(f"{victim} killed, {step}: {error!r}") from error
            await placing.get(EndComponent(ARC, wait=LONGEST), Placement)
            await lab.held_by(placing.client, RC)


async def _dies_at(step: str, folder: Path, lab: Lab, placing: Placing, rc: WitnessRc, victim: str) -> None:
    """Kills the target of a move at this step."""
    rc.witness.counts.clear()
    params = {"rc": RC, "folder": str(folder)}
    placed = await placing.place(ARC, "stepper", params, hosts=["h1", "h2"], restart="always")
    source, target = placed.host, "h1" if placed.host == "h2" else "h2"
    assert source is not None
    await rc.witness.more()
    await placing.until(ARC, lambda one: one.movable)
    released = rc.witness.released
    (folder / "at-init").unlink()
    moving = asyncio.create_task(placing.ask(MigrateComponent(ARC, target, wait=LONGEST), Placement))
    await MOVE_TO[step](lab, placing, folder, target)
    await kill(lab, target, victim)
    let_go(folder)
    await moving
    # It goes on: where it was, or, where the target ran already, wherever the placer starts it again.
    await rc.witness.more(5)
    if step != "running":
        rc.witness.check()
    living = await placing.until(ARC, lambda one: one.state == "running")
    alive = [host for host in ("h1", "h2") if lab.nodes[host].poll() is None]
    running = [view for view in await placing.views(ARC, *alive) if view.phase == "running"]
    assert [(view.host, view.incarnation) for view in running] == [(living.host, living.incarnation)]
    if step not in ("handed over", "running"):
        assert (living.host, living.incarnation) == (source, placed.incarnation)
    if step in ("starting", "standing by", "restoring"):
        assert rc.witness.released == released


async def kill(lab: Lab, host: str, victim: str) -> None:
    """Kills a node with all it started, as if its host had lost power, or only the component there."""
    children = psutil.Process(lab.nodes[host].pid).children(recursive=True)
    if victim == "node":
        # It sees nothing of its children's end; and a child that was stopped would go on at its node's.
        lab.signal(host, signal.SIGSTOP)
    for child in children:
        child.kill()
    if victim == "node":
        lab.signal(host, signal.SIGKILL)
    await asyncio.to_thread(psutil.wait_procs, children, HANG)


async def held_at(step: str, lab: Lab, placing: Placing, folder: Path, target: str) -> None:
    (folder / f"hold-{step}").touch()
    await until((folder / f"at-{step}").exists)


at_restoring = functools.partial(held_at, "restore")


async def at_restored(lab: Lab, placing: Placing, folder: Path, target: str) -> None:
    """The RCM stands still, so that the hand-over is asked for and not carried out."""
    await at_restoring(lab, placing, folder, target)
    lab.signal("h0", signal.SIGSTOP)
    (folder / "hold-restore").unlink()
    await until((folder / "restored").exists)
    asyncio.get_running_loop().call_later(0.3, lab.signal, "h0", signal.SIGCONT)


async def at_handed_over(lab: Lab, placing: Placing, folder: Path, target: str) -> None:
    """The target stands still from the moment in which it has its state: it is handed the ARC, and can't say
    that it runs."""
    given, seen = asyncio.Event(), placing.client

    def on_grants(_key: str, said: Grants) -> None:
        if any(holder.client.startswith(f"{target}/") for holder in said.rcs.get(RC, [])):
            given.set()

    declared = seen.mesh.subscribe(seen.mesh.keys.grants, Grants, on_grants)
    await at_restoring(lab, placing, folder, target)
    lab.signal("h0", signal.SIGSTOP)
    (folder / "hold-restore").unlink()
    await until((folder / "restored").exists)
    # Nothing shows that its node, and the source's, have heard so: they may not have run meanwhile.
    await asyncio.sleep(2)
    for child in psutil.Process(lab.nodes[target].pid).children(recursive=True):
        child.suspend()
    lab.signal("h0", signal.SIGCONT)
    async with asyncio.timeout(HANG):
        await given.wait()
    declared.close()


async def at_running(lab: Lab, placing: Placing, folder: Path, target: str) -> None:
    await placing.until(ARC, lambda one: one.state == "running" and one.host == target)


MOVE_TO: dict[str, Callable[[Lab, Placing, Path, str], Awaitable[None]]] = {
    "starting": functools.partial(held_at, "init"),
    "standing by": functools.partial(held_at, "checkpoint"),
    "restoring": at_restoring,
    "restored": at_restored,
    "handed over": at_handed_over,
    "running": at_running,
}


async def test_drain_empties_a_host_without_a_lost_grant(tmp_path: Path) -> None:
    names = [f"part-{number}" for number in range(4)]
    async with Lab(tmp_path, candidates=["h0"]) as lab:
        register(lab)
        lab.node("h0", *(f"robot/{name}" for name in names))
        lab.node("h1")
        client = await lab.client()
        placing = Placing(client)
        await lab.ready(client, *(f"robot/{name}" for name in names))
        await placing.hosts(2)
        both = ["h0", "h1"]
        await asyncio.gather(
            *(placing.place(name, "tally", {"rc": f"robot/{name}", "period": 0.01}, hosts=both) for name in names)
        )
        revoked: list[str] = []

        def on_grants(_key: str, said: Grants) -> None:
            revoked.extend(one.outcome for one in said.revoked)

        client.mesh.subscribe(client.mesh.keys.grants, Grants, on_grants)
        placed = [await placing.until(name, lambda one: one.state == "running" and one.movable) for name in names]
        elsewhere = [one.component for one in placed if one.host == "h0"]
        await asyncio.gather(
            *(placing.get(MigrateComponent(name, "h1", wait=LONGEST), Placement) for name in elsewhere)
        )
        # What is published comes to this client when it comes.
        await until(lambda: revoked == ["handed_over"] * len(elsewhere))
        revoked.clear()
        for name in names:
            await placing.until(name, lambda one: (one.state, one.host, one.movable) == ("running", "h1", True))
        drained = await placing.get(DrainHost("h1"), Placements)
        assert drained.cordoned == ["h1"]
        for name in names:
            await placing.until(name, lambda one: (one.state, one.host) == ("running", "h0"))
        await until(lambda: len(revoked) >= len(names))
        assert revoked == ["handed_over"] * len(names)

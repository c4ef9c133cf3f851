"""A Scout's mind in closed loops: it hides, keeps still, survives what spoils pictures and takes its hold."""

from __future__ import annotations

from typing import NamedTuple

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from studies.robots.hide import HideJob, LinkConditions, run, trial
from tests.behaviors.perception.rooms import room, sofa
from tests.thorough import times
from zscout.behaviors.perception.hiding.hider import BadCheckpoint, Hider
from zscout.behaviors.perception.hiding.state import MAX_CHECKPOINT, WheelCommand
from zscout.behaviors.perception.lens import Picture
from zscout.simulation.building.bodies import Pose
from zscout.simulation.building.drawn import drawn_plan
from zscout.simulation.building.plan import Plan, Rug
from zscout.simulation.building.plan_file import load_plan, shipped_plans
from zscout.simulation.building.world import World

STATES = {"search", "approach", "unstick", "enter", "turn", "hidden"}


class Frame(NamedTuple):
    now: float
    picture: Picture | None
    act: WheelCommand


@pytest.fixture(scope="module")
def story() -> list[Frame]:
    """All that one mind saw and did until it was hidden."""
    frames: list[Frame] = []

    def watch(now: float, world: World, picture: Picture | None, act: WheelCommand) -> None:
        frames.append(Frame(now, picture, act))

    outcome = trial(room(sofa(4.0)), Pose(1.8, 1.5, 2.0), 0, watch=watch)
    assert outcome.good
    return frames


@pytest.mark.parametrize(
    "building", ["office", *(pytest.param(name, marks=pytest.mark.slow) for name in {*shipped_plans()} - {"office"})]
)
def test_it_hides_in_each_shipped_building(building: str) -> None:
    plan = load_plan(shipped_plans()[building])
    outcomes = [run(HideJob(plan, seed)) for seed in range(1, 1 + times(1))]
    assert sum(outcome.good for outcome in outcomes) >= 0.9 * times(1)


def test_it_hides_in_a_building_never_seen_before() -> None:
    outcome = run(HideJob(drawn_plan(3), 2))
    assert outcome.good
    assert outcome.share < 0.25


def test_it_hides_at_three_pictures_a_second_over_a_bad_radio() -> None:
    plan = load_plan(shipped_plans()["living_room"])
    assert run(HideJob(plan, 5, LinkConditions(frame_rate=3, loss=0.15, latency=0.3))).good


def test_a_dark_rug_does_not_hide_anybody() -> None:
    rug = Rug(x=2.5, y=2.0, width=1.2, depth=1.2, shade=0.04)
    outcome = trial(room(rugs=(rug,)), Pose(2.5, 2.0, 0.0), 1, limit=30)
    assert outcome.hidden_at is None


@pytest.mark.slow
def test_every_act_is_one_that_a_packet_carries(story: list[Frame]) -> None:
    for frame in story:
        act = frame.act
        assert -1 <= act.left <= 1
        assert -1 <= act.right <= 1
        assert 0 < act.lasts <= 1.5 if act.moves else act.lasts == 0
        assert act.doing in STATES
        assert act.why
    assert [frame.act.hidden for frame in story].count(True) == 1
    assert {"search", "approach", "enter", "turn"} <= {frame.act.doing for frame in story}


@pytest.mark.slow
@settings(max_examples=times(4))
@given(cuts=st.sets(st.integers(1, 400), min_size=1, max_size=4))
def test_a_checkpoint_changes_nothing(story: list[Frame], cuts: set[int]) -> None:
    hider = Hider()
    for number, frame in enumerate(story):
        if number in {cut % len(story) for cut in cuts}:
            data = hider.checkpoint()
            assert len(data) < MAX_CHECKPOINT
            hider = Hider.restore(data)
        assert hider.see(frame.now, frame.picture) == frame.act


def test_another_hosts_clock_changes_nothing(story: list[Frame]) -> None:
    hider, half = Hider(), len(story) // 2
    for frame in story[:half]:
        hider.see(frame.now, frame.picture)
    moved = Hider.restore(hider.checkpoint())
    # Its first picture counts no time at all, as nobody knows how long the way took.
    acts = [moved.see(frame.now - 5_000, frame.picture) for frame in story[half:]]
    assert any(act.moves for act in acts)
    assert {act.doing for act in acts} <= STATES


def test_a_bad_checkpoint_is_refused() -> None:
    wrong: list[dict[str, object]] = [{"form": 99}, {"phase": "dance"}, {"tones": b"abc"}, {"clock": "late"}]
    for data in (b"", b"\xc1", b"{}", b"\x00" * (MAX_CHECKPOINT + 1), *map(msgspec.msgpack.encode, wrong)):
        with pytest.raises(BadCheckpoint):
            Hider.restore(data)


def test_a_picture_of_another_form_is_refused() -> None:
    with pytest.raises(ValueError, match="120, 160"):
        Hider().see(0.0, np.zeros((60, 80), np.uint8))


def approaching(story: list[Frame]) -> tuple[Hider, int]:
    """A mind that drives, and the number of the last picture it saw."""
    driving = next(n for n, frame in enumerate(story) if frame.act.doing == "approach" and frame.act.moves)
    hider = Hider()
    for frame in story[: driving + 1]:
        hider.see(frame.now, frame.picture)
    return hider, driving


def test_it_stands_while_pictures_are_spoiled_and_says_so(story: list[Frame]) -> None:
    rng = np.random.default_rng(1)
    hider, driving = approaching(story)
    start = story[driving].now
    for tick in range(1, 20):
        snow = np.clip(110 + 62 * rng.standard_normal((120, 160)), 0, 255).astype(np.uint8)
        act = hider.see(start + tick / 5, snow)
        assert not act.moves
    assert "snow" in act.why
    again = [hider.see(start + 4 + frame.now, frame.picture) for frame in story[driving + 1 : driving + 8]]
    assert any(act.moves for act in again)


@pytest.mark.parametrize("frozen", [True, False])
def test_without_new_pictures_it_stands_soon(story: list[Frame], frozen: bool) -> None:
    hider, driving = approaching(story)
    last = story[driving]
    acts = [hider.see(last.now + tick / 5, last.picture if frozen else None) for tick in range(1, 16)]
    assert not any(act.moves for act in acts[5:])
    assert ("frozen" if frozen else "no picture") in acts[-1].why


class Loop:
    """A mind on a robot without anything in between, to move it about by hand."""

    def __init__(self, plan: Plan, pose: Pose, hider: Hider) -> None:
        self.world = World(plan, seed=5, starts={"scout": pose})
        self.body, self.hider = self.world.bodies["scout"], hider

    def run(self, seconds: float) -> list[WheelCommand]:
        acts = []
        for _ in range(round(seconds * 5)):
            acts.append(self.hider.see(self.world.time, self.world.picture("scout")))
            if acts[-1].moves:
                self.body.command(acts[-1].left, acts[-1].right, acts[-1].lasts, self.world.time)
            for _ in range(4):
                self.world.step(0.05)
        return acts

    def until_hidden(self, limit: float) -> WheelCommand:
        """The act that hides, or the last one."""
        for _ in range(round(limit * 5)):
            if (act := self.run(0.2)[-1]).hidden:
                break
        return act


def test_back_from_an_interruption_it_keeps_still_if_it_is_hidden_yet() -> None:
    loop = Loop(room(sofa(4.0)), Pose(3.2, 1.8, 0.2), Hider())
    assert loop.until_hidden(60).hidden
    loop.run(1)
    place = loop.body.pose
    loop.hider.interrupted(loop.world.time)
    assert not any(act.moves for act in loop.run(3))
    loop.hider.resumed(loop.world.time)
    assert loop.hider.state == "hidden"
    acts = loop.run(4)
    assert not any(act.moves for act in acts)
    assert acts[-1].hidden
    assert loop.body.pose == place


@pytest.mark.slow
def test_moved_into_the_light_it_hides_again() -> None:
    loop = Loop(room(sofa(4.0)), Pose(3.2, 1.8, 0.2), Hider())
    assert loop.until_hidden(60).hidden
    loop.hider.interrupted(loop.world.time)
    loop.body.place(3.0, 2.0, 0.0)
    loop.run(1)
    loop.hider.resumed(loop.world.time)
    assert not any(act.hidden for act in loop.run(2))
    assert loop.until_hidden(60).hidden
    assert loop.world.is_dark("scout")


def test_interrupted_while_driving_it_stands_and_searches_anew() -> None:
    loop = Loop(room(sofa(4.0)), Pose(1.0, 2.0, 0.0), Hider())
    while loop.hider.state != "approach":
        loop.run(0.2)
    loop.hider.interrupted(loop.world.time)
    assert not any(act.moves for act in loop.run(2))
    loop.hider.resumed(loop.world.time)
    assert loop.hider.state == "search"
    assert any(act.moves for act in loop.run(2))

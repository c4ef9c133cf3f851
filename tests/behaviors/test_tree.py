"""Trees of behaviors: paths, sayings, failures side by side, memories."""

from __future__ import annotations

import asyncio
from typing import Any, cast

import pytest

from zscout.behaviors.client.client import Client
from zscout.behaviors.sensor_net.scout import BAD_FOR, QUIET, Alerts, Blindness
from zscout.behaviors.tree import MAX_CHILDREN, MAX_DEPTH, Behavior, BehaviorContext, CarriedClock
from zscout.messages import BehaviorSaid
from zscout.types import SECOND


class Count(Behavior):
    """Counts to `to`, and fails there if it is to."""

    def __init__(self, name: str, to: int = 3, *, fails: bool = False) -> None:
        super().__init__(name)
        self.to, self.fails, self.count = to, fails, 0

    async def run(self, context: BehaviorContext) -> None:
        while self.count < self.to:
            self.count += 1
            self.report("counting", str(self.count))
            await context.safe_point()
        if self.fails:
            raise RuntimeError(self.path)

    def memory(self) -> dict[str, Any]:
        return {"count": self.count}

    def recall(self, memory: dict[str, Any]) -> None:
        self.count = int(memory["count"])


class All(Behavior):
    results: list[BaseException | None]

    async def run(self, context: BehaviorContext) -> None:
        children = (child.perform(context) for child in self.children)
        self.results = await asyncio.gather(*children, return_exceptions=True)


def played(root: Behavior) -> list[BehaviorSaid]:
    said: list[BehaviorSaid] = []

    async def safe_point() -> None:
        await asyncio.sleep(0)

    nobody = cast("Client", None)  # nothing here speaks to the mesh
    asyncio.run(root.perform(BehaviorContext(nobody, safe_point, said.append)))
    return said


def test_one_that_fails_leaves_the_others_at_work() -> None:
    root = All("net")
    for child in (Count("a", 5), Count("b", 2, fails=True), Count("c", 5)):
        root.add(child)
    said = played(root)
    assert [str(result) for result in root.results] == ["None", "net/b", "None"]
    assert [s.detail for s in said if s.path == "net/c" and s.doing] == ["1", "2", "3", "4", "5"]
    ended = [s.path for s in said if not s.doing]
    assert sorted(ended) == ["net/a", "net/b", "net/c"]


def test_the_same_said_again_is_told_once() -> None:
    class Same(Behavior):
        async def run(self, context: BehaviorContext) -> None:
            for _ in range(3):
                self.report("watch")
            self.report("watch", alert=True)
            self.report("watch", camera="framegrabber/f1", boxes=[(1, 2, 3, 4)])

    said = played(Same("one"))
    assert [(s.doing, s.alert, len(s.boxes)) for s in said] == [
        ("watch", False, 0),
        ("watch", True, 0),
        ("watch", False, 1),
        ("", False, 0),
    ]


def test_a_tree_is_remembered_whole() -> None:
    def tree() -> All:
        root = All("net")
        for name in "ab":
            root.add(Count(name, 4))
        return root

    one, other = tree(), tree()
    cast("Count", one.children[1]).count = 3
    other.restore(one.checkpoint())
    assert other.checkpoint() == one.checkpoint()
    assert [s.detail for s in played(other) if s.path == "net/b" and s.doing] == ["4"]


def test_trees_have_bounds() -> None:
    root = All("net")
    for number in range(MAX_CHILDREN):
        root.add(Count(f"c{number}"))
    with pytest.raises(ValueError, match="net may have"):
        root.add(Count("more"))
    twice = All("n")
    twice.add(Count("a"))
    with pytest.raises(ValueError, match="already has a behavior a"):
        twice.add(Count("a"))
    with pytest.raises(ValueError, match="not valid"):
        Count("a/b")
    deep: Behavior = All("n")
    for number in range(MAX_DEPTH - 1):
        child = All(f"d{number}")
        deep.add(child)
        deep = child
    with pytest.raises(ValueError, match="deep"):
        deep.add(Count("too-deep"))


def test_a_clock_goes_on_at_another_host_where_it_was() -> None:
    here, there = CarriedClock(), CarriedClock()
    readings = [here.read(at * SECOND, 2.0) for at in (1000, 1003)]
    there.seconds = here.seconds
    readings += [there.read(at * SECOND, 2.0) for at in (5, 6)]
    assert readings == [0.0, 6.0, 6.0, 8.0]


# Whose fault it is that there is no picture


def test_a_channel_without_a_picture_is_left_for_another() -> None:
    blind, channels = Blindness(5.0), ["video/ch1", "video/ch2"]
    blind.begin(0)
    assert [blind.see(at, False, "video/ch1") for at in (1, 4.9, 5)] == [False, False, True]
    assert not blind.dead
    assert blind.choose(6, channels) == "video/ch2"
    blind.begin(6)
    assert not blind.see(8, True, "video/ch2")
    assert blind.choose(9, channels) == "video/ch2"
    assert blind.choose(5 + BAD_FOR, channels) is None


def test_a_robot_that_no_channel_shows_is_dead() -> None:
    blind = Blindness(5.0)
    for start, channel in ((0, "video/ch1"), (10, "video/ch2")):
        blind.begin(start)
        assert blind.see(start + 5, False, channel)
    assert blind.dead
    assert blind.choose(16, ["video/ch1", "video/ch2"]) == "video/ch1", "it was bad first"
    assert blind.choose(5 + BAD_FOR, ["video/ch1", "video/ch2"]) == "video/ch1"
    assert blind.choose(15 + BAD_FOR, ["video/ch1", "video/ch2"]) is None
    other = Blindness(5.0)
    other.recall(blind.memory())
    assert other.dead


def test_a_picture_that_comes_and_goes_is_no_fault() -> None:
    blind = Blindness(5.0)
    blind.begin(0)
    assert not any(blind.see(at / 2, at % 8 == 0, "video/ch1") for at in range(200))


def test_an_alert_for_each_event() -> None:
    alerts, moves = Alerts(), {1.0, 1.1, 1.0 + QUIET, 8.0}
    words = [alerts.see(at, at in moves) for at in (0.5, 1.0, 1.1, 2.0, 1.0 + QUIET, 5.5, 8.0)]
    assert words == ["", "start", "", "", "", "end", "start"]
    alerts.rest()
    assert (alerts.see(8.1, True), alerts.count) == ("start", 3)


def test_motion_that_is_too_short_is_no_alert() -> None:
    alerts, moves = Alerts(), {1.0, 1.5, 5.0, 5.9, 6.9, 7.1, 20.0}
    words = [alerts.see(at, at in moves, 2.0) for at in (1.0, 1.2, 1.5, 4.0, 5.0, 5.9, 6.9, 7.1, 8.0, 9.2, 20.0)]
    assert words == [*[""] * 7, "start", "", "end", ""]
    assert alerts.count == 1

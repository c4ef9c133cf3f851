"""What the recorder writes of components, read back from real recordings."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from tests.services.recorder.kit import ears, recording
from tests.services.recorder.paper_run import colours, events, lanes, rows
from tests.services.recorder.placed_hour import TERM, placement, play
from tests.services.recorder.test_service import Leader
from zscout.mesh import IncomingQuery
from zscout.messages import ComponentUse, ListPlacements, Placement, Placements, PlacerOperation
from zscout.services.recorder import hosts as module
from zscout.services.recorder.drawing import HolderRow
from zscout.services.recorder.hosts import HostTracker
from zscout.services.recorder.timeline import Timeline
from zscout.testing.memory import MemoryNetwork
from zscout.types import Term

SCALARS = "Scalars:scalars"


def marks(path: Path) -> list[tuple[float, str, str, str]]:
    """Second, what happened, component, host; in order of time."""
    components, hosts = (rows(path, "/mark/**", column) for column in ("component", "host"))
    return sorted(
        (at, entity.removeprefix("/mark/"), component, host)
        for (entity, at, (component,)), (_, _, (host,)) in zip(components, hosts, strict=True)
    )


def curve(path: Path, entity: str) -> list[float]:
    points = sorted((at, values[0]) for _, at, values in rows(path, entity, SCALARS) if values)
    return [value for _, value in points]


def test_an_hour_reads_as_it_was(path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        play(timeline, every=127)  # 1,905 = 15 * 127
    shown = lanes(path, "/host/**")
    assert set(shown) == {"/host/anvil", "/host/basil", "/host/crucible"}
    assert [change for change in shown["/host/basil"] if 1800 < change[0] < 2300] == [
        (1900, ["counter · gets ready", ""]),
        (1906, ["counter", ""]),
        (2100, ["counter", "shaky · starting"]),
        (2104, ["counter", "shaky"]),
        (2220, ["counter", ""]),
        (2240, ["counter", "shaky"]),
    ]
    assert shown["/host/crucible"][-1:] == [(3000, ["", ""])]

    said = events(path)
    assert "counter moved anvil -> basil, dead 34 ms" in said
    assert "basil is being emptied: nothing is placed there any more" in said
    assert "shaky failed on basil, and is tried again: " in "\n".join(said)
    assert "watch-2 is restarted on anvil, it was on crucible: crucible is gone" in said
    levels = [level for _, _, level in rows(path, "/events", "TextLog:level") if level == ["ERROR"]]
    assert len(levels) == 1

    happened = marks(path)
    assert [it[1:] for it in happened if it[0] == 1906] == [("came", "counter", "basil"), ("left", "counter", "anvil")]
    assert [one[2:] for one in happened if one[1] == "placed"] == [
        ("counter", "anvil"),
        ("mapper", "anvil"),
        ("watch-1", "basil"),
        ("watch-2", "crucible"),
        ("watch-3", "basil"),
        ("shaky", "basil"),
    ]
    assert [one for one in happened if one[1] == "given_up"] == [(2600, "given_up", "shaky", "basil")]
    # A mark stands on its host's curve.
    loads = {at: value for _, at, value in rows(path, "/load/anvil", SCALARS)}
    (left,) = [value for _, at, value in rows(path, "/mark/left", SCALARS) if at == 1906]
    assert left == loads[1905]


def test_a_component_has_the_colour_of_its_arc(path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        timeline.holders(0, "robot/a", [HolderRow("first"), HolderRow("counter")])
        on_anvil = [placement(name, "running", "anvil", 1) for name in ("counter", "other")]
        say(timeline.hosts, 1, *on_anvil)
        timeline.holders(2, "robot/a", [HolderRow("other"), HolderRow("next")])
    rc, host = colours(path, "/devices/**")["/devices/robot/a"], colours(path, "/host/**")["/host/anvil"]
    assert host == {name: rc[name] for name in ("counter", "other")}
    assert len(set(rc.values())) == 4


def test_a_move_that_failed_is_told_and_leaves_no_mark(path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        tracker = timeline.hosts
        say(tracker, 0, placement("counter", "running", "anvil", 1))
        say(tracker, 1, placement("counter", "moving", "anvil", 1, to="basil"))
        say(tracker, 2, placement("counter", "running", "anvil", 1, reason="not at a safe point for 5 s"))
        say(tracker, 3, placement("picky", "waiting", None, 0, reason="no host has label gpu"))
        say(tracker, 4, placement("picky", "waiting", None, 0, reason="no host has label gpu"))
    assert [mark for _, mark, _, _ in marks(path)] == ["placed"]
    assert events(path)[1:] == [
        "counter moves from anvil to basil",
        "counter stays on anvil: not at a safe point for 5 s",
        "picky waits for a host: no host has label gpu",
    ]
    assert lanes(path, "/host/**")["/host/basil"] == [(1, ["counter · gets ready"]), (2, [""])]


def say(tracker: HostTracker, at: float, *told: Placement, term: Term = TERM) -> None:
    tracker.placements(at, Placements(term, list(told)))


def test_what_a_late_recorder_reads_did_not_happen_now(path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        tracker = timeline.hosts
        say(tracker, 1, placement("newer", "running", "anvil", 2))
        older = [placement("newer", "starting", "anvil", 1), placement("counter", "running", "basil", 7)]
        tracker.placements(2, Placements(TERM, older, ["crucible"]), {"newer"})
        say(tracker, 3, placement("counter", "running", "basil", 8))
        # An answer of an RCM that was overthrown meanwhile, and one that has not heard of `newer`.
        say(tracker, 4, term=Term(2, "next"))
        tracker.placements(5, Placements(TERM), set())
        tracker.placements(6, Placements(Term(2, "next"), [placement("counter", "running", "basil", 8)]), set())
    assert [told[:3] for told in marks(path)] == [(1, "placed", "newer"), (3, "restarted", "counter")]
    assert lanes(path, "/host/**") == {"/host/anvil": [(1, ["newer"]), (6, [""])], "/host/basil": [(2, ["counter"])]}
    assert "counter (counter) runs on basil already" in events(path)
    assert "crucible is being emptied: nothing is placed there any more" in events(path)


def test_bad_names_are_left_out_and_lanes_are_bounded(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_HOSTS", 2)
    with Timeline("lab", path=path) as timeline:
        tracker = timeline.hosts
        say(tracker, 0, placement("a/b", "running", "anvil", 1), placement("a", "running", "h" * 70, 1))
        for number in range(4):
            say(tracker, 1, placement(f"c{number}", "running", f"host{number}", 1))
    assert set(lanes(path, "/host/**")) == {"/host/host0", "/host/host1"}
    assert sum(text.startswith("timeline: more than 2 hosts") for text in events(path)) == 1


def use(component: str, cpu: float, memory: int = 0) -> ComponentUse:
    return ComponentUse(component, "kind", 1, cpu, memory)


def test_the_heaviest_components_have_curves(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_CURVES", 3)
    monkeypatch.setattr(module, "MAX_DRAWN", 5)
    many = [use(f"c{number}", 0.1 * number) for number in range(1, 7)]
    with Timeline("lab", path=path) as timeline:
        timeline.hosts.uses(0, "anvil", many)
        timeline.hosts.uses(1, "basil", [use("heavy", 0.3, 2_000_000_000)])
        timeline.hosts.uses(2, "anvil", many)
        timeline.hosts.uses(3, "anvil", [use("c6", 0.6, 5_000_000)])
        timeline.hosts.uses(4, "anvil", [])
        timeline.hosts.uses(5, "anvil", [use(f"d{number}", 9) for number in range(3)])
    drawn = {entity for entity, _, _ in rows(path, "/use/cpu/**", SCALARS)}
    assert drawn == {f"/use/cpu/{name}" for name in ("anvil/c6", "anvil/c5", "anvil/c4", "basil/heavy", "anvil/d0")}
    # c4 gave way to the heavy one; c5 and c6 went on until they were gone.
    assert [len(curve(path, f"/use/cpu/anvil/c{number}")) for number in (4, 5, 6)] == [1, 2, 3]
    assert curve(path, "/use/memory/anvil/c6") == [0, 0, 5]
    ends = {entity: at for entity, at, _ in rows(path, "/use/cpu/**", "Clear:is_recursive")}
    assert ends == {"/use/cpu/anvil/c4": 1, "/use/cpu/anvil/c5": 3, "/use/cpu/anvil/c6": 4}
    assert sum("more than 5 components" in text for text in events(path)) == 1


def test_no_line_is_drawn_through_a_host_s_silence(path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        for at in (0, 9, 60):
            timeline.hosts.load(at, "anvil", 1.0, 0.5)
    for folder in ("load", "cpu"):
        breaks = [at for _, at, _ in rows(path, f"/{folder}/anvil", "Clear:is_recursive")]
        assert breaks == [9 + module.SILENCE]
        assert len(curve(path, f"/{folder}/anvil")) == 3


def test_marks_of_one_moment_stand_above_each_other(path: Path) -> None:
    with Timeline("lab", path=path) as timeline:
        timeline.hosts.load(0, "anvil", 2.0)
        for at, name in ((1.0, "a"), (1.5, "b"), (1.9, "c"), (9.0, "d")):
            timeline.hosts.mark(at, "anvil", "placed", name)
    heights = curve(path, "/mark/placed")
    assert heights[0] == heights[3] == 2.0
    assert heights[0] < heights[1] < heights[2]


async def test_a_recorder_hears_a_placer_and_asks_for_what_it_missed(path: Path) -> None:
    network = MemoryNetwork()
    mesh = Leader(network).mesh

    def list_all(query: IncomingQuery[PlacerOperation]) -> None:
        assert isinstance(query.message, ListPlacements)
        query.answer(Placements(TERM, [placement("counter", "running", "anvil", 1)]))

    served = mesh.serve(mesh.keys.placer(mesh.me), PlacerOperation, list_all)
    async with recording(path, ears(network), mesh):
        await asyncio.sleep(1)
        moved = placement("counter", "running", "basil", 2, moves=1, dead=0.5)
        mesh.put(mesh.keys.placements, Placements(TERM, [moved]))
        await asyncio.sleep(1)
    served.close()
    assert [text for text in events(path) if text.startswith("counter")] == [
        "counter (counter) runs on anvil already",
        "counter moved anvil -> basil, dead 500 ms",
    ]

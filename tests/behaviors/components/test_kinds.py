"""Kinds of components: which are there, and what is said of those that are none; where safe points hold one."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from tests.behaviors.components.kit import ODD, register_odd_kinds
from tests.hang import HANG
from zscout.behaviors.components.component import (
    BadKind,
    Component,
    SafePointGate,
    installed_kinds,
    is_movable,
    load_kind,
)
from zscout.behaviors.components.shipped import Counter, Spin


def test_what_comes_with_zscout_is_installed_and_can_be_loaded() -> None:
    there = installed_kinds()
    assert [load_kind(kind, there[kind]) for kind in ("counter", "spin")] == [Counter, Spin]
    assert is_movable(Counter({}))
    assert not is_movable(Component({}))


@pytest.mark.slow
def test_kinds_of_other_packages_are_seen_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "still" not in installed_kinds()
    register_odd_kinds(tmp_path / "site")
    monkeypatch.syspath_prepend(tmp_path / "site")
    assert set(ODD) < set(installed_kinds())


def test_a_name_that_means_two_things_or_none_is_no_kind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    info = tmp_path / "other-1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: other\nVersion: 1\n")
    (info / "entry_points.txt").write_text("[zscout.components]\nspin = a:B\nbad/name = a:B\nfine = a:B\n")
    monkeypatch.syspath_prepend(tmp_path)
    there = installed_kinds()
    assert there["fine"] == "a:B"
    assert "spin" not in there
    assert "bad/name" not in there


@pytest.mark.parametrize(
    "where", ["zscout.behaviors.components.shipped:PAGE", "zscout.behaviors.components.shipped:No.such", "json"]
)
def test_what_is_no_component_is_refused_in_one_line(where: str) -> None:
    with pytest.raises(BadKind, match=r"kind x: .* not a subclass of .*; fix the entry point") as caught:
        load_kind("x", where)
    assert "\n" not in str(caught.value)


BAD = [
    (Spin, {"cpu": 2}, "cpu: is 2; write a number from 0 to 1"),
    (Spin, {"cpu": True}, "cpu: is true"),
    (Spin, {"cpu": float("nan")}, "cpu: is not a finite number"),
    (Spin, {"cores": 2}, "cores: unknown key; known here: cpu, memory"),
    (Counter, {"rc": 5}, "rc: is 5; write a text"),
    (Counter, {"rc": "robot"}, "kind/name"),
    (Counter, {"period": 0}, "period: is 0"),
]


@pytest.mark.parametrize(("kind", "params", "words"), BAD)
def test_bad_parameters_are_told(kind: type[Component], params: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words) as caught:
        kind(params)
    assert "\n" not in str(caught.value)


# Safe points


async def test_who_is_not_wanted_goes_on_and_gives_the_loop_a_turn() -> None:
    gate = SafePointGate()
    turns: list[int] = []
    asyncio.get_running_loop().call_soon(turns.append, 1)
    await gate.enter()
    assert turns == [1]
    assert not gate.holds


async def test_who_comes_is_held_until_released() -> None:
    gate, steps = SafePointGate(), 0

    async def run() -> None:
        nonlocal steps
        while True:
            steps += 1
            await gate.enter()

    running = asyncio.create_task(run())
    for _ in range(3):
        assert await gate.hold(HANG)
        held = steps
        for _ in range(10):
            await asyncio.sleep(0)
        assert steps == held
        gate.release()
        async with asyncio.timeout(HANG):
            while steps == held:  # noqa: ASYNC110 - the loop has its turns, nothing else
                await asyncio.sleep(0)
    running.cancel()


async def test_who_does_not_come_is_not_held_later() -> None:
    gate = SafePointGate()
    assert not await gate.hold(0.01)
    async with asyncio.timeout(HANG):
        await gate.enter()


async def test_who_is_cancelled_at_the_gate_is_not_held_any_more() -> None:
    gate = SafePointGate()
    comes = asyncio.create_task(gate.enter())
    held = [await gate.hold(HANG), gate.holds]
    comes.cancel()
    await asyncio.gather(comes, return_exceptions=True)
    held += [gate.holds, await gate.hold(0.01)]
    assert held == [True, True, False, False]

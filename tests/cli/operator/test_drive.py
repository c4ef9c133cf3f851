"""What an operator's hands do to `zscout drive`, without a robot; with one, see tests/live/robots."""

from __future__ import annotations

import asyncio
import json
import os
import sys
import termios
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tests.hang import HANG
from zscout.behaviors.client.client import Client
from zscout.behaviors.sensor_net.held_robot import RobotNeeds
from zscout.behaviors.teleop import Pilot, Teleop
from zscout.cli.operator.drive import AXIS, BUTTON, FULL_DEFLECTION, INITIAL, PAD_EVENT, Hands, _Console, game_pad
from zscout.config.strict import BadInput
from zscout.mesh import clock
from zscout.terminal import KEYS, MAX_TYPED, typed_keys
from zscout.types import SECOND

ZSCOUT = str(Path(sys.executable).with_name("zscout"))


def teleop_of(**how: Any) -> Teleop:
    """One that is never run: of its client it reads the clock alone."""
    client = SimpleNamespace(mesh=SimpleNamespace(now=clock.now))
    return Teleop(cast("Client", client), RobotNeeds("robot/r1"), Pilot(0.6), priority=10, **how)


async def comes_true(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(HANG):
        while not condition():  # noqa: ASYNC110 - it comes from a descriptor
            await asyncio.sleep(0.005)


@pytest.mark.parametrize(
    ("typed", "keys"),
    [
        (b"", []), (b"wasd", [b"w", b"a", b"s", b"d"]), (b"\x1b[A\x1bOBq", [b"\x1b[A", b"\x1bOB", b"q"]),
        (b"w\x1b[C ", [b"w", b"\x1b[C", b" "]), (b"\x1b", [b"\x1b"]), (b"\x1b[", [b"\x1b", b"["]),
        (b"\xc3\xa4", [b"\xc3", b"\xa4"]),
    ],
)  # fmt: skip
def test_keys_are_told_apart(typed: bytes, keys: list[bytes]) -> None:
    assert KEYS.findall(typed) == keys


def test_keys_drive_stop_and_give_back() -> None:
    async def story() -> None:
        teleop, end = teleop_of(), asyncio.Event()
        hands = Hands(teleop, end)

        def wheels() -> tuple[float, float]:
            now = teleop.pilot.wheels(clock.now() / SECOND)
            return now.left, now.right

        for keys, expected in (
            ([b"w"], (0.6, 0.6)),
            ([b" "], (0, 0)),
            ([b"\x1b[B"], (-0.6, -0.6)),
            ([b"x"], (0, 0)),
            ([b"+", b"d"], (0.35, -0.35)),
            ([b" ", b"-", b"-", b"\x1bOD"], (-0.25, 0.25)),
            ([b"g"], (0, 0)),
            ([b"?", b"\x1b"], (0, 0)),
        ):
            for key in keys:
                hands.key(key)
            assert wheels() == pytest.approx(expected), keys
        assert not end.is_set()
        hands.moved(1.0, 0.0)
        assert wheels() == pytest.approx((0.5, 0.5))
        hands.button(0)
        assert wheels() == (0, 0)
        hands.key(b"q")
        assert end.is_set()

    asyncio.run(story())


def test_a_terminal_gives_its_keys_one_by_one_and_is_as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    async def story() -> None:
        master, slave = os.openpty()
        terminal = os.fdopen(slave, "rb", buffering=0)
        monkeypatch.setattr(sys, "stdin", terminal)
        before = termios.tcgetattr(slave)
        pressed: list[bytes] = []
        ended = asyncio.Event()
        with typed_keys(pressed.append, ended.set):
            assert not termios.tcgetattr(slave)[3] & (termios.ICANON | termios.ECHO)
            os.write(master, b"w\x1b[A")
            await comes_true(lambda: pressed == [b"w", b"\x1b[A"])
            os.write(master, b"d" * MAX_TYPED)
            await comes_true(lambda: pressed[2:] == [b"d"] * MAX_TYPED)
        assert termios.tcgetattr(slave) == before
        assert not ended.is_set()
        # The terminal goes: that is told, and there is nothing to be set back.
        with typed_keys(pressed.append, ended.set):
            os.close(master)
            await asyncio.wait_for(ended.wait(), HANG)
        terminal.close()

    asyncio.run(story())


def test_a_pad_moves_stops_and_is_unplugged(tmp_path: Path) -> None:
    async def story() -> None:
        device = tmp_path / "js0"
        os.mkfifo(device)
        moves: list[tuple[float, float]] = []
        buttons: list[int] = []
        with game_pad(device, lambda *move: moves.append(move), buttons.append):
            pad = os.open(device, os.O_WRONLY)

            def happens(*events: tuple[int, int, int]) -> bytes:
                return b"".join(PAD_EVENT.pack(1, value, kind, number) for value, kind, number in events)

            # As Linux does, it first tells how all stands.
            os.write(pad, happens((0, AXIS | INITIAL, 0), (0, AXIS | INITIAL, 1), (0, BUTTON | INITIAL, 0)))
            os.write(
                pad, happens((-FULL_DEFLECTION, AXIS, 1), (FULL_DEFLECTION // 2, AXIS, 0), (FULL_DEFLECTION, AXIS, 5))
            )
            await comes_true(lambda: len(moves) == 4)
            assert moves[-1] == pytest.approx((1.0, 0.5), abs=0.001)
            os.write(pad, happens((1, BUTTON, 1), (0, BUTTON, 1), (1, BUTTON, 0)))
            await comes_true(lambda: buttons == [1, 0])
            os.close(pad)
            await comes_true(lambda: moves[-1] == (0.0, 0.0) and len(moves) == 5)

    asyncio.run(story())


def test_a_pad_that_is_not_there() -> None:
    with (
        pytest.raises(BadInput, match=r"--pad.*js99.*can't be opened.*name a joystick"),
        game_pad(Path("/nowhere/js99"), lambda *_: None, lambda _: None),
    ):
        pass


def test_json_lines_tell_each_state_once(capsys: pytest.CaptureFixture[str]) -> None:
    console = _Console("robot/r1", as_json=True)
    teleop = teleop_of()
    for state, why, takeover in (
        ("waiting", "for the RCM", None),
        ("waiting", "for the RCM", None),
        ("waiting", "robot/r1 is held", None),
        ("driving", "", None),
        ("driving", "", 0.04),
        ("free", "", 0.04),
        ("waiting", "for the RCM", None),
    ):
        teleop.state, teleop.why, teleop.takeover = state, why, takeover  # type: ignore[assignment]
        console.update(teleop)
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [line["event"] for line in lines] == ["waiting", "waiting", "taken", "driving", "free", "waiting"]
    assert all(line["robot"] == "robot/r1" for line in lines)
    assert lines[1]["why"] == "robot/r1 is held"
    assert lines[3]["takeover"] == 0.04

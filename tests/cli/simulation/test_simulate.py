"""`zscout simulate` as people and scripts run it."""

from __future__ import annotations

import asyncio
import json
import signal
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import pytest

from tests.cli.tools import COMMAND, Terminal, zscout_here
from tests.hang import HANG
from tests.live.lab import Lab
from zscout.config.devices import FramegrabberRc, RadioRc, RobotRc, VideoRc
from zscout.config.node import load_node
from zscout.messages import BuildingPlan, BuildingPoses, PlanAsk
from zscout.messages.behaviors import MAX_PLAN
from zscout.simulation.building.plan_file import plan_named

CLOSET = """
name = "closet"
width = 2.0
depth = 2.0
[[light]]
name = "ceiling"
x = 1.0
y = 1.0
[[robot]]
name = "scout33"
id = 33
x = 0.5
y = 0.5
[[robot]]
name = "scout35"
id = 35
x = 1.5
y = 1.5
"""


@pytest.fixture
def closet(tmp_path: Path) -> Path:
    file = tmp_path / "closet.toml"
    file.write_text(CLOSET)
    return file


@contextmanager
def simulating(*args: object, env: dict[str, str] | None = None) -> Iterator[tuple[subprocess.Popen[str], Any]]:
    """A building in the background, and what it told of itself."""
    process = subprocess.Popen(
        [*COMMAND, *(["simulate", *map(str, args), "--json"])], stdout=subprocess.PIPE, text=True, env=env
    )
    assert process.stdout is not None
    try:
        yield process, json.loads(process.stdout.readline())
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


@pytest.mark.live
def test_it_serves_what_it_tells_and_leaves_nothing_behind(closet: Path, tmp_path: Path) -> None:
    link, file = tmp_path / "radio0", tmp_path / "lab.toml"
    how = ("--radio", link, "--node", file, "--speed", 2, "--baud", 1200, "--channels", 2, "--framegrabbers", 3)
    with simulating(closet, *how) as (process, told):
        assert told["radio"] == {"port": str(link), "baud": 2400}
        assert [robot["id"] for robot in told["robots"]] == [33, 35]
        assert str(link.readlink()).startswith("/dev/pts/")
        for channel in told["channels"]:
            with urlopen(channel["url"] + ".jpg", timeout=HANG) as answer:  # noqa: S310
                assert answer.read(2) == b"\xff\xd8"

        devices = {rc.name: rc for rc in load_node(file).rcs}
        radio, robot = devices["radio/rf0"], devices["robot/scout35"]
        assert isinstance(radio, RadioRc)
        assert (radio.port, radio.baud) == (str(link), 2400)
        assert isinstance(robot, RobotRc)
        assert (robot.id, robot.radio, robot.warm_up) == (35, "radio/rf0", 1_000_000_000)
        assert robot.channels == {"video/ch1": 1, "video/ch2": 2}
        assert isinstance(devices["video/ch2"], VideoRc)
        grabber = devices["framegrabber/fgrab3"]
        assert isinstance(grabber, FramegrabberRc)
        assert grabber.rate == 20
        assert grabber.sources == {channel["video"]: channel["url"] for channel in told["channels"]}
        assert len(devices) == 1 + 2 + 2 + 3

        process.send_signal(signal.SIGINT)
        assert process.wait(HANG) == 130
    assert not link.is_symlink()


def test_it_ends_by_itself_and_says_how_it_was(closet: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert zscout_here("simulate", closet, "--speed", 20, "--for", 2) == 0
    said = capfd.readouterr().out.splitlines()
    assert said[0] == "closet, seed 0 at 20 times real time"
    assert any(line.startswith("radio") and "/dev/pts/" in line for line in said)
    assert sum(line.startswith("camera") and "http://127.0.0.1:" in line for line in said) == 4
    assert "scout35  id 35" in "\n".join(said)
    assert said[-1].startswith("2.")
    assert "0 packets received, 0 lost" in said[-1]


@pytest.mark.live
def test_at_a_terminal_a_line_tells_how_it_goes(closet: Path) -> None:
    with Terminal("simulate", closet, "--speed", 2) as terminal:
        terminal.until("scout33")
        terminal.until("CPU")
        terminal.press("\x03")
        assert terminal.code() == 130


@pytest.mark.live
def test_the_mesh_hears_who_is_where(closet: Path, tmp_path: Path) -> None:
    async def run() -> None:
        async with Lab(tmp_path) as lab:
            client = await lab.client()
            keys = client.mesh.keys
            news: asyncio.Queue[tuple[str, BuildingPoses]] = asyncio.Queue()
            client.mesh.subscribe(
                keys.building_poses_any, BuildingPoses, lambda key, told: news.put_nowait((key, told))
            )
            lab.spawn([*COMMAND, "simulate", str(closet), "--mesh", "--speed", "3"], log="building.log")
            async with asyncio.timeout(HANG):
                key, first = await news.get()
                _, second = await news.get()
            assert {robot.name for robot in first.robots} == {"scout33", "scout35"}
            assert second.time > first.time
            assert first.speed == 3
            reply = await client.mesh.ask(
                keys.building_plan(keys.sender_of(key)),
                PlanAsk(),
                BuildingPlan,
                timeout=HANG,
                enough=lambda _: True,
                limit=MAX_PLAN,
            )
            plan = reply[0].message
            assert plan is not None
            assert (plan.name, plan.width, plan.picture[1:4]) == ("closet", 2.0, b"PNG")

    asyncio.run(run())


def test_the_shipped_buildings_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert zscout_here("simulate", "--list") == 0
    said = capsys.readouterr().out
    assert "living_room" in said
    assert "office" in said
    assert zscout_here("simulate", "--list", "--json") == 0
    rows = json.loads(capsys.readouterr().out)
    for row in rows:
        assert row["robots"] == ["scout33", "scout35", "scout37", "scout39"]


def test_the_building_in_the_docs_is_one(tmp_path: Path) -> None:
    text = (Path(__file__).parents[3] / "docs" / "reference" / "building.md").read_text()
    file = tmp_path / "study.toml"
    file.write_text(text.partition("```toml\n")[2].partition("```")[0])
    assert plan_named(str(file)).robots[0].id == 33


def test_a_building_is_drawn_by_its_seed() -> None:
    assert plan_named("random:3") != plan_named("random:4")


def test_a_port_in_use_is_said_so(closet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        assert zscout_here("simulate", closet, "--http", address) == 2
    said = capsys.readouterr().err
    assert "(in use); choose another" in said
    assert said.count("\n") == 1

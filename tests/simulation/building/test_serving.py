"""A building served in real time: its robots are driven over its serial port and seen over HTTP."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import cv2
import numpy as np
import pytest
import serial

from tests.hang import HANG
from tests.simulation.building.real_time import in_real_time, until, with_served
from zscout.config.strict import BadInput
from zscout.drivers.packets import CameraPacket, DrivePacket, HaltPacket, Packet, encode
from zscout.simulation.building.bodies import TOP_SPEED
from zscout.simulation.building.camera import Picture
from zscout.simulation.building.plan import Furniture, Light, Noise, Person, Plan, Robot
from zscout.simulation.building.serve import Served
from zscout.simulation.building.view import building_plan

BAUD = 9600
PLAN = Plan(
    name="closet",
    width=2.4,
    depth=2.0,
    noise=Noise(sensor=0.3, analog=0.3),
    furniture=(Furniture("chest", "solid", 2.0, 1.7, 0.5, 0.4, 0.6, shade=0.1),),
    lights=(Light("ceiling", 1.2, 1.0),),
    robots=(Robot("scout33", 33, 0.4, 1.0, slip=0.0), Robot("scout35", 35, 0.4, 0.4, 0.8, slip=0.0)),
)


in_closet = with_served(lambda: Served(PLAN, speed=8.0))


class Driver:
    """Sends packets as the real driver's line does."""

    def __init__(self, served: Served) -> None:
        assert served.radio.port is not None
        self._port = serial.Serial(served.radio.port, BAUD, timeout=1, write_timeout=HANG, exclusive=True)
        self._numbers = itertools.cycle(range(256))

    def send(self, kind: Callable[..., Packet], robot: int, *arguments: float) -> None:
        self._port.write(encode(kind(robot, next(self._numbers), *arguments)))

    def __enter__(self) -> Driver:
        return self

    def __exit__(self, *exc: object) -> None:
        self._port.close()


async def picture_of(served: Served, channel: int) -> Picture:
    """One frame as it is served."""
    url = served.video.url(served.channels[channel - 1]) + ".jpg"

    def read() -> bytes:
        with urlopen(url, timeout=HANG) as answer:  # noqa: S310 - our own address
            return bytes(answer.read())

    raw = np.frombuffer(await asyncio.to_thread(read), np.uint8)
    picture = cv2.imdecode(raw, cv2.IMREAD_GRAYSCALE)
    assert picture is not None
    return np.asarray(picture, np.uint8)


def alike(one: Picture, other: Picture) -> float:
    """Correlation of two pictures."""
    return float(np.corrcoef(one.ravel(), other.ravel())[0, 1])


@in_closet
async def test_a_robot_is_driven_over_the_serial_port_and_stops_by_itself(served: Served) -> None:
    with Driver(served) as driver:
        body = served.world.bodies["scout33"]
        before = body.pose
        driver.send(DrivePacket, 33, 0.8, 0.8, 1.0)
        await until(lambda: body.travelled > 0 and body.still)
    there = body.pose
    assert there.x - before.x == pytest.approx(0.8 * TOP_SPEED, rel=0.1)
    assert there.y == pytest.approx(before.y, abs=0.01)
    assert served.world.bodies["scout35"].pose.x == 0.4


@in_closet
async def test_a_camera_is_switched_on_and_its_picture_served(served: Served) -> None:
    with Driver(served) as driver:
        snow = await picture_of(served, 2)
        driver.send(CameraPacket, 33, 2)
        await until(lambda: served.world.bodies["scout33"].camera == 2)
        await served.until(served.time + 3)
        picture, again = await picture_of(served, 2), await picture_of(served, 2)
        assert picture.shape == (120, 160)
        assert abs(alike(snow, picture)) < 0.2
        assert alike(picture, again) > 0.9
        driver.send(HaltPacket, 33)
        await until(lambda: served.world.bodies["scout33"].camera is None)
        assert abs(alike(picture, await picture_of(served, 2))) < 0.2


@in_closet
async def test_two_transmitters_on_one_channel_spoil_each_other_until_one_dies(served: Served) -> None:
    with Driver(served) as driver:
        driver.send(CameraPacket, 33, 1)
        await until(lambda: served.world.bodies["scout33"].camera == 1)
        await served.until(served.time + 3)
        alone = await picture_of(served, 1)
        driver.send(CameraPacket, 35, 1)
        await until(lambda: served.world.bodies["scout35"].camera == 1)
        await served.until(served.time + 3)
        assert alike(alone, await picture_of(served, 1)) < 0.6
        served.kill("scout35")
        await served.until(served.time + 1)
        assert alike(alone, await picture_of(served, 1)) > 0.9


@in_closet
async def test_only_watched_channels_are_drawn_each_at_its_rate(served: Served) -> None:
    await served.until(1.0)
    assert served.frames == 0
    await picture_of(served, 1)
    assert served.frames >= 1
    await until(lambda: served.video.watched == ())
    before, since = served.frames, served.time
    capture = await asyncio.to_thread(
        cv2.VideoCapture,
        served.video.url("ch1"),
        cv2.CAP_FFMPEG,
        [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, 20_000, cv2.CAP_PROP_READ_TIMEOUT_MSEC, 20_000],
    )
    for _ in range(25):
        assert (await asyncio.to_thread(capture.read))[0]
    drawn, passed = served.frames - before, served.time - since
    await asyncio.to_thread(capture.release)
    # One may be under way at each end; on a busy machine some are left out.
    assert 25 <= drawn <= passed * served.frame_rate + 2
    await until(lambda: served.video.watched == ())


@in_closet
async def test_a_channel_stalls_and_goes_on(served: Served) -> None:
    served.stall(2)
    waiting = asyncio.ensure_future(picture_of(served, 2))
    await until(lambda: served.video.clients == 1)
    await served.until(served.time + 1)
    assert served.frames == 0
    served.stall(2, stalled=False)
    assert (await waiting).shape == (120, 160)


@in_real_time
async def test_the_radio_is_unplugged_and_plugged_in_again(tmp_path: Path) -> None:
    link = tmp_path / "radio0"
    async with Served(PLAN, speed=8.0, radio_link=link) as served:
        with Driver(served):
            served.unplug_radio()
            assert served.radio.port is None
        served.plug_radio()
        with Driver(served) as driver:
            driver.send(CameraPacket, 35, 4)
            await until(lambda: served.world.bodies["scout35"].camera == 4)
    assert not link.is_symlink()


@in_real_time
async def test_who_is_where_and_what_the_building_looks_like() -> None:
    # She walks from the beginning.
    walker = Person("anna", path=((0.2, 1.8), (2.2, 1.8)), speed=0.1, first=0.0, jitter=0.0)
    cave = Furniture("bed", "bed", 0.6, 1.0, 1.2, 1.6, 0.5, clearance=0.1)
    robots = (PLAN.robots[0], Robot("scout35", 35, 2.0, 0.5))
    plan = Plan(
        name="bedroom", width=2.4, depth=2.0, furniture=(cave,), lights=PLAN.lights, people=(walker,), robots=robots
    )
    async with Served(plan, speed=2.0) as served:
        with Driver(served) as driver:
            await served.until(0.5)
            told = await served.poses()
            assert (told.speed, [one.name for one in told.people]) == (2.0, ["anna"])
            assert 0.2 < told.people[0].x < 2.2
            assert [(one.name, one.hidden, one.camera) for one in told.robots] == [
                ("scout33", True, 0),
                ("scout35", False, 0),
            ]
            driver.send(DrivePacket, 33, 0.1, -0.1, 5.0)
            driver.send(CameraPacket, 35, 3)
            await until(lambda: served.world.bodies["scout35"].camera == 3)
            moving, filming = (await served.poses()).robots
            # Whoever still moves has not hidden yet.
            assert not moving.hidden
            assert filming.camera == 3
        drawn = await served.map()
        picture = cv2.imdecode(np.frombuffer(drawn.picture, np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        high, wide = picture.shape[:2]
        assert wide / high == pytest.approx(drawn.width / drawn.depth, rel=0.01)
        # Under the bed is darker than the middle of the floor; rows go down.
        assert picture[high // 4, wide // 4].mean() < picture[high // 2, wide * 3 // 4].mean()


def test_a_large_building_is_drawn_small_enough_for_the_mesh(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zscout.simulation.building.view.MAX_PNG", 30_000)
    small = building_plan(PLAN)
    assert len(small.picture) <= 30_000
    monkeypatch.undo()
    assert len(building_plan(PLAN).picture) > 30_000


@in_closet
async def test_a_building_that_breaks_says_so(served: Served) -> None:
    def broken(dt: float) -> None:
        raise RuntimeError(f"the roof came down within {dt} s")

    served.world.step = broken  # type: ignore[method-assign]
    with pytest.raises(RuntimeError, match="roof"):
        await served.until(1e6)


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"speed": 0}, "more than 0"),
        ({"frame_rate": 0}, "write 0.1 to 60"),
        ({"channels": 16}, "write 1 to 15"),
        ({"loss": 2}, "share"),
    ],
)
@in_real_time
async def test_what_cannot_be_served(how: dict[str, Any], words: str) -> None:
    with pytest.raises(BadInput, match=words):
        await Served(PLAN, **how).__aenter__()


@in_real_time
async def test_the_port_is_free_again_where_a_part_failed(tmp_path: Path) -> None:
    taken = tmp_path / "taken"
    taken.write_text("mine")
    async with Served(PLAN, speed=4) as served:
        port = int(served.video.page[:-1].rpartition(":")[2])
        with pytest.raises(BadInput, match="in use"):
            await Served(PLAN, http=("127.0.0.1", port)).__aenter__()
    for _ in range(2):
        with pytest.raises(BadInput, match="already exists"):
            await Served(PLAN, http=("127.0.0.1", port), radio_link=taken).__aenter__()

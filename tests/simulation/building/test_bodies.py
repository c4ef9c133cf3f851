"""A robot's firmware and motors."""

from __future__ import annotations

import numpy as np
import pytest
from msgspec.structs import replace

from tests.simulation.building.rooms import room
from zscout.drivers.packets import CameraPacket, DrivePacket, HaltPacket, Packet, StopPacket
from zscout.simulation.building.bodies import LAG, TOP_SPEED, WARM_UP, WHEEL_BASE, Body, Pose
from zscout.simulation.building.plan import Robot
from zscout.simulation.building.world import World

ROBOT = Robot(name="r1", id=1, x=1.0, y=1.0, slip=0.0)


def body() -> Body:
    return Body(ROBOT, Pose(1.0, 1.0, 0.0), np.random.default_rng(0))


def roll(one: Body, start: float, end: float) -> list[tuple[float, float]]:
    """Ground speeds from `start` to `end`, every 0.02 s."""
    return [one.roll(0.02, start + 0.02 * n) for n in range(round((end - start) / 0.02))]


def test_wheels_stop_by_themselves_when_their_time_is_over() -> None:
    one = body()
    one.receive(DrivePacket(1, 0, 1.0, 1.0, 0.5), 0.0)
    speeds = roll(one, 0.0, 2.0)
    assert speeds[24][0] == pytest.approx(TOP_SPEED, rel=0.02)
    assert (one.left, one.right) == (0.0, 0.0)
    # The motors' lag alone lets them run on.
    after = [left for left, _ in speeds[25:]]
    assert after == sorted(after, reverse=True)
    assert after[round(5 * LAG / 0.02)] < TOP_SPEED / 100
    assert after[-1] == 0.0
    assert one.still
    assert sum(left for left, _ in speeds) * 0.02 == pytest.approx(TOP_SPEED * 0.5, rel=0.03)


def test_a_newer_command_counts_from_when_it_came() -> None:
    one = body()
    one.receive(DrivePacket(1, 0, 1.0, 1.0, 0.5), 0.0)
    one.receive(DrivePacket(1, 1, 0.5, -0.5, 0.5), 0.4)
    assert roll(one, 0.4, 0.88)[-1] == pytest.approx((TOP_SPEED / 2, -TOP_SPEED / 2), rel=0.02)
    one.receive(DrivePacket(1, 2, 0.2, 0.2, 0.1), 0.88)
    roll(one, 0.88, 1.02)
    assert (one.left, one.right) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("packet", "wheels", "camera"),
    [
        (StopPacket(1, 5), 0.0, 3),
        (HaltPacket(1, 5), 0.0, None),
        (CameraPacket(1, 5, 0), 1.0, None),
        (CameraPacket(1, 5, 7), 1.0, 7),
        pytest.param(HaltPacket(2, 5), 1.0, 3, id="for another robot"),
        pytest.param(CameraPacket(1, 1, 3), 1.0, 3, id="the last packet again"),
        pytest.param(HaltPacket(1, 1), 0.0, None, id="another packet of the last number"),
    ],
)
def test_what_packets_do(packet: Packet, wheels: float, camera: int | None) -> None:
    one = body()
    one.receive(DrivePacket(1, 0, 1.0, 1.0, 5.0), 0.0)
    one.receive(CameraPacket(1, 1, 3), 0.0)
    one.receive(packet, 0.5)
    roll(one, 0.5, 0.6)
    assert (one.left, one.camera) == (wheels, camera)


def test_a_drive_packet_that_is_heard_twice_does_not_last_longer() -> None:
    one = body()
    one.receive(DrivePacket(1, 9, 1.0, 1.0, 0.5), 0.0)
    one.receive(DrivePacket(1, 9, 1.0, 1.0, 0.5), 0.4)
    roll(one, 0.4, 0.6)
    assert one.left == 0.0


def test_a_camera_warms_up_once() -> None:
    one = body()
    assert one.warmth(0.0) == 0.0
    one.transmit(1, 10.0)
    assert [one.warmth(10.0 + WARM_UP * share) for share in (0.0, 0.5, 1.0, 9.0)] == [0.0, 0.5, 1.0, 1.0]
    one.transmit(2, 20.0)
    assert one.warmth(20.0) == 1.0
    one.transmit(None, 21.0)
    one.transmit(2, 22.0)
    assert one.warmth(22.0) == 0.0


def test_without_a_battery_nothing_turns_or_transmits() -> None:
    one = body()
    one.receive(CameraPacket(1, 0, 3), 0.0)
    one.receive(DrivePacket(1, 1, 1.0, 1.0, 5.0), 0.0)
    roll(one, 0.0, 1.0)
    one.alive = False
    assert one.warmth(5.0) == 0.0
    assert roll(one, 1.0, 2.5)[-1] == (0.0, 0.0)
    assert one.camera is None
    one.receive(DrivePacket(1, 2, 1.0, 1.0, 5.0), 2.5)
    assert roll(one, 2.5, 3.0)[-1] == (0.0, 0.0)


def drive(left: float, right: float, lasts: float) -> Body:
    """A robot that was at (1, 1), heading along x, when it has done that and stands."""
    world = World(room())
    one = world.bodies["r1"]
    one.receive(DrivePacket(1, 0, left, right, lasts), 0.0)
    for _ in range(round(lasts / 0.1) + 15):
        world.step(0.1)
    assert one.still
    return one


STEP = 0.02
"""Seconds within which the world lets a command end."""


@pytest.mark.parametrize(("speed", "lasts"), [(1.0, 5.0), (-0.5, 2.0), (0.1, 3.0)])
def test_a_straight_run_is_as_long_as_it_was_told(speed: float, lasts: float) -> None:
    one, near = drive(speed, speed, lasts), STEP * TOP_SPEED * abs(speed) + 1e-4
    assert one.pose == pytest.approx((1.0 + speed * TOP_SPEED * lasts, 1.0, 0.0), abs=near)
    assert one.travelled == pytest.approx(abs(speed) * TOP_SPEED * lasts, abs=near)


def test_a_turn_in_place_is_as_far_as_it_was_told() -> None:
    one, rate = drive(-0.2, 0.2, 1.0), 2 * 0.2 * TOP_SPEED / WHEEL_BASE
    assert (one.x, one.y) == pytest.approx((1.0, 1.0), abs=1e-6)
    assert one.heading == pytest.approx(rate, abs=rate * STEP + 1e-3)


def test_wheels_that_slip_lead_astray_by_some_percent() -> None:
    ways, wobbles = [], []
    for seed in range(60):
        one = Body(replace(ROBOT, slip=0.04), Pose(1.0, 1.0, 0.0), np.random.default_rng(seed))
        one.receive(DrivePacket(1, 0, 1.0, 1.0, 3.0), 0.0)
        speeds = np.array(roll(one, 0.0, 4.5))
        ways.append(speeds.sum(0) * 0.02 / (3.0 * TOP_SPEED))
        wobbles.append(speeds[50:140].std() / TOP_SPEED)
    assert 0.02 < np.mean(wobbles) < 0.08
    assert np.mean(ways) == pytest.approx(1.0, abs=0.03)
    # Each wheel in its own way, and most of it the same all along.
    assert 0.02 < np.std(np.diff(ways)) < 0.12
    assert 0.02 < np.std(ways) < 0.08

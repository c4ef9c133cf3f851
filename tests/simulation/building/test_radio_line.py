"""The radio's line, written to by the real serial driver."""

from __future__ import annotations

import asyncio
from functools import partial
from pathlib import Path

import pytest
import serial

from tests.hang import HANG
from tests.simulation.building.real_time import in_real_time, until
from zscout.config.strict import BadInput
from zscout.drivers.packets import DrivePacket, Packet, StopPacket, encode
from zscout.simulation.building.radio_line import HOLDS, SLACK, Pace, RadioLine

DRIVE = DrivePacket(33, 0, 0.5, -0.5, 1.0)


class Ear:
    """What came through a line, and when, on the loop's clock."""

    def __init__(self) -> None:
        self.heard: list[tuple[float, Packet]] = []

    def __call__(self, packet: Packet, at: float) -> None:
        self.heard.append((at, packet))

    @property
    def packets(self) -> list[Packet]:
        return [packet for _, packet in self.heard]


def opened(port: str | Path | None, baud: int, *, write_timeout: float = HANG) -> serial.Serial:
    assert port is not None
    return serial.Serial(str(port), baud, timeout=1, exclusive=True, write_timeout=write_timeout)


def numbered(count: int) -> list[Packet]:
    return [StopPacket(number % 200, number % 256) for number in range(count)]


async def written(line: RadioLine, baud: int, packets: list[Packet]) -> None:
    """Writes them from a thread, as a driver does, and returns when the line carried them."""
    data = b"".join(map(encode, packets))
    with opened(line.port, baud) as port:
        end = line.carried + len(data)
        await asyncio.to_thread(port.write, data)
        await until(lambda: line.carried >= end)


def test_the_line_carries_a_tenth_of_its_baud_rate_in_bytes() -> None:
    pace, now = Pace(960), 100.0
    for _ in range(250):
        now = pace.carry(now, 8, waited=now > 100)
    assert now - 100 == pytest.approx(2000 / 960)


def test_a_look_that_comes_late_costs_the_line_nothing_up_to_its_slack() -> None:
    pace = Pace(960)
    first = pace.carry(0.0, 96, waited=False)
    assert pace.carry(first + SLACK, 96, waited=True) == pytest.approx(0.2)
    # What came to a line at rest, or far too late, begins when it comes.
    assert pace.carry(1.0, 96, waited=False) == pytest.approx(1.1)
    assert pace.carry(1.1 + 2 * SLACK, 96, waited=True) == pytest.approx(1.2 + 2 * SLACK)


@in_real_time
async def test_packets_come_in_order_and_no_sooner_than_the_line_carries_them() -> None:
    ear, packets = Ear(), numbered(40)
    with RadioLine(9600, ear) as line:
        await written(line, 9600, packets)
    assert ear.packets == packets
    size = sum(len(encode(packet)) for packet in packets)
    # All but the packet that began the count, and a chunk that may have been through with it.
    least = (size - len(encode(packets[0])) - Pace(960).chunk) / 960
    assert ear.heard[-1][0] - ear.heard[0][0] >= least > 0.2


@in_real_time
async def test_a_faster_building_has_a_faster_line() -> None:
    ear = Ear()
    with RadioLine(1200, ear, speed=8) as line:
        assert line.baud == 9600
        await written(line, 9600, numbered(20))
        # Drivers may know the line by its own name as well.
        await written(line, 1200, numbered(20))
    assert len(ear.packets) == 40
    least = (19 * len(encode(StopPacket(0, 0))) - Pace(960).chunk) / 960
    assert ear.heard[19][0] - ear.heard[0][0] >= least


@in_real_time
async def test_who_writes_more_than_a_line_holds_must_wait() -> None:
    async def fill(line: RadioLine, port: serial.Serial) -> None:
        part = encode(DRIVE) * 50
        for _ in range(2 * HOLDS // len(part)):
            await asyncio.to_thread(port.write, part)
            # The line has looked at what waits since.
            looked = line.carried + 2 * Pace(960).chunk
            await until(partial(_carried, line, looked))

    with (
        RadioLine(9600, Ear()) as line,
        opened(line.port, 9600, write_timeout=0.2) as port,
        pytest.raises(serial.SerialTimeoutException),
    ):
        await fill(line, port)


def _carried(line: RadioLine, least: int) -> bool:
    return line.carried >= least


@pytest.mark.parametrize("loss", [0.0, 0.2, 1.0])
def test_packets_are_lost_at_the_rate_that_was_set_and_the_same_each_time(loss: float) -> None:
    async def heard() -> list[Packet]:
        ear = Ear()
        with RadioLine(1_000_000, ear, loss=loss, seed=7) as line:
            await written(line, 1_000_000, numbered(1_000))
            assert line.received + line.lost == 1_000
        return ear.packets

    first, second = asyncio.run(heard()), asyncio.run(heard())
    assert first == second
    # Three standard deviations of a draw of 1,000.
    assert abs(len(first) - 1_000 * (1 - loss)) <= 3 * (1_000 * loss * (1 - loss)) ** 0.5


@in_real_time
async def test_garbled_bytes_spoil_packets_and_make_up_none() -> None:
    ear, packets = Ear(), numbered(200)
    with RadioLine(1_000_000, ear, garble=0.02, seed=3) as line:
        await written(line, 1_000_000, packets)
        assert 100 < len(ear.packets) < 200
        assert line.spoiled > 0
    assert set(ear.packets) <= set(packets)


@in_real_time
async def test_a_driver_at_another_rate_is_noise() -> None:
    ear = Ear()
    with RadioLine(19_200, ear) as line:
        await written(line, 9600, numbered(20))
        assert ear.packets == []
        await written(line, 19_200, [DRIVE])
        await until(lambda: len(ear.packets) == 1)


@in_real_time
async def test_unplugged_and_plugged_in_again_behind_the_same_link(tmp_path: Path) -> None:
    ear, link = Ear(), tmp_path / "radio0"
    with RadioLine(115_200, ear, link=link) as line:
        port = opened(link, 115_200)
        line.unplug()
        assert not link.is_symlink()
        with pytest.raises((serial.SerialException, OSError)):
            port.write(encode(DRIVE))
        port.close()
        with pytest.raises(serial.SerialException):
            opened(link, 115_200)
        line.plug()
        assert str(link.readlink()) == line.port
        with opened(link, 115_200) as again:
            again.write(encode(DRIVE))
            await until(lambda: ear.packets != [])
    assert [type(packet) for packet in ear.packets] == [DrivePacket]
    assert list(tmp_path.iterdir()) == []  # noqa: ASYNC240


@in_real_time
async def test_what_waited_in_a_line_that_was_unplugged_is_gone() -> None:
    ear = Ear()
    with RadioLine(300, ear) as line:
        with opened(line.port, 300) as port:
            port.write(encode(DRIVE) * 20)
            line.unplug()
            with pytest.raises((serial.SerialException, OSError)):
                port.write(b"x")
        line.plug()
        with opened(line.port, 300) as port:
            port.write(encode(StopPacket(9, 1)))
            await until(lambda: ear.packets != [])
    assert ear.packets == [StopPacket(9, 1)]


@in_real_time
async def test_the_link_replaces_one_to_a_pty_and_nothing_else(tmp_path: Path) -> None:
    stale, file, foreign = tmp_path / "stale", tmp_path / "file", tmp_path / "foreign"
    stale.symlink_to("/dev/pts/12345")
    file.write_text("mine")
    foreign.symlink_to(file)
    with RadioLine(9600, Ear(), link=stale) as line:
        assert str(stale.readlink()) == line.port
    assert not stale.is_symlink()
    for link in (file, foreign, tmp_path / "no" / "folder"):
        with pytest.raises(BadInput, match="give another name"):
            RadioLine(9600, Ear(), link=link)
    assert file.read_text() == "mine"
    assert foreign.readlink() == file


@pytest.mark.parametrize(
    ("how", "words"),
    [
        ({"baud": 200}, "write 300 to"),
        ({"speed": 0.0}, "more than 0"),
        ({"loss": 1.5}, "loss 1.5: write a share"),
        ({"garble": -0.1}, "garble -0.1: write a share"),
    ],
)
@in_real_time
async def test_what_no_line_can_be(how: dict[str, float], words: str) -> None:
    with pytest.raises(BadInput, match=words):
        RadioLine(**{"baud": 9600, "on_packet": Ear(), **how})  # type: ignore[arg-type]

"""The radio's driver on a real pty: unplugged and plugged in again, stalled, shared, paced."""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
import serial

from tests.drivers.ptys import PtyLine
from tests.hang import HANG
from tests.live.bench import until
from zscout.drivers.packets import DrivePacket, HaltPacket, encode
from zscout.drivers.serial_line import DEPTH, SerialLine
from zscout.drivers.serial_port import SerialPort

pytestmark = pytest.mark.real_time


class Ear:
    """Keeps what a line tells."""

    def __init__(self) -> None:
        self.told: list[str] = []
        self.wrote = 0
        self._news = asyncio.Event()

    def line_up(self) -> None:
        self._tell("up")

    def line_down(self, why: str) -> None:
        self._tell(why)

    def line_wrote(self) -> None:
        self.wrote += 1
        self._news.set()

    def _tell(self, what: str) -> None:
        self.told.append(what)
        self._news.set()

    async def until(self, true: Callable[[], Any]) -> None:
        try:
            async with asyncio.timeout(HANG):
                while not true():
                    self._news.clear()
                    await self._news.wait()
        except TimeoutError:
            raise AssertionError(f"waited in vain; it told {self.told}") from None


def opened(port: str, ear: Ear) -> SerialLine:
    return SerialLine(SerialPort(port, 9600), up=ear.line_up, down=ear.line_down, wrote=ear.line_wrote)


@asynccontextmanager
async def live(link: Path, **how: Any) -> AsyncIterator[tuple[PtyLine, Ear, SerialLine]]:
    """An open line."""
    pty, ear = PtyLine(link, **how), Ear()
    line = opened(str(link), ear)
    try:
        await ear.until(lambda: ear.told == ["up"])
        yield pty, ear, line
    finally:
        await line.stop()
        pty.unplug()


async def test_what_is_written_arrives_and_noise_does_not_hide_it(tmp_path: Path) -> None:
    async with live(tmp_path / "tty") as (pty, ear, line):
        for number in range(4):
            garbled = encode(DrivePacket(1, number, 1, -1, 0.5))[:-3]
            assert line.write(garbled + encode(HaltPacket(1, number)))
            await ear.until(lambda number=number: ear.wrote == number + 1)  # type: ignore[misc]
        await pty.until(lambda packets: packets == [HaltPacket(1, number) for number in range(4)])
        assert pty.decoder.spoiled >= 4
        # What the radio itself says is read and counted, so that it fills no buffer.
        os.write(pty.master, b"OK\r\n" * 100)
        await until(lambda: line.received == 400)


async def test_unplugged_and_plugged_in_again(tmp_path: Path) -> None:
    async with live(tmp_path / "tty") as (pty, ear, line):
        for _ in range(2):
            pty.unplug()
            await ear.until(lambda: len(ear.told) >= 2)
            assert "was unplugged" in ear.told[1]
            await ear.until(lambda: "is not there" in ear.told[-1])
            pty.plug()
            await ear.until(lambda: ear.told[-1] == "up")
            # Once for each reason in a row, however often it was tried.
            assert len(ear.told) == 4
            assert line.write(encode(HaltPacket(3, 1)))
            await pty.until(lambda packets: packets == [HaltPacket(3, 1)])
            ear.told, pty.heard = ["up"], []


async def test_a_second_program_is_refused_and_has_its_turn_later(tmp_path: Path) -> None:
    pty, first, second = PtyLine(tmp_path / "tty"), Ear(), Ear()
    line = opened(str(pty.link), first)
    await first.until(lambda: first.told == ["up"])
    with pytest.raises(serial.SerialException):
        serial.Serial(str(pty.link), exclusive=True)
    other = opened(str(pty.link), second)
    await second.until(lambda: second.told)
    assert second.told == [f"{pty.link} is used by another device of this node"]
    await line.stop()
    await second.until(lambda: second.told[-1] == "up")
    await other.stop()
    pty.unplug()


async def test_a_line_that_takes_nothing_is_told_of_and_its_backlog_thrown_away(tmp_path: Path) -> None:
    async with live(tmp_path / "tty", reads=False) as (pty, ear, line):
        block, sent = encode(DrivePacket(1, 1, 1, 1, 0.5)) * 400, 0
        while len(ear.told) == 1 and sent < 100:
            written = ear.wrote
            if line.write(block):
                sent += 1
            await ear.until(lambda written=written: ear.wrote > written or len(ear.told) > 1)  # type: ignore[misc]
        assert "took nothing" in ear.told[1]
        assert not all(line.write(block) for _ in range(DEPTH + 1))
        # It opens again, and what lay in the buffers has gone.
        await ear.until(lambda: ear.told[-1] == "up")
        left = b""
        try:
            while data := os.read(pty.master, 65_536):
                left += data
        except BlockingIOError:
            pass
        # All but what the other end had in its own hands already.
        assert len(left) < 4096 < ear.wrote * len(block)


async def test_ports_that_can_never_be_opened_are_named_in_plain_words(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.write_text("no tty")
    with socket.socket() as bound:  # and not listening: its port refuses connections
        bound.bind(("127.0.0.1", 0))
        for port, words in (
            (str(tmp_path / "none"), "is not there; is it plugged in?"),
            (str(file), "is no serial port"),
            (f"socket://127.0.0.1:{bound.getsockname()[1]}", "no program listens there"),
            ("nonsense://x", "nonsense://x fails: "),
        ):
            ear = Ear()
            line = opened(port, ear)
            await ear.until(lambda ear=ear: ear.told)  # type: ignore[misc]
            assert words in ear.told[0]
            await line.stop()


async def test_a_radio_on_another_machine(tmp_path: Path) -> None:
    arrived: asyncio.Queue[bytes] = asyncio.Queue()

    async def served(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        arrived.put_nowait(await reader.readexactly(7))
        writer.close()

    server = await asyncio.start_server(served, "127.0.0.1", 0)
    port, ear = server.sockets[0].getsockname()[1], Ear()
    line = opened(f"socket://127.0.0.1:{port}", ear)
    await ear.until(lambda: ear.told == ["up"])
    line.write(encode(HaltPacket(9, 9)))
    assert await asyncio.wait_for(arrived.get(), HANG) == encode(HaltPacket(9, 9))
    # The other machine hangs up: that is noticed though nothing is sent.
    await ear.until(lambda: len(ear.told) > 1)
    server.close()
    await line.stop()
